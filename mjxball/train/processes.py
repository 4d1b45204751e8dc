"""Distributed training: several processes over JAX's multi-process runtime, of which process 0 writes files."""

from __future__ import annotations

import contextlib
import errno
import functools
import os
import socket
import subprocess
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjxball.errors import InputError, TrainingDivergedError
from mjxball.running import FAULT
from mjxball.terminal import warn
from mjxball.train import lock

HEARTBEAT = 20  # [s] after which a process that does not respond counts as dead
PATIENCE = 120  # [s] within which all processes must connect at the start
MOST = 4096  # processes; JAX would allocate for a billion


@dataclass(frozen=True)
class Rendezvous:
    """Addresses of a distributed run. Without a coordinator JAX asks SLURM, Open MPI or Kubernetes."""

    coordinator: str | None = None  # HOST:PORT of process 0
    processes: int | None = None
    process: int | None = None

    def __post_init__(self) -> None:
        if self.coordinator is None or self.processes is None or self.process is None:
            if (self.coordinator, self.processes, self.process) != (None, None, None):
                raise InputError("--coordinator, --processes and --process belong together: give all three or none")
            return
        host, _, port = self.coordinator.rpartition(":")
        if not (host and port.isdecimal() and len(port) < 6 and 0 < int(port) < 65536):
            raise InputError(f"--coordinator must be HOST:PORT, not {self.coordinator!r}")
        if not 1 <= self.processes <= MOST:
            raise InputError(f"--processes must be 1 .. {MOST}, not {self.processes}")
        if not 0 <= self.process < self.processes:
            raise InputError(f"--process must be 0 .. {self.processes - 1}, not {self.process}")


def join(rendezvous: Rendezvous) -> None:
    """Connect to the other processes. Must precede every other use of JAX's devices.

    If they do not connect within `PATIENCE`, the process prints an error and exits with code 2, where JAX would abort.
    JAX waits in a separate thread, because it blocks outside Python. The main thread handles signals, and wakes now and
    then for those that came to another thread or just before it began to wait.
    """
    import jax

    own_address = rendezvous.coordinator if rendezvous.process == 0 else None
    bind_address = None if own_address is None else _bind_address(own_address)
    where = f"at {rendezvous.coordinator}" if rendezvous.coordinator else f"under {' and '.join(_schedulers())}"
    failures: list[Exception] = []

    def initialize() -> None:
        try:
            jax.distributed.initialize(
                rendezvous.coordinator,
                rendezvous.processes,
                rendezvous.process,
                _only_device(),
                initialization_timeout=10 * PATIENCE,
                heartbeat_timeout_seconds=HEARTBEAT,
                coordinator_bind_address=bind_address,
            )
        except Exception as error:  # Kubernetes' client raises errors of its own classes
            failures.append(error)

    waiting = threading.Thread(target=initialize, daemon=True)
    with warnings.catch_warnings(action="ignore"):  # the error message below replaces them
        waiting.start()
        deadline = time.monotonic() + PATIENCE
        while waiting.is_alive() and time.monotonic() < deadline:
            waiting.join(0.1)
    if waiting.is_alive():
        warn(f"error: the processes did not come together {where} within {PATIENCE} s: each must reach process 0")
        os._exit(2)  # any other exit would abort while JAX's thread runs
    for error in failures:
        why = (str(error).splitlines() or [type(error).__name__])[0][:200]
        unknown = rendezvous.coordinator is None and isinstance(error, ValueError)
        raise InputError(_advice() if unknown else f"the processes cannot come together {where}: {why}") from None


def _only_device() -> list[int] | None:
    """[0] if this process sees one GPU: JAX would take the index of the process on its node instead."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES", "")
    return [0] if visible and "," not in visible else None


def _bind_address(coordinator: str) -> str | None:
    """Address at which process 0 listens: `coordinator`, or None (all interfaces) if this machine does not have it.

    Behind address translation, a machine does not have the address at which others reach it. InputError if another
    program uses the port, where JAX would crash.
    """
    host, _, port = coordinator.rpartition(":")
    for name, address in ((host.strip("[]"), coordinator), ("", None)):
        family = socket.AF_INET6 if ":" in name else socket.AF_INET
        try:
            socket.create_server((name, int(port)), family=family).close()
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                raise InputError(
                    f"--coordinator {coordinator}: another program of this machine has that port"
                ) from None
        else:
            return address
    return None


# Scheduler: (variable that it sets, what the user must do so that JAX finds the processes).
SCHEDULERS = {
    "SLURM": ("SLURM_JOB_ID", "start the processes with srun"),
    "Open MPI": (
        "OMPI_COMM_WORLD_SIZE",
        "of version 5 and later pass --coordinator HOST:PORT --processes $OMPI_COMM_WORLD_SIZE "
        "--process $OMPI_COMM_WORLD_RANK",
    ),
    "Kubernetes": ("KUBERNETES_SERVICE_HOST", "install the Python package kubernetes and run an indexed Job or JobSet"),
}


def _schedulers() -> list[str]:
    """Names of the `SCHEDULERS` that this process runs under."""
    return [name for name, (variable, _) in SCHEDULERS.items() if variable in os.environ]


def _advice() -> str:
    """Error message if JAX cannot find the other processes through a scheduler."""
    found = _schedulers()
    if not found:
        return (
            f"--distributed found none of {', '.join(SCHEDULERS)}: start it with srun or mpirun, "
            "or pass --coordinator HOST:PORT --processes N --process I"
        )
    ways = "; ".join(SCHEDULERS[name][1] for name in found)
    return f"--distributed found {' and '.join(found)}, but not where the processes meet: {ways}"


def leave() -> None:
    """Shut down jax.distributed; this process may continue alone."""
    import jax

    jax.distributed.shutdown()


def is_writer() -> bool:
    """Whether this is process 0, which writes files and prints."""
    import jax

    return jax.process_index() == 0


def gather(tree: Any) -> Any:
    """`tree` with every distributed array copied to NumPy as a whole, in every process. All processes must call it."""
    import jax

    leaves, structure = jax.tree.flatten(tree)
    spread = [k for k, leaf in enumerate(leaves) if isinstance(leaf, jax.Array) and not leaf.is_fully_addressable]
    if spread:
        replicated = _replicate(leaves[spread[0]].sharding.mesh)([leaves[k] for k in spread])
        for k, leaf in zip(spread, replicated, strict=True):
            leaves[k] = leaf.addressable_data(0)
    return jax.tree.unflatten(structure, [np.array(leaf) for leaf in leaves])


@functools.cache
def _replicate(mesh: Any) -> Any:
    """Jitted function that copies whole arrays to every device; cached, so that it compiles once per tree."""
    import jax
    from jax.sharding import NamedSharding, PartitionSpec

    return jax.jit(lambda arrays: arrays, out_shardings=NamedSharding(mesh, PartitionSpec()))


def any_of(flags: tuple[bool, ...]) -> tuple[bool, ...]:
    """For each flag, whether it is true in any process. All processes must call it."""
    import jax
    from jax.experimental import multihost_utils

    if jax.process_count() == 1:
        return flags
    everywhere = multihost_utils.process_allgather(np.array(flags, np.int32))
    return tuple(bool(flag) for flag in np.max(everywhere, axis=0))


@contextlib.contextmanager
def holding(run: Path, distributed: bool, check: Callable[[], Any]) -> Iterator[None]:
    """Lock the run directory `run` (see `lock.held`), then `check` it, both in process 0 for all processes.

    Raises InputError in every process if either fails.
    """
    if not distributed:
        with lock.held(run):
            check()
            yield
        return
    refused = None
    with contextlib.ExitStack() as stack:
        if is_writer():
            try:
                stack.enter_context(lock.held(run))
                check()
            except InputError as error:
                refused = error
        (anywhere,) = any_of((refused is not None,))
        if anywhere:
            leave()
            raise refused or InputError(f"process 0 cannot train into {run}, and says why")
        yield


@contextlib.contextmanager
def exit_when_a_process_is_lost(resume: str) -> Iterator[None]:
    """If this or another process fails, print an error that recommends `resume`, and exit with a non-zero code.

    After the loss of a process, a collective operation raises, or JAX's runtime aborts this process. In the second case
    a small watcher process prints the error.
    """
    advice = f"Start all of them again with {resume}"
    watcher = _watcher(f"\nthis process was ended, because another one of the run was lost. {advice}")
    try:
        yield
    except (InputError, TrainingDivergedError):
        raise
    except Exception as error:
        import jax

        if not isinstance(error, jax.errors.JaxRuntimeError):
            traceback.print_exc()
        _dismiss(watcher)
        why = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
        warn(f"process {jax.process_index()} cannot go on, because it or another one failed: {why}. {advice}")
        os._exit(FAULT)  # a normal shutdown of JAX would wait for the lost process
    finally:
        _dismiss(watcher)


WATCH = "import sys; sys.stdin.read(1) or print(sys.argv[1], file=sys.stderr)"


def _watcher(text: str) -> subprocess.Popen[bytes]:
    """A process that prints `text` if this one ends without `_dismiss`."""
    command = [sys.executable, "-I", "-S", "-c", WATCH, text]
    return subprocess.Popen(command, stdin=subprocess.PIPE, start_new_session=True)


def _dismiss(watcher: subprocess.Popen[bytes]) -> None:
    if watcher.poll() is None:
        watcher.communicate(b".", timeout=10)
