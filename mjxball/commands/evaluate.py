"""Command line of `eval.py`."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import json
import shlex
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from mjxball import cli, config
from mjxball.baselines import BASELINES, LAWS, SUITE_BASELINES
from mjxball.bench.tracks import TRACKS
from mjxball.commands.scenarios import SCENARIO_FLAGS, native_scenarios, scenarios_of, setup_of
from mjxball.control.followers import Follower
from mjxball.errors import InputError
from mjxball.evaluate import paper_figures
from mjxball.evaluate.benchmark import run_benchmark, scores_of, text_table
from mjxball.evaluate.followers import Make, find_follower
from mjxball.evaluate.plots import write_results
from mjxball.evaluate.policies import check_bounds, group_by_plant, load_policy, native_config
from mjxball.evaluate.report import MADE, write_page, write_report
from mjxball.evaluate.results import Result, fly_scenarios, table, to_json
from mjxball.evaluate.scenarios import rig_line, standard_scenarios
from mjxball.evaluate.stand_figure import stand_config
from mjxball.evaluate.suites import find_suites, list_suites
from mjxball.evaluate.variants import Suite
from mjxball.files import write_whole
from mjxball.physics.step import ENGINES
from mjxball.plotting import STYLES
from mjxball.policy import Policy
from mjxball.policy.file import policy_path, shipped_policies
from mjxball.sim.scenario import Scenario
from mjxball.terminal import Status, warn
from mjxball.train.run_directory import commit, versions

# What `--figures` fixes itself.
NOT_WITH_FIGURES = ("suite", "num_seeds", "check", "followers", "json", "wn_pitch", "plant", *SCENARIO_FLAGS)


def parser() -> cli.Parser:
    """The argument parser of `eval.py`."""
    result = cli.make_parser(
        "eval.py",
        description="Fly policies and baselines through scenarios on a CPU and print their metrics.",
        epilog="Without policies, followers or scenarios: every shipped policy and baseline on the standard scenarios.",
    )
    names = ", ".join(LAWS)
    about = "policy files, or names of shipped ones"
    result.add_argument("policies", nargs="*", type=policy_path, metavar="POLICY.npz", help=about)
    result.add_argument(
        "--followers", nargs="+", default=[], metavar="NAME", help=f"baselines: {names}; or module:Class, your own"
    )
    result.add_argument("--omega", nargs="+", type=float, metavar="W", help="CG speeds [rad/s] (default 0.31)")
    result.add_argument(
        "--amplitude",
        nargs="+",
        type=float,
        metavar="A",
        help="CG amplitudes [m] (default 0.05, or what the plant allows)",
    )
    result.add_argument(
        "--mass", nargs="+", type=float, metavar="M", help="object masses [kg] (default the plant's, 0.2)"
    )
    result.add_argument("--believed-mass", type=float, metavar="M", help="mass that hover thrust assumes (true mass)")
    result.add_argument("--wn-pitch", type=float, metavar="W", help="pitch natural frequency of both drones [rad/s]")
    result.add_argument(
        "--goal",
        nargs=3,
        type=float,
        metavar=("X", "Y", "Z"),
        help="goal of O [m] (default 1 1 1, on a stand where it moves)",
    )
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
    result.add_argument(
        "--plant", type=Path, metavar="NAME|FILE", help="shipped plant, file of a rig, or a model of a drone"
    )
    result.add_argument("--physics", choices=ENGINES, default="mjx", help="physics engine (default mjx)")
    result.add_argument("--json", type=Path, metavar="FILE", help="write the results as JSON")
    result.add_argument("--out", type=Path, metavar="DIR", help="write report.html, JSON and figures")
    result.add_argument("--check", action="store_true", help="exit 1 if a policy misses the bounds in its card")
    result.add_argument("--suite", "--families", nargs="+", metavar="NAME", help="benchmark suites, or all; see --list")
    result.add_argument("--num-seeds", "--seeds", type=int, metavar="N", help="of each variant of a suite (default 3)")
    figures = ", ".join(paper_figures.NAMES)
    result.add_argument("--figures", nargs="+", metavar="NAME", help=f"the paper's: {figures}, or all")
    about = "of figures: screen (default), or paper: PDF of a column's width"
    result.add_argument("--style", choices=STYLES, default="screen", help=about)
    result.add_argument("--force", action="store_true", help="fly policies made for another plant or rate, marked")
    result.add_argument("--list", action="store_true", help="list the benchmark suites and stop")
    result.add_argument(
        "--benchmark",
        metavar="FOLLOWER",
        help="fly mjxball-bench, write the entry to --out FILE.json: a policy, MODEL.onnx, module:Class, or a name",
    )
    result.add_argument(
        "--tracks", nargs="+", metavar="NAME", help=f"of --benchmark: {', '.join(TRACKS)} (default all)"
    )
    result.add_argument(
        "--draw", type=int, metavar="N", help="other flights of --benchmark (default 0, the published ones)"
    )
    return result


def main(arguments: list[str] | None = None) -> int:
    """Evaluate; return the exit code."""
    options = parser().parse_args(arguments)
    given = sys.argv[1:] if arguments is None else arguments

    def run() -> int:
        if options.style != "screen" and (options.out is None or options.suite or options.benchmark):
            raise InputError("--style belongs to figures of --figures or a comparison, and needs --out DIR")
        return _evaluate(options, given)

    return cli.run_command(run)


def _suites(options: argparse.Namespace) -> list[Suite]:
    if options.suite is None:
        if options.num_seeds is not None:
            raise InputError("--num-seeds belongs to --suite")
        return []
    given = [name for name in SCENARIO_FLAGS if getattr(options, name) is not None]
    given += ["plant"] if options.plant else []
    if given or options.check:
        flag = "check" if options.check else given[0].replace("_", "-")
        raise InputError(f"--suite flies scenarios of its own; drop --{flag}")
    if options.num_seeds is not None and not 1 <= options.num_seeds <= 1000:
        raise InputError(f"--num-seeds must be between 1 and 1000, not {options.num_seeds}")
    return find_suites([name for name in options.suite if not name.endswith(".npz")])


def _evaluate(options: argparse.Namespace, arguments: Sequence[str]) -> int:
    if options.list:
        print(list_suites())  # noqa: T201
        return 0
    if options.benchmark is not None:
        return _entry(options, arguments)
    if options.tracks or options.draw is not None:
        raise InputError("--tracks and --draw belong to --benchmark")
    if options.figures is not None:
        return _figures(options, arguments)
    setup = setup_of(options)
    chosen = _suites(options)
    scenarios = scenarios_of(options, setup)
    if options.out:
        cli.output_directory(options.out)
    if options.json:
        cli.output_file(options.json, ".json")
    # `--followers copy mine.npz` reads as it looks: a file name among the followers is a policy.
    listed = [name for name in (*options.followers, *(options.suite or [])) if name.endswith(".npz")]
    files = [*options.policies, *map(Path, listed)]
    named = [name for name in options.followers if not name.endswith(".npz")]
    for name in named:
        _maker(name)  # refused at once where there is none
    asked = bool(files or named)
    paths = files if asked else shipped_policies()
    if options.check and not paths:
        raise InputError("--check needs a policy")
    here, others = (paths, []) if options.force or options.plant else group_by_plant(paths)
    team = [path for _, files in others for path in files]
    if chosen and others:
        if asked and not any(variant.team for suite in chosen for variant in suite.variants):
            raise InputError(f"--suite flies the paper's plant, and {others[0][1][0]} was made for another")
        others = []
    # Only policies for other plants: then the baselines beside them fly theirs, and nothing the paper's.
    groups = [] if others and not here else [Group(setup, scenarios, named, here, asked)]
    groups += [Group(own, native_scenarios(options, own), named or ["copy"], files, True) for own, files in others]
    command = shlex.join(["python", "eval.py", *arguments])
    if chosen:
        return _benchmark(groups[0], chosen, options, command, team)
    return _compare(groups, options, command)


def _entry(options: argparse.Namespace, arguments: Sequence[str]) -> int:
    """Fly mjxball-bench and write the entry; its flights are its own, so that hardly any other flag goes with them."""
    given = [name for name in ("figures", *NOT_WITH_FIGURES) if getattr(options, name) not in (None, False, [])]
    if options.policies or given:
        what = "the policies" if options.policies else f"--{given[0].replace('_', '-')}"
        raise InputError(f"--benchmark flies one follower on flights of its own; drop {what}")
    if options.out is None or options.out.suffix != ".json":
        raise InputError("--benchmark needs --out FILE.json, where the entry is written")
    cli.output_file(options.out, ".json")
    from mjxball.bench.entry import run as run_entry
    from mjxball.bench.entry import table as table_of
    from mjxball.bench.followers import entrant

    name, make = entrant(options.benchmark)
    found = run_entry(name, make, options.tracks or (), options.draw or 0, _clock())
    known = {"command": shlex.join(["python", "eval.py", *arguments]), "commit": commit(), "versions": versions()}
    write_whole(options.out, json.dumps({**found, **known}, indent=1, allow_nan=False) + "\n")
    print(f"{table_of(found)}\nthe entry is {options.out}")  # noqa: T201
    return 0


def _clock() -> Callable[[str], None]:
    """What says on stderr how far it is, and after how long."""
    started, status = time.monotonic(), Status()
    return lambda text: status.say(f"{time.monotonic() - started:6.1f} s  {text}")


@dataclasses.dataclass(frozen=True)
class Group:
    """Followers that fly the same plant."""

    setup: config.Config
    scenarios: Sequence[Scenario]
    named: list[str]  # baselines, and followers of the user's own
    paths: list[Path]  # policies
    asked: bool  # false: every baseline

    def policies(self, options: argparse.Namespace) -> list[Policy]:
        """The policies, loaded to fit the plant; raise InputError for bounds that are wanted and missing."""
        # A pitch frequency that was asked for is an experiment, not a mistake.
        longest = max(scenario.seconds for scenario in self.scenarios)
        found = _load(self.paths, lambda path: self.setup, options, longest)
        unbounded = [policy.name for policy in found if options.check and not policy.card["bounds"]]
        if unbounded:
            raise InputError(f"the card of policy {unbounded[0]} has no bounds to check")
        return found

    def baselines(self, every: Sequence[str]) -> list[Follower]:
        """Those that are no policies, `every` baseline if none was asked for."""
        return [_maker(name)(self.setup) for name in dict.fromkeys(self.named if self.asked else every)]


def _maker(name: str) -> Make:
    return find_follower(name, "--followers")[1]


def _benchmark(
    group: Group, suites: list[Suite], options: argparse.Namespace, command: str, team: Sequence[Path]
) -> int:
    """Fly benchmark suites, with progress on stderr; `team`: policies for teams."""
    policies = group.policies(options)
    one_plant = any(not variant.team for suite in suites for variant in suite.variants)
    baselines = group.baselines(SUITE_BASELINES) if one_plant else []
    followers: list[Follower] = [*baselines, *policies]
    _refuse_same_names([*(follower.name for follower in followers), *(path.stem for path in team)])
    num_seeds = options.num_seeds or 3

    def team_followers(known: config.Config) -> list[Follower]:
        """Whoever flies this team: baselines, and policies that were made for such."""
        found: list[Follower] = []
        for name in dict.fromkeys(group.named if group.asked else [*SUITE_BASELINES, "lqg-known-failures"]):
            with contextlib.suppress(InputError):
                found.append(_maker(name)(known))
        for path in (*group.paths, *team):
            with contextlib.suppress(InputError):
                found.append(load_policy(path, known))
        return found

    scores = run_benchmark(group.setup, followers, suites, num_seeds, options.physics, _clock(), team_followers)
    if not scores:
        raise InputError("none of these followers flies the teams of these suites")
    plant = suites[0].variants[0].nominal(group.setup).plant
    print(text_table(scores, suites))  # noqa: T201
    if options.json:
        write_whole(options.json, json.dumps({"scores": [score.record() for score in scores]}, indent=1) + "\n")
    if options.out:
        write_report(options.out, plant, scores, suites, policies, command, versions())
        print(f"the report is {options.out / 'report.html'}")  # noqa: T201
    return 0


def _compare(groups: Sequence[Group], options: argparse.Namespace, command: str) -> int:
    """Fly every group's scenarios; the report of a plant other than the first one's has a directory of its own."""
    loaded = [(group, group.baselines(list(BASELINES)), group.policies(options)) for group in groups]
    for _, baselines, policies in loaded:
        _refuse_same_names([*(follower.name for follower in baselines), *(policy.name for policy in policies)])
    every: list[Result] = []
    code = 0
    for number, (group, baselines, policies) in enumerate(loaded):
        results = fly_scenarios(group.setup, [*baselines, *policies], group.scenarios, options.physics)
        if number:
            print(f"\n{group.setup.preset}: its own plant and scenarios")  # noqa: T201
        if options.plant or group.setup.plant != config.Plant():
            print(rig_line(group.setup, max(scenario.mass for scenario in group.scenarios)))  # noqa: T201
        print(table(results, standard_scenarios(group.setup)[0]))  # noqa: T201
        if not number or groups[0].asked:  # without arguments the JSON is about the paper's plant alone
            every += results
        if options.out:
            place = options.out / group.setup.preset if number else options.out
            write_results(results, place, options.style)
            scores, suites = scores_of(results)
            write_report(place, group.setup.plant, scores, suites, policies, command, versions())
            print(f"report.html, figures and cells.json are in {place}")  # noqa: T201
        if options.check:
            code = max(code, _check(group.setup, policies, results, options.physics))
    if options.json:
        write_whole(options.json, to_json(every))
    return code


def _figures(options: argparse.Namespace, arguments: Sequence[str]) -> int:
    """Draw the paper's figures; what was flown is theirs, so that hardly any other flag goes with them."""
    given = [name for name in NOT_WITH_FIGURES if getattr(options, name) not in (None, False, [])]
    if given:
        raise InputError(f"--figures fly the paper's scenarios; drop --{given[0].replace('_', '-')}")
    names = paper_figures.find_figures([name for name in options.figures if not name.endswith(".npz")])
    if options.out is None:
        raise InputError("--figures needs --out DIR, a directory to write to")
    cli.output_directory(options.out)
    listed = [Path(name) for name in options.figures if name.endswith(".npz")]
    paths = [*options.policies, *listed] or [path for path in shipped_policies() if _figure_config(path)]
    policies = _load(paths, lambda path: _figure_config(path) or config.preset("paper"), options)
    _refuse_same_names([*LAWS, *(policy.name for policy in policies)])
    paper_figures.check_figures(names, policies)
    figures, say = [], _clock()
    for name in names:
        figures.append(paper_figures.draw_figure(name, policies, options.physics, options.style))
        say(f"figure {name}")
    options.out.mkdir(parents=True, exist_ok=True)
    ending = STYLES[options.style]["savefig.format"]
    for figure in figures:
        write_whole(options.out / f"figure-{figure.name}.{ending}", figure.picture)
    page = options.out / "figures.html"
    links = [*((figure.name, figure.title) for figure in figures), MADE]
    context = {
        "title": "The paper's figures from our flights",
        "figures": figures,
        "links": links,
        "file_format": ending,
    }
    command = shlex.join(["python", "eval.py", *arguments])
    write_page("figures.html", page, context, policies, command, versions())
    print(f"the figures are in {page}")  # noqa: T201
    return 0


def _figure_config(path: Path) -> config.Config | None:
    """The configuration that the policy file `path` flies with in the figures, None if it fits none."""
    if paper_figures.on_stand(Policy.load(path)):
        return stand_config()
    return config.preset("paper") if native_config(path) is None else None


def _load(
    paths: Sequence[Path], setup_of: Callable[[Path], config.Config], options: argparse.Namespace, seconds: float = 0.0
) -> list[Policy]:
    """The policies, each to fit the configuration of its file, for flights of up to `seconds` [s].

    Files of one stem are called by their directory too, forced ones carry a mark in their name.
    """
    policies = []
    for path in paths:
        setup, policy = setup_of(path), Policy.load(path)
        policy.join(setup.plant)
        try:
            policy = load_policy(path, setup, compare_laws=options.wn_pitch is None, seconds=seconds)
        except InputError as error:
            if not options.force:
                raise InputError(f"{error}; --force flies it all the same") from None
            warn(f"warning: FORCED: {error}")
            policy.name += " (FORCED)"
        policies.append(policy)
    stems = [policy.name for policy in policies]
    for policy, path in zip(policies, paths, strict=True):
        if stems.count(policy.name) > 1:
            policy.name = f"{path.absolute().parent.name}/{policy.name}"
    return policies


def _refuse_same_names(names: list[str]) -> None:
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"two followers are called {name!r}; rename a policy file")


def _check(setup: config.Config, policies: Sequence[Policy], results: Sequence[Result], physics: str) -> int:
    """Hold every policy against its card on the reference scenario, flown anew if the results lack it."""
    own = setup.autopilot.kind != "ideal" or setup.plant != config.Plant()
    plain = setup if own else dataclasses.replace(setup, attitude=config.Attitude(), motion=config.Motion())
    reference = standard_scenarios(plain)[0]
    known = {result.follower: result for result in results if result.scenario == reference} if plain == setup else {}
    missing = [policy for policy in policies if policy.name not in known]
    if missing:
        known |= {result.follower: result for result in fly_scenarios(plain, missing, [reference], physics)}
    failed = False
    for policy in policies:
        misses = check_bounds(policy, known[policy.name].metrics)
        failed = failed or bool(misses)
        print(f"check {policy.name}: {'ok' if not misses else '; '.join(misses)}")  # noqa: T201
    sys.stdout.flush()
    return 1 if failed else 0
