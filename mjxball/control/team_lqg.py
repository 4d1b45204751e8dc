"""Offset-free LQG of one follower of a team: what a network with `follower.base = lqg` is added to there.

Every follower runs it for itself, in its mount frame. Closed attitude loops answer to the mean of all N commands alike
whatever the rig weighs, so that the filter's numbers do not depend on it: two equal ones about roll and pitch, with the
load's torque over the inertia, and one of the height. What a follower knows of its team is its context
(`team_context`). Needs NumPy alone: the numbers are made by `baselines.team_lqg` and stand in the policy file.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from mjxball.config import Plant
from mjxball.control import rotations
from mjxball.control.observation import ERROR, ERROR_RATE, copy_command, mount_frames
from mjxball.plant import PlantParameters
from mjxball.plant.parts import clipped, joined

Array = Any
ANGLE_STATES, HEIGHT_STATES, CONTEXT = 5, 3, 5
STATES = 2 * ANGLE_STATES + HEIGHT_STATES


class TeamLqg(NamedTuple):
    """Numbers of the law (ours).

    State of the filter about an axis: (angle [rad], rate [rad/s], load d [rad/s2], d', rotors' part [rad/s2]), driven
    by the mean command [rad]; of the height: (climb [m/s], lift [m/s2], lift error [m/s2]), driven by the mean vertical
    command. x <- A x + B u, then x <- x + K (y - C x) with angle and rate, or climb, measured. The commands that enter
    are the law's own, without what the network adds: its followers would each expect another sum of commands, and what
    they make of the difference would drift apart unseen.
    """

    axis: Array  # (A B) (5, 6)
    axis_gain: Array  # K (5, 2)
    height: Array  # (A B) (3, 4)
    height_gain: Array  # K (3,)
    tilt: Array  # (4,) feedback on (error, velocity, angle, rate) of pitch; that of roll mirrors it
    rise: Array  # (2,) feedback on the vertical (error, velocity)
    limits: Array  # (3,) of the error's part in a tilt [rad], of that in the height [m/s2], against the load [rad]
    stiffness: float  # natural frequency of the closed attitude loops, squared [1/s2]
    damping: float  # Kd over Kp of the attitude loops [s]
    lifting: float = 0.0  # share of the load's torque that followers hold by lifting apart, the rest by tilting

    @property
    def size(self) -> int:
        """Numbers in the memory: the state as it is predicted, and the context."""
        return STATES + CONTEXT

    @property
    def shown(self) -> int:
        """How many numbers `features` has."""
        return self.size

    def start(self, observation: Array, context: Array) -> Array:
        """Memory (..., 18) before the first `observation` (..., 18) of followers with `context` (..., 5).

        Context: N / (N - 1); the roll and pitch [rad per m/s2] that all drones would have to command to hold what
        lifting 1 m/s2 more than the leader does; how far a roll and a pitch command may be from where the follower's
        loop asks for no torque, before its rotors cannot follow [rad].
        """
        xp = observation.__array_namespace__()
        roll, pitch, roll_rate, pitch_rate, climb = measured(observation)
        zero = xp.zeros_like(roll)
        state = [roll, roll_rate, zero, zero, zero, pitch, pitch_rate, zero, zero, zero, climb, zero, zero]
        known = xp.broadcast_to(xp.asarray(context, dtype=observation.dtype), (*roll.shape, CONTEXT))
        return xp.concat([joined(state), known], axis=-1)

    def estimate(self, memory: Array, observation: Array) -> tuple[Array, Array]:
        """State about roll and pitch (..., 2, 5) and of the height (..., 3) at `observation`."""
        xp = observation.__array_namespace__()
        gain, rising = (xp.asarray(part, dtype=observation.dtype) for part in (self.axis_gain, self.height_gain))
        parts, found = [], measured(observation)
        for number in (0, 1):
            predicted = memory[..., number * ANGLE_STATES : (number + 1) * ANGLE_STATES]
            left = joined([found[number] - predicted[..., 0], found[2 + number] - predicted[..., 1]])
            parts.append(predicted + left @ gain.T)
        predicted = memory[..., 2 * ANGLE_STATES : STATES]
        turning = joined(parts, axis=-2)
        return turning, predicted + (found[4] - predicted[..., 0])[..., None] * rising

    def features(self, memory: Array, observation: Array) -> Array:
        """(..., 18) for a network: the measured less its estimate (5), the other estimates (8), the context (5)."""
        xp = observation.__array_namespace__()
        turning, rising = self.estimate(memory, observation)
        expected = [turning[..., 0, 0], turning[..., 1, 0], turning[..., 0, 1], turning[..., 1, 1], rising[..., 0]]
        left = [a - b for a, b in zip(measured(observation), expected, strict=True)]
        estimated = [turning[..., 0, 2:], turning[..., 1, 2:], rising[..., 1:], memory[..., STATES:]]
        return xp.concat([joined(left), *estimated], axis=-1)

    def command(self, added: Array, memory: Array, observation: Array, leader: tuple[Any, ...]) -> Array:
        """The law's command (..., 3), not yet clipped, with `added` (..., 3) to it.

        `leader`: the arguments of `copy_command` after the observation.
        """
        own, held = self._plan(memory, observation, leader)[:2]
        return (own if held is None else self._apart(own, held, memory)) + added

    def next(self, memory: Array, observation: Array, command: Array, leader: tuple[Any, ...]) -> Array:
        """Memory of the next step, after `observation` was answered; `command` is not read."""
        xp, dtype = observation.__array_namespace__(), observation.dtype
        own, held, turning, rising = self._plan(memory, observation, leader)
        led, share = copy_command(observation, *leader), memory[..., STATES : STATES + 1]
        mean = (own + (share - 1.0) * led) / share
        drive = mean[..., :2] + memory[..., STATES + 1 : STATES + 3] * (own - led)[..., 2:]
        drive = drive if held is None else drive - held
        axis, height = (xp.asarray(part, dtype=dtype).T for part in (self.axis, self.height))
        angles = [xp.concat([turning[..., k, :], drive[..., k : k + 1]], axis=-1) @ axis for k in (0, 1)]
        climbing = xp.concat([rising, mean[..., 2:]], axis=-1) @ height
        return xp.concat([*angles, climbing, memory[..., STATES:]], axis=-1)

    def _apart(self, own: Array, held: Array, memory: Array) -> Array:
        """`own` command (..., 3) and what this follower lifts more to hold `held` (..., 2), a command of all drones.

        On a ring of N drones lifts in proportion to their places give a torque with the least effort; F = N - 1
        followers without the leader, whose lifts are to sum to 0, have to give (N - 1) / (N - 3) about its axis.
        """
        xp = own.__array_namespace__()
        share, lever = memory[..., STATES : STATES + 1], memory[..., STATES + 1 : STATES + 3]
        length = xp.sqrt((lever * lever).sum(axis=-1, keepdims=True) + 1e-12)
        count = share / (share - 1.0)
        led = lever / length
        along = (led * held).sum(axis=-1, keepdims=True)
        torque = held[..., 1:] + led[..., 1:] * along * (2.0 / (count - 3.0))
        lifts = (torque - along / (count - 3.0)) * 2.0 / (count * length)
        return xp.concat([own[..., :2], own[..., 2:] - lifts], axis=-1)

    def _plan(
        self, memory: Array, observation: Array, leader: tuple[Any, ...]
    ) -> tuple[Array, Array | None, Array, Array]:
        """(the law's own command, only its vertical part clipped; what of the load is lifted apart; estimates)."""
        xp = observation.__array_namespace__()
        turning, rising = self.estimate(memory, observation)
        led, share = copy_command(observation, *leader), memory[..., STATES]
        lever, most = memory[..., STATES + 1 : STATES + 3], memory[..., STATES + 3 :]
        error, rate = observation[..., ERROR], observation[..., ERROR_RATE]
        tilt_limit, rise_limit, load_limit = (float(limit) for limit in self.limits)
        k_error, k_velocity = (float(gain) for gain in self.rise)
        rise = clipped(k_error * error[..., 2] + k_velocity * rate[..., 2], -rise_limit, rise_limit) - rising[..., 2]
        vertical = clipped(share * rise - (share - 1.0) * led[..., 2], -leader[-1], leader[-1])
        k_error, k_velocity, k_angle, k_rate = (float(gain) for gain in self.tilt)
        far = k_error * error + k_velocity * rate
        far = within(xp, joined([-far[..., 1], far[..., 0]]), tilt_limit)
        wanted = far - k_angle * observation[..., 3:5] - k_rate * observation[..., 9:11]
        load = turning[..., 2] / self.stiffness + lever * (vertical - led[..., 2])[..., None]
        load, held = within(xp, load, load_limit), None
        if self.lifting > 0:
            held = float(self.lifting) * load
            load = load - held
        wanted = wanted - load
        own = share[..., None] * wanted - (share - 1.0)[..., None] * led[..., :2]
        rest = observation[..., 3:5] + self.damping * observation[..., 9:11]
        own = rest + most * within(xp, (own - rest) / most, 1.0)
        return xp.concat([own, vertical[..., None]], axis=-1), held, turning, rising


def team_context(parameters: PlantParameters, plant: Plant, object_mass: Array) -> Array:
    """What every follower of a team that carries `object_mass` () [kg] knows of it, (..., F, 5) or of one (..., 5).

    See `TeamLqg.start`; in mount frames. `parameters` are those of teams like `plant`.
    """
    xp, lead = parameters.mounts.__array_namespace__(), plant.leader
    count = xp.astype((parameters.drone_mass > 0).sum(axis=-1), parameters.mounts.dtype)
    lifted = parameters.known_mass[..., lead] + parameters.share[..., lead] * object_mass
    x, y = parameters.mounts[..., lead, 0], parameters.mounts[..., lead, 1]
    per_command = joined([-y, x]) * (lifted / count)[..., None] / parameters.gains.kp[..., :2]
    hover = parameters.gravity * (parameters.known_mass + parameters.share * object_mass[..., None]) / 4
    room = 2 * parameters.arm * xp.minimum(hover, parameters.rotor_force_max - hover)  # [N m]
    several = len(plant.followers) > 1
    angles = mount_frames(plant, parameters.mounts)
    chosen = xp.asarray(plant.followers) if several else plant.followers[0]
    room, share, kp = room.take(chosen, axis=-1), count / (count - 1), parameters.gains.kp
    if several:
        share, kp = xp.broadcast_to(share[..., None], angles.shape), kp[..., None, :]
        per_command = xp.broadcast_to(per_command[..., None, :], (*angles.shape, 2))
    flat = xp.concat([per_command, xp.zeros_like(per_command[..., :1])], axis=-1)
    along, across = xp.cos(angles) ** 2, xp.sin(angles) ** 2
    most = [room / (along * kp[..., 0] + across * kp[..., 1]), room / (along * kp[..., 1] + across * kp[..., 0])]
    turned = rotations.turned_about_z(flat, -angles)[..., :2]
    return xp.concat([share[..., None], turned, xp.maximum(joined(most), 1e-3)], axis=-1)


def measured(observation: Array) -> list[Array]:
    """Roll, pitch, their rates, climb."""
    return [*(observation[..., k] for k in (3, 4, 9, 10)), -observation[..., ERROR_RATE.stop - 1]]


def within(xp: Any, vector: Array, limit: float) -> Array:
    """`vector` (..., 2) no longer than `limit`, in every mount frame alike."""
    return vector * (limit / xp.maximum(xp.sqrt((vector * vector).sum(axis=-1, keepdims=True) + 1e-12), limit))
