"""Followers named on a command line: policies, baselines and the user's classes, loaded for a plant."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from mjxball.baselines import CONTROLLERS
from mjxball.config import Config
from mjxball.control.followers import Follower
from mjxball.errors import InputError
from mjxball.evaluate.followers import FollowerFactory, follower_factory
from mjxball.evaluate.policies import load_policy
from mjxball.evaluate.results import Result, fly_scenarios
from mjxball.physics.step import ENGINES
from mjxball.policy import Policy
from mjxball.policy.file import policy_path, shipped_policies
from mjxball.sim.scenario import Scenario
from mjxball.terminal import Status, Working, warn


def add_policies(parser: argparse.ArgumentParser) -> None:
    """Add the positional arguments of a command that flies policies."""
    about = "policy files, or names of shipped ones"
    parser.add_argument("policies", nargs="*", type=policy_path, metavar="POLICY.npz", help=about)


def add_followers(parser: argparse.ArgumentParser) -> None:
    """Add the flag of a command that flies other followers too."""
    about = f"baselines: {', '.join(CONTROLLERS)}; module:Class, your own; policies. The flag may be left out"
    parser.add_argument("--followers", nargs="+", default=[], metavar="NAME", help=about)


def add_flight(parser: argparse.ArgumentParser) -> None:
    """Add the flags that select the physics engine and allow policies of other plants."""
    parser.add_argument("--physics", choices=ENGINES, default="mjx", help="physics engine (default mjx)")
    parser.add_argument("--force", action="store_true", help="fly policies made for another plant or rate, marked")


@dataclass(frozen=True)
class Named:
    """Followers named on the command line."""

    names: list[str]  # of baselines and classes
    paths: list[Path]  # of policy files; every shipped one if no follower was named
    asked: bool  # whether a follower was named

    def made(self, config: Config, every: Sequence[str]) -> list[Follower]:
        """The followers that are no policies, for the plant of `config`; those named `every` if none was named."""
        return [_maker(name)(config) for name in dict.fromkeys(self.names if self.asked else every)]


def named(options: argparse.Namespace) -> Named:
    """The followers that `options` name. Raises InputError for an unknown one."""
    files, names = [], []
    for given in [*map(str, options.policies), *options.followers]:
        path = policy_path(given)
        if given in CONTROLLERS or (":" in given and not path.exists()):
            names.append(given)
        elif path.exists() or path.suffix == ".npz" or path in options.policies:
            files.append(path / "policy.npz" if path.is_dir() else path)
        else:
            names.append(given)
    for name in names:
        _maker(name)
    asked = bool(files or names)
    return Named(names, files if asked else shipped_policies(), asked)


def _maker(name: str) -> FollowerFactory:
    return follower_factory(name, "--followers")[1]


def load(
    paths: Sequence[Path],
    setup_of: Callable[[Path], Config],
    force: bool,
    compare_controllers: bool = True,
    seconds: float = 0.0,
) -> list[Policy]:
    """The policies, each loaded for the configuration `setup_of` its path, for flights of up to `seconds` [s].

    InputError if one does not fit, unless `force`, which marks its name. Files with equal stems are named with their
    directory.
    """
    policies = []
    for path in paths:
        setup, policy = setup_of(path), Policy.load(path)
        policy.join(setup.plant)
        try:
            policy = load_policy(path, setup, compare_controllers, seconds)
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
    """Raise InputError if two followers have the same name, which identifies a row of a table."""
    for name in names:
        if names.count(name) > 1:
            raise InputError(f"two followers are called {name!r}; rename a policy file")


def clock() -> Callable[[str], None]:
    """A function that prints the time since this call and a text on stderr, to show progress."""
    started, status = time.monotonic(), Status()
    return lambda text: status.say(f"{time.monotonic() - started:6.1f} s  {text}")


def fly_and_say(
    setup: Config, followers: Sequence[Follower], scenarios: Sequence[Scenario], physics: str
) -> list[Result]:
    """`fly_scenarios`, which says on stderr how far it is."""

    def counted(things: Sequence[object], name: str) -> str:
        return f"{len(things)} {name}{'s' if len(things) > 1 else ''}"

    text = f"flying {counted(followers, 'follower')} in {counted(scenarios, 'scenario')}"
    with Working(text) as working:
        return fly_scenarios(setup, followers, scenarios, physics, working)
