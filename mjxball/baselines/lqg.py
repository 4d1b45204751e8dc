"""LQG for plants with ideal loops: the followers take over the loop by LQR and Kalman filters for what disturbs (ours).

The assembly follows the sum of all drones' commands. The followers therefore command what N drones should do less the
leader's command, which they compute from what they see, each its part.
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

CORRECTION_LIMIT = 0.6  # of all followers' roll and pitch against the load's torque [rad]
LIMITS = (1.0, 0.6)  # of a command, about an axis that the load turns and about another [rad]
# QUICK reproduces an independent simulation; with delayed commands it limit-cycles. SLOW settles earliest under noise
# and 40 ms of delay among the sets that settle in every case (docs/archive/training.md).
QUICK = Tuning(position=0.25, velocity=1.0, height=0.25, climb=1.0, torque_walk=9.0, tilt_limit=0.25)
SLOW = Tuning(position=0.15, velocity=0.6, height=0.15, climb=0.6, torque_walk=0.003)
OFFSET_FREE = Tuning(position=0.2, velocity=0.6, height=0.2, climb=0.6, torque_walk=0.003, lift_walk=0.01)


class Takeover:
    """What `lqg` and `memoryless` share: everything but how the load's torque d is found."""

    needs_privileged = False
    name = ""
    tuning = QUICK
    limits: tuple[float, float] | None = LIMITS  # None: those of the leader

    def __init__(self, config: Config):
        self._law = copy_gains(config)
        self._model = model = ideal_model(config, self.name)
        self._gains = position_gains(model, self.tuning)
        self._far = np.array([self.tuning.tilt_limit, self.tuning.tilt_limit, self.tuning.lift_limit])
        turned, other = self.limits or (config.command.tilt_limit,) * 2
        tilts = [turned if axis in model.axes else other for axis in (0, 1)]
        self._largest = CORRECTION_LIMIT * model.followers * np.array(model.kp)
        self._limits = np.array([*tilts, config.command.vertical_limit])

    def _desired(self, observation: Array) -> Array:
        """What the assembly should do: roll, pitch, vertical acceleration (..., 3)."""
        xp, (far, back) = observation.__array_namespace__(), (times(gains, observation) for gains in self._gains)
        limit = xp.asarray(self._far, dtype=far.dtype)
        return xp.clip(far, -limit, limit) + back

    def _plan(
        self, observation: Array, desired: Array, torque: Array, lift: Array, privileged: PrivilegedInfo
    ) -> tuple[Array, Array]:
        """Commands (..., F, 3) for `desired` (..., 3) against a `torque` (..., A) [N m] and a `lift` (...) [m/s2].

        Beside them what the commands of all ask for (..., 3), as the u of `motion`.

        The followers lift alike. On top each gives its share of the torque that the assembly wants and the leader does
        not give: its N attitude loops at `desired`, against the load and against thrusts that are uneven.
        """
        xp, model, count = observation.__array_namespace__(), self._model, len(self._model.own_mass)
        kp, kd, limits, most = (
            xp.asarray(part, dtype=observation.dtype) for part in (model.kp, model.kd, self._limits, self._largest)
        )
        thrust = self._thrust(privileged)
        carried = model.carried(self._believed(observation, privileged))
        given = xp.ones_like(carried) if thrust is None else thrust
        lifting, level = given * carried, xp.cos(observation[..., 3]) * xp.cos(observation[..., 4])
        led, first = copy_command(observation, *self._law), given[..., model.leader, None]

        left = self._weighing(carried, privileged) * (model.gravity + desired[..., 2] - lift)
        left = left - lifting[..., model.leader] * (model.gravity + led[..., 2])
        alike = xp.clip(left / model.of_followers(lifting).sum(axis=-1) - model.gravity, -limits[2], limits[2])
        # Where the rotors of a drone that is commanded there give no torque.
        rest = observation[..., 3:5] + kd / kp * observation[..., 9:11]
        base = xp.concat([rest, alike[..., None]], axis=-1)[..., None, :]
        base = xp.broadcast_to(base, (*base.shape[:-2], model.followers, 3))
        turns = self._lever_torque(led, base, lifting, level)[..., model.turned] + torque
        wanted = kp * (count * (desired[..., :2] - rest) - first * (led[..., :2] - rest))
        wanted = wanted - xp.clip(model.on_axes(turns), -most, most)
        wrench = xp.concat([0.0 * wanted[..., :1], wanted], axis=-1)
        followed = self._limited(base, base + model.corrections(wrench, carried, thrust), carried, limits)

        angles = first * led[..., :2] + (model.of_followers(given)[..., None] * followed[..., :2]).sum(axis=-2)
        # The filter knows N loops; what drones do not give of theirs is taken off.
        commanded = kp * (angles + (count - given.sum(axis=-1))[..., None] * rest)
        turning = commanded + self._lever_torque(led, followed, lifting, level)
        mean = (led[..., 2] + followed[..., 2].sum(axis=-1)) / count
        return followed, xp.concat([turning, mean[..., None]], axis=-1)

    def _believed(self, observation: Array, privileged: PrivilegedInfo) -> Array:
        """Mass (...) of the object that each drone takes its share of [kg]."""
        return self._model.of_flight(privileged.believed_mass)

    def _thrust(self, privileged: PrivilegedInfo) -> Array | None:
        """What drones give of what they are asked for (..., N), if that is known."""
        return None

    def _limited(self, base: Array, followed: Array, carried: Array, limits: Array) -> Array:
        """Commands `followed` (..., F, 3) within what may be sent; at `base` (..., F, 3) rotors only lift."""
        return followed.__array_namespace__().clip(followed, -limits, limits)

    def _weighing(self, carried: Array, privileged: PrivilegedInfo) -> Array:
        """Mass (...) that all drones lift, as far as it is known, of what each believes to carry (..., N) [kg]."""
        return carried.sum(axis=-1)

    def _in_order(self, led: Array, followed: Array) -> Array:
        """Commands of all drones (..., N, 3)."""
        place = self._model.leader
        parts = [followed[..., :place, :], led[..., None, :], followed[..., place:, :]]
        return led.__array_namespace__().concat(parts, axis=-2)

    def _lever_torque(self, led: Array, followed: Array, lifting: Array, level: Array) -> Array:
        """(..., 2) roll and pitch torque about O of all thrusts less the drones' own weight."""
        xp, model = led.__array_namespace__(), self._model
        own = xp.asarray(model.own_mass, dtype=led.dtype) * model.gravity
        asked = model.gravity + self._in_order(led, followed)[..., 2]
        return model.lever_torque(lifting * asked / level[..., None] - own)


class Memoryless(Takeover):
    """d from the balance of torques at standstill: N Kp (theta - theta*) + N Kd q."""

    name = "memoryless"

    def start(self, observation: Array) -> Any:
        """See `Law.start`."""
        return ()

    def step(self, state: Any, observation: Array, privileged: PrivilegedInfo) -> tuple[Any, Array]:
        """See `Law.step`."""
        xp, model = observation.__array_namespace__(), self._model
        observation = model.seen(observation)
        desired = self._desired(observation)
        kp, kd = (xp.asarray(gain, dtype=observation.dtype) for gain in (model.kp, model.kd))
        torque = kp * (observation[..., 3:5] - desired[..., :2]) + kd * observation[..., 9:11]
        torque = len(model.own_mass) * torque[..., model.turned]
        followed, _ = self._plan(observation, desired, torque, 0.0, privileged)
        return state, model.sent(followed)


class Lqg(Takeover):
    """d from a steady-state Kalman filter on angle, rate, d, d' and the rotors' torque about each of the load's axes.

    With a `lift_walk` the filter also finds the vertical acceleration that nobody commanded, as of a mass that is not
    the believed one. The state (..., n) is the filter's.
    """

    name = "lqg"
    scaled = False  # a load's torque is expected to wander as much as that of the pair, whatever the inertia is

    def __init__(self, config: Config):
        super().__init__(config)
        model = self._model
        roll, pitch = (inertia / PAIR_INERTIA if self.scaled else 1.0 for inertia in model.inertia)
        found = disturbance_filter(model, model.axes, self.tuning, noise(), (roll, pitch))
        self._filter, self._shown = found

    def start(self, observation: Array) -> Array:
        """See `Law.start`."""
        return self._filter.start(times(self._shown, self._model.seen(observation)))

    def estimate(self, state: Array, observation: Array) -> tuple[Array, Array, Array]:
        """(the filter's state (..., n), torque of the load (..., A) [N m], error of the lift (...) [m/s2])."""
        x, turns = self._filter.corrected(state, times(self._shown, observation)), 5 * len(self._model.axes)
        return x, x[..., 3:turns:5], x[..., -1] if self.tuning.lift_walk > 0.0 else 0.0

    def step(self, state: Array, observation: Array, privileged: PrivilegedInfo) -> tuple[Array, Array]:
        """See `Law.step`."""
        observation = self._model.seen(observation)
        x, torque, lift = self.estimate(state, observation)
        followed, given = self._plan(observation, self._desired(observation), torque, lift, privileged)
        return self._filter.moved(x, given), self._model.sent(followed)


class SlowLqg(Lqg):
    """The same with a filter that is slow enough for noise and late commands."""

    name = "lqg-slow"
    tuning = SLOW


class OffsetFree(Lqg):
    """`lqg` for a pair whose mass nobody knows; it is not told what mass is believed, and keeps the leader's limits."""

    name = "lqg-offset-free"
    tuning = OFFSET_FREE
    limits = None

    def __init__(self, config: Config):
        pair_model(config, self.name)
        super().__init__(config)
        self._mass = config.plant.object_mass

    def start(self, observation: Array) -> Array:
        """See `Law.start`; the filter begins a period late."""
        found = super().start(observation)
        return self._filter.moved(found, 0.0 * observation[..., :3])

    def _believed(self, observation: Array, privileged: PrivilegedInfo) -> Array:
        return self._mass + 0.0 * observation[..., 0]


class KnownFailuresLqg(Lqg):
    """`lqg` that also knows what every drone gives of its thrust: which have failed, and when."""

    name = "lqg-known-failures"
    needs_privileged = True

    def _thrust(self, privileged: PrivilegedInfo) -> Array | None:
        return None if privileged.thrust is None else self._model.of_flight(privileged.thrust, axes=1)


class KnownRigLqg(KnownFailuresLqg):
    """`lqg` that knows everything of its rig but where the CG is: `config` is the rig's, the true mass included.

    The load's torque is expected to wander in proportion to the assembly's inertia, so that one tuning serves rigs of
    all sizes, and no command asks rotors for more torque than they have.
    """

    name = "lqg-known-rig"
    scaled = True

    def __init__(self, config: Config):
        super().__init__(config)
        numbers, followers = plant_parameters(config.plant, config.attitude), list(config.plant.followers)
        self._rotors = numbers.arm[followers], numbers.rotor_force_max[followers]

    def _weighing(self, carried: Array, privileged: PrivilegedInfo) -> Array:
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
    """The same with the tuning of `lqg-slow`."""

    name = "lqg-slow-known-rig"
    tuning = SLOW
