"""CPU time and group of a process, from the operating system: Linux and macOS."""

from __future__ import annotations

import subprocess
import sys
import time
from pathlib import Path

LINUX = sys.platform == "linux"
CALLS = 1 if LINUX else 20  # of a follower between two readings, because `ps` counts hundredths of a second
PS = "/bin/ps"


def cpu_time(pid: int) -> float:
    """CPU time, user and system, of all threads of process `pid` [s]; 0 if it has ended."""
    if LINUX:
        try:
            return time.clock_gettime((~pid << 3) | 2)  # the clock that clock_getcpuclockid(3) returns
        except OSError:
            return 0.0
    found = _ps("-p", str(pid), "-o", "cputime=")
    return _seconds(found[0]) if found else 0.0


def others_of_group(pid: int) -> list[int]:
    """Processes other than `pid` of the process group that `pid` leads, without those that have ended."""
    if LINUX:
        rows = [row for stat in Path("/proc").glob("[0-9]*/stat") if (row := _stat(stat))]
    else:
        rows = [(int(one), state, int(group)) for one, state, group in map(str.split, _ps("-Ao", "pid=,state=,pgid="))]
    return [one for one, state, group in rows if group == pid and one != pid and not state.startswith("Z")]


def _stat(path: Path) -> tuple[int, str, int] | None:
    """(process, state, group) of a /proc/PID/stat; None if it has ended."""
    try:
        text = path.read_text("utf-8", "replace")
    except OSError:
        return None
    state, _, group, *_ = text.rpartition(")")[2].split()
    return int(path.parent.name), state, int(group)


def _ps(*arguments: str) -> list[str]:
    done = subprocess.run([PS, *arguments], capture_output=True, text=True, check=False)
    return [line.strip() for line in done.stdout.splitlines() if line.strip()]


def _seconds(text: str) -> float:
    """Seconds of `ps`: [[hours:]minutes:]seconds."""
    total = 0.0
    for part in text.replace("-", ":").split(":"):
        total = 60 * total + float(part)
    return total
