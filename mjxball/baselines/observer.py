"""A PD controller with a disturbance observer, a standard design for the paper's pair (ours).

Its gains are the best of 1920 sets of `benchmarks/tuning.py observer` on 72 flights in each condition; their cost is
4.09.
"""

from __future__ import annotations

from typing import NamedTuple

from mjxball.arrays import Array, clipped, joined
from mjxball.baselines.assembly_model import pair_model
from mjxball.config import Config
from mjxball.control import leader
from mjxball.control.followers import PrivilegedInfo, copy_gains
from mjxball.control.observation import ERROR, ERROR_RATE, copy_command


class ObserverGains(NamedTuple):
    """Gains of the PD controller of the position, and bandwidths of the observers, each (...)."""

    position: Array = 1.07  # [rad/m]
    velocity: Array = 0.78  # [rad s/m]
    tilt_limit: Array = 0.147  # of the PD controller [rad]
    height: Array = 19.9  # vertical acceleration for an error [1/s2]
    climb: Array = 9.61  # and for a velocity [1/s]
    torque_bandwidth: Array = 50.5  # [rad/s]
    lift_bandwidth: Array = 5.06  # [rad/s]


class ObserverState(NamedTuple):
    """Motion explained by both commands and the disturbance estimated so far."""

    rate: Array  # (...) of pitch [rad/s]
    climb: Array  # (...) [m/s]


class Observer:
    """A PD controller of the pair's position that cancels the torque and lift estimated by a disturbance observer.

    The observer (Ohnishi's, of first order) compares pitch rate and climb with the integral of both drones' commands
    and of its estimate: d = w (rate - integral). The leader's command is computed from its known controller.
    """

    name = "observer"
    needs_privileged = False
    gains = ObserverGains()

    def __init__(self, config: Config):
        pair = pair_model(config, self.name)
        self._period, self._kp, self._kd, self._inertia = pair.period, pair.kp[1], pair.kd[1], pair.inertia[1]
        self._leader = copy_gains(config)

    def start(self, observation: Array) -> ObserverState:
        """See `Controller.start`."""
        return ObserverState(observation[..., 10], -observation[..., ERROR_RATE][..., 2])

    def step(self, state: ObserverState, observation: Array, privileged: PrivilegedInfo) -> tuple[ObserverState, Array]:
        """See `Controller.step`."""
        gains, led, limits = self.gains, copy_command(observation, *self._leader), self._leader[-2:]
        error, velocity = observation[..., ERROR], observation[..., ERROR_RATE]
        turning = gains.torque_bandwidth * (observation[..., 10] - state.rate)  # disturbance [rad/s2]
        lift = gains.lift_bandwidth * (-velocity[..., 2] - state.climb)  # disturbance [m/s2]
        tilt_limit = gains.tilt_limit
        ahead, aside = (
            clipped(gains.position * error[..., axis] + gains.velocity * velocity[..., axis], -tilt_limit, tilt_limit)
            for axis in (0, 1)
        )
        rise = gains.height * error[..., 2] + gains.climb * velocity[..., 2] - lift
        pitch = 2.0 * ahead - led[..., 1] - self._inertia * turning / self._kp
        command = leader.clip_command(joined([-2.0 * aside - led[..., 0], pitch, 2.0 * rise - led[..., 2]]), *limits)
        torque = self._kp * (led[..., 1] + command[..., 1] - 2.0 * observation[..., 4])
        turn = (torque - 2.0 * self._kd * observation[..., 10]) / self._inertia
        climb = 0.5 * (led[..., 2] + command[..., 2])
        return ObserverState(
            state.rate + self._period * (turn + turning), state.climb + self._period * (climb + lift)
        ), command
