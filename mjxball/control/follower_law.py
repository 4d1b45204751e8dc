"""What surrounds a follower's network: what it sees and remembers, and how its action becomes a command.

One for training, for flight and for every export; all functions run on NumPy and on JAX arrays.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from mjxball.control import leader
from mjxball.control.multi_model_lqg import CONTEXT, MultiModelLqg
from mjxball.control.observation import (
    ACTION_SIZE,
    ERROR,
    ERROR_RATE,
    ObservationHistory,
    copy_command,
    scale_action,
)
from mjxball.control.offset_free import OffsetFreeLqg
from mjxball.control.team_lqg import TeamLqg

Array = Any
# What a recurrent network sees besides: tanh of the object's error and of its rate over these, so that millimetres at
# the goal are not lost beside metres on the way to it.
NEAR_ERROR, NEAR_ERROR_RATE = 0.03, 0.1  # [m], [m/s]
SATURATED = 6  # such numbers


class FollowerLaw(NamedTuple):
    """The laws around the network of one follower.

    Its memory (..., m) holds that of `history` and, behind it, that of `lqg` or the state of the network's GRU.
    """

    history: ObservationHistory
    action_scale: tuple[float, float]  # at an action of 1: tilt [rad], vertical acceleration [m/s2]
    limits: tuple[float, float]  # of a command: tilt [rad], vertical acceleration [m/s2]
    kp: Array  # (3,) of the leader's PD law
    kd: Array  # (3,)
    gravity: float  # [m/s2]
    residual: bool = True  # whether the action is added to a law: `lqg`, or the leader's PD law if that is None
    lqg: OffsetFreeLqg | TeamLqg | MultiModelLqg | None = None
    units: int = 0  # H of the network's GRU; then there is no `lqg`, and the network's answer has its state behind it
    geometry: bool = False  # whether a network with a GRU is told where the drones are mounted, `ring_context`

    @property
    def size(self) -> int:
        """Length m of the memory."""
        own = self.units + self.geometry * CONTEXT if self.lqg is None else self.lqg.size
        return self.history.size + own

    @property
    def shown(self) -> int:
        """How many numbers s `network_input` has behind an observation."""
        recurrent = SATURATED + self.geometry * CONTEXT + self.units if self.units else 0
        return self.history.size + (recurrent if self.lqg is None else self.lqg.shown)

    def mask(self, ignore_position: bool) -> list[float]:
        """1 for each number of `network_input` that the network uses, 0 for absolute positions if it ignores them."""
        return self.history.mask(ignore_position) + [1.0] * (self.shown - self.history.size)

    @property
    def needs_context(self) -> bool:
        """Whether a follower has to be told its team: `team_lqg.team_context`, `multi_model_lqg.ring_context`."""
        return self.geometry or isinstance(self.lqg, TeamLqg | MultiModelLqg)

    def start(self, observation: Array, context: Array | None = None) -> Array:
        """Memory (..., m) before the first `observation` (..., 18); `context` (..., c) if `needs_context`."""
        remembered = self.history.start(observation)
        xp = observation.__array_namespace__()
        if self.units:
            nothing = xp.zeros_like(observation[..., :1])
            parts = [remembered, *[nothing] * self.units]
            if self.geometry:
                known = xp.asarray(context, dtype=observation.dtype)
                parts.append(xp.broadcast_to(known, (*observation.shape[:-1], CONTEXT)))
            return xp.concat(parts, axis=-1)
        if self.lqg is None:
            return remembered
        known = {"context": context} if self.needs_context else {}
        return xp.concat([remembered, self.lqg.start(observation, **known)], axis=-1)

    @property
    def told(self) -> int:
        """How many of the last numbers of the memory never change."""
        return CONTEXT if self.geometry or isinstance(self.lqg, MultiModelLqg) else 0

    def known(self, observation: Array, memory: Array) -> Any:
        """What `network_input`, `command` and `next` have in common at `observation`, so that it is found once."""
        if not isinstance(self.lqg, MultiModelLqg):
            return None
        return self.lqg.known(memory[..., self.history.size :], observation, self._leader)

    def network_input(self, observation: Array, memory: Array, known: Any = None) -> Array:
        """Input of the network (..., 18 + s); here and below `known` may be given."""
        seen = self.history.network_input(observation, memory[..., : self.history.size])
        if self.units:
            xp = observation.__array_namespace__()
            small = [
                xp.tanh(observation[..., part] * (1 / scale))
                for part, scale in ((ERROR, NEAR_ERROR), (ERROR_RATE, NEAR_ERROR_RATE))
            ]
            behind = self.history.size + self.units
            hidden, placed = memory[..., self.history.size : behind], memory[..., behind:]
            return xp.concat([seen, *small, placed, hidden], axis=-1)
        if self.lqg is None:
            return seen
        features = self.lqg.features(memory[..., self.history.size :], observation, *_if_any(known))
        return observation.__array_namespace__().concat([seen, features], axis=-1)

    def command(self, scaled: Array, observation: Array, memory: Array, known: Any = None) -> Array:
        """Command (..., 3) of a network action `scaled` in [-1, 1] (..., 3) at `observation` (..., 18).

        Here and below `scaled` has the GRU's next state behind it, (..., 3 + H), if there is one.
        """
        if isinstance(self.lqg, MultiModelLqg):
            scaled = self.lqg.counted(scaled, memory)
        command = scale_action(scaled[..., :ACTION_SIZE], *self.action_scale)
        if self.lqg is not None:
            own = memory[..., self.history.size :]
            command = self.lqg.command(command, own, observation, self._leader, *_if_any(known))
        elif self.residual:
            command = command + copy_command(observation, *self._leader)
        return leader.clip_command(command, *self.limits)

    def next(self, memory: Array, observation: Array, scaled: Array, command: Array, known: Any = None) -> Array:
        """Memory for the next step, after `observation` was answered by `scaled`, which made `command`."""
        remembered = self.history.next(memory[..., : self.history.size], observation, scaled[..., :ACTION_SIZE])
        if self.units:
            placed = memory[..., self.history.size + self.units :]
            return observation.__array_namespace__().concat([remembered, scaled[..., ACTION_SIZE:], placed], axis=-1)
        if self.lqg is None:
            return remembered
        own = memory[..., self.history.size :]
        estimated = self.lqg.next(own, observation, command, self._leader, *_if_any(known))
        return observation.__array_namespace__().concat([remembered, estimated], axis=-1)

    @property
    def _leader(self) -> tuple[Any, ...]:
        """Arguments of `copy_command` after the observation."""
        return self.kp, self.kd, self.gravity, *self.limits


def _if_any(known: Any) -> tuple[Any, ...]:
    return (known,) if known else ()
