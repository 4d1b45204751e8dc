"""`benchmarks/hardening.py` notices what a refused command must not do, and a few of its lines are refused well."""

from __future__ import annotations

import sys
from collections import Counter
from types import ModuleType
from typing import Any

import pytest
from command_line import REPOSITORY


@pytest.fixture(scope="module")
def hardening() -> ModuleType:
    """The script, which imports others beside it."""
    place = str(REPOSITORY / "benchmarks")
    sys.path.insert(0, place)
    try:
        import hardening
    finally:
        sys.path.remove(place)
    return hardening


GOOD = "import sys; sys.stderr.write('error: no\\n'); "


def test_what_a_refused_command_must_not_do_is_seen(hardening: ModuleType) -> None:
    lines = {
        GOOD + "sys.exit(2)": "",
        GOOD + "sys.exit(0)": "exit code",
        GOOD * 2 + "sys.exit(2)": "sentences",
        "import sys; sys.exit(2)": "sentences",
        GOOD + "raise ValueError": "traceback",
        GOOD + "open('left', 'w').close(); sys.exit(2)": "changed",
        GOOD + "open('mine', 'a').write('!'); sys.exit(2)": "changed",
        GOOD + "import tempfile; tempfile.mkdtemp(); sys.exit(2)": "left behind",
        "import time; time.sleep(60)": "time",
        "import time; b = b'x' * (3 * 10**8); time.sleep(60)": "memory",
    }
    kept, hardening.MEMORY = hardening.MEMORY, 2e8
    try:
        for line, cause in lines.items():
            case = hardening.Case("python", line, ("-c", line), {"mine": b"mine"})
            wrong = hardening.run(case, 60.0 if cause != "time" else 3.0)["wrong"]
            assert (not wrong) if not cause else any(text.startswith(cause) for text in wrong), (line, wrong)
    finally:
        hardening.MEMORY = kept


def test_every_command_has_many_lines(hardening: ModuleType) -> None:
    cases = hardening.every_case()
    assert len(cases) >= hardening.LINES
    assert len({(case.program, case.flaw) for case in cases}) == len(cases)
    count = Counter(case.program for case in cases)
    assert set(count) == {"train", "eval", "view", "fly", "export", "gains", "identify"}
    assert min(count[name] for name in ("train", "eval", "view", "fly")) > 40
    assert len(hardening.spread(cases, hardening.LINES)) == hardening.LINES


@pytest.mark.slow
def test_some_of_its_lines_are_refused_well(hardening: ModuleType) -> None:
    """One of each command: the whole list is the script's."""
    wanted: dict[str, Any] = {
        "train": "--plant an unknown key",
        "eval": "policy: a NaN weight",
        "view": "--amplitude alone",
        "fly": "--gains empty",
        "export": "policy: noise",
        "gains": "gains.json exists",
        "identify": "log: a directory",
    }
    found = [case for case in hardening.every_case() if wanted.get(case.program) == case.flaw]
    assert {case.program for case in found} == set(wanted)
    for case in found:
        assert hardening.run(case, 120.0)["wrong"] == [], case
