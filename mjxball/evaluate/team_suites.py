"""Suites of the benchmark for teams, whose plants are their own."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from mjxball import config as configs
from mjxball.evaluate.variants import Suite, Variant
from mjxball.plant.teams import ring_config
from mjxball.sim.disturbances import Disturbance
from mjxball.sim.rigs import held_out
from mjxball.sim.scenario import CIRCLE, CgPath, Scenario

TEAM_SIZES = (2, 3, 4, 5, 6)
EIGHT = CgPath(direction=0.7, width=0.5, ratio=2.0, lead=0.3)


def _places(seed: int) -> tuple[tuple[float, ...], ...]:
    """The CG goes to a place within 7 cm of O in the plane and stays, every 3 s."""
    random, times = np.random.default_rng([seed, 17]), []
    radius, angle = 0.07 * np.sqrt(random.random(15)), 2 * np.pi * random.random(15)
    places = np.insert(radius * np.exp(1j * angle), 0, 0.0)
    for number in range(len(places)):
        times += [3.0 * number + (1.0 if number else 0.0), 3.0 * number + 2.0, 3.0 * number + 3.0]
    offsets = np.repeat(places, 3)
    return tuple(times), tuple(map(float, offsets.real)), tuple(map(float, offsets.imag))


def _ring(drones: int, omega: float = 1.0, share: float = 0.3, **more: Any) -> Scenario:
    """The nominal load of a ring of that many drones on a circle of `share` of its radius."""
    own = ring_config(configs.preset("team"), drones).plant
    radius = own.object_size[0] / 2
    return Scenario(**{"omega": omega, "amplitude": share * radius, "mass": own.object_mass, "path": CIRCLE, **more})


def _on_rig(size: int, number: int) -> Variant:
    """A held-out rig whose load goes round at 70 % of where it can be trimmed, its mass unknown; noise and delay."""
    rigs = held_out(configs.preset("universal"), size)
    scenario = Scenario(
        omega=1.0,
        amplitude=0.7 * float(rigs.reach[number]),
        mass=float(rigs.object_mass[number]),
        believed_mass=float(rigs.believed_mass[number]),
        path=CIRCLE,
        thrust=tuple(map(float, rigs.thrust[number])),
        disturbance=Disturbance(noise=1.0, delay=0.02),
    )
    return Variant(f"{size} drones, rig {number}", scenario, team="universal", drones=size, rig=number)


TEAM_SUITES: tuple[Suite, ...] = (
    Suite(
        "team-size",
        "the load goes round on rings of two to six drones; nobody trains with five",
        "drones",
        tuple(Variant(f"{n} drones", _ring(n), team="team", drones=n) for n in TEAM_SIZES),
    ),
    Suite(
        "team-path",
        "four drones, and a load that moves in the plane on other paths",
        "path",
        (
            *(Variant(f"circle, {w:g} rad/s", _ring(4, w), team="team", drones=4) for w in (0.31, 2.0, 3.1)),
            Variant("ellipse", _ring(4, path=dataclasses.replace(CIRCLE, width=0.4)), team="team", drones=4),
            Variant("Lissajous", _ring(4, path=EIGHT), team="team", drones=4),
            Variant("visits of random places", _ring(4), waveform=_places, team="team", drones=4),
        ),
    ),
    Suite(
        "team-weak",
        "of four drones the follower opposite to the leader gives less thrust than it is asked for",
        "its thrust",
        tuple(Variant(f"{x:g}", _ring(4, thrust=(1.0, 1.0, x, 1.0)), team="team", drones=4) for x in (0.95, 0.9, 0.8)),
    ),
    Suite(
        "team-lost",
        "of six drones, commanded up to 12 m/s2, the rotors of one follower stop after 10 s",
        "which",
        tuple(
            Variant(
                name,
                _ring(6, share=0.15, lost=((k, 10.0),)),
                team="team",
                drones=6,
                design_settings={"command.vertical_limit": 12.0},
            )
            for name, k in (("next to the leader", 1), ("next but one", 2), ("opposite", 3))
        ),
    ),
    Suite(
        "team-rig",
        "four drones no two of which are alike: mass, inertia, mount, arm, rotors and lag of each are drawn",
        "within",
        tuple(Variant(f"{100 * x:g} %", _ring(4), team="team", drones=4, scatter=x) for x in (0.05, 0.1, 0.2)),
    ),
    Suite(
        "rigs",
        "random rigs of all sizes that nobody trains with, mass and thrusts unknown, noise and 20 ms of delay",
        "rig",
        tuple(_on_rig(size, number) for size in TEAM_SIZES for number in (0, 1)),
    ),
)
