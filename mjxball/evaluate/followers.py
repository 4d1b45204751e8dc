"""Followers by name: classical ones, and a user's `module:Class`, whose answers are checked."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from mjxball.baselines import CONTROLLERS, make_baseline
from mjxball.config import Config
from mjxball.control.followers import Baseline, Follower, checked_command
from mjxball.errors import FOREIGN, InputError, said

MAX_COMMAND = 1e9  # of a command, in rad and m/s2; larger values soon overflow when squared
FollowerFactory = Callable[[Config], Follower]  # InputError if the follower does not fly that plant


def follower_factory(text: str, flag: str) -> tuple[str, FollowerFactory]:
    """(name, function that makes it for a plant) of a classical follower or of the class `text` = module:Class.

    The class is called with the `Config` and is a `mjxball.control.followers.Controller` or a `Follower`. Raises
    InputError, which names the flag `flag`, if there is none of that name.
    """
    if text in CONTROLLERS or ":" not in text:
        return text, lambda config: make_baseline(text, config)
    from mjxball.train.extensions import find  # with JAX

    made, name = find(text, flag), text.rpartition(":")[2]
    return name, lambda config: _user_follower(name, made, config)


class UserFollower:
    """A user's `Follower` whose answers are checked."""

    def __init__(self, name: str, answer: Any):
        self.name, self._answer = name, answer

    def reset(self) -> None:
        """See `Follower.reset`."""
        _guarded(self.name, self._answer.reset)

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """See `Follower.__call__`; InputError if it raises or returns no command."""
        copied = np.array(observation)  # the user's code may write to it
        return answered(self.name, _guarded(self.name, self._answer, copied, given=observation), observation)


class UserController:
    """A user's `Controller` whose answers are checked."""

    def __init__(self, name: str, controller: Any):
        self.name, self._controller = name, controller
        self.needs_privileged = bool(_guarded(name, getattr, controller, "needs_privileged", False))

    def start(self, observation: Any) -> Any:
        """See `Controller.start`."""
        return _guarded(self.name, self._controller.start, observation, given=observation)

    def step(self, state: Any, observation: Any, privileged: Any) -> Any:
        """See `Controller.step`."""
        answer = _guarded(self.name, self._controller.step, state, observation, privileged, given=observation)
        if not isinstance(answer, tuple) or len(answer) != 2:
            raise InputError(
                f"follower {self.name} answered {type(answer).__name__}; step must return (state, command)"
            )
        return answer[0], answered(self.name, answer[1], observation)


def _user_follower(name: str, made: Any, config: Config) -> Follower:
    found = _guarded(f"{name}(config)", made, config)
    found = found.controller if isinstance(found, Baseline) else found
    has = {part for part in ("start", "step", "reset") if callable(_guarded(name, getattr, found, part, None))}
    if has >= {"start", "step"}:
        return Baseline(UserController(name, found), config)
    if callable(found) and "reset" in has:
        return UserFollower(name, found)
    raise InputError(
        f"follower {name} has neither start and step nor reset and __call__; see docs/howto/own-baseline.md"
    )


def _guarded(name: str, function: Any, *arguments: Any, given: Any = None) -> Any:
    try:
        return function(*arguments)
    except InputError:
        raise
    except FOREIGN as error:  # whatever somebody else's code raises
        observed = "" if given is None else f", given observations of shape {np.shape(given)}"
        raise InputError(f"follower {name} raised {said(error)}{observed}") from None


def answered(name: str, command: Any, observation: np.ndarray) -> np.ndarray:
    """`checked_command` of follower `name`; InputError also if it is not finite or exceeds `MAX_COMMAND`."""
    found = checked_command(name, command, observation)
    if not (np.abs(found) <= MAX_COMMAND).all():
        raise InputError(f"follower {name} answered a number that is not finite, or larger than {MAX_COMMAND:g}")
    return found
