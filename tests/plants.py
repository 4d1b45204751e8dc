"""Plants and random states that the physics tests share."""

from __future__ import annotations

import dataclasses

import numpy as np

from engines import random_team, reach
from mjxball.baselines import make_baseline
from mjxball.config import Config, Drone, Motion, Plant, preset
from mjxball.control.followers import Baseline
from mjxball.physics.engine import CgState, Wrench

team = random_team
REFERENCE = Plant()
# Nothing equal, nothing aligned: masses, inertias, mounts off the axis, another length and CG axis.
VARIED = Plant(
    drones=(
        Drone(mass=1.3, inertia=(2.0e-3, 3.1e-3, 4.2e-3), mount=(0.31, 0.02, 0.05)),
        Drone(mass=0.7, inertia=(1.1e-3, 2.3e-3, 3.4e-3), mount=(-0.19, -0.03, 0.04)),
    ),
    object_mass=0.35,
    object_size=(0.5, 0.12, 0.08),
    arm=0.09,
)
LIGHT_BALL = dataclasses.replace(VARIED, moving_fraction=0.4)
SIDEWAYS = dataclasses.replace(
    VARIED,
    cg_axis="y",
    object_size=(0.1, 0.44, 0.05),
    drones=(
        dataclasses.replace(VARIED.drones[0], mount=(0.02, 0.25, 0.05)),
        dataclasses.replace(VARIED.drones[1], mount=(-0.01, -0.18, 0.04)),
    ),
    moving_fraction=0.7,
)
PIVOT = dataclasses.replace(SIDEWAYS, stand="pivot")
HEAVE = dataclasses.replace(SIDEWAYS, stand="heave")
# The reference plant turned by 90 degrees onto the pivot: a level beam.
BEAM = Plant(
    stand="pivot",
    cg_axis="y",
    object_size=(0.1, 0.34, 0.05),
    drones=(Drone(mount=(0.0, 0.17, 0.0)), Drone(mount=(0.0, -0.17, 0.0))),
)
PLANTS = {
    "reference": REFERENCE,
    "varied": VARIED,
    "light_ball": LIGHT_BALL,
    "sideways": SIDEWAYS,
    "pivot": PIVOT,
    "heave": HEAVE,
}
SAMPLES = Motion(kind="waveform", times=(0.0, 2.0, 3.0, 7.0, 12.0, 19.0), offsets=(0.0, 0.05, -0.04, 0.06, -0.05, 0.0))
ROLLING = Motion(kind="rolling")


def random_motion(plant: Plant, count: int, random: np.random.Generator) -> CgState:
    """Offsets within the object, with any rate and acceleration."""
    places = (count,) if len(plant.directions) == 1 else (count, 2)
    most = plant.moving_fraction * reach(plant)
    return CgState(random.uniform(-most, most, places), *random.normal(size=(2, *places)))


def random_wrench(count: int, random: np.random.Generator) -> Wrench:
    """Thrust along body z, any torque."""
    return Wrench(random.uniform(0, 40, (count, 1)) * [0, 0, 1], random.normal(size=(count, 3)))


def paper_with(plant: Plant = REFERENCE, motion: Motion | None = None):
    """The paper's configuration on another plant or with another motion."""
    return dataclasses.replace(preset("paper"), plant=plant, motion=motion or Motion())


def copying(config: Config) -> Baseline:
    """The follower that copies its leader."""
    return make_baseline("copy", config)
