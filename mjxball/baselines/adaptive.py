"""An adaptive follower that estimates the CG's moment and its rate (ours, Slotine-Li style)."""

from __future__ import annotations

from typing import Any, NamedTuple

from mjxball.baselines.load_axis import CopiedPid, load_axis
from mjxball.config import Config
from mjxball.control.followers import PrivilegedInfo
from mjxball.control.leader import clip_command
from mjxball.control.observation import ERROR, ERROR_RATE

Array = Any
BANDWIDTH = 6.0  # w_b [rad/s]; the loop limit-cycles from 16
RATIO = 0.5  # r
MOMENT_LIMIT, RATE_LIMIT = 0.15, 0.3  # [kg m], [kg m/s]
CRAZYFLIE_BANDWIDTH = 4.0  # of two Crazyflies; in the middle of 2 to 9 tried on random rigs; at 9 more crash [rad/s]
CRAZYFLIE_RATE = 4.0  # what their load may change in a second over the largest that one tilt limit holds [1/s]
MASS_GAIN, MASS_SLOPE, MASS_LIMIT = 0.5, 0.35, 0.5  # Gamma, [1/s], [kg]
CORRECTION_LIMIT = 0.5  # [rad] of pitch, with mass adaptation


class State(NamedTuple):
    """State of the adaptive follower."""

    integral: Any  # (..., 3) see `CopiedPid`
    desired: Array  # (...) last command of the copied law about the load's axis [rad]
    moment: Array  # (...) estimate of the load's moment about that axis over gravity, m_o c for pitch [kg m]
    rate: Array  # (...) estimate of its rate [kg m/s]
    extra_mass: Array  # (...) estimate of the object's mass beyond what is believed [kg]
    error: Array  # (...) height error of an ideal PD response [m]
    error_rate: Array  # (...) [m/s]
    started: Array  # (...) 1 after the first step


class Adaptive:
    """s = (q - theta_d') + lam (theta - theta_d); d' = v + G1 (g + az) s, v' = G2 (g + az) s.

    theta_d is the copied pitch command, lam = Kp / Kd of a drone's pitch loop, K = 2 Kd, G1 = K w_b / g^2,
    G2 = G1 w_b r / 2; theta_f = theta_d - (g + az) d / Kp. With `adapts_mass` the object's mass is estimated from
    the height against an ideal PD response, and its weight and the torque of carrying it alone are compensated.
    With the CG along y the same of roll. A leader that integrates is copied with its integral, so that both lift alike;
    what a Crazyflie's motors lift besides when they work apart is taken off.
    """

    needs_privileged = False

    def __init__(self, config: Config, adapts_mass: bool = False):
        self.name = "adaptive-mass" if adapts_mass else "adaptive"
        self._pid = CopiedPid(config)
        self._limits = config.command.tilt_limit, config.command.vertical_limit
        self._height = (config.leader.kp[2], config.leader.kd[2])
        self._gains = gains = load_axis(config, self.name)
        self._adapts_mass = adapts_mass
        self._bandwidth, self._estimate_limits = BANDWIDTH, (MOMENT_LIMIT, RATE_LIMIT)
        if config.autopilot.kind == "crazyflie":
            trimmed = gains.kp * config.command.tilt_limit / gains.gravity
            self._bandwidth, self._estimate_limits = CRAZYFLIE_BANDWIDTH, (trimmed, CRAZYFLIE_RATE * trimmed)

    def start(self, observation: Array) -> State:
        """See `Law.start`."""
        zero = observation.__array_namespace__().zeros_like(observation[..., 0])
        error, error_rate = observation[..., ERROR][..., 2], observation[..., ERROR_RATE][..., 2]
        return State(self._pid.start(observation), zero, zero, zero, zero, error, error_rate, zero)

    def step(self, state: State, observation: Array, privileged: PrivilegedInfo) -> tuple[State, Array]:
        """See `Law.step`."""
        xp = observation.__array_namespace__()
        gains = self._gains
        integral, copied = self._pid.step(state.integral, observation)
        desired, vertical = copied[..., gains.axis], copied[..., 2]
        theta, rate = observation[..., 3 + gains.axis], observation[..., 9 + gains.axis]
        desired_rate = state.started * (desired - state.desired) / gains.period
        s = (rate - desired_rate) + gains.kp / gains.kd * (theta - desired)
        lift = gains.gravity + vertical
        first = 2.0 * gains.kd * self._bandwidth / gains.gravity**2
        second = first * self._bandwidth * RATIO / 2.0
        moment = state.moment + gains.period * (state.rate + first * lift * s)
        most, most_rate = self._estimate_limits
        moment = xp.clip(moment, -most, most)
        moment_rate = xp.clip(state.rate + gains.period * second * lift * s, -most_rate, most_rate)
        correction = -lift * moment / gains.kp
        moved = state._replace(
            integral=integral, desired=desired, moment=moment, rate=moment_rate, started=xp.ones_like(state.started)
        )
        if self._adapts_mass:
            moved, more, push = self._mass(moved, observation, privileged)
            vertical = vertical + push
            correction = xp.clip(correction + more, -CORRECTION_LIMIT, CORRECTION_LIMIT)
        tilts = [copied[..., 0], copied[..., 1]]
        tilts[gains.axis] = desired + correction
        vertical = gains.less_extra_lift(vertical, correction)
        return moved, clip_command(xp.stack([*tilts, vertical], axis=-1), *self._limits)

    def _mass(self, state: State, observation: Array, privileged: PrivilegedInfo) -> tuple[State, Array, Array]:
        """(state, tilt [rad], vertical acceleration [m/s2]) that carry the estimated extra mass."""
        xp = observation.__array_namespace__()
        gains = self._gains
        carried = gains.drone_mass[1] + gains.share[1] * privileged.believed_mass
        error, error_rate = observation[..., ERROR][..., 2], observation[..., ERROR_RATE][..., 2]
        s = (state.error_rate - error_rate) + MASS_SLOPE * (state.error - error)
        mass = state.extra_mass - gains.period * 2.0 * carried * MASS_GAIN / gains.gravity * s
        mass = xp.clip(mass, -MASS_LIMIT, MASS_LIMIT)
        kp, kd = self._height
        ideal = -kp * state.error - kd * state.error_rate
        moved = state._replace(
            extra_mass=mass,
            error=state.error + gains.period * state.error_rate,
            error_rate=state.error_rate + gains.period * ideal,
        )
        return moved, -gains.sign * gains.half_length * mass * gains.gravity / gains.kp, mass * gains.gravity / carried
