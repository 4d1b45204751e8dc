"""Feed-forward from the true CG: what a follower could do that knew everything (ours)."""

from __future__ import annotations

from typing import Any

from mjxball.config import Config
from mjxball.control.baselines.gains import PitchGains, copied_law, pitch_gains
from mjxball.control.baselines.law import Brief
from mjxball.control.leader import clip_command
from mjxball.control.observation import copy_command

Array = Any


class Oracle:
    """theta_f = theta_l - (g + az) m_o c / Kp_theta + 2 m_o c'' / (M g), roll and az as the leader."""

    name = "oracle"
    needs_truth = True

    def __init__(self, config: Config):
        self._law = copied_law(config)
        self._gains: PitchGains = pitch_gains(config, self.name)

    def start(self, observation: Array) -> Any:
        """See `Law.start`."""
        return ()

    def step(self, memory: Any, observation: Array, brief: Brief) -> tuple[Any, Array]:
        """See `Law.step`."""
        xp = observation.__array_namespace__()
        roll, pitch, vertical = (copy_command(observation, *self._law)[..., k] for k in range(3))
        gravity = self._gains.gravity
        pitch = pitch - (gravity + vertical) * brief.moment / self._gains.kp
        pitch = pitch + 2.0 * brief.moment_acceleration / (brief.total_mass * gravity)
        command = xp.stack([roll, pitch, vertical], axis=-1)
        return memory, clip_command(command, *self._law[3:])
