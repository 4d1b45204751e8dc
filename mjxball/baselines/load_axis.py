"""What the classical followers are built from: the pair about the axis that the load turns, and the leader's PID."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from mjxball.config import Config
from mjxball.control import leader
from mjxball.control.constants import drone_loop, thrust_slopes
from mjxball.control.followers import copy_gains
from mjxball.control.observation import ERROR, ERROR_RATE, copy_command
from mjxball.errors import InputError
from mjxball.plant import plant_parameters

Array = Any


class LoadAxis(NamedTuple):
    """The pair about the axis that the load turns, pitch for a CG along x, roll along y, and its attitude loop."""

    axis: int  # 0 roll, 1 pitch: of a command, of the Euler angles, of the rates
    sign: float  # of the torque of a load on the leader's side: 1 about pitch, -1 about roll
    kp: float  # of one drone's attitude loop [N m/rad]
    kd: float  # [N m s/rad]
    inertia: float  # of the assembly about O, CG at O, nominal object [kg m2]
    half_length: float  # from O to each drone [m]
    drone_mass: tuple[float, float]  # leader, follower, each with its share of a carrier [kg]
    share: tuple[float, float]  # of the object's weight that each drone carries
    gravity: float  # [m/s2]
    slope: float  # thrust of the follower per commanded vertical acceleration [kg]
    thrust_surplus: float  # see `DroneLoop`; 0 of an ideal loop [1/(N m2)]
    lag: float  # of the rotors [s]
    period: float  # between two commands [s]
    natural_frequency: tuple[float, float]  # of the closed roll and pitch loops of `Attitude` [rad/s]
    damping: float

    def less_extra_lift(self, vertical: Array, trim: Array) -> Array:
        """`vertical` (...) [m/s2] less the extra lift of motors that hold the torque kp `trim` (...) [rad]."""
        return vertical - self.thrust_surplus / self.slope * (self.kp * trim) ** 2


class CopiedPid:
    """The leader's PID on the follower's own observation; with the leader's integral each drone lifts its half."""

    def __init__(self, config: Config):
        law = config.leader
        self._pid = law.kp, law.kd, law.ki
        self._pd = copy_gains(config)
        self._band, self._period = law.integral_error_limit, config.timing.control_period

    def start(self, observation: Array) -> Any:
        """Integral (..., 3) [m s] at the first `observation` (..., 18); () if the leader has none."""
        return observation.__array_namespace__().zeros_like(observation[..., ERROR]) if any(self._pid[2]) else ()

    def step(self, integral: Any, observation: Array) -> tuple[Any, Array]:
        """(integral, command (..., 3)) at `observation` (..., 18)."""
        xp, dtype = observation.__array_namespace__(), observation.dtype
        if not any(self._pid[2]):
            return integral, copy_command(observation, *self._pd)
        error = observation[..., ERROR]
        gains = (xp.asarray(gain, dtype=dtype) for gain in self._pid)
        wanted = leader.desired_acceleration(error, observation[..., ERROR_RATE], integral, *gains)
        band = xp.asarray(self._band, dtype=dtype)
        return integral + self._period * xp.clip(error, -band, band), leader.command(wanted, 0.0, *self._pd[2:])


def pitch_axis(config: Config, name: str) -> LoadAxis:
    """`load_axis` for the follower `name`; InputError unless an ideal loop and a free pair with its CG along x."""
    plant = config.plant
    if plant.cg_axis != "x" or plant.stand != "free" or config.autopilot.kind != "ideal":
        raise InputError(f"follower {name!r} balances a free pair along x with ideal loops; this plant is another")
    return load_axis(config, name)


def load_axis(config: Config, name: str) -> LoadAxis:
    """The pair about the axis that the load turns, for the follower `name`; InputError if a stand locks that axis.

    A Crazyflie's attitude loop is approximated by the PD part of its cascade at hover, without the integrals.
    """
    plant, attitude = config.plant, config.attitude
    lead, follow = plant.pair
    if plant.cg_axis == "x" and plant.stand != "free":
        raise InputError(f"follower {name!r} balances a free pair along x, or a pair along y; this stand locks pitch")
    axis = "yx".index(plant.cg_axis)
    constants = plant_parameters(plant, attitude)
    inertia = np.diag(constants.drone_inertia) + plant.object_mass * constants.object_inertia_per_mass
    kp, kd, thrust_surplus = float(constants.gains.kp[axis]), float(constants.gains.kd[axis]), 0.0
    if config.autopilot.kind == "crazyflie":
        loop = drone_loop(config, axis)
        kp, kd, thrust_surplus = loop.kp, loop.kd, loop.thrust_surplus
    roll, pitch, _ = attitude.natural_frequency
    leader_share, follower_share = map(float, constants.share)
    along = plant.directions[0]
    return LoadAxis(
        axis=axis,
        sign=1.0 if axis else -1.0,
        kp=kp,
        kd=kd,
        inertia=float(inertia[axis]),
        half_length=0.5 * (lead.mount[along] - follow.mount[along]),
        drone_mass=(plant.known_masses[0], plant.known_masses[1]),
        share=(leader_share, follower_share),
        gravity=plant.gravity,
        slope=thrust_slopes(config)[1],
        thrust_surplus=thrust_surplus,
        lag=plant.rotor_lag,
        period=config.timing.control_period,
        natural_frequency=(roll, pitch),
        damping=attitude.damping,
    )
