"""The clock of a flight: the monotonic clock, or a slowed one that runner, watchdog and twin of a rehearsal share.

All times and durations of the flight logic are on this clock [s]. Timeouts of cflib itself are in real time.
"""

from __future__ import annotations

import time

SLOWEST = 100.0  # largest factor


class _Pace:
    factor = 1.0  # times slower than real time


def slow_down(factor: float) -> None:
    """Make a second of this process's clock last `factor` seconds. Call it before the first `now`."""
    _Pace.factor = factor


def factor() -> float:
    """Ratio of real time to time on this clock, 1 or more."""
    return _Pace.factor


def now() -> float:
    """Monotonic time [s], the same in all processes with the same factor."""
    return time.monotonic() / _Pace.factor


def real(seconds: float) -> float:
    """Real time [s] that `seconds` of this clock take, for calls that wait in real time."""
    return seconds * _Pace.factor


def sleep(seconds: float) -> None:
    """Sleep for `seconds` of this clock."""
    time.sleep(real(seconds))


def too_slow(why: str) -> str:
    """Error sentence of a rehearsal that is too slow on this computer; `why` is the evidence."""
    pace = "in real time" if _Pace.factor == 1 else f"even {_Pace.factor:g} times slower than real time"
    slower = f"use --rehearse --slow {2 * _Pace.factor:g}, or " if 2 * _Pace.factor <= SLOWEST else ""
    return f"this computer is too slow for a rehearsal {pace}: {why}; {slower}end other programs"
