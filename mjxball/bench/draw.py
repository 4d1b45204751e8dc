"""The flights of a draw: candidates of the tracks that the oracle succeeds in, with its arrivals.

Those of draw 0 are stored in one file a track (`python -m mjxball.bench.store` writes them), and so are a few of draw 1
on some tracks, for `mjxball.bench.quick`. Those of another draw are found when asked for, by the same function.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import math
import re
from collections.abc import Iterator, Sequence
from importlib import resources
from typing import Any, NamedTuple

import numpy as np

from mjxball.baselines import make_baseline
from mjxball.bench import CONDITIONS, NAME, VERSION
from mjxball.bench.flying import ENGINE
from mjxball.bench.success import deadline, reasons
from mjxball.bench.tracks import TRACKS, PlantFlights, candidate
from mjxball.config import Config
from mjxball.errors import InputError
from mjxball.evaluate.metrics import fly_and_measure
from mjxball.reading import parse_json
from mjxball.sim.scenario import Scenario

STORED_DRAW = 0
QUICK_DRAW, QUICK_FLIGHTS, QUICK_TRACKS = 1, 50, ("pair", "crazyflie")
LEFT = 5.0  # least time between the deadline and the end of a flight [s]
MOST_TRIES = 20  # largest number of candidates for each flight wanted, before an error says that the oracle fails
# Parts of a configuration that act on a flight.
ACTING = ("plant", "attitude", "autopilot", "leader", "command", "timing", "motion")


class Flight(NamedTuple):
    """One flight of a draw: a candidate that the oracle succeeds in."""

    condition: str
    candidate: int  # its number
    scenario: Scenario
    radius: float  # [m]
    oracle_arrival: float  # [s]
    deadline: float  # [s]


class Group(NamedTuple):
    """The flights of a draw on one plant."""

    config: Config
    flights: tuple[Flight, ...]


@functools.cache
def groups_of(track: str, draw: int) -> tuple[Group, ...]:
    """All flights of a track for one draw, by plant; cached.

    Raises InputError if the stored flights are not of this version's definition, or if the oracle succeeds too rarely.
    """
    if draw != STORED_DRAW:
        plants = TRACKS[track].flights(draw)
        return tuple(sample_group(track, draw, number, plant) for number, plant in enumerate(plants))
    return _stored_groups(track, draw, read_stored(track))


@functools.cache
def quick_group(track: str) -> Group:
    """A few flights of one of `QUICK_TRACKS`, of a draw of their own; cached. Raises InputError as `groups_of`."""
    (group,) = _stored_groups(track, QUICK_DRAW, read_stored(f"{track}-quick"))
    return group


def _stored_groups(track: str, draw: int, stored: dict[str, Any]) -> tuple[Group, ...]:
    plants = TRACKS[track].flights(draw)
    if len(stored["plants"]) != len(plants):
        raise changed(track)
    groups = tuple(
        _rebuilt(track, draw, number, plant, known)
        for number, (plant, known) in enumerate(zip(plants, stored["plants"], strict=True))
    )
    if definition(groups) != stored["definition"]:
        raise changed(track)
    return groups


def stored_forms(track: str) -> dict[str, dict[str, Any]]:
    """What the files of a track store, by the files' stems: the flights of draw 0, and a few of `QUICK_DRAW`."""
    plants = TRACKS[track].flights(STORED_DRAW)
    found = {track: _stored_form(track, track, STORED_DRAW, plants)}
    if track in QUICK_TRACKS:
        few = [dataclasses.replace(one, count=QUICK_FLIGHTS) for one in TRACKS[track].flights(QUICK_DRAW)]
        found[f"{track}-quick"] = _stored_form(f"{track}-quick", track, QUICK_DRAW, few)
    return found


def _stored_form(name: str, track: str, draw: int, plants: Sequence[PlantFlights]) -> dict[str, Any]:
    """Which candidates the flights are, and when the oracle arrives."""
    groups = [sample_group(track, draw, number, plant) for number, plant in enumerate(plants)]
    rows = [
        {
            "moving": plant.moving,
            "radius": {condition: plant.radius_in(condition) for condition in CONDITIONS},
            "seconds": max(one.scenario.seconds for one in group.flights),
            **{
                condition: [[one.candidate, one.oracle_arrival] for one in group.flights if one.condition == condition]
                for condition in CONDITIONS
            },
        }
        for plant, group in zip(plants, groups, strict=True)
    ]
    return {"benchmark": NAME, "version": VERSION, "track": name, "definition": definition(groups), "plants": rows}


@functools.cache
def read_stored(track: str) -> dict[str, Any]:
    """The stored file of a track, by its stem; InputError if there is none of this version."""
    path = resources.files("mjxball.bench") / "draws" / f"{track}.json"
    if not path.is_file():
        raise InputError(f"flights of track {track} are not stored; python -m mjxball.bench.store {track} does it")
    found: dict[str, Any] = parse_json(path.read_text("utf-8"))
    if (found["benchmark"], found["version"], found["track"]) != (NAME, VERSION, track):
        raise changed(track)
    return found


def changed(track: str) -> InputError:
    """The error where the stored flights of a track are not those that this version samples."""
    return InputError(
        f"the stored flights of track {track} are not those that this source samples: python -m mjxball.bench.store "
        f"{track} stores them anew, which makes another version of {NAME}"
    )


def definition(groups: Sequence[Group]) -> str:
    """Hash of all plants, controllers and flights, but not of what the oracle does in them."""
    parts = [
        (
            [_in_full(getattr(group.config, name)) for name in ACTING],
            group.config.scenario.termination_distance,
            [(one.condition, one.candidate, _in_full(one.scenario), one.radius) for one in group.flights],
        )
        for group in groups
    ]
    # Six digits: a linear program bounds some amplitudes, and its last bits differ between machines.
    text = re.sub(r"-?\d+\.\d+(e-?\d+)?", lambda number: f"{float(number[0]):.6g}", repr(parts))
    return hashlib.sha256(text.encode()).hexdigest()


def _in_full(value: Any) -> str:
    """Every field of a dataclass, whatever its own `repr` leaves out."""
    if not dataclasses.is_dataclass(value):
        return repr(value)
    fields = ", ".join(f"{one.name}={_in_full(getattr(value, one.name))}" for one in dataclasses.fields(value))
    return f"{type(value).__qualname__}({fields})"


def _rebuilt(track: str, draw: int, number: int, plant: PlantFlights, stored: dict[str, Any]) -> Group:
    """The stored flights of a draw on plant `number`, without flying the oracle."""
    flights = []
    for condition in CONDITIONS:
        for which, arrival in stored[condition]:
            scenario = candidate(track, draw, number, condition, which, plant.sample)
            if scenario is None:
                raise changed(track)
            flights.append(_flight(plant, condition, which, scenario, arrival))
    return Group(plant.config, tuple(flights))


def _flight(plant: PlantFlights, condition: str, which: int, scenario: Scenario, arrival: float) -> Flight:
    return Flight(condition, which, scenario, plant.radius_in(condition), arrival, deadline(arrival, plant.moving))


def sample_group(track: str, draw: int, number: int, plant: PlantFlights) -> Group:
    """The first `plant.count` candidates of each condition that the oracle succeeds in.

    Raises InputError if these are too few of all.
    """
    flights: dict[str, list[Flight]] = {condition: [] for condition in CONDITIONS}
    coming = {condition: _candidates(track, draw, number, condition, plant) for condition in CONDITIONS}
    for _ in range(MOST_TRIES):
        lacking = [condition for condition in CONDITIONS if len(flights[condition]) < plant.count]
        if not lacking:
            return Group(plant.config, tuple(one for condition in CONDITIONS for one in flights[condition]))
        # As many candidates of either condition each time: another number of flights would be compiled anew.
        tried = [(one, *next(coming[one])) for one in CONDITIONS for _ in range(plant.count)]
        radii = np.array([plant.radius_in(condition) for condition, _, _ in tried])
        arrivals = oracle_arrivals(plant.config, [scenario for _, _, scenario in tried], radii, plant.moving)
        for (condition, which, scenario), arrival in zip(tried, arrivals, strict=True):
            if arrival is not None and len(flights[condition]) < plant.count:
                flights[condition].append(_flight(plant, condition, which, scenario, arrival))
    raise InputError(f"the oracle succeeds in too few flights of track {track}, plant {number + 1}, draw {draw}")


def _candidates(
    track: str, draw: int, number: int, condition: str, plant: PlantFlights
) -> Iterator[tuple[int, Scenario]]:
    which = 0
    while True:
        if (scenario := candidate(track, draw, number, condition, which, plant.sample)) is not None:
            yield which, scenario
        which += 1


def oracle_arrivals(
    config: Config, scenarios: Sequence[Scenario], radii: np.ndarray, moving: bool
) -> list[float | None]:
    """When the object arrives for good within its radius [m] with the oracle [s], in each flight; None: no success."""
    perfect = [with_perfect_sensors(scenario) for scenario in scenarios]
    _, flown = fly_and_measure(config, [(make_baseline("oracle", config), perfect)], ENGINE, radii)
    found: list[float | None] = []
    for metrics, scenario in zip(flown, scenarios, strict=True):
        latest = deadline(math.inf if metrics.arrival is None else metrics.arrival, moving)
        good = not reasons(metrics, latest) and latest <= scenario.seconds - LEFT
        found.append(metrics.arrival if good else None)
    return found


def with_perfect_sensors(scenario: Scenario) -> Scenario:
    """`scenario` as the oracle flies it: exact sensors without delay, the true mass; plant and air stay.

    Errors of the attitude are of the sensors, so no loop has them either. Jitter counts as an error of the sensors: the
    oracle's commands are never late, other followers' are.
    """
    rough = scenario.disturbance
    kept = dataclasses.replace(type(rough)(), gust=rough.gust, gust_seed=rough.gust_seed)
    return dataclasses.replace(scenario, disturbance=kept, believed_mass=None)
