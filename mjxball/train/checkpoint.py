"""Checkpoints of a run with Orbax: the whole training state, written in the background."""

from __future__ import annotations

import contextlib
import logging
import sys
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from mjxball.config import Config
from mjxball.errors import InputError
from mjxball.terminal import warn
from mjxball.train.curves import best_member, read_members
from mjxball.train.extensions import Extensions, is_transport_env, resolve
from mjxball.train.population import Population
from mjxball.train.processes import is_writer
from mjxball.train.program import TrainState
from mjxball.train.run_directory import CHECKPOINTS, read_config

KEEP = 2  # checkpoints kept while training, so that one is left if the newest is damaged
CHECKSUMS = "checksums"
# This module reports a damaged checkpoint itself, in one line; asyncio reports every other read of it that failed too.
logging.getLogger("absl").setLevel(logging.CRITICAL)
logging.getLogger("asyncio").addFilter(lambda record: "_wrap_awaitable" not in record.getMessage())


def _ignoring_closed_loop(previous: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """`sys.unraisablehook` that drops errors of TensorStore reads which finish after another read has failed."""

    def hook(unraisable: Any) -> None:
        if str(unraisable.exc_value) != "Event loop is closed":
            previous(unraisable)

    return hook


sys.unraisablehook = _ignoring_closed_loop(sys.unraisablehook)


class Checkpoints:
    """The checkpoints of one run directory, numbered by environment steps."""

    def __init__(self, run: Path, reading: bool = False):
        """With `reading` nothing is changed: another process may be writing the next checkpoint."""
        # Processes of a distributed run do not synchronise in Orbax: process 0 writes, all read.
        alone = ocp.options.MultiprocessingOptions(
            primary_host=jax.process_index(),
            active_processes={jax.process_index()},
            barrier_sync_key_prefix=str(jax.process_index()),
        )
        options = ocp.CheckpointManagerOptions(
            max_to_keep=KEEP,
            enable_async_checkpointing=True,
            multiprocessing_options=alone,
            create=False,
            read_only=reading,
        )
        place = (run / CHECKPOINTS).absolute()
        if not reading:
            place.mkdir(parents=True, exist_ok=True)
        try:
            self._manager = ocp.CheckpointManager(place, options=options)
        except (ValueError, OSError, RecursionError) as error:
            why = str(error).splitlines()[0][:200]
            raise InputError(f"the checkpoints in {place} cannot be read: {why}") from None

    def save(self, state: TrainState) -> None:
        """Start writing `state`, a tree of NumPy arrays. A step that was already saved is not written again."""
        step = int(np.ravel(np.asarray(state.steps))[0])  # the same for every member of a population
        if step in self._manager.all_steps():
            return
        arrays = {name: np.asarray(leaf) for name, leaf in _named_leaves(state).items()}
        arrays[CHECKSUMS] = _checksums(arrays)
        with self._written():
            if not self._manager.save(step, args=ocp.args.StandardSave(arrays)):
                raise RuntimeError(f"Orbax refused to save checkpoint {step}")

    def steps(self) -> list[int]:
        """Environment steps of every complete checkpoint, newest first."""
        return sorted(self._manager.all_steps(), reverse=True)

    def restore(self, template: TrainState, warn: Callable[[str], None], discard: bool) -> TrainState | None:
        """The newest readable state, shaped like `template` (arrays or `jax.ShapeDtypeStruct`); None without one.

        A checkpoint that cannot be read is skipped with a warning to `warn`. With `discard` it is deleted once an older
        one is restored, because Orbax would refuse to save the same step again.
        """
        arrays = {name: np.empty(leaf.shape, leaf.dtype) for name, leaf in _named_leaves(template).items()}
        unreadable = []
        for step in self.steps():
            try:
                state = _rebuild(template, self._read(step, arrays))
            except Exception as error:  # Orbax and TensorStore raise many kinds for damaged files
                warn(f"checkpoint {step} cannot be read and is skipped: {str(error).splitlines()[0][:200]}")
                unreadable.append(step)
                continue
            if discard and is_writer():
                for damaged in unreadable:
                    self._manager.delete(damaged)
            return state
        return None

    def _read(self, step: int, template: dict[str, np.ndarray]) -> dict[str, Any]:
        """The arrays of one checkpoint by name, shaped like `template`. ValueError if a checksum does not match."""
        with_checksums = {**template, CHECKSUMS: np.empty(len(template), np.uint32)}
        try:
            arrays = self._manager.restore(step, args=ocp.args.StandardRestore(with_checksums))
        except Exception:  # checkpoints before 0.2 have no checksums; a damaged one fails again below
            return self._manager.restore(step, args=ocp.args.StandardRestore(template))
        checksums = arrays.pop(CHECKSUMS)
        if (checksums != _checksums(arrays)).any():
            raise ValueError("its arrays are not what was written")
        return arrays

    def keep_newest(self) -> None:
        """Delete all but the newest checkpoint, once it is on disk: a finished run is not continued."""
        with self._written():
            self._manager.wait_until_finished()
            for step in self.steps()[1:]:
                self._manager.delete(step)

    def close(self) -> None:
        """Wait until everything is on disk."""
        with self._written():
            self._manager.wait_until_finished()
            self._manager.close()

    @contextlib.contextmanager
    def _written(self) -> Iterator[None]:
        """Turn errors of Orbax in this or an earlier write into InputError, which names the directory."""
        try:
            yield
        except Exception as error:  # of many kinds: a full disk is a ValueError
            why = (str(error).splitlines() or [type(error).__name__])[0][:200]
            raise InputError(f"a checkpoint in {self._manager.directory} cannot be written: {why}") from None


def _checksums(arrays: dict[str, Any]) -> np.ndarray:
    """CRC-32 of each array (n,), sorted by name. TensorStore does not detect every damaged byte."""
    flat = (np.ascontiguousarray(arrays[name]).reshape(-1).view(np.uint8).data for name in sorted(arrays))
    return np.array([zlib.crc32(part) for part in flat], np.uint32)


def _name(path: Any) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".")


def _rebuild(template: TrainState, arrays: dict[str, Any]) -> TrainState:
    """The inverse of `_named_leaves`. ValueError if an array has another shape or type than in `template`."""
    leaves, structure = jax.tree_util.tree_flatten_with_path(template)
    restored = [
        np.asarray(arrays[_name(path)]) if leaf.size else np.zeros(leaf.shape, leaf.dtype) for path, leaf in leaves
    ]
    for (path, leaf), value in zip(leaves, restored, strict=True):
        if value.shape != leaf.shape or value.dtype != leaf.dtype:
            raise ValueError(f"{_name(path)} has shape {value.shape} instead of {leaf.shape}")
    return jax.tree_util.tree_unflatten(structure, restored)


def _named_leaves(state: Any) -> dict[str, Any]:
    """Leaves by their path, without empty arrays, which Orbax cannot store."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(state)
    return {_name(path): leaf for path, leaf in leaves if leaf.size}


def restore_state(run: Path, config: Config, origin: dict[str, Any]) -> tuple[TrainState | None, int]:
    """(newest saved state of `run`, environment steps of its whole training); `config` and `origin`: `read_config`.

    The state holds NumPy arrays, and is None if none was saved. Raises InputError if every checkpoint is damaged, or if
    the environments were distributed over another number of devices.
    """
    population, parts = _population(config, origin), origin.get("parts", 1)
    if population.parts != parts:
        raise InputError(
            f"{run} was trained with every follower's worlds on {parts} device(s), not {population.parts}; "
            "continue it with as many processes as before"
        )
    state = _restore(run, population, discard=True)
    return state, population.program.schedule.total_steps if state is None else population.total_steps(state)


def _restore(run: Path, population: Population, discard: bool) -> TrainState | None:
    if not (run / CHECKPOINTS).is_dir():
        return None
    with contextlib.closing(Checkpoints(run, reading=not discard)) as checkpoints:
        if not checkpoints.steps():
            return None
        state = checkpoints.restore(population.template(), lambda text: warn(f"warning: {text}"), discard)
    if state is None:
        raise InputError(f"{run} has no checkpoint that can be read")
    return state


def restore_policy(run: Path) -> tuple[Config, Any, int, dict[str, Any]]:
    """(configuration, policy, environment steps, origin) of a run's newest checkpoint, for its best member."""
    config, origin = read_config(run)
    population, best = _population(config, origin), best_member(read_members(run))
    state = _restore(run, population, discard=False)
    if state is None:
        raise InputError(f"{run} has no complete checkpoint")
    if not is_transport_env(population.program.env):
        raise InputError(f"{run} was trained on an environment of its own; its policy.npz is all there is to export")
    origin = {**origin, "seed": origin["seed"] + best}
    steps = int(np.ravel(state.steps)[0])
    return population.member_config(best), population.policy(state, best), steps, origin


def _population(config: Config, origin: dict[str, Any]) -> Population:
    extensions = resolve(Extensions(**(origin.get("extensions") or {})))
    return Population(config, origin["physics"], origin["seeds"], origin["sweep"], extensions=extensions)
