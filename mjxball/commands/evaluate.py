"""Command line of `eval.py`."""

from __future__ import annotations

import argparse
import dataclasses
import json
import shlex
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from mjxball import cli, config
from mjxball.control.followers import BASELINES, LAWS, Follower, make_baseline
from mjxball.errors import InputError
from mjxball.evaluate import families
from mjxball.evaluate.cells import REFERENCE, STANDARD, Cell, check_bounds, cross, load_policy, run_cells
from mjxball.evaluate.judging import judge_families, scores_of, write_judgement
from mjxball.evaluate.paper import command as paper
from mjxball.evaluate.report import to_json, write_report
from mjxball.evaluate.table import table
from mjxball.evaluate.waveform import read_waveform
from mjxball.physics.stepper import ENGINES
from mjxball.policy import Policy, PolicyFileError
from mjxball.policy.shipped import shipped_policies, stand_policies
from mjxball.scenario import Scenario, check_scenario
from mjxball.train.provenance import versions

SCENARIO_FLAGS = (
    "omega",
    "amplitude",
    "mass",
    "believed_mass",
    "goal",
    "seconds",
    "waveform",
    "mass_change",
    "rolling",
)
# What the paper's figures settle themselves.
NOT_WITH_FIGURES = ("families", "seeds", "check", "followers", "json", "wn_pitch", *SCENARIO_FLAGS)


def parser() -> cli.Parser:
    """The argument parser of `eval.py`."""
    result = cli.make_parser(
        "eval.py",
        description="Fly policies and baselines through scenarios on a CPU and print their metrics.",
        epilog="Without policies, followers or scenarios: every shipped policy and baseline on the standard scenarios.",
    )
    names = ", ".join(LAWS)
    result.add_argument("policies", nargs="*", type=Path, metavar="POLICY.npz", help="policy files")
    result.add_argument("--followers", nargs="+", default=[], metavar="NAME", help=f"baselines: {names}")
    result.add_argument("--omega", nargs="+", type=float, metavar="W", help="CG speeds [rad/s] (default 0.31)")
    result.add_argument("--amplitude", nargs="+", type=float, metavar="A", help="CG amplitudes [m] (default 0.05)")
    result.add_argument("--mass", nargs="+", type=float, metavar="M", help="object masses [kg] (default 0.2)")
    result.add_argument("--believed-mass", type=float, metavar="M", help="mass that hover thrust assumes (true mass)")
    result.add_argument("--wn-pitch", type=float, metavar="W", help="pitch natural frequency of both drones [rad/s]")
    result.add_argument("--goal", nargs=3, type=float, metavar=("X", "Y", "Z"), help="goal of O [m] (default 1 1 1)")
    result.add_argument("--seconds", type=float, metavar="S", help="length of each flight (default 45)")
    result.add_argument(
        "--waveform", type=Path, metavar="FILE", help="CG offsets from a CSV file: time [s], offset [m] per line"
    )
    result.add_argument("--rolling", type=float, metavar="X", help="a free ball that starts at X [m] from O")
    result.add_argument(
        "--mass-change",
        nargs="+",
        metavar="T:DM",
        help="DM [kg] added to, or if negative dropped from, the object at T [s]",
    )
    result.add_argument("--physics", choices=ENGINES, default="mjx", help="physics engine (default mjx)")
    result.add_argument("--json", type=Path, metavar="FILE", help="write the cells as JSON")
    result.add_argument("--out", type=Path, metavar="DIR", help="write report.html, JSON and figures")
    result.add_argument("--check", action="store_true", help="exit 1 if a policy misses the bounds in its card")
    result.add_argument("--families", nargs="+", metavar="NAME", help="scenario families, or all; see --list")
    result.add_argument("--seeds", type=int, metavar="N", help="seeds of each level of a family (default 3)")
    result.add_argument("--figures", nargs="+", metavar="NAME", help=f"the paper's: {', '.join(paper.NAMES)}, or all")
    result.add_argument("--force", action="store_true", help="fly policies made for another plant or rate, marked")
    result.add_argument("--list", action="store_true", help="list the scenario families and stop")
    return result


def main(arguments: list[str] | None = None) -> int:
    """Evaluate; return the exit code."""
    options = parser().parse_args(arguments)
    return cli.run_command(lambda: _evaluate(options, sys.argv[1:] if arguments is None else arguments))


def _families(options: argparse.Namespace) -> list[families.Family]:
    if options.families is None:
        if options.seeds is not None:
            raise InputError("--seeds belongs to --families")
        return []
    given = [name for name in SCENARIO_FLAGS if getattr(options, name) is not None]
    if given or options.check:
        flag = "check" if options.check else given[0].replace("_", "-")
        raise InputError(f"--families fly their own scenarios; drop --{flag}")
    if options.seeds is not None and not 1 <= options.seeds <= 1000:
        raise InputError(f"--seeds must be between 1 and 1000, not {options.seeds}")
    return families.find([name for name in options.families if not name.endswith(".npz")])


def _evaluate(options: argparse.Namespace, arguments: Sequence[str]) -> int:
    if options.list:
        print(families.listing())  # noqa: T201
        return 0
    if options.figures is not None:
        return _figures(options, arguments)
    setup = _setup(options)
    chosen = _families(options)
    scenarios = _scenarios(options)
    for scenario in scenarios:
        check_scenario(setup, scenario)
    if options.out:
        cli.output_directory(options.out)
    if options.json:
        cli.output_file(options.json, ".json")
    # `--followers copy mine.npz` reads as it looks: a file name among the followers is a policy.
    listed = [name for name in (*options.followers, *(options.families or [])) if name.endswith(".npz")]
    files = [*options.policies, *map(Path, listed)]
    named = [name for name in options.followers if not name.endswith(".npz")]
    paths = files if files or named else shipped_policies()
    names = named if files or named else list(LAWS if chosen else BASELINES)
    if options.check and not paths:
        raise InputError("--check needs a policy")
    # A pitch frequency that was asked for is an experiment, not a mistake.
    policies = _load(paths, lambda path: setup, options)
    unbounded = [policy.name for policy in policies if options.check and not policy.card["bounds"]]
    if unbounded:
        raise InputError(f"the card of policy {unbounded[0]} has no bounds to check")
    followers: list[Follower] = [*(make_baseline(name, setup) for name in dict.fromkeys(names)), *policies]
    _refuse_same_names([follower.name for follower in followers])

    command = shlex.join(["python", "eval.py", *arguments])
    if chosen:
        seeds = 3 if options.seeds is None else options.seeds
        scores = judge_families(setup, followers, chosen, seeds, options.physics)
        if options.json:
            options.json.write_text(json.dumps({"scores": [score.record() for score in scores]}, indent=1) + "\n")
        if options.out:
            write_judgement(options.out, setup, scores, chosen, policies, command, versions())
            print(f"the report is {options.out / 'report.html'}")  # noqa: T201
        return 0
    cells = run_cells(setup, followers, scenarios, options.physics)
    print(table(cells))  # noqa: T201
    if options.json:
        options.json.write_text(to_json(cells))
    if options.out:
        write_report(cells, options.out)
        scores, shown = scores_of(cells)
        write_judgement(options.out, setup, scores, shown, policies, command, versions())
        print(f"report.html, figures and cells.json are in {options.out}")  # noqa: T201
    return _check(setup, policies, cells, options.physics) if options.check else 0


def _figures(options: argparse.Namespace, arguments: Sequence[str]) -> int:
    """Draw the paper's figures; what was flown is theirs, so that hardly any other flag goes with them."""
    given = [name for name in NOT_WITH_FIGURES if getattr(options, name) not in (None, False, [])]
    if given:
        raise InputError(f"--figures fly the paper's scenarios; drop --{given[0].replace('_', '-')}")
    names = paper.find([name for name in options.figures if not name.endswith(".npz")])
    if options.out is None:
        raise InputError("--figures needs --out DIR, a directory to write to")
    cli.output_directory(options.out)
    listed = [Path(name) for name in options.figures if name.endswith(".npz")]
    paths = [*options.policies, *listed] or [*shipped_policies(), *stand_policies()]
    policies = _load(paths, paper.plant_of, options)
    _refuse_same_names([*LAWS, *(policy.name for policy in policies)])
    figures = paper.draw_figures(names, policies, options.physics)
    paper.write_figures(options.out, figures, policies, shlex.join(["python", "eval.py", *arguments]), versions())
    print(f"the figures are in {options.out / paper.PAGE}")  # noqa: T201
    return 0


def _setup(options: argparse.Namespace) -> config.Config:
    setup = config.preset("paper")
    if options.wn_pitch is not None:
        roll, _, yaw = setup.attitude.natural_frequency
        setup = config.replace(setup, "attitude.natural_frequency", (roll, options.wn_pitch, yaw))
    _refuse_two_motions(options)
    if options.waveform:
        times, offsets = read_waveform(options.waveform)
        setup = dataclasses.replace(setup, motion=config.Motion(kind="waveform", times=times, offsets=offsets))
    if options.rolling is not None:
        setup = dataclasses.replace(setup, motion=config.Motion(kind="rolling"))
    return config.validate(setup)


def _refuse_two_motions(options: argparse.Namespace) -> None:
    """The CG moves in one way: as a waveform, as a rolling ball, or as a sine of some speed and amplitude."""
    ways = {"waveform": "waveform", "rolling": "rolling", "omega": "sine", "amplitude": "sine"}
    given = {name: way for name, way in ways.items() if getattr(options, name) is not None}
    if len(set(given.values())) > 1:
        first, *others = given
        second = next(name for name in others if given[name] != given[first])
        raise InputError(f"--{first} and --{second} exclude each other: the CG moves in one way")


def _scenarios(options: argparse.Namespace) -> Sequence[Scenario]:
    given = any(getattr(options, name) is not None for name in SCENARIO_FLAGS)
    if not (given or options.policies or options.followers):
        return STANDARD
    return cross(
        options.omega or [REFERENCE.omega],
        options.amplitude or [REFERENCE.amplitude],
        options.mass or [REFERENCE.mass],
        believed_mass=options.believed_mass,
        goal=tuple(options.goal or REFERENCE.goal),
        seconds=REFERENCE.seconds if options.seconds is None else options.seconds,
        mass_changes=tuple(map(_mass_change, options.mass_change or [])),
        ball_start=options.rolling or 0.0,
    )


def _mass_change(text: str) -> tuple[float, float]:
    try:
        time, mass = map(float, text.split(":"))
    except ValueError:
        raise InputError(f"--mass-change takes TIME:KG, for example 10:0.2, not {text!r}") from None
    return time, mass


def _load(
    paths: Sequence[Path], setup_of: Callable[[Path], config.Config], options: argparse.Namespace
) -> list[Policy]:
    """The policies, each to fit the configuration of its file.

    Files of one stem are called by their directory too, forced ones carry a mark in their name.
    """
    policies = []
    for path in paths:
        try:
            policies.append(load_policy(path, setup_of(path), compare_laws=options.wn_pitch is None))
        except PolicyFileError:
            raise
        except InputError as error:
            if not options.force:
                raise InputError(f"{error}; --force flies it all the same") from None
            print(f"warning: FORCED: {error}", file=sys.stderr)  # noqa: T201
            policies.append(Policy.load(path))
            policies[-1].name += " (FORCED)"
    stems = [policy.name for policy in policies]
    for policy, path in zip(policies, paths, strict=True):
        if stems.count(policy.name) > 1:
            policy.name = f"{path.absolute().parent.name}/{policy.name}"
    return policies


def _refuse_same_names(names: list[str]) -> None:
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"two followers are called {name!r}; rename a policy file")


def _check(setup: config.Config, policies: Sequence[Policy], cells: Sequence[Cell], physics: str) -> int:
    """Hold every policy against its card on the reference scenario, flown anew if the cells lack it."""
    plain = dataclasses.replace(setup, attitude=config.Attitude(), motion=config.Motion())
    known = {cell.follower: cell for cell in cells if cell.scenario == REFERENCE} if plain == setup else {}
    missing = [policy for policy in policies if policy.name not in known]
    if missing:
        known |= {cell.follower: cell for cell in run_cells(plain, missing, [REFERENCE], physics)}
    failed = False
    for policy in policies:
        misses = check_bounds(policy, known[policy.name].metrics)
        failed = failed or bool(misses)
        print(f"check {policy.name}: {'ok' if not misses else '; '.join(misses)}")  # noqa: T201
    sys.stdout.flush()
    return 1 if failed else 0
