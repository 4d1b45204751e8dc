"""Return of the policy against seconds since process start: `train.py` with each algorithm, and stock Brax SAC.

`python benchmarks/learning_curves.py [--runs sac ppo gradient stock] [--flags "ppo=--physics newton-euler"]
[--evaluations N] [--json FILE] [--stock FLAG ...]`

Seed 0 of each, one after the other, with an empty cache. Every policy file that a run writes is kept with the second
it was written in, and afterwards flown: in the same 128 episodes of `transport` on the closed form (16 s, scaled to an
episode's 1000 steps), and on the reference scenario, which says whether it is at the bar of `benchmarks/training.py`.
`--stock` passes flags to `benchmarks/stock_sac.py` and must come last.

`python benchmarks/learning_curves.py --draw FILE.json ... --figure FILE.svg` draws what was written, a panel each.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shlex
import shutil
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

from training import BAR, _finite, _steps_of, launch, say, until_policy, versions

RUNS = ("sac", "ppo", "gradient", "stock")
LABELS = {"sac": "SAC", "ppo": "PPO", "gradient": "first-order gradients", "stock": "Brax's own SAC"}
COLOURS = {"sac": "#1b6ca8", "ppo": "#c2571a", "gradient": "#2a8a4a", "stock": "#888888"}


def ours(name: str, options: argparse.Namespace, flags: str, place: Path) -> list[tuple[float, Path]]:
    """(seconds, policy file) of every policy that a run of train.py writes."""
    out, kept, ended = place / name, [], threading.Event()
    policy = out / "policy.npz"

    def watch() -> None:
        seen = 0.0
        while not ended.wait(0.01):
            if policy.exists() and policy.stat().st_mtime != seen:
                seen = policy.stat().st_mtime
                kept.append((seen - started, Path(shutil.copy(policy, place / f"{name}{len(kept)}.npz"))))

    command = ["train.py", "transport", "--algorithm", name, "--seed", "0", "--out", str(out)]
    command += [f"--{name}.num_evaluations", str(options.evaluations), *shlex.split(flags)]
    started, watcher = time.time(), threading.Thread(target=watch)
    watcher.start()
    until_policy(launch(command, place / f"cache-{name}"), started, policy)
    time.sleep(0.1)  # the last one is seen, too
    ended.set()
    watcher.join()
    return kept


def stock(options: argparse.Namespace, place: Path) -> list[tuple[float, Path]]:
    """The same of Brax's `sac.train`."""
    out = place / "stock.npz"
    command = ["benchmarks/stock_sac.py", str(out), "--snapshots", str(options.evaluations), *options.stock]
    started = time.time()
    until_policy(launch(command, place / "cache-stock"), started, out)
    return [(path.stat().st_mtime - started, path) for path in sorted(place.glob("stock-*.npz"), key=_steps_of)]


def judge(found: list[tuple[float, Path]]) -> list[dict[str, Any]]:
    """One row for each policy: seconds, return, metrics of the reference scenario, whether it is at the bar."""
    import jax
    import jax.numpy as jnp

    from mjxball.config import preset
    from mjxball.control.network import Network
    from mjxball.evaluate.policies import load_policy
    from mjxball.evaluate.results import fly_scenarios
    from mjxball.evaluate.scenarios import REFERENCE
    from mjxball.policy.file import load_file
    from mjxball.train.program import Program

    settings = preset("transport")
    program = Program(settings, "newton-euler")
    environments, steps = program.environments, program.evaluation_steps

    @jax.jit
    def reward(weights: Any, biases: Any, mean: Any, scale: Any) -> Any:
        def step(envs: Any, key: Any) -> tuple[Any, None]:
            action = Network(weights, biases, mean, scale)(envs.states.obs)
            return environments.step(envs, action, key)[0], None

        envs = environments.begin(program.evaluation_envs(jax.random.PRNGKey(0)), 1.0)
        envs, _ = jax.lax.scan(step, envs, jax.random.split(jax.random.PRNGKey(1), steps))
        return program.evaluated_return(envs.statistics.reward, envs.statistics.ended)

    rows = []
    policies = [load_policy(path, settings) for _, path in found]
    results = fly_scenarios(settings, policies, [REFERENCE], "newton-euler")
    for (seconds, path), result in zip(found, results, strict=True):
        contents, record = load_file(path), result.record()
        means = [*contents.weights[:-1], contents.weights[-1][:, :3]], [*contents.biases[:-1], contents.biases[-1][:3]]
        arrays = jax.tree.map(jnp.asarray, (*means, contents.observation_mean, contents.observation_scale))
        row = {"seconds": seconds, "steps": contents.card["training_steps"], "return": float(reward(*arrays))}
        row |= {name: math.inf if record[name] is None or record["failed"] else record[name] for name in BAR}
        rows.append(row | {"at_bar": all(row[name] <= bar for name, bar in BAR.items())})
        say(rows[-1])
    return rows


def draw(files: list[Path], figure: Path) -> None:
    """A panel for each of `files`: cost of an episode against seconds, both logarithmic."""
    from mjxball.plotting import pyplot

    plt = pyplot()
    picture, axes = plt.subplots(1, len(files), sharey=True, squeeze=False, layout="constrained")
    picture.set_size_inches(5.6 * len(files), 3.6)
    for axis, file in zip(axes[0], files, strict=True):
        found = json.loads(file.read_text())
        for name, rows in found["curves"].items():
            seconds, cost = [row["seconds"] for row in rows], [-row["return"] for row in rows]
            axis.plot(seconds, cost, color=COLOURS[name], label=LABELS[name])
            reached = [k for k, row in enumerate(rows) if row["at_bar"]]
            axis.plot([seconds[k] for k in reached], [cost[k] for k in reached], "o", color=COLOURS[name], markersize=4)
        axis.set(xscale="log", yscale="log", xlabel="seconds since process start", title=found["versions"]["where"])
        for each, marks in ((axis.xaxis, (5, 10, 20, 30, 50, 100, 200, 400)), (axis.yaxis, (1000, 2000, 4000, 8000))):
            each.set_major_locator(plt.FixedLocator(marks))
            each.set_major_formatter("{x:g}")
            each.set_minor_locator(plt.NullLocator())
        axis.grid(alpha=0.25)
    axes[0][0].set_ylabel("cost of an episode (minus its return)")
    axes[0][-1].plot([], [], "o", color="black", markersize=4, label="at the bar")
    axes[0][-1].legend(fontsize="small")
    picture.savefig(figure)
    plt.close(picture)


def main() -> None:
    """Train, fly, write; or draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", nargs="+", choices=RUNS, default=list(RUNS))
    parser.add_argument("--flags", nargs="*", default=[], metavar="ALGORITHM=FLAGS", help="further flags of train.py")
    parser.add_argument("--evaluations", type=int, default=12, help="policies that a run writes, at least")
    parser.add_argument("--where", default=None, help="what the figure calls this machine")
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--draw", type=Path, nargs="+", metavar="FILE.json")
    parser.add_argument("--figure", type=Path, metavar="FILE")
    parser.add_argument("--stock", nargs=argparse.REMAINDER, default=[], help="flags for stock_sac.py; must come last")
    options = parser.parse_args()
    if options.draw:
        draw(options.draw, options.figure)
        return
    flags = dict.fromkeys(RUNS, "") | dict(one.split("=", 1) for one in options.flags)
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        # Children first: a process that holds a GPU would keep most of its memory from them.
        found = {
            run: stock(options, place) if run == "stock" else ours(run, options, flags[run], place)
            for run in options.runs
        }
        curves = {run: judge(policies) for run, policies in found.items()}
    known = versions() | {"cores": len(os.sched_getaffinity(0)), "load_average": os.getloadavg()[0]}
    known["where"] = options.where or f"{known['device']}, {known['cores']} cores"
    if options.json:
        record = {"bar": BAR, "flags": flags, "stock": options.stock, "curves": curves, "versions": known}
        options.json.write_text(json.dumps(_finite(record), indent=2) + "\n")


if __name__ == "__main__":
    main()
