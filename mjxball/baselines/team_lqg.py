"""Offset-free LQG of one follower of a team (ours).

Every follower runs it for itself, in its mount frame. Closed attitude loops answer to the mean of all N commands alike
whatever the rig weighs, so that the filter's numbers do not depend on it: two equal ones about roll and pitch, with the
load's torque over the inertia, and one of the height.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from mjxball.arrays import Array, clipped, joined, matmul
from mjxball.baselines.assembly_model import ideal_model
from mjxball.baselines.lqg import CORRECTION_LIMIT, VERTICAL_LIMIT
from mjxball.baselines.lqg_design import CLIMB_NOISE, RATE_NOISE, Tuning, feedback, steady_filter
from mjxball.baselines.offset_free import LIFT_WALK, NAME
from mjxball.config import Config
from mjxball.control import rotations
from mjxball.control.followers import PrivilegedInfo, copy_gains
from mjxball.control.leader import clip_command
from mjxball.control.observation import ERROR, ERROR_RATE, copy_command, mount_frames
from mjxball.errors import InputError
from mjxball.plant import plant_parameters

TUNING = Tuning(position=0.2, velocity=0.6, torque_walk=20.0, tilt_limit=0.3)  # of a load's torque over the inertia
# [s] in which the estimates of d, d' and the lift error are forgotten.
LOAD_TIME, RATE_TIME, LIFT_TIME = 3.0, 0.3, 5.0
ANGLE_NOISE = 5e-3  # deviation of a measurement [rad]
ANGLE_STATES, HEIGHT_STATES = 5, 3
LEAST_ROOM = 1e-3  # [rad]


class Design(NamedTuple):
    """Numbers of the law.

    State of the filter about an axis: (angle [rad], rate [rad/s], load d [rad/s2], d', rotors' part [rad/s2]), driven
    by the mean command [rad]; of the height: (climb [m/s], lift [m/s2], lift error [m/s2]), driven by the mean vertical
    command. x <- A x + B u, then x <- x + K (y - C x) with angle and rate, or climb, measured.
    """

    axis: Array  # (A B) (5, 6)
    axis_gain: Array  # K (5, 2)
    height: Array  # (A B) (3, 4)
    height_gain: Array  # K (3,)
    tilt: Array  # (4,) feedback on (error, velocity, angle, rate) of pitch; that of roll mirrors it
    rise: Array  # (2,) feedback on the vertical (error, velocity)
    stiffness: float  # natural frequency of the closed attitude loops, squared [1/s2]
    damping: float  # Kd over Kp of the attitude loops [s]


def design(config: Config) -> Design:
    """The law for teams like that of `config`; InputError unless it flies freely with ideal loops that are alike."""
    model = ideal_model(config, NAME)
    roll, pitch, _ = config.attitude.natural_frequency
    if roll != pitch:
        raise InputError(f"follower {NAME!r} needs attitude loops alike about roll and pitch in a team")
    stiffness, damping = roll**2, 2 * config.attitude.damping * roll
    a, b = np.zeros((ANGLE_STATES, ANGLE_STATES)), np.zeros((ANGLE_STATES, 1))
    a[0, 1] = a[2, 3] = a[1, 2] = a[1, 4] = 1.0
    a[2, 2], a[3, 3] = -1.0 / LOAD_TIME, -1.0 / RATE_TIME
    a[4] = np.array([-stiffness, -damping, 0.0, 0.0, -1.0]) / model.lag
    b[4] = stiffness / model.lag
    noise = {0: ANGLE_NOISE, 1: RATE_NOISE}
    *axis, axis_gain = steady_filter(a, b, model.period, {3: TUNING.torque_walk}, noise)
    a, b = np.zeros((HEIGHT_STATES, HEIGHT_STATES)), np.zeros((HEIGHT_STATES, 1))
    a[0, 1] = a[0, 2] = 1.0
    a[1, 1], b[1] = -1.0 / model.lag, 1.0 / model.lag
    a[2, 2] = -1.0 / LIFT_TIME
    *height, height_gain = steady_filter(a, b, model.period, {2: LIFT_WALK}, {0: CLIMB_NOISE})
    gains = feedback(model, TUNING)
    return Design(
        axis=np.hstack(axis),
        axis_gain=axis_gain,
        height=np.hstack(height),
        height_gain=height_gain[:, 0],
        tilt=np.array(gains.pitch),
        rise=np.array(gains.height),
        stiffness=stiffness,
        damping=damping / stiffness,
    )


class TeamModel(NamedTuple):
    """What followers know of their team, each in its mount frame; without F where there is one."""

    ratio: float  # N / (N - 1)
    # (F, 2) roll and pitch that all drones would have to command to hold what lifting 1 m/s2 more than the leader does
    # [rad per m/s2]
    lever: Array
    # (F, 2) how far a roll and a pitch command may be from where the follower's loop asks for no torque, before its
    # rotors cannot follow [rad]
    room: Array


def team_model(config: Config) -> TeamModel:
    """What the followers of the team of `config` know of it."""
    plant, numbers = config.plant, plant_parameters(config.plant, config.attitude)
    lifted = numbers.known_mass + numbers.load_share * plant.object_mass
    (x, y), kp, count = numbers.mounts[plant.leader, :2], numbers.gains.kp[:2], plant.count
    angles, hover = mount_frames(plant), plant.gravity * lifted / 4
    held = np.append(np.array([-y, x]) * lifted[plant.leader] / count / kp, 0.0)
    held = np.broadcast_to(held, (*np.shape(angles), 3))
    followers = list(plant.followers) if len(plant.followers) > 1 else plant.followers[0]
    most = (2 * numbers.arm * np.minimum(hover, numbers.rotor_force_max - hover))[followers]  # [N m]
    along, across = np.cos(angles) ** 2, np.sin(angles) ** 2
    room = joined([most / (along * kp[0] + across * kp[1]), most / (along * kp[1] + across * kp[0])])
    lever = rotations.turned_about_z(held, -angles)[..., :2]
    return TeamModel(count / (count - 1), lever, np.maximum(room, LEAST_ROOM))


class TeamOffsetFree:
    """The law as the followers of a team; it is not told the object's mass. Its state (..., 13) is the filters'."""

    name = NAME
    needs_privileged = False

    def __init__(self, config: Config):
        self.design, self.team, self._leader = design(config), team_model(config), copy_gains(config)

    def start(self, observation: Array) -> Array:
        """See `Law.start`."""
        roll, pitch, roll_rate, pitch_rate, climb = _measured(observation)
        zero = observation.__array_namespace__().zeros_like(roll)
        rest = [zero, zero, zero]
        return joined([roll, roll_rate, *rest, pitch, pitch_rate, *rest, climb, zero, zero])

    def estimate(self, state: Array, observation: Array) -> tuple[Array, Array]:
        """State about roll and pitch (..., 2, 5) and of the height (..., 3) at `observation`."""
        xp, own = observation.__array_namespace__(), self.design
        gain, rising = (xp.asarray(part, dtype=observation.dtype) for part in (own.axis_gain, own.height_gain))
        parts, found = [], _measured(observation)
        for number in (0, 1):
            predicted = state[..., number * ANGLE_STATES : (number + 1) * ANGLE_STATES]
            left = joined([found[number] - predicted[..., 0], found[2 + number] - predicted[..., 1]])
            parts.append(predicted + matmul(left, gain.T))
        predicted = state[..., 2 * ANGLE_STATES :]
        return joined(parts, axis=-2), predicted + (found[4] - predicted[..., 0])[..., None] * rising

    def step(self, state: Array, observation: Array, privileged: PrivilegedInfo) -> tuple[Array, Array]:
        """See `Law.step`."""
        xp, dtype = observation.__array_namespace__(), observation.dtype
        turning, rising = self.estimate(state, observation)
        led, ratio = copy_command(observation, *self._leader), self.team.ratio
        own = self._command(turning, rising, led, observation)
        mean = (own + (ratio - 1.0) * led) / ratio
        drive = mean[..., :2] + xp.asarray(self.team.lever, dtype=dtype) * (own - led)[..., 2:]
        axis, height = (xp.asarray(part, dtype=dtype).T for part in (self.design.axis, self.design.height))
        angles = [matmul(xp.concat([turning[..., k, :], drive[..., k : k + 1]], axis=-1), axis) for k in (0, 1)]
        climbing = matmul(xp.concat([rising, mean[..., 2:]], axis=-1), height)
        return xp.concat([*angles, climbing], axis=-1), clip_command(own, *self._leader[-2:])

    def _command(self, turning: Array, rising: Array, led: Array, observation: Array) -> Array:
        """The command (..., 3) for these estimates, only its vertical part clipped; the leader's is `led`."""
        xp, dtype, own = observation.__array_namespace__(), observation.dtype, self.design
        ratio, vertical_limit = self.team.ratio, self._leader[-1]
        lever, room = (xp.asarray(part, dtype=dtype) for part in (self.team.lever, self.team.room))
        error, rate = observation[..., ERROR], observation[..., ERROR_RATE]
        k_error, k_velocity = (float(gain) for gain in own.rise)
        rise = clipped(k_error * error[..., 2] + k_velocity * rate[..., 2], -VERTICAL_LIMIT, VERTICAL_LIMIT)
        vertical = ratio * (rise - rising[..., 2]) - (ratio - 1.0) * led[..., 2]
        vertical = clipped(vertical, -vertical_limit, vertical_limit)
        k_error, k_velocity, k_angle, k_rate = (float(gain) for gain in own.tilt)
        far = k_error * error + k_velocity * rate
        far = _within(xp, joined([-far[..., 1], far[..., 0]]), TUNING.tilt_limit)
        load = turning[..., 2] / own.stiffness + lever * (vertical - led[..., 2])[..., None]
        wanted = far - k_angle * observation[..., 3:5] - k_rate * observation[..., 9:11]
        wanted = wanted - _within(xp, load, CORRECTION_LIMIT)
        rest = observation[..., 3:5] + own.damping * observation[..., 9:11]
        tilts = ratio * wanted - (ratio - 1.0) * led[..., :2]
        tilts = rest + room * _within(xp, (tilts - rest) / room, 1.0)
        return xp.concat([tilts, vertical[..., None]], axis=-1)


def _measured(observation: Array) -> list[Array]:
    """Roll, pitch, their rates, climb."""
    return [*(observation[..., k] for k in (3, 4, 9, 10)), -observation[..., ERROR_RATE.stop - 1]]


def _within(xp: Any, vector: Array, limit: float) -> Array:
    """`vector` (..., 2) no longer than `limit`, in every mount frame alike."""
    return vector * (limit / xp.maximum(xp.sqrt((vector * vector).sum(axis=-1, keepdims=True) + 1e-12), limit))
