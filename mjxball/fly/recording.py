"""A flight log as arrays, one row per tick, and the same commands flown again by the twin's physics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjxball.config import Config
from mjxball.control import crazyflie
from mjxball.control.firmware_gains import PairGains
from mjxball.errors import InputError
from mjxball.fly import flight_log
from mjxball.fly.card import drone_of
from mjxball.fly.command import CurveName
from mjxball.fly.flight_log import FlightLog
from mjxball.fly.flown import force_curve, one_curve
from mjxball.fly.limits import NAMES
from mjxball.fly.packets import DroneState
from mjxball.fly.telemetry import ObjectState, Rig, object_state
from mjxball.fly.twin.conditions import DroneKind, Surroundings, drone_kind
from mjxball.fly.twin.physics import PairState, pair_of

LONGEST = 3600.0  # [s] of a flight that is read
OBSERVATION = 18  # numbers of an observation, where the log holds none


@dataclass(frozen=True)
class Recording:
    """One flight from where its motors first turn; arrays of T rows, SI units."""

    policy: str
    config: Config
    curves: tuple[CurveName, CurveName]  # of leader's and follower's firmware
    gains: PairGains  # that they flew with
    time: np.ndarray  # (T,) from 0 [s]
    phase: tuple[str, ...]  # (T,) the supervisor's state
    sent: np.ndarray  # (T, 2, 4) leader, follower: roll, pitch [deg], yaw rate [deg/s], thrust, wire's signs
    goal: np.ndarray  # (T, 3) of O [m]
    position: np.ndarray  # (T, 3) of O [m]
    velocity: np.ndarray  # (T, 3) [m/s]
    quaternion: np.ndarray  # (T, 4) body -> world (w, x, y, z), the follower's
    rates: np.ndarray  # (T, 3) [rad/s]
    leader: np.ndarray  # (T, 3) command: roll, pitch [rad], vertical acceleration [m/s2]; NaN: no law in command
    follower: np.ndarray  # (T, 3) likewise
    observation: np.ndarray  # (T, 18) NaN where no law was in command
    rotor_force: np.ndarray  # (T, 2, 4) [N]; of a log: what the thrust that was sent gives, without lag and cascade
    cg_offset: np.ndarray  # (T,) [m]; NaN where nobody measured it
    remarks: tuple[str, ...] = ()  # what a reader of the log should know, a line each


def read_recording(path: Path) -> Recording:
    """The flight in the log `path`. Raises InputError with one sentence if there is none."""
    log = flight_log.load(path)
    plant = log.config.plant
    rig = Rig(plant.leader_mount, plant.follower_mount)
    ticks: list[Mapping[str, Any]] = []
    seen: list[ObjectState] = []
    newest: dict[str, DroneState] = {}
    for record in log.records:
        if record["kind"] == "state":
            newest[record["drone"]] = record["raw"].state
        elif len(newest) == len(NAMES):
            ticks.append(record)
            seen.append(object_state([newest[name] for name in NAMES], rig))
    time = np.array([tick["t"] for tick in ticks])
    if len(time) < 2 or not (np.diff(time) > 0).all() or time[-1] - time[0] > LONGEST:
        raise InputError(f"flight log {path} holds no flight: fewer than two ticks, or their times do not follow")
    return _recording(log, ticks, seen)


def _recording(log: FlightLog, ticks: Sequence[Mapping[str, Any]], seen: Sequence[ObjectState]) -> Recording:
    def column(name: str, width: int) -> np.ndarray:
        return np.array([tick.get(name, np.full(width, np.nan)) for tick in ticks])

    position, velocity, quaternion, rates = (np.array(part) for part in zip(*seen, strict=True))
    curves = [force_curve(log.config, name) for name in log.curves]
    force = np.array([[c.force(s[3]) / 4 for c, s in zip(curves, tick["sent"], strict=True)] for tick in ticks])
    lengths = {len(tick["observation"]) for tick in ticks if "observation" in tick} or {OBSERVATION}
    if len(lengths) > 1:
        raise InputError(f"flight log {log.path} holds observations of several lengths")
    return Recording(
        policy=log.policy,
        config=log.config,
        curves=log.curves,
        gains=log.gains,
        time=np.array([tick["t"] for tick in ticks]) - ticks[0]["t"],
        phase=tuple(tick["state"] for tick in ticks),
        sent=column("sent", 8),
        goal=column("goal", 3),
        position=position,
        velocity=velocity,
        quaternion=quaternion,
        rates=rates,
        leader=column("leader", 3),
        follower=column("follower", 3),
        observation=column("observation", lengths.pop()),
        rotor_force=np.repeat(force[..., None], 4, axis=-1),
        cg_offset=np.full(len(ticks), np.nan),
        remarks=tuple(log.told()),
    )


def twin_of(recording: Recording) -> DroneKind:
    """The twin's drones whose firmware has the force curve that flew. Raises InputError if both had different ones."""
    curve = one_curve(recording.curves)
    if curve is None:
        told = ", ".join(f"{name} {own}" for name, own in zip(NAMES, recording.curves, strict=True))
        raise InputError(f"the flight was flown on two force curves ({told}), and the twin's drones have one")
    return drone_kind(drone_of(recording.config), curve)


def fly_again(recording: Recording, kind: DroneKind | None = None) -> Recording:
    """The recorded setpoints through the physics of drones of `kind`, from rest where the recorded flight began.

    Without a `kind` they are those that the log tells of (`twin_of`). Nobody steers: what both disagree on adds up
    with time. The object's mass and the CG's motion, which no log knows, are those of a rehearsal
    (`twin.coupled.Conditions.of`).
    """
    pair = pair_of(recording.config, kind or twin_of(recording), Surroundings(exact=True))
    for drone, gains in enumerate(recording.gains):
        for name, value in gains.items():
            pair.set_parameter(drone, name, value)
    rig = Rig(recording.config.plant.leader_mount, recording.config.plant.follower_mount)
    state, seen, forces, offsets = pair.start(), [], [], []
    for time, sent in zip(recording.time, recording.sent, strict=True):
        seen.append(object_state(_drones(state), rig))
        forces.append(getattr(pair, "rotor_force", np.zeros((2, 4))))
        offsets.append(getattr(pair, "cg_offset", np.nan))
        step = recording.time[len(seen)] - time if len(seen) < len(recording.time) else 0.0
        sound = np.where(sent[:, 3:] >= crazyflie.IDLE, sent, 0.0)
        state = pair.advance(sound, step)
    position, velocity, quaternion, rates = (np.array(part, float) for part in zip(*seen, strict=True))
    changed = {
        "position": position - position[0] + recording.position[0],
        "velocity": velocity,
        "quaternion": quaternion,
        "rates": rates,
        "rotor_force": np.array(forces),
        "cg_offset": np.array(offsets, float),
    }
    return Recording(**{**vars(recording), **changed})


def _drones(state: PairState) -> list[DroneState]:
    """Both drones' states as perfect estimators would report them."""
    return [
        DroneState(
            state.position[n], state.velocity[n], state.quaternion[n], state.rates[n], 0, float(state.battery[n])
        )
        for n in range(2)
    ]
