"""A cascade of PD and PID laws: what an autopilot would fly the paper's pair with (ours).

Its gains were found by `benchmarks/observer_tuning.py pid` on flights with and without noise and delay: 72 rounds, then
40 in which an overshoot below 4 % cost nothing. The script goes on from them.
"""

from __future__ import annotations

from typing import NamedTuple

from mjxball.arrays import Array, clipped, joined
from mjxball.baselines.assembly_model import pair_model
from mjxball.config import Config
from mjxball.control import leader
from mjxball.control.followers import PrivilegedInfo, copy_gains
from mjxball.control.observation import ERROR, ERROR_RATE, copy_command


class PidGains(NamedTuple):
    """PD law of the position, PID laws of the pitch and of the height, each (...)."""

    position: Array = 0.84  # [rad/m]
    velocity: Array = 0.687  # [rad s/m]
    tilt_limit: Array = 0.122  # of the PD law [rad]
    reference_time: Array = 0.227  # in which the pitch is expected to follow [s]
    pitch: Array = 4.52  # pitch command for an error of the pitch, beside that of the attitude loops
    rate: Array = 0.404  # and for a rate [s]
    pitch_integral: Array = 63.1  # and for an integral [1/s]
    pitch_band: Array = 0.0859  # error of the pitch that is integrated at most [rad]
    height: Array = 1.2  # climb for an error of the height [1/s]
    climb_limit: Array = 2.15  # [m/s]
    climb_time: Array = 0.184  # in which the climb is expected to follow [s]
    climb: Array = 5.76  # vertical acceleration for an error of the climb [1/s]
    climb_integral: Array = 15.2  # and for an integral [1/s2]
    climb_band: Array = 0.137  # error of the climb that is integrated at most [m/s]


class PidState(NamedTuple):
    """What the integrators hold."""

    leaning: Array  # (...) pitch as it should follow [rad]
    rising: Array  # (...) climb as it should follow [m/s]
    pitch: Array  # (...) integral part of the pitch command [rad]
    vertical: Array  # (...) of the vertical command [m/s2]


class Pid:
    """A PD law of the position commands the pitch, a P law of the height the climb; PID laws bring both there.

    The integrals hold the load's torque and what a mass weighs that nobody knows. Both references follow with a lag,
    as the pair does, so that the integrals see what disturbs and not the way to the goal. Wind-up is prevented twice:
    no more than a band of each error is integrated, and nothing where the command is at its limit and would be taken
    beyond. The leader's command is known, for its law is.
    """

    name = "pid"
    needs_privileged = False
    gains = PidGains()

    def __init__(self, config: Config):
        self._period = pair_model(config, self.name).period
        self._leader = copy_gains(config)

    def start(self, observation: Array) -> PidState:
        """See `Law.start`."""
        zero = observation.__array_namespace__().zeros_like(observation[..., 4])
        return PidState(observation[..., 4], -observation[..., ERROR_RATE][..., 2], zero, zero)

    def step(self, state: PidState, observation: Array, privileged: PrivilegedInfo) -> tuple[PidState, Array]:
        """See `Law.step`."""
        own, led, limits, period = self.gains, copy_command(observation, *self._leader), self._leader[-2:], self._period
        error, velocity, most = observation[..., ERROR], observation[..., ERROR_RATE], own.tilt_limit
        ahead, aside = (
            clipped(own.position * error[..., axis] + own.velocity * velocity[..., axis], -most, most)
            for axis in (0, 1)
        )
        leaning = state.leaning + period / (period + own.reference_time) * (ahead - state.leaning)
        aim = clipped(own.height * error[..., 2], -own.climb_limit, own.climb_limit)
        speeding = (aim - state.rising) / (period + own.climb_time)  # [m/s2]
        rising = state.rising + period * speeding
        short, slow = leaning - observation[..., 4], rising + velocity[..., 2]
        held = state.pitch + own.pitch * short - own.rate * observation[..., 10]
        lift = state.vertical + 2.0 * (speeding + own.climb * slow)
        wanted = joined([-2.0 * aside, 2.0 * ahead + held, lift]) - led
        command = leader.clip_command(wanted, *limits)
        beyond = wanted - command
        pitch = own.pitch_integral * clipped(short, -own.pitch_band, own.pitch_band)
        vertical = own.climb_integral * clipped(slow, -own.climb_band, own.climb_band)
        return PidState(
            leaning,
            rising,
            state.pitch + period * pitch * (beyond[..., 1] * pitch <= 0.0),
            state.vertical + period * vertical * (beyond[..., 2] * vertical <= 0.0),
        ), command
