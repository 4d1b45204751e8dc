"""Where the seconds of a training go: every phase of `train.py` from process start to process end, as a table and JSON.

`python benchmarks/timeline.py [--runs N] [--algorithms sac gradient ...] [--json FILE] [--flags "--seed 1 ..."]`

Each algorithm trains once with an empty cache (cold), then `--runs` times with it (warm). The trainer itself runs
unchanged: it is started through this file, which notes when imports and functions of the list below begin and end, in
which thread, and JAX's own reports of tracing, lowering, compiling and reading the cache. Seconds count from before the
process starts; `cpu` is the thread's own time, which other work on the machine does not lengthen. The policy is there
at `policy`; what follows is evaluation and figures. Before, each algorithm runs once for a moment, uncounted: a machine
reads libraries from its disk only once.
"""

from __future__ import annotations

import argparse
import contextlib
import functools
import importlib.abc
import importlib.machinery
import json
import os
import shlex
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

IMPORTS = (
    "jax",
    "brax.training.networks",
    "brax.envs.base",
    "mujoco.mjx",
    "mujoco",
    "flax",
    "optax",
    "scipy.linalg",
    "orbax.checkpoint",
    "matplotlib.pyplot",
    "tensorboardX",
    "mjxball.train.run",
    "mjxball.commands.train",
)
FUNCTIONS = {
    "mjxball.commands.train": (
        "parser",
        "_new_run",
        "_run",
        "_first_kernel",
        "_prepare_evaluation",
        "draw_training",
        "_evaluate",
    ),
    "mjxball.train.run": ("Run.__init__", "Run._start", "Run._row", "Run._evaluated", "Run._save", "Run._export"),
    "mjxball.train.population": (
        "Population.__init__",
        "Population.template",
        "Population.compile",
        "Population.start",
        "Population.metric_names",
    ),
    "mjxball.train.compilation": (
        "TracedProgram._traced",
        "TracedProgram.lower",
        "TracedProgram.lower_carrying",
        "Carrying.compile",
        "_read",
        "_write",
    ),
    "mjxball.train.checkpoint": ("Checkpoints.__init__", "Checkpoints.save"),
}
VARIABLE = "MJXBALL_TIMELINE"


class Recorder:
    """Spans of one process: name, seconds since `started`, and the thread's CPU seconds."""

    def __init__(self, started: float):
        self._started, self.spans = started, []
        self.mark("process runs Python")

    def now(self) -> float:
        """Seconds since the process was started."""
        return time.time() - self._started

    def add(self, name: str, begin: float, end: float, cpu: float) -> None:
        """One span of this thread; `process` is the CPU time of all threads when it ended."""
        row = {"name": name, "begin": round(begin, 4), "end": round(end, 4), "cpu": round(cpu, 4)}
        row["process"] = round(time.process_time(), 4)
        self.spans.append(row | {"thread": threading.current_thread().name})

    def mark(self, name: str) -> None:
        """A moment."""
        self.add(name, self.now(), self.now(), time.process_time())

    @contextlib.contextmanager
    def span(self, name: str) -> Iterator[None]:
        """What happens inside."""
        begin, cpu = self.now(), time.thread_time()
        try:
            yield
        finally:
            self.add(name, begin, self.now(), time.thread_time() - cpu)

    def wrapped(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """`function`, noted as `name` and the first argument that is a word or a number of steps."""

        @functools.wraps(function)
        def call(*arguments: Any, **others: Any) -> Any:
            words = [one for one in arguments if isinstance(one, str)]
            words += [f"{int(one.steps)} steps" for one in arguments if type(one).__name__ == "Mode"]
            with self.span(" ".join([name, *words[:1]])):
                return function(*arguments, **others)

        return call

    def reported(self, event: str, seconds: float, **more: Any) -> None:
        """JAX's report of something that just ended."""
        short = {
            "jaxpr_trace_duration": "trace",
            "jaxpr_to_mlir_module_duration": "lower",
            "backend_compile_duration": "compile",
            "cache_retrieval_time_sec": "read cache",
        }.get(event.rpartition("/")[2])
        if short and seconds > 0.005:
            self.add(f"jax {short} {more.get('fun_name', '')}".strip(), self.now() - seconds, self.now(), 0.0)

    def loaded(self, name: str, module: Any) -> None:
        """Wrap what is to be noted of a module that was imported just now."""
        if name == "jax":
            module.monitoring.register_event_duration_secs_listener(self.reported)
        for path in FUNCTIONS.get(name, ()):
            owner, _, attribute = path.rpartition(".")
            holder = getattr(module, owner) if owner else module
            setattr(holder, attribute, self.wrapped(path, getattr(holder, attribute)))


class Finder(importlib.abc.MetaPathFinder):
    """Notes how long the modules that matter take to import."""

    def __init__(self, recorder: Recorder):
        self._recorder = recorder

    def find_spec(self, name: str, path: Any, target: Any = None) -> Any:
        """Python's own finding, with `exec_module` wrapped."""
        if name not in IMPORTS and name not in FUNCTIONS:
            return None
        spec = importlib.machinery.PathFinder.find_spec(name, path, target)
        if spec is None or spec.loader is None:
            return spec
        execute, recorder = spec.loader.exec_module, self._recorder

        def exec_module(module: Any) -> None:
            with recorder.span(f"import {name}") if name in IMPORTS else contextlib.nullcontext():
                execute(module)
            recorder.loaded(name, module)

        spec.loader.exec_module = exec_module  # type: ignore[method-assign]
        return spec


def child() -> int:
    """The trainer with its time line, written at the end to the file that the variable names."""
    started, file = json.loads(os.environ.pop(VARIABLE))
    recorder = Recorder(started)
    sys.meta_path.insert(0, Finder(recorder))
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from mjxball.entry import train

    code = train()
    recorder.mark("main returns")
    Path(file).write_text(json.dumps(recorder.spans))
    return code


def run(flags: list[str], cache: Path, place: Path) -> dict[str, Any]:
    """One training: its spans and when the policy and the whole command were there."""
    from training import launch

    file, out = place / "spans.json", place / "run"
    out.mkdir(exist_ok=True)
    out = out / str(time.monotonic_ns())
    started = time.time()
    command = ["benchmarks/timeline.py", "transport", "--out", str(out), *flags]
    process = launch(command, cache, **{VARIABLE: json.dumps([started, str(file)])})
    policy, lines = None, []
    for line in process.stdout or ():
        lines.append(line)
        if line.startswith("policy:"):
            policy = (out / "policy.npz").stat().st_mtime - started
    if process.wait():
        raise RuntimeError(f"training failed:\n{''.join(lines)[-3000:]}")
    spans = sorted(json.loads(file.read_text()), key=lambda span: (span["begin"], -span["end"]))
    return {"policy": policy, "ended": time.time() - started, "spans": spans}


def show(title: str, found: dict[str, Any], least: float) -> None:
    """Spans of at least so many seconds, indented by thread and nesting."""
    print(f"\n{title}: policy {found['policy']:.2f} s, process ended {found['ended']:.2f} s")
    print("  begin length   cpu  of all")
    open_: dict[str, list[float]] = {}
    for span in found["spans"]:
        inside = open_.setdefault(span["thread"], [])
        while inside and inside[-1] <= span["begin"] + 1e-4:
            inside.pop()
        moment = span["begin"] == span["end"]
        if moment or span["end"] - span["begin"] >= least:
            thread = "" if span["thread"] == "MainThread" else f"  [{span['thread']}]"
            length = "" if moment else f"{span['end'] - span['begin']:6.2f}"
            times = f"{span['begin']:7.2f} {length:>6} {span['cpu']:5.2f} {span['process']:6.2f}"
            print(f"{times}  {'  ' * len(inside)}{span['name']}{thread}")
        inside.append(span["end"])
    sys.stdout.flush()


def main() -> None:
    """Measure, print, write."""
    from algorithms import ON_GPU, SHORT
    from training import NO_CACHE, versions

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--algorithms", nargs="+", choices=tuple(SHORT), default=["sac", "gradient"])
    parser.add_argument("--runs", type=int, default=1, help="with a warm cache")
    parser.add_argument("--gpu", action="store_true", help="the settings of one GPU, see benchmarks/algorithms.py")
    parser.add_argument("--flags", default="", help="further flags of train.py")
    parser.add_argument("--again", action="store_true", help="the libraries were read just now: none runs uncounted")
    parser.add_argument("--least", type=float, default=0.05, metavar="S", help="shortest span in the table")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    found: dict[str, Any] = {"flags": options.flags, "runs": []}
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        for algorithm in options.algorithms:
            chosen = ["--algorithm", algorithm, "--seed", "0", *shlex.split(ON_GPU[algorithm] if options.gpu else "")]
            chosen += shlex.split(options.flags)
            if not options.again:
                run([*chosen, *shlex.split(SHORT[algorithm])], NO_CACHE, place)
            for number in range(1 + options.runs):
                row = run(chosen, place / f"cache-{algorithm}", place)
                title = f"{algorithm}, {'warm' if number else 'cold'}"
                show(title, row, options.least)
                found["runs"].append({"algorithm": algorithm, "cache": title.rpartition(" ")[2], **row})
    found["versions"] = versions() | {"load_average": os.getloadavg()}
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    sys.exit(child() if VARIABLE in os.environ else main())
