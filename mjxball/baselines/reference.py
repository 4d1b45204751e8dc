"""Reference followers: `stay` and `random`, which anything must beat, and `oracle`, which knows the CG."""

from __future__ import annotations

from typing import Any

import numpy as np

from mjxball.baselines.load_axis import CopiedPid, LoadAxis, load_axis
from mjxball.config import Config
from mjxball.control.followers import PrivilegedInfo
from mjxball.control.leader import clip_command
from mjxball.control.observation import ACTION_SIZE, scale_action

Array = Any
RANDOM_COMMANDS = 4096  # after which `random` repeats itself


class Stay:
    """Level at hover thrust: the zero command."""

    name = "stay"
    needs_privileged = False

    def __init__(self, config: Config):
        pass

    def start(self, observation: Array) -> Any:
        """See `Law.start`."""
        return ()

    def step(self, state: Any, observation: Array, privileged: PrivilegedInfo) -> tuple[Any, Array]:
        """See `Law.step`."""
        return state, observation.__array_namespace__().zeros_like(observation[..., :ACTION_SIZE])


class Random:
    """Uniform commands within a policy's action scale, the same in every flight."""

    name = "random"
    needs_privileged = False

    def __init__(self, config: Config):
        actions = np.random.default_rng(0).uniform(-1.0, 1.0, (RANDOM_COMMANDS, ACTION_SIZE))
        self._commands = scale_action(actions, config.follower.action_scale_tilt, config.follower.action_scale_vertical)

    def start(self, observation: Array) -> Any:
        """See `Law.start`."""
        xp = observation.__array_namespace__()
        return (xp.zeros_like(observation[..., 0], dtype=xp.int32),)

    def step(self, state: Any, observation: Array, privileged: PrivilegedInfo) -> tuple[Any, Array]:
        """See `Law.step`."""
        xp = observation.__array_namespace__()
        (count,) = state
        return (count + 1,), xp.asarray(self._commands, dtype=observation.dtype)[count % RANDOM_COMMANDS]


class Oracle:
    """Feed-forward of the true CG (ours), for a CG along x:

    theta_f = theta_l - (g + az) m_o c / Kp_theta + 2 m_o c'' / (M g), roll and az as the leader.
    With the CG along y the same of roll, both terms with the other sign.
    """

    name = "oracle"
    needs_privileged = True

    def __init__(self, config: Config):
        self._pid = CopiedPid(config)
        self._limits = config.command.tilt_limit, config.command.vertical_limit
        self._load_axis: LoadAxis = load_axis(config, self.name)

    def start(self, observation: Array) -> Any:
        """See `Law.start`."""
        return self._pid.start(observation)

    def step(self, state: Any, observation: Array, privileged: PrivilegedInfo) -> tuple[Any, Array]:
        """See `Law.step`."""
        xp = observation.__array_namespace__()
        state, copied = self._pid.step(state, observation)
        axis, sign, gravity = self._load_axis.axis, self._load_axis.sign, self._load_axis.gravity
        tilts, vertical = [copied[..., 0], copied[..., 1]], copied[..., 2]
        trim = -sign * (gravity + vertical) * privileged.moment / self._load_axis.kp
        tilts[axis] = tilts[axis] + trim
        tilts[axis] = tilts[axis] + sign * 2.0 * privileged.moment_acceleration / (privileged.total_mass * gravity)
        vertical = self._load_axis.less_extra_lift(vertical, trim)
        return state, clip_command(xp.stack([*tilts, vertical], axis=-1), *self._limits)
