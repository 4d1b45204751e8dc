"""LQG for plants with ideal loops: the followers take over the loop by LQR and Kalman filters for what disturbs (ours).

The assembly follows the sum of all drones' commands. The followers therefore command what N drones should do less the
leader's command, which they compute from what they see, each its part.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from mjxball.arrays import Array
from mjxball.baselines.assembly_model import ideal_model
from mjxball.baselines.lqg_design import SLOW, Filter, Tuning, feedback, filtered, kalman
from mjxball.config import Config
from mjxball.control.followers import PrivilegedInfo, copy_gains
from mjxball.control.observation import ERROR, ERROR_RATE, copy_command
from mjxball.plant import plant_parameters

VERTICAL_LIMIT = 2.0  # of the position and velocity part [m/s2]
CORRECTION_LIMIT = 0.6  # of all followers' roll and pitch against the load's torque [rad]
PAIR_INERTIA = 0.0644  # of the pair about pitch, for which the tunings below are [kg m2]
LIMITS = (1.0, 0.6)  # of a command, about an axis that the load turns and about another [rad]


class State(NamedTuple):
    """Estimates and what acts until the next step, body axes; A axes about which the load turns the assembly."""

    estimate: Array  # (..., A, 5) of each axis, see `Filter`
    torque: Array  # (..., A) that all drones command [N m]
    started: Array  # (...) 1 after the first step


class Plan(NamedTuple):
    """What all drones should do, body axes."""

    followed: Array  # (..., F, 3) the followers' commands
    torque: Array  # (..., 2) that the commands of all give about roll and pitch [N m]


class Takeover:
    """What `lqg` and `memoryless` share: everything but how the load's torque d is found."""

    needs_privileged = False
    name = ""
    tuning = Tuning()

    def __init__(self, config: Config):
        self._law = copy_gains(config)
        self._model = model = ideal_model(config, self.name)
        self._feedback = feedback(model, self.tuning)
        tilts = [LIMITS[0] if axis in model.axes else LIMITS[1] for axis in (0, 1)]
        self._largest = CORRECTION_LIMIT * model.followers * np.array(model.kp)
        self._limits = np.array([*tilts, config.command.vertical_limit])

    def _desired(self, observation: Array) -> Array:
        """What the assembly should do: roll, pitch, vertical acceleration (..., 3)."""
        xp = observation.__array_namespace__()
        ex, ey, ez = (observation[..., ERROR][..., k] for k in range(3))
        vx, vy, vz = (-observation[..., ERROR_RATE][..., k] for k in range(3))
        roll_angle, pitch_angle = observation[..., 3], observation[..., 4]
        roll_rate, pitch_rate = observation[..., 9], observation[..., 10]
        f = self._feedback
        limit = self.tuning.tilt_limit
        pitch = xp.clip(f.pitch[0] * ex - f.pitch[1] * vx, -limit, limit)
        pitch = pitch - f.pitch[2] * pitch_angle - f.pitch[3] * pitch_rate
        roll = xp.clip(f.roll[0] * ey - f.roll[1] * vy, -limit, limit)
        roll = roll - f.roll[2] * roll_angle - f.roll[3] * roll_rate
        vertical = xp.clip(f.height[0] * ez - f.height[1] * vz, -VERTICAL_LIMIT, VERTICAL_LIMIT)
        return xp.stack([roll, pitch, vertical], axis=-1)

    def _plan(self, observation: Array, desired: Array, torque: Array, privileged: PrivilegedInfo) -> Plan:
        """Commands for `desired` (..., 3) against the load's `torque` (..., A) [N m].

        The followers lift alike. On top each gives its share of the torque that the assembly wants and the leader does
        not give: its N attitude loops at `desired`, against the load and against thrusts that are uneven.
        """
        xp, model, count = observation.__array_namespace__(), self._model, len(self._model.own_mass)
        kp, kd, limits, most = (
            xp.asarray(part, dtype=observation.dtype) for part in (model.kp, model.kd, self._limits, self._largest)
        )
        thrust = self._thrust(privileged)
        carried = model.carried(model.of_flight(privileged.believed_mass))
        given = xp.ones_like(carried) if thrust is None else thrust
        lifting, level = given * carried, xp.cos(observation[..., 3]) * xp.cos(observation[..., 4])
        led, first = copy_command(observation, *self._law), given[..., model.leader, None]

        left = self._weighing(carried, privileged) * (model.gravity + desired[..., 2])
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
        return Plan(followed, commanded + self._lever_torque(led, followed, lifting, level))

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
        plan = self._plan(observation, desired, torque, privileged)
        return state, model.sent(plan.followed)


class Lqg(Takeover):
    """d from steady-state Kalman filters on angle, rate, d, d' and the rotors' torque about each of the load's axes."""

    name = "lqg"

    def __init__(self, config: Config):
        super().__init__(config)
        filters = [kalman(self._model, axis, self.tuning.torque_walk) for axis in self._model.axes]
        self._filter = Filter(*(np.stack(parts) for parts in zip(*filters, strict=True)))

    def start(self, observation: Array) -> State:
        """See `Law.start`."""
        xp, observation = observation.__array_namespace__(), self._model.seen(observation)
        theta, rate = (observation[..., part] for part in self._seen())
        zero = xp.zeros_like(theta)
        estimate = xp.stack([theta, rate, zero, zero, zero], axis=-1)
        return State(estimate, zero, xp.zeros_like(observation[..., 0]))

    def step(self, state: State, observation: Array, privileged: PrivilegedInfo) -> tuple[State, Array]:
        """See `Law.step`."""
        xp, model = observation.__array_namespace__(), self._model
        observation = model.seen(observation)
        measured = xp.stack([observation[..., part] for part in self._seen()], axis=-1)
        started = state.started[..., None, None]
        estimate = filtered(self._filter, state.estimate, state.torque, measured, started)
        plan = self._plan(observation, self._desired(observation), estimate[..., 2], privileged)
        moved = State(estimate, plan.torque[..., model.turned], xp.ones_like(state.started))
        return moved, model.sent(plan.followed)

    def _seen(self) -> tuple[slice, slice]:
        """Where an observation has the angles and rates about the load's axes."""
        axes = self._model.turned
        return slice(3 + axes.start, 3 + axes.stop), slice(9 + axes.start, 9 + axes.stop)


class SlowLqg(Lqg):
    """The same with a filter that is slow enough for noise and late commands."""

    name = "lqg-slow"
    tuning = SLOW


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

    def __init__(self, config: Config):
        super().__init__(config)
        model, walk = self._model, self.tuning.torque_walk
        scaled = [kalman(model, axis, walk * (model.inertia[axis] / PAIR_INERTIA) ** 2) for axis in model.axes]
        self._filter = Filter(*(np.stack(parts) for parts in zip(*scaled, strict=True)))
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
