"""Several processes that train together over JAX's own multi-process runtime; process 0 writes."""

from __future__ import annotations

import contextlib
import errno
import functools
import os
import socket
import subprocess
import sys
import threading
import traceback
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjxball.cli import FAULT
from mjxball.errors import InputError, TrainingDivergedError
from mjxball.terminal import warn
from mjxball.train import lock

HEARTBEAT = 20  # [s] after which a process that does not answer counts as dead
PATIENCE = 120  # [s] for all processes to come together at the start
MOST = 4096  # processes; JAX would make room for a billion


@dataclass(frozen=True)
class Rendezvous:
    """Where the processes meet. Without a coordinator JAX asks SLURM, Open MPI or Kubernetes."""

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


def join(meeting: Rendezvous) -> None:
    """Join the other processes. Must come before anything else asks JAX for its devices.

    If they do not come together within `PATIENCE` the process says so and ends with exit code 2: JAX would abort it.
    JAX waits outside Python, hence in a thread of its own: the main thread hears signals meanwhile.
    """
    import jax

    own = meeting.coordinator if meeting.process == 0 else None
    bound = None if own is None else _bound(own)
    where = f"at {meeting.coordinator}" if meeting.coordinator else f"under {' and '.join(_surroundings())}"
    failures: list[Exception] = []

    def initialize() -> None:
        try:
            jax.distributed.initialize(
                meeting.coordinator,
                meeting.processes,
                meeting.process,
                _only_device(),
                initialization_timeout=10 * PATIENCE,
                heartbeat_timeout_seconds=HEARTBEAT,
                coordinator_bind_address=bound,
            )
        except Exception as error:  # those of Kubernetes' client are of a kind of their own
            failures.append(error)

    waiting = threading.Thread(target=initialize, daemon=True)
    with warnings.catch_warnings(action="ignore"):  # the sentence says what they would
        waiting.start()
        waiting.join(PATIENCE)
    if waiting.is_alive():
        warn(f"error: the processes did not come together {where} within {PATIENCE} s: each must reach process 0")
        os._exit(2)  # whoever ends a thread of JAX's in another way aborts
    for error in failures:
        why = (str(error).splitlines() or [type(error).__name__])[0][:200]
        unknown = meeting.coordinator is None and isinstance(error, ValueError)
        raise InputError(_advice() if unknown else f"the processes cannot come together {where}: {why}") from None


def _only_device() -> list[int] | None:
    """The one GPU that this process may see is its number 0; JAX takes it for that of its place in the node."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES", "")
    return [0] if visible and "," not in visible else None


def _bound(coordinator: str) -> str | None:
    """Where process 0 listens: at `coordinator` alone, or None, on all interfaces, if that is none of this machine's.

    A machine behind address translation does not have the address at which others reach it. InputError if another
    program listens at that port, at which JAX would crash.
    """
    host, _, port = coordinator.rpartition(":")
    for name, place in ((host.strip("[]"), coordinator), ("", None)):
        family = socket.AF_INET6 if ":" in name else socket.AF_INET
        try:
            socket.create_server((name, int(port)), family=family).close()
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                raise InputError(
                    f"--coordinator {coordinator}: another program of this machine has that port"
                ) from None
        else:
            return place
    return None


# What each says of itself, and what makes JAX understand it.
SURROUNDINGS = {
    "SLURM": ("SLURM_JOB_ID", "start the processes with srun"),
    "Open MPI": (
        "OMPI_COMM_WORLD_SIZE",
        "of version 5 and later pass --coordinator HOST:PORT --processes $OMPI_COMM_WORLD_SIZE "
        "--process $OMPI_COMM_WORLD_RANK",
    ),
    "Kubernetes": ("KUBERNETES_SERVICE_HOST", "install the Python package kubernetes and run an indexed Job or JobSet"),
}


def _surroundings() -> list[str]:
    """Which of `SURROUNDINGS` this process runs in."""
    return [name for name, (variable, _) in SURROUNDINGS.items() if variable in os.environ]


def _advice() -> str:
    """What to do if JAX cannot tell from the surroundings where the processes meet."""
    found = _surroundings()
    if not found:
        return (
            f"--distributed found none of {', '.join(SURROUNDINGS)}: start it with srun or mpirun, "
            "or pass --coordinator HOST:PORT --processes N --process I"
        )
    ways = "; ".join(SURROUNDINGS[name][1] for name in found)
    return f"--distributed found {' and '.join(found)}, but not where the processes meet: {ways}"


def leave() -> None:
    """Part from the other processes; this one may go on alone."""
    import jax

    jax.distributed.shutdown()


def is_writer() -> bool:
    """True in the one process that writes files and prints."""
    import jax

    return jax.process_index() == 0


def gather(tree: Any) -> Any:
    """The whole of every array as NumPy, copied, in every process; all must call it."""
    import jax

    leaves, structure = jax.tree.flatten(tree)
    spread = [k for k, leaf in enumerate(leaves) if isinstance(leaf, jax.Array) and not leaf.is_fully_addressable]
    if spread:
        together = _replicate(leaves[spread[0]].sharding.mesh)([leaves[k] for k in spread])
        for k, leaf in zip(spread, together, strict=True):
            leaves[k] = leaf.addressable_data(0)
    return jax.tree.unflatten(structure, [np.array(leaf) for leaf in leaves])


@functools.cache
def _replicate(mesh: Any) -> Any:
    """The program that brings arrays whole to every device; one, so that it is compiled once for each tree."""
    import jax
    from jax.sharding import NamedSharding, PartitionSpec

    return jax.jit(lambda arrays: arrays, out_shardings=NamedSharding(mesh, PartitionSpec()))


def any_of(flags: tuple[bool, ...]) -> tuple[bool, ...]:
    """Each flag, true if it is true in any process; all must call it."""
    import jax
    from jax.experimental import multihost_utils

    if jax.process_count() == 1:
        return flags
    everywhere = multihost_utils.process_allgather(np.array(flags, np.int32))
    return tuple(bool(flag) for flag in np.max(everywhere, axis=0))


@contextlib.contextmanager
def holding(run: Path, meeting: bool, check: Callable[[], Any]) -> Iterator[None]:
    """Hold the run directory `run` for all processes, see `lock.held`, and `check` it then, both in process 0.

    Raises InputError in every process if it is refused.
    """
    if not meeting:
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
    """If this or another process fails, say so, name `resume` as the way on, and end with a non-zero exit code.

    A lost process shows in two ways: a collective operation raises, or JAX's runtime aborts this process. For the
    second a small watcher process prints the sentence.
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
        os._exit(FAULT)  # the runtime's own farewell would wait for the lost process
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
