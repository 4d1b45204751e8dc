"""What one step of SAC's training is made of on a GPU: kernels, their time and the gaps between them.

`python benchmarks/kernels.py [--members 1 64] [--rounds 100] [--gpu] [--top 30] [--json FILE]`

Of each number of followers trained at once the training program of `transport` runs some rounds (a step of all
environments and its updates) under JAX's profiler. Printed per round: seconds by the clock, kernels and copies, seconds
in them, and the kernels that take longest, by name with how often they run. `--gpu` takes the settings of one follower
on a GPU (`benchmarks/algorithms.py`), else the preset's, by which populations are measured.
"""

from __future__ import annotations

import argparse
import collections
import json
import shlex
import tempfile
import time
from pathlib import Path
from typing import Any

import jax

from algorithms import ON_GPU
from mjxball import config as configs
from mjxball.train import program as programs
from mjxball.train.population import Population
from training import say, versions

IGNORED = ("Steps", "XLA Modules", "Framework Name Scope", "Source code", "Launch Stats")  # lines that sum up others


def settings_of(flags: str) -> configs.Config:
    """The preset with some of the flags of `train.py`."""
    words, config = shlex.split(flags), configs.preset("transport")
    for name, value in zip(words[::2], words[1::2], strict=True):
        config = configs.override(config, name.removeprefix("--"), value)
    return config


def profile(members: int, config: configs.Config, physics: str, rounds: int) -> dict[str, Any]:
    """Seconds by the clock and in kernels of `rounds` rounds."""
    population = Population(config, physics, members, devices=jax.devices()[:1])
    compiled = population.compile(creating=True)
    state = population.start(compiled, 0)
    mode = programs.train(rounds)
    state, *_ = compiled.advance(state, programs.warmup(population.program.warmup_rounds))
    state, *_ = jax.block_until_ready(compiled.advance(state, mode))
    began = time.perf_counter()
    state, *_ = jax.block_until_ready(compiled.advance(state, mode))
    seconds = (time.perf_counter() - began) / rounds
    with tempfile.TemporaryDirectory() as place:
        with jax.profiler.trace(place):
            jax.block_until_ready(compiled.advance(state, mode))
        (file,) = Path(place).rglob("*.xplane.pb")
        found = read(file)
    count, busy = sum(n for n, _ in found.values()), sum(t for _, t in found.values())
    top = sorted(found.items(), key=lambda item: -item[1][1])
    return {
        "members": members,
        "seconds": seconds,
        "rate": population.program.schedule.num_envs * members / seconds,
        "kernels": count / rounds,
        "in_kernels": busy / rounds,
        "top": [{"name": name, "times": n / rounds, "seconds": t / rounds} for name, (n, t) in top],
    }


def read(file: Path) -> dict[str, tuple[int, float]]:
    """Of every kernel in a profile: how often it ran and for how many seconds in all."""
    found: dict[str, list[float]] = collections.defaultdict(lambda: [0, 0.0])
    planes = list(jax.profiler.ProfileData.from_file(str(file)).planes)
    devices = [plane for plane in planes if "/device:" in plane.name and "CUSTOM" not in plane.name]
    for plane in devices or planes:
        for line in plane.lines:
            if not any(line.name.startswith(name) for name in IGNORED):
                for event in line.events:
                    found[event.name][0] += 1
                    found[event.name][1] += 1e-9 * event.duration_ns
    return {name: (int(count), seconds) for name, (count, seconds) in found.items()}


def main() -> None:
    """Profile, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--members", type=int, nargs="+", default=[1, 64])
    parser.add_argument("--rounds", type=int, default=100)
    parser.add_argument("--physics", default="mjx", choices=("mjx", "newton-euler"))
    parser.add_argument("--gpu", action="store_true")
    parser.add_argument("--top", type=int, default=30)
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    config = settings_of(ON_GPU["sac"] if options.gpu else "")
    rows = []
    for members in options.members:
        rows.append(profile(members, config, options.physics, options.rounds))
        say({name: value for name, value in rows[-1].items() if name != "top"})
        for kernel in rows[-1]["top"][: options.top]:
            print(
                f"  {1e6 * kernel['seconds']:8.1f} us {kernel['times']:7.2f} times  {kernel['name'][:110]}", flush=True
            )
    if options.json:
        options.json.write_text(json.dumps({"profiles": rows, "versions": versions()}, indent=1) + "\n")


if __name__ == "__main__":
    main()
