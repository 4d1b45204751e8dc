"""What is drawn of the load follows from the plant, unless the user says otherwise."""

from __future__ import annotations

from collections.abc import Collection

from mjxball.config._plant import Plant
from mjxball.config._settings import Config
from mjxball.config._tree import leaves, replace
from mjxball.config._validate import ball_limit, cg_limit

# In proportion to the object's mass.
MASSES = (
    "scenario.object_mass",
    "scenario.unknown_mass",
    "scenario.mass_change",
    "attitude.design_object_mass",
)


def follow_plant(config: Config, before: Plant, said: Collection[str]) -> Config:
    """`config`, whose plant was `before`, with the load of its own plant; what the user has `said` (paths) stays.

    Masses keep their proportion to `plant.object_mass`. The CG's amplitude and the ball's start are cut to the object.
    """
    factor = config.plant.object_mass / before.object_mass
    known = {path: value for path, value, _ in leaves(config)}
    for path in MASSES if factor != 1 else ():
        if path not in said:
            value = known[path]
            scaled = tuple(factor * one for one in value) if isinstance(value, tuple) else factor * value
            config = replace(config, path, scaled)
    if config.plant == before:
        return config
    if "scenario.cg_amplitude" not in said:
        low, high = (min(one, cg_limit(config.plant)) for one in config.scenario.cg_amplitude)
        config = replace(config, "scenario.cg_amplitude", (low, high))
    if "scenario.ball_start" not in said:
        config = replace(config, "scenario.ball_start", min(config.scenario.ball_start, ball_limit(config.plant)))
    return config
