"""The flights of a draw: stored and sampled, with the oracle's arrivals."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from mjxball.baselines import make_baseline
from mjxball.bench import CONDITIONS, draw, store
from mjxball.bench.draw import Group, definition, groups_of, oracle_arrivals, with_perfect_sensors
from mjxball.bench.tracks import FLIGHTS, TRACKS, PlantFlights, Track, candidate
from mjxball.config import preset
from mjxball.errors import InputError
from mjxball.evaluate.metrics import measure, rotor_limits
from mjxball.plant.trim import largest_margin
from mjxball.sim.disturbances import Disturbance
from mjxball.sim.goals import GoalMotion
from mjxball.sim.rollout import simulate
from mjxball.sim.scenario import Scenario

STORED = tuple(name for path in sorted(store.FOLDER.glob("*.json")) if not (name := path.stem).endswith("-known"))


def flights_of(track: str) -> list[draw.Flight]:
    """All stored flights of a file."""
    name, few, _ = track.partition("-quick")
    groups = [draw.quick_group(name)] if few else groups_of(name, 0)
    return [one for group in groups for one in group.flights]


@pytest.mark.parametrize("track", STORED)
def test_stored_flights_are_those_that_the_source_samples(track: str) -> None:
    """`groups_of` compares the hash of their definition."""
    flights = flights_of(track)
    for condition in CONDITIONS:
        wanted = draw.QUICK_FLIGHTS if track.endswith("-quick") else FLIGHTS
        assert sum(one.condition == condition for one in flights) == wanted
    assert all(one.deadline <= one.scenario.seconds - draw.LEFT for one in flights)
    assert all(one.scenario.disturbance == Disturbance(offset=1.0) for one in flights if one.condition == "calm")


@pytest.mark.parametrize("track", STORED)
def test_no_flight_tells_of_another(track: str) -> None:
    """Not of another condition either: goals, phases and amplitudes are all different."""
    flights = [one.scenario for one in flights_of(track)]
    for name in ("goal_motion" if track == "moving" else "goal", "phase", "amplitude"):
        assert len({getattr(one, name) for one in flights}) == len(flights)


def test_a_candidate_is_the_same_whatever_else_is_sampled_and_another_draw_is_others() -> None:
    (plant,) = TRACKS["pair"].flights(0)
    first = candidate("pair", 0, 0, "calm", 7, plant.sample)
    candidate("pair", 0, 0, "disturbed", 8, plant.sample)
    assert candidate("pair", 0, 0, "calm", 7, plant.sample) == first
    for other in (("pair", 1, 0, "calm"), ("pair-unknown", 0, 0, "calm"), ("pair", 0, 0, "disturbed")):
        assert candidate(*other, 7, plant.sample) != first


def test_every_load_of_the_pair_can_be_trimmed() -> None:
    config = groups_of("pair", 0)[0].config
    for one in flights_of("pair")[:30]:
        sides = [largest_margin(config.plant, one.scenario.mass, s * one.scenario.amplitude).margin for s in (-1, 1)]
        assert min(sides) >= 0.15 - 1e-6


def test_stored_arrivals_are_those_of_the_oracle_flown_alone() -> None:
    """Without sensor errors, by another road: one flight at a time, measured apart."""
    config = groups_of("pair", 0)[0].config
    flights = flights_of("pair")
    for one in (flights[0], flights[-1]):
        flown = simulate(config, make_baseline("oracle", config), with_perfect_sensors(one.scenario), "newton-euler")
        distance = np.linalg.norm(flown.error, axis=1)
        # In another batch the last bits are others, and a control period is 20 ms.
        assert one.oracle_arrival == pytest.approx(flown.time[distance > one.radius].max(), abs=0.021)
        assert one.deadline == pytest.approx(1.25 * one.oracle_arrival)
        (limits,) = rotor_limits(config.plant, [one.scenario])
        found = measure(flown, config.scenario.termination_distance, limits, radius=one.radius)
        assert not found.failed
        assert found.rotor_limit_share <= 0.05


def test_the_oracle_knows_the_mass_and_flies_without_noise_and_delay() -> None:
    rough = Disturbance(noise=1.0, delay=0.04, gust=0.2, seed=3, gust_seed=4, estimator_drift=1.0, offset=1.0)
    found = with_perfect_sensors(Scenario(mass=0.5, believed_mass=0.2, disturbance=rough))
    assert found == Scenario(mass=0.5, disturbance=Disturbance(gust=0.2, gust_seed=4))


def one_plant(monkeypatch: pytest.MonkeyPatch, plant: PlantFlights) -> None:
    """Make the track of the pair one of this plant alone."""
    monkeypatch.setitem(TRACKS, "pair", Track("pair", "pair", lambda draw: [plant]))


def test_flights_that_the_oracle_does_not_succeed_in_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of every two flights one begins with the CG where no follower can hold it."""

    def sample(random: np.random.Generator, condition: str) -> Scenario:
        hopeless = random.random() < 0.5
        return Scenario(
            omega=0.0, phase=1.57, amplitude=0.16, mass=3.0 if hopeless else 0.1, goal=(0.5, 0.5, 0.5), seconds=20.0
        )

    one_plant(monkeypatch, PlantFlights(preset("paper"), sample, 3))
    (group,) = groups_of.__wrapped__("pair", 9)
    assert {one.scenario.mass for one in group.flights} == {0.1}
    for condition in CONDITIONS:
        numbers = [one.candidate for one in group.flights if one.condition == condition]
        assert len(numbers) == 3
        tried = [candidate("pair", 9, 0, condition, number, sample) for number in range(max(numbers) + 1)]
        assert [number for number, one in enumerate(tried) if one.mass == 0.1] == numbers


def test_a_track_without_successes_of_the_oracle_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    too_heavy = PlantFlights(preset("paper"), lambda random, condition: Scenario(mass=9.0, seconds=0.1), 1)
    one_plant(monkeypatch, too_heavy)
    with pytest.raises(InputError, match="succeeds in too few flights of track pair, plant 1, draw 9"):
        groups_of.__wrapped__("pair", 9)


def test_a_moving_goal_has_its_own_deadline() -> None:
    """A goal that is where the object begins is followed from the start; one that runs away is not within 3 s."""
    near, far = (
        Scenario(goal=(0.0,) * 3, omega=0.0, amplitude=0.0, seconds=9.0, goal_motion=GoalMotion(velocity=(v, 0.0, 0.0)))
        for v in (0.0, 4.0)
    )
    config = preset("paper")
    assert oracle_arrivals(config, [near, far], np.full(2, 0.02), moving=True) == [0.0, None]


def test_flights_of_another_definition_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    (group,) = groups_of("pair", 0)
    heavier = dataclasses.replace(group.flights[0].scenario, mass=group.flights[0].scenario.mass + 1e-3)
    changed = Group(group.config, (group.flights[0]._replace(scenario=heavier), *group.flights[1:]))
    assert definition([changed]) != definition([group])
    gains = dataclasses.replace(group.config.leader, kp=(0.5, 0.5, 0.6))
    assert definition([Group(dataclasses.replace(group.config, leader=gains), group.flights)]) != definition([group])
    (plant,) = TRACKS["pair"].flights(0)
    one_plant(monkeypatch, dataclasses.replace(plant, radius=0.011))
    with pytest.raises(InputError, match="the stored flights of track pair are not those that this source samples"):
        groups_of.__wrapped__("pair", 0)


def test_storing_a_track_writes_what_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By a track of two flights, whose files are then read in place of the others."""
    monkeypatch.setattr(draw, "QUICK_FLIGHTS", 3)

    def sample(random: np.random.Generator, condition: str) -> Scenario:
        return Scenario(amplitude=0.02, goal=tuple(map(float, random.uniform(0.3, 0.5, 3))), seconds=20.0)

    one_plant(monkeypatch, PlantFlights(preset("paper"), sample, 1))
    monkeypatch.setattr(store, "FOLDER", tmp_path / "draws")
    monkeypatch.setattr(draw.resources, "files", lambda package: tmp_path)
    assert store.main(["pair"]) == 0
    try:
        draw.read_stored.cache_clear()
        stored = draw.stored_forms("pair")
        assert draw.definition(groups_of.__wrapped__("pair", 0)) == stored["pair"]["definition"]
        few = draw.quick_group.__wrapped__("pair")
        assert draw.definition((few,)) == stored["pair-quick"]["definition"]
        assert len(few.flights) == 2 * draw.QUICK_FLIGHTS
        with pytest.raises(InputError, match="flights of track team are not stored"):
            draw.read_stored("team")
    finally:
        draw.read_stored.cache_clear()
        draw.quick_group.cache_clear()  # other tests want the stored one
