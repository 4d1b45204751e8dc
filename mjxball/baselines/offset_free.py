"""Offset-free LQG for the paper's pair: the numbers of `control.offset_free`, and the law as a follower (ours)."""

from __future__ import annotations

from typing import Any

import numpy as np

from mjxball.baselines.assembly_model import AssemblyModel, ideal_model
from mjxball.baselines.lqg import CORRECTION_LIMIT, VERTICAL_LIMIT
from mjxball.baselines.lqg_design import CLIMB_NOISE, RATE_NOISE, THETA_NOISE, Tuning, feedback, steady_filter
from mjxball.config import Config
from mjxball.control.followers import PrivilegedInfo, copy_gains
from mjxball.control.leader import clip_command
from mjxball.control.offset_free import DRIVES, STATES, OffsetFreeLqg
from mjxball.errors import InputError

Array = Any
NAME = "lqg-offset-free"
TUNING = Tuning(position=0.2, velocity=0.6, torque_walk=0.003, tilt_limit=0.3)
LIFT_WALK = 0.01  # intensity of the white noise that drives the lift error [(m/s2)2/s]


def pair_model(config: Config) -> AssemblyModel:
    """`ideal_model`; InputError unless the plant is a free pair along x with ideal loops."""
    plant = config.plant
    alike = plant.count == 2 and plant.leader == 0 and plant.cg_axis == "x" and plant.stand == "free"
    if not alike or config.autopilot.kind != "ideal":
        raise InputError(f"follower {NAME!r} balances a free pair along x with ideal loops; this plant is another")
    return ideal_model(config, NAME)


def offset_free_lqg(config: Config) -> OffsetFreeLqg:
    """The law for the plant of `config`; InputError unless it is a free pair along x with ideal attitude loops."""
    pair = pair_model(config)
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
    gains, mass = feedback(pair, TUNING), config.plant.object_mass
    return OffsetFreeLqg(
        transition=np.hstack([transition, drive]),
        gain=gain,
        tilt=np.array([gains.roll, gains.pitch]),
        height=np.array(gains.height),
        limits=np.array([TUNING.tilt_limit, VERTICAL_LIMIT, CORRECTION_LIMIT]),
        stiffness=kp,
        half_length=0.5 * float(pair.mounts[0, 0] - pair.mounts[1, 0]),
        carried=pair.known_mass + pair.share * mass,
    )


class OffsetFree:
    """What a network with `follower.base = lqg` starts from, flying alone. It is not told the object's mass."""

    name = NAME
    needs_privileged = False

    def __init__(self, config: Config):
        self._law: Any = offset_free_lqg(config)
        self._leader = copy_gains(config)

    def start(self, observation: Array) -> Array:
        """See `Law.start`."""
        return self._law.start(observation)

    def step(self, state: Array, observation: Array, privileged: PrivilegedInfo) -> tuple[Array, Array]:
        """See `Law.step`."""
        nothing = observation.__array_namespace__().zeros_like(observation[..., :3])
        command = clip_command(self._law.command(nothing, state, observation, self._leader), *self._leader[-2:])
        return self._law.next(state, observation, command, self._leader), command
