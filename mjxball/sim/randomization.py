"""The reset distribution: load, start and goal of one environment, sampled from `config.scenario`."""

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
from mjxball.sim.goals import GoalPath
from mjxball.sim.sensors import ATTITUDE_OFFSET

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

    from mjxball.arrays import Array
    from mjxball.physics.engine import Scalar, Vector


SAMPLES = 18  # random numbers of a reset
COMMAND_SHARE = 0.85  # share of the leader's vertical limit that a hover may take
CANDIDATES = 8  # sampled (battery, thrust of each drone), of which an environment takes the first that can fly
LIFT, PULL = 0.06, 0.05  # spare lift of every drone over its weight: at 60 000 units, and the rest at full power
SHRINKS = 8  # largest number of times that thrust factors are moved towards 1 by three tenths
CEILING = float(crazyflie.THRUST_CEILING)
MASS_CHANGE_TIME = (5.0, 15.0)  # [s]
LOSS_TIME = (3.0, 15.0)  # [s]
LISSAJOUS = 0.3  # probability that the CG's second sine is twice as fast, where it has one
CIRCLE_RADIUS = (0.3, 1.0)  # of goals that move around a circle [m]
PLACES = 16  # random waypoints of a CG before it starts over


class SampledRig(NamedTuple):
    """The rig of an environment with random rigs."""

    parameters: PlantParameters  # padded to the plant's drones
    flies: Float[Array, " drones"]  # 1 for a drone that exists, 0 for padding
    proportion: Scalar  # radius over the plant's, a factor on CG amplitudes
    size_ratio: Scalar  # number of drones over the plant's, a factor on the object's mass
    row: rigs.RigTable | None = None  # row of a table of random rigs, which includes the load


class ResetDistribution:
    """Samples environments of `config.scenario` with CG amplitudes that can be trimmed.

    `varies`: rotors or inertia are random; `rigs`: the whole rig is random.
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
        self.moving_goals = scenario.goal_motion_probability > 0 or scenario.goal_step_probability > 0
        plant, self._ranges = config.plant, [getattr(scenario, name) for name in teams.Factors._fields]
        self.rigs = bool(scenario.team_sizes or config.rigs.number) or any(ends != (1.0, 1.0) for ends in self._ranges)
        self._in_plane, self._several = len(plant.directions) == 2, plant.count > 2
        sizes = scenario.team_sizes or (plant.count,)
        self._sizes = np.array(sizes)
        self._rings = teams.table(config) if scenario.team_sizes and not config.rigs.number else None
        self._table = rigs.training_rigs(config) if config.rigs.number and scenario.team_sizes else None
        self._constants = constants = plant_parameters(config.plant, config.attitude)
        self._motor = motors.MOTORS[config.autopilot.drone or "2.1"]
        self._loses = scenario.lost_follower_probability + scenario.lost_leader_probability > 0
        self._loss_amplitudes = teams.amplitudes_with_loss(config) if self._loses else None
        self._drones = constants.own_inertia.sum(axis=0)
        self._object = constants.object_inertia_per_mass

    def sample(
        self,
        rng: Array,
        number: Int[Array, ""] | None = None,
        chosen: rigs.RigTable | None = None,
    ) -> tuple[Load, PlantState, Vector, SampledRig | None]:
        """(load, plant nearly at rest, goal (3,) of O [m] at the start, the environment's rig if rigs are random).

        `number` sets the team's size; None: any of `scenario.team_sizes`. `chosen` is the rig, if given.
        """
        scenario = self.config.scenario
        rig = self._rig(jax.random.fold_in(rng, 6), number) if self.rigs and chosen is None else None
        rig = rig if chosen is None else self._rig_of_row(chosen)
        # One call for everything: a reset runs with every training step, and each call launches kernels.
        samples = iter(jnp.split(jax.random.uniform(rng, (SAMPLES,)), SAMPLES))

        def between(low: float, high: Scalar | float) -> Scalar:
            return low + (high - low) * next(samples)[0]

        def symmetric(limit: float, size: int = 3) -> Float[Array, " size"]:
            return limit * (2.0 * jnp.concatenate([next(samples) for _ in range(size)]) - 1.0)

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
        if rig is not None and rig.row is not None:
            load = self._with_rig_load(load, rig, jax.random.fold_in(rng, 13))
        if self.varies:
            load = self._varied(load, jax.random.fold_in(rng, 2))
        if self.has_battery:
            load = self._with_battery(load, jax.random.fold_in(rng, 4))
        if scenario.cg_waypoint_probability > 0:
            load = self._with_waypoints(load, jax.random.fold_in(rng, 3))
        if self._in_plane:
            load = self._with_plane_path(load, jax.random.fold_in(rng, 12), rig)
        else:
            load = load._replace(cg_amplitude=jnp.minimum(load.cg_amplitude, jnp.maximum(self.trimmed(load, rig), 0.0)))
        if self._loses:
            load = self._with_loss(load, jax.random.fold_in(rng, 8), rig)
        plant = start_state(
            self.config,
            euler=jnp.append(symmetric(scenario.start_tilt, 2), 0.0),
            position=symmetric(scenario.start_position),
            velocity=symmetric(scenario.start_velocity),
            believed_mass=load.believed_mass,
            ball_offset=(self._direction(rng, 9) if self._in_plane else 1.0) * symmetric(scenario.ball_start, 1)[0],
            parameters=None if rig is None else rig.parameters,
        )
        goal = symmetric(scenario.goal_range)
        load = self._with_air(load, jnp.minimum(plant.position[2], goal[2]), jax.random.fold_in(rng, 15))
        return load, plant, goal, rig

    def goal_path(self, start: Vector, key: Array) -> Any:
        """A goal from `start` (3,) that rests, or moves along a line or around a circle, and may jump; () if all rest.

        `key` is that of the reset.
        """
        if not self.moving_goals:
            return ()
        scenario, key = self.config.scenario, jax.random.fold_in(key, 14)
        moves, circles, fast, far, side, phase, jumps, when = jax.random.uniform(key, (8,))
        low, high = scenario.goal_speed
        speed = jnp.where(moves < scenario.goal_motion_probability, low + (high - low) * fast, 0.0)
        way = jax.random.normal(jax.random.fold_in(key, 1), (3,))
        radius = CIRCLE_RADIUS[0] + (CIRCLE_RADIUS[1] - CIRCLE_RADIUS[0]) * far
        step = jax.random.uniform(jax.random.fold_in(key, 2), (3,), minval=-0.5, maxval=0.5) * scenario.goal_range
        around = (circles < 0.5) & (speed > 0)
        return GoalPath(
            start=start,
            until=jnp.full((), jnp.inf),
            velocity=jnp.where(around, 0.0, speed) * way / jnp.linalg.norm(way),
            radius=jnp.where(around, radius, 0.0),
            speed=jnp.where(side < 0.5, -1.0, 1.0) * speed / radius,
            phase=2 * jnp.pi * phase,
            step=step,
            step_time=jnp.where(jumps < scenario.goal_step_probability, 5.0 + 10.0 * when, jnp.inf),
        )

    def _with_air(self, load: Load, lowest: Scalar, key: Array) -> Load:
        """`load` with random air, attitude loops, attitude errors and fading thrust; `lowest` place of O [m]."""
        scenario, found = self.config.scenario, dict[str, Any]()

        def between(ends: tuple[float, float], stream: int) -> Scalar:
            return ends[0] + (ends[1] - ends[0]) * jax.random.uniform(jax.random.fold_in(key, stream))

        if scenario.rotor_drag[1] > 0:
            found["rotor_drag"] = between(scenario.rotor_drag, 0)
        if scenario.wind[1] > 0:
            found["wind"] = between(scenario.wind, 1) * jnp.append(self._direction(key, 2), 0.0)
        if scenario.floor_clearance[1] > 0:
            found["floor"] = lowest - between(scenario.floor_clearance, 3)
        if scenario.download[1] > 0:
            found["download"] = between(scenario.download, 4)
        if scenario.attitude_frequency[1] > 0:
            low, high = jnp.log(jnp.array(scenario.attitude_frequency))
            frequency = jnp.exp(low + (high - low) * jax.random.uniform(jax.random.fold_in(key, 5)))
            found["loop_scale"] = frequency / self.config.attitude.natural_frequency[0]
        if scenario.offset[1] > 0:
            off = jax.random.normal(jax.random.fold_in(key, 7), (self.config.plant.count, 3))
            found["attitude_error"] = between(scenario.offset, 6) * jnp.asarray(ATTITUDE_OFFSET, jnp.float32) * off
        if scenario.thrust_fade[1] > 0:
            faded = 0.0 if load.thrust_fade is None else load.thrust_fade
            found["thrust_fade"] = faded + between(scenario.thrust_fade, 8)
        return load._replace(**found)

    def _with_rig_load(self, load: Load, rig: SampledRig, key: Array) -> Load:
        """`load` with the masses, thrusts and CG reach of the row in `rig`."""
        row: Any = rig.row
        far, stepped = jax.random.uniform(key, (2,))
        load = load._replace(object_mass=row.object_mass, believed_mass=row.believed_mass, thrust_scale=row.thrust)
        change = self.config.rigs.mass_step * (2 * stepped - 1) * row.object_mass
        assumed = (row.believed_mass, row.thrust, self.config.scenario.trim_margin, *rigs.command_limits(self.config))
        later = rigs.trimmed_reach(rig.parameters, row.object_mass + change, *assumed)
        change = jnp.where(later < 0, 0.0, change)
        reach = jnp.where(later < 0, row.reach, jnp.minimum(row.reach, later))
        return load._replace(
            cg_amplitude=far * reach,
            mass_change=change[None],
            thrust_fade=row.thrust_fade,
        )

    def trimmed(self, load: Load, rig: SampledRig | None = None) -> Scalar:
        """CG amplitude [m] that can be trimmed before and after the mass changes; negative: none."""
        if rig is not None and rig.row is not None:  # the amplitude was sampled within it
            return load.cg_amplitude
        masses = (load.object_mass, load.object_mass + load.mass_change[0])
        if self._several or self._in_plane or rig is not None:
            parameters, leader = (self._constants if rig is None else rig.parameters), self.config.plant.leader
            rest = (self.config.scenario.trim_margin, load.believed_mass, load.thrust_scale)
            rotors = jnp.minimum(*(safe_radius(parameters, leader, mass, *rest) for mass in masses))
            return jnp.minimum(rotors, self._commanded_radius(parameters, jnp.maximum(*masses)))
        if self.has_battery:
            return jnp.minimum(*(self._battery_trim_limit(load, mass) for mass in masses))
        margin, plant = self.config.scenario.trim_margin, self.config.plant
        thrust = (1.0, 1.0) if load.thrust_scale is None else (load.thrust_scale[0], load.thrust_scale[1])
        if self.config.leader.ki[2] > 0:  # its integral finds the thrust for its share of the weight
            limits = (trim_limit(plant, mass, margin, None, (1.0, thrust[1])) for mass in masses)
        else:
            limits = (trim_limit(plant, mass, margin, load.believed_mass, thrust) for mass in masses)
        return jnp.minimum(*limits)

    def _commanded_radius(self, parameters: PlantParameters, object_mass: Scalar) -> Scalar:
        """CG distance from O [m] that the followers' tilt commands hold with `trim_margin` left.

        Small teams have little inertia about the axis through their drones, and therefore low attitude gains.
        """
        margin, tilt = self.config.scenario.trim_margin, self.config.follower.action_scale_tilt
        flying = (jnp.asarray(parameters.drone_mass) > 0).sum() - 1
        gain = jnp.min(jnp.asarray(parameters.gains.kp)[..., :2], axis=-1)
        return (1 - margin) * flying * gain * tilt / (parameters.gravity * object_mass)

    def _varied(self, load: Load, key: Array) -> Load:
        """`load` with random rotors and inertia."""
        scenario, count = self.config.scenario, self.config.plant.count
        share = jax.random.uniform(key, (3 + count,))
        each = (scenario.thrust_scale,) * count
        ranges = (scenario.rotor_lag_scale, scenario.inertia_scale, *each, scenario.thrust_scale_common)
        samples = (low + (high - low) * u for (low, high), u in zip(ranges, share, strict=True))
        lag, inertia, *apart, common = samples
        thrust = common * jnp.stack(apart)
        own = jnp.asarray(self._drones) + jnp.asarray(self._object) * load.object_mass
        load = load._replace(
            rotor_lag_scale=lag, thrust_scale=thrust, added_inertia=((inertia - 1.0) * own).astype(own.dtype)
        )
        if self.has_battery or self._several or scenario.thrust_scale == scenario.thrust_scale_common == (1.0, 1.0):
            return load
        # A leader that lifts too little can leave more than any follower trims: factors are then moved towards 1.
        for _ in range(SHRINKS):
            scales: Array = load.thrust_scale
            milder = load._replace(thrust_scale=1.0 + 0.7 * (scales - 1.0))
            load = jax.tree.map(functools.partial(jnp.where, self.trimmed(load) < 0), milder, load)
        return load

    def _rig(self, key: Array, number: Int[Array, ""] | None) -> SampledRig:
        """A rig with random factors; `number` sets the team's size, None takes any."""
        plant, attitude = self.config.plant, self.config.attitude
        index = jax.random.randint(jax.random.fold_in(key, 1), (), 0, len(self._sizes)) if number is None else number
        index = index % len(self._sizes)
        if self._table is not None:
            return self._random_row(jax.random.fold_in(key, 2), index)
        parameters = jax.tree.map(jnp.float32, self._constants)
        size = jnp.asarray(self._sizes, jnp.float32)[index]
        if self._rings is not None:
            parameters = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32)[index], self._rings)
        share, samples = size / plant.count, jax.random.uniform(key, (len(self._ranges),))
        factors = teams.Factors(*(low + (high - low) * u for (low, high), u in zip(self._ranges, samples, strict=True)))
        parameters = teams.varied(parameters, factors, attitude, share * attitude.design_object_mass)
        flies = (jnp.arange(plant.count) < size).astype(jnp.float32)
        return SampledRig(parameters, flies, parameters.ball_limit / self._constants.ball_limit, share)

    def _random_row(self, key: Array, index: Int[Array, ""]) -> SampledRig:
        """Any of the tabulated rigs of the size `index`."""
        number = jax.random.randint(key, (), 0, self.config.rigs.number)
        return self._rig_of_row(jax.tree.map(lambda part: jnp.asarray(part, jnp.float32)[index, number], self._table))

    def _rig_of_row(self, row: rigs.RigTable) -> SampledRig:
        flies = (jnp.arange(self.config.plant.count) < row.size).astype(jnp.float32)
        one = jnp.ones(())
        return SampledRig(rigs.whole(row.parameters, self.config.plant.gravity), flies, one, one, row)

    def _with_plane_path(self, load: Load, key: Array, rig: SampledRig | None) -> Load:
        """`load` with a random path of the CG in the plane, within the carrier and what can be trimmed."""
        scenario = self.config.scenario
        turn, wide, late, kind = jax.random.uniform(key, (4,))
        low, high = scenario.cg_width
        ratio = jnp.where(kind < (LISSAJOUS if high > 0 else 0.0), 2.0, 1.0)
        shape = PathShape(2 * jnp.pi * turn, low + (high - low) * wide, ratio, 2 * jnp.pi * late)
        # The longer half axis of an ellipse; for a Lissajous curve the corner of its box, an upper bound.
        w, across = shape.width**2, jnp.cos(2 * shape.lead)
        ellipse = (1 + w + jnp.sqrt(jnp.maximum(1 + w * w + 2 * w * across, 0.0))) / 2
        longest = jnp.sqrt(jnp.where(ratio > 1, 1 + w, ellipse))
        if load.follows_path is not None:
            longest = jnp.where(load.follows_path > 0, 1.0, longest)
        proportion: Scalar | float = 1.0 if rig is None else rig.proportion
        limit = jnp.maximum(self.trimmed(load, rig), 0.0)
        if rig is None or rig.row is None:
            limit = jnp.minimum(cg_limit(self.config.plant) * proportion, limit)
        return load._replace(cg_amplitude=jnp.minimum(load.cg_amplitude * proportion, limit / longest), cg_shape=shape)

    def _with_loss(self, load: Load, key: Array, rig: SampledRig | None) -> Load:
        """`load` in which the rotors of one drone may stop, with the CG within what the others can then trim.

        No rotor stops if no CG could be trimmed afterwards, unless `trim_margin` is negative; then the CG stays at O.
        """
        plant, scenario = self.config.plant, self.config.scenario
        masses, table = self._loss_amplitudes  # type: ignore[misc]
        lost, which, when = jax.random.uniform(key, (3,))
        followers = np.array(plant.followers)
        existing = len(followers) if rig is None else rig.flies[followers].sum()
        follower = jnp.asarray(followers)[jnp.floor(which * existing).astype(jnp.int32)]
        chosen = jnp.where(lost < scenario.lost_leader_probability, plant.leader, follower)
        size = 0 if rig is None or self._rings is None else jnp.argmin(jnp.abs(self._sizes - rig.flies.sum()))
        share, wide = (1.0, 1.0) if rig is None else (rig.size_ratio, rig.proportion)
        held = jnp.interp(load.object_mass / share, masses, jnp.asarray(table)[size, chosen]) * wide
        likely = scenario.lost_follower_probability + scenario.lost_leader_probability
        happens = (lost < likely) & ((held > 0) | (scenario.trim_margin < 0))
        low, high = LOSS_TIME
        stops = (jnp.arange(plant.count) == chosen) & happens
        return load._replace(
            stop_time=jnp.where(stops, low + (high - low) * when, jnp.inf),
            cg_amplitude=jnp.where(happens, jnp.clip(held, 0.0, load.cg_amplitude), load.cg_amplitude),
        )

    def _direction(self, rng: Array, stream: int) -> Float[Array, "2"]:
        """A random unit vector (2,) in the plane."""
        angle = 2 * jnp.pi * jax.random.uniform(jax.random.fold_in(rng, stream))
        return jnp.stack([jnp.cos(angle), jnp.sin(angle)])

    def _battery_trim_limit(self, load: Load, mass: Scalar) -> Scalar:
        """As `trimmed`, for drones with batteries, of which the weaker one holds the load."""
        plant = self.config.plant
        weakest = 1.0 if load.thrust_scale is None else jnp.minimum(load.thrust_scale[0], load.thrust_scale[1])
        return trim_limit(plant, mass, self.config.scenario.trim_margin, None, (1.0, weakest))

    def sample_battery_and_thrust(
        self, load: Load, key: Array, count: int = CANDIDATES
    ) -> tuple[Float[Array, " count"], Float[Array, " count"], Float[Array, "count 2"], Bool[Array, " count"]]:
        """Samples of battery [V], older firmware (0 or 1), thrust factors (count, 2), and whether each can be flown."""
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
        """(n,) whether both drones lift their share of the weight with spare lift for commands and tilting."""
        curve, motor = self.config.autopilot.motor_curve, self._motor
        most, cap = (motors.force(motor, jnp.full_like(battery, pwm), battery) for pwm in (crazyflie.FULL, CEILING))
        if motors.compensates(curve):
            cap = jnp.where(uncompensated > 0, cap, jnp.minimum(most, curve[1] * CEILING / crazyflie.FULL))
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
        """(n, 2) commanded vertical acceleration [m/s2] at which each drone hovers its share of the weight."""
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

    def _with_battery(self, load: Load, key: Array) -> Load:
        """`load` with the first sampled battery, firmware and thrusts that can fly, or nominal drones if none can."""
        battery, uncompensated, scale, good = self.sample_battery_and_thrust(load, key)
        first = jnp.argmax(good)
        found = good[first]
        return load._replace(
            battery=jnp.where(found, battery[first], self.config.scenario.battery[1]).astype(jnp.float32),
            uncompensated=jnp.where(found, uncompensated[first], 0.0).astype(jnp.float32),
            thrust_scale=jnp.where(found, scale[first], 1.0),
        )

    def _with_waypoints(self, load: Load, key: Array) -> Load:
        """`load` whose CG follows random waypoints in some flights."""
        path_key, key = jax.random.split(key)
        places = jax.random.uniform(path_key, (PLACES, 2) if self._in_plane else (PLACES,), minval=-1.0, maxval=1.0)
        if self._in_plane:  # within the circle
            radius, angle = jnp.sqrt(jnp.abs(places[:, 0])), jnp.pi * places[:, 1]
            places = radius[:, None] * jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
        visits = jax.random.uniform(key) < self.config.scenario.cg_waypoint_probability
        return load._replace(cg_path=places, follows_path=visits.astype(jnp.float32))
