"""CPU time of a process as the operating system counts it."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import pytest

from mjxball.bench.cpu import cpu_time, others_of_group, seconds

BUSY = "import time\nwhile time.process_time() < 0.3: pass"


def test_a_process_that_sleeps_takes_none() -> None:
    """Beside what the process counts itself; `ps` counts hundredths of a second."""
    before, own = cpu_time(os.getpid()), time.process_time()
    time.sleep(0.2)
    end = time.process_time() + 0.1
    while time.process_time() < end:
        pass
    assert cpu_time(os.getpid()) - before == pytest.approx(time.process_time() - own, abs=0.025)


@pytest.mark.slow
def test_a_process_counts_those_that_it_has_started() -> None:
    """While they run as members of its group, and on Linux by their time when they have ended."""
    source = f"import subprocess, sys, time; subprocess.run([sys.executable, '-c', {BUSY!r}]); time.sleep(60)"
    with subprocess.Popen([sys.executable, "-c", source], start_new_session=True) as process:
        seen, until = False, time.monotonic() + 30
        while not seen and time.monotonic() < until:
            seen = bool(others_of_group(process.pid))
        while others_of_group(process.pid) and time.monotonic() < until:
            time.sleep(0.05)
        assert seen
        assert sys.platform != "linux" or cpu_time(process.pid) >= 0.3
        process.kill()
    assert cpu_time(process.pid) == 0.0


def test_times_of_ps() -> None:
    assert [seconds(text) for text in ("0:01.25", "02:00:03", "1-00:00:01")] == [1.25, 7203.0, 86401.0]
