"""Success in a few flights of mjxball-bench, within seconds: how good a follower is while it trains.

The flights are of a draw of their own, so whoever watches them has not seen those that are ranked. They are flown in
this process: what a follower may know is not enforced, as `eval.py bench` does. The success of the followers in `KNOWN`
is stored beside the flights.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Sequence
from typing import Any

import numpy as np

from mjxball.baselines import make_baseline
from mjxball.bench import CONDITIONS
from mjxball.bench.draw import QUICK_TRACKS, Flight, Group, definition, quick_group, read_stored
from mjxball.bench.evaluation import with_seed
from mjxball.bench.flying import ENGINE
from mjxball.bench.success import reasons, summary
from mjxball.bench.tracks import TRACKS
from mjxball.config import Config
from mjxball.control.followers import Follower
from mjxball.errors import InputError
from mjxball.evaluate.metrics import Metrics, fly_and_measure
from mjxball.evaluate.policies import load_policy
from mjxball.policy.file import shipped_policy

KEY = "quick"  # of the noise
KNOWN = {"pair": ("lqg", "balance"), "crazyflie": ("lqg", "flight")}  # on each track: a baseline, a shipped policy
Success = dict[str, float]  # share of the flights of each condition


def quick_track(config: Config) -> str | None:
    """The track whose plant, controllers and rate `config` has; None if there is none with a few flights."""
    for name in QUICK_TRACKS:
        (plant,) = TRACKS[name].flights(0)
        if all(getattr(config, part) == getattr(plant.config, part) for part in ("plant", "attitude", "timing")):
            return name
    return None


def quick_success(track: str, followers: Sequence[Follower]) -> list[Success]:
    """Success of each of `followers`, flown together, in the few flights of `track`."""
    found = summaries(quick_group(track), followers)
    return [{name: own["succeeded"] / own["flights"] for name, own in one.items()} for one in found]


def known_success(track: str) -> dict[str, Success]:
    """Success of the followers in `KNOWN`, as stored if that is of this policy and these flights, else flown."""
    try:
        stored = read_stored(f"{track}-known")
        if tuple(stored["success"]) == KNOWN[track] and stored.items() >= _flown_in(track).items():
            return dict(stored["success"])
    except InputError:  # nothing is stored, or there are no policies
        pass
    return fly_known(track)


def known_form(track: str) -> dict[str, Any]:
    """What the file of `known_success` stores."""
    return {**_flown_in(track), "success": fly_known(track)}


def fly_known(track: str) -> dict[str, Success]:
    """Success of the followers in `KNOWN`; without the policy where an installation has none."""
    config, (baseline, shipped) = quick_group(track).config, KNOWN[track]
    followers: list[Follower] = [make_baseline(baseline, config)]
    with contextlib.suppress(InputError):
        followers.append(load_policy(shipped_policy(shipped), config))
    return dict(zip(KNOWN[track], quick_success(track, followers), strict=False))


def _flown_in(track: str) -> dict[str, str]:
    """Hashes of the flights and of the shipped policy; InputError if there is none."""
    policy = shipped_policy(KNOWN[track][1]).read_bytes()
    return {"definition": definition((quick_group(track),)), "policy": hashlib.sha256(policy).hexdigest()}


def summaries(group: Group, followers: Sequence[Follower]) -> list[dict[str, dict[str, Any]]]:
    """`success.summary` by condition of each of `followers`, flown together, in the flights of `group`."""
    config, flights = group
    scenarios = [with_seed(one, KEY, 0) for one in flights]
    radii, deadlines = (np.array([getattr(one, name) for one in flights]) for name in ("radius", "deadline"))
    radius, latest = (np.tile(values, len(followers)) for values in (radii, deadlines))
    _, metrics = fly_and_measure(config, [(one, scenarios) for one in followers], ENGINE, radius, latest)
    found = []
    for begin in range(0, len(metrics), len(flights)):
        own = list(zip(metrics[begin : begin + len(flights)], flights, strict=True))
        parts = {name: [pair for pair in own if pair[1].condition == name] for name in CONDITIONS}
        found.append({name: _summary(part) for name, part in parts.items()})
    return found


def _summary(flown: Sequence[tuple[Metrics, Flight]]) -> dict[str, Any]:
    failures = [reasons(metrics, flight.deadline) for metrics, flight in flown]
    return summary([metrics for metrics, _ in flown], failures, [flight.oracle_arrival for _, flight in flown])
