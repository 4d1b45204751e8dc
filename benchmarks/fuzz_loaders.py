"""Mutated policy files, run records and checkpoints: each must load right or be refused in one sentence.

`python benchmarks/fuzz_loaders.py [--files 10000] [--records 1000] [--checkpoints 100] [--seed 0] [--json FILE]`

Counts for every kind of mutation what loaded, what was refused, and what went wrong: another exception than the
one-line refusal, code run from the file, too much memory, too much time. Exit code 1 if anything did. Checkpoints
are damaged files of a small run that is trained first (half a minute); they are read in a process of their own,
whose death would count as a fault.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mjxball import config as configs
from mjxball.control.observation import OBSERVATION_SIZE
from mjxball.errors import InputError
from mjxball.evaluate.policies import load_policy
from mjxball.policy import Policy, shipped_policies
from mjxball.train.curves import read_members, training_summary
from mjxball.train.run_directory import read_config
from mutations import ANY, CSV, JSON, POLICY, WITNESS

TRAIN = Path(__file__).parents[1] / "train.py"
MEMORY = 256 * 2**20  # [B] that reading one file may take: a few times the largest file that is read
PATIENCE = 10.0  # [s] for one file
ROOM = 8 * 2**30  # [B] of address space for the whole process
SEEN = np.random.default_rng(0).normal(size=(5, OBSERVATION_SIZE))
FORBIDDEN = ("pickle.find_class", "subprocess.Popen", "os.system", "os.exec", "os.posix_spawn", "socket.connect")
events: list[str] = []  # forbidden ones, as Python's audit hook tells them


class HangError(BaseException):
    """Reading took longer than `PATIENCE`; no loader's `except Exception` can catch it."""


@dataclass
class Count:
    """What became of the files of one kind."""

    kind: str
    files: int = 0
    loaded: int = 0
    refused: int = 0
    faults: int = 0
    longest: float = 0.0  # [s]
    memory: float = 0.0  # [MiB] most of any file


def watch() -> None:
    """Note forbidden events, and limit what the process may take."""
    sys.addaudithook(lambda event, _: events.append(event) if event in FORBIDDEN else None)
    resource.setrlimit(resource.RLIMIT_AS, (ROOM, ROOM))


@contextmanager
def patience(seconds: float) -> Iterator[None]:
    """Raise HangError in the body after `seconds`."""

    def over(*_: Any) -> None:
        raise HangError

    before = signal.signal(signal.SIGALRM, over)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def outcome(load: Callable[[Path], object], path: Path) -> str:
    """'loaded', 'refused', or what went wrong."""
    events.clear()
    os.environ.pop(WITNESS, None)
    try:
        with patience(PATIENCE):
            load(path)
        result = "loaded"
    except InputError as error:
        result = "refused" if str(error).isprintable() and str(error) else f"not one line: {str(error)[:80]!r}"
    except HangError:
        result = "it hung"
    except BaseException as error:
        result = f"{type(error).__name__}: {str(error)[:80]}"
    if events or WITNESS in os.environ:
        result = f"ran code: {events or WITNESS}"
    return result


def measured(load: Callable[[Path], object], path: Path, count: Count) -> str:
    """`outcome`, with time and memory added to `count`."""
    tracemalloc.start()
    began = time.perf_counter()
    result = outcome(load, path)
    count.longest = max(count.longest, time.perf_counter() - began)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    count.memory = max(count.memory, peak / 2**20)
    if peak > MEMORY:
        result = f"took {peak >> 20} MiB"
    count.files += 1
    if result in ("loaded", "refused"):
        setattr(count, result, getattr(count, result) + 1)
    else:
        count.faults += 1
        print(f"FAULT {count.kind}: {result}", file=sys.stderr)
    return result


def load_and_fly(path: Path) -> None:
    """What `eval.py` does with a policy file before it flies, and one batch of commands, which must be finite."""
    policy = Policy.load(path)
    if not np.isfinite(policy(SEEN)).all():
        raise ArithmeticError("a command is not finite")
    load_policy(path, configs.preset("paper"))


def read_records(run: Path) -> None:
    """All that is read of a run directory besides its checkpoints."""
    read_config(run)
    read_members(run)
    training_summary(run, 0)


def fuzz_policies(files: int, seed: int, place: Path) -> list[Count]:
    """Mutated copies of the shipped policies."""
    originals = [path.read_bytes() for path in shipped_policies()]
    counts = [Count(f"policy, {kind}") for kind in POLICY]
    path = place / "mutated.npz"
    for number in range(files):
        draw = random.Random(f"{seed} {number}")
        mutate = [*POLICY.values()][number % len(POLICY)]
        path.write_bytes(mutate(draw, draw.choice(originals)))
        measured(load_and_fly, path, counts[number % len(POLICY)])
    return counts


def fuzz_records(run: Path, files: int, seed: int) -> list[Count]:
    """A run directory of which one text file is damaged."""
    kinds = [("config.json", kind, JSON[kind]) for kind in JSON]
    kinds += [(name, kind, CSV[kind]) for name in ("metrics.csv", "members.csv") for kind in CSV]
    counts = [Count(f"{name}, {kind}") for name, kind, _ in kinds]
    originals = {name: (run / name).read_bytes() for name in ("config.json", "metrics.csv", "members.csv")}
    for number in range(files):
        name, _, mutate = kinds[number % len(kinds)]
        (run / name).write_bytes(mutate(random.Random(f"{seed} {number}"), originals[name]))
        measured(read_records, run, counts[number % len(kinds)])
        (run / name).write_bytes(originals[name])
    return counts


def fuzz_checkpoints(run: Path, files: int, seed: int) -> list[Count]:
    """A run directory of which one file of one checkpoint is damaged or gone."""
    import jax

    from mjxball.train.checkpoint import Checkpoints
    from mjxball.train.population import Population

    config, origin = read_config(run)
    template = Population(config, origin["physics"], origin["seeds"], origin["sweep"]).template()
    kinds = {**ANY, "emptied": lambda draw, content: b"", "gone": None, "json: text": JSON["json: text"]}
    counts = [Count(f"checkpoint, {kind}") for kind in kinds]

    def restored(directory: Path) -> Any:
        checkpoints = Checkpoints(directory)
        try:
            return checkpoints.restore(template, lambda text: None, discard=False)
        finally:
            checkpoints.close()

    def load(directory: Path) -> None:
        state = restored(directory)
        if state is None:
            raise InputError("no checkpoint can be read")
        leaves = [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(state)]
        if leaves not in sound:
            raise ArithmeticError("a damaged checkpoint was restored as if it were sound")

    sound = []  # the states of both checkpoints, the newest first; every damaged one must give one of them or none
    for step in sorted((run / "checkpoints").iterdir(), key=lambda path: -int(path.name)):
        sound.append([np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(restored(run))])
        step.rename(run / f"aside-{step.name}")
    (run / "checkpoints").mkdir(exist_ok=True)
    for aside in run.glob("aside-*"):
        aside.rename(run / "checkpoints" / aside.name.removeprefix("aside-"))
    load(run)
    for number in range(files):
        draw, mutate = random.Random(f"{seed} {number}"), [*kinds.values()][number % len(kinds)]
        copy = run.with_name("damaged")
        shutil.copytree(run, copy)
        path = draw.choice(sorted(path for path in (copy / "checkpoints").rglob("*") if path.is_file()))
        content = path.read_bytes()
        path.write_bytes(mutate(draw, content or b"\0")) if mutate else path.unlink()
        measured(load, copy, counts[number % len(kinds)])
        shutil.rmtree(copy)
    return counts


def small_run(place: Path) -> Path:
    """A run directory with checkpoints, of two followers with networks so small that damage hits everything."""
    flags = {
        "--physics": "newton-euler",
        "--seeds": 2,
        "--out": place / "run",
        "--sac.total_steps": 4096,
        "--sac.num_envs": 32,
        "--sac.replay_size": 3200,
        "--sac.warmup_steps": 1024,
        "--sac.updates_per_step": 1,
        "--timing.episode_steps": 100,
        "--sac.policy_layers": "8,8",
        "--sac.critic_layers": "8,8",
    }
    command = [sys.executable, str(TRAIN), *(str(word) for pair in flags.items() for word in pair)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env={**os.environ})
    if not (place / "run" / "checkpoints").is_dir():
        raise SystemExit(f"the small run failed:\n{done.stderr}")
    return place / "run"


def in_child(run: Path, files: int, seed: int) -> list[Count]:
    """`fuzz_checkpoints` in a process of its own."""
    command = [sys.executable, __file__, "--run", str(run), "--checkpoints", str(files), "--seed", str(seed)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        print(f"FAULT checkpoint: the reader died with code {done.returncode}", file=sys.stderr)
        return [Count("checkpoint, all", files, faults=1)]
    return [Count(**count) for count in json.loads(done.stdout.splitlines()[-1])]


def table(counts: list[Count]) -> str:
    """One line for each kind, and their sum."""
    total = Count("all", *(sum(getattr(c, name) for c in counts) for name in ("files", "loaded", "refused", "faults")))
    total.longest, total.memory = max(c.longest for c in counts), max(c.memory for c in counts)
    lines = [
        f"{'mutation':34s} {'files':>6s} {'loaded':>6s} {'refused':>7s} {'faults':>6s} {'slowest':>8s} {'most':>9s}"
    ]
    for c in (*counts, total):
        numbers = (
            f"{c.files:6d} {c.loaded:6d} {c.refused:7d} {c.faults:6d} {1e3 * c.longest:5.0f} ms {c.memory:5.1f} MiB"
        )
        lines.append(f"{c.kind:34s} {numbers}")
    return "\n".join(lines)


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--files", type=int, default=10_000, help="mutated policy files")
    parser.add_argument("--records", type=int, default=1000, help="mutated config.json, metrics.csv and members.csv")
    parser.add_argument("--checkpoints", type=int, default=100, help="runs with a damaged checkpoint")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--run", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.run:
        watch()
        print(json.dumps([asdict(count) for count in fuzz_checkpoints(options.run, options.checkpoints, options.seed)]))
        return 0
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        run = small_run(place) if options.records or options.checkpoints else place
        watch()
        counts = fuzz_policies(options.files, options.seed, place)
        counts += fuzz_records(run, options.records, options.seed) if options.records else []
        counts += in_child(run, options.checkpoints, options.seed) if options.checkpoints else []
    print(table(counts))
    if options.json:
        options.json.write_text(
            json.dumps({"seed": options.seed, "kinds": [asdict(c) for c in counts]}, indent=1) + "\n"
        )
    return 1 if any(count.faults for count in counts) else 0


if __name__ == "__main__":
    sys.exit(main())
