"""LQG for two Crazyflies on a stick along y, and what `oracle` shares with it (ours)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mjxball.arrays import Array
from mjxball.baselines.assembly_model import CopiedPid, assembly_model
from mjxball.baselines.crazyflie_model import MEASURED, Decay, LinearModel, linear_model
from mjxball.baselines.linear import discretise, missed, regulator, riccati, times
from mjxball.config import Config
from mjxball.control.followers import PrivilegedInfo
from mjxball.control.observation import OBSERVATION_SIZE, OWN_STATE
from mjxball.errors import InputError

if TYPE_CHECKING:
    from jaxtyping import Float

LOAD_COST = 1e-2  # of a rolling ball's torque with a cost of 1 [N m]
ROLLING_NOISE = 2e-3  # walk of `load_rate` if the model includes a rolling ball
POSITION_NOISE = 3e-3  # standard deviation of measured y and height, to which the others refer [m]
LONGEST_DELAY = 8  # control steps


class Costs(NamedTuple):
    """Values with a cost of 1, and the largest error that the feedback acts on."""

    y: float = 0.0272  # of O [m]
    vy: float = 0.72  # [m/s]
    height: float = 0.0506  # [m]
    climb: float = 0.0872  # [m/s]
    rate: float = 0.289  # [rad/s]
    thrust_difference: float = 0.602  # [N]
    roll_change: float = 0.779  # of the roll command [rad/s]
    vertical_change: float = 45.3  # of the vertical acceleration [m/s3]
    error_limit: float = 0.147  # the motors have little thrust to spare [m]


class Tuning(NamedTuple):
    """Parameters of the controller: those of `Costs`, then walks as standard deviations after a second, and others."""

    y: float = 0.166
    vy: float = 0.845
    height: float = 0.116
    climb: float = 0.167
    rate: float = 2.97
    thrust_difference: float = 0.195
    roll_change: float = 1.79
    vertical_change: float = 51.1
    error_limit: float = 0.192
    load_rate_walk: float = 0.0302
    load_walk: float = 0.00255
    lift_walk: float = 0.0185
    wind_walk: float = 0.187
    rate_walk: float = 0.262
    velocity_walk: float = 0.0989
    load_rate_time: float = 2.64  # time constants with which disturbances decay [s]
    load_time: float = 16.7
    lift_time: float = 14.6
    wind_time: float = 51.6
    velocity_noise: float = 0.0931  # standard deviations of measurements, beside `POSITION_NOISE` [m/s]
    angle_noise: float = 0.00341  # [rad]
    rate_noise: float = 0.0852  # [rad/s]
    delay: float = 12.8  # of the measurements, rounded [control steps]

    @property
    def costs(self) -> Costs:
        """Those of the LQR."""
        return Costs(*self[: len(Costs._fields)])

    @property
    def late(self) -> int:
        """Delay in control steps."""
        return min(max(round(float(self.delay)), 0), LONGEST_DELAY)

    @property
    def decay(self) -> Decay:
        """That of the disturbances."""
        return Decay(self.load_rate_time, self.load_time, self.lift_time, self.wind_time)


# For both conditions of the benchmark, and for one: 44 % of 48 calm flights of the search, 79 % of the disturbed ones,
# after 1920 sets each.
BOTH = Tuning()
CALM = Tuning(
    y=0.145,
    vy=0.544,
    height=0.138,
    climb=0.304,
    rate=3.51,
    thrust_difference=0.499,
    roll_change=0.789,
    vertical_change=27.8,
    error_limit=0.138,
    load_rate_walk=0.0344,
    load_walk=0.00612,
    lift_walk=0.0143,
    wind_walk=0.232,
    rate_walk=0.181,
    velocity_walk=0.0999,
    load_rate_time=2.27,
    load_time=9.15,
    lift_time=13.9,
    wind_time=68.3,
    velocity_noise=0.0844,
    angle_noise=0.006,
    rate_noise=0.0261,
    delay=22.4,
)
DISTURBED = Tuning(
    y=0.254,
    vy=0.756,
    height=0.125,
    climb=0.238,
    rate=2.9,
    thrust_difference=0.501,
    roll_change=0.525,
    vertical_change=35.8,
    error_limit=0.211,
    load_rate_walk=0.00243,
    load_walk=0.00363,
    lift_walk=0.0209,
    wind_walk=0.191,
    rate_walk=0.105,
    velocity_walk=0.0401,
    load_rate_time=0.72,
    load_time=6.46,
    lift_time=48.8,
    wind_time=24.3,
    velocity_noise=0.116,
    angle_noise=0.00367,
    rate_noise=0.0311,
    delay=16.2,
)


def changes(model: LinearModel, costs: Costs, period: float) -> Float[np.ndarray, "2 n+2"]:
    """K of the command's change -K (x, u) every control `period` [s]: the LQR of outputs and changes."""
    n, names = len(model.names), model.names
    a, b = np.eye(n + 2), np.zeros((n + 2, 2))
    a[:n, :n], a[:n, n:] = discretise(model.a, model.b, period)
    b[:n], b[n:] = a[:n, n:], np.eye(2)
    unit, rolls = np.eye(n + 2), bool(np.isfinite(model.load_limit))
    outputs = [
        np.append(row, [0.0, 0.0]) / getattr(costs, name)
        for row, name in zip(model.measured, model.shown, strict=True)
        if name != "roll"
    ]
    outputs += [unit[names.index("load")] / LOAD_COST] * rolls
    apart = unit[names.index("leader_thrust")] - unit[names.index("follower_thrust")]
    outputs.append(apart / costs.thrust_difference)
    cost = np.array(outputs).T @ np.array(outputs)
    limits = costs.roll_change, costs.vertical_change
    return regulator(a, b, cost, np.diag([(limit * period) ** -2 for limit in limits]))[0]


class CrazyflieDesign(NamedTuple):
    """Matrices of the controller; all may have leading axes."""

    transition: Float[Array, "... n n"]
    drive: Float[Array, "... n 2"]
    gain: Float[Array, "... n k"]  # of the filter
    measured: Float[Array, "... k n"]
    now: Float[Array, "... n n"]  # state now for one at the time of the newest measurement
    ahead: Float[Array, "... n 16"]  # and what the commands since then add, the newest first
    sent: Float[Array, "... 9"]  # 1 for the command of that time, of the one now and the last eight
    delay: Float[Array, "..."]  # control steps
    change: Float[Array, "... 2 n+2"]
    error_limit: Float[Array, "..."]


def design(config: Config, tuning: Tuning) -> CrazyflieDesign:
    """The controller for the plant of `config`."""
    model, period = linear_model(config, tuning.decay), config.timing.control_period
    transition, drive = discretise(model.a, model.b, period)
    walks = {"load_rate": tuning.load_rate_walk, "load": tuning.load_walk, "lift": tuning.lift_walk}
    walks |= {
        "wind": tuning.wind_walk,
        "rate": tuning.rate_walk,
        "vy": tuning.velocity_walk,
        "climb": tuning.velocity_walk,
    }
    if np.isfinite(model.load_limit):
        walks["load_rate"] = ROLLING_NOISE
    process = np.diag([walks.get(name, 0.0) ** 2 * period for name in model.names])
    velocity, angle, rate = tuning.velocity_noise, tuning.angle_noise, tuning.rate_noise
    deviations = {"y": POSITION_NOISE, "vy": velocity, "roll": angle, "rate": rate, "height": POSITION_NOISE}
    noise = np.diag([(deviations | {"climb": velocity})[name] ** 2 for name in model.shown])
    predicted = riccati(transition.T, model.measured.T, process, noise)
    gain = np.linalg.solve(model.measured @ predicted @ model.measured.T + noise, model.measured @ predicted).T
    ahead, power = np.zeros((len(transition), 2 * LONGEST_DELAY)), np.eye(len(transition))
    for number in range(tuning.late):
        ahead[:, 2 * number : 2 * number + 2], power = power @ drive, transition @ power
    return CrazyflieDesign(
        *(transition, drive, gain, model.measured, power, ahead),
        sent=np.eye(LONGEST_DELAY + 1)[tuning.late],
        delay=np.array(float(tuning.late)),
        change=changes(model, tuning.costs, period),
        error_limit=np.array(tuning.error_limit),
    )


class LqgState(NamedTuple):
    """State of the controller between control steps."""

    expected: Array  # (..., n) states of the model at the time of the next measurement
    commands: Array  # (..., 16) the last eight: roll [rad] and vertical acceleration [m/s2], the newest first
    integral: Any  # (..., 3) see `CopiedPid`
    steps: Array  # (...) so far, at most `LONGEST_DELAY`
    last: Array  # (..., 12) own state as last measured


class CrazyflieLqg:
    """Kalman filter and LQR of the pair's roll and height; pitch, which the load does not move, copies the leader."""

    name = "lqg"
    needs_privileged = False
    tuning = BOTH

    def __init__(self, config: Config, tuning: Tuning | None = None):
        self.design = design(config, tuning or self.tuning)
        self._actuators = Actuators(config, self.name)
        self._pid, self._model = CopiedPid(config), self._actuators.model
        shown = [MEASURED[name] for name in self._model.shown]
        self._measurement = np.array([sign * np.eye(OBSERVATION_SIZE)[place] for place, sign in shown])  # (k, 18)
        self._first = np.eye(len(self._model.names))[self._model.indices(MEASURED)].T  # (n, k)

    def start(self, observation: Array) -> LqgState:
        """See `Controller.start`."""
        xp = observation.__array_namespace__()
        zero = xp.zeros_like(observation[..., 0])
        expected = times(self._first, times(self._measurement, observation))
        commands, integral = xp.stack([zero] * 2 * LONGEST_DELAY, axis=-1), self._pid.start(observation)
        return LqgState(expected, commands, integral, zero, observation[..., :OWN_STATE])

    def step(self, state: LqgState, observation: Array, privileged: PrivilegedInfo) -> tuple[LqgState, Array]:
        """See `Controller.step`."""
        xp, own = observation.__array_namespace__(), self.design
        y = times(self._measurement, observation)
        surprise = xp.where(missed(observation, state.last), 0.0, y - times(own.measured, state.expected))
        estimate = state.expected + times(own.gain, surprise)
        estimate = self._actuators.bounded(estimate)
        now = times(own.now, estimate) + times(own.ahead, state.commands)
        command = self._actuators.command(now, state.commands[..., :2], own.change, own.error_limit)
        commands = xp.concat([command, state.commands], axis=-1)
        sent, late = (xp.asarray(part, dtype=now.dtype) for part in (own.sent, own.delay))
        before = (xp.reshape(commands, (*commands.shape[:-1], LONGEST_DELAY + 1, 2)) * sent[..., None]).sum(axis=-2)
        moved = times(own.transition, estimate) + times(own.drive, before)
        # The first measurements are of the start, where nothing moves.
        expected = xp.where((state.steps >= late)[..., None], moved, state.expected)
        integral, copied = self._pid.step(state.integral, observation)
        steps = xp.minimum(state.steps + 1.0, LONGEST_DELAY)
        after = LqgState(expected, commands[..., :-2], integral, steps, observation[..., :OWN_STATE])
        return after, self._actuators.sent(command, copied)


class CalmCrazyflieLqg(CrazyflieLqg):
    """`lqg` for flights that are known to be calm: constant errors of the sensors alone."""

    name = "lqg-calm"
    tuning = CALM


class DisturbedCrazyflieLqg(CrazyflieLqg):
    """`lqg` for flights that are known to be disturbed: noise, delay, wind, errors of the plant."""

    name = "lqg-disturbed"
    tuning = DISTURBED


class Actuators:
    """What follows from the state of two Crazyflies along y: bounded states, limited commands."""

    def __init__(self, config: Config, name: str):
        if config.plant.cg_axis != "y" or config.plant.stand == "pivot":
            raise InputError(f"follower {name!r} flies two Crazyflies along y, free or on the stand with height free")
        self.assembly, self.model = assembly_model(config, name), linear_model(config, Decay())
        self._limits = config.command.tilt_limit, config.command.vertical_limit
        self._bounds = np.full(len(self.model.names), np.inf)
        limits = {"rate_integral": self.model.rate_integral_limit, "load": self.model.load_limit}
        self._bounds[self.model.indices(limits)] = list(limits.values())
        self._errors = np.zeros(len(self.model.names))
        self._errors[self.model.indices(("y", "height"))] = 1.0

    def bounded(self, x: Array) -> Array:
        """`x` (..., n) within what the leader's rate loop and the ball allow."""
        xp = x.__array_namespace__()
        bounds = xp.asarray(self._bounds, dtype=x.dtype)
        return xp.clip(x, -bounds, bounds)

    def command(self, x: Array, last: Array, change: Array, error_limit: Array) -> Array:
        """Roll and vertical acceleration (..., 2) at `x` (..., n) after the `last`, by the gains `change`."""
        xp = x.__array_namespace__()
        most = xp.where(xp.asarray(self._errors > 0), xp.asarray(error_limit, dtype=x.dtype)[..., None], np.inf)
        wanted = last - times(change, xp.concat([xp.clip(x, -most, most), last], axis=-1))
        limits = xp.asarray(self._limits, dtype=x.dtype)
        return xp.clip(wanted, -limits, limits)

    def sent(self, command: Array, copied: Array) -> Array:
        """Command (..., 3) of roll and vertical acceleration `command` (..., 2) and the pitch that was `copied`."""
        xp, limit = command.__array_namespace__(), self._limits[1]
        torque = self.assembly.on_axes(command[..., :1])
        vertical = xp.clip(self.assembly.without_extra_lift(command[..., 1], torque), -limit, limit)
        return xp.stack([command[..., 0], copied[..., 1], vertical], axis=-1)
