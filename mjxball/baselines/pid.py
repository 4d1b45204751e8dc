"""A cascade of PD and PID controllers as in an autopilot, for the paper's pair (ours).

Its gains are the best of 1920 sets of `benchmarks/tuning.py pid` on 72 flights in each condition; their cost is 4.01.
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
    """Gains of the PD controller of the position and of the PID controllers of pitch and height, each (...)."""

    position: Array = 1.1  # [rad/m]
    velocity: Array = 0.752  # [rad s/m]
    tilt_limit: Array = 0.121  # of the PD controller [rad]
    reference_time: Array = 0.179  # time constant of the pitch reference [s]
    pitch: Array = 5.06  # pitch command for an error of the pitch, besides the attitude loops'
    rate: Array = 0.44  # and for a rate [s]
    pitch_integral: Array = 71  # and for an integral [1/s]
    pitch_band: Array = 0.0702  # largest error of the pitch that is integrated [rad]
    height: Array = 2.34  # climb for an error of the height [1/s]
    climb_limit: Array = 1.59  # [m/s]
    climb_time: Array = 0.0722  # time constant of the climb reference [s]
    climb: Array = 5.53  # vertical acceleration for an error of the climb [1/s]
    climb_integral: Array = 32.3  # and for an integral [1/s2]
    climb_band: Array = 0.202  # largest error of the climb that is integrated [m/s]


class PidState(NamedTuple):
    """References and integrals."""

    leaning: Array  # (...) reference of the pitch [rad]
    rising: Array  # (...) reference of the climb [m/s]
    pitch: Array  # (...) integral part of the pitch command [rad]
    vertical: Array  # (...) integral part of the vertical command [m/s2]


class Pid:
    """The position's PD controller commands the pitch, the height's P controller the climb; PID controllers track both.

    The integrals hold the load's torque and the weight of an unknown mass. Both references lag, as the pair does, so
    that the integrals act on disturbances and not on the way to the goal. Wind-up is prevented twice: each error is
    clipped to a band before it is integrated, and nothing is integrated that drives a saturated command further. The
    leader's command is computed from its known controller.
    """

    name = "pid"
    needs_privileged = False
    gains = PidGains()

    def __init__(self, config: Config):
        self._period = pair_model(config, self.name).period
        self._leader = copy_gains(config)

    def start(self, observation: Array) -> PidState:
        """See `Controller.start`."""
        zero = observation.__array_namespace__().zeros_like(observation[..., 4])
        return PidState(observation[..., 4], -observation[..., ERROR_RATE][..., 2], zero, zero)

    def step(self, state: PidState, observation: Array, privileged: PrivilegedInfo) -> tuple[PidState, Array]:
        """See `Controller.step`."""
        gains, led, limits = self.gains, copy_command(observation, *self._leader), self._leader[-2:]
        error, velocity, most = observation[..., ERROR], observation[..., ERROR_RATE], gains.tilt_limit
        period = self._period
        ahead, aside = (
            clipped(gains.position * error[..., axis] + gains.velocity * velocity[..., axis], -most, most)
            for axis in (0, 1)
        )
        leaning = state.leaning + period / (period + gains.reference_time) * (ahead - state.leaning)
        aim = clipped(gains.height * error[..., 2], -gains.climb_limit, gains.climb_limit)
        speeding = (aim - state.rising) / (period + gains.climb_time)  # [m/s2]
        rising = state.rising + period * speeding
        short, slow = leaning - observation[..., 4], rising + velocity[..., 2]
        held = state.pitch + gains.pitch * short - gains.rate * observation[..., 10]
        lift = state.vertical + 2.0 * (speeding + gains.climb * slow)
        desired = joined([-2.0 * aside, 2.0 * ahead + held, lift]) - led
        command = leader.clip_command(desired, *limits)
        beyond = desired - command
        pitch = gains.pitch_integral * clipped(short, -gains.pitch_band, gains.pitch_band)
        vertical = gains.climb_integral * clipped(slow, -gains.climb_band, gains.climb_band)
        return PidState(
            leaning,
            rising,
            state.pitch + period * pitch * (beyond[..., 1] * pitch <= 0.0),
            state.vertical + period * vertical * (beyond[..., 2] * vertical <= 0.0),
        ), command
