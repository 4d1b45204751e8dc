"""What a reset draws from `config.scenario`: load, start and goal of one world."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjxball.config import Config
from mjxball.control.constants import plant_constants, trim_reach
from mjxball.physics.engine import Load, PlantState
from mjxball.physics.step import start_state

Array = Any
DRAWS = 18  # random numbers of a reset
DRAWN_BACK = 8  # times at most that a world's thrust is drawn back by three tenths
PLACES = 16  # that a CG visits, where it does, before it begins again


class Draws:
    """Worlds of `config.scenario`, whose CG swings no further than can be trimmed.

    `varies`: whether they have rotors or inertia of their own.
    """

    def __init__(self, config: Config):
        self.config = config
        scenario = config.scenario
        scales = (
            scenario.rotor_lag_scale,
            scenario.thrust_scale,
            scenario.thrust_common,
            scenario.inertia_scale,
        )
        self.varies = any(scale != (1.0, 1.0) for scale in scales)
        constants = plant_constants(config.plant, config.attitude)
        self._drones = np.asarray(config.plant.leader_inertia) + config.plant.follower_inertia
        self._object = constants.object_inertia_per_mass

    def draw(self, rng: Array, reach: Array | float = 1.0) -> tuple[Load, PlantState, Array]:
        """(load, plant at rest or nearly so, goal (3,) of O [m]).

        `reach` () in [0, 1]: the lower share of the ranges of the CG's amplitude and speed, which is drawn from.
        """
        scenario = self.config.scenario
        # One draw for everything: a reset runs beside every training step, and each draw is kernels to launch.
        drawn = iter(jnp.split(jax.random.uniform(rng, (DRAWS,)), DRAWS))

        def between(low: float, high: Array | float) -> Array:
            return low + (high - low) * next(drawn)[0]

        def symmetric(reach: float, size: int = 3) -> Array:
            return reach * (2.0 * jnp.concatenate([next(drawn) for _ in range(size)]) - 1.0)

        mass = between(*scenario.object_mass)
        nominal = jnp.full_like(mass, self.config.plant.object_mass)
        believed = mass if scenario.mass_known else nominal
        load = Load(
            object_mass=mass,
            believed_mass=believed,
            cg_amplitude=between(*shortened(scenario.cg_amplitude, reach)),
            cg_speed=between(*shortened(scenario.cg_speed, reach)),
            cg_phase=between(0.0, 2 * jnp.pi),
            mass_change=between(*scenario.mass_change)[None],
            mass_change_time=between(*scenario.mass_change_time)[None],
        )
        if self.varies:
            load = self._varied(load, jax.random.fold_in(rng, 2))
        if scenario.cg_visits > 0:
            load = self._visiting(load, jax.random.fold_in(rng, 3))
        load = load._replace(cg_amplitude=jnp.minimum(load.cg_amplitude, jnp.maximum(self.trimmed(load), 0.0)))
        plant = start_state(
            self.config,
            euler=jnp.append(symmetric(scenario.start_tilt, 2), 0.0),
            position=symmetric(scenario.start_position),
            velocity=symmetric(scenario.start_velocity),
            believed_mass=load.believed_mass,
            ball_offset=symmetric(scenario.ball_start, 1)[0],
        )
        return load, plant, symmetric(scenario.goal_reach)

    def trimmed(self, load: Load) -> Array:
        """CG amplitude that can be trimmed before and after the mass changes [m]; negative: none."""
        masses = (load.object_mass, load.object_mass + load.mass_change[0])
        margin, plant = self.config.scenario.trim_margin, self.config.plant
        thrust = (1.0, 1.0) if load.thrust_scale is None else (load.thrust_scale[0], load.thrust_scale[1])
        if self.config.leader.ki[2] > 0:  # it finds the thrust for its share of the weight by itself
            reaches = (trim_reach(plant, mass, margin, None, (1.0, thrust[1])) for mass in masses)
        else:
            reaches = (trim_reach(plant, mass, margin, load.believed_mass, thrust) for mass in masses)
        return jnp.minimum(*reaches)

    def _varied(self, load: Load, key: Array) -> Load:
        """`load` with rotors and inertia of its own."""
        scenario, share = self.config.scenario, jax.random.uniform(key, (5,))
        each = (scenario.thrust_scale, scenario.thrust_scale)
        ranges = (scenario.rotor_lag_scale, scenario.inertia_scale, *each, scenario.thrust_common)
        drawn = (low + (high - low) * u for (low, high), u in zip(ranges, share, strict=True))
        lag, inertia, leader, follower, common = drawn
        thrust = common * jnp.stack([leader, follower])
        own = jnp.asarray(self._drones) + jnp.asarray(self._object) * load.object_mass
        load = load._replace(
            rotor_lag_scale=lag, thrust_scale=thrust, added_inertia=((inertia - 1.0) * own).astype(own.dtype)
        )
        if scenario.thrust_scale == scenario.thrust_common == (1.0, 1.0):
            return load
        # A leader that lifts too little can leave more than any follower trims: its world is drawn back towards 1.
        for _ in range(DRAWN_BACK):
            scales: Array = load.thrust_scale
            milder = load._replace(thrust_scale=1.0 + 0.7 * (scales - 1.0))
            load = jax.tree.map(functools.partial(jnp.where, self.trimmed(load) < 0), milder, load)
        return load

    def _visiting(self, load: Load, key: Array) -> Load:
        """`load` whose CG perhaps goes from place to place."""
        path_key, key = jax.random.split(key)
        places = jax.random.uniform(path_key, (PLACES,), minval=-1.0, maxval=1.0)
        visits = jax.random.uniform(key) < self.config.scenario.cg_visits
        return load._replace(cg_path=places, cg_visits=visits.astype(jnp.float32))


def shortened(ends: tuple[float, float], share: Array | float) -> tuple[float, Array | float]:
    """The lower `share` () of the range between `ends`."""
    low, high = ends
    return low, high if isinstance(share, float) and share == 1.0 else low + share * (high - low)
