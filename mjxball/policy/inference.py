"""Inference of a trained follower, called once per control period."""

from __future__ import annotations

import math
import os
from typing import Any

import numpy as np

from mjxball.arrays import Array, real_numbers
from mjxball.config import Plant
from mjxball.control import observation as layout
from mjxball.control.followers import OneThread, check_batch, checked_observation
from mjxball.control.geometry import team_geometry
from mjxball.control.network import Network
from mjxball.control.network_interface import NetworkInterface
from mjxball.errors import InputError
from mjxball.policy.file import PolicyFile, interface_of, load_file, policy_name

ROUNDED = 1e-5  # tolerance for a GRU's state beyond 1, from rounding


def missing_team_error(name: str) -> InputError:
    """The error for a policy that needs the geometry of its team and has none."""
    return InputError(f"policy {name} must know its team: --plant NAME or FILE.toml, such as team4")


def geometry_of(plant: Plant) -> np.ndarray:
    """Geometry of the team on `plant` for each follower (F, 4), or (4,) for one follower (`control.geometry`)."""
    return np.asarray(team_geometry(plant, np.array([drone.mount for drone in plant.drones]), np.float64(plant.count)))


def known_geometry(metadata: dict[str, Any], name: str) -> np.ndarray | None:
    """Geometry of the team in a policy's metadata, (4,); None for a policy that takes no geometry.

    Raises InputError if it needs geometry that the metadata do not contain.
    """
    team = metadata.get("team")
    return _geometry_for(name, interface_of(metadata), None if team is None else np.array(team["context"]))


class Policy:
    """A follower from a policy file, with the memory of past observations that its network needs.

    One instance serves one flight, or one batch of worlds, in one thread; `reset()` starts another. `controller` is the
    same controller as pure functions of memory and observation.
    """

    def __init__(self, contents: PolicyFile, name: str, dtype: type = np.float32):
        """Prepare `contents` for inference in `dtype` (float32 on the laptop, float64 for tests)."""
        metadata = contents.metadata
        self.name = name
        self.metadata = metadata
        self.control_period = float(metadata["control_period"])
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
        self._interface = interface_of(metadata)
        known = self._interface.geometry and "team" in metadata
        self._geometry: Array | None = np.array(metadata["team"]["context"], dtype) if known else None
        self._memory: Array | None = None
        self._thread = OneThread()

    @property
    def _facts(self) -> dict[str, object]:
        """Properties that a representation shows, by label; None if absent."""
        layers = [len(bias) for bias in self._biases[:-1]]
        run = {
            "preset": self.metadata.get("preset"),
            "seed": self.metadata.get("seed"),
            "steps": self.metadata["training_steps"],
        }
        return {
            **run,
            "GRU": self._interface.units or None,
            "layers": layers,
            "period": f"{1e3 * self.control_period:g} ms",
        }

    def __repr__(self) -> str:
        facts = ", ".join(f"{name} {value}" for name, value in self._facts.items() if value is not None)
        return f"<Policy {self.name}: {facts}>"

    def _repr_html_(self) -> str:
        """HTML for notebooks: the run that trained it, and its learning curve."""
        from mjxball import pictures

        curve, lines = self.metadata.get("curve") or {}, []
        if curve.get("steps"):
            lines = [pictures.Curve("exploring", curve["steps"], curve["episode_return"])]
            lines += [pictures.Curve("evaluated", curve["eval_steps"], curve["eval_return"], dots=True)]
        plot = pictures.curves(lines, "environment steps", "return of an episode") if lines else ""
        facts = {name: value for name, value in self._facts.items() if value is not None}
        return pictures.summary(f"policy {self.name}", facts, plot)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Policy:
        """Load a policy file. Raises PolicyFileError, with one sentence, if it is invalid."""
        return cls(load_file(path), policy_name(path))

    def join(self, plant: Plant) -> None:
        """Set the geometry of the team on `plant`, if the policy takes it. Must precede the first call."""
        if self._interface.geometry:
            self._geometry = geometry_of(plant).astype(self._dtype)

    def reset(self) -> None:
        """Clear the memory: the next call starts an episode."""
        self.memory = None

    @property
    def controller(self) -> NetworkController:
        """The same controller as pure functions."""
        return NetworkController(self)

    @property
    def memory(self) -> Array:
        """Memory (..., m), see `control.network_interface.NetworkInterface`; None before the first call."""
        return self._memory

    @memory.setter
    def memory(self, memory: Array) -> None:
        """Raises InputError, without a change, unless `memory` is finite, (..., m), and a GRU's state in [-1, 1]."""
        self._memory = None if memory is None else self._checked(memory)
        self._thread.forget()

    @property
    def hidden(self) -> Array | None:
        """State of the GRU (..., H) in [-1, 1], a part of `memory`; None without a GRU or before the first call."""
        memory = self.memory if self._interface.units else None
        return None if memory is None else self._interface.hidden(memory)

    def __getstate__(self) -> dict[str, Any]:
        """State of a copy, which may be used in another thread."""
        return {**self.__dict__, "_thread": OneThread()}

    def action(self, observation: Array) -> Array:
        """The network's action in [-1, 1] (..., 3) for `observation` (..., 18); updates the memory."""
        return np.asarray(self._answer(observation)[0], self._dtype)

    def __call__(self, observation: Array) -> Array:
        """Command (..., 3) = roll, pitch [rad], vertical acceleration [m/s2] for `observation` (..., 18).

        Raises InputError, without a change of memory, for an invalid observation (`checked_observation`) or a result
        that is not finite; RuntimeError if the memory belongs to a flight in another thread.
        """
        return np.asarray(self._answer(observation)[1], self._dtype)

    def _answer(self, observation: Array) -> tuple[Array, Array]:
        """(action in [-1, 1], command) for `observation`; updates the memory."""
        observation = checked_observation(observation).astype(self._dtype, copy=False)
        remembers = self._interface.size > 0
        if remembers:
            self._thread.check(self.name)
        controller, memory = self.controller, self.memory if remembers else None
        if memory is not None:
            check_batch(self.name, memory.shape[:-1], observation)
        with np.errstate(all="ignore"):  # results that are not finite are refused below
            action, command, memory = controller.answer(
                controller.start(observation) if memory is None else memory, observation
            )
        if not math.isfinite(float(command.sum()) + float(memory.sum())):
            raise InputError(f"policy {self.name} has no answer to an observation: what it computes is not finite")
        if remembers:
            self._memory = memory
        return action, command

    def _checked(self, memory: Array) -> Array:
        """A copy of `memory`. Raises InputError unless it can be a memory of this policy."""
        given, size = real_numbers(memory, f"a memory of policy {self.name}"), self._interface.size
        if given.shape[-1:] != (size,):
            raise InputError(f"policy {self.name} remembers {size} numbers, not an array of shape {given.shape}")
        with np.errstate(over="ignore"):
            copied = np.array(given, self._dtype)
        if not np.isfinite(copied).all():
            raise InputError(f"a memory of policy {self.name} must be finite, and this one is not finite")
        if (np.abs(self._interface.hidden(copied)) > 1 + ROUNDED).any():
            raise InputError(f"a memory of policy {self.name} has a GRU's state beyond 1: it is another policy's")
        return copied


class NetworkController:
    """A policy as pure functions of NumPy or JAX arrays (`control.followers.Controller`), for any number of threads.

    Arguments are not checked, so that JAX can trace the functions.
    """

    needs_privileged = False

    def __init__(self, policy: Policy):
        self.name = policy.name
        self._network = policy._network
        self._interface = policy._interface
        self._geometry = policy._geometry

    def start(self, observation: Array) -> Array:
        """Memory at the start of a flight whose first observation is `observation` (..., 18).

        Raises InputError if it needs a geometry that is not set, or is set for another number of followers.
        """
        geometry = _geometry_for(self.name, self._interface, self._geometry)
        if geometry is not None and geometry.ndim > 1 and observation.shape[-2:-1] != geometry.shape[:1]:
            joined = f"policy {self.name} joined a team of {len(geometry)} followers (Policy.join)"
            raise InputError(f"{joined}, and an observation of shape {observation.shape} is not of so many")
        return self._interface.start(observation, geometry)

    def hidden(self, memory: Array) -> Array:
        """State (..., H) of the network's GRU in `memory` (..., m)."""
        return self._interface.hidden(memory)

    def step(self, memory: Array, observation: Array, privileged: Any) -> tuple[Array, Array]:
        """(memory, command (..., 3)) at `observation` (..., 18); `privileged` is not read."""
        _, command, memory = self.answer(memory, observation)
        return memory, command

    def answer(self, memory: Array, observation: Array) -> tuple[Array, Array, Array]:
        """(action in [-1, 1] (..., 3), command (..., 3), memory of the next step) at `observation` (..., 18)."""
        network_input = self._interface.network_input(observation, memory) if self._interface.size else observation
        output = self._network.like(observation)(network_input)
        command, after = (
            self._interface.command(output, observation),
            self._interface.next(memory, observation, output),
        )
        return output[..., : layout.ACTION_SIZE], command, after


def _geometry_for(name: str, interface: NetworkInterface, geometry: Array | None) -> Array | None:
    """`geometry`. Raises InputError if it is None and `interface` needs it."""
    if interface.geometry and geometry is None:
        raise InputError(f"policy {name} must know its team before it flies (Policy.join)")
    return geometry
