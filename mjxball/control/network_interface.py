"""The inputs and memory of a follower's network, and the command that its action becomes.

Training, flight and every export use it; all functions run on NumPy and on JAX arrays.
"""

from __future__ import annotations

from typing import NamedTuple

from mjxball.arrays import Array
from mjxball.control import leader
from mjxball.control.geometry import GEOMETRY_SIZE
from mjxball.control.observation import (
    ACTION_SIZE,
    ERROR,
    ERROR_RATE,
    OBSERVATION_SIZE,
    ObservationHistory,
    copy_command,
    scale_action,
)

# What a recurrent network sees besides: tanh of the object's error and of its rate over these, so that millimetres at
# the goal are not lost beside metres on the way to it.
NEAR_ERROR, NEAR_ERROR_RATE = 0.03, 0.1  # [m], [m/s]
SATURATED = 6  # such numbers


class NetworkInterface(NamedTuple):
    """Between observation, network and command of one follower.

    The memory (..., m) holds that of `history`, the state of the network's GRU, and its team's geometry.
    """

    history: ObservationHistory
    action_scale: tuple[float, float]  # at an action of 1: tilt [rad], vertical acceleration [m/s2]
    limits: tuple[float, float]  # of a command: tilt [rad], vertical acceleration [m/s2]
    kp: Array  # (3,) of the leader's PD controller
    kd: Array  # (3,)
    gravity: float  # [m/s2]
    residual: bool = True  # whether the action is added to the leader's PD controller
    units: int = 0  # H of the network's GRU, whose answer has its next state behind it
    geometry: bool = False  # whether a network with a GRU knows where the drones are mounted, `control.geometry`

    @property
    def size(self) -> int:
        """Length m of the memory."""
        return self.history.size + self.units + self._geometry_size

    @property
    def input_size(self) -> int:
        """Size n of `network_input` without a GRU's state."""
        return OBSERVATION_SIZE + self.history.input_size + (SATURATED if self.units else 0) + self._geometry_size

    def mask(self, ignore_position: bool) -> list[float]:
        """1 for components of `network_input` that the network uses, 0 for absolute positions if it ignores them."""
        shown = self.history.mask(ignore_position)
        return shown + [1.0] * (self.input_size + self.units - len(shown))

    @property
    def _geometry_size(self) -> int:
        return self.geometry * GEOMETRY_SIZE

    def start(self, observation: Array, geometry: Array | None = None) -> Array:
        """Memory (..., m) before the first `observation` (..., 18); `geometry` (..., 4) if `geometry` is set."""
        remembered = self.history.start(observation)
        if not self.units:
            return remembered
        xp = observation.__array_namespace__()
        parts = [remembered, *[xp.zeros_like(observation[..., :1])] * self.units]
        if self.geometry:
            parts.append(xp.zeros_like(observation[..., :1]) + xp.asarray(geometry, dtype=observation.dtype))
        return xp.concat(parts, axis=-1)

    def network_input(self, observation: Array, memory: Array) -> Array:
        """Input of the network (..., n + H), a GRU's state at its end."""
        seen = self.history.network_input(observation, memory[..., : self.history.size])
        if not self.units:
            return seen
        xp, known = observation.__array_namespace__(), memory[..., self.history.size + self.units :]
        small = [
            xp.tanh(observation[..., part] * (1 / scale))
            for part, scale in ((ERROR, NEAR_ERROR), (ERROR_RATE, NEAR_ERROR_RATE))
        ]
        return xp.concat([seen, *small, known, self.hidden(memory)], axis=-1)

    def hidden(self, memory: Array) -> Array:
        """State (..., H) of the network's GRU in `memory` (..., m)."""
        return memory[..., self.history.size : self.history.size + self.units]

    def command(self, action: Array, observation: Array) -> Array:
        """Command (..., 3) of a network action `action` in [-1, 1] (..., 3) at `observation` (..., 18).

        Here and below `action` has the GRU's next state behind it, (..., 3 + H), if there is one.
        """
        command = scale_action(action[..., :ACTION_SIZE], *self.action_scale)
        if self.residual:
            command = command + copy_command(observation, self.kp, self.kd, self.gravity, *self.limits)
        return leader.clip_command(command, *self.limits)

    def next(self, memory: Array, observation: Array, action: Array) -> Array:
        """Memory for the next step, after `observation` was answered by `action`."""
        remembered = self.history.next(memory[..., : self.history.size], observation, action[..., :ACTION_SIZE])
        if not self.units:
            return remembered
        known = memory[..., self.history.size + self.units :]
        return observation.__array_namespace__().concat([remembered, action[..., ACTION_SIZE:], known], axis=-1)
