"""An adaptive follower that estimates the CG's moment and its rate (ours, Slotine-Li style)."""

from __future__ import annotations

from typing import Any, NamedTuple

from mjxball.config import Config
from mjxball.control.baselines.gains import copied_law, pitch_gains
from mjxball.control.baselines.law import Brief
from mjxball.control.leader import clip_command
from mjxball.control.observation import ERROR, ERROR_RATE, copy_command

Array = Any
BANDWIDTH = 6.0  # w_b [rad/s]; the loop limit-cycles from 16
RATIO = 0.5  # r
MOMENT_LIMIT, RATE_LIMIT = 0.15, 0.3  # [kg m], [kg m/s]
MASS_GAIN, MASS_SLOPE, MASS_LIMIT = 0.5, 0.35, 0.5  # Gamma, [1/s], [kg]
CORRECTION_LIMIT = 0.5  # [rad] of pitch, with mass adaptation


class Memory(NamedTuple):
    """What the adaptive follower carries from step to step."""

    wanted: Array  # (...) last pitch command of the copied law [rad]
    moment: Array  # (...) estimate of m_o c [kg m]
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
    """

    needs_truth = False

    def __init__(self, config: Config, adapts_mass: bool = False):
        self.name = "adaptive-mass" if adapts_mass else "adaptive"
        self._law = copied_law(config)
        self._height = (config.leader.kp[2], config.leader.kd[2])
        self._gains = pitch_gains(config, self.name)
        self._adapts_mass = adapts_mass

    def start(self, observation: Array) -> Memory:
        """See `Law.start`."""
        zero = observation.__array_namespace__().zeros_like(observation[..., 0])
        return Memory(
            zero, zero, zero, zero, observation[..., ERROR][..., 2], observation[..., ERROR_RATE][..., 2], zero
        )

    def step(self, memory: Memory, observation: Array, brief: Brief) -> tuple[Memory, Array]:
        """See `Law.step`."""
        xp = observation.__array_namespace__()
        gains = self._gains
        roll, wanted, vertical = (copy_command(observation, *self._law)[..., k] for k in range(3))
        theta, rate = observation[..., 4], observation[..., 10]
        wanted_rate = memory.started * (wanted - memory.wanted) / gains.period
        s = (rate - wanted_rate) + gains.kp / gains.kd * (theta - wanted)
        lift = gains.gravity + vertical
        first = 2.0 * gains.kd * BANDWIDTH / gains.gravity**2
        second = first * BANDWIDTH * RATIO / 2.0
        moment = memory.moment + gains.period * (memory.rate + first * lift * s)
        moment = xp.clip(moment, -MOMENT_LIMIT, MOMENT_LIMIT)
        moment_rate = xp.clip(memory.rate + gains.period * second * lift * s, -RATE_LIMIT, RATE_LIMIT)
        correction = -lift * moment / gains.kp
        moved = memory._replace(wanted=wanted, moment=moment, rate=moment_rate, started=xp.ones_like(memory.started))
        if self._adapts_mass:
            moved, more, push = self._mass(moved, observation, brief)
            vertical = vertical + push
            correction = xp.clip(correction + more, -CORRECTION_LIMIT, CORRECTION_LIMIT)
        command = xp.stack([roll, wanted + correction, vertical], axis=-1)
        return moved, clip_command(command, *self._law[3:])

    def _mass(self, memory: Memory, observation: Array, brief: Brief) -> tuple[Memory, Array, Array]:
        """(memory, pitch [rad], vertical acceleration [m/s2]) that carry the estimated extra mass."""
        xp = observation.__array_namespace__()
        gains = self._gains
        carried = gains.drone_mass[1] + gains.share[1] * brief.believed_mass
        error, error_rate = observation[..., ERROR][..., 2], observation[..., ERROR_RATE][..., 2]
        s = (memory.error_rate - error_rate) + MASS_SLOPE * (memory.error - error)
        mass = memory.extra_mass - gains.period * 2.0 * carried * MASS_GAIN / gains.gravity * s
        mass = xp.clip(mass, -MASS_LIMIT, MASS_LIMIT)
        kp, kd = self._height
        ideal = -kp * memory.error - kd * memory.error_rate
        moved = memory._replace(
            extra_mass=mass,
            error=memory.error + gains.period * memory.error_rate,
            error_rate=memory.error_rate + gains.period * ideal,
        )
        return moved, -gains.half_length * mass * gains.gravity / gains.kp, mass * gains.gravity / carried
