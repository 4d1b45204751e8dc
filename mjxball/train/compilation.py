"""Compilation: compiler options, and a cache of traced programs beside XLA's compilation cache."""

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

from mjxball.files import write_atomically
from mjxball.reading import parse_json
from mjxball.xla import traced_directory

OPTIONS = ("jax_enable_x64", "jax_default_prng_impl", "jax_threefry_partitionable", "jax_default_matmul_precision")
# For one follower, autotuning and further optimisation take a third of the compile time and make no kernel faster.
# (cuBLAS instead of Triton for matrix products compiles 2 s sooner, and then takes 4 s to load and run.)
GPU_OPTIONS: dict[str, Any] = {"xla_gpu_autotune_level": 0, "xla_backend_optimization_level": 1}
# For products with batches of thousands: XLA tries a few kernels of cuBLAS, but compiles hundreds of Triton's, which
# are hardly faster (PPO of Brax's `ant`).
CUBLAS_GPU_OPTIONS: dict[str, Any] = {"xla_gpu_enable_triton_gemm": False, "xla_backend_optimization_level": 1}
# Autotuning halves the time of the small products of many followers at once (SAC, 64 members).
TUNED_GPU_OPTIONS: dict[str, Any] = {"xla_backend_optimization_level": 1}
# For trainings shorter than their compilation: XLA compiles twice as fast, and the program runs a quarter slower.
CPU_OPTIONS: dict[str, Any] = {"xla_backend_optimization_level": 1}
if jax.__version_info__ < (0, 11):
    CPU_OPTIONS["xla_cpu_use_fusion_emitters"] = False
# For one follower with layers of 64, plain loops are fast enough, and avoid 2 - 5 s for a Triton kernel per product.
PLAIN_PRODUCTS = {"xla_gpu_gemm_rewrite_size_threshold": 70_000}  # elements of both matrices
# A window of gradients is a loop of many small kernels, which waits for their launches unless it is one CUDA graph.
GRAPHS: dict[str, Any] = {
    "xla_gpu_graph_min_graph_size": 1,
    "xla_gpu_enable_command_buffer": "FUSION,CUBLAS,WHILE,CONDITIONAL,CUSTOM_CALL,DYNAMIC_SLICE_FUSION",
}


def compiler_options(algorithm: Any = None, members: int = 1) -> dict[str, Any] | None:
    """XLA's options for training `members` followers at once by `algorithm` on JAX's default device.

    Also for `mjxball.train.train`: `jax.jit(lambda key: train(config, key), compiler_options=compiler_options())`, with
    the class of the algorithm if it is not SAC.
    """
    if jax.default_backend() == "gpu":
        graphs = GRAPHS if getattr(algorithm, "long_loops", False) else {}
        if members > 1:
            return TUNED_GPU_OPTIONS | graphs
        if getattr(algorithm, "large_products", False):
            return CUBLAS_GPU_OPTIONS | graphs
        return GPU_OPTIONS | PLAIN_PRODUCTS | graphs
    return CPU_OPTIONS if getattr(algorithm, "prefers_cpu", False) else None


def partitioned_by_gspmd(mesh: Mesh | None) -> contextlib.AbstractContextManager[None]:
    """Use XLA's older partitioner, GSPMD, if there is a `mesh`.

    The newer one, Shardy, crashes when a constant that `shard_map` closes over is simplified away (jax 0.11.2,
    `ManualComputationUnusedInputsPattern`), and MJX's model consists of hundreds of constants.
    """
    return contextlib.nullcontext() if mesh is None else jax_setting("jax_use_shardy_partitioner", False)


@contextlib.contextmanager
def jax_setting(name: str, value: Any) -> Iterator[None]:
    """Set one of JAX's settings, and restore it afterwards."""
    settings: Any = jax.config  # its attributes are created at import, so type checkers do not know them
    before = getattr(settings, name)
    settings.update(name, value)
    try:
        yield
    finally:
        settings.update(name, before)


class TracedProgram:
    """A function of arrays, traced or read from the cache. `lower` prepares it for compilation.

    Its first arrays are carried: it returns them first, possibly changed. Its last `others` arrays are not.
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
        """`shapes` returns the arguments as `ShapeDtypeStruct`s; `result` is any tree with the result's structure.

        `key` must contain everything that the traced program depends on; with None it is not cached. With `others` None
        no array is carried.
        """
        self._name, self._function, self._shapes, self._others = name, function, shapes, others
        self._structure = jax.tree.structure(result)
        self._path = _path(name, key)
        self._kept = _read(self._path)

    def _traced(self) -> tuple[Any, list[int]]:
        """(exported program, indices of the carried arrays that it leaves unchanged)."""
        if self._kept is None:
            leaves, structure = jax.tree.flatten(self._shapes())
            carried, unchanged = self._carried(leaves), list[int]()

            def flat(*arrays: Any) -> Any:
                results = jax.tree.leaves(self._function(*jax.tree.unflatten(structure, arrays)))
                unchanged[:] = [k for k in range(carried) if results[k] is arrays[k]]
                return [result for k, result in enumerate(results) if k not in unchanged]

            exported = jax.export.export(jax.jit(flat))(*leaves)
            _write(self._path, exported, unchanged)
            self._kept = exported, unchanged
        return self._kept

    def _carried(self, leaves: Sequence[Any]) -> int:
        """Number of carried arrays."""
        return 0 if self._others is None else len(leaves) - self._others

    def lower(self) -> Any:
        """`jax.stages.Lowered` of a function without carried arrays."""
        exported, _ = self._traced()

        def call(*arguments: Any) -> Any:
            return jax.tree.unflatten(self._structure, exported.call(*jax.tree.leaves(arguments)))

        call.__name__ = self._name  # its name in profiles and in the compilation cache
        return jax.jit(call).lower(*self._shapes())

    def lower_carrying(self) -> Carrying:
        """The lowered function, which takes the arrays that it reads and returns those that it changes."""
        exported, unchanged = self._traced()
        leaves = [jax.ShapeDtypeStruct(aval.shape, aval.dtype) for aval in exported.in_avals]
        carried = self._carried(leaves)
        writes = [k for k in range(carried) if k not in unchanged]
        special = [k for k, leaf in enumerate(leaves) if jnp.issubdtype(leaf.dtype, jax.dtypes.extended)]
        reads = sorted({*exported.module_kept_var_idx, *special})

        def call(*arrays: Any) -> Any:
            given = dict(zip(reads, arrays, strict=True))
            unread = lambda leaf: jnp.zeros(leaf.shape, leaf.dtype)  # noqa: E731
            return exported.call(*[given[k] if k in given else unread(leaf) for k, leaf in enumerate(leaves)])

        call.__name__ = self._name
        donated = [position for position, k in enumerate(reads) if k in writes]
        lowered = jax.jit(call, donate_argnums=donated).lower(*[leaves[k] for k in reads])
        return Carrying(lowered, carried, reads, writes)


class Carrying(NamedTuple):
    """A lowered function with carried arrays, which `compile` turns into `run(carried, *others)`."""

    lowered: Any
    carried: int  # number of carried arrays
    reads: Sequence[int]  # indices, among the carried and then the other arrays, of those that it takes
    writes: Sequence[int]  # indices of the carried arrays that it returns, before other results

    def compile(self, compiler_options: Mapping[str, Any] | None) -> Callable[..., list[Array]]:
        """`run` updates the list `carried`, which begins with the function's arrays, and returns the other results.

        The buffers of arrays that are replaced are donated.
        """
        compiled = self.lowered.compile(compiler_options=compiler_options)

        def run(carried: list[Array], *others: Any) -> list[Array]:
            arrays = [*carried[: self.carried], *others]
            results = jax.tree.leaves(compiled(*[arrays[k] for k in self.reads]))
            for k, array in zip(self.writes, results, strict=False):
                carried[k] = array
            return results[len(self.writes) :]

        return run


def _path(name: str, key: Mapping[str, Any] | None) -> Path | None:
    """File of the traced program in the cache; None without a cache or a key."""
    directory = traced_directory()
    if directory is None or key is None:
        return None
    settings = {option: str(getattr(jax.config, option)) for option in OPTIONS}
    text = json.dumps({**key, **settings, "platform": jax.default_backend()}, sort_keys=True)
    return directory / f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:32]}.stablehlo"


def _read(path: Path | None) -> tuple[Any, list[int]] | None:
    """(exported program, indices of unchanged arrays) of the file `path`; None if it cannot be read."""
    if path is None:
        return None
    try:
        first, _, program = path.read_bytes().partition(b"\n")
        return jax.export.deserialize(bytearray(program)), parse_json(first)
    except Exception:  # absent, truncated, or of another JAX: the program is traced again
        return None


def _write(path: Path | None, exported: Any, unchanged: list[int]) -> None:
    if path is None:
        return
    with contextlib.suppress(OSError):  # training works without the cache, which may be full or read-only
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, json.dumps(unchanged).encode() + b"\n" + exported.serialize())
