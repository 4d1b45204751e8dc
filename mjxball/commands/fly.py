"""fly policies and baselines through scenarios and print their metrics"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from mjxball import cli, config
from mjxball.baselines import BASELINES
from mjxball.commands.followers import (
    Named,
    add_flight,
    add_followers,
    add_policies,
    fly_and_say,
    load,
    named,
    refuse_same_names,
)
from mjxball.commands.scenarios import native_scenarios, scenarios_of, setup_of
from mjxball.errors import InputError
from mjxball.evaluate.plots import write_results
from mjxball.evaluate.policies import check_bounds, group_by_plant
from mjxball.evaluate.report import write_report
from mjxball.evaluate.results import Result, table, to_json
from mjxball.evaluate.scenarios import rig_summary, standard_scenarios
from mjxball.files import write_atomically
from mjxball.plotting import STYLES
from mjxball.policy import Policy
from mjxball.sim.scenario import Scenario
from mjxball.terminal import Working
from mjxball.train.run_directory import versions


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `eval.py fly`."""
    add_policies(parser)
    add_flags(parser)


def add_flags(parser: argparse.ArgumentParser) -> None:
    """Add the flags of `eval.py fly`, which `eval.py` lists too."""
    add_followers(parser)
    parser.add_argument("--omega", nargs="+", type=float, metavar="W", help="CG speeds [rad/s] (default 0.31)")
    parser.add_argument(
        "--amplitude",
        nargs="+",
        type=float,
        metavar="A",
        help="CG amplitudes [m] (default 0.05, or what the plant allows)",
    )
    parser.add_argument(
        "--mass", nargs="+", type=float, metavar="M", help="object masses [kg] (default the plant's, 0.2)"
    )
    parser.add_argument("--believed-mass", type=float, metavar="M", help="mass that hover thrust assumes (true mass)")
    parser.add_argument("--wn-pitch", type=float, metavar="W", help="pitch natural frequency of both drones [rad/s]")
    parser.add_argument(
        "--goal",
        nargs=3,
        type=float,
        metavar=("X", "Y", "Z"),
        help="goal of O [m] (default 1 1 1, on a stand where it moves)",
    )
    parser.add_argument("--seconds", type=float, metavar="S", help="length of each flight (default 45)")
    parser.add_argument(
        "--waveform", type=Path, metavar="FILE", help="CG offsets from a CSV file: time [s], offset [m] per line"
    )
    parser.add_argument("--rolling", type=float, metavar="X", help="a free ball that starts at X [m] from O")
    parser.add_argument(
        "--mass-change",
        nargs="+",
        metavar="T:DM",
        help="DM [kg] added to, or if negative dropped from, the object at T [s]",
    )
    parser.add_argument(
        "--plant", type=Path, metavar="NAME|FILE", help="shipped plant, file of a rig, or a model of a drone"
    )
    add_flight(parser)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the results as JSON")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write report.html, JSON and figures")
    parser.add_argument("--check", action="store_true", help="exit 1 if a policy misses the bounds in its metadata")
    about = "of the figures: screen (default), or paper: PDF of a column's width"
    parser.add_argument("--style", choices=STYLES, default="screen", help=about)


@dataclass(frozen=True)
class Group:
    """Followers that fly the same plant and scenarios."""

    setup: config.Config
    scenarios: Sequence[Scenario]
    followers: Named

    def policies(self, options: argparse.Namespace) -> list[Policy]:
        """The policies, loaded for the plant. Raises InputError if `--check` is given and one has no bounds."""
        # --wn-pitch changes the attitude loops on purpose, so they may differ from the policy's.
        longest, compare_controllers = max(scenario.seconds for scenario in self.scenarios), options.wn_pitch is None
        policies = load(self.followers.paths, lambda path: self.setup, options.force, compare_controllers, longest)
        unbounded = [policy.name for policy in policies if options.check and not policy.metadata["bounds"]]
        if unbounded:
            raise InputError(f"the metadata of policy {unbounded[0]} has no bounds to check")
        return policies


def run(options: argparse.Namespace, command: str) -> int:
    """Fly the scenarios of every plant; return the exit code.

    The report of each plant after the first goes to a subdirectory of `--out`.
    """
    if options.style != "screen" and options.out is None:
        raise InputError("--style belongs to figures, and needs --out DIR")
    setup = setup_of(options)
    scenarios = scenarios_of(options, setup)
    if options.out:
        cli.output_directory(options.out)
    if options.json:
        cli.output_file(options.json, ".json")
    groups = _groups(options, setup, scenarios)
    loaded = [(group, group.followers.made(group.setup, BASELINES), group.policies(options)) for group in groups]
    for _, baselines, policies in loaded:
        refuse_same_names([*(follower.name for follower in baselines), *(policy.name for policy in policies)])
    written: list[Result] = []
    code = 0
    for number, (group, baselines, policies) in enumerate(loaded):
        results = fly_and_say(group.setup, [*baselines, *policies], group.scenarios, options.physics)
        if number:
            print(f"\n{group.setup.preset}: its own plant and scenarios")
        if options.plant or group.setup.plant != config.Plant():
            print(rig_summary(group.setup, max(scenario.mass for scenario in group.scenarios)))
        print(table(results, standard_scenarios(group.setup)[0]))
        if not number or groups[0].followers.asked:  # without arguments the JSON holds the paper's plant alone
            written += results
        if options.out:
            place = options.out / group.setup.preset if number else options.out
            with Working("drawing the figures and the report"):
                write_results(results, place, options.style)
                write_report(place, group.setup.plant, results, policies, command, versions())
            print(f"report.html, figures and cells.json are in {place}")
        if options.check:
            code = max(code, _check(group.setup, policies, results, options.physics))
    if options.json:
        write_atomically(options.json, to_json(written))
    return code


def _groups(options: argparse.Namespace, setup: config.Config, scenarios: Sequence[Scenario]) -> list[Group]:
    """Followers by plant: those that fly `setup`, then policies that were made for other plants, with baselines."""
    selected = named(options)
    if options.check and not selected.paths:
        raise InputError("--check needs a policy")
    here, others = (selected.paths, []) if options.force or options.plant else group_by_plant(selected.paths)
    # If all policies are for other plants, the baselines fly those alone, and no follower flies `setup`.
    groups = [] if others and not here else [Group(setup, scenarios, Named(selected.names, here, selected.asked))]
    for native, files in others:
        groups.append(Group(native, native_scenarios(options, native), Named(selected.names or ["copy"], files, True)))
    return groups


def _check(setup: config.Config, policies: Sequence[Policy], results: Sequence[Result], physics: str) -> int:
    """Compare every policy with its bounds on the reference scenario; return the exit code, 1 if one misses them.

    On the paper's plant the reference has the default attitude loops and CG motion. A result that is missing is flown.
    """
    other_plant = setup.autopilot.kind != "ideal" or setup.plant != config.Plant()
    plain = setup if other_plant else dataclasses.replace(setup, attitude=config.Attitude(), motion=config.Motion())
    reference = standard_scenarios(plain)[0]
    known = {result.follower: result for result in results if result.scenario == reference} if plain == setup else {}
    missing = [policy for policy in policies if policy.name not in known]
    if missing:
        known |= {result.follower: result for result in fly_and_say(plain, missing, [reference], physics)}
    failed = False
    for policy in policies:
        misses = check_bounds(policy, known[policy.name].metrics)
        failed = failed or bool(misses)
        print(f"check {policy.name}: {'ok' if not misses else '; '.join(misses)}")
    sys.stdout.flush()
    return 1 if failed else 0
