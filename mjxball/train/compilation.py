"""Compilation: JAX's settings around it, and traced programs, kept beside XLA's compilation cache for the next run."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jax.sharding import Mesh

from mjxball.files import write_whole
from mjxball.reading import parse_json
from mjxball.xla import traced_directory

OPTIONS = ("jax_enable_x64", "jax_default_prng_impl", "jax_threefry_partitionable", "jax_default_matmul_precision")
# One follower's kernels gain nothing from being tuned and optimised further, and it costs a third of the compile time.
# (cuBLAS instead of Triton's products compiles 2 s sooner and then takes 4 s to load and run.)
GPU_OPTIONS: dict[str, Any] = {"xla_gpu_autotune_level": 0, "xla_backend_optimization_level": 1}
# Products of batches of thousands: of cuBLAS's kernels XLA tries a few, of Triton's it first compiles hundreds, which
# are hardly faster (PPO of Brax's `ant`).
CUBLAS_GPU_OPTIONS: dict[str, Any] = {"xla_gpu_enable_triton_gemm": False, "xla_backend_optimization_level": 1}
# The small products of many followers at once take half as long when tuned (64 of SAC).
TUNED_GPU_OPTIONS: dict[str, Any] = {"xla_backend_optimization_level": 1}
# For algorithms that are done sooner than XLA, which then compiles twice as fast what runs a quarter slower.
CPU_OPTIONS: dict[str, Any] = {"xla_backend_optimization_level": 1}
if jax.__version_info__ < (0, 11):
    CPU_OPTIONS["xla_cpu_use_fusion_emitters"] = False
# One follower's products of layers of 64 are small enough for plain loops, which spare XLA a kernel in Triton for each
# (2 - 5 s to compile).
PLAIN_PRODUCTS = {"xla_gpu_gemm_rewrite_size_threshold": 70_000}  # numbers in both matrices


def compiler_options(algorithm: Any = None, members: int = 1) -> dict[str, Any] | None:
    """XLA's options for training `members` followers at once by `algorithm` on JAX's default device.

    Also for `mjxball.train.train`: `jax.jit(lambda key: train(config, key), compiler_options=compiler_options())`, with
    the class of the algorithm if it is not SAC.
    """
    if jax.default_backend() == "gpu":
        if members > 1:
            return TUNED_GPU_OPTIONS
        if getattr(algorithm, "large_products", False):
            return CUBLAS_GPU_OPTIONS
        return GPU_OPTIONS | PLAIN_PRODUCTS
    return CPU_OPTIONS if getattr(algorithm, "prefers_cpu", False) else None


def partitioned_by_gspmd(mesh: Mesh | None) -> contextlib.AbstractContextManager[None]:
    """Leave the partitioning over `mesh` to XLA's older partitioner, GSPMD.

    The newer one, Shardy, ends the process by a segfault where a constant that `shard_map` closes over is simplified
    away (jax 0.11.2, `ManualComputationUnusedInputsPattern`), and MJX's model is hundreds of constants.
    """
    return contextlib.nullcontext() if mesh is None else jax_setting("jax_use_shardy_partitioner", False)


@contextlib.contextmanager
def jax_setting(name: str, value: Any) -> Iterator[None]:
    """One of JAX's settings, put back afterwards."""
    settings: Any = jax.config  # its settings are made while JAX is imported: no type checker knows them
    before = getattr(settings, name)
    settings.update(name, value)
    try:
        yield
    finally:
        settings.update(name, before)


class TracedProgram:
    """One function of arrays, traced or found in the cache. `lower` readies it for compilation.

    All of its arrays but the last few, `others`, are the first that it returns, perhaps changed.
    """

    def __init__(
        self,
        name: str,
        key: Mapping[str, Any] | None,
        function: Callable[..., Any],
        shapes: Callable[[], Any],
        result: Any = None,
        others: int | None = None,
    ):
        """`shapes` makes the arguments' `ShapeDtypeStruct`s, `result` is any tree with the structure of the result.

        `key` must hold everything that the traced program depends on; None: it is not kept. `others` is None if all
        arrays are such.
        """
        self._name, self._function, self._shapes, self._others = name, function, shapes, others
        self._structure = jax.tree.structure(result)
        self._path = _path(name, key)
        self._kept = _read(self._path)

    def _traced(self) -> tuple[Any, list[int]]:
        """The exported program and which of the carried arrays it leaves unchanged."""
        if self._kept is None:
            leaves, structure = jax.tree.flatten(self._shapes())
            carried, unchanged = self._carried(leaves), list[int]()

            def flat(*arrays: Any) -> Any:
                found = jax.tree.leaves(self._function(*jax.tree.unflatten(structure, arrays)))
                unchanged[:] = [k for k in range(carried) if found[k] is arrays[k]]
                return [one for k, one in enumerate(found) if k not in unchanged]

            exported = jax.export.export(jax.jit(flat))(*leaves)
            _write(self._path, exported, unchanged)
            self._kept = exported, unchanged
        return self._kept

    def _carried(self, leaves: Sequence[Any]) -> int:
        return 0 if self._others is None else len(leaves) - self._others

    def lower(self) -> Any:
        """`jax.stages.Lowered` of the function, of which nothing is carried."""

        exported, _ = self._traced()

        def call(*arguments: Any) -> Any:
            return jax.tree.unflatten(self._structure, exported.call(*jax.tree.leaves(arguments)))

        call.__name__ = self._name  # what profiles and the compilation cache call it
        return jax.jit(call).lower(*self._shapes())

    def lower_carrying(self) -> Carrying:
        """The function of what it reads, which returns what it changes: the rest does not pass through the device."""
        exported, unchanged = self._traced()
        leaves = [jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in exported.in_avals]
        carried = self._carried(leaves)
        writes = [k for k in range(carried) if k not in unchanged]
        special = [k for k, leaf in enumerate(leaves) if jnp.issubdtype(leaf.dtype, jax.dtypes.extended)]
        reads = sorted({*exported.module_kept_var_idx, *special})

        def call(*arrays: Any) -> Any:
            given = dict(zip(reads, arrays, strict=True))
            nothing = lambda leaf: jnp.zeros(leaf.shape, leaf.dtype)  # noqa: E731
            return exported.call(*[given[k] if k in given else nothing(leaf) for k, leaf in enumerate(leaves)])

        call.__name__ = self._name
        donated = [place for place, k in enumerate(reads) if k in writes]
        lowered = jax.jit(call, donate_argnums=donated).lower(*[leaves[k] for k in reads])
        return Carrying(lowered, carried, reads, writes)


class Carrying(NamedTuple):
    """A lowered function that carries arrays on; `compile` makes `run(carried, *others)` of it."""

    lowered: Any
    carried: int
    reads: Sequence[int]  # which of the carried arrays and, behind them, of the others it takes
    writes: Sequence[int]  # which of the carried arrays it returns, before other results

    def compile(self, compiler_options: Mapping[str, Any] | None) -> Callable[..., list[Array]]:
        """`run` changes the list `carried`, whose first arrays are those of the function, and returns other results.

        Arrays that are replaced lose their memory.
        """
        compiled = self.lowered.compile(compiler_options=compiler_options)

        def run(carried: list[Array], *others: Any) -> list[Array]:
            given = [*carried[: self.carried], *others]
            found = compiled(*[given[k] for k in self.reads])
            for k, array in zip(self.writes, found, strict=False):
                carried[k] = array
            return found[len(self.writes) :]

        return run


def _path(name: str, key: Mapping[str, Any] | None) -> Path | None:
    place = traced_directory()
    if place is None or key is None:
        return None
    settings = {option: str(getattr(jax.config, option)) for option in OPTIONS}
    text = json.dumps({**key, **settings, "platform": jax.default_backend()}, sort_keys=True)
    return place / f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:32]}.stablehlo"


def _read(path: Path | None) -> tuple[Any, list[int]] | None:
    """The exported program in `path` and which carried arrays it leaves unchanged; None if it cannot be read."""
    if path is None:
        return None
    try:
        first, _, program = path.read_bytes().partition(b"\n")
        return jax.export.deserialize(bytearray(program)), parse_json(first)
    except Exception:  # absent, cut short, or of another JAX: traced anew
        return None


def _write(path: Path | None, exported: Any, unchanged: list[int]) -> None:
    if path is None:
        return
    with contextlib.suppress(OSError):  # a full or read-only cache is no reason not to train
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, json.dumps(unchanged).encode() + b"\n" + exported.serialize())
