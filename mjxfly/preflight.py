"""Preflight: connect, write gains, reset estimators, check states; and recognise each firmware's force curve.

The curve is recognised while the motors turn slowly; the gains for it are then written.
"""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mjxball.control import motors, rotations
from mjxball.control.crazyflie import PARAMETERS, Gains, PairGains, read_pair_gains
from mjxball.control.motors import Motor
from mjxball.errors import InputError
from mjxball.files import read_text
from mjxball.reading import near, parse_json
from mjxfly import clock, packets, positioning
from mjxfly.app.protocol import CONTROLLER, OUT_OF_TREE, PID
from mjxfly.connection import LinkError
from mjxfly.limits import NAMES, Check, Limits
from mjxfly.link import Link
from mjxfly.mocap import KALMAN, Mocap
from mjxfly.monitor import down_reason, stick_faults
from mjxfly.packets import GRAVITY, THRUST_CEILING, DroneState, Health
from mjxfly.process import together, wait_until
from mjxfly.setpoints import CURVE_NAMES, CurveName, Variant, Variants
from mjxfly.supervisor import Event, Fault
from mjxfly.telemetry import DroneLink, Note, Rig, yaw_of


@dataclass(frozen=True)
class Preflight:
    """Requirements on a pair on the ground."""

    rate: float = 90.0  # states per second of each drone
    measure: float = 1.0  # time over which the rate is measured [s]
    variance: float = 1e-3  # of the estimator's position [m2]
    converge: float = 10.0  # time for the estimators to converge [s]
    tilt: float = math.radians(8)  # [rad]
    yaw: float = math.radians(15)  # from the world's x axis [rad]
    apart: float = math.radians(8)  # between the drones' yaws, which are equal on a stick [rad]
    gravity: float = math.radians(5)  # between the accelerometer's up and the attitude's [rad]
    length: float = 0.03  # of the distance between both from the stick's length [m]
    rearm: float = 4.0  # time for the firmware to settle after a landing [s]
    reset: float = 0.1  # time between the two writes that reset an estimator [s]
    drone: str = "2.1"  # which Crazyflie the policy was trained for, a key of `motors.MOTORS`


def read_gains(path: Path) -> PairGains:
    """Parameters of leader and follower from a JSON file, see `crazyflie.read_pair_gains`. Raises InputError."""
    try:
        data = parse_json(read_text(path, "gain file"))
    except InputError:
        raise
    except (ValueError, RecursionError) as error:
        raise InputError(f"gain file {path} is not JSON: {error}") from None
    try:
        return read_pair_gains(data)
    except ValueError:
        known = (*NAMES, *PARAMETERS)
        other = next((name for name in data if name not in known), "") if isinstance(data, dict) else ""
        raise InputError(
            f'gain file {path} must be JSON of finite numbers, {{"pid_attitude.roll_kp": 6, ...}} for both drones or '
            f'{{"leader": {{...}}, "follower": {{...}}}}{near(other, known, 0.5)}'
        ) from None


def parameters_of(gains: Gains, on_board: bool) -> Gains:
    """Parameters that a flight writes to a drone: gains and the firmware's controller.

    Another program or flight may have changed the controller. An app `on_board` gets the state only if it is its own.
    """
    return {**gains, CONTROLLER: float(OUT_OF_TREE if on_board else PID)}


def prepare(
    links: Sequence[Link],
    variants: Sequence[Variants],
    required: Preflight,
    say: Callable[[str], None],
    mocap: Mocap | None = None,
    check_app: Callable[[int, Link], None] | None = None,
) -> list[CurveName]:
    """Open both links in parallel, write gains, start the states, reset the estimators. Raises InputError.

    Returns the force curves expected by the firmwares' versions, whose gains were written. With `mocap`, poses are
    forwarded to each drone before its estimator is reset. `check_app` checks the app of a flight on board.
    """
    curves: dict[str, CurveName] = {}

    def one(link: Link, own: Variants) -> None:
        link.open(say)
        check_kind(link, required, mocap is not None)
        if check_app is not None:
            check_app(links.index(link), link)
        curves[link.name] = promised_curve(link, own)
        link.write_parameters(parameters_of(own[curves[link.name]].gains, check_app is not None))
        if mocap is not None:
            link.write_parameters(mocap.parameters())
            mocap.feed(links.index(link), link)
        link.start_states()
        if mocap is None:
            positioning.wait(link, required.converge)
        reset_estimator(link, required)

    together([functools.partial(one, *each) for each in zip(links, variants, strict=True)])
    return [curves[link.name] for link in links]


def promised_curve(link: Link, own: Variants) -> CurveName:
    """Expected force curve of the drone's firmware, by its version. Raises LinkError if there are no gains for it."""
    known, first = curve_of_version(link.identity.version), next(iter(own))
    if known is None or known in own:
        return known or first
    raise LinkError(
        f"the firmware {link.identity.version} of the {link.name} has the {known} force curve, "
        f"and this flight has gains for the {first} one only: {CURVE_REMEDY}"
    )


def check_kind(link: Link, required: Preflight, measured: bool = False) -> None:
    """Raise LinkError if the drone is not of the kind that the policy was trained for, or has no position.

    If its position is `measured` by motion capture, only the kind is checked.
    """
    device, brushless = link.identity.device, "brushless" in link.identity.device.lower()
    if device.startswith("Crazyflie 2") and brushless != (required.drone == "brushless"):
        trained = f"the policy was trained for the {required.drone}: fly one that was trained for it"
        raise LinkError(f"the {link.name} is a {device}, and {trained}")
    if not measured and link.parameters.read(["stabilizer.estimator"])["stabilizer.estimator"] != KALMAN:
        system = positioning.found(link)
        why = "it has found no positioning deck: fit one, or forward poses with --mocap"
        if system is not positioning.UNKNOWN:
            why = f"its {system.name} deck needs it: write that parameter with cfclient and keep it"
        raise LinkError(
            f"the estimator of the {link.name} is not the Kalman filter (stabilizer.estimator is not {KALMAN}): {why}"
        )


def reset_estimator(link: Link, required: Preflight) -> None:
    """Reset the Kalman filter and wait until its position has converged. Raises LinkError."""
    link.write_parameters({"kalman.resetEstimation": 1.0}, check=False)  # the firmware clears it by itself
    clock.sleep(required.reset)
    link.write_parameters({"kalman.resetEstimation": 0.0}, check=False)
    started, good, checked, found = clock.now(), 0, 0.0, math.inf
    while good < 5:
        if clock.now() - started > required.converge:
            raise LinkError(
                f"the estimator of the {link.name} has not converged after {required.converge:g} s: "
                f"position variance {found:.2g} m2, {required.variance:g} needed; does it get its position?"
            )
        clock.sleep(0.01)
        sample = link.telemetry.health
        if sample is None or sample.arrival <= max(checked, started):
            continue
        checked, found = sample.arrival, max(sample.health.variance)
        # A filter that does not run reports 0.
        good = good + 1 if min(sample.health.variance) > 0 and found < required.variance else 0


def _can_start(info: int) -> bool:
    return bool(info & (packets.CAN_ARM | packets.CAN_FLY)) and not info & packets.FLYING


def _wait_until_ready(links: Sequence[Link], seconds: float) -> None:
    """Wait while a firmware still counts as flying, or disarms and arms again, as it does 3 s after a landing."""

    def settled() -> bool:
        infos = [link.telemetry.newest.state.info for link in links if link.telemetry.newest is not None]
        return all(_can_start(info) or down_reason(info, armed=False) for info in infos)

    wait_until(settled, seconds)


def check(links: Sequence[Link], rig: Rig, bounds: Limits, required: Preflight) -> list[Check]:
    """All preflight checks; takes `required.measure` seconds, more if a firmware arms again after a landing."""
    _wait_until_ready(links, required.rearm)
    began = clock.now()
    before = [link.telemetry.received for link in links]
    clock.sleep(required.measure)
    _wait_until_ready(links, required.rearm)
    checks, now = [], clock.now()
    states = []
    for link, count in zip(links, before, strict=True):
        sample, rate = link.telemetry.newest, (link.telemetry.received - count) / max(now - began, 1e-3)
        assert sample is not None
        state, age = sample.state, link.telemetry.age(now)
        states.append(state)
        refusal = down_reason(state.info, armed=False)
        can = _can_start(state.info)
        tilt, yaw = rotations.tilt_of_quaternion(state.quaternion), yaw_of(state)
        fresh, alive = rate >= required.rate, refusal or ("can fly" if can else "cannot arm")
        rows: tuple[tuple[str, bool, str, str], ...] = (
            ("states", fresh, f"{rate:.0f} Hz, {required.rate:.0f} needed", BUSY),
            ("state age", age <= bounds.state_age, f"{1000 * age:.0f} ms", BUSY),
            ("battery", state.battery > bounds.battery, f"{state.battery:.2f} V", "charge it"),
            ("firmware", can and not refusal, alive, "switch it off and on again, upright and at rest"),
            ("level", tilt <= required.tilt, f"{math.degrees(tilt):.1f} degrees", "put the pair on level ground"),
            ("heading", abs(yaw) <= required.yaw, f"{math.degrees(yaw):z.0f} degrees from +x", TURNED),
        )
        checks += [Check.judged(f"{link.name} {name}", good, text, remedy) for name, good, text, remedy in rows]
        checks += gravity_checks(link, state, required)
    return [*checks, heading_check(states, required), stick_check(states, rig, bounds, required)]


CURVE_REMEDY = "leave --curve out, or take other firmware or another policy"
BUSY = "take a free radio channel, come closer, end other programs"
TURNED = "turn it, or its body in the cameras' program, to look along +x"
YAW_COST = 6  # [mm] of hover error for each degree between both yaws: 29 mm for 5 on the real firmware


def heading_check(states: Sequence[DroneState], required: Preflight) -> Check:
    """Whether both drones on one stick measure the same yaw; a difference is due to their frames or mounting."""
    beside = math.degrees(math.remainder(yaw_of(states[0]) - yaw_of(states[1]), 2 * math.pi))
    text = f"leader {beside:+z.1f} degrees from the follower; each one costs {YAW_COST:g} mm of hover error"
    remedy = "turn both alike on the stick, or their bodies in the cameras' program"
    return Check.judged("headings", abs(beside) <= math.degrees(required.apart), text, remedy)


def gravity_checks(link: Link, state: DroneState, required: Preflight) -> list[Check]:
    """Whether a standing drone's accelerometer agrees with its attitude; no check without accelerometer data."""
    sample = link.telemetry.sensed
    if sample is None:
        return []
    force = np.array(sample.sensed.force)
    size = float(np.linalg.norm(force))
    up = float((rotations.matrix_from_quaternion(state.quaternion) @ force)[2])
    off = math.acos(min(max(up / max(size, 1e-9), -1.0), 1.0))
    good = off <= required.gravity and abs(size - GRAVITY) <= 0.1 * GRAVITY
    text = f"{size / GRAVITY:.2f} g, {math.degrees(off):.1f} degrees from the attitude's"
    remedy = "keep it at rest; else switch it off and on again on level ground"
    return [Check.judged(f"{link.name} gravity", good, text, remedy)]


NOISY = 4.0  # standard deviations of the positions that the check allows


def stick_check(states: Sequence[DroneState], rig: Rig, bounds: Limits, required: Preflight) -> Check:
    """Whether the drones' relative position and distance agree with the stick."""
    faults = stick_faults(states, rig.span, bounds)
    line = states[0].position - states[1].position
    beside = float(np.linalg.norm(line - rig.span))
    length, known = float(np.linalg.norm(line)), float(np.linalg.norm(rig.span))
    text = f"{length:.3f} m long, {known:.3f} m needed; {beside:.3f} m from where it should be"
    placed = (
        not faults and beside <= bounds.stick_error and abs(length - known) <= required.length + NOISY * bounds.noise
    )
    remedy = "are the URIs exchanged, is it the policy's stick, and have both drones one origin?"
    return Check.judged("stick", placed, faults[0].detail if faults else text, remedy)


COMPENSATES_SINCE = (2025, 12)  # first version of the released firmware with battery compensation
MAX_LOG_RATIO = 0.12  # largest |ln(PWM / expected PWM)|: half the difference between the two curves at a full battery
AGREEING = 3  # consecutive health packets that must agree
RESERVE = 0.97  # of the largest thrust command, above which a pair has no reserve to hover


def curve_of_version(version: str) -> CurveName | None:
    """Force curve of released firmware of this `version`, such as 2026.08; None if the version has another form."""
    found = re.match(r"(20\d\d)\.(\d\d)", version)
    if found is None:
        return None
    return "linear" if (int(found[1]), int(found[2])) >= COMPENSATES_SINCE else "older"


def recognise(seen: Health, battery: float, motor: Motor) -> CurveName | None:
    """The force curve that maps the reported thrust to the PWM `seen`; None if neither does. `battery` in V.

    The mean PWM of the four motors is used, in which roll, pitch and yaw commands cancel.
    """
    pwm, thrust = float(np.mean(seen.motors)), seen.thrust
    if not (pwm > 0 and thrust > 0 and battery > 0):
        return None
    compensated = float(motors.compensated(motor, np.float64(thrust), np.float64(battery)))
    expected = {"linear": compensated, "older": thrust}
    off = {name: abs(math.log(pwm / value)) if value > 0 else math.inf for name, value in expected.items()}
    best = min(CURVE_NAMES, key=lambda name: off[name])
    return best if off[best] < MAX_LOG_RATIO else None


class SpinCheck:
    """Recognises the force curves of both drones' firmwares. `update` once a tick in FlightState.SPIN."""

    def __init__(
        self, links: Sequence[DroneLink], variants: Sequence[Variants], assumed: Sequence[CurveName], motor: Motor
    ):
        self._links, self._variants, self._motor = links, variants, motor
        self.curves: list[CurveName] = list(assumed)
        self._seen: list[list[CurveName | None]] = [[], []]
        self._last = [0.0, 0.0]
        self._decided = [False, False]
        self._failures: list[str] = []

    def chosen(self) -> tuple[Variant, Variant]:
        """Command map and gains of leader and follower, by the curves known so far."""
        leader, follower = (own[curve] for own, curve in zip(self._variants, self.curves, strict=True))
        return leader, follower

    def update(self, since: float, now: float, note: Note) -> list[Fault]:
        """Check health packets after `since` [s], when the motors had settled; return events once both are known."""
        for number in range(2):
            if not self._decided[number]:
                self._check_health(number, since, now, note)
        failed = [link.busy for link in self._links if isinstance(link.busy, str)]
        if failed or self._failures:
            return [Fault(Event.CURVE_UNKNOWN, text) for text in (*failed, *self._failures)]
        if not all(self._decided):
            return []
        heavy = []
        for name, curve, variant in zip(NAMES, self.curves, self.chosen(), strict=True):
            if variant.map.hover_thrust > RESERVE * THRUST_CEILING:
                units = f"{variant.map.hover_thrust:.0f} of {THRUST_CEILING} thrust units on the {curve} force curve"
                text = f"the {name} would hover at {units}: make the rig lighter"
                heavy.append(Fault(Event.CURVE_UNKNOWN, text))
        if heavy or any(link.busy for link in self._links):
            return heavy
        return [Fault(Event.CURVE_KNOWN, ", ".join(self.curves))]

    def _check_health(self, number: int, since: float, now: float, note: Note) -> None:
        telemetry, seen = self._links[number].telemetry, self._seen[number]
        sample, state = telemetry.health, telemetry.newest
        if sample is None or state is None or sample.arrival <= max(since, self._last[number]):
            return
        self._last[number] = sample.arrival
        if not any(sample.health.motors) and len(seen) < 2 * AGREEING:
            seen.append(None)  # not listed by this firmware, or not turning yet
            return
        found = recognise(sample.health, state.state.battery, self._motor)
        seen.append(found)
        if found is not None and seen[-AGREEING:] == [found] * AGREEING:
            self._decide(number, found, now, note, True)
        elif len(seen) >= 4 * AGREEING:  # neither fits: keep the assumed curve
            self._decide(number, self.curves[number], now, note, False)

    def _decide(self, number: int, curve: CurveName, now: float, note: Note, recognised: bool) -> None:
        self._decided[number] = True
        changed = curve != self.curves[number]
        if curve not in self._variants[number]:
            text = f"the {NAMES[number]} has the {curve} force curve, which this flight has no gains for"
            self._failures.append(f"{text}: {CURVE_REMEDY}")
        elif changed:
            self.curves[number] = curve
            self._links[number].write_later(self._variants[number][curve].gains)
        note("thrust", now, drone=NAMES[number], curve=curve, recognised=recognised, changed=changed)
