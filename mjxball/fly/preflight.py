"""Before the motors may turn: connect, gains, estimators, states, and a list of checks with its numbers."""

from __future__ import annotations

import functools
import json
import math
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mjxball.control.firmware_gains import Gains, PairGains, read_pair_gains
from mjxball.errors import InputError
from mjxball.fly import limits, packets, pair
from mjxball.fly.limits import Limits
from mjxball.fly.link import Link, LinkError

VARIANCES = ("kalman.varPX", "kalman.varPY", "kalman.varPZ")


@dataclass(frozen=True)
class Preflight:
    """What is asked of a pair on the ground."""

    rate: float = 90.0  # states per second of each drone
    measure: float = 1.0  # time over which the rate is measured [s]
    variance: float = 1e-3  # of the estimator's position [m2]
    converge: float = 10.0  # time the estimators get [s]
    tilt: float = math.radians(8)  # [rad]
    yaw: float = math.radians(15)  # from the world's x axis [rad]


class Check(NamedTuple):
    """One check and how it went."""

    name: str
    passed: bool
    found: str


def read_gains(path: Path) -> PairGains:
    """Parameters of leader and follower from a JSON file, see `firmware_gains.read_pair_gains`. Raises InputError."""
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"gain file {path} cannot be read: {error.strerror or error}") from None
    except ValueError:
        raise InputError(f"gain file {path} is not JSON") from None
    try:
        return read_pair_gains(data)
    except ValueError:
        raise InputError(
            f"gain file {path} must be one JSON object of parameter names with finite numbers, or two of them, named "
            "leader and follower"
        ) from None


def together(actions: Sequence[Callable[[], None]]) -> None:
    """Run all `actions` at once; raise the first one's error after all have ended."""
    errors: list[Exception] = []

    def guarded(action: Callable[[], None]) -> None:
        try:
            action()
        except Exception as error:  # carried over to the caller's thread
            errors.append(error)

    threads = [threading.Thread(target=guarded, args=(action,), daemon=True) for action in actions]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    if errors:
        raise errors[0]


def prepare(links: Sequence[Link], gains: PairGains, asked: Preflight) -> None:
    """Open both links, write each drone's gains, reset the estimators, start the states. Raises LinkError."""

    def one(link: Link, own: Gains) -> None:
        link.open()
        link.write_parameters(own)
        reset_estimator(link, asked)
        link.start_states()

    together([functools.partial(one, *each) for each in zip(links, gains, strict=True)])


def reset_estimator(link: Link, asked: Preflight) -> None:
    """Reset the Kalman filter and wait until its position has converged. Raises LinkError."""
    link.write_parameters({"kalman.resetEstimation": 1.0})
    link.write_parameters({"kalman.resetEstimation": 0.0})
    found: list[float] = [math.inf]
    good = threading.Event()
    below = [0]

    def take(values: dict[str, float]) -> None:
        found[0] = max(values[name] for name in VARIANCES)
        below[0] = below[0] + 1 if found[0] < asked.variance else 0
        if below[0] >= 5:
            good.set()

    block = link.stream(VARIANCES, 50, take)
    converged = good.wait(asked.converge)
    link.stop_stream(block)
    if not converged:
        raise LinkError(
            f"the estimator of the {link.name} has not converged after {asked.converge:g} s: "
            f"position variance {found[0]:.2g} m2, {asked.variance:g} needed"
        )


def check(links: Sequence[Link], rig: pair.Rig, bounds: Limits, asked: Preflight) -> list[Check]:
    """All checks, with what was found; takes `asked.measure` seconds."""
    before = [link.telemetry.received for link in links]
    time.sleep(asked.measure)
    checks, now = [], time.monotonic()
    states = []
    for link, count in zip(links, before, strict=True):
        sample, rate = link.telemetry.newest, (link.telemetry.received - count) / asked.measure
        assert sample is not None
        state, age = sample.state, link.telemetry.age(now)
        states.append(state)
        refusal = limits.down_reason(state.info, armed=False)
        can = bool(state.info & (packets.CAN_ARM | packets.CAN_FLY))
        tilt, yaw = limits.tilt_of(state), pair.yaw_of(state)
        checks += [
            Check(f"{link.name} states", rate >= asked.rate, f"{rate:.0f} Hz, {asked.rate:.0f} needed"),
            Check(f"{link.name} state age", age <= bounds.state_age, f"{1000 * age:.0f} ms"),
            Check(f"{link.name} battery", state.battery > bounds.battery, f"{state.battery:.2f} V"),
            Check(f"{link.name} firmware", can and not refusal, refusal or ("can fly" if can else "cannot arm")),
            Check(f"{link.name} level", tilt <= asked.tilt, f"{math.degrees(tilt):.1f} degrees"),
            Check(f"{link.name} heading", abs(yaw) <= asked.yaw, f"{math.degrees(yaw):.0f} degrees from +x"),
        ]
    faults = limits.stick_faults(states, rig.span, bounds)
    line = states[0].position - states[1].position
    beside = float(np.linalg.norm(line - rig.span))
    text = faults[0].detail if faults else f"{np.linalg.norm(line):.3f} m long, {beside:.3f} m from where it should be"
    placed = not faults and beside <= bounds.stick_error
    return [*checks, Check("stick", placed, text)]
