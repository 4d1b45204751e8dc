"""Checkpoints of a run with Orbax: the whole training state, written in the background, two kept, one in the end."""

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
from mjxball.train.extensions import Extensions, is_pair, resolve
from mjxball.train.population import Population
from mjxball.train.processes import is_writer
from mjxball.train.program import TrainState
from mjxball.train.run_directory import CHECKPOINTS, read_config

KEEP = 2  # while training, so that one is left if the newest is damaged
CHECKSUMS = "checksums"
# What is wrong with a checkpoint is said here, in one line.
logging.getLogger("absl").setLevel(logging.CRITICAL)


def _without_late_answers(before: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """`sys.unraisablehook` that is silent where TensorStore answers a read that another one's failure has ended."""

    def hook(unraisable: Any) -> None:
        if str(unraisable.exc_value) != "Event loop is closed":
            before(unraisable)

    return hook


sys.unraisablehook = _without_late_answers(sys.unraisablehook)


class Checkpoints:
    """The checkpoints of one run directory, numbered by environment steps."""

    def __init__(self, run: Path, reading: bool = False):
        """`reading` leaves everything there as it is: another process may be writing the next one."""
        # Of several processes each acts for itself: process 0 writes, all read.
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
        """Start writing `state`, NumPy arrays; a step that is already there is not written again."""
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
        """The newest sound state, shaped like `template` (arrays or `jax.ShapeDtypeStruct`); None if there is none.

        Half-written checkpoints never count as complete; one that cannot be read is skipped and `warn`ed of, and
        with `discard` deleted once an older one is restored: Orbax would refuse to save its steps again.
        """
        wanted = {name: np.empty(leaf.shape, leaf.dtype) for name, leaf in _named_leaves(template).items()}
        unreadable = []
        for step in self.steps():
            try:
                state = _rebuild(template, self._read(step, wanted))
            except Exception as error:  # Orbax and TensorStore raise many kinds for damaged files
                warn(f"checkpoint {step} cannot be read and is skipped: {str(error).splitlines()[0][:200]}")
                unreadable.append(step)
                continue
            if discard and is_writer():
                for damaged in unreadable:
                    self._manager.delete(damaged)
            return state
        return None

    def _read(self, step: int, wanted: dict[str, np.ndarray]) -> dict[str, Any]:
        """The arrays of one checkpoint; ValueError if one of them is not what was written."""
        template = {**wanted, CHECKSUMS: np.empty(len(wanted), np.uint32)}
        try:
            arrays = self._manager.restore(step, args=ocp.args.StandardRestore(template))
        except Exception:  # checkpoints before 0.2 have no checksums; of others this fails once more
            return self._manager.restore(step, args=ocp.args.StandardRestore(wanted))
        checksums = arrays.pop(CHECKSUMS)
        if (checksums != _checksums(arrays)).any():
            raise ValueError("its arrays are not what was written")
        return arrays

    def keep_newest(self) -> None:
        """Delete all but the newest, once that is on disk: nothing of a finished run is continued."""
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
        """Orbax raises here what went wrong while it wrote, now or before: InputError, which names the directory."""
        try:
            yield
        except Exception as error:  # of many kinds: a full disk is a ValueError
            why = (str(error).splitlines() or [type(error).__name__])[0][:200]
            raise InputError(f"a checkpoint in {self._manager.directory} cannot be written: {why}") from None


def _checksums(arrays: dict[str, Any]) -> np.ndarray:
    """CRC-32 of every array in the order of their names (n,): TensorStore does not notice every damaged byte."""
    flat = (np.ascontiguousarray(arrays[name]).reshape(-1).view(np.uint8).data for name in sorted(arrays))
    return np.array([zlib.crc32(part) for part in flat], np.uint32)


def _name(path: Any) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".")


def _rebuild(template: TrainState, arrays: dict[str, Any]) -> TrainState:
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
    """(newest state of the run directory that `read_config` describes, steps of its whole training).

    The state holds NumPy arrays; None if none was ever saved.

    Raises InputError if every checkpoint is damaged or the worlds were cut otherwise than now.
    """
    population, parts = _population(config, origin), origin.get("parts", 1)
    if population.parts != parts:
        raise InputError(
            f"{run} was trained with every follower's worlds on {parts} device(s), not {population.parts}; "
            "continue it with as many processes as before"
        )
    return _restore(run, population, discard=True), population.program.schedule.total_steps


def _restore(run: Path, population: Population, discard: bool) -> TrainState | None:
    if not (run / CHECKPOINTS).is_dir():
        return None
    with contextlib.closing(Checkpoints(run, reading=not discard)) as checkpoints:
        if not checkpoints.steps():
            return None
        say = lambda text: warn(f"warning: {text}")  # noqa: E731
        state = checkpoints.restore(population.template(), say, discard)
    if state is None:
        raise InputError(f"{run} has no checkpoint that can be read")
    return state


def restore_policy(run: Path) -> tuple[Config, Any, int, dict[str, Any]]:
    """Configuration, policy, environment steps and origin of a run's newest checkpoint; of a population the best's."""
    config, origin = read_config(run)
    population, best = _population(config, origin), best_member(read_members(run))
    state = _restore(run, population, discard=False)
    if state is None:
        raise InputError(f"{run} has no complete checkpoint")
    if not is_pair(population.program.env):
        raise InputError(f"{run} was trained on an environment of its own; its policy.npz is all there is to export")
    origin = {**origin, "seed": origin["seed"] + best}
    steps = int(np.ravel(state.steps)[0])
    return population.member_config(best), population.policy(state, best), steps, origin


def _population(config: Config, origin: dict[str, Any]) -> Population:
    extensions = resolve(Extensions(**(origin.get("extensions") or {})))
    return Population(config, origin["physics"], origin["seeds"], origin["sweep"], extensions=extensions)
