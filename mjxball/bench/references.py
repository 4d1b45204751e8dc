"""Results of the classical followers that know the plant, in the benchmark's flights."""

from __future__ import annotations

import functools

import numpy as np

from mjxball.baselines import make_baseline
from mjxball.bench.success import bar, numbers
from mjxball.bench.tracks import worlds_of
from mjxball.config import Config
from mjxball.control.followers import Baseline


@functools.cache
def bars(track: str, draw: int, number: int) -> np.ndarray:
    """(flights, 3): the `bar` of every flight of a track's world `number`, undisturbed and disturbed in turn.

    Each value is the best of all references in that flight; infinite where all of them failed.
    """
    world = worlds_of(track, draw)[number]
    scenarios = world.reference_scenarios or tuple(one for pair in world.scenarios for one in pair)
    found = world.fly([reference(name, world.config) for name in world.references], scenarios)
    return bar(np.array([[numbers(one) for one in flights] for flights in found]).min(axis=0), world.length)


def reference(name: str, config: Config) -> Baseline:
    """The reference called `name`, made for the plant of `config`."""
    return make_baseline(name, config)
