"""`eval.py --figures`: which figures, what they need, and the files that they become."""

from __future__ import annotations

import html
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from mjxball import config as configs
from mjxball.config import Config
from mjxball.errors import InputError
from mjxball.evaluate import page
from mjxball.evaluate.homes import own_home
from mjxball.evaluate.paper import adaptive, experiment, reward, variations
from mjxball.evaluate.paper.figure import LETTERS, Figure
from mjxball.evaluate.paper.stand import stand_config
from mjxball.plotting import pyplot
from mjxball.policy import Policy

PAGE = "figures.html"
NAMES = ("reward", "adaptive", "speeds", "masses", "stand")
FREE = ("adaptive", "speeds", "masses")  # they fly policies freely
TITLE = "The paper's figures beside ours"
INTRODUCTION = """The figures of Barawkar and Chopra, "Reinforcement Learning Driven Cooperative Ball Balance in Rigidly
Coupled Drones", drawn anew from our own simulated flights. What is compared are the paper's words: its curves are not
published as numbers. Every number below is computed from the curves above it."""


def find(names: Sequence[str]) -> list[str]:
    """The figures called `names` in the paper's order, all of them for 'all'; raise InputError for an unknown one."""
    unknown = [name for name in names if name not in (*NAMES, "all")]
    if unknown:
        raise InputError(f"unknown figure {unknown[0]!r}; there are all, {', '.join(NAMES)}")
    if not names:
        raise InputError(f"--figures takes a name: all, {', '.join(NAMES)}")
    return [name for name in NAMES if name in names or "all" in names]


def plant_of(path: Path) -> Config:
    """The configuration that a policy file must fit: the stand's if it was made for one, else the paper's."""
    return stand_config() if _stands(Policy.load(path)) else configs.preset("paper")


def fitting(paths: Sequence[Path]) -> list[Path]:
    """Those of `paths` that the figures can fly: made for the paper's plant or for the stand."""
    return [path for path in paths if own_home(path) is None or _stands(Policy.load(path))]


def _stands(policy: Policy) -> bool:
    return policy.card["plant"].get("stand", "free") != "free"


def draw_figures(names: Sequence[str], policies: Sequence[Policy], physics: str) -> list[Figure]:
    """Fly and draw, saying on stderr how far it is; raise InputError before any flight if a figure lacks a policy."""
    setup = configs.preset("paper")
    standing = [policy for policy in policies if _stands(policy)]
    free = [policy for policy in policies if policy not in standing]
    needy = [name for name in names if name in FREE]
    if needy and not free:
        raise InputError(f"figure {needy[0]} needs a policy made for free flight")
    if "reward" in names and not policies:
        raise InputError("figure reward needs a policy, and none was given or is shipped")
    makers: dict[str, Callable[[], Figure]] = {
        "reward": lambda: reward.draw(free or policies),
        "adaptive": lambda: adaptive.draw(setup, free, physics),
        "speeds": lambda: variations.draw_speeds(setup, free, physics),
        "masses": lambda: variations.draw_masses(setup, free, physics),
        "stand": lambda: experiment.draw(standing, physics),
    }
    started, figures = time.monotonic(), []
    for name in names:
        with pyplot().rc_context(LETTERS):
            figures.append(makers[name]())
        print(f"{time.monotonic() - started:6.1f} s  figure {name}", file=sys.stderr)  # noqa: T201
    return figures


def write_figures(
    out: Path, figures: Sequence[Figure], policies: Sequence[Policy], command: str, versions: Mapping[str, str]
) -> None:
    """Write `figures.html` and a `figure-NAME.svg` for each into the directory `out`, which is made."""
    out.mkdir(parents=True, exist_ok=True)
    for figure in figures:
        (out / f"figure-{figure.name}.svg").write_text(figure.drawing, encoding="utf-8")
    links = "".join(f'<a href="#{figure.name}">{figure.name}</a>' for figure in figures)
    sections = "".join(figure.markup() for figure in figures)
    made = page.made(command, versions, {policy.name: policy.card for policy in policies})
    body = (
        f"<h1>{html.escape(TITLE)}</h1><p>{html.escape(INTRODUCTION)}</p>"
        f'<nav>{links}<a href="#made">how it was made</a></nav>{sections}{made}'
    )
    (out / PAGE).write_text(page.document(TITLE, body), encoding="utf-8")
