"""Offset-free LQG of one follower of a team (ours).

Every follower runs it separately, in its mount frame. Torques are divided by the inertia [rad/s2]: closed attitude
loops follow the mean of all N commands in the same way for any rig, so the filter's parameters do not depend on it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjxball.arrays import Array
from mjxball.baselines.assembly_model import AssemblyModel, ideal_model
from mjxball.baselines.linear import times
from mjxball.baselines.lqg import CORRECTION_LIMIT, OffsetFree
from mjxball.baselines.motion import disturbance_filter, noise, position_gains
from mjxball.config import Config
from mjxball.control import rotations
from mjxball.control.followers import PrivilegedInfo, copy_gains
from mjxball.control.leader import clip_command
from mjxball.control.observation import copy_command, mount_frames
from mjxball.errors import InputError
from mjxball.plant import plant_parameters

# torque_walk is that of the load's torque over the inertia. Decays keep the followers' estimates from drifting apart.
TUNING = OffsetFree.tuning._replace(torque_walk=20.0, load_time=3.0, rate_time=0.3, lift_time=5.0)
NOISE = noise(angle=5e-3)
LEAST_ROOM = 1e-3  # [rad]


def unit_model(config: Config) -> AssemblyModel:
    """Model of the team of `config` over its inertia; InputError unless it is free with equal ideal loops."""
    model = ideal_model(config, OffsetFree.name)
    roll, pitch = model.natural_frequency
    if roll != pitch:
        raise InputError(f"follower {OffsetFree.name!r} needs attitude loops alike about roll and pitch in a team")
    stiffness, damping = roll**2 / config.plant.count, 2 * model.damping * roll / config.plant.count
    return model._replace(kp=(stiffness,) * 2, kd=(damping,) * 2, inertia=(1.0, 1.0))


class TeamModel(NamedTuple):
    """Knowledge of a follower about its team, in its mount frame; the axis F is absent for one follower."""

    ratio: float  # N / (N - 1)
    # (F, 2) roll and pitch commands of all drones that balance the torque of lifting 1 m/s2 more than the leader
    # [rad per m/s2]
    lever: Array
    # (F, 2) distance of roll and pitch commands from those without torque at which the follower's rotors saturate
    # [rad]
    room: Array


def team_model(config: Config) -> TeamModel:
    """`TeamModel` of the followers of the team of `config`."""
    plant, params = config.plant, plant_parameters(config.plant, config.attitude)
    lifted = params.known_mass + params.load_share * plant.object_mass
    (x, y), kp, count = params.mounts[plant.leader, :2], params.gains.kp[:2], plant.count
    angles, hover = mount_frames(plant), plant.gravity * lifted / 4
    held = np.append(np.array([-y, x]) * lifted[plant.leader] / count / kp, 0.0)
    held = np.broadcast_to(held, (*np.shape(angles), 3))
    followers = list(plant.followers) if len(plant.followers) > 1 else plant.followers[0]
    most = (2 * params.arm * np.minimum(hover, params.rotor_force_max - hover))[followers]  # [N m]
    along, across = np.cos(angles) ** 2, np.sin(angles) ** 2
    room = np.stack([most / (along * kp[0] + across * kp[1]), most / (along * kp[1] + across * kp[0])], axis=-1)
    lever = rotations.turned_about_z(held, -angles)[..., :2]
    return TeamModel(count / (count - 1), lever, np.maximum(room, LEAST_ROOM))


class TeamOffsetFree:
    """`lqg-offset-free` for the followers of a team of unknown object mass. Its state (..., 13) is the filter's."""

    name = OffsetFree.name
    needs_privileged = False

    def __init__(self, config: Config):
        model = unit_model(config)
        self.filter, self._measurement = disturbance_filter(model, (0, 1), TUNING, NOISE)
        self.gains, self.team, self._leader = position_gains(model, TUNING), team_model(config), copy_gains(config)
        self.stiffness, self._damping = config.plant.count * model.kp[0], model.kd[0] / model.kp[0]

    def start(self, observation: Array) -> Array:
        """See `Controller.start`."""
        return self.filter.start(times(self._measurement, observation))

    def estimate(self, state: Array, observation: Array) -> tuple[Array, Array, Array]:
        """(the filter's state (..., 13), load torque over inertia (..., 2) [rad/s2], error of lift (...) [m/s2])."""
        x = self.filter.corrected(state, times(self._measurement, observation))
        return x, x[..., 3:10:5], x[..., -1]

    def step(self, state: Array, observation: Array, privileged: PrivilegedInfo) -> tuple[Array, Array]:
        """See `Controller.step`."""
        xp, ratio = observation.__array_namespace__(), self.team.ratio
        x, load, lift = self.estimate(state, observation)
        led = copy_command(observation, *self._leader)
        own = self._command(load, lift, led, observation)
        mean = (own + (ratio - 1.0) * led) / ratio
        tilts = mean[..., :2] + xp.asarray(self.team.lever, dtype=x.dtype) * (own - led)[..., 2:]
        given = xp.concat([self.stiffness * tilts, mean[..., 2:]], axis=-1)
        return self.filter.moved(x, given), clip_command(own, *self._leader[-2:])

    def _command(self, load: Array, lift: Array, led: Array, observation: Array) -> Array:
        """Command (..., 3) for these estimates and the leader's command `led`; only the vertical part is clipped."""
        xp, ratio, limit = observation.__array_namespace__(), self.team.ratio, self._leader[-1]
        lever, room = (xp.asarray(part, dtype=led.dtype) for part in (self.team.lever, self.team.room))
        far, back = (times(gains, observation) for gains in self.gains)
        rise = xp.clip(far[..., 2], -TUNING.lift_limit, TUNING.lift_limit)
        vertical = xp.clip(ratio * (rise - lift) - (ratio - 1.0) * led[..., 2], -limit, limit)
        held = load / self.stiffness + lever * (vertical - led[..., 2])[..., None]
        desired = _within(far[..., :2], TUNING.tilt_limit) + back[..., :2] - _within(held, CORRECTION_LIMIT)
        rest = observation[..., 3:5] + self._damping * observation[..., 9:11]
        tilts = ratio * desired - (ratio - 1.0) * led[..., :2]
        tilts = rest + room * _within((tilts - rest) / room, 1.0)
        return xp.concat([tilts, vertical[..., None]], axis=-1)


def _within(vector: Array, limit: float) -> Array:
    """`vector` (..., 2) shortened to the length `limit`, which does not depend on the mount frame."""
    xp = vector.__array_namespace__()
    return vector * (limit / xp.maximum(xp.sqrt((vector * vector).sum(axis=-1, keepdims=True) + 1e-12), limit))
