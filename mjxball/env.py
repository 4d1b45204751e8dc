"""The Brax environment: reset, reward and termination around the closed loop of `sim`."""

from __future__ import annotations

import dataclasses
import functools
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjxball import rewards
from mjxball.arrays import Array
from mjxball.config import Config, ball_limit
from mjxball.control import crazyflie, rotations
from mjxball.control import observation as layout
from mjxball.control.geometry import GEOMETRY_SIZE, team_geometry
from mjxball.errors import InputError
from mjxball.physics.engine import Load, PlantState
from mjxball.physics.motion import object_mass
from mjxball.physics.step import TRAINING_ENGINES, PlantStep, make_cg_offset, make_jax_plant_step
from mjxball.plant import PlantParameters, plant_parameters
from mjxball.sim.closed_loop import ClosedLoop, LoopState, TeamCommands
from mjxball.sim.disturbances import RandomDisturbances, followers_axis
from mjxball.sim.follower import network_interface
from mjxball.sim.goals import Goal
from mjxball.sim.randomization import ResetDistribution, SampledRig
from mjxball.sim.rigs import RigTable, whole
from mjxball.sim.sensors import SensorSettings

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
# Time in an episode after which its error counts as steady state in training's metrics [s]. The goal is reached after
# 4 s; training's episodes last 20 s, and the evaluation's steady state begins only after that.
STEADY_IN_TRAINING_AFTER = 8.0


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class State:
    """The fields of Brax's `State`, whose import takes a second. Arrays may have any leading batch shape."""

    pipeline_state: Any  # `PipelineState`
    obs: Any  # (n,) the networks' input
    reward: Any  # ()
    done: Any  # () 1 at the end of an episode
    metrics: dict[str, Any]
    info: dict[str, Any]

    def replace(self, **fields: Any) -> State:
        """A copy with these `fields` replaced."""
        return dataclasses.replace(self, **fields)


class PipelineState(NamedTuple):
    """State of one world between control steps."""

    loop: LoopState  # plant, leader's integral, sensors
    load: Load
    goal: Float[Array, "3"]  # of O, now [m]
    disturbances: Any  # `sim.disturbances.RandomState`, () without disturbances
    memory: Any  # (m,) the follower's memory, () if m is 0: XLA's partitioner fails on empty arrays
    action: Float[Array, "... 3"]  # last network actions in [-1, 1]
    command: Float[Array, "... 3"]  # last followers' commands: roll, pitch [rad], vertical acceleration [m/s2]
    steps: Int[Array, ""]  # control steps since the reset
    parameters: Any = ()  # `plant.PlantParameters` of this world; () if all worlds have the plant's
    goal_path: Any = ()  # `sim.goals.GoalPath`; () if goals rest

    @property
    def plant(self) -> PlantState:
        """State of the rigid assembly."""
        return self.loop.plant


class TransportEnv:
    """A team that carries one object whose CG moves. The policy flies the followers, a PID interface the leader.

    Implements Brax's `Env`. For a pair, observations are (n,), actions (3,) and the reward (). For F > 1 followers they
    are (F, n), (F, 3) and (F,), each in its mount frame. Worlds of smaller teams are padded to the plant's number of
    drones (`scenario.team_sizes`).

    `reset` samples goal, start, CG motion and object mass. `step` clips the action to [-1, 1]. An episode terminates at
    |e_o| > d_term or when the world diverges, and is truncated at `timing.episode_steps`: `done` is 1 in both cases,
    `info["truncation"]` only in the second. Brax's EpisodeWrapper, if present, truncates instead. An action that is not
    finite counts as divergence.
    """

    def __init__(self, config: Config, physics: str = "mjx"):
        if physics not in TRAINING_ENGINES:
            raise ValueError(f"physics must be one of {TRAINING_ENGINES}, not {physics!r}")
        if "brax.envs.base" in sys.modules:  # Brax's trainers require an instance of its `Env`
            sys.modules["brax.envs.base"].Env.register(type(self))
        self.config = config
        self._backend = physics
        self._disturbances = RandomDisturbances(config)
        self._resets = ResetDistribution(config)
        self._followers = followers_axis(config)
        self._loop = None if self._resets.rigs else self._make_loop()
        self._ball_limit = ball_limit(config.plant)
        self._interface = interface = network_interface(config)
        # Jitted separately: `scalar_form` keeps such calls whole if their arrays are large. `jax.jit` needs a hashable
        # function, which `partial` makes of a method of the unhashable interface.
        parts = self._input, self._answer, interface.next if interface.size else lambda *_: ()
        self._network_input, self._answered, self._remembered = (jax.jit(functools.partial(part)) for part in parts)
        self._cg = make_cg_offset(config)
        mask = layout.action_mask(config.follower.load_axis_only, config.plant.cg_axis)
        self._action_mask = np.append(mask, np.ones(interface.units))
        self._unloaded = 1 if config.plant.cg_axis == "y" else 0  # index of the tilt (roll, pitch) free of CG torque
        self._in_plane = len(config.plant.directions) == 2
        self._privileged_size = 0
        if config.follower.privileged_critic:
            self._privileged_size = jax.eval_shape(self._first_privileged, jax.random.key(0)).shape[-1]

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle the constructor's arguments alone; traced and compiled functions are rebuilt."""
        return type(self), (self.config, self._backend)

    @property
    def observation_size(self) -> int:
        """Length of the networks' input."""
        return len(self.input_mask)

    @property
    def policy_input_size(self) -> int:
        """Length of the policy's part of the observation; the rest is privileged information of the critics."""
        return self._interface.input_size + self._interface.units

    @property
    def input_mask(self) -> list[float]:
        """1 for each entry of the observation that the policy uses, else 0."""
        return [*self._interface.mask(self.config.follower.ignore_position), *[0.0] * self._privileged_size]

    @property
    def critic_mask(self) -> list[float]:
        """1 for each entry of the observation that the critics use, else 0."""
        return [*self._interface.mask(self.config.follower.ignore_position), *[1.0] * self._privileged_size]

    @property
    def team_sizes(self) -> tuple[int, ...] | None:
        """Number of drones in worlds 0, 1, ..., repeated cyclically; None for a pair, which has no followers' axis."""
        return (self.config.scenario.team_sizes or (self.config.plant.count,)) if self._followers else None

    @property
    def action_size(self) -> int:
        """Length of an action: roll, pitch, vertical acceleration, then the next state of a recurrent network."""
        return layout.ACTION_SIZE + self._interface.units

    @property
    def recurrent_slots(self) -> slice:
        """Entries of the observation that hold the state of a recurrent network; empty without one."""
        return slice(self.policy_input_size - self._interface.units, self.policy_input_size)

    @property
    def backend(self) -> str:
        """Name of the physics engine."""
        return self._backend

    @property
    def unwrapped(self) -> TransportEnv:
        """Itself."""
        return self

    @property
    def dt(self) -> float:
        """Control period [s]."""
        return self.config.timing.control_period

    def reset(
        self,
        rng: Array,
        number: Int[Array, ""] | None = None,
        rig: RigTable | None = None,
    ) -> State:
        """A sampled initial state, at rest or nearly so. `number` and `rig` as in `ResetDistribution.sample`."""
        world, observation = self._fresh_world(rng, number, rig)
        zero = jnp.zeros(())
        names = ("error", "steady_error", "steady", "diverged", "tilt_error", "vertical_error")
        metrics = dict.fromkeys(names, zero)
        reward = jnp.zeros(self._followers)
        return State(world, self.seen(world, observation), reward, zero, metrics, {"truncation": zero})

    def step(self, state: State, action: Float[Array, "... actions"], plant_step: PlantStep | None = None) -> State:
        """Apply the network's `action` for one control period. `plant_step`, if given, replaces the engine's.

        The action is clipped to [-1, 1] before the followers, the history and the reward use it. The state (H,) of a
        recurrent network is part of the observation, and its next state the end of `action` (..., 3 + H). InputError,
        while JAX traces, for an action of another shape.
        """
        world: PipelineState = state.pipeline_state
        shape = (*self._followers, self.action_size)
        if jnp.shape(action) != shape:
            raise InputError(f"an action of one world must have shape {shape}, not {jnp.shape(action)}")
        finite = jnp.all(jnp.isfinite(action))
        action = jnp.where(finite, jnp.clip(action, -1.0, 1.0), jnp.zeros_like(action)) * self._action_mask
        command, memory = self._answered(action, self._observed(state), world.memory)
        return self._step(state, command, memory, action, ~finite | world.loop.diverged, plant_step)

    def step_with_command(self, state: State, follower_command: Float[Array, "... 3"]) -> State:
        """`step` with the command of a follower that is no network, which is applied unchanged."""
        world = state.pipeline_state
        action = jnp.zeros((*follower_command.shape[:-1], self.action_size))
        memory = self._remembered(world.memory, self._observed(state), action)
        return self._step(state, follower_command, memory, action, world.loop.diverged)

    def commands(self, state: State, action: Float[Array, "... 3"]) -> tuple[Float[Array, "drones 3"], Load]:
        """(commands of all drones, load) that `step` passes to the physics at the network's `action`."""
        given: list[Any] = []

        def plant_step(plant: PlantState, commands: Float[Array, "drones 3"], load: Load) -> PlantState:
            given.extend((commands, load))
            return plant

        self.step(state, action, plant_step)
        return given[0], given[1]

    def _observed(self, state: State) -> Float[Array, "... 18"]:
        return state.obs[..., : layout.OBSERVATION_SIZE]

    def _step(
        self,
        state: State,
        command: Float[Array, "... 3"],
        memory: Any,
        action: Float[Array, "... actions"],
        diverged: Bool[Array, ""],
        plant_step: PlantStep | None = None,
    ) -> State:
        """The next state after the followers' `command`, with their new `memory`."""
        world: PipelineState = state.pipeline_state
        observation = self._observed(state)
        load, steps = world.load, world.steps + 1
        if self._disturbances.present:
            load = load._replace(external_force=world.disturbances.force, late=world.disturbances.late)
        disturbances, sample = self._disturbances.step(world.disturbances)
        before, goals = world.loop._replace(diverged=diverged), (self.goal(world), self.goal(world, steps))
        closed_loop = self._loop_of(world.parameters)
        loop, after, commands = closed_loop.step(before, observation, command, load, goals, sample, plant_step)
        moved = world._replace(
            loop=loop,
            goal=goals[1].position,
            disturbances=disturbances,
            memory=memory,
            action=action[..., : layout.ACTION_SIZE],
            command=command,
            steps=steps,
        )
        distance = jnp.linalg.norm(goals[1].position - loop.plant.position)
        terminated = jnp.logical_or(loop.diverged, distance > self.config.scenario.termination_distance)
        # Brax's EpisodeWrapper applies the time limit itself, and would take ours for a termination.
        wrapped = "steps" in state.info
        truncated = jnp.logical_and(moved.steps >= self.config.timing.episode_steps, ~terminated) & (not wrapped)
        steady = (loop.plant.time > STEADY_IN_TRAINING_AFTER).astype(jnp.float32)
        difference = commands.follower - commands.leader
        return state.replace(
            pipeline_state=moved,
            obs=self.seen(moved, after),
            reward=rewards.reward(self.config.reward, self._transition(world, moved, goals[1], commands, terminated)),
            done=jnp.logical_or(terminated, truncated).astype(jnp.float32),
            metrics={
                **state.metrics,
                "error": distance,
                "steady_error": distance * steady,
                "steady": steady,
                "diverged": loop.diverged.astype(jnp.float32),
                "tilt_error": jnp.mean(difference[..., :2] ** 2),
                "vertical_error": jnp.mean(difference[..., 2] ** 2),
            },
            info={**state.info, "truncation": truncated.astype(jnp.float32)},
        )

    def _make_loop(self, parameters: PlantParameters | None = None) -> ClosedLoop:
        make = functools.partial(make_jax_plant_step, self.config, self._backend, parameters)
        disturbances = self._disturbances
        return ClosedLoop(self.config, _lazy_plant_step(make), disturbances.sensors, parameters, disturbances.jitters)

    def goal(self, world: PipelineState, steps: Int[Array, ""] | None = None) -> Goal:
        """The goal of O `steps` after the reset, by default now."""
        if world.goal_path == ():
            return Goal(world.goal)
        steps = world.steps if steps is None else steps
        return world.goal_path.at(self.config.timing.control_period * steps.astype(jnp.float32))

    def _loop_of(self, parameters: Any) -> ClosedLoop:
        """The closed loop of a world with these `PipelineState.parameters`."""
        if self.config.rigs.number:
            parameters = whole(parameters, self.config.plant.gravity)
        return self._loop or self._make_loop(parameters)

    def _fresh_world(
        self,
        rng: Array,
        number: Int[Array, ""] | None = None,
        chosen: RigTable | None = None,
    ) -> tuple[PipelineState, Float[Array, "... 18"]]:
        """(world, its first observation)."""
        load, plant, goal, rig = self._resets.sample(rng, number, chosen)
        parameters = () if rig is None else rig.parameters if rig.row is None else rig.row.parameters
        disturbances, sample = self._disturbances.start(jax.random.fold_in(rng, 1))
        settings = disturbances.settings if self._disturbances.present else SensorSettings()
        path = self._resets.goal_path(goal, rng)
        first = Goal(goal) if path == () else path.at(jnp.zeros(()))
        loop, observation = self._loop_of(parameters).start(plant, first, load, sample, settings)
        world = PipelineState(
            loop=loop,
            load=load,
            goal=first.position,
            disturbances=disturbances,
            memory=self._interface.start(observation, self._geometry(rig)) if self._interface.size else (),
            action=jnp.zeros((*self._followers, 3)),
            command=jnp.zeros((*self._followers, 3)),
            steps=jnp.zeros((), jnp.int32),
            parameters=parameters,
            goal_path=path,
        )
        return world, observation

    def _geometry(self, rig: SampledRig | None) -> Any:
        """Mount geometry of a world as given to its followers; None unless they take it."""
        if not self._interface.geometry:
            return None
        plant = self.config.plant
        if rig is not None and rig.row is not None:
            return team_geometry(plant, rig.row.parameters.mounts, rig.row.size)
        parameters = plant_parameters(plant, self.config.attitude) if rig is None else rig.parameters
        mounts, masses = jnp.asarray(parameters.mounts, jnp.float32), jnp.asarray(parameters.drone_mass)
        return team_geometry(plant, mounts, (masses > 0).sum().astype(jnp.float32))

    def seen(self, world: PipelineState, observation: Float[Array, "... 18"]) -> Float[Array, "... input"]:
        """The networks' input: the policy's input, then the critics' privileged information."""
        network_input = self._network_input(observation, world.memory) if self._interface.size else observation
        if self.config.follower.privileged_critic:
            network_input = jnp.concatenate([network_input, self._privileged(world)], axis=-1)
        return network_input

    def _input(self, observation: Float[Array, "... 18"], memory: Float[Array, "... m"]) -> Array:
        """Input of the policy network."""
        if self._interface.geometry:  # the geometry is constant, so no derivatives need be carried through it
            history, geometry = memory[..., :-GEOMETRY_SIZE], memory[..., -GEOMETRY_SIZE:]
            memory = jnp.concatenate([history, jax.lax.stop_gradient(geometry)], axis=-1)
        return self._interface.network_input(observation, memory)

    def _answer(
        self, action: Float[Array, "... actions"], observation: Float[Array, "... 18"], memory: Any
    ) -> tuple[Float[Array, "... 3"], Any]:
        """(command, memory at the next step) for the network's `action`."""
        interface = self._interface
        after = interface.next(memory, observation, action) if interface.size else ()
        return interface.command(action, observation), after

    def _first_privileged(self, rng: Array) -> Float[Array, "... privileged"]:
        return self._privileged(self._fresh_world(rng)[0])

    def _privileged(self, world: PipelineState) -> Float[Array, "... privileged"]:
        """Inputs of the critics alone: CG offset, first moment, object mass, its difference from the assumed mass.

        Depending on the configuration then the undisturbed observation, force and levels of disturbances, actuator
        errors, controllers' integrals, rate of the ball, battery, and the size of the team.
        """
        loop, load = self._loop_of(world.parameters), world.load
        offset, mass = self._cg(world.plant, load), object_mass(world.plant.time, load)
        if self._in_plane:
            offset = loop.seen_by_followers(offset)
        offset = jnp.atleast_1d(offset)
        masses = jnp.stack([mass, mass - load.believed_mass])
        parts: list[Any] = [offset, mass * offset, masses]
        if self._disturbances.present:
            goal, disturbed = self.goal(world), world.disturbances
            truth = loop.observe(world.plant, goal.position, goal.rate)
            levels = jnp.stack([disturbed.noise, disturbed.settings.delay.astype(jnp.float32)])
            force = loop.seen_by_followers(disturbed.force) if self._followers else disturbed.force
            parts += [truth[..., 3:], force, levels]
        if self._resets.varies:
            lag: Array = load.rotor_lag_scale
            thrust: Array = load.thrust_scale
            parts += [lag[None], self._leaders_and_own(thrust), load.added_inertia]
        if world.plant.loops is not None:
            integrals = crazyflie.unpack(world.plant.loops).rate_integral
            parts += [(integrals / jnp.asarray(crazyflie.RATE_LIMITS)).ravel()]
        if self.config.motion.kind == "rolling":
            rate = world.plant.ball_rate
            parts += [loop.seen_by_followers(rate) if self._in_plane else rate[None]]
        if load.battery is not None:
            battery: Array = load.battery
            uncompensated: Array = load.uncompensated
            parts += [jnp.stack([battery, uncompensated])]
        if self.config.scenario.team_sizes:
            parts += [(world.parameters.drone_mass > 0).sum()[None] / self.config.plant.count]
        return jnp.concatenate([jnp.broadcast_to(part, (*self._followers, part.shape[-1])) for part in parts], axis=-1)

    def _leaders_and_own(self, each: Float[Array, " drones"]) -> Float[Array, "... 2"]:
        """(leader's, follower's own) entries, one pair per follower, of a value for each drone."""
        if not self._followers:
            return each
        own = each[np.array(self.config.plant.followers)]
        return jnp.stack([jnp.broadcast_to(each[self.config.plant.leader], own.shape), own], axis=-1)

    def _transition(
        self,
        before: PipelineState,
        after: PipelineState,
        goal: Goal,
        commands: TeamCommands,
        terminated: Bool[Array, ""],
    ) -> rewards.RewardInputs:
        """Inputs of the reward of the step from `before` to `after`."""
        plant = after.plant
        remembers = bool(self.config.follower.observation_averages)
        return rewards.RewardInputs(
            error=goal.position - plant.position,
            velocity=plant.velocity if goal.rate is None else plant.velocity - goal.rate,
            euler=rotations.euler_from_matrix(rotations.matrix_from_quaternion(plant.quaternion)),
            rates=plant.rates,
            action=after.action,
            last_action=before.action,
            command_change=after.command - before.command,
            action_average=self._interface.history.slowest_action(before.memory) if remembers else None,
            leader_command=commands.leader,
            follower_command=commands.follower,
            tilt_disagreement=(commands.follower - commands.leader)[..., self._unloaded],
            spread=self._spread(commands.follower, after.parameters) if self._followers else None,
            ball=jnp.atleast_1d(plant.ball_offset / self._ball_limit),
            rotors=self._rotors(after) if rewards.used(self.config.reward.rotor_limits) else None,
            terminated=terminated,
        )

    def _rotors(self, world: PipelineState) -> Float[Array, " rotors"]:
        """Forces of all rotors over their largest; half for padding."""
        load, plant = world.load, self.config.plant
        own = plant_parameters(plant, self.config.attitude) if world.parameters == () else world.parameters
        most: Array = jnp.asarray(own.rotor_force_max, jnp.float32)
        most = most if load.thrust_scale is None else most * load.thrust_scale
        share = world.plant.rotor_force / jnp.maximum(most, 1e-9)[..., None]
        return jnp.where(most[..., None] > 0, share, 0.5).reshape(-1)

    def _spread(self, commands: Float[Array, "followers 3"], rig: Any) -> Float[Array, "followers 3"]:
        """What of the commands moves nothing; 0 for padding.

        Of roll and pitch this is the deviation from the mean over the followers that fly. Of the vertical command it is
        the deviation from the plane over the mounts that fits best: a plane turns the load.
        """
        followers = np.array(self.config.plant.followers)
        if rig == ():
            mounts = np.array([drone.mount for drone in self.config.plant.drones])[followers]
            flies: Any = np.ones(len(followers))
        else:
            mounts, flies = rig.mounts[followers], (rig.drone_mass[followers] > 0).astype(jnp.float32)
        rest = flies[:, None] * commands
        mean = rest.sum(axis=0) / flies.sum()
        vertical: Array = rest[:, 2]
        axes: list[Array] = []
        for direction in (flies, flies * mounts[:, 0], flies * mounts[:, 1]):
            axis = direction
            for other in axes:
                axis = axis - (axis * other).sum() * other
            length = jnp.sqrt((axis * axis).sum() + 1e-12)
            # Of one or two followers, or of some in a line, a direction is none of its own.
            axis = jnp.where(length > 1e-3 * jnp.sqrt((direction * direction).sum() + 1e-12), axis / length, 0.0 * axis)
            vertical = vertical - (vertical * axis).sum() * axis
            axes.append(axis)
        return jnp.concatenate([flies[:, None] * (commands - mean)[:, :2], vertical[:, None]], axis=-1)

    @staticmethod
    def report(totals: Any, peaks: Any, count: float, evaluation: bool) -> dict[str, Any]:
        """Columns of metrics.csv, (members,), from `totals` of `metrics` over `count` steps and their maxima, `peaks`.

        `totals` (members,), `peaks` (members, worlds). steady_error: mean |e_o| later than 8 s into an episode [m];
        peak: mean over worlds of its maximum [m]; tilt_error, vertical_error: rms difference between the followers' and
        the leader's commands [rad, m/s2].
        """
        steady = totals["steady"]
        nan_if_none = np.where(steady > 0, 0.0, np.nan)
        columns = {"steady_error": totals["steady_error"] / np.maximum(steady, 1) + nan_if_none}
        if evaluation:
            columns["peak"] = peaks["steady_error"].mean(axis=-1) + nan_if_none
            columns |= {name: np.sqrt(totals[name] / count) for name in ("tilt_error", "vertical_error")}
        return columns


def _lazy_plant_step(make: Callable[[], PlantStep]) -> PlantStep:
    """The step that `make` returns, built at its first call: programs that only reset worlds need no engine.

    If JAX traces that call, the engine is built outside the trace.
    """

    @functools.cache
    def made() -> PlantStep:
        with jax.ensure_compile_time_eval():
            return make()

    def plant_step(state: PlantState, commands: Float[Array, "... drones 3"], load: Load) -> PlantState:
        return made()(state, commands, load)

    return plant_step
