"""Batches that keep only metrics give what recorded flights give."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from tables import weekly

from batch import fly_compiled
from mjxball.baselines import CONTROLLERS, make_baseline
from mjxball.config import preset
from mjxball.errors import InputError
from mjxball.evaluate.results import fly_scenarios
from mjxball.policy import Policy
from mjxball.policy.file import shipped_policy
from mjxball.sim.disturbances import Disturbance
from mjxball.sim.scenario import Scenario

CONFIG = preset("paper")
SECONDS = 22.0
SCENARIOS = [
    Scenario(seconds=SECONDS),
    Scenario(omega=2.0, amplitude=0.1, mass=0.3, believed_mass=0.2, goal=(-1, 0.5, 0), seconds=SECONDS),
    Scenario(mass_changes=((5.0, 0.1),), start_tilt=(0.1, 0.0), waypoints=((8.0, (0.0, 0.0, 1.0)),), seconds=SECONDS),
    Scenario(disturbance=Disturbance(noise=0.5, gust=0.2, seed=1), seconds=SECONDS),
    Scenario(
        loop_scale=1.4,
        rotor_drag=0.3,
        wind=(1.0, -1.0, 0.0),
        floor=-0.2,
        download=0.1,
        thrust_fade=1e-3,
        seconds=SECONDS,
    ),
    Scenario(disturbance=Disturbance(delay=0.04, gap_rate=0.5, jitter=0.01, offset=1.0, seed=2), seconds=SECONDS),
]


@pytest.mark.parametrize(
    "name",
    [
        "copy",
        pytest.param("balance-sac", marks=pytest.mark.slow),  # `balance` circles, and float32 comes to circle elsewhere
        *weekly("adaptive-mass", "lqg", "oracle"),
    ],
)
def test_batch_equals_recorded_flights(name: str) -> None:
    follower = make_baseline(name, CONFIG) if name in CONTROLLERS else Policy.load(shipped_policy(name))
    batched = fly_compiled(CONFIG, follower, SCENARIOS)
    recorded = [cell.metrics for cell in fly_scenarios(CONFIG, [follower], SCENARIOS, "newton-euler")]
    for mine, other in zip(batched, recorded, strict=True):
        for field in dataclasses.fields(mine):
            a, b = getattr(mine, field.name), getattr(other, field.name)
            if a is None or b is None or isinstance(a, bool):
                assert a == b, field.name
            elif field.name.startswith("settling"):
                assert a == pytest.approx(b, abs=0.05), field.name  # a sample or two at the threshold
            else:
                # Float32 against float64 through a closed loop of 1100 steps, 1e-4 of the numbers' size.
                # Saturation counts samples at a threshold: one rotor and step of 1101 x 4 is 2.3e-4.
                slack = 1e-3 if field.name in ("saturation", "rotors_at_limit") else 2e-4
                assert a == pytest.approx(b, rel=2e-3, abs=slack), field.name


def test_what_a_batch_cannot_fly_is_refused() -> None:
    class Mine:
        name = "mine"

    copying = make_baseline("copy", CONFIG)
    with pytest.raises(InputError, match="mujoco"):
        fly_compiled(CONFIG, copying, SCENARIOS, "mujoco")
    with pytest.raises(InputError, match="no baseline and no policy"):
        fly_compiled(CONFIG, Mine(), SCENARIOS)
    with pytest.raises(InputError, match="equally long"):
        fly_compiled(CONFIG, copying, [Scenario(seconds=1), Scenario(seconds=2)])
    with pytest.raises(InputError, match="finite"):
        fly_compiled(CONFIG, copying, [Scenario(omega=np.inf)])
