"""Whether the batteries carry the pair for as long as a landing takes, by the largest thrust at their voltage. Pure.

The low battery of `Limits` is a matter of seconds; a cell that gives way takes the lift within less than one.
"""

from __future__ import annotations

import collections
import statistics
from collections.abc import Sequence

import numpy as np

from mjxball.control import motors, rotations
from mjxball.control.motors import Motor
from mjxfly.limits import NAMES
from mjxfly.setpoints import CommandMap
from mjxfly.supervisor import Event, Fault
from mjxfly.telemetry import ObjectState, Rig

RESERVE = 0.15  # [V] of a battery in hover above that at which full power just carries: full power takes as much more
SAMPLES = 5  # voltages whose median counts, at one a tick
WINDOW = 0.5  # [s] over which a voltage falls, or does not
SCARCE = 1.05  # of its weight, below which a drone is given all that it can lift
ALL = 1.2  # share of hover that is asked of it then
LEVELLING = (2.5, 1.0)  # shares of hover by which an end of the stick is let down, per m and per m/s that it is up
CLIMBS = 0.25  # [m/s] upward that a pair without lift cannot reach
SETTLE = 0.5  # [s] that a landing takes beyond its way down


class LiftWatch:
    """One for both drones. `update` once a tick in the air."""

    def __init__(self, motor: Motor):
        self._motor = motor
        self._raw = [collections.deque[float](maxlen=SAMPLES) for _ in NAMES]
        self._seen: list[collections.deque[tuple[float, float]]] = [collections.deque() for _ in NAMES]
        self.shares = [np.inf, np.inf]  # of what it carries, the most that each drone can lift
        self._disproved = False  # whether a pair without lift was seen to climb

    @property
    def share(self) -> float:
        """That of the weaker one."""
        return min(self.shares)

    def update(
        self, voltages: Sequence[float], maps: Sequence[CommandMap], height: float, speed: float, now: float
    ) -> list[Fault]:
        """What is wrong at `now` [s]: batteries of `voltages` [V] lose lift before a descent from `height` [m] ends.

        `speed` [m/s] is that of the descent.
        """
        shares, faults, needed = [], [], max(height, 0.0) / speed + SETTLE
        for name, raw, seen, volts, own in zip(NAMES, self._raw, self._seen, voltages, maps, strict=True):
            raw.append(volts)
            level, weight = statistics.median(raw), own.carried_mass * own.gravity
            shares.append(4 * float(motors.force(self._motor, np.float64(motors.FULL), np.float64(level))) / weight)
            seen.append((now, level))
            while len(seen) > 2 and seen[1][0] <= now - WINDOW:
                seen.popleft()
            if len(raw) < SAMPLES:
                continue
            margin = level - float(motors.voltage(self._motor, np.float64(weight / 4))) - RESERVE
            began, before = seen[0]
            falls = (before - level) / WINDOW if now - began >= WINDOW else 0.0
            if margin < max(falls, 0.0) * needed:
                lifts = f"full power lifts {shares[-1]:.2f} times its share of the weight"
                faults.append(Fault(Event.LIFT, f"{name} at {level:.2f} V, falling by {falls:.1f} V/s: {lifts}"))
        self.shares = shares
        return faults

    def shared(self, wanted: float, seen: ObjectState | None, rig: Rig) -> list[float]:
        """Shares of hover for leader and follower in a descent that wants `wanted`, the same of both.

        Where lift is scarce a drone that lacks it gives all it has, since to sink at leisure would cost speed. One that
        does not lack it lifts no more than the other, or the stick turns over. What a weak drone gives lags, and is
        spent on its attitude too, so the end of the stick that is `seen` to rise is let down. A pair that is `seen` to
        climb has lift enough, whatever its voltage reads, for the rest of the flight.
        """
        self._disproved = self._disproved or (seen is not None and float(seen.velocity[2]) > CLIMBS)
        if self.share > SCARCE or self._disproved:
            return [wanted, wanted]
        up, rising = 0.0, 0.0  # the leader above the follower [m], and how fast [m/s]
        if seen is not None:
            up = float(seen.matrix[2] @ rig.span)
            rising = float(seen.matrix[2] @ rotations.cross(seen.rates, rig.span))
        excess = LEVELLING[0] * up + LEVELLING[1] * rising
        most = [ALL if share < SCARCE else self.share for share in self.shares]
        return [most[0] - max(excess, 0.0), most[1] - max(-excess, 0.0)]
