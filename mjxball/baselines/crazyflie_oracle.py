"""`oracle` for two Crazyflies on a stick along y: the LQR of `crazyflie_lqg` on the true state (ours)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mjxball.arrays import Array, joined
from mjxball.baselines.assembly_model import CopiedPid
from mjxball.baselines.crazyflie_lqg import Actuators, Costs, changes
from mjxball.baselines.crazyflie_model import Decay, linear_model
from mjxball.config import Config
from mjxball.control.constants import drone_loop
from mjxball.control.crazyflie import unpack
from mjxball.control.followers import PrivilegedInfo
from mjxball.control.observation import ERROR, ERROR_RATE


class CrazyflieOracle:
    """The controller, told the state of the cascades, thrusts, loads and wind."""

    name = "oracle"
    needs_privileged = True
    tuning = Costs()

    def __init__(self, config: Config, tuning: Costs | None = None):
        self._actuators, self._pid = Actuators(config, self.name), CopiedPid(config)
        self._assembly, self._names = self._actuators.assembly, self._actuators.model.names
        costs, period = tuning or self.tuning, config.timing.control_period
        self.gains = changes(linear_model(config, Decay()), costs, period), np.array(costs.error_limit)
        self._loop, leader = drone_loop(config, 0), config.leader
        self._pd = (leader.kp[1] / config.plant.gravity, leader.kd[1] / config.plant.gravity)
        self._limit = config.command.tilt_limit

    def start(self, observation: Array) -> Any:
        """(last command (..., 2), state of `CopiedPid`)."""
        return observation.__array_namespace__().zeros_like(observation[..., :2]), self._pid.start(observation)

    def step(self, state: Any, observation: Array, privileged: PrivilegedInfo) -> tuple[Any, Array]:
        """See `Controller.step`."""
        last, integral = state
        after, copied = self._pid.step(integral, observation)
        x = self._state(observation, integral, copied, privileged)
        command = self._actuators.command(x, last, *self.gains)
        return (command, after), self._actuators.sent(command, copied)

    def _state(self, seen: Array, integral: Any, copied: Array, known: PrivilegedInfo) -> Array:
        """The state (..., n) of `linear_model`."""
        xp, assembly, mass = seen.__array_namespace__(), self._assembly, known.total_mass
        carried, gravity = assembly.carried(known.believed_mass), assembly.gravity
        factor = xp.ones_like(carried) if known.thrust is None else known.thrust
        hover = factor * carried * gravity
        above = known.rotors[..., 0] - hover  # what vertical commands have added [N]
        error, rate = seen[..., ERROR], seen[..., ERROR_RATE]
        zero = xp.zeros_like(mass)
        # The leader's roll beyond its PD controller, and unequal thrusts at hover, turn the stick as a load does.
        extra = copied[..., 0] + self._pd[0] * error[..., 1] + self._pd[1] * rate[..., 1]
        uneven = assembly.lever_torque(hover)[..., 0]
        wind = xp.zeros_like(error) if known.force is None else known.force
        values = {
            "y": -error[..., 1] + known.moment / mass,
            "vy": -rate[..., 1] + known.moment_rate / mass,
            "roll": seen[..., 3],
            "rate": seen[..., 9],
            "torque": known.rotors[..., 1].sum(axis=-1),
            "rate_integral": unpack(known.loops).rate_integral[..., assembly.leader, 0] * (math.pi / 180.0),
            "height": -error[..., 2],
            "climb": -rate[..., 2],
            "leader_thrust": above[..., assembly.leader],
            "follower_thrust": assembly.of_followers(above)[..., 0],
            "leader_integral": zero if isinstance(integral, tuple) else integral[..., 2],
            "load": -gravity * known.moment + uneven + self._loop.kp * extra,
            "load_rate": -gravity * known.moment_rate,
            "lift": hover.sum(axis=-1) - gravity * mass + wind[..., 2],
            "wind": wind[..., 1] / mass,
        }
        return joined([values[name] for name in self._names])
