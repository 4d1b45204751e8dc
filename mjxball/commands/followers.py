"""Followers that a command line names: policies, baselines and the user's own, loaded to fit a plant."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from mjxball.baselines import LAWS
from mjxball.config import Config
from mjxball.control.followers import Follower
from mjxball.errors import InputError
from mjxball.evaluate.followers import Make, find_follower
from mjxball.evaluate.policies import load_policy
from mjxball.physics.step import ENGINES
from mjxball.policy import Policy
from mjxball.policy.file import policy_path, shipped_policies
from mjxball.terminal import Status, warn


def add_policies(parser: argparse.ArgumentParser) -> None:
    """The positional arguments of a command that flies policies."""
    about = "policy files, or names of shipped ones"
    parser.add_argument("policies", nargs="*", type=policy_path, metavar="POLICY.npz", help=about)


def add_followers(parser: argparse.ArgumentParser) -> None:
    """The flag of a command that flies other followers as well."""
    about = f"baselines: {', '.join(LAWS)}; or module:Class, your own"
    parser.add_argument("--followers", nargs="+", default=[], metavar="NAME", help=about)


def add_flight(parser: argparse.ArgumentParser) -> None:
    """The flags of a command that flies on an engine of choice."""
    parser.add_argument("--physics", choices=ENGINES, default="mjx", help="physics engine (default mjx)")
    parser.add_argument("--force", action="store_true", help="fly policies made for another plant or rate, marked")


@dataclass(frozen=True)
class Named:
    """Followers that were asked for: `names` of baselines and classes, `paths` of policies; all of both if none was."""

    names: list[str]
    paths: list[Path]
    asked: bool

    def made(self, config: Config, every: Sequence[str]) -> list[Follower]:
        """Those that are no policies, for the plant of `config`; `every` one of these names if none was asked for."""
        return [_maker(name)(config) for name in dict.fromkeys(self.names if self.asked else every)]


def named(options: argparse.Namespace) -> Named:
    """Raises InputError for a follower that there is not."""
    # `--followers copy mine.npz` reads as it looks: a file name among the followers is a policy.
    files = [*options.policies, *(Path(name) for name in options.followers if name.endswith(".npz"))]
    names = [name for name in options.followers if not name.endswith(".npz")]
    for name in names:
        _maker(name)
    asked = bool(files or names)
    return Named(names, files if asked else shipped_policies(), asked)


def _maker(name: str) -> Make:
    return find_follower(name, "--followers")[1]


def load(
    paths: Sequence[Path],
    setup_of: Callable[[Path], Config],
    force: bool,
    compare_laws: bool = True,
    seconds: float = 0.0,
) -> list[Policy]:
    """The policies, each to fit the configuration of its file, for flights of up to `seconds` [s].

    Files of one stem are called by their directory too, forced ones carry a mark in their name.
    """
    policies = []
    for path in paths:
        setup, policy = setup_of(path), Policy.load(path)
        policy.join(setup.plant)
        try:
            policy = load_policy(path, setup, compare_laws, seconds)
        except InputError as error:
            if not force:
                raise InputError(f"{error}; --force flies it all the same") from None
            warn(f"warning: FORCED: {error}")
            policy.name += " (FORCED)"
        policies.append(policy)
    stems = [policy.name for policy in policies]
    for policy, path in zip(policies, paths, strict=True):
        if stems.count(policy.name) > 1:
            policy.name = f"{path.absolute().parent.name}/{policy.name}"
    return policies


def refuse_same_names(names: list[str]) -> None:
    """Raise InputError if two followers would be one row of a table."""
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"two followers are called {name!r}; rename a policy file")


def clock() -> Callable[[str], None]:
    """What says on stderr how far a command is, and after how long."""
    started, status = time.monotonic(), Status()
    return lambda text: status.say(f"{time.monotonic() - started:6.1f} s  {text}")
