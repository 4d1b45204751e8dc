"""Short flights of the benchmark, and followers of one's own."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import pytest

from mjxball.bench import CONDITIONS, entry, evaluation
from mjxball.bench.draw import Flight, Group
from mjxball.bench.tracks import TRACKS, candidate

SECONDS, EACH = 3.0, 3


def short_group(track: str) -> Group:
    """Three flights of 3 s in each condition on the first plant of a track, with deadlines that no oracle sets."""
    plant, flights = TRACKS[track].flights(5)[0], []
    for condition in CONDITIONS:
        found = (candidate(track, 5, 0, condition, number, plant.sample) for number in range(100))
        for number, scenario in enumerate([one for one in found if one is not None][:EACH]):
            short = dataclasses.replace(scenario, seconds=SECONDS)
            flights.append(Flight(condition, number, short, plant.radius_in(condition), 1.6, 2.0))
    return Group(plant.config, tuple(flights))


@pytest.fixture
def short(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current directory, for followers of one's own, where tracks have `short_group` alone."""
    monkeypatch.chdir(tmp_path)
    made = {}

    def groups_of(track: str, draw: int) -> tuple[Group, ...]:
        if track not in made:
            made[track] = (short_group(track),)
        return made[track]

    for module in (entry, evaluation):
        monkeypatch.setattr(module, "groups_of", groups_of)
    return tmp_path
