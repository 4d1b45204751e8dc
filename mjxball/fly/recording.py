"""A flight log as arrays, one row per tick, and the same commands flown again by the twin's physics."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjxball import config as configs
from mjxball.config import Config
from mjxball.control import crazyflie
from mjxball.control.firmware_gains import PairGains, read_pair_gains
from mjxball.errors import InputError
from mjxball.fly import packets
from mjxball.fly.card import command_maps
from mjxball.fly.journal import read
from mjxball.fly.limits import NAMES
from mjxball.fly.packets import DroneState
from mjxball.fly.pair import Rig, object_state
from mjxball.fly.twin.body import PairState
from mjxball.fly.twin.pairs import pair_of

STAMP = 4  # bytes of block and time stamp before a state
LONGEST = 3600.0  # [s] of a flight that is read
LONGEST_GAP = 5.0  # [s] between two ticks


@dataclass(frozen=True)
class Recording:
    """One flight from where its motors first turn; arrays of T rows, SI units."""

    policy: str
    config: Config
    gains: PairGains  # that were uploaded
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


def read_recording(path: Path) -> Recording:
    """The flight in the log `path`. Raises InputError with one sentence if there is none."""
    try:
        return _arrange(path, list(read(path)))
    except OSError as error:
        raise InputError(f"flight log {path} cannot be read: {error.strerror or error}") from None
    except InputError:
        raise
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError) as error:
        raise InputError(f"{path} is not a flight log that this version reads ({type(error).__name__})") from None


def _arrange(path: Path, records: Sequence[Mapping[str, Any]]) -> Recording:
    if not records or records[0]["kind"] != "header" or "config" not in records[0]:
        raise InputError(f"{path} is not a flight log of this version: it does not begin with a header and its config")
    header = records[0]
    config = configs.validate(configs.from_record(header["config"]))
    rig = Rig(config.plant.leader_mount, config.plant.follower_mount)
    rows: list[dict[str, Any]] = []
    newest: list[DroneState | None] = [None, None]
    for record in sorted(records[1:], key=lambda one: float(one["t"])):
        if record["kind"] == "state":
            newest[NAMES.index(record["drone"])] = packets.unpack_state(bytes.fromhex(record["raw"])[STAMP:])
        seen = [state for state in newest if state is not None]
        if record["kind"] != "tick" or len(seen) < 2:
            continue
        if rows or max(setpoint[3] for setpoint in record["sent"]) > 0:
            rows.append({**record, "seen": object_state(seen, rig)})
    if len(rows) < 2:
        raise InputError(f"flight log {path} holds no flight: no motor was ever told to turn")
    return _recording(path, header, config, rows)


def _recording(path: Path, header: Mapping[str, Any], config: Config, rows: Sequence[Mapping[str, Any]]) -> Recording:
    nothing = {"leader": [np.nan] * 3, "follower": [np.nan] * 3, "observation": [np.nan] * 18}

    def column(name: str, *shape: int) -> np.ndarray:
        return np.array([row.get(name, nothing.get(name)) for row in rows], float).reshape(len(rows), *shape)

    time, sent = column("t") - float(rows[0]["t"]), column("sent", 2, 4)
    steps = np.diff(time)
    if not (np.isfinite(sent).all() and np.isfinite(time).all() and time[-1] <= LONGEST):
        raise InputError(f"flight log {path} holds a time or a setpoint that is not sound")
    if not ((steps > 0) & (steps < LONGEST_GAP)).all():
        raise InputError(f"flight log {path}: its ticks do not follow each other")
    seen = [row["seen"] for row in rows]
    position, velocity, quaternion, rates = (np.array(part, float) for part in zip(*seen, strict=True))
    force = np.array(
        [[m.curve.force(s[3]) / 4 for m, s in zip(command_maps(config), row, strict=True)] for row in sent]
    )
    return Recording(
        policy=str(header["policy"])[:80],
        config=config,
        gains=read_pair_gains(header["gains"]),
        time=time,
        phase=tuple(str(row["state"]) for row in rows),
        sent=sent,
        goal=column("goal", 3),
        position=position,
        velocity=velocity,
        quaternion=quaternion,
        rates=rates,
        leader=column("leader", 3),
        follower=column("follower", 3),
        observation=column("observation", 18),
        rotor_force=np.repeat(force[..., None], 4, axis=-1),
        cg_offset=np.full(len(rows), np.nan),
    )


def fly_again(recording: Recording) -> Recording:
    """The recorded setpoints through the twin's physics, from rest where the recorded flight began.

    Nobody steers: what both disagree on adds up with time. The object's mass and the CG's motion, which no log knows,
    are those of a rehearsal (`twin.coupled.Conditions.of`).
    """
    pair = pair_of(recording.config)
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
