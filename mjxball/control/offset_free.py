"""Offset-free LQG: what a follower with `follower.base = lqg` adds its network's action to.

A steady-state Kalman filter on the follower's own measurements and commands estimates what the load does: its torque
about pitch, how fast that changes, and the vertical acceleration that nobody commanded, as of a mass that is not the
believed one. The law brings the pair to the goal by linear-quadratic regulators, cancels the leader's command, which
the follower computes from its own observation, and takes the estimates off. Needs NumPy alone: the numbers are made by
`baselines.offset_free` and stand in the policy file.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from mjxball.control.observation import ERROR, ERROR_RATE, copy_command
from mjxball.plant.parts import clipped, joined

Array = Any
STATES, DRIVES, MEASURED = 8, 2, 3


class OffsetFreeLqg(NamedTuple):
    """Numbers of the law (ours).

    The filter's state is (pitch [rad], its rate [rad/s], load torque d [N m], d' [N m/s], rotors' torque [N m], climb
    [m/s], lift [m/s2], lift error [m/s2]). It is driven by the torque that both commands ask for [N m] and the mean of
    both vertical commands [m/s2], and measures pitch, its rate and climb: x <- A x + B u, then x <- x + K (y - C x).
    """

    transition: Array  # (A B) (8, 10)
    gain: Array  # K (8, 3)
    tilt: Array  # (2, 4) feedback of roll and pitch on their axis' (error, velocity, angle, rate)
    height: Array  # (2,) feedback on the vertical (error, velocity)
    limits: Array  # (3,) of the error's part in a tilt [rad], of that in the height [m/s2], against the load [rad]
    stiffness: float  # Kp of one drone's attitude loop about pitch [N m/rad]
    half_length: float  # from O to each drone [m]
    carried: Array  # (2,) mass that leader and follower believe they lift [kg]

    @property
    def size(self) -> int:
        """Numbers in the memory."""
        return STATES + DRIVES

    @property
    def shown(self) -> int:
        """How many numbers `features` has."""
        return self.size

    def start(self, observation: Array) -> Array:
        """Memory (..., 10), state and drives, before the first `observation` (..., 18)."""
        xp = observation.__array_namespace__()
        pitch, rate, climb = _measured(observation)
        zero = xp.zeros_like(pitch)
        return joined([pitch, rate, zero, zero, zero, climb, zero, zero, zero, zero])

    def estimate(self, memory: Array, observation: Array) -> Array:
        """The filter's state (..., 8) at `observation`."""
        xp = observation.__array_namespace__()
        predicted = memory @ xp.asarray(self.transition.T, dtype=observation.dtype)
        expected = joined([predicted[..., 0], predicted[..., 1], predicted[..., 5]])
        measured = joined(_measured(observation))
        return predicted + (measured - expected) @ xp.asarray(self.gain.T, dtype=observation.dtype)

    def features(self, memory: Array, observation: Array) -> Array:
        """(..., 10) for a network: what was measured less its estimate (3), the other estimates (5), the drives (2)."""
        xp = observation.__array_namespace__()
        x = self.estimate(memory, observation)
        left = [value - x[..., place] for value, place in zip(_measured(observation), (0, 1, 5), strict=True)]
        found = [x[..., place] for place in (2, 3, 4, 6, 7)]
        return xp.concat([joined([*left, *found]), memory[..., STATES:]], axis=-1)

    def command(self, added: Array, memory: Array, observation: Array, leader: tuple[Any, ...]) -> Array:
        """The law's command (..., 3), not yet clipped, with `added` (..., 3) to it.

        `leader`: the arguments of `copy_command` after the observation. The vertical part is clipped: the pitch part
        takes the torque off that the drones' difference in thrust makes.
        """
        x, led = self.estimate(memory, observation), copy_command(observation, *leader)
        error, rate = observation[..., ERROR], observation[..., ERROR_RATE]
        tilt_limit, rise_limit, load_limit = (float(limit) for limit in self.limits)

        def tilt(axis: int, along: int) -> Array:
            k_error, k_velocity, k_angle, k_rate = (float(gain) for gain in self.tilt[axis])
            far = clipped(k_error * error[..., along] + k_velocity * rate[..., along], -tilt_limit, tilt_limit)
            return far - k_angle * observation[..., 3 + axis] - k_rate * observation[..., 9 + axis]

        k_error, k_velocity = (float(gain) for gain in self.height)
        rise = clipped(k_error * error[..., 2] + k_velocity * rate[..., 2], -rise_limit, rise_limit) - x[..., 7]
        vertical = clipped(2.0 * rise - led[..., 2] + added[..., 2], -leader[-1], leader[-1])
        difference = self._difference(led[..., 2], vertical, observation, leader)
        against = clipped((self.half_length * difference - x[..., 2]) / self.stiffness, -load_limit, load_limit)
        roll = 2.0 * tilt(0, 1) - led[..., 0] + added[..., 0]
        pitch = 2.0 * tilt(1, 0) - led[..., 1] + against + added[..., 1]
        return joined([roll, pitch, vertical])

    def next(self, memory: Array, observation: Array, command: Array, leader: tuple[Any, ...]) -> Array:
        """Memory of the next step, after `observation` was answered by `command` (..., 3)."""
        xp = observation.__array_namespace__()
        led = copy_command(observation, *leader)
        difference = self._difference(led[..., 2], command[..., 2], observation, leader)
        torque = self.stiffness * (led[..., 1] + command[..., 1]) - self.half_length * difference
        lift = 0.5 * (led[..., 2] + command[..., 2])
        return xp.concat([self.estimate(memory, observation), joined([torque, lift])], axis=-1)

    def _difference(self, led: Array, vertical: Array, observation: Array, leader: tuple[Any, ...]) -> Array:
        """The leader's thrust less the follower's (...) [N] at vertical commands (...)."""
        xp, gravity = observation.__array_namespace__(), leader[2]
        level = xp.cos(observation[..., 3]) * xp.cos(observation[..., 4])
        ahead, behind = (float(mass) for mass in self.carried)
        return (ahead * (gravity + led) - behind * (gravity + vertical)) / level


def _measured(observation: Array) -> list[Array]:
    """Pitch, its rate, climb."""
    return [observation[..., 4], observation[..., 10], -observation[..., ERROR_RATE.stop - 1]]
