"""draw the paper's figures from flights of our own"""

from __future__ import annotations

import argparse
from pathlib import Path

from mjxball import cli
from mjxball.baselines import CONTROLLERS
from mjxball.commands.followers import add_flight, add_policies, clock, load, refuse_same_names
from mjxball.config import Config, preset
from mjxball.evaluate import paper_figures
from mjxball.evaluate.policies import native_config
from mjxball.evaluate.report import MADE, write_page
from mjxball.evaluate.stand_figure import stand_config
from mjxball.files import write_atomically
from mjxball.plotting import STYLES
from mjxball.policy import Policy
from mjxball.policy.file import shipped_policies
from mjxball.train.run_directory import versions


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `eval.py figures`."""
    add_policies(parser)
    names = paper_figures.NAMES
    about = f"figures to draw: {', '.join(names)} (default all)"
    parser.add_argument("--only", nargs="+", choices=names, default=names, metavar="NAME", help=about)
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="where to write them, and figures.html")
    about = "screen (default), or paper: PDF of a column's width"
    parser.add_argument("--style", choices=STYLES, default="screen", help=about)
    add_flight(parser)


def run(options: argparse.Namespace, command: str) -> int:
    """Fly, draw the figures and write their page; return the exit code."""
    names = [name for name in paper_figures.NAMES if name in options.only]
    cli.output_directory(options.out)
    paths = options.policies or [path for path in shipped_policies() if _setup_of(path)]
    policies = load(paths, lambda path: _setup_of(path) or preset("paper"), options.force)
    refuse_same_names([*CONTROLLERS, *(policy.name for policy in policies)])
    paper_figures.check_figures(names, policies)
    figures, say = [], clock()
    for name in names:
        figures.append(paper_figures.plot_figure(name, policies, options.physics, options.style))
        say(f"figure {name}")
    options.out.mkdir(parents=True, exist_ok=True)
    ending = STYLES[options.style]["savefig.format"]
    for figure in figures:
        write_atomically(options.out / f"figure-{figure.name}.{ending}", figure.picture)
    page = options.out / "figures.html"
    links = [*((figure.name, figure.title) for figure in figures), MADE]
    context = {
        "title": "The paper's figures from our flights",
        "figures": figures,
        "links": links,
        "file_format": ending,
    }
    write_page("figures.html", page, context, policies, command, versions())
    print(f"the figures are in {page}")
    return 0


def _setup_of(path: Path) -> Config | None:
    """Configuration in which the figures fly the policy file `path`; None if they cannot."""
    if paper_figures.on_stand(Policy.load(path)):
        return stand_config()
    return preset("paper") if native_config(path) is None else None
