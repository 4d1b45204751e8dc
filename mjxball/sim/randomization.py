"""What a reset draws from `config.scenario`: load, start and goal of one world."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjxball.config import Config, cg_limit
from mjxball.control import crazyflie, motors
from mjxball.control.constants import trim_limit
from mjxball.physics.engine import Load, PathShape, PlantState
from mjxball.physics.step import start_state
from mjxball.plant import PlantParameters, plant_parameters, teams
from mjxball.plant.trim import safe_radius
from mjxball.sim import rigs

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

    from mjxball.arrays import Array
    from mjxball.physics.engine import Scalar, Vector


DRAWS = 18  # random numbers of a reset
COMMAND_SHARE = 0.85  # share of the leader's vertical limit that a hover may take
CANDIDATES = 8  # drives (battery, thrust of each drone) from which a world takes the first that can be flown
LIFT, PULL = 0.06, 0.05  # shares of its weight that every drone must lift more, at most 60 000 units and at full power
DRAWN_BACK = 8  # times at most that a world's thrust is drawn back by three tenths
CEILING = float(crazyflie.THRUST_CEILING)
MASS_CHANGE_TIME = (5.0, 15.0)  # [s]
LOSS_TIME = (3.0, 15.0)  # [s]
LISSAJOUS = 0.3  # probability that the CG's second sine is twice as fast, where it has one
PLACES = 16  # random waypoints of a CG before it begins again


class Rig(NamedTuple):
    """What a world's own rig is."""

    numbers: PlantParameters  # padded to the plant's drones
    flies: Float[Array, " drones"]  # 1 for a drone that there is, 0 for one that pads
    proportion: Scalar  # its radius over the plant's, by which CG amplitudes are multiplied
    size_ratio: Scalar  # its number of drones over the plant's, by which the object's mass is multiplied
    drawn: rigs.RigTable | None = None  # the row of a random rig, whose load is its own


class ResetDistribution:
    """Worlds of `config.scenario`, whose CG swings no further than can be trimmed.

    `varies`: whether they have rotors or inertia of their own; `rigs`: whether each has a whole rig of its own.
    """

    def __init__(self, config: Config):
        self.config = config
        scenario = config.scenario
        scales = (
            scenario.rotor_lag_scale,
            scenario.thrust_scale,
            scenario.thrust_scale_common,
            scenario.inertia_scale,
        )
        self.varies = any(scale != (1.0, 1.0) for scale in scales)
        self.has_battery = scenario.battery[1] > 0
        plant, self._ranges = config.plant, [getattr(scenario, name) for name in teams.Factors._fields]
        self.rigs = bool(scenario.team_sizes or config.rigs.number) or any(ends != (1.0, 1.0) for ends in self._ranges)
        self._in_plane, self._several = len(plant.directions) == 2, plant.count > 2
        sizes = scenario.team_sizes or (plant.count,)
        self._sizes = np.array(sizes)
        self._table = teams.table(config) if scenario.team_sizes and not config.rigs.number else None
        self._drawn = rigs.training_rigs(config) if config.rigs.number and scenario.team_sizes else None
        self._constants = constants = plant_parameters(config.plant, config.attitude)
        self._motor = motors.MOTORS[config.autopilot.drone or "2.1"]
        self._lever = 2 * min(map(abs, constants.mounts[:, plant.directions[0]]))
        self._levels = config.follower.residual_on_pid and config.leader.tilt_integral_gain > 0
        self._held_with_loss = teams.amplitudes_with_loss(config) if scenario.lost_follower_probability > 0 else None
        self._drones = constants.own_inertia.sum(axis=0)
        self._object = constants.object_inertia_per_mass

    def draw(
        self,
        rng: Array,
        number: Int[Array, ""] | None = None,
        chosen: rigs.RigTable | None = None,
    ) -> tuple[Load, PlantState, Vector, Rig | None]:
        """(load, plant at rest or nearly so, goal (3,) of O [m], the world's own rig if it has one).

        `number` of the world, of which its team's size follows; None: any of `scenario.team_sizes`. `chosen`: its rig.
        """
        scenario = self.config.scenario
        rig = self._rig(jax.random.fold_in(rng, 6), number) if self.rigs and chosen is None else None
        rig = rig if chosen is None else self._drawn_rig(chosen)
        # One draw for everything: a reset runs beside every training step, and each draw is kernels to launch.
        drawn = iter(jnp.split(jax.random.uniform(rng, (DRAWS,)), DRAWS))

        def between(low: float, high: Scalar | float) -> Scalar:
            return low + (high - low) * next(drawn)[0]

        def symmetric(limit: float, size: int = 3) -> Float[Array, " size"]:
            return limit * (2.0 * jnp.concatenate([next(drawn) for _ in range(size)]) - 1.0)

        mass = between(*scenario.object_mass)
        nominal = jnp.full_like(mass, self.config.plant.object_mass)
        if rig is not None:
            mass, nominal = mass * rig.size_ratio, nominal * rig.size_ratio
        believed = mass if scenario.mass_known else nominal
        if scenario.unknown_mass_probability > 0:
            share, place = jax.random.uniform(jax.random.fold_in(rng, 7), (2,))
            low, high = scenario.unknown_mass
            unknown = share < scenario.unknown_mass_probability
            proportion: Scalar | float = 1.0 if rig is None else rig.size_ratio
            mass = jnp.where(unknown, proportion * (low + (high - low) * place), mass)
            believed = jnp.where(unknown, nominal, believed)
        load = Load(
            object_mass=mass,
            believed_mass=believed,
            cg_amplitude=between(*scenario.cg_amplitude),
            cg_speed=between(*scenario.cg_speed),
            cg_phase=between(0.0, 2 * jnp.pi),
            mass_change=between(*scenario.mass_change)[None],
            mass_change_time=between(*MASS_CHANGE_TIME)[None],
        )
        if rig is not None and rig.drawn is not None:
            load = self._of_rig(load, rig, jax.random.fold_in(rng, 13))
        if self.varies:
            load = self._varied(load, jax.random.fold_in(rng, 2))
        if self.has_battery:
            load = self._with_battery(load, jax.random.fold_in(rng, 4))
        if scenario.cg_waypoint_probability > 0:
            load = self._with_waypoints(load, jax.random.fold_in(rng, 3))
        if self._in_plane:
            load = self._in_the_plane(load, jax.random.fold_in(rng, 12), rig)
        else:
            load = load._replace(cg_amplitude=jnp.minimum(load.cg_amplitude, jnp.maximum(self.trimmed(load, rig), 0.0)))
        if scenario.lost_follower_probability > 0:
            load = self._losing(load, jax.random.fold_in(rng, 8), rig)
        plant = start_state(
            self.config,
            euler=jnp.append(symmetric(scenario.start_tilt, 2), 0.0),
            position=symmetric(scenario.start_position),
            velocity=symmetric(scenario.start_velocity),
            believed_mass=load.believed_mass,
            ball_offset=(self._direction(rng, 9) if self._in_plane else 1.0) * symmetric(scenario.ball_start, 1)[0],
            parameters=None if rig is None else rig.numbers,
        )
        return load, plant, symmetric(scenario.goal_range), rig

    def _of_rig(self, load: Load, rig: Rig, key: Array) -> Load:
        """`load` with the masses, thrusts and reach of the drawn `rig`."""
        own: Any = rig.drawn
        far, stepped = jax.random.uniform(key, (2,))
        load = load._replace(object_mass=own.object_mass, believed_mass=own.believed_mass, thrust_scale=own.thrust)
        change = self.config.rigs.mass_step * (2 * stepped - 1) * own.object_mass
        told = (own.believed_mass, own.thrust, self.config.scenario.trim_margin, *rigs.command_limits(self.config))
        later = rigs.trimmed_reach(rig.numbers, own.object_mass + change, *told)
        change = jnp.where(later < 0, 0.0, change)
        reach = jnp.where(later < 0, own.reach, jnp.minimum(own.reach, later))
        return load._replace(
            cg_amplitude=far * reach,
            mass_change=change[None],
            thrust_fade=own.thrust_fade,
        )

    def trimmed(self, load: Load, rig: Rig | None = None) -> Scalar:
        """CG amplitude that can be trimmed before and after the mass changes [m]; negative: none."""
        if rig is not None and rig.drawn is not None:  # the amplitude was drawn so
            return load.cg_amplitude
        masses = (load.object_mass, load.object_mass + load.mass_change[0])
        if self._several or self._in_plane or rig is not None:
            numbers, leader = (self._constants if rig is None else rig.numbers), self.config.plant.leader
            told = (self.config.scenario.trim_margin, load.believed_mass, load.thrust_scale)
            rotors = jnp.minimum(*(safe_radius(numbers, leader, mass, *told) for mass in masses))
            return jnp.minimum(rotors, self._commanded_radius(numbers, jnp.maximum(*masses)))
        if self.has_battery:
            return jnp.minimum(*(self._battery_trim_limit(load, mass) for mass in masses))
        margin, plant = self.config.scenario.trim_margin, self.config.plant
        thrust = (1.0, 1.0) if load.thrust_scale is None else (load.thrust_scale[0], load.thrust_scale[1])
        if self.config.leader.ki[2] > 0:  # it finds the thrust for its share of the weight by itself
            limits = (trim_limit(plant, mass, margin, None, (1.0, thrust[1])) for mass in masses)
        else:
            limits = (trim_limit(plant, mass, margin, load.believed_mass, thrust) for mass in masses)
        return jnp.minimum(*limits)

    def _commanded_radius(self, numbers: PlantParameters, object_mass: Scalar) -> Scalar:
        """Distance of the CG from O that the followers' tilt commands hold, with their share, `trim_margin` left [m].

        Small teams are light about the axis through their drones, and their attitude gains with it.
        """
        margin, tilt = self.config.scenario.trim_margin, self.config.follower.action_scale_tilt
        flying = (jnp.asarray(numbers.drone_mass) > 0).sum() - 1
        gain = jnp.min(jnp.asarray(numbers.gains.kp)[..., :2], axis=-1)
        return (1 - margin) * flying * gain * tilt / (numbers.gravity * object_mass)

    def _varied(self, load: Load, key: Array) -> Load:
        """`load` with rotors and inertia of its own."""
        scenario, count = self.config.scenario, self.config.plant.count
        share = jax.random.uniform(key, (3 + count,))
        each = (scenario.thrust_scale,) * count
        ranges = (scenario.rotor_lag_scale, scenario.inertia_scale, *each, scenario.thrust_scale_common)
        drawn = (low + (high - low) * u for (low, high), u in zip(ranges, share, strict=True))
        lag, inertia, *apart, common = drawn
        thrust = common * jnp.stack(apart)
        own = jnp.asarray(self._drones) + jnp.asarray(self._object) * load.object_mass
        load = load._replace(
            rotor_lag_scale=lag, thrust_scale=thrust, added_inertia=((inertia - 1.0) * own).astype(own.dtype)
        )
        if self.has_battery or self._several or scenario.thrust_scale == scenario.thrust_scale_common == (1.0, 1.0):
            return load
        # A leader that lifts too little can leave more than any follower trims: its world is drawn back towards 1.
        for _ in range(DRAWN_BACK):
            scales: Array = load.thrust_scale
            milder = load._replace(thrust_scale=1.0 + 0.7 * (scales - 1.0))
            load = jax.tree.map(functools.partial(jnp.where, self.trimmed(load) < 0), milder, load)
        return load

    def _rig(self, key: Array, number: Int[Array, ""] | None) -> Rig:
        """A rig of the size that follows from the world's `number`, with its factors."""
        plant, attitude = self.config.plant, self.config.attitude
        index = jax.random.randint(jax.random.fold_in(key, 1), (), 0, len(self._sizes)) if number is None else number
        index = index % len(self._sizes)
        if self._drawn is not None:
            return self._one_of_drawn(jax.random.fold_in(key, 2), index)
        numbers = jax.tree.map(jnp.float32, self._constants)
        size = jnp.asarray(self._sizes, jnp.float32)[index]
        if self._table is not None:
            numbers = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32)[index], self._table)
        share, drawn = size / plant.count, jax.random.uniform(key, (len(self._ranges),))
        factors = teams.Factors(*(low + (high - low) * u for (low, high), u in zip(self._ranges, drawn, strict=True)))
        numbers = teams.varied(numbers, factors, attitude, share * attitude.design_object_mass)
        flies = (jnp.arange(plant.count) < size).astype(jnp.float32)
        return Rig(numbers, flies, numbers.ball_limit / self._constants.ball_limit, share)

    def _one_of_drawn(self, key: Array, index: Int[Array, ""]) -> Rig:
        """Any of the drawn rigs of the size `index`."""
        number = jax.random.randint(key, (), 0, self.config.rigs.number)
        return self._drawn_rig(jax.tree.map(lambda part: jnp.asarray(part, jnp.float32)[index, number], self._drawn))

    def _drawn_rig(self, own: rigs.RigTable) -> Rig:
        flies = (jnp.arange(self.config.plant.count) < own.size).astype(jnp.float32)
        one = jnp.ones(())
        return Rig(rigs.whole(own.numbers, self.config.plant.gravity), flies, one, one, own)

    def _in_the_plane(self, load: Load, key: Array, rig: Rig | None) -> Load:
        """`load` whose CG goes along a path of its own in the plane, within the carrier and what can be trimmed."""
        scenario = self.config.scenario
        turn, wide, late, kind = jax.random.uniform(key, (4,))
        low, high = scenario.cg_width
        ratio = jnp.where(kind < (LISSAJOUS if high > 0 else 0.0), 2.0, 1.0)
        shape = PathShape(2 * jnp.pi * turn, low + (high - low) * wide, ratio, 2 * jnp.pi * late)
        # Of an ellipse the longer half axis, of a Lissajous curve no more than the corner of its box.
        w, across = shape.width**2, jnp.cos(2 * shape.lead)
        ellipse = (1 + w + jnp.sqrt(jnp.maximum(1 + w * w + 2 * w * across, 0.0))) / 2
        longest = jnp.sqrt(jnp.where(ratio > 1, 1 + w, ellipse))
        if load.follows_path is not None:
            longest = jnp.where(load.follows_path > 0, 1.0, longest)
        proportion: Scalar | float = 1.0 if rig is None else rig.proportion
        limit = jnp.maximum(self.trimmed(load, rig), 0.0)
        if rig is None or rig.drawn is None:
            limit = jnp.minimum(cg_limit(self.config.plant) * proportion, limit)
        return load._replace(cg_amplitude=jnp.minimum(load.cg_amplitude * proportion, limit / longest), cg_shape=shape)

    def _losing(self, load: Load, key: Array, rig: Rig | None) -> Load:
        """`load` in whose flight perhaps the rotors of one follower stop, its CG within what the others can trim.

        None stops where no place of the CG can be trimmed then, unless `trim_margin` is negative; there the CG stays.
        """
        followers, scenario = np.array(self.config.plant.followers), self.config.scenario
        masses, table = self._held_with_loss  # type: ignore[misc]
        lost, which, when = jax.random.uniform(key, (3,))
        there = len(followers) if rig is None else rig.flies[followers].sum()
        chosen = jnp.asarray(followers)[jnp.floor(which * there).astype(jnp.int32)]
        size = 0 if rig is None or self._table is None else jnp.argmin(jnp.abs(self._sizes - rig.flies.sum()))
        share, wide = (1.0, 1.0) if rig is None else (rig.size_ratio, rig.proportion)
        held = jnp.interp(load.object_mass / share, masses, jnp.asarray(table)[size, chosen]) * wide
        happens = (lost < scenario.lost_follower_probability) & ((held > 0) | (scenario.trim_margin < 0))
        low, high = LOSS_TIME
        stops = (jnp.arange(self.config.plant.count) == chosen) & happens
        return load._replace(
            stop_time=jnp.where(stops, low + (high - low) * when, jnp.inf),
            cg_amplitude=jnp.where(happens, jnp.clip(held, 0.0, load.cg_amplitude), load.cg_amplitude),
        )

    def _direction(self, rng: Array, stream: int) -> Float[Array, "2"]:
        """Any direction in the plane."""
        angle = 2 * jnp.pi * jax.random.uniform(jax.random.fold_in(rng, stream))
        return jnp.stack([jnp.cos(angle), jnp.sin(angle)])

    def _battery_trim_limit(self, load: Load, mass: Scalar) -> Scalar:
        """As `trimmed` for drones that can be flown: one's rotors, and what one lifts more and the other less."""
        plant = self.config.plant
        weakest = 1.0 if load.thrust_scale is None else jnp.minimum(load.thrust_scale[0], load.thrust_scale[1])
        apart = LIFT * (sum(drone.mass for drone in plant.drones) + mass) * self._lever if self._levels else 0.0
        return trim_limit(plant, mass, self.config.scenario.trim_margin, None, (1.0, weakest)) + apart / mass

    def draw_battery_and_thrust(
        self, load: Load, key: Array, count: int = CANDIDATES
    ) -> tuple[Float[Array, " count"], Float[Array, " count"], Float[Array, "count 2"], Bool[Array, " count"]]:
        """(battery [V], 1 for an older firmware, thrust factors (.., 2), whether it can be flown), (count,) of each."""
        scenario, share = self.config.scenario, jax.random.uniform(key, (5, count))
        each = (scenario.thrust_scale, scenario.thrust_scale)
        ranges = (scenario.battery, *each, scenario.thrust_scale_common)
        battery, leader, follower, common = (
            low + (high - low) * u for (low, high), u in zip(ranges, share[:4], strict=True)
        )
        uncompensated = (share[4] < scenario.uncompensated_probability).astype(battery.dtype)
        scale = (common * jnp.stack([leader, follower])).T
        return battery, uncompensated, scale, self.flyable(load.object_mass, battery, uncompensated, scale)

    def flyable(
        self,
        object_mass: Scalar,
        battery: Float[Array, " n"],
        uncompensated: Float[Array, " n"],
        scale: Float[Array, "n 2"],
    ) -> Bool[Array, " n"]:
        """(n,) whether both drones lift their share of the weight with room to command and to turn the stick."""
        law, motor = self.config.autopilot, self._motor
        most, cap = (motors.force(motor, jnp.full_like(battery, pwm), battery) for pwm in (crazyflie.FULL, CEILING))
        if motors.compensates(law.motor_curve):
            cap = jnp.where(uncompensated > 0, cap, jnp.minimum(most, law.motor_curve[1] * CEILING / crazyflie.FULL))
        constants = self._constants
        carried = jnp.asarray(constants.known_mass) + jnp.asarray(constants.load_share) * object_mass
        weight = carried * self.config.plant.gravity / 4
        enough = (scale * cap[:, None] >= (1 + LIFT) * weight) & (scale * most[:, None] >= (1 + LIFT + PULL) * weight)
        command = jnp.abs(self.hover_commands(object_mass, battery, uncompensated, scale))
        return (enough & (command < COMMAND_SHARE * self.config.command.vertical_limit)).all(axis=-1)

    def hover_commands(
        self,
        object_mass: Scalar,
        battery: Float[Array, " n"],
        uncompensated: Float[Array, " n"],
        scale: Float[Array, "n 2"],
    ) -> Float[Array, "n 2"]:
        """(n, 2) vertical acceleration that each drone has to be told so that it hovers its share [m/s2]."""
        carried = jnp.asarray(self._constants.known_mass) + jnp.asarray(self._constants.load_share) * object_mass
        believed = jnp.asarray(self._constants.known_mass) + jnp.asarray(self._constants.load_share) * (
            object_mass if self.config.scenario.mass_known else self.config.plant.object_mass
        )
        gravity, curve = self.config.plant.gravity, self.config.autopilot.motor_curve
        force = carried * gravity / 4 / scale  # of each motor
        pwm = crazyflie.FULL * motors.voltage(self._motor, force) / battery[:, None]
        plain = motors.OLDER if motors.compensates(curve) else curve
        asked = jnp.where(uncompensated[:, None] > 0, crazyflie.motor_force(plain, pwm), force)
        return 4 * asked / believed - gravity

    def initial_integrals(self, load: Load, key: Array) -> Float[Array, "7"]:
        """(7,) integrals (see `Laws`) with which a world begins, in the air: nearly those that hover it."""
        law = self.config.leader
        battery: Scalar = load.battery
        uncompensated: Scalar = load.uncompensated
        scale: Array = load.thrust_scale
        command = self.hover_commands(load.object_mass, battery[None], uncompensated[None], scale[None])[0]
        share = jax.random.uniform(key, (2,), minval=0.6, maxval=1.1)
        side = 1.0 if self.config.plant.cg_axis == "y" else -1.0
        height = share[0] * (command[0] + command[1]) / 2 / law.ki[2] if law.ki[2] > 0 else 0.0
        level = (
            share[1] * side * (command[0] - command[1]) / 2 / law.tilt_integral_gain
            if law.tilt_integral_gain > 0
            else 0.0
        )
        initial_integrals = jnp.zeros(7)
        return initial_integrals.at[2].set(height).at[3].set(level)

    def _with_battery(self, load: Load, key: Array) -> Load:
        """`load` with a battery, a firmware and drones that can be flown; if all candidates cannot, nominal drones."""
        battery, uncompensated, scale, good = self.draw_battery_and_thrust(load, key)
        first = jnp.argmax(good)
        found = good[first]
        return load._replace(
            battery=jnp.where(found, battery[first], self.config.scenario.battery[1]).astype(jnp.float32),
            uncompensated=jnp.where(found, uncompensated[first], 0.0).astype(jnp.float32),
            thrust_scale=jnp.where(found, scale[first], 1.0),
        )

    def _with_waypoints(self, load: Load, key: Array) -> Load:
        """`load` whose CG perhaps goes from place to place."""
        path_key, key = jax.random.split(key)
        places = jax.random.uniform(path_key, (PLACES, 2) if self._in_plane else (PLACES,), minval=-1.0, maxval=1.0)
        if self._in_plane:  # within the circle
            radius, angle = jnp.sqrt(jnp.abs(places[:, 0])), jnp.pi * places[:, 1]
            places = radius[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
        visits = jax.random.uniform(key) < self.config.scenario.cg_waypoint_probability
        return load._replace(cg_path=places, follows_path=visits.astype(jnp.float32))
