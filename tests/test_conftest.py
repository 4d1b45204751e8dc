"""Tests by the clock on a machine that others keep busy."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = """
import sys
import pytest

@pytest.mark.clock
def test_in_this_process():
    print("error: this computer is too slow for a rehearsal in real time", file=sys.stderr)
    assert 2 == 0

@pytest.mark.clock
def test_in_another_one():
    assert "error: this computer is too slow for a rehearsal" == ""

@pytest.mark.clock
def test_that_is_wrong():
    assert 2 == 0

def test_that_goes_by_no_clock():
    assert "this computer is too slow for a rehearsal" == ""
"""


@pytest.mark.slow
def test_what_only_a_busy_machine_fails_is_skipped_after_three_attempts(tmp_path: Path) -> None:
    (tmp_path / "test_busy.py").write_text(TESTS, encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-p", "conftest", "-p", "no:cacheprovider", "-rfs", "test_busy.py"]
    path = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    alone = {name: value for name, value in os.environ.items() if not name.startswith("PYTEST_")}
    child = {**alone, "PYTHONPATH": path}
    done = subprocess.run(command, cwd=tmp_path, env=child, capture_output=True, text=True, check=False)
    assert re.search("2 failed, 2 skipped.*6 rerun", done.stdout), done.stdout
    assert "test_busy.py::test_that_is_wrong" in done.stdout
    assert "test_busy.py::test_that_goes_by_no_clock" in done.stdout
    assert done.stdout.count("SKIPPED [1] test_busy.py") == 2
