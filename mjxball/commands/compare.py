"""Comparison after training: the exported policy, and every member of a population, on the standard scenarios."""

from __future__ import annotations

import dataclasses
import math
import statistics
from pathlib import Path
from typing import Any

from mjxball import config
from mjxball.evaluate.scenarios import standard_scenarios
from mjxball.terminal import Working, say
from mjxball.train.run_directory import POLICY


def compare_members(settings: config.Config, out: Path, origin: dict[str, Any]) -> None:
    """Fly every member on the reference scenario; print their metrics, the median and the range.

    The metrics also go into the metadata of the exported policy file, and the learning curves to eval/members.png.
    """
    from mjxball.commands.followers import fly_and_say
    from mjxball.evaluate.policies import load_policy
    from mjxball.evaluate.results import table
    from mjxball.policy.file import load_file, save_file
    from mjxball.train.curves import POLICIES, plot_members

    policies = [load_policy(path, settings) for path in sorted((out / POLICIES).glob("*.npz"), key=_seed_of)]
    reference = standard_scenarios(settings)[0]
    results = fly_and_say(settings, policies, [reference], origin["physics"])
    print(table(results, reference))
    compared = ("rmse", "settling_time", "x_peak", "overshoot")
    exported = load_file(out / POLICY)
    seeds = [int(result.follower.removeprefix("seed")) for result in results]
    spread = {name: [None if c.metrics.failed else getattr(c.metrics, name) for c in results] for name in compared}
    spread["failed"] = [result.metrics.failed for result in results]
    metadata = {**exported.metadata, "population": {"seed": seeds, **spread}}
    save_file(out / POLICY, dataclasses.replace(exported, metadata=metadata))
    for name in compared:
        values = sorted(math.inf if value is None else value for value in spread[name])
        summary = (statistics.median(values), values[0], values[-1])
        missing = "never" if name == "settling_time" else "failed"
        middle, low, high = (missing if math.isinf(value) else f"{value:.4g}" for value in summary)
        print(f"{name}: median {middle}, best {low}, worst {high} of {len(values)}")
    (out / "eval").mkdir(exist_ok=True)
    plot_members(out, out / "eval" / "members.png")


def _seed_of(path: Path) -> int:
    return int(path.stem.removeprefix("seed"))


def is_evaluated(origin: dict[str, Any]) -> bool:
    """Whether the trained policy can be compared with `copy`: only with our own environment."""
    return not (origin.get("extensions") or {}).get("env")


def compile_ahead(settings: config.Config, physics: str) -> None:
    """Import and compile what `compare` needs while the device trains, so that it starts at once on two cores."""
    import jax

    from mjxball.baselines import make_baseline
    from mjxball.plotting import pyplot
    from mjxball.sim.rollout import simulate_batch

    if jax.default_backend() != "cpu":
        return  # training on a GPU is so short that this would only delay its host
    pyplot()
    period = settings.timing.control_period
    scenarios = [dataclasses.replace(one, seconds=period) for one in standard_scenarios(settings)]
    copies = [make_baseline("copy", settings) for _ in range(2)]  # the batch size that `compare` flies
    simulate_batch(settings, [(copy, scenarios) for copy in copies], physics)


def compare(settings: config.Config, physics: str, out: Path, policy: Path) -> int:
    """Compare the exported policy with `copy` on the plant and engine of training; figures go to `out`/eval."""
    from mjxball.baselines import make_baseline
    from mjxball.commands.followers import fly_and_say
    from mjxball.evaluate.plots import write_results
    from mjxball.evaluate.policies import check_bounds, load_policy
    from mjxball.evaluate.results import table

    scenarios = standard_scenarios(settings)
    trained = load_policy(policy, settings)
    results = fly_and_say(settings, [make_baseline("copy", settings), trained], scenarios, physics)
    print(table(results, scenarios[0]))
    with Working("drawing the figures"):
        write_results(results, out / "eval")
    reference = next(
        result for result in results if result.follower == trained.name and result.scenario == scenarios[0]
    )
    misses = check_bounds(trained, reference.metrics)
    verdict = "meets the bounds in its metadata" if not misses else f"misses its bounds: {'; '.join(misses)}"
    say(f"{policy} {verdict}; figures in {out / 'eval'}")
    return 0
