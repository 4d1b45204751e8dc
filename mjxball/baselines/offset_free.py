"""Offset-free LQG of the paper's pair (ours).

A steady-state Kalman filter on the follower's own measurements and commands estimates what the load does: its torque
about pitch, how fast that changes, and the vertical acceleration that nobody commanded, as of a mass that is not the
believed one. The law brings the pair to the goal by linear-quadratic regulators, cancels the leader's command, which
the follower computes from its own observation, and takes the estimates off.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjxball.arrays import Array, clipped, joined, matmul
from mjxball.baselines.assembly_model import pair_model
from mjxball.baselines.lqg import CORRECTION_LIMIT, VERTICAL_LIMIT
from mjxball.baselines.lqg_design import CLIMB_NOISE, RATE_NOISE, THETA_NOISE, Tuning, feedback, steady_filter
from mjxball.config import Config
from mjxball.control.followers import PrivilegedInfo, copy_gains
from mjxball.control.leader import clip_command
from mjxball.control.observation import ERROR, ERROR_RATE, copy_command

NAME = "lqg-offset-free"
TUNING = Tuning(position=0.2, velocity=0.6, torque_walk=0.003, tilt_limit=0.3)
LIFT_WALK = 0.01  # intensity of the white noise that drives the lift error [(m/s2)2/s]
STATES, DRIVES = 8, 2


class Design(NamedTuple):
    """Numbers of the law.

    The filter's state is (pitch [rad], its rate [rad/s], load torque d [N m], d' [N m/s], rotors' torque [N m], climb
    [m/s], lift [m/s2], lift error [m/s2]). It is driven by the torque that both commands ask for [N m] and the mean of
    both vertical commands [m/s2], and measures pitch, its rate and climb: x <- A x + B u, then x <- x + K (y - C x).
    """

    transition: Array  # (A B) (8, 10)
    gain: Array  # K (8, 3)
    tilt: Array  # (2, 4) feedback of roll and pitch on their axis' (error, velocity, angle, rate)
    height: Array  # (2,) feedback on the vertical (error, velocity)
    tilt_limit: float  # of the error's part in a tilt [rad]
    stiffness: float  # Kp of one drone's attitude loop about pitch [N m/rad]
    half_length: float  # from O to each drone [m]
    carried: Array  # (2,) mass that leader and follower believe they lift [kg]


def design(config: Config) -> Design:
    """The law for the plant of `config`; InputError unless it is a free pair along x with ideal attitude loops."""
    pair = pair_model(config, NAME)
    kp, kd = pair.kp[1], pair.kd[1]
    a, b = np.zeros((STATES, STATES)), np.zeros((STATES, DRIVES))
    a[0, 1] = a[2, 3] = 1.0
    a[1, 2] = a[1, 4] = 1.0 / pair.inertia[1]
    a[4, :5] = np.array([-2.0 * kp, -2.0 * kd, 0.0, 0.0, -1.0]) / pair.lag
    a[5, 6] = a[5, 7] = 1.0
    a[6, 6] = -1.0 / pair.lag
    b[4, 0] = b[6, 1] = 1.0 / pair.lag
    walks, noise = {3: TUNING.torque_walk, 7: LIFT_WALK}, {0: THETA_NOISE, 1: RATE_NOISE, 5: CLIMB_NOISE}
    transition, drive, gain = steady_filter(a, b, pair.period, walks, noise)
    gains = feedback(pair, TUNING)
    return Design(
        transition=np.hstack([transition, drive]),
        gain=gain,
        tilt=np.array([gains.roll, gains.pitch]),
        height=np.array(gains.height),
        tilt_limit=TUNING.tilt_limit,
        stiffness=kp,
        half_length=0.5 * float(pair.mounts[0, 0] - pair.mounts[1, 0]),
        carried=pair.known_mass + pair.load_share * config.plant.object_mass,
    )


class OffsetFree:
    """The law as a follower; it is not told the object's mass. Its state (..., 10) is the filter's, and the drives."""

    name = NAME
    needs_privileged = False

    def __init__(self, config: Config):
        self.design = design(config)
        self._leader = copy_gains(config)

    def start(self, observation: Array) -> Array:
        """See `Law.start`."""
        pitch, rate, climb = _measured(observation)
        zero = observation.__array_namespace__().zeros_like(pitch)
        return joined([pitch, rate, zero, zero, zero, climb, zero, zero, zero, zero])

    def estimate(self, state: Array, observation: Array) -> Array:
        """The filter's state (..., 8) at `observation`."""
        xp = observation.__array_namespace__()
        predicted = matmul(state, xp.asarray(self.design.transition.T, dtype=observation.dtype))
        expected = joined([predicted[..., 0], predicted[..., 1], predicted[..., 5]])
        left = joined(_measured(observation)) - expected
        return predicted + matmul(left, xp.asarray(self.design.gain.T, dtype=observation.dtype))

    def step(self, state: Array, observation: Array, privileged: PrivilegedInfo) -> tuple[Array, Array]:
        """See `Law.step`.

        The vertical part of the command is clipped first: the pitch part takes the torque off that the drones'
        difference in thrust makes.
        """
        xp, own, leader = observation.__array_namespace__(), self.design, self._leader
        x, led = self.estimate(state, observation), copy_command(observation, *leader)
        k_error, k_velocity = (float(gain) for gain in own.height)
        rise = k_error * observation[..., ERROR][..., 2] + k_velocity * observation[..., ERROR_RATE][..., 2]
        rise = clipped(rise, -VERTICAL_LIMIT, VERTICAL_LIMIT) - x[..., 7]
        vertical = clipped(2.0 * rise - led[..., 2], -leader[-1], leader[-1])
        uneven = own.half_length * self._difference(led[..., 2], vertical, observation)
        against = clipped((uneven - x[..., 2]) / own.stiffness, -CORRECTION_LIMIT, CORRECTION_LIMIT)
        roll = 2.0 * self._tilt(0, 1, observation) - led[..., 0]
        pitch = 2.0 * self._tilt(1, 0, observation) - led[..., 1] + against
        command = clip_command(joined([roll, pitch, vertical]), *leader[-2:])
        torque = own.stiffness * (led[..., 1] + command[..., 1]) - uneven
        return xp.concat([x, joined([torque, 0.5 * (led[..., 2] + command[..., 2])])], axis=-1), command

    def _tilt(self, axis: int, along: int, observation: Array) -> Array:
        k_error, k_velocity, k_angle, k_rate = (float(gain) for gain in self.design.tilt[axis])
        limit, error, rate = self.design.tilt_limit, observation[..., ERROR], observation[..., ERROR_RATE]
        far = clipped(k_error * error[..., along] + k_velocity * rate[..., along], -limit, limit)
        return far - k_angle * observation[..., 3 + axis] - k_rate * observation[..., 9 + axis]

    def _difference(self, led: Array, vertical: Array, observation: Array) -> Array:
        """The leader's thrust less the follower's (...) [N] at vertical commands (...)."""
        xp, gravity = observation.__array_namespace__(), self._leader[2]
        level = xp.cos(observation[..., 3]) * xp.cos(observation[..., 4])
        ahead, behind = (float(mass) for mass in self.design.carried)
        return (ahead * (gravity + led) - behind * (gravity + vertical)) / level


def _measured(observation: Array) -> list[Array]:
    """Pitch, its rate, climb."""
    return [observation[..., 4], observation[..., 10], -observation[..., ERROR_RATE.stop - 1]]
