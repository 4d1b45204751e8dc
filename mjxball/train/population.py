"""Several followers trained in one program: seeds, and optionally hyper-parameters that differ between members."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, PartitionSpec

from mjxball import config as configs
from mjxball.config import Config
from mjxball.errors import InputError
from mjxball.train.program import Mode, Program, Tally, TrainState

Array = Any
# Settings that enter the compiled program as numbers, and may therefore differ between members.
SWEEPABLE = (
    "sac.learning_rate",
    "sac.alpha_learning_rate",
    "sac.learning_rate_end",
    "sac.discount",
    "sac.target_rate",
    "sac.alpha",
    "sac.target_entropy",
    "sac.reward_scale",
    "sac.policy_average",
    "follower.tilt_limit",
    "follower.vertical_limit",
    *(f"reward.{name}" for name in ("error", "error_scale", "velocity", "tilt", "rates", "effort", "smoothness")),
)
Sweep = Mapping[str, Sequence[float]]


def read_sweep(path: Path, members: int, config: Config) -> dict[str, list[float]]:
    """A sweep file: JSON {"<config path>": [one number for each member], ...}. Raises InputError if unsound."""
    try:
        sweep = json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise InputError(f"sweep file {path} cannot be read: {error}") from None
    if not isinstance(sweep, dict) or not sweep:
        raise InputError(f"sweep file {path} must hold an object of settings")
    for name, values in sweep.items():
        if name not in SWEEPABLE:
            raise InputError(f"sweep file {path}: {name} cannot differ between members; {', '.join(SWEEPABLE)} can")
        if not isinstance(values, list) or len(values) != members:
            raise InputError(f"sweep file {path}: {name} needs {members} numbers, one for each seed")
        for value in values:
            number = float(value) if isinstance(value, int) and not isinstance(value, bool) else value
            configs.validate(configs.replace(config, name, number))
    return sweep


class Population:
    """`Program` for `members` followers at once, with a leading member axis unless there is only one.

    Member k has seed `seed + k` and the k-th value of every swept setting. The members are spread over all
    local devices if their number divides evenly, else they share the first.
    """

    def __init__(self, config: Config, physics: str, members: int = 1, sweep: Sweep | None = None):
        self.config, self.members, self._physics = config, members, physics
        self._sweep = dict(sweep or {})
        self._single = members == 1 and not self._sweep
        self._values = {name: jnp.asarray(values, jnp.float32) for name, values in self._sweep.items()}
        devices = jax.local_device_count()
        self.devices = devices if members % devices == 0 and not self._single else 1
        self.program = Program(config, physics)

    def member_config(self, member: int) -> Config:
        """The configuration of one member."""
        config = self.config
        for name, values in self._sweep.items():
            config = configs.replace(config, name, float(values[member]))
        return config

    def member(self, value: Any, member: int) -> Any:
        """One member's part of a state or tally."""
        return value if self._single else jax.tree.map(lambda leaf: leaf[member], value)

    def each(self, value: Array) -> np.ndarray:
        """`value` as NumPy with the member axis first, also for a single member."""
        value = np.asarray(value)
        return value[None] if self._single else value

    def create(self, seed: int) -> TrainState:
        """Fresh training states."""
        if self._single:
            return jax.jit(self.program.create)(jax.random.PRNGKey(seed))
        keys = jnp.stack([jax.random.PRNGKey(seed + member) for member in range(self.members)])
        return jax.jit(jax.vmap(lambda values, key: self._of(values).create(key)))(self._values, keys)

    def template(self) -> TrainState:
        """Shapes of what `create` returns, without computing it."""
        return jax.eval_shape(self.create, 0)

    def fresh_worlds(self, key: Array) -> Any:
        """Newly reset worlds, the same draw for every member."""
        if self._single:
            return self.program.fresh_worlds(key)
        return jax.vmap(lambda values: self._of(values).fresh_worlds(key), axis_size=self.members)(self._values)

    def advance(self, state: TrainState, mode: Mode) -> tuple[TrainState, Tally]:
        """See `Program.advance`."""
        if self._single:
            return self.program.advance(state, mode)

        def together(values: Any, state: TrainState, mode: Mode) -> tuple[TrainState, Tally]:
            one = lambda own, state: self._of(own).advance(state, mode)  # noqa: E731
            return jax.vmap(one)(values, state)

        if self.devices == 1:
            return together(self._values, state, mode)
        mesh = jax.make_mesh((self.devices,), ("members",), axis_types=(AxisType.Auto,))
        spread, whole = PartitionSpec("members"), PartitionSpec()
        return jax.shard_map(together, mesh=mesh, in_specs=(spread, spread, whole), out_specs=spread, check_vma=False)(
            self._values, state, mode
        )

    def _of(self, values: Mapping[str, Array]) -> Program:
        return Program(self.config, self._physics, values) if values else self.program
