"""Command line of `train.py`."""

from __future__ import annotations

import argparse
import dataclasses
import math
import shlex
import statistics
import sys
import time
from pathlib import Path
from typing import Any

from mjxball import __version__, cli, config
from mjxball.cache import enable_compilation_cache
from mjxball.errors import InputError
from mjxball.evaluate.cells import REFERENCE, STANDARD
from mjxball.physics.stepper import TRAINING_ENGINES
from mjxball.rollout import Scenario, check_scenario
from mjxball.train.provenance import commit, differences, source_hash, versions

MOST_MEMBERS = 4096


def parser() -> cli.Parser:
    """The argument parser; configuration flags are generated from `mjxball.config`."""
    result = cli.Parser(
        prog="train.py",
        usage="train.py [PRESET] [--seed N] [--seeds K] [--sweep FILE] [--out DIR] [--resume DIR] [--physics ENGINE]\n"
        "                [--<config path> VALUE ...]",
        description="Train a follower with soft actor-critic, export it to NumPy and judge it against `copy`.",
        epilog="Writes DIR/config.json, metrics.csv, checkpoints/, policy.npz and eval/. Ctrl-C saves and stops.",
        allow_abbrev=False,
    )
    names = ", ".join(config.PRESETS)
    result.add_argument("preset", nargs="?", metavar="PRESET", help=f"one of {names} (default transport)")
    result.add_argument("--seed", type=int, metavar="N", help="seed of everything random (default 0)")
    result.add_argument("--seeds", type=int, metavar="K", help="train K followers at once, seeds N, N + 1, ...")
    result.add_argument("--sweep", type=Path, metavar="FILE", help="JSON: settings with K numbers each, one a member")
    result.add_argument("--out", type=Path, metavar="DIR", help="run directory (default runs/PRESET-<time>)")
    result.add_argument("--resume", type=Path, metavar="DIR", help="continue the run in DIR from its newest checkpoint")
    result.add_argument("--physics", choices=TRAINING_ENGINES, help="physics engine (default mjx)")
    result.add_argument("--version", action="version", version=f"mjxball {__version__}")
    cli.add_config_flags(result)
    return result


def main(arguments: list[str] | None = None) -> int:
    """Train, export, evaluate; return the exit code."""
    options = parser().parse_args(arguments)
    command = shlex.join(["python", "train.py", *(sys.argv[1:] if arguments is None else arguments)])
    return cli.run_command(lambda: _train(options, command))


def _train(options: argparse.Namespace, command: str) -> int:
    resume = options.resume is not None
    name, seed = options.preset or "transport", options.seed or 0
    settings = cli.apply_config_flags(config.preset(name), options)
    if not 0 <= seed < 2**31:
        raise InputError(f"--seed must be between 0 and {2**31 - 1}, not {seed}")
    if resume:
        _refuse_with_resume(options)
        out = options.resume
    else:
        out = cli.output_directory(options.out or Path("runs") / f"{name}-{time.strftime('%Y%m%d-%H%M%S')}")

    _scenarios(settings)
    members = 1 if options.seeds is None else options.seeds
    if not 1 <= members <= MOST_MEMBERS:
        raise InputError(f"--seeds must be between 1 and {MOST_MEMBERS}, not {members}")
    enable_compilation_cache()
    sweep = _read_sweep(options.sweep, members, settings)

    from mjxball.train.checkpoint import restore_run
    from mjxball.train.run import POLICY, Run, TrainingDivergedError

    state = None
    origin = {
        "command": command,
        "seed": seed,
        "physics": options.physics or "mjx",
        "seeds": members,
        "sweep": sweep,
        "package_version": __version__,
        "commit": commit(),
        "source_hash": source_hash(),
        "versions": versions(),
    }
    if resume:
        settings, state, origin = restore_run(out)
        changed = differences(origin)
        if changed:
            raise InputError(f"{out} was made by another program and cannot be continued exactly: {'; '.join(changed)}")
    run = Run(settings, out, origin, state)
    started = time.monotonic()
    try:
        finished = run.train()
    except TrainingDivergedError as error:
        print(f"training diverged: {error}; the last good policy and checkpoint are in {out}", file=sys.stderr)  # noqa: T201
        return 1
    print(f"policy: {out / POLICY}  ({time.monotonic() - started:.0f} s)", flush=True)  # noqa: T201
    if not finished:
        return 130
    if origin["seeds"] > 1:
        _compare_members(settings, out, origin)
    return _evaluate(settings, origin["physics"], out, out / POLICY)


def _read_sweep(path: Path | None, members: int, settings: config.Config) -> dict[str, list[float]] | None:
    if path is None:
        return None
    from mjxball.train.population import read_sweep

    return read_sweep(path, members, settings)


def _compare_members(settings: config.Config, out: Path, origin: dict[str, Any]) -> None:
    """Print every member on the reference scenario and their median, and draw them over training."""
    from mjxball.evaluate.cells import load_policy, run_cells
    from mjxball.evaluate.table import table
    from mjxball.train.members import POLICIES, draw_members

    policies = [load_policy(path, settings) for path in sorted((out / POLICIES).glob("*.npz"), key=_seed_of)]
    cells = run_cells(settings, policies, _scenarios(settings)[-1:], origin["physics"])
    print(table(cells))  # noqa: T201
    for name in ("rmse", "settling_time", "x_peak", "overshoot"):
        values = sorted(math.inf if (v := getattr(cell.metrics, name)) is None else v for cell in cells)
        low, middle, high = values[0], statistics.median(values), values[-1]
        print(f"{name}: median {middle:.4g}, best {low:.4g}, worst {high:.4g} of {len(values)}")  # noqa: T201
    (out / "eval").mkdir(exist_ok=True)
    draw_members(out, out / "eval" / "members.png")


def _seed_of(path: Path) -> int:
    return int(path.stem.removeprefix("seed"))


def _refuse_with_resume(options: argparse.Namespace) -> None:
    given = [f"--{name[7:]}" for name, value in vars(options).items() if name.startswith("config:") and value]
    given += [
        f"--{name}" for name in ("out", "seed", "seeds", "sweep", "physics") if getattr(options, name) is not None
    ]
    given += [options.preset] if options.preset else []
    if given:
        raise InputError(f"--resume continues with the run's own configuration; drop {', '.join(given)}")


def _evaluate(settings: config.Config, physics: str, out: Path, policy: Path) -> int:
    """Judge the exported policy against `copy` on its own plant and physics; figures go to DIR/eval."""
    from mjxball.control.followers import make_baseline
    from mjxball.evaluate.cells import check_bounds, load_policy, run_cells
    from mjxball.evaluate.report import write_report
    from mjxball.evaluate.table import table

    scenarios = _scenarios(settings)
    trained = load_policy(policy, settings)
    cells = run_cells(settings, [make_baseline("copy", settings), trained], scenarios, physics)
    print(table(cells))  # noqa: T201
    write_report(cells, out / "eval")
    reference = next(cell for cell in cells if cell.follower == trained.name and cell.scenario == scenarios[-1])
    misses = check_bounds(trained, reference.metrics)
    verdict = "meets the bounds of its card" if not misses else f"misses its bounds: {'; '.join(misses)}"
    print(f"{policy} {verdict}; figures in {out / 'eval'}")  # noqa: T201
    return 0


def _scenarios(settings: config.Config) -> tuple[Scenario, ...]:
    """The standard scenarios as far as the plant allows them, the reference one last; checked before training.

    The object has the plant's mass, the CG stays on the object, a stand's locked axes have goal 0, and the goal
    is drawn in to what training may draw. A waveform or a rolling ball makes one scenario.
    """
    plant = settings.plant
    reach = min(REFERENCE.goal[0], settings.scenario.goal_reach)
    free = {"free": (1, 1, 1), "pivot": (0, 0, 0), "heave": (0, 0, 1)}[plant.stand]
    common = {"mass": plant.object_mass, "goal": tuple(reach * float(axis) for axis in free)}
    reference = dataclasses.replace(
        REFERENCE,
        amplitude=min(REFERENCE.amplitude, config.cg_reach(plant)),
        ball_start=min(settings.scenario.ball_start, config.ball_reach(plant)),
        **common,
    )
    others = [
        dataclasses.replace(reference, omega=s.omega, amplitude=min(s.amplitude, reference.amplitude))
        for s in STANDARD
        if s != REFERENCE and settings.motion.kind == "sine"
    ]
    scenarios = (*others, reference)
    for scenario in scenarios:
        check_scenario(settings, scenario)
    return scenarios
