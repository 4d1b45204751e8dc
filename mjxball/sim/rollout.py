"""`simulate`: fly one follower, or a batch of them, through scenarios and return everything that happened."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from mjxball import pictures
from mjxball.config import Config, Plant, follow_plant, preset, replace, validate
from mjxball.control import rotations
from mjxball.control.followers import Baseline, Follower, PrivilegedInfo, checked_command
from mjxball.control.observation import mount_angles
from mjxball.errors import InputError
from mjxball.physics import newton_euler
from mjxball.physics.engine import Load, PathShape, PlantState, contact_wrenches, coordinates, total_wrench
from mjxball.physics.motion import make_prescribed, object_mass
from mjxball.physics.step import (
    make_accelerations,
    make_cg_offset,
    make_stepper,
    start_state,
    with_external_force,
)
from mjxball.plant import plant_parameters
from mjxball.sim.closed_loop import ClosedLoop
from mjxball.sim.disturbances import followers_axis, record, sensors_of
from mjxball.sim.scenario import CgPath, Scenario, check_scenario, of_plant

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

    from mjxball.arrays import Array
    from mjxball.physics.engine import Coordinates

# Observations (n, 18), of several followers (n, F, 18), and who tells what is known -> commands (n, 3), or (n, F, 3).
Act = Callable[[np.ndarray, Callable[[], PrivilegedInfo]], np.ndarray]

Flights = Sequence[tuple[Follower, Sequence[Scenario]]]  # each follower with the scenarios that it flies


class Tick(NamedTuple):
    """One control step of n flights, as far as its metrics go: rows of a `Trajectory`."""

    time: float  # [s]
    position: Float[np.ndarray, "n 3"]  # of O in the world [m]
    target: Float[np.ndarray, "n 3"]  # goal of O [m]
    euler: Float[np.ndarray, "n 3"]  # roll, pitch, yaw [rad]
    rotor_force: Float[np.ndarray, "n drones 4"]  # [N]
    leader_command: Float[np.ndarray, "n 3"]  # roll, pitch [rad], vertical acceleration [m/s2]
    follower_command: Float[np.ndarray, "n ... 3"]  # likewise, (n, F, 3) of several followers
    diverged: Bool[np.ndarray, " n"]


@dataclass(frozen=True)
class Trajectory:
    """A flight, or a batch of flights with the batch axis second. NumPy float64, one row per control step.

    Where there are several followers, `follower_command` and `observation` have their axis, in the order of
    `plant.followers`, before the last one; `cg_offset` has a last axis of 2 where the load moves in the plane.
    T = round(seconds / control period) + 1 rows; row 0 is the start. A flight that diverges (|e_o| or a body
    rate beyond any bound, or a value that is not finite) is frozen there and marked in `diverged`.
    """

    time: Float[np.ndarray, " T"]  # [s]
    position: Float[np.ndarray, "T ... 3"]  # of O in the world [m]
    velocity: Float[np.ndarray, "T ... 3"]  # of O in the world [m/s]
    euler: Float[np.ndarray, "T ... 3"]  # roll, pitch, yaw [rad]
    rates: Float[np.ndarray, "T ... 3"]  # body rates [rad/s]
    quaternion: Float[np.ndarray, "T ... 4"]  # body -> world (w, x, y, z)
    rotor_force: Float[np.ndarray, "T ... drones 4"]  # [N]
    leader_command: Float[np.ndarray, "T ... 3"]  # roll, pitch [rad], vertical acceleration [m/s2], in body axes
    follower_command: Float[np.ndarray, "T ... 3"]  # likewise
    observation: Float[np.ndarray, "T ... 18"]  # what the followers saw, in their mount frames
    cg_offset: Float[np.ndarray, "T ..."]  # along the load's directions from O [m]
    object_mass: Float[np.ndarray, "T ..."]  # [kg]
    contact_force: Float[np.ndarray, "T ... drones 3"]  # of every drone on the carrier, body axes [N]
    contact_torque: Float[np.ndarray, "T ... drones 3"]  # likewise, about each drone's centre [N m]
    goal: Float[np.ndarray, "... 3"]  # of O, the last one of a sequence of waypoints [m]
    target: Float[np.ndarray, "T ... 3"]  # goal of O at every step [m]
    diverged: Bool[np.ndarray, "..."]

    @property
    def _summary(self) -> str:
        several = f", {self.position.shape[1]} flights" if self.position.ndim > 2 else ""
        diverged = int(np.sum(self.diverged))
        lost = f", {diverged} diverged" if diverged else ""
        return f"{self.time[-1]:g} s, {len(self.time)} steps{several}{lost}"

    def __repr__(self) -> str:
        return f"<Trajectory {self._summary}>"

    def _repr_html_(self) -> str:
        """For notebooks: the error over time, of several flights its length."""
        if self.position.ndim == 2:
            lines = [pictures.Curve(f"error along {'xyz'[axis]}", self.time, self.error[:, axis]) for axis in range(3)]
        else:
            far = np.linalg.norm(self.error, axis=-1)
            lines = [pictures.Curve(f"flight {number}", self.time, far[:, number]) for number in range(far.shape[1])][
                :4
            ]
        return pictures.card("flight", {"of": self._summary}, pictures.curves(lines, "time [s]", "error [m]"))

    @property
    def error(self) -> Float[np.ndarray, "T ... 3"]:
        """e_o = target - position [m]."""
        return self.target - self.position

    def tick(self, number: int) -> Tick:
        """Control step `number` of a batch."""
        rows = {name: getattr(self, name)[number] for name in Tick._fields if name != "diverged"}
        return Tick(**rows, diverged=self.diverged)

    def copied(self) -> Trajectory:
        """The same with memory of its own: `world` shares that of its whole batch."""
        return self._each(lambda value, _: np.array(value))

    def batched(self) -> Trajectory:
        """A single flight as a batch of one."""
        return self._each(np.expand_dims)

    def world(self, index: int) -> Trajectory:
        """Flight `index` of a batch."""
        return self._each(lambda value, axis: value[:, index] if axis else value[index])

    def _each(self, change: Callable[[np.ndarray, int], np.ndarray]) -> Trajectory:
        """The same with `change(array, number of its batch axis)` of all arrays but the time."""
        parts = {item.name: getattr(self, item.name) for item in dataclasses.fields(self) if item.name != "time"}
        axes = {"goal": 0, "diverged": 0}
        return Trajectory(self.time, **{name: change(value, axes.get(name, 1)) for name, value in parts.items()})


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


def simulate_batch(config: Config, flights: Flights, physics: str = "mjx") -> Trajectory:
    """Fly every (follower, scenarios) pair at once; the batch axis runs over all scenarios in order.

    All scenarios must last equally long. Each follower is called once per control step for its own part.
    """
    scenarios, act = _together(config, flights)
    cg_offset, privileged, period = make_cg_offset(config), make_privileged_info(config), config.timing.control_period
    count = round(scenarios[0].seconds / period)
    load, target = load_of(config, scenarios), targets(config, scenarios, count + 1)
    disturbances, followers = [scenario.disturbance for scenario in scenarios], followers_axis(config)
    samples, on_pid = record(disturbances, count + 2, period, followers), on_pid_of(flights)
    sensors, delays = sensors_of(disturbances, period, followers)
    loop = ClosedLoop(config, make_stepper(config, physics), sensors)
    state, observation = loop.start(start_of(config, scenarios), target[0], samples.at(0), delays)
    plants, rows = [], []
    for number in range(count + 1):
        plant, goals, diverged = state.plant, (target[number], target[number + 1]), state.diverged
        euler = rotations.euler_from_matrix(rotations.matrix_from_quaternion(plant.quaternion))
        answer = act(observation, partial(privileged, plant, load))
        acting, seen = load._replace(external_force=samples.at(number).force), observation
        state, observation, commands = loop.step(state, seen, answer, acting, goals, samples.at(number + 1), on_pid)
        plants.append(plant)
        rows.append((euler, *commands, seen, cg_offset(plant, load)))
    flown = plants[0].each(lambda *leaves: np.stack(leaves), *plants[1:])
    pushed = load._replace(external_force=samples.at(slice(count + 1)).force)
    stacked = [np.stack(part) for part in zip(*rows, strict=True)]
    return _trajectory(config, flown, stacked, target[:-1], diverged, pushed, physics)


def _together(config: Config, flights: Flights) -> tuple[list[Scenario], Act]:
    """All scenarios in order, checked, and the followers' laws, each for its own part of the batch."""
    validate(config)
    scenarios = [check_scenario(config, scenario) for _, part in flights for scenario in part]
    if len({scenario.seconds for scenario in scenarios}) != 1:
        raise InputError("scenarios of one batch must last equally long")
    ends = np.cumsum([len(part) for _, part in flights])
    parts = [slice(end - len(part), end) for end, (_, part) in zip(ends, flights, strict=True)]
    followers = [follower for follower, _ in flights]
    for follower in followers:
        if hasattr(follower, "step") and not hasattr(follower, "reset"):
            name = type(follower).__name__
            raise InputError(f"{name} is a law; mjxball.control.followers.Baseline({name}(config), config) flies it")
        follower.reset()

    told = any(isinstance(follower, Baseline) for follower in followers)

    def act(observation: np.ndarray, privileged: Callable[[], PrivilegedInfo]) -> np.ndarray:
        commands, known = [], privileged() if told else ()
        for follower, part in zip(followers, parts, strict=True):
            if isinstance(follower, Baseline):
                follower.privileged = PrivilegedInfo(*(None if leaf is None else leaf[part] for leaf in known))
            seen = observation[part]
            commands.append(checked_command(getattr(follower, "name", type(follower).__name__), follower(seen), seen))
        return np.concatenate(commands)

    return scenarios, act


def on_pid_of(flights: Flights) -> Float[np.ndarray, " n"]:
    """1.0 for every flight whose follower's base is the leader's whole PID law: a policy, not a baseline."""
    return np.array([0.0 if isinstance(follower, Baseline) else 1.0 for follower, part in flights for _ in part])


def _trajectory(
    config: Config,
    flown: PlantState,
    rows: Sequence[np.ndarray],
    target: np.ndarray,
    diverged: np.ndarray,
    load: Load,
    physics: str,
) -> Trajectory:
    """Of recorded states (T, n, ...) with what goes with each: attitude, commands, observation and CG offset."""
    # The time is exact, so that a mass change falls on the same row for every engine.
    time = np.arange(len(target)) * config.timing.control_period
    flown = flown._replace(time=np.broadcast_to(time[:, None], flown.time.shape))
    euler, leader_command, follower_command, observation, cg_offset = rows
    force, torque = flown_contact_wrenches(config, flown, load, physics)
    return Trajectory(
        time=time,
        position=flown.position,
        velocity=flown.velocity,
        euler=euler,
        rates=flown.rates,
        quaternion=flown.quaternion,
        rotor_force=flown.rotor_force,
        leader_command=leader_command,
        follower_command=follower_command,
        observation=observation,
        cg_offset=cg_offset,
        object_mass=object_mass(flown.time, load),
        contact_force=force,
        contact_torque=torque,
        goal=target[-1],
        target=target,
        diverged=diverged,
    )


def make_privileged_info(config: Config) -> Callable[[PlantState, Load], PrivilegedInfo]:
    """Return `privileged(state, load)`: what a classical follower gets, the truth half a step and a rotor lag ahead.

    Of a rolling ball nobody can know the future: the oracle gets where it is.
    """
    plant = config.plant
    angles, several = mount_angles(plant), len(plant.followers) > 1
    ahead = 0.5 * config.timing.control_period + plant.rotor_lag
    drones = sum(drone.mass for drone in plant.drones) + plant.carrier_mass
    prescribed = None if config.motion.kind == "rolling" else make_prescribed(config)

    def privileged(state: PlantState, load: Load) -> PrivilegedInfo:
        xp = state.time.__array_namespace__()
        mass = object_mass(state.time, load)
        if prescribed is None:
            offset, acceleration = plant.moving_fraction * state.ball_offset, xp.zeros_like(state.ball_offset)
        else:
            offset, _, acceleration = prescribed(state.time + ahead, load)

        def each(value: Array, axes: int = 0) -> Array:
            """What is known of a flight, with the last `axes` of its own, for each of its followers."""
            if not several:
                return value
            place = value.ndim - axes
            shape = (*value.shape[:place], len(plant.followers), *value.shape[place:])
            return xp.broadcast_to(xp.expand_dims(value, axis=place), shape)

        def moment(found: Coordinates) -> Array:
            along = coordinates(found, len(plant.directions))
            if angles is None:
                return mass * along[0]
            parts = [mass * along[plant.directions.index(k)] if k in plant.directions else 0.0 * mass for k in (0, 1)]
            flat = each(xp.stack([*parts, 0.0 * mass], axis=-1), axes=1)
            return rotations.turned_about_z(flat, -angles)[..., :2]

        thrust = load.thrust_scale
        if load.stop_time is not None:
            turns = xp.astype(state.time[..., None] < load.stop_time, state.time.dtype)
            thrust = turns if thrust is None else turns * thrust
        known = each(load.believed_mass), moment(offset), moment(acceleration), each(drones + mass)
        return PrivilegedInfo(*known, None if thrust is None else each(thrust, axes=1))

    return privileged


def flown_contact_wrenches(
    config: Config, flown: PlantState, load: Load, physics: str
) -> tuple[Float[np.ndarray, "T n drones 3"], Float[np.ndarray, "T n drones 3"]]:
    """Contact forces and torques of recorded states (T, n, ...), see `physics.engine.contact_wrenches`.

    `mujoco` reads MuJoCo's own internal forces; the other engines, and flights with a push, share the closed form.
    """
    if physics == "mujoco" and load.external_force is None:
        from mjxball.physics.mujoco import flown_contact_wrenches as measured

        return measured(config, flown, load)
    constants = plant_parameters(config.plant, config.attitude)
    accelerate = make_accelerations(config, newton_euler.make_engine(config.plant, config.attitude))
    wrench = total_wrench(config.plant, constants, flown.rotor_force)
    linear, angular, _ = accelerate(flown, with_external_force(wrench, flown, load), load)
    return contact_wrenches(config.plant, constants, flown, linear, angular)


def targets(config: Config, scenarios: Sequence[Scenario], count: int) -> Float[np.ndarray, "rows n 3"]:
    """Goal of O, count + 1 rows, before the first control step and after each of `count`."""
    time = np.arange(count + 1) * config.timing.control_period
    target = np.empty((count + 1, len(scenarios), 3))
    for number, scenario in enumerate(of_plant(config, one) for one in scenarios):
        target[:, number] = scenario.goal
        for when, goal in scenario.waypoints:
            target[time >= when - 1e-9, number] = goal
    return target


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
    if any(scenario.lost for scenario in scenarios):
        stops = [[dict(s.lost).get(number, np.inf) for number in range(config.plant.count)] for s in scenarios]
        load = load._replace(stop_time=np.array(stops, float))
    return load
