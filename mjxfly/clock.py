"""The clock of a flight: the computer's own, or a slower one that runner, watchdog and twin of a rehearsal share.

Every time and every duration of the flight's logic is of this clock [s]. What only cflib waits for is in real time.
"""

from __future__ import annotations

import time

SLOWEST = 100.0  # the factor at most


class _Pace:
    factor = 1.0  # times slower than real time


def slow_down(factor: float) -> None:
    """Have a second of this process's clock take `factor` seconds; before anything asks for the time."""
    _Pace.factor = factor


def factor() -> float:
    """How many times slower than real time this clock is."""
    return _Pace.factor


def now() -> float:
    """Monotonic time [s], the same in all processes of this factor."""
    return time.monotonic() / _Pace.factor


def real(seconds: float) -> float:
    """What `seconds` of this clock take in real time [s], for whatever waits."""
    return seconds * _Pace.factor


def sleep(seconds: float) -> None:
    """Wait `seconds` of this clock."""
    time.sleep(real(seconds))


def too_slow(why: str) -> str:
    """The sentence that ends a rehearsal which this computer cannot fly, because of `why`."""
    kept = "in real time" if _Pace.factor == 1 else f"even {_Pace.factor:g} times slower than real time"
    slower = f"use --rehearse --slow {2 * _Pace.factor:g}, or " if 2 * _Pace.factor <= SLOWEST else ""
    return f"this computer is too slow for a rehearsal {kept}: {why}; {slower}end other programs"
