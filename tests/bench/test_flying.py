"""Plants that fly as one batch, and the conditions of their flights."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from mjxball.baselines import make_baseline
from mjxball.bench import flying
from mjxball.bench.conditions import CRAZYFLIE, OFFSET, OUTDOORS, in_calm, with_disturbances
from mjxball.bench.draw import with_perfect_sensors
from mjxball.bench.tracks import TRACKS
from mjxball.config import Config, preset
from mjxball.evaluate.metrics import fly_and_measure
from mjxball.sim.disturbances import Disturbance
from mjxball.sim.scenario import Scenario


class Observing:
    """A follower that sees observations alone."""

    def __init__(self, config: Config):
        self._own = make_baseline("copy", config)
        self.name, self.reset = self._own.name, self._own.reset

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        return self._own(observation)


def test_plants_fly_together_as_each_does_alone() -> None:
    """Three random rigs of three drones, of different masses, mounts and gains, under all disturbances."""
    plants = [one for one in TRACKS["rigs"].flights(5) if one.config.plant.count == 3][:3]
    parts = []
    for number, plant in enumerate(plants):
        scenarios = [plant.sample(np.random.default_rng([number, k]), "disturbed") for k in range(2)]
        short = [dataclasses.replace(one, seconds=4.0) for one in scenarios]
        follower = Observing(plant.config)
        parts.append(flying.Part(plant.config, follower, short, np.full(2, 0.02), np.full(2, 2.0)))
    assert flying.together([part.config for part in parts]) == [[0, 1, 2]]
    found = flying.fly(parts)
    alone = [
        fly_and_measure(p.config, [(p.follower, p.scenarios)], flying.ENGINE, p.radii, p.deadlines)[1] for p in parts
    ]
    for mine, other in zip(found, [one for flown in alone for one in flown], strict=True):
        for field in dataclasses.fields(mine):
            a, b = getattr(mine, field.name), getattr(other, field.name)
            assert a == b or a == pytest.approx(b, rel=1e-6, abs=1e-9), field.name  # rounding, in a closed loop


def test_plants_of_another_structure_fly_apart() -> None:
    configs = [preset("paper"), preset("team"), preset("flight"), preset("flight"), preset("transport")]
    assert sorted(flying.together(configs)) == [[0, 4], [1], [2], [3]]


def test_a_calm_flight_has_constant_errors_alone() -> None:
    scenario = in_calm(Scenario())
    assert scenario == Scenario(disturbance=Disturbance(offset=OFFSET))
    assert with_perfect_sensors(scenario) == Scenario()


def test_the_world_is_sampled_within_its_levels() -> None:
    config = preset("paper")
    random = np.random.default_rng(0)
    flown = [with_disturbances(Scenario(goal=(0.0, 0.0, -0.5)), config, random) for _ in range(2000)]
    levels = {
        "drag": [one.rotor_drag for one in flown],
        "wind": [float(np.hypot(*one.wind[:2])) for one in flown],
        "fade": [one.thrust_fade for one in flown],
        "download": [one.download for one in flown],
        "loops": [10.0 * one.loop_scale for one in flown],
        "clearance": [-0.5 - one.floor for one in flown if one.floor is not None],
    }
    for name, values in levels.items():
        low, high = getattr(OUTDOORS, name)
        assert low <= min(values) < low + 0.02 * (high - low), name
        assert high - 0.02 * (high - low) < max(values) <= high, name
    assert {round(one.disturbance.delay / 0.02) for one in flown} == {0, 1, 2, 3}
    assert len(levels["clearance"]) == pytest.approx(1000, abs=90)  # four deviations
    assert len({one.disturbance.gust_seed for one in flown}) > 1990
    small = with_disturbances(Scenario(goal=(0.0, 0.0, 0.1)), preset("flight"), random, CRAZYFLIE)
    assert small.loop_scale == 1.0
    assert small.disturbance.quantize
