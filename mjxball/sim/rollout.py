"""`simulate`: fly one follower, or a batch of them, through scenarios and return everything that happened."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mjxball.arrays import joined
from mjxball.config import Config, Plant, follow_plant, preset, replace, validate
from mjxball.control import rotations
from mjxball.control.followers import Baseline, Controller, Follower, PrivilegedInfo, checked_command
from mjxball.control.observation import mount_angles
from mjxball.errors import InputError
from mjxball.physics import aerodynamics, newton_euler
from mjxball.physics.engine import Load, PathShape, PlantState, contact_wrenches, coordinates, rotor_wrenches
from mjxball.physics.motion import make_cg_motion, object_mass
from mjxball.physics.step import (
    acting_wrench,
    make_accelerations,
    make_cg_offset,
    make_numpy_plant_step,
    start_state,
)
from mjxball.plant import plant_parameters
from mjxball.plant.parameters import rigid_mass
from mjxball.sim.closed_loop import ClosedLoop, LoopState
from mjxball.sim.disturbances import attitude_errors, followers_axis, record, sensors_of
from mjxball.sim.goals import Goal, GoalMotion, GoalPath
from mjxball.sim.scenario import CgPath, Scenario, check_scenario, of_plant
from mjxball.sim.sensors import Sample, SensorModel, SensorSettings
from mjxball.sim.trajectory import Trajectory

if TYPE_CHECKING:
    from jaxtyping import Float

    from mjxball.arrays import Array
    from mjxball.physics.engine import Coordinates, Vector

ENDS = slice(-1), slice(1, None)  # rows of the beginnings of control steps, and of their ends
NO_FLOOR = 1e6  # [m] below the origin: of a flight without ground in a batch with
Flights = Sequence[tuple[Follower, Sequence[Scenario]]]  # each follower with the scenarios that it flies


class Carry(NamedTuple):
    """State of n flights between control steps."""

    loop: LoopState
    observation: Float[Array, "n ... 18"]
    follower: Any  # state of the controller


class Inputs(NamedTuple):
    """Goals and disturbances of n flights in a control step, or with a leading axis in each of T."""

    time: Float[Array, "..."]  # at the beginning [s]
    goal: Goal  # of O at the beginning
    next_goal: Goal  # of O at the end
    force: Float[Array, "... n 3"] | None  # external force on O meanwhile [N]; None: none
    late: Float[Array, "... n"] | None  # physics steps by which the commands come late; None: none
    sample: Sample  # disturbances of the measurement at the end

    def at(self, number: int) -> Inputs:
        """Step `number`."""

        def row(part: Any) -> Any:
            return None if part is None else part[number]

        now, after = (Goal(*map(row, goal)) for goal in (self.goal, self.next_goal))
        return Inputs(self.time[number], now, after, row(self.force), row(self.late), self.sample.at(number))


def control_step(
    loop: ClosedLoop,
    controller: Controller,
    privileged: Callable[..., Any],
    load: Load,
    carry: Carry,
    inputs: Inputs,
) -> tuple[Carry, Trajectory]:
    """One control period of n flights, on NumPy or JAX arrays: (what goes on, the row of its beginning).

    The followers' `controller` sees `carry.observation` and, from `privileged`, what it may know of plant and `load`.
    """
    state, seen, plant = carry.loop, carry.observation, carry.loop.plant
    acting = load._replace(external_force=inputs.force, late=inputs.late)
    goals = inputs.goal, inputs.next_goal
    known = privileged(plant, acting, _goal_acceleration(goals, loop.period))
    memory, answer = controller.step(carry.follower, seen, known)
    moved, observation, commands = loop.step(state, seen, answer, acting, goals, inputs.sample)
    row = Trajectory.of(plant, inputs.time, inputs.goal.position, commands, diverged=state.diverged, observation=seen)
    return Carry(moved, observation, memory), row


def _goal_acceleration(goals: tuple[Goal, Goal], period: float) -> Vector | None:
    now, after = goals
    return None if now.rate is None or after.rate is None else (after.rate - now.rate) / period


class ScenarioArrays(NamedTuple):
    """Scenarios of one length as arrays of n flights: what `control_step` needs to fly them."""

    load: Load
    start: PlantState
    inputs: Inputs  # of T control steps
    first: Sample  # disturbances of the first measurement
    sensors: SensorModel
    settings: SensorSettings


def scenario_arrays(config: Config, scenarios: Sequence[Scenario], start: PlantState | None = None) -> ScenarioArrays:
    """`scenarios`, checked, as arrays; InputError unless all last equally long.

    `start`: the states in which complete and checked scenarios begin, on plants that are not that of `config`.
    """
    scenarios = scenarios if start else [check_scenario(config, scenario) for scenario in scenarios]
    if len({scenario.seconds for scenario in scenarios}) != 1:
        raise InputError("scenarios of one batch must last equally long")
    period, followers = config.timing.control_period, followers_axis(config)
    steps = round(scenarios[0].seconds / period) + 1
    goals, disturbances = goals_of(config, scenarios, steps), [scenario.disturbance for scenario in scenarios]
    samples = record(disturbances, steps + 1, period, followers, config.timing.physics_steps)
    during, later = samples.at(slice(steps)), samples.at(slice(1, None))._replace(force=None, late=None)
    before, after = (Goal(*(part if part is None else part[rows] for part in goals)) for rows in ENDS)
    # The time is exact, so that a mass change falls on the same row for every engine.
    inputs = Inputs(np.arange(steps) * period, before, after, during.force, during.late, later)
    load, start = load_of(config, scenarios), start or start_of(config, scenarios)
    first = samples.at(0)._replace(force=None, late=None)
    return ScenarioArrays(load, start, inputs, first, *sensors_of(disturbances, period, followers))


def simulate(
    plant: Plant | Config, follower: Follower, scenario: Scenario | None = None, physics: str = "mjx"
) -> Trajectory:
    """Fly `follower` through `scenario` on `plant` (or on a whole `Config`: gains, limits and rates too).

    `physics` is mjx, newton-euler or mujoco. Raises InputError for an unsound scenario or a policy of another rate.
    """
    paper = preset("paper")
    config = plant if isinstance(plant, Config) else follow_plant(replace(paper, "plant", plant), paper.plant, ())
    check_rate(config, follower)
    return simulate_batch(config, [(follower, [scenario or Scenario()])], physics).world(0)


def check_rate(config: Config, follower: Follower) -> None:
    """Raise InputError for a policy of another rate."""
    period = config.timing.control_period
    wanted = getattr(follower, "control_period", period)
    if abs(wanted - period) > 1e-9:
        raise InputError(f"{follower.name} was made for a control period of {wanted:g} s, not {period:g} s")


def simulate_batch(
    config: Config, flights: Flights, physics: str = "mjx", progress: Callable[[float], None] = lambda share: None
) -> Trajectory:
    """Fly every (follower, scenarios) pair at once; the batch axis runs over all scenarios in order.

    All scenarios must last equally long. Each follower is called once per control step for its own part. `progress` is
    called with the share that is flown.
    """
    validate(config)
    controller = Together(flights)
    flown = scenario_arrays(config, [scenario for _, part in flights for scenario in part])
    load, inputs = flown.load, flown.inputs
    privileged = make_privileged_info(config) if controller.needs_privileged else lambda *_: None
    plant_step = make_numpy_plant_step(config, physics)
    loop = ClosedLoop(config, plant_step, flown.sensors, jitters=inputs.late is not None)
    state, observation = loop.start(flown.start, inputs.at(0).goal, load, flown.first, flown.settings)
    carry, plants, rows = Carry(state, observation, controller.start(observation)), [], []
    for number in range(len(inputs.time)):
        progress(number / len(inputs.time))
        plants.append(carry.loop.plant)
        carry, row = control_step(loop, controller, privileged, load, carry, inputs.at(number))
        rows.append(row)
    plant = plants[0].each(lambda *leaves: np.stack(leaves), *plants[1:])
    flight = Trajectory(*(None if part[0] is None else np.stack(part) for part in zip(*rows, strict=True)))
    cg_offset = make_cg_offset(config)(plant, load)
    plant = plant._replace(time=np.broadcast_to(inputs.time[:, None], plant.time.shape))
    wrenches = flown_contact_wrenches(config, plant, load._replace(external_force=inputs.force), physics)
    return flight._replace(
        cg_offset=cg_offset,
        object_mass=object_mass(plant.time, load),
        contact_force=wrenches[0],
        contact_torque=wrenches[1],
    )


class Together:
    """The followers of `flights` as one controller of the whole batch, each for its own scenarios."""

    name = "together"

    def __init__(self, flights: Flights):
        ends = np.cumsum([len(part) for _, part in flights])
        parts = [slice(end - len(part), end) for end, (_, part) in zip(ends, flights, strict=True)]
        self._followers = [(follower, part) for (follower, _), part in zip(flights, parts, strict=True)]
        for follower, _ in self._followers:
            if hasattr(follower, "step") and not hasattr(follower, "reset"):
                name = type(follower).__name__
                raise InputError(
                    f"{name} is a controller; mjxball.control.followers.Baseline({name}(config), config) flies it"
                )
            follower.reset()
        self.needs_privileged = any(isinstance(follower, Baseline) for follower, _ in flights)

    def start(self, observation: np.ndarray) -> tuple[()]:
        """Nothing: the followers remember themselves."""
        return ()

    def step(self, state: Any, observation: np.ndarray, privileged: PrivilegedInfo) -> tuple[Any, np.ndarray]:
        """See `Controller.step`."""
        commands = []
        for follower, part in self._followers:
            if isinstance(follower, Baseline):
                known = PrivilegedInfo(*(None if leaf is None else leaf[part] for leaf in privileged))
                follower.privileged = known if follower.controller.needs_privileged else known.without_truth()
            seen = observation[part]
            commands.append(checked_command(getattr(follower, "name", type(follower).__name__), follower(seen), seen))
        return state, np.concatenate(commands)


def make_privileged_info(config: Config) -> Callable[..., PrivilegedInfo]:
    """Return `privileged(state, load, goal_acceleration=None)`: the present truth for a classical follower.

    A goal that is accelerated [m/s2] acts as a force against it. The acceleration of a freely rolling ball is taken
    for 0.
    """
    plant, params = config.plant, plant_parameters(config.plant, config.attitude)
    angles, several = mount_angles(plant), len(plant.followers) > 1
    drones = float(rigid_mass(params))
    prescribed = None if config.motion.kind == "rolling" else make_cg_motion(config)

    def each(value: Array, axes: int = 0) -> Array:
        """`value` of a flight, whose last `axes` are not the batch's, for each of its followers."""
        if not several:
            return value
        xp, place = value.__array_namespace__(), value.ndim - axes
        shape = (*value.shape[:place], len(plant.followers), *value.shape[place:])
        return xp.broadcast_to(xp.expand_dims(value, axis=place), shape)

    def in_frames(vector: Array) -> Array:
        """A vector (..., 3) in body axes in those of each follower's observation."""
        found = each(vector, axes=1)
        return found if angles is None else rotations.turned_about_z(found, -angles)

    def moment(mass: Array, found: Coordinates) -> Array:
        along = coordinates(found, len(plant.directions))
        if angles is None:
            return mass * along[0]
        parts = [mass * along[plant.directions.index(k)] if k in plant.directions else 0.0 * mass for k in (0, 1)]
        return in_frames(joined([*parts, 0.0 * mass]))[..., :2]

    def privileged(state: PlantState, load: Load, goal_acceleration: Vector | None = None) -> PrivilegedInfo:
        xp, mass = state.time.__array_namespace__(), object_mass(state.time, load)
        if prescribed is None:
            share, ball = plant.moving_fraction, state.ball_offset
            offset, rate, acceleration = share * ball, share * state.ball_rate, xp.zeros_like(ball)
        else:
            offset, rate, acceleration = prescribed(state.time, load)
        thrust = load.thrust_scale
        if load.stop_time is not None:
            turns = xp.astype(state.time[..., None] < load.stop_time, state.time.dtype)
            thrust = turns if thrust is None else turns * thrust
        if load.thrust_fade is not None:
            left = (1.0 - load.thrust_fade * state.time)[..., None]
            thrust = left * xp.ones_like(state.rotor_force[..., 0]) if thrust is None else left * thrust
        air = aerodynamics.effects(params, state, load)
        if air.lift is not None:
            lifts = air.lift.mean(axis=-1)
            thrust = lifts if thrust is None else lifts * thrust
        force = aerodynamics.drag_force(air, state)
        if load.external_force is not None:
            force = load.external_force if force is None else force + load.external_force
        if goal_acceleration is not None:
            inertial = -(drones + mass)[..., None] * goal_acceleration
            force = inertial if force is None else force + inertial
        return PrivilegedInfo(
            each(load.believed_mass),
            moment(mass, offset),
            moment(mass, acceleration),
            each(drones + mass),
            None if thrust is None else each(thrust, axes=1),
            moment(mass, rate),
            each(rotor_wrenches(plant, params, state.rotor_force, air)[..., :3], axes=2),
            None if force is None else in_frames(force),
            None if load.loop_scale is None else each(load.loop_scale),
            None if state.loops is None else each(state.loops, axes=2),
        )

    return privileged


def flown_contact_wrenches(
    config: Config, flown: PlantState, load: Load, physics: str
) -> tuple[Float[np.ndarray, "T n drones 3"], Float[np.ndarray, "T n drones 3"]]:
    """Contact forces and torques of recorded states (T, n, ...), see `physics.engine.contact_wrenches`.

    `mujoco` reads MuJoCo's own internal forces; the other engines, and flights with effects of the air, share the
    closed form. That has no elastic mounts: InputError for flights on them with effects of the air.
    """
    if physics == "mujoco" and load.rotor_drag is load.floor is load.download is None:
        from mjxball.physics.mujoco import flown_contact_wrenches as measured

        return measured(config, flown, load)
    if config.plant.mount_frequency:
        raise InputError("contact forces of drones on elastic mounts are not computed with drag, floor or download")
    constants = plant_parameters(config.plant, config.attitude)
    accelerate = make_accelerations(config, newton_euler.make_engine(config.plant, config.attitude))
    wrench = acting_wrench(config.plant, constants, flown.rotor_force, flown, load)
    linear, angular, _ = accelerate(flown, wrench, load)
    air = aerodynamics.effects(constants, flown, load)
    return contact_wrenches(config.plant, constants, flown, linear, angular, air)


def goals_of(config: Config, scenarios: Sequence[Scenario], count: int) -> Goal:
    """Goals of O (count + 1, n, 3) before the first control step and after each of `count`; no rate if all rest."""
    time = np.arange(count + 1) * config.timing.control_period
    target = np.empty((count + 1, len(scenarios), 3))
    for number, scenario in enumerate(of_plant(config, one) for one in scenarios):
        target[:, number] = scenario.goal
        for when, goal in scenario.waypoints:
            target[time >= when - 1e-9, number] = goal
    motions = [scenario.goal_motion for scenario in scenarios]
    if all(motion == GoalMotion() for motion in motions):
        return Goal(target)
    velocity, until, radius, speed, phase = (
        np.array([getattr(motion, name) for motion in motions], float) for name in GoalPath._fields[1:6]
    )
    path = GoalPath(0.0 * velocity, velocity, until, radius, speed, phase, 0.0 * velocity, np.full_like(until, np.inf))
    moved = path.at(time[:, None])
    return Goal(target + moved.position, moved.rate)


def start_of(config: Config, scenarios: Sequence[Scenario]) -> PlantState:
    """The state in which the scenarios begin."""
    believed = load_of(config, scenarios).believed_mass
    position = np.array([scenario.start_position for scenario in scenarios], float)
    velocity = np.array([scenario.start_velocity for scenario in scenarios], float)
    tilt = np.array([(*scenario.start_tilt, 0.0) for scenario in scenarios])
    ball = np.array([scenario.ball_start for scenario in scenarios], float)
    rolling = np.array([scenario.ball_velocity for scenario in scenarios], float)
    if len(config.plant.directions) == 2:
        ball = np.stack([ball, np.array([scenario.ball_start_across for scenario in scenarios], float)], axis=-1)
    else:
        rolling = rolling[:, 0]
    return start_state(config, position, tilt, velocity, believed, ball)._replace(ball_rate=rolling)


def load_of(config: Config, scenarios: Sequence[Scenario]) -> Load:
    """Masses, CG motions and drones that fail of the scenarios, one world each."""
    scenarios = [of_plant(config, scenario) for scenario in scenarios]
    mass = np.array([scenario.mass for scenario in scenarios], float)
    believed = [s.mass if s.believed_mass is None else s.believed_mass for s in scenarios]
    names = ("amplitude", "omega", "phase")
    amplitude, omega, phase = (np.array([getattr(s, name) for s in scenarios], float) for name in names)
    most = max(len(scenario.mass_changes) for scenario in scenarios)
    padded = [[*s.mass_changes, *[(np.inf, 0.0)] * (most - len(s.mass_changes))] for s in scenarios]
    changes = np.array(padded, float).reshape(len(scenarios), most, 2)
    load = Load(mass, np.array(believed, float), amplitude, omega, phase, changes[..., 1], changes[..., 0])
    if any(scenario.path != CgPath() for scenario in scenarios):
        load = load._replace(cg_shape=PathShape(*np.array([astuple(s.path) for s in scenarios], float).T))
    count = max((len(scenario.thrust) for scenario in scenarios), default=0)
    if count:
        load = load._replace(thrust_scale=np.array([s.thrust or (1.0,) * count for s in scenarios], float))
    load = load._replace(**_air_of(scenarios))
    if any(scenario.disturbance.offset for scenario in scenarios):
        errors = [attitude_errors(scenario.disturbance, config.plant.count) for scenario in scenarios]
        load = load._replace(attitude_error=np.array(errors))
    if any(scenario.lost for scenario in scenarios):
        stops = [[dict(s.lost).get(number, np.inf) for number in range(config.plant.count)] for s in scenarios]
        load = load._replace(stop_time=np.array(stops, float))
    return load


def _air_of(scenarios: Sequence[Scenario]) -> dict[str, Any]:
    """Fields of `Load` that at least one of the scenarios sets: attitude loops, air, fading thrust."""
    still, found = Scenario(), dict[str, Any]()
    for name in ("loop_scale", "rotor_lag_scale", "rotor_drag", "wind", "download", "thrust_fade"):
        values = [getattr(scenario, name) for scenario in scenarios]
        if any(value != getattr(still, name) for value in values):
            found[name] = np.array(values, float)
    floors = [-NO_FLOOR if scenario.floor is None else scenario.floor for scenario in scenarios]
    if any(floor != -NO_FLOOR for floor in floors):
        found["floor"] = np.array(floors, float)
    return found
