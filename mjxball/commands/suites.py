"""fly suites of scenarios, over seeds, and compare"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from mjxball import cli
from mjxball.baselines import SUITE_BASELINES
from mjxball.bench.report import write_report
from mjxball.bench.scores import fly_suites, text_table
from mjxball.bench.suites import BY_NAME, list_suites
from mjxball.commands.followers import add_flight, add_followers, add_policies, clock, load, named, refuse_same_names
from mjxball.config import preset
from mjxball.errors import InputError
from mjxball.evaluate.policies import group_by_plant
from mjxball.files import write_atomically
from mjxball.train.run_directory import versions


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `eval.py suites`."""
    add_policies(parser)
    add_followers(parser)
    about = "suites to fly (default all), see --list"
    parser.add_argument("--only", nargs="+", choices=BY_NAME, default=list(BY_NAME), metavar="NAME", help=about)
    parser.add_argument("--num-seeds", type=int, default=3, metavar="N", help="of each variant of a suite (default 3)")
    add_flight(parser)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the scores as JSON")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write report.html and scores.json")
    parser.add_argument("--list", action="store_true", help="list the suites with their variants and stop")


def run(options: argparse.Namespace, command: str) -> int:
    """Fly the suites and print scores, with progress on stderr; return the exit code."""
    if options.list:
        print(list_suites())
        return 0
    if not 1 <= options.num_seeds <= 1000:
        raise InputError(f"--num-seeds must be between 1 and 1000, not {options.num_seeds}")
    if options.out:
        cli.output_directory(options.out)
    if options.json:
        cli.output_file(options.json, ".json")
    setup, suites, selected = preset("paper"), [BY_NAME[name] for name in dict.fromkeys(options.only)], named(options)
    paths, others = (selected.paths, []) if options.force else group_by_plant(selected.paths)
    if others and selected.asked:
        raise InputError(f"suites fly the paper's plant, and {others[0][1][0]} was made for another")
    longest = max(variant.scenario.seconds for suite in suites for variant in suite.variants)
    policies = load(paths, lambda path: setup, options.force, seconds=longest)
    followers = [*selected.made(setup, SUITE_BASELINES), *policies]
    refuse_same_names([follower.name for follower in followers])
    scores = fly_suites(setup, followers, suites, options.num_seeds, options.physics, clock())
    print(text_table(scores, suites))
    if options.json:
        write_atomically(options.json, json.dumps({"scores": [score.record() for score in scores]}, indent=1) + "\n")
    if options.out:
        write_report(options.out, setup.plant, scores, suites, policies, command, versions())
        print(f"the report is {options.out / 'report.html'}")
    return 0
