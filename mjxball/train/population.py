"""Population: several followers trained at once, with different seeds and optionally different hyper-parameters."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec

from mjxball import config as configs
from mjxball.algorithms.base import PolicyNetwork, Shards, TrainingPhase
from mjxball.config import Config
from mjxball.errors import InputError
from mjxball.policy import PolicyFile
from mjxball.train import processes
from mjxball.train.compilation import Carrying, TracedProgram, compiler_options, jax_setting, partitioned_by_gspmd
from mjxball.train.environments import Statistics, report
from mjxball.train.extensions import DEFAULTS, Extensions
from mjxball.train.program import Mode, TrainingProgram, TrainState, train_mode, warmup_mode
from mjxball.train.run_directory import Sweep, source_hash, versions


class FlatState:
    """A state and its statistics as a flat list of arrays, which compiled functions update.

    Flattening and rebuilding the trees at every call would slow training on a GPU by a quarter.
    """

    def __init__(self, state: TrainState, statistics: Statistics):
        self.arrays, self._structure = jax.tree.flatten((state, statistics))

    def trees(self) -> tuple[TrainState, Statistics]:
        """The current state and statistics."""
        return jax.tree.unflatten(self._structure, self.arrays)


class Compiled(NamedTuple):
    """`TrainingProgram`'s functions for all members of a population."""

    begin: Callable[[Any, Any], TrainState]  # (swept values, keys) -> `TrainingProgram.begin`
    episodes: Callable[[Any, Any, Any], Any]  # (swept values, keys, training) -> `TrainingProgram.episodes`
    collect: Callable[[FlatState, TrainingPhase], Array]  # -> keys for `update`
    update: Callable[[FlatState, Array], list[Array]]  # -> the algorithm's metrics, by name
    wait: Callable[[], Any]  # wait until all are compiled; raises errors of their compilation


class Population:
    """`TrainingProgram` for `members` followers at once, with a leading member axis unless there is only one.

    Member k has seed `seed + k` and the k-th value of every swept setting. In one process, members are distributed over
    its devices if these divide their number, else all use the first device. With several processes (see `processes`),
    members are distributed over all devices, and if there are fewer members, each member's environments are too; in one
    process also those of an algorithm that says what is `averaged`, over the CPU's devices, if their number allows it.
    """

    def __init__(
        self,
        config: Config,
        physics: str,
        members: int = 1,
        sweep: Sweep | None = None,
        devices: Sequence[Any] | None = None,
        extensions: Extensions = DEFAULTS,
    ):
        self.config, self.members, self._physics, self._extensions = config, members, physics, extensions
        self._sweep = dict(sweep or {})
        self._single = members == 1 and not self._sweep
        self._template: TrainState | None = None
        self._values = {name: np.asarray(values, np.float32) for name, values in self._sweep.items()}
        if devices is None:
            devices = jax.devices() if jax.process_count() > 1 else jax.local_devices()
        together, cores = jax.process_count() > 1, jax.default_backend() == "cpu"
        may_split = together or (cores and hasattr(extensions.algorithm, "averaged"))
        groups, parts = grid(members, len(devices), split=may_split)
        try:
            self.program = self._program(parts)
        except InputError:
            if together:
                raise
            groups, parts = grid(members, len(devices), split=False)
            self.program = self._program(parts)
        self.mesh = _mesh(devices, groups, parts) if groups * parts > 1 else None
        self.devices, self.parts = groups * parts, parts
        whole: Any = PartitionSpec() if self._single else PartitionSpec("members")
        split: Any = PartitionSpec(*whole, "envs")
        self._whole, self._split = whole, split
        self._state_spec = TrainState(self.program.algorithm.partition(whole, split), split, whole, whole, whole)
        self._statistics_spec = Statistics(whole, whole, whole, split)

    def _program(self, parts: int) -> TrainingProgram:
        """The program for one of `parts` of the environments; InputError if they cannot be cut."""
        self._shards = Shards("envs", parts, jax.process_count() > 1) if parts > 1 else Shards()
        program = TrainingProgram(self.config, self._physics, shards=self._shards, extensions=self._extensions)
        program.algorithm.check_parts(parts)
        return program

    def member_config(self, member: int) -> Config:
        """Configuration of one member."""
        config = self.config
        for name, values in self._sweep.items():
            config = configs.replace(config, name, float(values[member]))
        return config

    def member(self, value: Any, member: int) -> Any:
        """One member's slice of a state or of statistics."""
        return value if self._single else jax.tree.map(lambda leaf: leaf[member], value)

    def each(self, value: Array | np.ndarray) -> np.ndarray:
        """`value` as NumPy with the member axis first, also for a single member."""
        array = np.asarray(value)
        return array[None] if self._single else array

    def template(self) -> TrainState:
        """Shapes of a state, without computing one."""
        if self._template is None:
            self._template = jax.eval_shape(self._create, self._values, self._keys(0))
        return self._template

    def compile(self, creating: bool) -> Compiled:
        """Compile everything that a run needs, in parallel; `begin` only if `creating`.

        On one device a function can be called while others are still being compiled.
        """
        options = compiler_options(self.program.algorithm, self.members)
        # XLA releases the GIL: the largest program is traced first, the others while it compiles. In a process that
        # shares GPUs with others, two compilations at once crash.
        pool = ThreadPoolExecutor(4 if jax.process_count() == 1 else 1)
        with (
            partitioned_by_gspmd(self.mesh),
            # Python source locations serve profiles only, and cost XLA a second.
            jax_setting("jax_traceback_in_locations_limit", 0),
        ):
            lowered = self._lower_here(creating) if self.mesh is None else self._lower_on_mesh(creating)
            try:
                pending = [pool.submit(work.compile, compiler_options=options) for work in lowered]
            finally:
                pool.shutdown(wait=self.mesh is not None)
        collect, update, episodes, *begin = map(_when_ready, pending)
        return Compiled(
            begin[0] if begin else self._begin,
            episodes,
            lambda carried, phase: collect(carried.arrays, *phase)[0],
            lambda carried, keys: update(carried.arrays, keys),
            lambda: [*map(Future.result, pending)],
        )

    def _lower_here(self, creating: bool) -> Iterator[Any]:
        """Lowered collect, update, episodes and, if `creating`, begin, for one device."""
        key, state = self._key, self.template()
        values, keys, phase = jax.tree.map(_shape, (*self._starts(0), warmup_mode(1).phase))
        collect = lambda: (state, jax.tree.map(_shape, self.no_statistics()), phase)  # noqa: E731
        yield TracedProgram("collect", key, self._collect, collect, others=len(phase)).lower_carrying()
        update = lambda: (state, _shape(self._example_keys()))  # noqa: E731
        yield TracedProgram("update", key, self._update, update, others=1).lower_carrying()
        episodes = lambda: (values, keys, phase.random)  # noqa: E731
        yield TracedProgram("episodes", key, self._episodes, episodes, state.envs).lower()
        if creating:
            begin = lambda: (values, keys)  # noqa: E731
            yield TracedProgram("begin", key, self._begin, begin, state._replace(envs=())).lower()

    @functools.cached_property
    def _key(self) -> dict[str, Any] | None:
        """Everything that the traced programs depend on; None if that is unknown, with the user's extensions."""
        if not self._extensions.ours():
            return None
        return {
            "config": configs.to_dict(self.config),
            "physics": self._physics,
            "algorithm": type(self.program.algorithm).__name__,
            "members": self.members,
            "swept": {name: values.tolist() for name, values in self._values.items()},  # traced as constants
            "source": source_hash(),
            "versions": versions(),
        }

    def _lower_on_mesh(self, creating: bool) -> Iterator[Any]:
        """The same as `_lower_here` for several devices."""
        values, keys = self._starts(0)
        state, statistics = self._placed_shapes(self.template(), self._state_spec), self.no_statistics()
        phase = self._as_argument(warmup_mode(1).phase, PartitionSpec())
        update_keys = self._as_argument(self._example_keys(), self._whole)
        carried = (self._state_spec, self._statistics_spec)
        yield self._carrying(self._collect, (state, statistics, phase), (*carried, self._whole), 2)
        yield self._carrying(self._update, (state, update_keys), (self._state_spec, self._whole), 1)
        yield jax.jit(self._episodes, **self._results(self._split)).lower(values, keys, phase.random)
        if creating:
            begun = self._results(self._state_spec._replace(envs=()))
            yield jax.jit(self._begin, **begun).lower(values, keys)

    def _carrying(self, function: Callable[..., Any], arguments: Any, results: Any, carried: int) -> Carrying:
        """`function` lowered for several devices. It carries the arrays of its first `carried` arguments."""
        leaves, structure = jax.tree.flatten(arguments)
        count = len(jax.tree.leaves(arguments[:carried]))

        def flat(*arrays: Any) -> Any:
            return function(*jax.tree.unflatten(structure, arrays))

        jitted = jax.jit(flat, donate_argnums=range(count), **self._results(*results))
        return Carrying(jitted.lower(*leaves), count, range(len(leaves)), range(count))

    def start(self, compiled: Compiled, seed: int) -> TrainState:
        """Initial training states."""
        values, keys = self._starts(seed)
        training = self._as_argument(np.asarray(True), PartitionSpec())
        return compiled.begin(values, keys)._replace(envs=compiled.episodes(values, keys, training))

    def start_from(self, state: TrainState, policies: Sequence[PolicyFile]) -> TrainState:
        """`state` with the network of one of `policies` in every member; see `FirstOrderGradient.start_from`."""
        algorithm: Any = self.program.algorithm  # a FirstOrderGradient
        learnt = processes.gather(state.algorithm)
        started = [
            algorithm.start_from(self.member(learnt, member), policies[member % len(policies)])
            for member in range(self.members)
        ]
        learnt = started[0] if self._single else jax.tree.map(lambda *leaves: np.stack(leaves), *started)
        return state._replace(algorithm=self.place(learnt, self._whole))

    def ending_at(self, state: TrainState, total: int) -> TrainState:
        """`state` of a training of `total` environment steps."""
        return state._replace(total=self.place(np.full(state.total.shape, total, np.float32), self._whole))

    def total_steps(self, state: TrainState) -> int:
        """Environment steps of the whole training of `state`, which has them in float32."""
        total, schedule = np.ravel(processes.gather(state.total))[0], self.program.schedule
        if total == np.float32(schedule.total_steps):
            return schedule.total_steps
        return round(float(total) / schedule.num_envs) * schedule.num_envs

    def advance(
        self, compiled: Compiled, state: TrainState, mode: Mode, pause: Callable[[], bool] = lambda: False
    ) -> tuple[TrainState, Statistics, Any, int]:
        """Step all environments `mode.steps` times, rounded up to whole collections, and learn; `pause` ends it.

        Returns (state, statistics, metrics of the last update, steps taken by each environment). On accelerators it
        returns before the devices are done. The buffers of `state` are donated.
        """
        phase, window = self.place_phase(mode.phase), self.program.algorithm.steps_per_collect
        carried, metrics, taken = FlatState(state, self.no_statistics()), self.no_metrics(), 0
        apart = self.parts > 1 and not self._shards.joined
        averaged = self._averaged(state) if apart else []
        while taken < int(mode.steps):
            keys = compiled.collect(carried, phase)
            for number in averaged:
                carried.arrays[number] = _over_parts(carried.arrays[number], np.mean)
            if mode.phase.learning:
                metrics = compiled.update(carried, keys)
            taken += window
            if pause():
                break
        state, statistics = carried.trees()
        return state, _joined(statistics) if apart else statistics, self.named(metrics), taken

    def _averaged(self, state: TrainState) -> list[int]:
        """Numbers of the arrays of `state` that differ between parts after `collect`; see `Shards`."""
        algorithm: Any = self.program.algorithm
        flags = jax.tree.map(lambda _: False, state)
        differ = {name: jax.tree.map(lambda _: True, getattr(state.algorithm, name)) for name in algorithm.averaged}
        flags = flags._replace(algorithm=flags.algorithm._replace(**differ))
        return [number for number, flag in enumerate(jax.tree.leaves(flags)) if flag]

    def evaluation_envs(self, compiled: Compiled) -> Any:
        """Newly reset environments, the same for every member and every evaluation."""
        values, keys = self._starts(0)
        first = self._as_argument(np.broadcast_to(_first_key(), keys.shape), self._whole)
        return compiled.episodes(values, first, self._as_argument(np.asarray(False), PartitionSpec()))

    def policy(self, state: TrainState, member: int) -> PolicyNetwork:
        """The policy of one member of a state of NumPy arrays."""
        return self.program.policy(self.member(state, member))

    def report(self, statistics: Statistics, steps: int, evaluation: bool) -> dict[str, np.ndarray]:
        """The environment's metrics {name: (members,)} from statistics (NumPy arrays) over `steps`."""
        each = lambda values: {name: self.each(value).astype(float) for name, value in values.items()}  # noqa: E731
        count = steps * self.program.schedule.num_envs
        return report(self.program.env, each(statistics.totals), each(statistics.peaks), count, evaluation)

    def metric_names(self) -> tuple[list[str], list[str]]:
        """Names of the metrics that `report` returns for training and for evaluation."""
        names = self.template().envs.metrics
        totals, peaks = dict.fromkeys(names, np.zeros(self.members)), dict.fromkeys(names, np.zeros((self.members, 1)))
        training, evaluation = (report(self.program.env, totals, peaks, 1, flag) for flag in (False, True))
        return list(training), list(evaluation)

    def place_state(self, state: TrainState) -> TrainState:
        """Distribute a state of NumPy arrays, equal in every process, over the devices."""
        return jax.tree.map(lambda spec, part: self.place(part, spec), self._state_spec, state, is_leaf=_is_spec)

    def _placed(self, tree: Any, specs: Any) -> Any:
        """`_as_argument` of the parts of `tree`, each with its spec."""
        return jax.tree.map(lambda spec, part: self._as_argument(part, spec), specs, tree, is_leaf=_is_spec)

    def place_phase(self, phase: TrainingPhase) -> TrainingPhase:
        """A phase as `Compiled.collect` takes it."""
        return self.place(phase, PartitionSpec())

    def place_keys(self, keys: np.ndarray) -> Array:
        """Distribute the members' keys, equal in every process, over the devices."""
        return self.place(keys, self._whole)

    def place(self, tree: Any, spec: PartitionSpec) -> Any:
        """Distribute arrays, equal in every process, over the devices as given by `spec`."""
        if self.mesh is None:
            return jax.tree.map(jnp.asarray, tree)
        sharding = NamedSharding(self.mesh, spec)

        def cut(leaf: Any) -> Array:
            leaf = np.asarray(leaf)
            return jax.make_array_from_callback(leaf.shape, sharding, lambda index: leaf[index])

        return jax.tree.map(cut, tree)

    def _as_argument(self, tree: Any, spec: PartitionSpec) -> Any:
        """`place` for arguments that no program donates: a single device takes NumPy arrays directly."""
        return tree if self.mesh is None else self.place(tree, spec)

    def _keys(self, seed: int) -> np.ndarray:
        keys = np.stack([np.asarray(jax.random.PRNGKey(seed + member)) for member in range(self.members)])
        return keys[0] if self._single else keys

    def _starts(self, seed: int) -> tuple[Any, Array]:
        return self._as_argument(self._values, self._whole), self._as_argument(self._keys(seed), self._whole)

    def _create(self, values: Any, keys: Array) -> TrainState:
        begun, training = self._begin(values, keys), np.asarray(True)
        return begun._replace(envs=self._episodes(values, keys, training))

    def _begin(self, values: Any, keys: Array) -> TrainState:
        begin, result = lambda program, key: program.begin(key), self._state_spec._replace(envs=())
        return self._on_mesh(begin, (self._whole,), result, (0,))(values, keys)

    def _episodes(self, values: Any, keys: Array, training: Array | np.ndarray) -> Any:
        episodes = lambda program, key, training: program.episodes(key, training)  # noqa: E731
        return self._on_mesh(episodes, (self._whole, PartitionSpec()), self._split, (0, None))(values, keys, training)

    def _collect(
        self, state: TrainState, statistics: Statistics, phase: TrainingPhase
    ) -> tuple[TrainState, Statistics, Array]:
        collect = lambda program, *arguments: program.collect(*arguments)  # noqa: E731
        given = (self._state_spec, self._statistics_spec, PartitionSpec())
        results = (self._state_spec, self._statistics_spec, self._whole)
        return self._on_mesh(collect, given, results, (0, 0, None))(self._values, state, statistics, phase)

    def _update(self, state: TrainState, keys: Array) -> tuple[TrainState, dict[str, Array]]:
        learning = train_mode(1).phase
        update = lambda program, state, keys: program.update(state, keys, learning)  # noqa: E731
        specs = self._state_spec, self._whole
        return self._on_mesh(update, specs, specs, (0, 0))(self._values, state, keys)

    def no_statistics(self) -> Statistics:
        """Statistics of no steps: zeros."""
        each = () if self._single else (self.members,)
        zero: Any = np.zeros(each, np.float32)
        peak: Any = np.zeros((*each, self.program.schedule.num_envs), np.float32)
        names = self.template().envs.metrics
        statistics = Statistics(zero, zero, dict.fromkeys(names, zero), dict.fromkeys(names, peak))
        return self._placed(statistics, self._statistics_spec)

    def no_metrics(self) -> list[Any]:
        """Metrics of no update: zeros."""
        return [self.no_statistics().reward] * len(self.program.algorithm.metrics)

    def named(self, metrics: Sequence[Any]) -> dict[str, Any]:
        """Metrics of `Compiled.update` by name."""
        return dict(zip(sorted(self.program.algorithm.metrics), metrics, strict=True))

    def _example_keys(self) -> np.ndarray:
        """Zeros with the shape of the keys that `collect` returns for `update`."""
        algorithm = self.program.algorithm
        count = algorithm.collect_keys + algorithm.update_keys + 1
        *members, width = self.template().key.shape
        return np.zeros((*members, count, width), np.uint32)

    def _on_mesh(self, one: Callable[..., Any], specs: Any, results: Any, axes: tuple[int | None, ...]) -> Any:
        """`one(program, *arguments)` for all members over the mesh, as a function of (swept values, *arguments).

        `axes`: member axis of each argument, None if all members share it. `specs`, `results`: partition specs.
        """

        def every(values: Any, *arguments: Any) -> Any:
            if self._single:
                return one(self.program, *arguments)
            each = lambda swept, *arguments: one(self._member_program(swept), *arguments)  # noqa: E731
            return jax.vmap(each, in_axes=(0, *axes), axis_size=self._members_here)(values, *arguments)

        if self.mesh is None:
            return every
        return jax.shard_map(every, mesh=self.mesh, in_specs=(self._whole, *specs), out_specs=results, check_vma=False)

    @property
    def _members_here(self) -> int:
        return self.members // (self.mesh.shape["members"] if self.mesh else 1)

    def _results(self, *specs: Any) -> dict[str, Any]:
        """Arguments of `jax.jit` that set the shardings of its results."""
        mesh = self.mesh
        if mesh is None:
            return {}
        shardings = jax.tree.map(lambda spec: NamedSharding(mesh, spec), specs, is_leaf=_is_spec)
        return {"out_shardings": shardings if len(shardings) > 1 else shardings[0]}

    def _placed_shapes(self, template: Any, specs: Any) -> Any:
        """`template` with the shardings that `place_state` gives."""
        mesh = self.mesh
        if mesh is None:
            return template

        def placed(spec: PartitionSpec, part: Any) -> Any:
            sharding = NamedSharding(mesh, spec)
            return jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype, sharding=sharding), part)

        return jax.tree.map(placed, specs, template, is_leaf=_is_spec)

    def _member_program(self, values: Mapping[str, Array]) -> TrainingProgram:
        if not values:
            return self.program
        return TrainingProgram(self.config, self._physics, values, self._shards, self._extensions)


def _over_parts(array: Array, mean: Callable[..., Any]) -> Array:
    """An array that should be equal on all devices, as the mean or sum over them."""
    parts = [np.asarray(part.data) for part in array.addressable_shards]
    return jax.device_put(mean(parts, axis=0, dtype=parts[0].dtype), array.sharding)


def _joined(statistics: Statistics) -> Statistics:
    """Statistics over the parts of the environments; `peaks` are cut already."""
    total = lambda array: _over_parts(array, np.sum)  # noqa: E731
    return statistics._replace(
        reward=_over_parts(statistics.reward, np.mean),
        ended=total(statistics.ended),
        totals={name: total(value) for name, value in statistics.totals.items()},
    )


def _when_ready(pending: Future[Callable[..., Any]]) -> Callable[..., Any]:
    """A function that waits for the compiled function at its first call."""

    def call(*arguments: Any) -> Any:
        return pending.result()(*arguments)

    return call


def _first_key() -> np.ndarray:
    return np.asarray(jax.random.PRNGKey(0))


def _shape(array: Any) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(array.shape, array.dtype)


def grid(members: int, devices: int, split: bool) -> tuple[int, int]:
    """(groups of members, parts of each member's environments): the shape of the grid of devices.

    Without `split` a member's environments stay on one device, and if `devices` does not divide `members`, all members
    use the first device.
    """
    groups = math.gcd(members, devices)
    if split:
        return groups, devices // groups
    return (devices, 1) if groups == devices else (1, 1)


def _mesh(devices: Sequence[Any], groups: int, parts: int) -> Mesh:
    return jax.make_mesh((groups, parts), ("members", "envs"), axis_types=(AxisType.Auto,) * 2, devices=devices)


def _is_spec(value: Any) -> bool:
    return isinstance(value, PartitionSpec)
