"""Flights of the benchmark with a follower in a process of its own.

Sensor noise, the order of flights and every other random number of an evaluation come from its key of 128 bits. It is
fresh for every evaluation and stands in the entry afterwards: no follower can know the noise beforehand, and anybody
can repeat the evaluation.
"""

from __future__ import annotations

import dataclasses
import hashlib
import re
import secrets
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mjxball.bench.draw import Flight, Group, groups_of
from mjxball.bench.flying import Part, fly, together
from mjxball.bench.process import FollowerProcess
from mjxball.bench.success import reasons
from mjxball.errors import InputError
from mjxball.evaluate.metrics import Metrics
from mjxball.sim.rollout import load_of
from mjxball.sim.scenario import Scenario

KEY = re.compile(r"[0-9a-f]{32}")
# What version 2 makes seeds of: conditions had these names when it was published.
SEEDED_AS = {"calm": "calm", "disturbed": "world"}


class Result(NamedTuple):
    """One flight of the follower."""

    plant: int  # of the track
    flight: Flight
    metrics: Metrics
    failures: tuple[str, ...]  # see `success.reasons`


def fresh_key() -> str:
    """A key that nobody knows."""
    return secrets.token_hex(16)


def check_key(key: str) -> str:
    """`key`; InputError unless it is 32 hexadecimal digits."""
    if not KEY.fullmatch(key):
        raise InputError(f"--key must be 32 digits of 0 - 9 and a - f, as an entry has it, not {key!r}")
    return key


def seed_of(key: str, *place: str | int) -> int:
    """The seed, 63 bits, of what `place` names in the evaluation with `key`."""
    digest = hashlib.sha256(":".join(map(str, (key, *place))).encode()).digest()
    return int.from_bytes(digest[:8]) >> 1


def evaluate(
    track: str, draw: int, key: str, process: FollowerProcess, progress: Callable[[str], None] = lambda text: None
) -> list[Result]:
    """The follower's flights on `track`; InputError if it does not answer as it should.

    Plants and their flights, of both conditions at once, come in an order of the key.
    """
    groups = groups_of(track, draw)
    batches = together([group.config for group in groups])
    found: list[Result] = []
    order = np.random.default_rng(seed_of(key, track, "batches")).permutation(len(batches))
    for done, number in enumerate(order):
        progress(f"{track}: {done + 1}/{len(batches)}")
        plants = np.random.default_rng(seed_of(key, track, "plants", int(number))).permutation(batches[number])
        found += _fly({int(plant): groups[plant] for plant in plants}, f"{key}:{track}", process)
        process.check_alone()
    return sorted(found, key=lambda one: (one.plant, one.flight.condition, one.flight.candidate))


def _fly(groups: dict[int, Group], key: str, process: FollowerProcess) -> list[Result]:
    """Flights on plants, by their numbers, as one batch."""
    flown: list[tuple[int, Flight]] = []
    parts, followers = [], {}
    for plant, group in groups.items():
        order = np.random.default_rng(seed_of(key, plant, "flights")).permutation(len(group.flights))
        flights = [group.flights[number] for number in order]
        scenarios = [with_seed(one, key, plant) for one in flights]
        follower = followers[plant] = process.follower(group.config)
        follower.believed_mass = load_of(group.config, scenarios).believed_mass
        radii, deadlines = (np.array([getattr(one, name) for one in flights]) for name in ("radius", "deadline"))
        parts.append(Part(group.config, follower, scenarios, radii, deadlines))
        flown += [(plant, flight) for flight in flights]
    begun, answered = process.cpu_time, process.answered
    metrics = fly(parts)
    mean = (process.cpu_time - begun) / (process.answered - answered)  # with that of threads between the calls
    return [
        Result(plant, flight, one, reasons(one, flight.deadline, max(mean, followers[plant].slowest)))
        for (plant, flight), one in zip(flown, metrics, strict=True)
    ]


def with_seed(flight: Flight, key: str, plant: int) -> Scenario:
    """The scenario of a flight on a track's plant number `plant`, with noise from `key` and the track's name."""
    seed = seed_of(key, plant, SEEDED_AS[flight.condition], flight.candidate)
    disturbance = dataclasses.replace(flight.scenario.disturbance, seed=seed)
    return dataclasses.replace(flight.scenario, disturbance=disturbance)
