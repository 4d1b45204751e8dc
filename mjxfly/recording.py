"""The flight in a log: firmware setup and outages, arrays with a row per tick, and its simulation on the twin."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjxball.config import Config
from mjxball.control import crazyflie, rotations
from mjxball.control.crazyflie import PARAMETERS, Gains, PairGains
from mjxball.errors import InputError
from mjxball.reading import check_times
from mjxball.sim.trajectory import Trajectory
from mjxfly import flight_log, log_consistency
from mjxfly.limits import NAMES, ticks_per_command
from mjxfly.log_consistency import SILENCE
from mjxfly.log_schema import Record
from mjxfly.packets import DroneState
from mjxfly.policy_setup import ThrustOptions, command_maps, drone_of, gains_of, with_curve
from mjxfly.setpoints import CURVE_NAMES, CurveName, ForceCurve
from mjxfly.supervisor import FlightState
from mjxfly.telemetry import ObjectState, Rig, object_state
from mjxfly.twin.conditions import DroneKind, Surroundings, drone_kind
from mjxfly.twin.pair import PairState
from mjxfly.twin.physics import pair_of

FROZEN = 0.25  # [s] of equal states after which an estimator counts as frozen while the controllers are in command
OFF_RATE = 0.2  # relative deviation of the tick period from the policy's that is reported
GUIDED = FlightState.FLY.value  # both controllers are in command
LONGEST = 3600.0  # [s] longest flight that is read
OBSERVATION = 18  # length of an observation if the log has none
SAME = 1e-5  # relative tolerance between equal gains, of which one was sent as a 32-bit float


class FirmwareSetup(NamedTuple):
    """Force curves and gains of leader's and follower's firmware, from a log."""

    curves: tuple[CurveName, CurveName]
    gains: PairGains

    @classmethod
    def of_header(cls, header: Record) -> FirmwareSetup:
        """The setup in a log's `header`; without a curve there, it is that of the policy's configuration."""
        curve = header.get("curve") or own_curve(header["config"])
        return cls((curve, curve), header["gains"])

    def after(self, record: Record, config: Config) -> FirmwareSetup:
        """The setup after one more record of a flight with a policy of `config`.

        If the firmware turns out to have another curve, gains that were the policy's become the policy's for that
        curve; others are kept.
        """
        if record["kind"] not in ("thrust", "parameter"):
            return self
        number = NAMES.index(record["drone"])
        curves, gains = list(self.curves), list(self.gains)
        if record["kind"] == "thrust":
            gains[number] = _for_curve(gains[number], config, number, curves[number], record["curve"])
            curves[number] = record["curve"]
        elif record["name"] in PARAMETERS:
            gains[number] = {**gains[number], record["name"]: record["value"]}
        return FirmwareSetup((curves[0], curves[1]), (gains[0], gains[1]))

    def force_curves(self, config: Config) -> tuple[ForceCurve, ForceCurve]:
        """Force of leader's and follower's motors over the sent thrust."""
        leader, follower = (
            command_maps(with_curve(config, name), ThrustOptions(curve=name))[0].curve for name in self.curves
        )
        return leader, follower


def own_curve(config: Config) -> CurveName:
    """The force curve that `config` was made for."""
    return next(name for name in CURVE_NAMES if with_curve(config, name) is config)


def one_curve(curves: tuple[CurveName, CurveName]) -> CurveName | None:
    """The curve of both drones, None if they have different ones."""
    return curves[0] if curves[0] == curves[1] else None


def _for_curve(gains: Gains, config: Config, number: int, before: CurveName, after: CurveName) -> Gains:
    """`gains` of drone `number`: those equal to the policy's for curve `before` become the policy's for `after`."""
    old, new = (gains_of(with_curve(config, name))[number] for name in (before, after))
    return {
        name: new[name] if name in old and math.isclose(value, old[name], rel_tol=SAME) else value
        for name, value in gains.items()
    }


class Outage(NamedTuple):
    """An interval without states of a drone, or with frozen ones."""

    drone: str
    frozen: bool  # states arrived but did not change; else none arrived
    begin: float  # [s] of the log's clock
    end: float


class FlightLog(NamedTuple):
    """The flight in a log, from when its motors first turn to its last tick."""

    path: Path
    policy: str
    config: Config
    setup: FirmwareSetup  # at the end
    records: tuple[Record, ...]  # ticks and states, sorted by time; the newest states before the flight come first
    outages: tuple[Outage, ...]
    remarks: tuple[str, ...]  # notes on the quality of the data, a line each


def load(path: Path, assumed: Config | None = None) -> FlightLog:
    """The flight in the whole log `path`, of the rig `assumed` if the log names none; see `flight_log.read`.

    Raises InputError if it holds no flight.
    """
    remarks: list[str] = []
    header, *records = flight_log.read(path, remarks.append, assumed)
    settings = header.get("settings")
    if isinstance(settings, dict) and settings.get("dry_run") is True:
        raise InputError(f"flight log {path} holds no flight: it is of a dry run")
    rows = sorted((one for one in records if one["kind"] in ("tick", "state")), key=lambda one: float(one["t"]))
    turning = [one["t"] for one in rows if one["kind"] == "tick" and one["sent"][:, 3].max() > 0]
    if not turning:
        why = f"; {remarks[-1]}" if remarks else ""
        raise InputError(
            f"flight log {path} holds no flight: no setpoint in it turns a motor (apps on board send their own){why}"
        )
    last = max(one["t"] for one in rows if one["kind"] == "tick")
    newest = {one["drone"]: one for one in rows if one["kind"] == "state" and one["t"] < turning[0]}
    before = sorted(newest.values(), key=lambda one: float(one["t"]))
    flown = (*before, *(one for one in rows if turning[0] <= one["t"] <= last))
    for drone in NAMES:
        if not any(one["kind"] == "state" and one["drone"] == drone for one in flown):
            raise InputError(f"flight log {path} holds no flight: it has no state of the {drone}")
    if not any(one["kind"] == "end" for one in records):
        remarks.append("it has no end: the runner was killed, or the log was cut")
    remarks += _tick_remarks([one["t"] for one in flown if one["kind"] == "tick"], header["config"])
    found = _outages(flown, turning[-1])
    for gap in found:
        what = f"the {gap.drone}'s estimate is frozen" if gap.frozen else f"there is no state of the {gap.drone}"
        remarks.append(f"{what} for {gap.end - gap.begin:.2f} s from {max(gap.begin - turning[0], 0.0):.1f} s on")
    remarks += _faults(flown)
    setup = FirmwareSetup.of_header(header)
    for one in records:
        setup = setup.after(one, header["config"])
    lines = tuple(f"{path.name}: {remark}" for remark in remarks)
    return FlightLog(path, header["policy"][:80], header["config"], setup, flown, found, lines)


def _tick_remarks(times: list[float], config: Config) -> list[str]:
    """Notes on the times (T,) [s] of the ticks: gaps, and a period that differs from the policy's."""
    if len(times) < 2:
        return []
    period = config.timing.control_period / ticks_per_command(config.timing.control_period)
    usual = float(np.median(np.diff(times)))
    found = [f"of its ticks {phrase}, where what was sent is held" for phrase in check_times(times)]
    if abs(usual - period) > OFF_RATE * period:
        found.append(f"its ticks are {1e3 * usual:.3g} ms apart, and the policy's are {1e3 * period:.3g} ms")
    return found


def _faults(rows: Sequence[Record]) -> list[str]:
    """Faults of the clocks of a flight while both controllers are in command."""
    ticks = [one for one in rows if one["kind"] == "tick" and one["state"] == GUIDED]
    if len(ticks) < 2:
        return []
    states = [[one for one in rows if one["kind"] == "state" and one["drone"] == name] for name in NAMES]
    return log_consistency.faults(
        (np.array([one["t"] for one in ticks]), np.array([one["sent"] for one in ticks])),
        [(np.array([one["t"] for one in own]), np.array([numbers(one["raw"].state) for one in own])) for own in states],
    )


def outages(drone: str, time: np.ndarray, states: np.ndarray, end: float) -> list[Outage]:
    """Gaps between the rows of `states` (S, n) at `time` (S,) [s] until `end`, and intervals without change."""
    edges = np.append(time, max(end, time[-1]))
    gaps = [(edges[k], edges[k + 1]) for k in np.flatnonzero(np.diff(edges) > SILENCE)]
    changes = np.flatnonzero((np.diff(states, axis=0) != 0).any(axis=1)) + 1
    runs = zip([0, *changes], [*(changes - 1), len(time) - 1], strict=True)
    kept = [(time[a], min(time[b], end)) for a, b in runs if min(time[b], end) - time[a] > FROZEN]
    return [
        Outage(drone, frozen, float(begin), float(over))
        for frozen, spans in ((False, gaps), (True, kept))
        for begin, over in spans
    ]


def numbers(state: DroneState) -> np.ndarray:
    """(13,) position [m], velocity [m/s], quaternion (w, x, y, z), body rates [rad/s]."""
    return np.concatenate([state.position, state.velocity, state.quaternion, state.rates])


def _outages(rows: tuple[Record, ...], stopped: float) -> tuple[Outage, ...]:
    """Gaps until the motors have `stopped` [s]; frozen states only in FLY, since those of a resting pair may freeze."""
    guided = [one["t"] for one in rows if one["kind"] == "tick" and one["state"] == GUIDED]
    found = []
    for drone in NAMES:
        own = [one for one in rows if one["kind"] == "state" and one["drone"] == drone]
        time, states = np.array([one["t"] for one in own]), np.array([numbers(one["raw"].state) for one in own])
        found += [gap for gap in outages(drone, time, states, stopped) if not gap.frozen]
        if guided and (within := (time >= guided[0]) & (time <= guided[-1])).any():
            found += [gap for gap in outages(drone, time[within], states[within], guided[-1]) if gap.frozen]
    return tuple(sorted(found, key=lambda gap: gap.begin))


@dataclass(frozen=True)
class Recording:
    """One flight from when its motors first turn; arrays of T rows, SI units."""

    policy: str
    config: Config
    setup: FirmwareSetup
    time: np.ndarray  # (T,) from 0 [s]
    phase: tuple[str, ...]  # (T,) the supervisor's state
    sent: np.ndarray  # (T, 2, 4) leader, follower: roll, pitch [deg], yaw rate [deg/s], thrust, wire's signs
    goal: np.ndarray  # (T, 3) of O [m]
    position: np.ndarray  # (T, 3) of O [m]
    velocity: np.ndarray  # (T, 3) [m/s]
    quaternion: np.ndarray  # (T, 4) body -> world (w, x, y, z), the follower's
    rates: np.ndarray  # (T, 3) [rad/s]
    leader: np.ndarray  # (T, 3) command: roll, pitch [rad], vertical acceleration [m/s2]; NaN: not in command
    follower: np.ndarray  # (T, 3) likewise
    observation: np.ndarray  # (T, 18) NaN where the controllers were not in command
    hidden: np.ndarray  # (T, H) state of the follower's GRU, likewise; H = 0 without a GRU
    rotor_force: np.ndarray  # (T, 2, 4) [N]; of a log: from the sent thrust, without motor lag and attitude control
    cg_offset: np.ndarray  # (T,) [m]; NaN where it was not measured
    remarks: tuple[str, ...] = ()  # notes on the quality of the log, a line each

    @property
    def target(self) -> np.ndarray:
        """(T, 3) the goal [m]; while landing the last one before, not the one that sinks below the ground."""
        rows = np.where([phase == FlightState.LAND.value for phase in self.phase], 0, np.arange(len(self.phase)))
        return np.asarray(self.goal[np.maximum.accumulate(rows)])

    @property
    def guided_rows(self) -> int:
        """Number of rows up to the last one in FLY."""
        return 1 + max((row for row, phase in enumerate(self.phase) if phase == GUIDED), default=-1)


def read_recording(path: Path, assumed: Config | None = None) -> Recording:
    """The flight in the log `path`, of the rig `assumed` if the log names none. Raises InputError if it holds none."""
    log = load(path, assumed)
    plant = log.config.plant
    rig = Rig.of_plant(plant)
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
    if len(time) < 2 or time[-1] - time[0] > LONGEST:
        raise InputError(f"flight log {path} holds no flight: fewer than two ticks, or more than {LONGEST:g} s")
    return _recording(log, ticks, seen)


def _recording(log: FlightLog, ticks: Sequence[Mapping[str, Any]], seen: Sequence[ObjectState]) -> Recording:
    def column(name: str, width: int) -> np.ndarray:
        return np.array([tick.get(name, np.full(width, np.nan)) for tick in ticks])

    position, velocity, quaternion, rates = (np.array(part) for part in zip(*seen, strict=True))
    curves = log.setup.force_curves(log.config)
    force = np.array([[c.force(s[3]) / 4 for c, s in zip(curves, tick["sent"], strict=True)] for tick in ticks])

    def length(name: str, usual: int) -> int:
        lengths = {len(tick[name]) for tick in ticks if name in tick} or {usual}
        if len(lengths) > 1:
            raise InputError(f"flight log {log.path} holds a tick's {name} in several lengths")
        return lengths.pop()

    return Recording(
        policy=log.policy,
        config=log.config,
        setup=log.setup,
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
        observation=column("observation", length("observation", OBSERVATION)),
        hidden=column("hidden", length("hidden", 0)),
        rotor_force=np.repeat(force[..., None], 4, axis=-1),
        cg_offset=np.full(len(ticks), np.nan),
        remarks=log.remarks,
    )


def drone_kind_of(recording: Recording) -> DroneKind:
    """The twin's kind of drone with the force curve of the flight. Raises InputError if the drones' curves differed."""
    curve = one_curve(recording.setup.curves)
    if curve is None:
        named = ", ".join(f"{name} {own}" for name, own in zip(NAMES, recording.setup.curves, strict=True))
        raise InputError(f"the flight was flown on two force curves ({named}), and the twin's drones have one")
    return drone_kind(drone_of(recording.config), curve)


def trajectory_of(recording: Recording) -> Trajectory:
    """A recording as a trajectory."""
    return Trajectory(
        time=recording.time,
        position=recording.position,
        velocity=recording.velocity,
        euler=rotations.euler_from_matrix(rotations.matrix_from_quaternion(recording.quaternion)),
        rates=recording.rates,
        quaternion=recording.quaternion,
        rotor_force=recording.rotor_force,
        leader_command=recording.leader,
        follower_command=recording.follower,
        observation=recording.observation,
        cg_offset=recording.cg_offset,
        target=recording.target,
        diverged=np.zeros(len(recording.time), bool),
    )


def simulate_setpoints(recording: Recording, kind: DroneKind | None = None) -> Recording:
    """Open-loop simulation of the recorded setpoints, from rest at the recorded start, with drones of `kind`.

    Without a `kind` it is that of the log (`drone_kind_of`). Model errors accumulate with time. The object's mass and
    the CG's motion are not logged; they are those of a rehearsal (`twin.conditions.Conditions.of`).
    """
    pair = pair_of(recording.config, kind or drone_kind_of(recording), Surroundings(exact=True))
    for drone, gains in enumerate(recording.setup.gains):
        for name, value in gains.items():
            pair.set_parameter(drone, name, value)
    rig = Rig.of_plant(recording.config.plant)
    state, seen, forces, offsets = pair.start(), [], [], []
    for time, sent in zip(recording.time, recording.sent, strict=True):
        seen.append(object_state([drone_state(state, number) for number in range(2)], rig))
        forces.append(pair.rotor_force)
        offsets.append(pair.cg_offset)
        step = recording.time[len(seen)] - time if len(seen) < len(recording.time) else 0.0
        sound = np.where(sent[:, 3:] >= crazyflie.IDLE, sent, 0.0)
        state = pair.advance(sound, step)
    position, velocity, quaternion, rates = (np.array(part, float) for part in zip(*seen, strict=True))
    return dataclasses.replace(
        recording,
        position=position - position[0] + recording.position[0],
        velocity=velocity,
        quaternion=quaternion,
        rates=rates,
        rotor_force=np.array(forces),
        cg_offset=np.array(offsets, float),
    )


def drone_state(state: PairState, number: int) -> DroneState:
    """State that a perfect estimator of drone `number` would report."""
    pose, moving = (state.position[number], state.velocity[number]), (state.quaternion[number], state.rates[number])
    return DroneState(*pose, *moving, 0, float(state.battery[number]))
