"""LQG of one follower of a plant with ideal attitude loops: a Kalman filter and an LQR of one linear model (ours).

The model (`hover_model`) has the reaction to the CG's motion, the leader's controller and disturbances: the load's
torque, wind, errors of mass and thrust. Measurements are some control steps late; the state is predicted from there
with the commands sent since. A measurement that repeats the last one, as in a gap, is left out. The assembly follows
the sum of all commands. A follower therefore commands its share of what N drones should do minus the leader's part, and
assumes that the others do the same; it uses its own measurements alone. Followers whose sensors disagree by constants
would pull against each other for ever, hence the time constants.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from mjxball.arrays import Array, joined
from mjxball.baselines.assembly_model import ideal_model
from mjxball.baselines.hover_model import (
    ACROSS,
    ERRORS,
    LIFT_ERROR,
    LOAD,
    LOAD_CURVE,
    MEASURED,
    RATES,
    STATES,
    TURN,
    WIND,
    HoverModel,
    LoadModel,
    hover_model,
)
from mjxball.baselines.linear import missed, regulator, riccati, times
from mjxball.baselines.lqg_tuning import CALM, DISTURBED, LONGEST_DELAY, TEAM, TEAM_CALM, TEAM_DISTURBED, Costs, Tuning
from mjxball.baselines.sharing import Assumed, Wanted, level, sharing
from mjxball.config import Config
from mjxball.control.followers import PrivilegedInfo
from mjxball.control.observation import OWN_STATE

if TYPE_CHECKING:
    from jaxtyping import Float

POSITION_NOISE = 3e-3  # standard deviation of a measured error, to which the others refer [m]
TILT_COST, VERTICAL_COST = 0.15, 1.0  # deviations of the mean command with a cost of 1 [rad], [m/s2]
MEMORY, MOST_HALVINGS = 20.0, 24  # in which followers forget what they estimate apart [s]; tries to make it so
ROWS = 14  # of `Feedback`


class Feedback(NamedTuple):
    """The mean command of all drones as a function of the state: P clipped error + D rate, clipped, + a rest."""

    # error of O; D times its rate; rest, which balances disturbances and damps; the leader's command; `Wanted.rest`
    rows: Float[Array, "... 14 n"]
    position: Float[Array, "... 3 3"]  # P
    error_limit: Float[Array, "... 3"]  # [m]
    limit: Float[Array, "... 3"]  # [rad], [rad], [m/s2]

    def wanted(self, values: Array, stiffness: Array | None = None) -> Wanted:
        """What all drones should do for `values` (..., 14) of `rows`.

        `stiffness` (...) of the attitude loops over that which the limits are for. A stiffer leader saturates its
        rotors sooner against a tilt that it does not command: errors may then ask for less beside its command.
        """
        xp = values.__array_namespace__()
        gain, most, limit = (xp.asarray(part, dtype=values.dtype) for part in self[1:])
        far = times(gain, xp.clip(values[..., :3], -most, most)) + values[..., 3:6]
        led = values[..., 9:12]
        middle = 0.0 * led
        if stiffness is not None:
            share = 1.0 / xp.maximum(stiffness, 1.0 + 0.0 * stiffness)[..., None]
            limit = xp.concat([share * limit[..., :2], limit[..., 2:] + 0.0 * share], axis=-1)
            middle = xp.concat([(1.0 - share) * led[..., :2], middle[..., 2:]], axis=-1)
        command = xp.clip(far, middle - limit, middle + limit) + values[..., 6:9]
        return Wanted(command, led, values[..., 12:14])


def balance(model: HoverModel, gravity: float) -> np.ndarray:
    """(3, 22) mean command that balances the disturbances at rest, with the tilt that it takes against wind."""
    found = np.zeros((3, STATES))
    found[:2, 19:21] = -ACROSS.T / gravity
    found[:2, LOAD] = -np.linalg.inv(model.commanded[:2, :2])
    found[2, LIFT_ERROR] = -1.0
    return found


def regulated(model: HoverModel, costs: Costs, gravity: float) -> tuple[np.ndarray, np.ndarray]:
    """(gains (3, 22) of the command's deviation from `balance`, cost (3, 3) of another deviation, see `regulator`)."""
    drive = model.drive @ model.commanded
    outputs = np.vstack([model.error, model.error_rate])
    weights = np.array([costs.position] * 2 + [costs.height] + [costs.velocity] * 2 + [costs.climb]) ** -2.0
    deviation = np.diag([TILT_COST**-2, TILT_COST**-2, VERTICAL_COST**-2])
    transition = model.transition + drive @ balance(model, gravity)
    return regulator(transition, drive, outputs.T * weights @ outputs, deviation)


def feedback(model: HoverModel, costs: Costs, gravity: float) -> Feedback:
    """The LQR of errors and rates of O and of the command's deviation from `balance`."""
    whole = balance(model, gravity) - regulated(model, costs, gravity)[0]
    position, damping = whole[:, ERRORS], whole[:, RATES] @ model.error_rate
    rest = whole - position @ model.error - damping
    return Feedback(
        np.vstack([model.error, damping, rest, model.led, model.rest]),
        position,
        np.array([costs.error_limit, costs.error_limit, costs.height_limit]),
        np.array([costs.tilt_limit, costs.tilt_limit, costs.climb_limit]),
    )


class LqgDesign(NamedTuple):
    """Matrices of the controller; all may have leading axes."""

    transition: Float[Array, "... 22 22"]  # with the leader in the loop
    drive: Float[Array, "... 22 3"]  # of what the followers' commands ask for
    gain: Float[Array, "... 22 10"]  # of the filter
    measured: Float[Array, "... 10 22"]
    feedback: Feedback  # on the state at the time of the newest measurement
    ahead: Float[Array, "... 14 12"]  # and what the inputs since then add, the newest first
    sent: Float[Array, "... 5"]  # 1 for the input of that time, of the one now and the last four
    delay: Float[Array, "..."]  # control steps
    loop_scale: Float[Array, "..."]  # assumed factor on the attitude loops' frequency
    commanded: Float[Array, "... 3 3"]  # what the mean command of all drones asks for
    led_drive: Float[Array, "... 3 3"]  # and the leader's


def design(config: Config, tuning: Tuning) -> LqgDesign:
    """The controller for the plant of `config`.

    What several followers estimate apart does not show in the motion; it must die out by the controller's own dynamics.
    Where it would not within `MEMORY`, disturbances are taken to walk less.
    """
    found = _design(config, tuning)
    if len(config.plant.followers) > 1:
        for _ in range(MOST_HALVINGS):
            if np.abs(np.linalg.eigvals(apart(found))).max() < np.exp(-config.timing.control_period / MEMORY):
                break
            walks = {name: 0.5 * getattr(tuning, name) for name in ("load_walk", "wind_walk", "lift_walk")}
            tuning = tuning._replace(**walks)
            found = _design(config, tuning)
    return found


def apart(own: LqgDesign) -> Float[np.ndarray, "34 34"]:
    """The step of (state, last inputs) of the controller where no measurement changes, none of its limits reached."""
    size, feedback = STATES, own.feedback
    asks = own.commanded @ np.hstack([feedback.position, np.eye(3), np.eye(3)])
    asks = np.hstack([asks, -own.led_drive, np.zeros((3, 2))])
    blind = np.eye(size) - own.gain @ own.measured
    given = np.hstack([asks @ feedback.rows @ blind, asks @ own.ahead])
    inputs = np.vstack([given, np.eye(size + 3 * LONGEST_DELAY)[size:]])
    before = sum(weight * inputs[3 * k : 3 * k + 3] for k, weight in enumerate(own.sent))
    moved = own.transition @ np.hstack([blind, np.zeros((size, 3 * LONGEST_DELAY))]) + own.drive @ before
    return np.vstack([moved, inputs[: 3 * LONGEST_DELAY]])


def _design(config: Config, tuning: Tuning) -> LqgDesign:
    assembly = ideal_model(config, "lqg")
    model = hover_model(config, assembly, tuning.load, tuning.loop_scale)
    transition, found = model.with_leader, feedback(model, tuning.costs, assembly.gravity)
    powers = [np.linalg.matrix_power(transition, number) for number in range(tuning.late + 1)]
    ahead = np.zeros((ROWS, 3 * LONGEST_DELAY))
    for number in range(tuning.late):
        ahead[:, 3 * number : 3 * number + 3] = found.rows @ powers[number] @ model.drive
    return LqgDesign(
        transition=transition,
        drive=model.drive,
        gain=filter_gain(model, tuning, assembly.period),
        measured=model.measured,
        feedback=found._replace(rows=found.rows @ powers[-1]),
        ahead=ahead,
        sent=np.eye(LONGEST_DELAY + 1)[tuning.late],
        delay=np.array(float(tuning.late)),
        loop_scale=np.array(float(tuning.loop_scale)),
        commanded=model.commanded,
        led_drive=model.led_drive,
    )


def filter_gain(model: HoverModel, tuning: Tuning, period: float) -> np.ndarray:
    """(22, 10) K of the steady-state Kalman filter x <- x + K (y - C x), with the leader in the loop."""
    process, noise = noises(tuning, period)
    predicted = riccati(model.with_leader.T, model.measured.T, process, noise)
    innovation = model.measured @ predicted @ model.measured.T + noise
    return np.linalg.solve(innovation, model.measured @ predicted).T


def noises(tuning: Tuning, period: float) -> tuple[np.ndarray, np.ndarray]:
    """Covariances of the process noise of one `period` [s] (22, 22) and of the measurements (10, 10)."""
    walks = np.zeros(STATES)
    walks[RATES], walks[TURN] = tuning.acceleration_walk, tuning.turn_walk
    walks[LOAD_CURVE], walks[WIND], walks[LIFT_ERROR] = tuning.load_walk, tuning.wind_walk, tuning.lift_walk
    deviations = [POSITION_NOISE] * 3 + [tuning.velocity_noise] * 3 + [tuning.angle_noise] * 2 + [tuning.rate_noise] * 2
    return np.diag(walks * period), np.diag(np.square(deviations))


class LqgState(NamedTuple):
    """State of the controller between control steps."""

    expected: Array  # (..., 22) state at the time of the next measurement
    given: Array  # (..., 12) what the followers' last four commands asked for, the newest first
    steps: Array  # (...) so far, at most `LONGEST_DELAY`
    last: Array  # (..., 12) own state as last measured


class Lqg:
    """The controller of every follower, on its own measurements; of several, arrays are (..., F, ...)."""

    name = "lqg"
    needs_privileged = False
    tuning, team_tuning = Tuning(), TEAM

    def __init__(self, config: Config, tuning: Tuning | None = None):
        self._model = ideal_model(config, self.name)
        self._sharing = sharing(config, self._model)
        own = self.team_tuning if config.plant.is_team else self.tuning
        self.design = design(config, tuning or own)
        self._over_inertia = np.linalg.inv(hover_model(config, self._model, LoadModel()).inertia)

    def start(self, observation: Array) -> LqgState:
        """See `Controller.start`."""
        xp, zero = observation.__array_namespace__(), 0.0 * observation[..., 0]
        measured = self._model.in_body_axes(observation)[..., list(MEASURED)]
        unknown = [zero] * (STATES - measured.shape[-1])
        expected = joined([*(measured[..., place] for place in range(measured.shape[-1])), *unknown])
        return LqgState(expected, xp.stack([zero] * 3 * LONGEST_DELAY, axis=-1), zero, observation[..., :OWN_STATE])

    def step(self, state: LqgState, observation: Array, privileged: PrivilegedInfo) -> tuple[LqgState, Array]:
        """See `Controller.step`."""
        xp, own, model = observation.__array_namespace__(), self.design, self._model
        seen = model.in_body_axes(observation)
        y = seen[..., list(MEASURED)]
        surprise = xp.where(missed(observation, state.last), 0.0, y - times(own.measured, state.expected))
        x = state.expected + times(own.gain, surprise)
        carried = model.carried(privileged.believed_mass)
        wanted = own.feedback.wanted(times(own.feedback.rows, x) + times(own.ahead, state.given))
        commands, asked = self._sharing(
            wanted, Assumed(carried, carried.sum(axis=-1), level(seen), None, xp.asarray(own.loop_scale, dtype=x.dtype))
        )
        asked = xp.concat([times(self._over_inertia, asked[..., :2]), asked[..., 2:]], axis=-1)
        given = xp.concat([asked, state.given], axis=-1)
        sent, late = (xp.asarray(part, dtype=x.dtype) for part in (own.sent, own.delay))
        before = (xp.reshape(given, (*given.shape[:-1], LONGEST_DELAY + 1, 3)) * sent[..., None]).sum(axis=-2)
        moved = times(own.transition, x) + times(own.drive, before)
        # The first measurements are of the start, where nothing moves.
        expected = xp.where((state.steps >= late)[..., None], moved, state.expected)
        steps = xp.minimum(state.steps + 1.0, LONGEST_DELAY)
        return LqgState(expected, given[..., :-3], steps, observation[..., :OWN_STATE]), model.own(commands)


class CalmLqg(Lqg):
    """`lqg` for flights that are known to be calm: constant errors of the sensors alone."""

    name = "lqg-calm"
    tuning, team_tuning = CALM, TEAM_CALM


class DisturbedLqg(Lqg):
    """`lqg` for flights that are known to be disturbed: noise, delay, wind, errors of the plant."""

    name = "lqg-disturbed"
    tuning, team_tuning = DISTURBED, TEAM_DISTURBED
