"""CPU time and group of a process, from the operating system: Linux and macOS."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

LINUX = sys.platform == "linux"
CALLS = 1 if LINUX else 20  # of a follower between two readings, because `ps` counts hundredths of a second
PS = "/bin/ps"


def cpu_time(pid: int) -> float:
    """CPU time, user and system, of all threads of process `pid` [s]; 0 if it has ended.

    On Linux with that of the processes which it has started and waited for.
    """
    fields = _stat(Path(f"/proc/{pid}/stat")) if LINUX else None
    return own_time(pid) + (0.0 if fields is None else sum(map(int, fields[13:15])) / os.sysconf("SC_CLK_TCK"))


def own_time(pid: int) -> float:
    """`cpu_time` without that of other processes, which on Linux takes a tenth of the time to read."""
    if not LINUX:
        found = _ps("-p", str(pid), "-o", "cputime=")
        return seconds(found[0]) if found else 0.0
    try:
        return time.clock_gettime((~pid << 3) | 2)  # the clock that clock_getcpuclockid(3) returns
    except OSError:
        return 0.0


def others_of_group(pid: int) -> list[int]:
    """Processes other than `pid` of the process group that `pid` leads, without those that have ended."""
    if LINUX:
        found = ((int(path.parent.name), _stat(path)) for path in Path("/proc").glob("[0-9]*/stat"))
        rows = [(one, fields[0], int(fields[2])) for one, fields in found if fields is not None]
    else:
        rows = [(int(one), state, int(group)) for one, state, group in map(str.split, _ps("-Ao", "pid=,state=,pgid="))]
    return [one for one, state, group in rows if group == pid and one != pid and not state.startswith("Z")]


def _stat(path: Path) -> list[str] | None:
    """Fields of a /proc/PID/stat behind the name: state, parent, group, ...; None if the process has ended."""
    try:
        return path.read_text("utf-8", "replace").rpartition(")")[2].split()
    except OSError:
        return None


def _ps(*arguments: str) -> list[str]:
    done = subprocess.run([PS, *arguments], capture_output=True, text=True, check=False)
    return [line.strip() for line in done.stdout.splitlines() if line.strip()]


def seconds(text: str) -> float:
    """Seconds of a time as `ps` writes it: [[days-]hours:]minutes:seconds."""
    days, _, rest = text.rpartition("-")
    total = 0.0
    for part in rest.split(":"):
        total = 60 * total + float(part)
    return total + 86_400 * int(days or 0)
