"""Suites: variants of the pair's reference flight, each suite along one axis of difficulty."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mjxball import config as configs
from mjxball.config import Config
from mjxball.sim.disturbances import Disturbance
from mjxball.sim.scenario import Scenario


@dataclass(frozen=True)
class Variant:
    """One case of a suite: a scenario, and the settings that differ from the reference configuration."""

    label: str
    scenario: Scenario
    changes: Mapping[str, Any] = field(default_factory=dict)  # config path -> value
    waveform: Callable[[int], tuple[tuple[float, ...], ...]] | None = None  # seed -> times, offsets

    @property
    def is_reference(self) -> bool:
        """Whether it is the reference scenario, which several suites contain."""
        s, changed = self.scenario, bool(self.changes or self.waveform)
        return not changed and s.believed_mass in (None, s.mass) and s == Scenario(believed_mass=s.believed_mass)

    def config(self, base: Config, seed: int) -> Config:
        """The configuration of this variant for one seed; followers are made for `base`."""
        for path, value in self.changes.items():
            base = configs.replace(base, path, value)
        if self.waveform:
            base = dataclasses.replace(base, motion=configs.Motion("waveform", *self.waveform(seed)))
        return configs.validate(base)

    def seeded(self, seed: int) -> Scenario:
        """The scenario of one seed. Seed 0 starts the CG at phase 0, other seeds at a random phase."""
        random = np.random.default_rng([seed, 7])
        phase = 0.0 if seed == 0 else float(random.uniform(0, 2 * np.pi))
        # A rolling ball has no phase: it starts on either side, up to 30 % nearer to O.
        start = self.scenario.ball_start * (
            1.0 if seed == 0 else float(random.choice([-1, 1]) * random.uniform(0.7, 1))
        )
        disturbance = dataclasses.replace(self.scenario.disturbance, seed=seed)
        return dataclasses.replace(self.scenario, phase=phase, ball_start=start, disturbance=disturbance)


@dataclass(frozen=True)
class Suite:
    """Variants along one axis of difficulty."""

    name: str
    about: str
    axis: str  # quantity that the variants' labels name
    variants: tuple[Variant, ...]


WALK_STEP, WALK_SIGMA = 0.5, 0.03  # of a random walk: time between samples [s], deviation after 1 s [m]


def _steps(seed: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Times [s] and offsets [m]: every 5 s the CG jumps within 0.3 s to a random place up to 5 cm from O."""
    random = np.random.default_rng([seed, 11])
    places = [0.0, *random.uniform(-0.05, 0.05, 8)]
    times, offsets = [], []
    for number, place in enumerate(places):
        begin = 5.0 * number + (0.3 if number else 0.0)
        times += [begin, 5.0 * number + 2.5, 5.0 * number + 5.0]
        offsets += [place] * 3
    return tuple(times), tuple(map(float, offsets))


def _walk(seed: int) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Times [s] and offsets [m] of a random walk within 10 cm of O."""
    random = np.random.default_rng([seed, 13])
    times = np.arange(0.0, 45.0 + WALK_STEP, WALK_STEP)
    offsets = np.zeros_like(times)
    for number, move in enumerate(random.normal(0.0, WALK_SIGMA * np.sqrt(WALK_STEP), len(times) - 1)):
        offsets[number + 1] = np.clip(offsets[number] + move, -0.1, 0.1)
    return tuple(map(float, times)), tuple(map(float, offsets))


def _variants(name: str, values: tuple[Any, ...], unit: str = "", **common: Any) -> tuple[Variant, ...]:
    return tuple(Variant(f"{value:g}{unit}", Scenario(**{name: value}, **common)) for value in values)


def _disturbed(name: str, values: tuple[Any, ...], unit: str = "") -> tuple[Variant, ...]:
    return tuple(Variant(f"{v * (1e3 if unit == ' ms' else 1):g}{unit}", _with(**{name: v})) for v in values)


def _with(**disturbance: Any) -> Scenario:
    return Scenario(disturbance=Disturbance(**disturbance))


SPEEDS = (0.31, 0.62, 1.0, 2.0, 3.1)
MASSES = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
GRID = "speed-mass"  # drawn as heat maps
SUITES: tuple[Suite, ...] = (
    Suite("cg-speed", "the CG moves as a sine of 5 cm", "CG speed [rad/s]", _variants("omega", SPEEDS)),
    Suite(
        "cg-amplitude",
        "further, up to a drone's own centre",
        "amplitude",
        _variants("amplitude", (0.05, 0.1, 0.17), " m"),
    ),
    Suite("mass-known", "the hover thrust knows the object's mass", "object mass", _variants("mass", MASSES, " kg")),
    Suite(
        GRID,
        "every CG speed with every object mass, known to the hover thrust",
        "CG speed, mass",
        tuple(Variant(f"{w:g} rad/s, {m:g} kg", Scenario(omega=w, mass=m)) for w in SPEEDS for m in MASSES),
    ),
    Suite(
        "mass-unknown",
        "the hover thrust believes 0.2 kg",
        "object mass",
        _variants("mass", (0.1, 0.2, 0.3, 0.4), " kg", believed_mass=0.2),
    ),
    Suite(
        "mass-change",
        "mass is added to or dropped from the object in flight, unannounced",
        "change",
        (
            Variant("+0.1 kg at 15 s", Scenario(mass_changes=((15.0, 0.1),))),
            Variant("-0.1 kg at 15 s", Scenario(mass_changes=((15.0, -0.1),))),
            Variant("+0.1 kg at 12 s, -0.1 kg at 24 s", Scenario(mass_changes=((12.0, 0.1), (24.0, -0.1)))),
        ),
    ),
    Suite(
        "waveform",
        "the CG moves as no sine does",
        "motion",
        (
            Variant("a jump every 5 s", Scenario(), waveform=_steps),
            Variant("random walk", Scenario(), waveform=_walk),
        ),
    ),
    Suite(
        "rolling-ball",
        "the object is a ball that rolls freely between end stops",
        "start",
        tuple(
            Variant(f"{100 * start:g} cm", Scenario(ball_start=start), {"motion.kind": "rolling"})
            for start in (0.05, 0.1)
        ),
    ),
    Suite("noise", "the follower's measurements are noisy", "noise level", _disturbed("noise", (0.5, 1.0, 2.0))),
    Suite(
        "leader",
        "the leader has other gains than the follower was made for",
        "leader",
        (
            Variant("kp 0.3", Scenario(), {"leader.kp": (0.3, 0.3, 0.3)}),
            Variant("kp 0.8", Scenario(), {"leader.kp": (0.8, 0.8, 0.8)}),
            Variant("kd 0.7", Scenario(), {"leader.kd": (0.7, 0.7, 0.7)}),
            Variant("kd 1.5", Scenario(), {"leader.kd": (1.5, 1.5, 1.5)}),
            Variant("kI 0.05", Scenario(), {"leader.ki": (0.05, 0.05, 0.05)}),
        ),
    ),
    Suite("delay", "the follower's measurements are late", "delay", _disturbed("delay", (0.02, 0.04, 0.06), " ms")),
    Suite(
        "rotor-lag",
        "rotors faster or slower than 30 ms",
        "lag",
        tuple(Variant(f"{1e3 * lag:g} ms", Scenario(), {"plant.rotor_lag": lag}) for lag in (0.015, 0.045, 0.06)),
    ),
    Suite(
        "gusts", "a random force on the object, correlated over 1 s", "rms", _disturbed("gust", (0.1, 0.3, 0.6), " N")
    ),
    Suite(
        "waypoints",
        "three goals in a row",
        "route",
        (
            Variant(
                "a triangle",
                Scenario(goal=(1, 0, 1), waypoints=((15.0, (1.0, 1.0, 1.0)), (30.0, (0.0, 0.0, 1.0)))),
            ),
        ),
    ),
    Suite(
        "start-errors",
        "tilted, moving or far away at the start",
        "start",
        (
            Variant("tilted 10 deg", Scenario(start_tilt=(0.17, -0.17))),
            Variant("moving 0.5 m/s", Scenario(start_velocity=(0.3, -0.3, 0.26))),
            Variant("0.5 m further", Scenario(start_position=(-0.3, -0.3, -0.26))),
        ),
    ),
)
BY_NAME = {suite.name: suite for suite in SUITES}


def list_suites() -> str:
    """Text with one line for each suite and one for its variants."""
    return "\n".join(
        f"{suite.name}: {suite.about}\n    {suite.axis}: {'; '.join(variant.label for variant in suite.variants)}"
        for suite in SUITES
    )
