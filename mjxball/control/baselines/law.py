"""What a classical follower is made of, and what it is told before and during a flight."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

Array = Any


class Brief(NamedTuple):
    """What a follower is told at one control step. All leaves have the batch shape of the observation."""

    believed_mass: Array  # (...) mass of the object that the hover thrust assumes [kg]
    # Only `oracle` may look at what follows: the truth half a control step and one rotor lag ahead.
    moment: Array  # (...) object mass x CG offset [kg m]
    moment_acceleration: Array  # (...) object mass x second derivative of the CG offset [kg m/s2]
    total_mass: Array  # (...) of the assembly [kg]


class Law(Protocol):
    """A follower as two pure functions of arrays; `memory` is a tuple of arrays (possibly empty)."""

    name: str
    needs_truth: bool  # it reads the Brief's true CG

    def start(self, observation: Array) -> Any:
        """Memory at the start of a flight whose first observation is `observation` (..., 18)."""

    def step(self, memory: Any, observation: Array, brief: Brief) -> tuple[Any, Array]:
        """(memory, command (..., 3): roll, pitch [rad], vertical acceleration [m/s2]) at `observation` (..., 18)."""
