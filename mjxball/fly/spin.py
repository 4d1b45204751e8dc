"""Which force curve each connected firmware has, found while the motors turn slowly; its gains are then written."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import numpy as np

from mjxball.control import motors
from mjxball.control.motors import Motor
from mjxball.fly.command import CURVE_NAMES, CurveName, Variant, Variants
from mjxball.fly.limits import NAMES
from mjxball.fly.packets import THRUST_CEILING, Health
from mjxball.fly.supervisor import Event, Fault
from mjxball.fly.telemetry import DroneLink, Note

COMPENSATES_SINCE = (2025, 12)  # version of the firmware, as delivered
LIKELY = 0.12  # of ln(PWM / expected PWM): half of what lies between the two firmwares at a full battery
WANTED = 3  # health packets in a row that agree
RESERVE = 0.97  # of the largest thrust command, above which a pair has no reserve to hover


def curve_of_version(version: str) -> CurveName | None:
    """What a firmware of this `version`, such as 2026.08, has as delivered; None if it does not say."""
    found = re.match(r"(20\d\d)\.(\d\d)", version)
    if found is None:
        return None
    return "linear" if (int(found[1]), int(found[2])) >= COMPENSATES_SINCE else "older"


def recognise(seen: Health, battery: float, motor: Motor) -> CurveName | None:
    """Which firmware makes the PWM that was `seen` of the thrust that it reports; None if neither does.

    The mean of the four motors counts, in which roll, pitch and yaw cancel. `battery` in V.
    """
    pwm, thrust = float(np.mean(seen.motors)), seen.thrust
    if not (pwm > 0 and thrust > 0 and battery > 0):
        return None
    compensated = float(motors.compensated(motor, np.float64(thrust), np.float64(battery)))
    expected = {"linear": compensated, "older": thrust}
    off = {name: abs(math.log(pwm / value)) if value > 0 else math.inf for name, value in expected.items()}
    best = min(CURVE_NAMES, key=lambda name: off[name])
    return best if off[best] < LIKELY else None


class SpinCheck:
    """Decides for both drones. `update` once a tick in State.SPIN."""

    def __init__(
        self, links: Sequence[DroneLink], variants: Sequence[Variants], assumed: Sequence[CurveName], motor: Motor
    ):
        self._links, self._variants, self._motor = links, variants, motor
        self.curves: list[CurveName] = list(assumed)
        self._seen: list[list[CurveName | None]] = [[], []]
        self._last = [0.0, 0.0]
        self._decided = [False, False]
        self._unfit: list[str] = []

    def chosen(self) -> tuple[Variant, Variant]:
        """How leader and follower are flown, by what is known so far."""
        leader, follower = (own[curve] for own, curve in zip(self._variants, self.curves, strict=True))
        return leader, follower

    def update(self, since: float, now: float, note: Note) -> list[Fault]:
        """Judge what came after `since` [s], when the motors had settled; events once both are known."""
        for number in range(2):
            if not self._decided[number]:
                self._look(number, since, now, note)
        failed = [link.busy for link in self._links if isinstance(link.busy, str)]
        if failed or self._unfit:
            return [Fault(Event.CURVE_UNKNOWN, text) for text in (*failed, *self._unfit)]
        if not all(self._decided):
            return []
        heavy = []
        for name, curve, variant in zip(NAMES, self.curves, self.chosen(), strict=True):
            if variant.map.hover_thrust > RESERVE * THRUST_CEILING:
                units = f"{variant.map.hover_thrust:.0f} of {THRUST_CEILING} thrust units on the {curve} force curve"
                heavy.append(Fault(Event.CURVE_UNKNOWN, f"the {name} would hover at {units}"))
        if heavy or any(link.busy for link in self._links):
            return heavy
        return [Fault(Event.CURVE_KNOWN, ", ".join(self.curves))]

    def _look(self, number: int, since: float, now: float, note: Note) -> None:
        telemetry, seen = self._links[number].telemetry, self._seen[number]
        sample, state = telemetry.health, telemetry.newest
        if sample is None or state is None or sample.arrival <= max(since, self._last[number]):
            return
        self._last[number] = sample.arrival
        if not any(sample.health.motors) and len(seen) < 2 * WANTED:
            seen.append(None)  # not listed by this firmware, or not turning yet
            return
        found = recognise(sample.health, state.state.battery, self._motor)
        seen.append(found)
        if found is not None and seen[-WANTED:] == [found] * WANTED:
            self._decide(number, found, now, note, True)
        elif len(seen) >= 4 * WANTED:  # neither fits: what was assumed stands
            self._decide(number, self.curves[number], now, note, False)

    def _decide(self, number: int, curve: CurveName, now: float, note: Note, recognised: bool) -> None:
        self._decided[number] = True
        changed = curve != self.curves[number]
        if curve not in self._variants[number]:
            self._unfit.append(f"the {NAMES[number]} has the {curve} force curve, which this flight has no gains for")
        elif changed:
            self.curves[number] = curve
            self._links[number].write_later(self._variants[number][curve].gains)
        note("thrust", now, drone=NAMES[number], curve=curve, recognised=recognised, changed=changed)
