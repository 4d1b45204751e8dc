"""Compilation: JAX's settings around it, and traced programs, kept beside XLA's compilation cache for the next run."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import jax
from jax.sharding import Mesh

from mjxball.cache import traced_directory

OPTIONS = ("jax_enable_x64", "jax_default_prng_impl", "jax_threefry_partitionable", "jax_default_matmul_precision")
# Kernels of this size gain nothing from being tuned and optimised further, and it costs a third of the compile time.
# (cuBLAS instead of Triton's products compiles 2 s sooner and then takes 4 s to load and run: docs/archive.)
GPU_OPTIONS: dict[str, Any] = {"xla_gpu_autotune_level": 0, "xla_backend_optimization_level": 1}
# Batches of thousands gain a third of the run from tuned products (PPO of `ant`: docs/archive/training.md).
TUNED_GPU_OPTIONS: dict[str, Any] = {"xla_backend_optimization_level": 1}
# For algorithms that are done sooner than XLA, which then compiles twice as fast what runs a quarter slower.
CPU_OPTIONS: dict[str, Any] = {"xla_backend_optimization_level": 1}
if jax.__version_info__ < (0, 11):
    CPU_OPTIONS["xla_cpu_use_fusion_emitters"] = False
# One follower's products of layers of 64 are small enough for plain loops, which spare XLA a kernel in Triton for each
# (2 - 5 s to compile). For many followers at once Triton's are faster (64: by a quarter).
PLAIN_PRODUCTS = {"xla_gpu_gemm_rewrite_size_threshold": 70_000}  # numbers in both matrices


def compiler_options(algorithm: Any = None, members: int = 1) -> dict[str, Any] | None:
    """XLA's options for training `members` followers at once by `algorithm` on JAX's default device.

    Also for `mjxball.train.train`: `jax.jit(lambda key: train(config, key), compiler_options=compiler_options())`, with
    the class of the algorithm if it is not SAC.
    """
    if jax.default_backend() == "gpu":
        if getattr(algorithm, "worth_tuning", False):
            return TUNED_GPU_OPTIONS
        return GPU_OPTIONS | (PLAIN_PRODUCTS if members == 1 else {})
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
    """One function of arrays, traced or found in the cache. `lower(donate)` readies it for compilation."""

    def __init__(
        self, name: str, key: Mapping[str, Any] | None, function: Callable[..., Any], shapes: Any, result: Any
    ):
        """`shapes` are the arguments' `ShapeDtypeStruct`s, `result` any tree with the structure of what it returns.

        `key` must hold everything that the traced program depends on; None: it is not kept.
        """
        self._name = name
        self._shapes, self._structure = shapes, jax.tree.structure(result)
        path = _path(name, key)
        exported = _read(path)
        if exported is None:
            leaves, structure = jax.tree.flatten(shapes)

            def flat(*arrays: Any) -> Any:
                return jax.tree.leaves(function(*jax.tree.unflatten(structure, arrays)))

            exported = jax.export.export(jax.jit(flat))(*leaves)
            _write(path, exported)
        self._exported = exported

    def lower(self, donate: int | None = None) -> Any:
        """`jax.stages.Lowered`; argument number `donate` gives its memory away."""

        def call(*arguments: Any) -> Any:
            return jax.tree.unflatten(self._structure, self._exported.call(*jax.tree.leaves(arguments)))

        call.__name__ = self._name  # what profiles and the compilation cache call it
        return jax.jit(call, donate_argnums=() if donate is None else donate).lower(*self._shapes)


def _path(name: str, key: Mapping[str, Any] | None) -> Path | None:
    place = traced_directory()
    if place is None or key is None:
        return None
    settings = {option: str(getattr(jax.config, option)) for option in OPTIONS}
    text = json.dumps({**key, **settings, "platform": jax.default_backend()}, sort_keys=True)
    return place / f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:32]}.stablehlo"


def _read(path: Path | None) -> Any:
    """The exported program in `path`, None if there is none that can be read."""
    if path is None:
        return None
    try:
        return jax.export.deserialize(bytearray(path.read_bytes()))
    except Exception:  # absent, cut short, or of another JAX: traced anew
        return None


def _write(path: Path | None, exported: Any) -> None:
    if path is None:
        return
    partial = path.with_suffix(f".{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_bytes(exported.serialize())
        partial.replace(path)
    except OSError:  # a full or read-only cache is no reason not to train
        partial.unlink(missing_ok=True)
