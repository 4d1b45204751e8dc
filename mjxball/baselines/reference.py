"""Reference followers: `stay` and `random` as lower bounds, and `oracle`, which knows the CG."""

from __future__ import annotations

from typing import Any

import numpy as np

from mjxball.arrays import Array
from mjxball.baselines.assembly_model import SIGNS, CopiedPid, assembly_model
from mjxball.config import Config
from mjxball.control.followers import PrivilegedInfo
from mjxball.control.leader import clip_command
from mjxball.control.observation import ACTION_SIZE, scale_action

RANDOM_COMMANDS = 4096  # after which `random` repeats itself


class Stay:
    """Level at hover thrust: the zero command."""

    name = "stay"
    needs_privileged = False

    def __init__(self, config: Config):
        pass

    def start(self, observation: Array) -> Any:
        """See `Controller.start`."""
        return ()

    def step(self, state: Any, observation: Array, privileged: PrivilegedInfo) -> tuple[Any, Array]:
        """See `Controller.step`."""
        return state, observation.__array_namespace__().zeros_like(observation[..., :ACTION_SIZE])


class Random:
    """Uniform commands within a policy's action scale, the same in every flight."""

    name = "random"
    needs_privileged = False

    def __init__(self, config: Config):
        actions = np.random.default_rng(0).uniform(-1.0, 1.0, (RANDOM_COMMANDS, ACTION_SIZE))
        self._commands = scale_action(actions, config.follower.action_scale_tilt, config.follower.action_scale_vertical)

    def start(self, observation: Array) -> Any:
        """See `Controller.start`."""
        xp = observation.__array_namespace__()
        return (xp.zeros_like(observation[..., 0], dtype=xp.int32),)

    def step(self, state: Any, observation: Array, privileged: PrivilegedInfo) -> tuple[Any, Array]:
        """See `Controller.step`."""
        xp = observation.__array_namespace__()
        (count,) = state
        return (count + 1,), xp.asarray(self._commands, dtype=observation.dtype)[count % RANDOM_COMMANDS]


class Oracle:
    """Feed-forward of the true CG (ours), for a pair with the CG along x:

    theta_f = theta_l - (g + az) m_o c / Kp_theta + 2 m_o c'' / (M g), roll and az as the leader. For a CG along y the
    same about roll, with the signs of both terms changed. Several followers share the CG's torque by
    `AssemblyModel.corrections`, with N / F in place of 2.
    """

    name = "oracle"
    needs_privileged = True

    def __init__(self, config: Config):
        self._pid = CopiedPid(config)
        self._limits = config.command.tilt_limit, config.command.vertical_limit
        self._model = assembly_model(config, self.name)

    def start(self, observation: Array) -> Any:
        """See `Controller.start`."""
        return self._pid.start(self._model.seen(observation))

    def step(self, state: Any, observation: Array, privileged: PrivilegedInfo) -> tuple[Any, Array]:
        """See `Controller.step`."""
        xp, model = observation.__array_namespace__(), self._model
        state, copied = self._pid.step(state, model.seen(observation))
        weight = (model.gravity + copied[..., 2:]) * self._torques(privileged.moment)
        wrench = xp.concat([0.0 * weight[..., :1], -weight], axis=-1)
        trim = model.corrections(wrench, model.carried(model.of_flight(privileged.believed_mass)))
        ahead = len(model.own_mass) / model.followers / (model.of_flight(privileged.total_mass) * model.gravity)
        reaction = ahead[..., None] * self._torques(privileged.moment_acceleration)
        vertical = model.without_extra_lift(copied[..., None, 2] + trim[..., 2], trim[..., :2])
        tilt = copied[..., None, :2] + trim[..., :2] + reaction[..., None, :]
        command = xp.concat([tilt, vertical[..., None]], axis=-1)
        return state, model.sent(clip_command(command, *self._limits))

    def _torques(self, moment: Array) -> Array:
        """Roll and pitch torque (..., 2) over gravity of the load's `moment`, in the form of `PrivilegedInfo`."""
        xp, model = moment.__array_namespace__(), self._model
        if model.angles is None:
            return model.on_axes(SIGNS[model.axes[0]] * moment[..., None])
        flat = model.seen(xp.concat([moment, 0.0 * moment[..., :1]], axis=-1))
        return xp.stack([-flat[..., 1], flat[..., 0]], axis=-1)
