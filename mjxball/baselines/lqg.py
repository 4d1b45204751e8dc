"""LQG for plants with ideal attitude loops: LQR on the motion, Kalman filters for the disturbances (ours).

The assembly follows the sum of all drones' commands. The followers therefore command what N drones should do minus the
leader's command, which they compute from their observation, in equal shares.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from mjxball.arrays import Array
from mjxball.baselines.assembly_model import ideal_model, pair_model
from mjxball.baselines.linear import times
from mjxball.baselines.motion import PAIR_INERTIA, Tuning, disturbance_filter, noise, position_gains
from mjxball.config import Config
from mjxball.control.followers import PrivilegedInfo, copy_gains
from mjxball.control.observation import copy_command
from mjxball.plant import plant_parameters

CORRECTION_LIMIT = 0.6  # of each follower's roll and pitch against the load's torque [rad]
LIMITS = (1.0, 0.6)  # of a command about an axis with a load torque and about another [rad]
# QUICK reproduces an independent simulation; with delayed commands it limit-cycles. SLOW settles earliest under noise
# and 40 ms of delay among those that settle in every flight.
QUICK = Tuning(position=0.25, velocity=1.0, height=0.25, climb=1.0, torque_walk=9.0, tilt_limit=0.25)
SLOW = Tuning(position=0.15, velocity=0.6, height=0.15, climb=0.6, torque_walk=0.003)
OFFSET_FREE = Tuning(position=0.2, velocity=0.6, height=0.2, climb=0.6, torque_walk=0.003, lift_walk=0.01)


class LqrFollower:
    """Base of `lqg` and `memoryless`, which differ in how they estimate the load's torque d."""

    needs_privileged = False
    name = ""
    tuning = QUICK
    limits: tuple[float, float] | None = LIMITS  # None: the leader's

    def __init__(self, config: Config):
        self._leader_gains = copy_gains(config)
        self._model = model = ideal_model(config, self.name)
        self._gains = position_gains(model, self.tuning)
        self._position_limits = np.array([self.tuning.tilt_limit, self.tuning.tilt_limit, self.tuning.lift_limit])
        turned, other = self.limits or (config.command.tilt_limit,) * 2
        tilts = [turned if axis in model.axes else other for axis in (0, 1)]
        self._torque_limits = CORRECTION_LIMIT * model.followers * np.array(model.kp)
        self._limits = np.array([*tilts, config.command.vertical_limit])

    def _desired(self, observation: Array) -> Array:
        """Desired roll, pitch and vertical acceleration (..., 3) of the assembly."""
        xp, (far, back) = observation.__array_namespace__(), (times(gains, observation) for gains in self._gains)
        limit = xp.asarray(self._position_limits, dtype=far.dtype)
        return xp.clip(far, -limit, limit) + back

    def _plan(
        self, observation: Array, desired: Array, torque: Array, lift: Array, privileged: PrivilegedInfo
    ) -> tuple[Array, Array]:
        """Commands (..., F, 3) for `desired` (..., 3) against a `torque` (..., A) [N m] and a `lift` (...) [m/s2].

        Also the sum of what all commands ask for (..., 3), which is u of `motion`.

        All followers lift alike. Each adds its share of the torque that the assembly needs and the leader does not
        give: N attitude loops at `desired`, against the load and against unequal thrusts.
        """
        xp, model, count = observation.__array_namespace__(), self._model, len(self._model.own_mass)
        kp, kd, limits, torque_limits = (
            xp.asarray(part, dtype=observation.dtype)
            for part in (model.kp, model.kd, self._limits, self._torque_limits)
        )
        thrust = self._thrust(privileged)
        carried = model.carried(self._believed(observation, privileged))
        factor = xp.ones_like(carried) if thrust is None else thrust
        lifting, level = factor * carried, xp.cos(observation[..., 3]) * xp.cos(observation[..., 4])
        led, leader_factor = copy_command(observation, *self._leader_gains), factor[..., model.leader, None]

        left = self._lifted_mass(carried, privileged) * (model.gravity + desired[..., 2] - lift)
        left = left - lifting[..., model.leader] * (model.gravity + led[..., 2])
        vertical = xp.clip(left / model.of_followers(lifting).sum(axis=-1) - model.gravity, -limits[2], limits[2])
        # The tilt command at which a drone's attitude loop asks for no torque.
        rest = observation[..., 3:5] + kd / kp * observation[..., 9:11]
        base = xp.concat([rest, vertical[..., None]], axis=-1)[..., None, :]
        base = xp.broadcast_to(base, (*base.shape[:-2], model.followers, 3))
        turns = self._lever_torque(led, base, lifting, level)[..., model.turned] + torque
        torque_left = kp * (count * (desired[..., :2] - rest) - leader_factor * (led[..., :2] - rest))
        torque_left = torque_left - xp.clip(model.on_axes(turns), -torque_limits, torque_limits)
        wrench = xp.concat([0.0 * torque_left[..., :1], torque_left], axis=-1)
        followed = self._limited(base, base + model.corrections(wrench, carried, thrust), carried, limits)

        angles = leader_factor * led[..., :2] + (model.of_followers(factor)[..., None] * followed[..., :2]).sum(axis=-2)
        # The filter's model has N loops at full thrust; the torque that weak drones do not give is subtracted.
        commanded = kp * (angles + (count - factor.sum(axis=-1))[..., None] * rest)
        turning = commanded + self._lever_torque(led, followed, lifting, level)
        mean = (led[..., 2] + followed[..., 2].sum(axis=-1)) / count
        return followed, xp.concat([turning, mean[..., None]], axis=-1)

    def _believed(self, observation: Array, privileged: PrivilegedInfo) -> Array:
        """Believed mass (...) of the object, shared by all drones [kg]."""
        return self._model.of_flight(privileged.believed_mass)

    def _thrust(self, privileged: PrivilegedInfo) -> Array | None:
        """Factors (..., N) on the drones' thrust, or None if they are unknown."""
        return None

    def _limited(self, base: Array, followed: Array, carried: Array, limits: Array) -> Array:
        """Commands `followed` (..., F, 3) clipped to the limits; at `base` (..., F, 3) rotors give no torque."""
        return followed.__array_namespace__().clip(followed, -limits, limits)

    def _lifted_mass(self, carried: Array, privileged: PrivilegedInfo) -> Array:
        """Mass (...) that all drones lift [kg]: here the sum of those that each assumes, `carried` (..., N)."""
        return carried.sum(axis=-1)

    def _all_commands(self, led: Array, followed: Array) -> Array:
        """Commands of all drones (..., N, 3)."""
        place = self._model.leader
        parts = [followed[..., :place, :], led[..., None, :], followed[..., place:, :]]
        return led.__array_namespace__().concat(parts, axis=-2)

    def _lever_torque(self, led: Array, followed: Array, lifting: Array, level: Array) -> Array:
        """Roll and pitch torque (..., 2) about O of all thrusts minus the weights of the drones."""
        xp, model = led.__array_namespace__(), self._model
        own = xp.asarray(model.own_mass, dtype=led.dtype) * model.gravity
        asked = model.gravity + self._all_commands(led, followed)[..., 2]
        return model.lever_torque(lifting * asked / level[..., None] - own)


class Memoryless(LqrFollower):
    """d from the torque balance at standstill: N Kp (theta - theta*) + N Kd q."""

    name = "memoryless"

    def start(self, observation: Array) -> Any:
        """See `Controller.start`."""
        return ()

    def step(self, state: Any, observation: Array, privileged: PrivilegedInfo) -> tuple[Any, Array]:
        """See `Controller.step`."""
        xp, model = observation.__array_namespace__(), self._model
        observation = model.seen(observation)
        desired = self._desired(observation)
        kp, kd = (xp.asarray(gain, dtype=observation.dtype) for gain in (model.kp, model.kd))
        torque = kp * (observation[..., 3:5] - desired[..., :2]) + kd * observation[..., 9:11]
        torque = len(model.own_mass) * torque[..., model.turned]
        followed, _ = self._plan(observation, desired, torque, 0.0, privileged)
        return state, model.sent(followed)


class Lqg(LqrFollower):
    """d from a steady-state Kalman filter on angle, rate, d, d' and the rotors' torque about each of the load's axes.

    With a `lift_walk` the filter also estimates an uncommanded vertical acceleration, as from an error of the mass. The
    state (..., n) is the filter's.
    """

    name = "lqg"
    scaled = False  # whether the process noise of the load's torque scales with the inertia

    def __init__(self, config: Config):
        super().__init__(config)
        model = self._model
        roll, pitch = (inertia / PAIR_INERTIA if self.scaled else 1.0 for inertia in model.inertia)
        found = disturbance_filter(model, model.axes, self.tuning, noise(), (roll, pitch))
        self._filter, self._measurement = found

    def start(self, observation: Array) -> Array:
        """See `Controller.start`."""
        return self._filter.start(times(self._measurement, self._model.seen(observation)))

    def estimate(self, state: Array, observation: Array) -> tuple[Array, Array, Array]:
        """(the filter's state (..., n), load torque (..., A) [N m], error of the lift (...) [m/s2])."""
        x, turns = self._filter.corrected(state, times(self._measurement, observation)), 5 * len(self._model.axes)
        return x, x[..., 3:turns:5], x[..., -1] if self.tuning.lift_walk > 0.0 else 0.0

    def step(self, state: Array, observation: Array, privileged: PrivilegedInfo) -> tuple[Array, Array]:
        """See `Controller.step`."""
        observation = self._model.seen(observation)
        x, torque, lift = self.estimate(state, observation)
        followed, given = self._plan(observation, self._desired(observation), torque, lift, privileged)
        return self._filter.moved(x, given), self._model.sent(followed)


class SlowLqg(Lqg):
    """`lqg` with a slower filter, for noise and delay."""

    name = "lqg-slow"
    tuning = SLOW


class OffsetFree(Lqg):
    """`lqg` for a pair of unknown object mass: it ignores the believed mass and keeps the leader's limits."""

    name = "lqg-offset-free"
    tuning = OFFSET_FREE
    limits = None

    def __init__(self, config: Config):
        pair_model(config, self.name)
        super().__init__(config)
        self._mass = config.plant.object_mass

    def start(self, observation: Array) -> Array:
        """See `Controller.start`; the filter starts one period late."""
        found = super().start(observation)
        return self._filter.moved(found, 0.0 * observation[..., :3])

    def _believed(self, observation: Array, privileged: PrivilegedInfo) -> Array:
        return self._mass + 0.0 * observation[..., 0]


class KnownFailuresLqg(Lqg):
    """`lqg` that also knows the factor on every drone's thrust, and so which have failed."""

    name = "lqg-known-failures"
    needs_privileged = True

    def _thrust(self, privileged: PrivilegedInfo) -> Array | None:
        return None if privileged.thrust is None else self._model.of_flight(privileged.thrust, axes=1)


class KnownRigLqg(KnownFailuresLqg):
    """`lqg` that knows its rig and the true mass, which `config` has, but not where the CG is.

    The process noise of the load's torque scales with the assembly's inertia, so that one tuning serves rigs of all
    sizes. No command asks rotors for more torque than they have.
    """

    name = "lqg-known-rig"
    scaled = True

    def __init__(self, config: Config):
        super().__init__(config)
        parameters, followers = plant_parameters(config.plant, config.attitude), list(config.plant.followers)
        self._rotors = parameters.arm[followers], parameters.rotor_force_max[followers]

    def _lifted_mass(self, carried: Array, privileged: PrivilegedInfo) -> Array:
        return self._model.of_flight(privileged.total_mass)

    def _limited(self, base: Array, followed: Array, carried: Array, limits: Array) -> Array:
        xp = followed.__array_namespace__()
        kp, arm, most = (xp.asarray(part, dtype=followed.dtype) for part in (self._model.kp, *self._rotors))
        hover = self._model.of_followers(carried) * (self._model.gravity + followed[..., 2]) / 4
        room = 2 * arm * xp.maximum(xp.minimum(hover, most - hover), 0.1 * most)
        reach = 0.95 * room[..., None] / kp
        tilts = base[..., :2] + xp.clip(followed[..., :2] - base[..., :2], -reach, reach)
        return xp.clip(xp.concat([tilts, followed[..., 2:]], axis=-1), -limits, limits)


class SlowKnownRigLqg(KnownRigLqg):
    """`lqg-known-rig` with the tuning of `lqg-slow`."""

    name = "lqg-slow-known-rig"
    tuning = SLOW
