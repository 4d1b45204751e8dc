"""A trained follower, ready to be called once per control period."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import Any

import numpy as np

from mjxball.config import LEAST_LIFTING, Attitude, Plant
from mjxball.control import observation as layout
from mjxball.control.follower_law import FollowerLaw
from mjxball.control.followers import OneThread, checked_observation
from mjxball.control.multi_model_lqg import CONTEXT, MultiModelLqg, team_geometry
from mjxball.control.network import Network
from mjxball.control.team_lqg import team_context
from mjxball.errors import InputError
from mjxball.plant import plant_parameters
from mjxball.policy.file import PolicyFile, law_of, load_file
from mjxball.policy.single import SingleFollower, single_follower
from mjxball.policy.single_network import SinglePdFollower

Array = Any
ROUNDED = 1e-5  # that a GRU's state may be beyond 1


def not_told(name: str) -> InputError:
    """What to say where nobody has told a policy its team."""
    return InputError(f"policy {name} has to be told its team: --plant NAME or FILE.toml, such as team4")


def context_of(name: str, card: dict[str, Any], plant: Plant | None, attitude: Attitude | None) -> np.ndarray:
    """What each follower of a team on `plant` is told, (F, c), or (c,) of one follower.

    `name` and `card` of a policy of format 3 (`team_lqg.team_context`) or 4 (`multi_model_lqg.team_geometry`, for any
    team). Raises InputError if the attitude loops are not those that its law is for, or without a plant.
    """
    if plant is None or attitude is None:
        raise not_told(name)
    if card["format_version"] in (4, 5):
        mounts = np.array([drone.mount for drone in plant.drones])
        return np.asarray(team_geometry(plant, mounts, np.float64(plant.count)))
    made_for, found = float(card["lqg"]["stiffness"]) ** 0.5, attitude.natural_frequency[:2]
    if plant.stand != "free" or max(abs(frequency - made_for) for frequency in found) > 1e-6 * made_for:
        raise InputError(
            f"policy {name} was made for free flight with attitude loops of {made_for:g} rad/s, "
            f"not {found[0]:g} and {found[1]:g} on a stand that is {plant.stand}"
        )
    if float(card["lqg"].get("lifting", 0)) > 0 and plant.count < LEAST_LIFTING:
        raise InputError(f"policy {name} needs a team of at least {LEAST_LIFTING} drones, not {plant.count}")
    return np.asarray(team_context(plant_parameters(plant, attitude), plant, np.float64(plant.object_mass)))


def known_context(card: dict[str, Any], name: str) -> np.ndarray | None:
    """What a policy of format 3 or 4 has in its card of the team that it is for, (c,); None for other formats.

    Raises InputError if it is told its team by `Policy.join` alone.
    """
    team = card.get("team")
    return _known(name, law_of(card), None if team is None else np.array(team["context"]))


class Policy:
    """A follower from a policy file. It remembers past observations if the file asks for them.

    One instance serves one flight, or one batch of worlds, of one thread: `reset()` starts anew. `law` is the same as
    pure functions, memory in and memory out.
    """

    def __init__(self, contents: PolicyFile, name: str, dtype: type = np.float32):
        """Prepare `contents` for inference in `dtype` (float32 on the laptop, float64 for tests)."""
        card = contents.card
        self.name = name
        self.card = card
        self.control_period = float(card["control_period"])
        self._dtype = np.dtype(dtype)
        half = layout.ACTION_SIZE
        weights = [*contents.weights[:-1], contents.weights[-1][:, :half]]
        biases = [*contents.biases[:-1], contents.biases[-1][:half]]
        self._weights: list[np.ndarray] = [np.ascontiguousarray(weight, dtype) for weight in weights]
        self._biases: list[np.ndarray] = [np.ascontiguousarray(bias, dtype) for bias in biases]
        self._mean: np.ndarray = contents.observation_mean.astype(dtype)
        self._scale: np.ndarray = contents.observation_scale.astype(dtype)
        gru: Any = None if contents.gru is None else tuple(np.ascontiguousarray(part, dtype) for part in contents.gru)
        self._network = Network(self._weights, self._biases, self._mean, self._scale, gru)
        self._law = law_of(card)
        told = self._law.needs_context and "team" in card
        self._context: Array | None = np.array(card["team"]["context"], dtype) if told else None
        self._memory: Array | None = None
        self._thread = OneThread()
        self._single: SingleFollower | SinglePdFollower | None = None
        self._answers_alone = True  # as far as is known
        self._ahead = False  # whether `_single` has the memory, newer than `_memory`

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Policy:
        """Load a policy file; raise PolicyFileError with one sentence if it is unsound."""
        return cls(load_file(path), Path(path).stem)

    def join(self, plant: Plant, attitude: Attitude) -> None:
        """Tell it the team in which it flies, if it needs to know; before its first call.

        Raises InputError if the team's attitude loops are not those that its law is for.
        """
        if self._law.needs_context:
            if not plant.is_team and not self._law.told:
                raise InputError(f"policy {self.name} was made for teams, or a load that moves in the plane")
            self._context = context_of(self.name, self.card, plant, attitude).astype(self._dtype)

    def reset(self) -> None:
        """Forget past observations: the next call starts an episode."""
        self.memory = None

    @property
    def law(self) -> NetworkLaw:
        """What it answers and remembers, as pure functions."""
        return NetworkLaw(self)

    @property
    def memory(self) -> Array:
        """What it remembers (..., m), see `control.follower_law.FollowerLaw`; None: nothing yet."""
        if self._ahead and self._single is not None:
            return self._single.memory
        return self._memory

    @memory.setter
    def memory(self, memory: Array) -> None:
        """Raises InputError, and keeps the old one, unless `memory` is of m finite numbers, of a GRU up to 1."""
        self._memory, self._ahead = None if memory is None else self._checked(memory), False
        self._thread.forget()

    @property
    def hidden(self) -> Array | None:
        """State of the network's GRU (..., H) in `memory`, each number from -1 to 1; None: no GRU, or nothing yet."""
        units, first = self._law.units, self._law.history.size
        memory = self.memory if units else None
        return None if memory is None else memory[..., first : first + units]

    def __getstate__(self) -> dict[str, Any]:
        """For copies, which share neither the buffers of `_single` nor the thread."""
        return {**self.__dict__, "_memory": self.memory, "_single": None, "_ahead": False, "_thread": OneThread()}

    def scaled(self, observation: Array) -> Array:
        """The network's action in [-1, 1] (..., 3) for `observation` (..., 18), remembered if need be."""
        return self._answer(observation)[0]

    def __call__(self, observation: Array) -> Array:
        """Command (..., 3) = roll, pitch [rad], vertical acceleration [m/s2] for `observation` (..., 18).

        Raises InputError for what is no observation (`checked_observation`) or has no finite answer, and remembers
        nothing of it; RuntimeError if the flight that it remembers is another thread's.
        """
        return self._answer(observation)[1]

    def _answer(self, observation: Array) -> tuple[Array, Array]:
        """(action in [-1, 1], command) for `observation`, remembered if need be."""
        observation = checked_observation(observation).astype(self._dtype, copy=False)
        remembers = self._law.size > 0
        if remembers:
            self._thread.check(self.name)
        if observation.ndim == 1 and remembers and self._answers_alone:
            alone = self._answer_alone(observation)
            if alone is not None:
                return alone
        law, memory = self.law, self.memory if remembers else None
        with np.errstate(all="ignore"):  # what is not finite is refused below
            action, command, memory = law.answer(law.start(observation) if memory is None else memory, observation)
        if not math.isfinite(float(command.sum()) + float(memory.sum())):
            raise InputError(f"policy {self.name} has no answer to an observation: what it computes is not finite")
        if remembers:
            self._memory, self._ahead = memory, False
        return action, command

    def _answer_alone(self, observation: Array) -> tuple[Array, Array] | None:
        """`_answer` to one observation (18,), by a `SingleFollower`; None if that cannot answer it."""
        if self._single is None:
            self._single = single_follower(self._law, self._network)
            self._answers_alone = self._single is not None
        if self._single is None:
            return None
        if not self._ahead:
            memory = self.law.start(observation) if self._memory is None else self._memory
            # Of several followers, or one whose share of the command is 0, by which it divides.
            if memory.ndim > 1 or (isinstance(self._law.lqg, MultiModelLqg) and memory[-CONTEXT] <= 0):
                return None
            self._single.memory = memory
        found = self._single.answer(observation)
        if found is None:
            return None
        self._ahead = True
        return np.array(found[0], self._dtype), np.array(found[1], self._dtype)

    def _checked(self, memory: Array) -> Array:
        """A copy of `memory`, or InputError unless it is one that this policy may have."""
        given, size = np.asarray(memory), self._law.size
        if given.dtype.kind not in "fiu" or given.shape[-1:] != (size,):
            raise InputError(f"policy {self.name} remembers {size} numbers, not {given.dtype} of shape {given.shape}")
        with np.errstate(over="ignore"):
            own = np.array(given, self._dtype)
        if not np.isfinite(own).all():
            raise InputError(f"a memory of policy {self.name} must be finite, and this one is not finite")
        first = self._law.history.size
        if (np.abs(own[..., first : first + self._law.units]) > 1 + ROUNDED).any():
            raise InputError(f"a memory of policy {self.name} has a GRU's state beyond 1: it is another policy's")
        return own


class NetworkLaw:
    """A policy as pure functions of arrays (see `control.followers.Law`), on NumPy or JAX, for any number of threads.

    What they are given is not checked, so that JAX can trace them.
    """

    needs_privileged = False

    def __init__(self, policy: Policy):
        self.name = policy.name
        self._network = policy._network
        self._law = policy._law
        self._context = policy._context

    def start(self, observation: Array) -> Array:
        """Memory at the start of a flight whose first observation is `observation` (..., 18)."""
        return self._law.start(observation, _known(self.name, self._law, self._context))

    @property
    def units(self) -> int:
        """H of the network's GRU, whose state ends what is `shown`; 0 without one."""
        return self._law.units

    def shown(self, observation: Array, memory: Array) -> Array:
        """What the network sees of its `memory` (..., s)."""
        return self._law.network_input(observation, memory)[..., layout.OBSERVATION_SIZE :]

    def step(self, memory: Array, observation: Array, privileged: Any) -> tuple[Array, Array]:
        """(memory, command (..., 3)) at `observation` (..., 18); `privileged` is not read."""
        _, command, memory = self.answer(memory, observation)
        return memory, command

    def answer(self, memory: Array, observation: Array) -> tuple[Array, Array, Array]:
        """(action in [-1, 1] (..., 3), command (..., 3), memory of the next step) at `observation` (..., 18)."""
        known = self._law.known(observation, memory)
        seen = self._law.network_input(observation, memory, known) if self._law.size else observation
        answer = self._network.like(observation)(seen)
        command = self._law.command(answer, observation, memory, known)
        remembered = self._law.next(memory, observation, answer, command, known)
        return answer[..., : layout.ACTION_SIZE], command, remembered


def _known(name: str, law: FollowerLaw, context: Array | None) -> Array | None:
    """`context`, or InputError if the law needs one and there is none."""
    if law.needs_context and context is None:
        raise InputError(f"policy {name} has to be told its team before it flies (Policy.join)")
    return context
