"""Refused command lines do nothing else, and what judges them notices if they did."""

from __future__ import annotations

from collections import Counter
from typing import Any

import hostile_lines
import pytest

GOOD = "import sys; sys.stderr.write('error: no\\n'); "


def test_what_a_refused_command_must_not_do_is_seen() -> None:
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
    kept, hostile_lines.MEMORY = hostile_lines.MEMORY, 2e8
    try:
        for line, cause in lines.items():
            case = hostile_lines.Case("python", line, ("-c", line), {"mine": b"mine"})
            wrong = hostile_lines.run(case, 60.0 if cause != "time" else 3.0)["wrong"]
            assert (not wrong) if not cause else any(text.startswith(cause) for text in wrong), (line, wrong)
    finally:
        hostile_lines.MEMORY = kept


def test_every_command_has_many_lines() -> None:
    cases = hostile_lines.every_case()
    assert len(cases) >= 250
    assert len({(case.program, case.flaw) for case in cases}) == len(cases)
    count = Counter(case.program for case in cases)
    programs = {"train", "eval", "export", "fly", "view", "app", "log", "gains", "design", "identify", "mount"}
    assert set(count) == programs
    assert min(count[name] for name in ("train", "eval", "view", "fly")) > 40


@pytest.mark.slow
def test_some_of_its_lines_are_refused_well() -> None:
    """One of each command."""
    wanted: dict[str, Any] = {
        "train": "--plant an unknown key",
        "eval": "policy: a NaN weight",
        "view": "--amplitude alone",
        "fly": "--gains empty",
        "export": "policy: noise",
        "app": "app exists",
        "log": "log: noise",
        "gains": "gains.json exists",
        "design": "--plant alone",
        "identify": "log: a directory",
        "mount": "log: a directory",
    }
    found = [case for case in hostile_lines.every_case() if wanted.get(case.program) == case.flaw]
    assert {case.program for case in found} == set(wanted)
    for case in found:
        assert hostile_lines.run(case, 120.0)["wrong"] == [], case


@pytest.mark.release
@pytest.mark.parametrize("program", ["train", "eval", "view", "fly", "export", "gains", "design", "identify", "mount"])
def test_every_line_is_refused_well(program: str) -> None:
    lines = [case for case in hostile_lines.every_case() if case.program == program]
    wrong = {case.flaw: found for case in lines if (found := hostile_lines.run(case, hostile_lines.SECONDS)["wrong"])}
    assert wrong == {}
