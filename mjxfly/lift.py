"""Whether the batteries can carry the pair until it has landed, by the largest thrust at their voltage. Pure.

The battery limit of `Limits` reacts within seconds; a failing cell loses its lift within less than one.
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

RESERVE = 0.15  # [V] above the voltage at which full power carries the weight; full power lowers it by as much
SAMPLES = 5  # ticks, over which the median voltage is taken
WINDOW = 0.5  # [s] over which the rate of the voltage is measured
SCARCE = 1.05  # lift over weight below which a drone is weak
SPARE = 0.03  # lift over weight that a weak drone keeps to control its attitude, or it gets full thrust
ALL = 1.2  # full thrust in a descent, over hover thrust
LEVELLING = (2.5, 1.0)  # thrust over hover taken from the higher end of the stick, per m and per m/s
BRAKING = 0.25  # the same from the end that lags in a motion along the stick, per m/s
CLIMBS = 0.25  # [m/s] vertical speed that proves that there is lift
SETTLE = 0.5  # [s] of a landing beyond the time of its descent


class LiftWatch:
    """Watches the lift of both drones. `update` once a tick in the air."""

    def __init__(self, motor: Motor):
        self._motor = motor
        self._raw = [collections.deque[float](maxlen=SAMPLES) for _ in NAMES]
        self._seen: list[collections.deque[tuple[float, float]]] = [collections.deque() for _ in NAMES]
        self.shares = [np.inf, np.inf]  # largest lift of each drone over the weight that it carries
        self._disproved = False  # whether a pair said to lack lift has climbed

    @property
    def share(self) -> float:
        """Largest lift over weight of the weaker drone."""
        return min(self.shares)

    def update(
        self, voltages: Sequence[float], maps: Sequence[CommandMap], height: float, speed: float, now: float
    ) -> list[Fault]:
        """Faults at `now` [s] of batteries, `voltages` (2,) [V], that would fail before a descent ends.

        The descent is from `height` [m] at `speed` [m/s].
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
        """Thrust over hover thrust of leader and follower in a descent; `wanted` for both if there is lift enough.

        A drone that cannot lift its share of `wanted` gets full thrust. The other one lifts no more than the weak one,
        or the stick would turn over. The weak drone's thrust lags and also controls its attitude, so the higher end of
        the stick, by the object's state `seen`, gets less. A pair that climbs has lift enough for the rest of the
        flight, whatever the voltage.
        """
        self._disproved = self._disproved or (seen is not None and float(seen.velocity[2]) > CLIMBS)
        if self.share > SCARCE or self._disproved:
            return [wanted, wanted]
        up, rising, along = 0.0, 0.0, 0.0  # the leader above the follower [m], how fast [m/s]; motion toward it [m/s]
        if seen is not None:
            up = float(seen.matrix[2] @ rig.span)
            rising = float(seen.matrix[2] @ rotations.cross(seen.rates, rig.span))
            stick = seen.matrix[:2] @ rig.span
            along = float(seen.velocity[:2] @ stick) / max(float(np.linalg.norm(stick)), 1e-6)
        excess = LEVELLING[0] * up + LEVELLING[1] * rising - BRAKING * along
        weak = min(SCARCE, wanted + SPARE)
        most = [ALL if share < weak else min(wanted, self.share) for share in self.shares]
        return [most[0] - max(excess, 0.0), most[1] - max(-excess, 0.0)]
