"""Success in a few flights of mjxball-bench, within seconds: how good a follower is while it trains.

The flights are of a draw of their own, so whoever watches them has not seen those that are ranked. They are flown in
this process: what a follower may know is not enforced, as `eval.py bench` does.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mjxball.bench import CONDITIONS
from mjxball.bench.draw import QUICK_TRACKS, Group, quick_group
from mjxball.bench.evaluation import with_seed
from mjxball.bench.flying import ENGINE
from mjxball.bench.success import reasons
from mjxball.bench.tracks import TRACKS
from mjxball.config import Config
from mjxball.control.followers import Follower
from mjxball.evaluate.metrics import fly_and_measure

KEY = "quick"  # of the noise
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
    return success(quick_group(track), followers)


def success(group: Group, followers: Sequence[Follower]) -> list[Success]:
    """Success of each of `followers`, flown together, in the flights of `group`."""
    config, flights = group
    scenarios = [with_seed(one, KEY, 0) for one in flights]
    radii, deadlines = (np.array([getattr(one, name) for one in flights]) for name in ("radius", "deadline"))
    repeated = (np.tile(values, len(followers)) for values in (radii, deadlines))
    _, metrics = fly_and_measure(config, [(one, scenarios) for one in followers], ENGINE, *repeated)
    found: list[Success] = []
    for begin in range(0, len(metrics), len(flights)):
        own = [not reasons(one, late) for one, late in zip(metrics[begin:], deadlines, strict=False)]
        found.append(
            {
                name: float(np.mean([good for good, one in zip(own, flights, strict=True) if one.condition == name]))
                for name in CONDITIONS
            }
        )
    return found
