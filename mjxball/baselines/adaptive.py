"""An adaptive follower that estimates the CG's moment and its rate (ours, Slotine-Li style)."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from mjxball.arrays import Array
from mjxball.baselines.assembly_model import CopiedPid, assembly_model
from mjxball.config import Config
from mjxball.control.followers import PrivilegedInfo
from mjxball.control.leader import clip_command
from mjxball.control.observation import ERROR, ERROR_RATE

BANDWIDTH = 6.0  # w_b [rad/s]; the loop limit-cycles from 16
RATIO, TEAM_RATIO = 0.5, 1.0  # r of a pair and of a team
MOMENT_LIMIT, RATE_LIMIT = 0.15, 0.3  # per follower [kg m], [kg m/s]
CRAZYFLIE_BANDWIDTH = 4.0  # for two Crazyflies [rad/s]; of 2 to 9 tried on random rigs; at 9 more crash
CRAZYFLIE_RATE = 4.0  # largest rate of their load's moment over the moment that the tilt limit holds [1/s]
MASS_GAIN, TEAM_MASS_GAIN = 0.5, 4.0  # Gamma of a pair and of a team
MASS_SLOPE, MASS_LIMIT = 0.35, 0.5  # [1/s], per follower [kg]
MEMORY, MASS_MEMORY = 0.5, 20.0  # time constants with which estimates of several followers fade [s]
CORRECTION_LIMIT = 0.5  # [rad] of roll and pitch, with mass adaptation


class AdaptiveState(NamedTuple):
    """State of the adaptive follower, in body axes; A is the number of axes about which the load acts.

    Arrays of several followers are (..., F, ...).
    """

    integral: Any  # (..., 3) see `CopiedPid`
    desired: Array  # (..., A) last tilt command of the copied PID about the load's axes [rad]
    moment: Array  # (..., A) estimate of the load's torque about them over gravity, m_o c for pitch [kg m]
    rate: Array  # (..., A) estimate of its rate [kg m/s]
    extra_mass: Array  # (...) estimated mass of the object minus the believed mass [kg]
    error: Array  # (...) height error of an ideal PD response [m]
    error_rate: Array  # (...) [m/s]
    started: Array  # (...) 1 after the first step


class Adaptive:
    """s = (q - theta_d') + lam (theta - theta_d); d' = v + G1 (g + az) s, v' = G2 (g + az) s, about each load's axis.

    theta_d is the copied command, lam = Kp / Kd of a drone's attitude loop, K = N Kd of all N drones, G1 = K w_b / g^2,
    G2 = G1 w_b r / 2. Every follower gives one F-th of the torque against (g + az) d; for a pair
    theta_f = theta_d - (g + az) d / Kp. With `adapts_mass` the object's mass is estimated from the height relative to
    an ideal PD response, and the followers lift its weight without a moment. The other axis of a pair is copied. If the
    leader has an integral, it is copied too, so that all lift alike. The extra thrust of Crazyflie motors at unequal
    commands is subtracted.

    Followers of a team estimate from their own measurements. Sensors that disagree by constants would drive their
    estimates apart for ever, so these fade (Ioannou's sigma modification), and a slow load is not cancelled
    completely. Constant errors of level 1 keep rotors of `team4` at a limit for half of the time if estimates fade
    with 1 s, and those of `team6` from 0.6 s on.
    """

    needs_privileged = False

    def __init__(self, config: Config, adapts_mass: bool = False):
        self.name = "adaptive-mass" if adapts_mass else "adaptive"
        self._pid = CopiedPid(config)
        self._limits = config.command.tilt_limit, config.command.vertical_limit
        self._height = (config.leader.kp[2], config.leader.kd[2])
        self._model = model = assembly_model(config, self.name).each_alone()
        self._adapts_mass = adapts_mass
        drones, followers = len(model.own_mass), model.followers
        kp, kd = np.array(model.kp)[model.turned], np.array(model.kd)[model.turned]
        bandwidth, self._estimate_limits = BANDWIDTH, (followers * MOMENT_LIMIT, followers * RATE_LIMIT)
        if config.autopilot.kind == "crazyflie":
            trimmed = float(kp[0]) * config.command.tilt_limit / model.gravity
            bandwidth, self._estimate_limits = CRAZYFLIE_BANDWIDTH, (trimmed, CRAZYFLIE_RATE * trimmed)
        first, ratio = drones * kd * bandwidth / model.gravity**2, RATIO if followers == 1 else TEAM_RATIO
        self._gains = kp / kd, first, first * bandwidth * ratio / 2.0  # lam, G1, G2 of each axis
        self._mass_gain = (MASS_GAIN if followers == 1 else TEAM_MASS_GAIN) / model.gravity
        self._mass_limit = followers * MASS_LIMIT
        # Shares of the estimates that are left after a period.
        kept = [math.exp(-model.period / memory) for memory in (MEMORY, MASS_MEMORY)]
        self._kept, self._mass_kept = (1.0, 1.0) if followers == 1 else kept

    def start(self, observation: Array) -> AdaptiveState:
        """See `Controller.start`."""
        xp, observation = observation.__array_namespace__(), self._model.in_body_axes(observation)
        zero = xp.zeros_like(observation[..., 0])
        zeros = xp.zeros_like(observation[..., : len(self._model.axes)])
        error, error_rate = observation[..., ERROR][..., 2], observation[..., ERROR_RATE][..., 2]
        return AdaptiveState(self._pid.start(observation), zeros, zeros, zeros, zero, error, error_rate, zero)

    def step(self, state: AdaptiveState, observation: Array, privileged: PrivilegedInfo) -> tuple[AdaptiveState, Array]:
        """See `Controller.step`."""
        xp, model, axes = observation.__array_namespace__(), self._model, self._model.turned
        slope, first, second = (xp.asarray(gain, dtype=observation.dtype) for gain in self._gains)
        observation = model.in_body_axes(observation)
        integral, copied = self._pid.step(state.integral, observation)
        desired, vertical = copied[..., axes], copied[..., 2]
        theta, rate = observation[..., 3:5][..., axes], observation[..., 9:11][..., axes]
        desired_rate = state.started[..., None] * (desired - state.desired) / model.period
        s = (rate - desired_rate) + slope * (theta - desired)
        weight = (model.gravity + vertical)[..., None]
        most, most_rate = self._estimate_limits
        kept = self._kept
        moment = xp.clip(kept * state.moment + model.period * (state.rate + first * weight * s), -most, most)
        moment_rate = xp.clip(kept * state.rate + model.period * second * weight * s, -most_rate, most_rate)
        after = state._replace(
            integral=integral, desired=desired, moment=moment, rate=moment_rate, started=xp.ones_like(state.started)
        )
        carried, lift = model.carried(privileged.believed_mass), xp.zeros_like(vertical)
        if self._adapts_mass:
            after = self._mass(after, observation, carried)
            lift = model.gravity * after.extra_mass
        wrench = xp.concat([lift[..., None], model.on_axes(-weight * moment)], axis=-1)
        correction = model.corrections(wrench, carried)
        tilt = correction[..., :2]
        if self._adapts_mass:
            tilt = xp.clip(tilt, -CORRECTION_LIMIT, CORRECTION_LIMIT)
        lift = model.without_extra_lift(vertical[..., None] + correction[..., 2], tilt)
        command = xp.concat([copied[..., None, :2] + tilt, lift[..., None]], axis=-1)
        return after, model.own(clip_command(command, *self._limits))

    def _mass(self, state: AdaptiveState, observation: Array, carried: Array) -> AdaptiveState:
        """`state` with the extra mass that explains the height; `carried` (..., N) are the drones' assumed masses."""
        xp, period = observation.__array_namespace__(), self._model.period
        error, error_rate = observation[..., ERROR][..., 2], observation[..., ERROR_RATE][..., 2]
        s = (state.error_rate - error_rate) + MASS_SLOPE * (state.error - error)
        mass = self._mass_kept * state.extra_mass - period * carried.sum(axis=-1) * self._mass_gain * s
        kp, kd = self._height
        return state._replace(
            extra_mass=xp.clip(mass, -self._mass_limit, self._mass_limit),
            error=state.error + period * state.error_rate,
            error_rate=state.error_rate + period * (-kp * state.error - kd * state.error_rate),
        )
