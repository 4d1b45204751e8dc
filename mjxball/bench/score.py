"""What mjxball-bench measures of a flight, when a flight is met, and what a track comes to."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from scipy.stats import binomtest

from mjxball.bench.followers import Make, checked
from mjxball.bench.tracks import TRACKS, World
from mjxball.control.followers import Follower
from mjxball.evaluate.metrics import Metrics, measure_batch, rotor_limits
from mjxball.sim.rollout import simulate_batch
from mjxball.sim.scenario import Scenario

ENGINE = "newton-euler"
# A flight is met if it does not fail and has, of the best that a reference has there, at most
PEAK = 0.003  # more peak [m], times the world's length
LATER, LATER_SECONDS = 0.1, 0.1  # so much later settling, whichever is more: share, [s]
OVERSHOOT = 0.01  # more overshoot
CONFIDENCE = 0.95  # of the interval of what is met (Wilson 1927)
CONDITIONS = ("undisturbed", "disturbed")


def fly(world: World, followers: Sequence[Follower], scenarios: Sequence[Scenario]) -> list[list[Metrics]]:
    """Metrics of every flight of every follower, in float64."""
    flown = simulate_batch(world.config, [(follower, scenarios) for follower in followers], ENGINE)
    plant, count = world.config.plant, len(scenarios)
    limit, most = world.config.scenario.termination_distance, rotor_limits(plant, [*scenarios] * len(followers))
    found = measure_batch(flown, limit, most, plant.leader)
    return [found[first : first + count] for first in range(0, len(found), count)]


def numbers(metrics: Metrics) -> tuple[float, float, float]:
    """(peak [m], settling time [s], overshoot) of a flight, infinite where it failed or never settled."""
    if metrics.failed or not math.isfinite(metrics.peak):
        return math.inf, math.inf, math.inf
    settling = math.inf if metrics.settling_time is None else metrics.settling_time
    return metrics.peak, settling, math.inf if metrics.overshoot is None else metrics.overshoot


@functools.cache
def worlds_of(track: str, draw: int) -> list[World]:
    """The worlds of a track, drawn once."""
    return TRACKS[track].worlds(draw)


@functools.cache
def bars(track: str, draw: int, number: int) -> np.ndarray:
    """(flights, 3): the largest peak, settling and overshoot with which flights of a track's world `number` are met.

    Undisturbed and disturbed flights in turn. The best of the references in each number apart, in the same flight;
    infinite where all of them failed.
    """
    world = worlds_of(track, draw)[number]
    scenarios = world.reference_scenarios or tuple(one for pair in world.scenarios for one in pair)
    found = fly(world, [make(world.config) for make in world.references], scenarios)
    best = np.array([[numbers(one) for one in flights] for flights in found]).min(axis=0)
    peak, settling, overshoot = best.T
    later = settling + np.maximum(LATER_SECONDS, LATER * settling)
    return np.stack([peak + PEAK * world.length, later, overshoot + OVERSHOOT], axis=1)


def measure(track: str, draw: int, make: Make, progress: Callable[[str], None]) -> dict[str, dict[str, Any]]:
    """What the follower comes to on `track`, of undisturbed flights and of disturbed ones.

    Raises InputError if it does not fly the track's plants, or is none that can be flown (`mjxball.bench.followers`).
    """
    flown: list[Metrics] = []
    met: list[bool] = []
    worlds = worlds_of(track, draw)
    # All refusals before the first flight; with the first plant as many calls as a flight has.
    whole = round(worlds[0].scenarios[0][0].seconds / worlds[0].config.timing.control_period)
    entrants = [checked(make, world.config, *[] if number else [whole]) for number, world in enumerate(worlds)]
    for number, (world, follower) in enumerate(zip(worlds, entrants, strict=True)):
        progress(f"{track}: {number + 1}/{len(worlds)}")
        (mine,) = fly(world, [follower], [one for pair in world.scenarios for one in pair])
        reached = [numbers(one) for one in mine]
        good = [
            not metrics.failed and bool((np.array(own) <= bar).all())
            for metrics, own, bar in zip(mine, reached, bars(track, draw, number), strict=True)
        ]
        flown, met = [*flown, *mine], [*met, *good]
    return {name: summary(flown[row::2], met[row::2]) for row, name in enumerate(CONDITIONS)}


def summary(flown: Sequence[Metrics], met: Sequence[bool]) -> dict[str, Any]:
    """A track's numbers in one condition; None for what is infinite."""
    peak, settling, _ = np.array([numbers(one) for one in flown]).T
    interval = binomtest(sum(met), len(met)).proportion_ci(CONFIDENCE, method="wilson")
    sound = [one for one in flown if not one.failed]
    limit, change = (
        [getattr(one, name) for one in sound if getattr(one, name) is not None]
        for name in ("rotors_at_limit", "smoothness")
    )
    found = {
        "flights": len(flown),
        "met": sum(met) / len(met),
        "low": float(interval.low),
        "high": float(interval.high),
        "failed": sum(one.failed for one in flown) / len(flown),
        "settling_50": float(np.quantile(settling, 0.5, method="higher")),
        "peak_90": float(np.quantile(peak, 0.9, method="higher")),
        "rotors_at_limit": float(np.mean(limit)) if limit else math.inf,
        "command_change": float(np.median(change)) if change else math.inf,
    }
    return {name: value if math.isfinite(value) else None for name, value in found.items()}
