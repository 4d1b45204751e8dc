"""A load that was put on the stick in flight, from the flight's own log: how heavy it is, and where it hangs.

What is used. Twenty times a second each drone reports its motors' PWM; with the voltage that gives the force of every
motor, hence the lift L = sum T_i of both drones and their moment Q = sum (y_i T_i + roll torque_i) about the stick's
roll axis. States give climb v and roll rate p. With M the mass of all, J the inertia across the stick and S the first
moment of everything along the stick, both drones' included (ours, from the equations of docs/model.md):

- climb: M (dv/dt + g) = f L cos(roll) cos(pitch)
- roll:  J dp/dt = f Q - S f L / M

f is the factor by which the motors differ from their curve. It is found before the load comes, when M is the card's;
afterwards the same factor gives the mass: no scale has to be known in the absolute. S is a constant, the swing
a sin + b cos of the CG, whose angular speed is searched, and a step when the load comes, which is searched as well.
Both equations are averaged over bins of `BIN` seconds, where each is linear in what is unknown: two small least
squares. Lateral accelerations, the motors' lag and the load's part of J are left out; over seconds they average out.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from mjxball.config import Config
from mjxball.control import crazyflie, mixer, motors, rotations
from mjxball.fly.card import motor_of
from mjxball.fly.command import OLDER, CurveName
from mjxball.fly.limits import NAMES
from mjxball.fly.packets import DroneState
from mjxball.fly.supervisor import State
from mjxball.fly.telemetry import Rig
from mjxball.rig.attitude import inertia_about_o
from mjxball.rig.fit import pair_mass

Array = np.ndarray
BIN = 0.2  # [s]
BEFORE, AFTER = 12.0, 3.0  # [s] of flight before the load, at most, and with it, at least, that are used
LONGEST = 7.0  # [s] with it, at most: until its moment is known to `ENOUGH` [kg m]
ENOUGH = 2.5e-5
LEAST_BEFORE = 4.0  # [s]
SEEN = 1.0  # [s] from which on a load shows
SETTLING = 1.0  # [s] after take-over that are left out
SPEEDS = 16  # angular speeds of the CG's swing that are tried
LEAST_MASS, LEAST_MOMENT = 1e-3, 4e-5  # [kg], [kg m] steps that count as a load
CLEARLY = 6.0  # in standard deviations
OTHER_DRONE = 0.1  # [s] that one drone's motors may be older than the other's


class IdentifiedLoad(NamedTuple):
    """A load that was identified."""

    time: float  # [s] of the log's clock, when it came
    mass: float  # [kg]
    moment: float  # mass times offset from O along the stick, toward the leader [kg m]
    mass_spread: float  # one standard deviation, by the fit's own account [kg]
    moment_spread: float  # [kg m]
    own_moment: float  # of the stick and its object on the average before, as the motors show it [kg m]
    swing: float  # amplitude of the first moment's sine [kg m]
    speed: float  # its angular speed [rad/s]
    phase: float  # its phase at `time` [rad]
    volts: float  # of the batteries, the mean

    @property
    def offset(self) -> float:
        """From O along the stick, toward the leader [m]; 0 for a load without mass."""
        return self.moment / self.mass if abs(self.mass) > LEAST_MASS / 2 else 0.0


class _Row(NamedTuple):
    """One tick under both laws."""

    time: float
    lift: float  # of both drones, as the motors' curve has it [N]
    moment: float  # of both drones about roll [N m]
    level: float  # cos(roll) cos(pitch)
    climb: float  # [m/s]
    rate: float  # of roll [rad/s]
    volts: float


class LoadWatch:
    """Reads a flight's records as they come; `find` says whether a load was put on."""

    def __init__(self, config: Config, curve: CurveName = "linear"):
        """`config` of the flown policy, whose stick lies along y; `curve` of the firmware until the log says more."""
        plant = config.plant
        self.curve: CurveName = curve
        self._config, self._motor = config, motor_of(config)
        leader, follower = (drone.mount for drone in plant.pair)
        self._lever = np.array([leader[1], follower[1]])
        self._weights = Rig(leader, follower).weights
        self._mass, self._inertia = pair_mass(config), float(inertia_about_o(config)[0])
        self._states: dict[str, DroneState] = {}
        self._motors: dict[str, tuple[float, Array]] = {}
        self._rows: deque[_Row] = deque()
        self._begin = math.nan

    def take(self, record: Mapping[str, Any]) -> None:
        """One record of the log (`fly.log_schema`), in order."""
        match record["kind"]:
            case "header":
                self.curve = record.get("curve", self.curve)
            case "state":
                self._states[record["drone"]] = record["raw"].state
            case "health":
                self._motors[record["drone"]] = (record["t"], np.asarray(record["motors"], float))
            case "thrust":
                self.curve = record["curve"]
            case "tick":
                self._tick(float(record["t"]), record["state"] == State.FLY.value)

    def _tick(self, now: float, flying: bool) -> None:
        if not flying:
            self._rows.clear()
            self._begin = math.nan
            return
        if math.isnan(self._begin) or (self._rows and now - self._rows[-1].time > BIN):  # a bin would be empty
            self._rows.clear()
            self._begin = now
        known = len(self._states) == len(self._motors) == len(NAMES)
        if not known or now - self._begin < SETTLING or any(now - t > OTHER_DRONE for t, _ in self._motors.values()):
            return
        states = [self._states[name] for name in NAMES]
        volts = np.array([[state.battery] for state in states])
        pwm = np.stack([self._motors[name][1] for name in NAMES])
        older = (OLDER.quadratic, OLDER.linear)
        force = motors.force(self._motor, pwm, volts) if self.curve == "linear" else crazyflie.motor_force(older, pwm)
        plant = self._config.plant
        wrench = mixer.wrench_from_rotors(force, plant.arm, plant.yaw_per_thrust, plant.layout)
        moment = float(wrench[:, 1].sum() + self._lever @ wrench[:, 0])
        level = float(np.mean([rotations.matrix_from_quaternion(state.quaternion)[2, 2] for state in states]))
        climb = float(sum(w * state.velocity[2] for w, state in zip(self._weights, states, strict=True)))
        rate = float(np.mean([state.rates[0] for state in states]))
        self._rows.append(_Row(now, float(wrench[:, 0].sum()), moment, level, climb, rate, float(volts.mean())))
        while now - self._rows[0].time > BEFORE + LONGEST + SEEN:
            self._rows.popleft()

    @property
    def now(self) -> float:
        """Time of the newest tick that can be used, 0 before the first [s]."""
        return self._rows[-1].time if self._rows else 0.0

    @property
    def flown(self) -> float:
        """Time that can be used so far [s]."""
        return self._rows[-1].time - self._rows[0].time if self._rows else 0.0

    def find(self) -> IdentifiedLoad | None:
        """The load that came `AFTER` to `LONGEST` seconds ago; None if none did, or too little is known of it yet.

        Call it about twice a second.
        """
        if self.flown < LEAST_BEFORE + AFTER:
            return None
        bins = _Bins.of(list(self._rows))
        last = bins.time[-1] + BIN / 2
        steps = np.arange(max(bins.time[0] + LEAST_BEFORE, last - LONGEST - SEEN), last - SEEN, BIN / 4)
        slowest, fastest = self._config.scenario.cg_speed
        speeds = np.linspace(slowest, fastest, SPEEDS)
        found = [one for step in steps if (one := self._fit(bins, float(step), speeds)) is not None]
        best = min(found, key=lambda one: one[0], default=None)
        if best is None or last - best[1].time < AFTER:
            return None
        refined = self._fit(bins, best[1].time, np.linspace(slowest, fastest, 8 * SPEEDS))
        load = refined[1] if refined is not None else best[1]
        if load.moment_spread > ENOUGH and last - load.time < LONGEST:
            return None
        heavy = abs(load.mass) > max(LEAST_MASS, CLEARLY * load.mass_spread)
        off = abs(load.moment) > max(LEAST_MOMENT, CLEARLY * load.moment_spread)
        return load if heavy or off else None

    def _fit(self, bins: _Bins, step: float, speeds: Array) -> tuple[float, IdentifiedLoad] | None:
        """(misfit of both equations, the load) if it came at `step` [s]."""
        used = (bins.time > step - BEFORE) & (bins.time < step + LONGEST)
        part = bins.only(used)
        loaded = np.clip((part.time + BIN / 2 - step) / BIN, 0.0, 1.0)
        # climb: (dv/dt + g) / (L cos cos) = f / M, and what its change says of M
        ratio = (part.climbing + self._config.plant.gravity) / part.lift_up
        (before, change), spreads, misfit = _least_squares(np.stack([1 - loaded, loaded], axis=-1), ratio)
        if min(before, change) <= 0:
            return None
        after, factor = self._mass * before / change, before * self._mass
        mass_spread = after * math.hypot(spreads[0] / before, spreads[1] / change)
        # roll: f Q - J dp/dt = S f L / M
        weight = factor * part.lift / (self._mass + loaded * (after - self._mass))
        turned = factor * part.moment - self._inertia * part.turning
        phase = speeds[:, None] * (part.time - step)
        shapes = np.stack([np.ones_like(phase), loaded + 0 * phase, np.sin(phase), np.cos(phase)], axis=-1)
        fits = _least_squares(weight[:, None] * shapes, turned)
        best = int(np.argmin(fits.misfit))
        own, moment, sine, cosine = fits.solution[best]
        load = IdentifiedLoad(
            time=step,
            mass=float(after - self._mass),
            moment=float(moment),
            mass_spread=float(mass_spread),
            moment_spread=float(fits.spreads[best, 1]),
            own_moment=float(own),
            swing=math.hypot(sine, cosine),
            speed=float(speeds[best]),
            phase=math.atan2(cosine, sine),
            volts=float(part.volts.mean()),
        )
        return math.log(misfit) + math.log(fits.misfit[best]), load


class _Bins(NamedTuple):
    """Averages over `BIN` seconds, each (n,)."""

    time: Array  # of the middle [s]
    lift: Array  # [N]
    lift_up: Array  # its vertical part [N]
    moment: Array  # [N m]
    climbing: Array  # change of climb [m/s2]
    turning: Array  # change of the roll rate [rad/s2]
    volts: Array

    @classmethod
    def of(cls, rows: list[_Row]) -> _Bins:
        table = np.array(rows)
        edges = np.arange(table[0, 0], table[-1, 0] + 1e-9, BIN)
        column = dict(zip(_Row._fields, table.T, strict=True))
        place = np.searchsorted(edges, column["time"], side="right") - 1
        count = len(edges) - 1

        def mean(values: Array) -> Array:
            inside = place < count
            total = np.bincount(place[inside], values[inside], count)
            return total / np.maximum(np.bincount(place[inside], minlength=count), 1)

        def slope(values: Array) -> Array:
            # A little smoothing at the edges: one sample carries the noise of the whole bin's slope.
            window = BIN / 8
            at = np.array([values[np.abs(column["time"] - edge) <= window].mean() for edge in edges])
            return np.diff(at) / BIN

        return cls(
            edges[:-1] + BIN / 2,
            mean(column["lift"]),
            mean(column["lift"] * column["level"]),
            mean(column["moment"]),
            slope(column["climb"]),
            slope(column["rate"]),
            mean(column["volts"]),
        )

    def only(self, used: Array) -> _Bins:
        """Those bins that are `used` (n,)."""
        return _Bins(*(values[used] for values in self))


class _Fits(NamedTuple):
    """What least squares give, of each set of shapes."""

    solution: Array  # (..., k)
    spreads: Array  # (..., k) one standard deviation of each
    misfit: Array  # (...) root mean square of what is left, never 0


def _least_squares(shapes: Array, values: Array) -> _Fits:
    """Of shapes (..., n, k) x = values (n,)."""
    across = shapes.mT
    normal = np.linalg.pinv(across @ shapes)
    solution = (normal @ (across @ values)[..., None])[..., 0]
    left = values - (shapes @ solution[..., None])[..., 0]
    misfit = np.sqrt(np.vecdot(left, left) / max(shapes.shape[-2] - shapes.shape[-1], 1))
    spreads = misfit[..., None] * np.sqrt(np.linalg.diagonal(normal))
    return _Fits(solution, spreads, np.maximum(misfit, 1e-12))
