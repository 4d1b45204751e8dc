"""Checkpoints of a run with Orbax: the whole training state, written in the background, the newest few kept."""

from __future__ import annotations

import contextlib
import json
import logging
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from mjxball import config as configs
from mjxball.config import Config
from mjxball.errors import InputError
from mjxball.train.program import Program, TrainState

KEEP = 2
CONFIG_FILE = "config.json"
CHECKPOINTS = "checkpoints"
logging.getLogger("absl").setLevel(logging.ERROR)


class Checkpoints:
    """The checkpoints of one run directory, numbered by environment steps."""

    def __init__(self, run: Path, keep: int = KEEP):
        options = ocp.CheckpointManagerOptions(max_to_keep=keep, enable_async_checkpointing=True)
        self._manager = ocp.CheckpointManager((run / CHECKPOINTS).absolute(), options=options)

    def save(self, state: TrainState) -> None:
        """Start writing `state`; a step that is already there is not written again."""
        step = int(state.steps)
        if step not in self._manager.all_steps():
            # Copies: the next chunk of training reuses the buffers while the files are still being written.
            arrays = {name: np.array(leaf) for name, leaf in _named_leaves(state).items()}
            self._manager.save(step, args=ocp.args.StandardSave(arrays))

    def newest(self) -> int | None:
        """Environment steps of the newest complete checkpoint, None if there is none."""
        return self._manager.latest_step()

    def restore(self, template: TrainState) -> TrainState:
        """The newest state, shaped like `template` (arrays or `jax.ShapeDtypeStruct`)."""
        wanted = {name: np.empty(leaf.shape, leaf.dtype) for name, leaf in _named_leaves(template).items()}
        arrays = self._manager.restore(self._manager.latest_step(), args=ocp.args.StandardRestore(wanted))
        leaves, structure = jax.tree_util.tree_flatten_with_path(template)
        restored = [
            jnp.asarray(arrays[_name(path)]) if leaf.size else jnp.zeros(leaf.shape, leaf.dtype)
            for path, leaf in leaves
        ]
        return jax.tree_util.tree_unflatten(structure, restored)

    def close(self) -> None:
        """Wait until everything is on disk."""
        self._manager.wait_until_finished()
        self._manager.close()


def _name(path: Any) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".")


def _named_leaves(state: Any) -> dict[str, Any]:
    """Leaves by their path, without empty arrays, which Orbax cannot store."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(state)
    return {_name(path): leaf for path, leaf in leaves if leaf.size}


def write_config(run: Path, config: Config, origin: dict[str, Any]) -> None:
    """Write the run's `config.json`: configuration, its hash, and `origin` (seed, physics, command, commit)."""
    record = {"config": configs.to_dict(config), "config_hash": configs.config_hash(config), **origin}
    (run / CONFIG_FILE).write_text(json.dumps(record, indent=2) + "\n")


def read_config(run: Path) -> tuple[Config, dict[str, Any]]:
    """Configuration and origin of a run directory; raise InputError if it is none."""
    path = run / CONFIG_FILE
    try:
        record = json.loads(path.read_text())
        config = configs.from_dict(record.pop("config"))
    except FileNotFoundError:
        raise InputError(f"{run} is not a run directory: it has no {CONFIG_FILE}") from None
    except (OSError, ValueError, KeyError, AttributeError, TypeError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path} cannot be read: {error}") from None
    record.pop("config_hash", None)
    return configs.validate(config), record


def restore_run(run: Path) -> tuple[Config, TrainState, dict[str, Any]]:
    """Configuration, newest state and origin of a run directory; raise InputError if there is none."""
    config, origin = read_config(run)
    if not (run / CHECKPOINTS).is_dir():
        raise InputError(f"{run} has no checkpoints")
    checkpoints = Checkpoints(run)
    with contextlib.closing(checkpoints):
        if checkpoints.newest() is None:
            raise InputError(f"{run} has no complete checkpoint")
        template = jax.eval_shape(Program(config, origin["physics"]).create, jax.random.PRNGKey(0))
        return config, checkpoints.restore(template), origin


def restore_policy(run: Path) -> tuple[Config, Any, int, dict[str, Any]]:
    """Configuration, learner, environment steps and origin of a run's newest checkpoint."""
    config, state, origin = restore_run(run)
    return config, state.learner, int(state.steps), origin
