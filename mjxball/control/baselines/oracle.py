"""Feed-forward from the true CG: what a follower could do that knew everything (ours)."""

from __future__ import annotations

from typing import Any

from mjxball.config import Config
from mjxball.control.baselines.gains import CopiedPid, LoadAxis, load_axis
from mjxball.control.baselines.law import Brief
from mjxball.control.leader import clip_command

Array = Any


class Oracle:
    """theta_f = theta_l - (g + az) m_o c / Kp_theta + 2 m_o c'' / (M g), roll and az as the leader.

    With the CG along y the same of roll, both terms with the other sign.
    """

    name = "oracle"
    needs_truth = True

    def __init__(self, config: Config):
        self._pid = CopiedPid(config)
        self._limits = config.leader.tilt_limit, config.leader.vertical_limit
        self._gains: LoadAxis = load_axis(config, self.name)

    def start(self, observation: Array) -> Any:
        """See `Law.start`."""
        return self._pid.start(observation)

    def step(self, memory: Any, observation: Array, brief: Brief) -> tuple[Any, Array]:
        """See `Law.step`."""
        xp = observation.__array_namespace__()
        memory, copied = self._pid.step(memory, observation)
        axis, sign, gravity = self._gains.axis, self._gains.sign, self._gains.gravity
        tilts, vertical = [copied[..., 0], copied[..., 1]], copied[..., 2]
        trim = -sign * (gravity + vertical) * brief.moment / self._gains.kp
        tilts[axis] = tilts[axis] + trim
        tilts[axis] = tilts[axis] + sign * 2.0 * brief.moment_acceleration / (brief.total_mass * gravity)
        vertical = self._gains.unlifted(vertical, trim)
        return memory, clip_command(xp.stack([*tilts, vertical], axis=-1), *self._limits)
