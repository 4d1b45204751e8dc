"""What a benchmark suite is made of: variants, each a scenario and the settings that differ from the reference."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mjxball import config as configs
from mjxball.config import Config
from mjxball.plant.teams import ring_config
from mjxball.sim.rigs import held_out, rig_config
from mjxball.sim.scenario import Scenario


@dataclass(frozen=True)
class Variant:
    """One case of a suite: a scenario, and the settings that differ from the reference."""

    label: str
    scenario: Scenario
    changes: Mapping[str, Any] = field(default_factory=dict)  # config path -> value
    waveform: Callable[[int], tuple[tuple[float, ...], ...]] | None = None  # seed -> times, offsets, offsets across
    team: str = ""  # preset whose plant it flies; empty: the command's
    drones: int = 0  # of a ring of that many; 0: the preset's plant
    rig: int | None = None  # number of a held-out rig of so many drones, in place of a ring
    # Of a team, settings that its followers are made for.
    design_settings: Mapping[str, Any] = field(default_factory=dict)
    scatter: float = 0.0  # of a team, every drone's numbers are drawn within this share of those that followers know

    @property
    def is_reference(self) -> bool:
        """Whether it is the reference scenario itself on the command's plant, which several suites have."""
        s, changed = self.scenario, bool(self.changes or self.waveform or self.team or self.scatter)
        return not changed and s.believed_mass in (None, s.mass) and s == Scenario(believed_mass=s.believed_mass)

    def nominal(self, base: Config) -> Config:
        """What its followers are made for: `base`, or a team of its own."""
        if not self.team:
            return base
        found = configs.preset(self.team)
        if self.rig is not None:
            found = rig_config(found, held_out(found, self.drones), self.rig)
        elif self.drones:
            found = ring_config(found, self.drones)
        for path, value in self.design_settings.items():
            found = configs.replace(found, path, value)
        return configs.validate(found)

    def config(self, base: Config, seed: int) -> Config:
        """The configuration of this variant for one seed; `base` is its `nominal` one."""
        for path, value in self.changes.items():
            base = configs.replace(base, path, value)
        if self.waveform:
            base = dataclasses.replace(base, motion=configs.Motion("waveform", *self.waveform(seed)))
        if self.scatter:
            base = dataclasses.replace(base, plant=_scattered(base.plant, self.scatter, seed))
        return configs.validate(base)

    def seeded(self, seed: int) -> Scenario:
        """The scenario of one seed. Seed 0 starts the CG at phase 0, the others at a place drawn from the seed."""
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
    axis: str  # what the variants' labels say
    variants: tuple[Variant, ...]


def _scattered(plant: configs.Plant, share: float, seed: int) -> configs.Plant:
    """`plant` whose drones differ in mass, inertia, mount, arm, rotors and lag by up to `share` of each number."""
    random, drones = np.random.default_rng([seed, 19]), []
    for number, drone in enumerate(plant.drones):

        def near(value: Any) -> Any:
            return tuple(map(near, value)) if isinstance(value, tuple) else value * random.uniform(1 - share, 1 + share)

        arm, force, lag, yaw = (
            near(plant.of_drones(name)[number]) for name in ("arm", "rotor_force_max", "rotor_lag", "yaw_per_thrust")
        )
        changed = {"mass": near(drone.mass), "inertia": near(drone.inertia), "mount": near(drone.mount)}
        rotors = {"arm": arm, "rotor_force_max": force, "rotor_lag": lag, "yaw_per_thrust": yaw}
        drones.append(dataclasses.replace(drone, **changed, **rotors))
    return dataclasses.replace(plant, drones=tuple(drones))
