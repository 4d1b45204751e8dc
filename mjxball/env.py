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
from mjxball.physics import newton_euler
from mjxball.physics.engine import Load, PlantState
from mjxball.physics.motion import object_mass
from mjxball.physics.step import TRAINING_ENGINES, ControlStep, jax_repeat, make_cg_offset, make_control_step
from mjxball.plant import PlantParameters, plant_parameters
from mjxball.sim.closed_loop import ClosedLoop, Commands, LoopState
from mjxball.sim.disturbances import RandomDisturbances, followers_axis
from mjxball.sim.follower import follower_law
from mjxball.sim.randomization import ResetDistribution, Rig
from mjxball.sim.rigs import RigTable, whole

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int
# [s] of an episode, after which its error counts as steady state in training's metrics. Episodes last 20 s, after which
# alone the evaluation counts; the goal is reached after 4 s.
STEADY_IN_TRAINING_AFTER = 8.0


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class State:
    """The fields of Brax's `State`. Brax itself takes a second to import, most of it for meshes."""

    pipeline_state: Any  # `PipelineState`
    obs: Any  # (n,) the networks' input; like all that follow with any leading batch shape, or without arrays as a tree
    reward: Any  # ()
    done: Any  # () 1 at an end
    metrics: dict[str, Any]
    info: dict[str, Any]

    def replace(self, **fields: Any) -> State:
        """The same with other `fields`."""
        return dataclasses.replace(self, **fields)


class PipelineState(NamedTuple):
    """Everything that one world carries from step to step."""

    loop: LoopState  # plant, leader's integral, sensors
    load: Load
    goal: Float[Array, "3"]  # of O [m]
    disturbances: Any  # `sim.disturbances.RandomState`, () if nothing is disturbed
    history: Any  # (m,) what the follower remembers; () if none: XLA's partitioner cannot bear arrays of no elements
    action: Float[Array, "... 3"]  # last network actions in [-1, 1]
    command: Float[Array, "... 3"]  # the followers' last, roll, pitch [rad], vertical acceleration [m/s2]
    steps: Int[Array, ""]  # control steps since the reset
    rig: Any = ()  # its own `plant.PlantParameters`; () if all worlds have the plant's

    @property
    def plant(self) -> PlantState:
        """State of the rigid assembly."""
        return self.loop.plant


class TransportEnv:
    """A team with one object whose CG moves: the followers act, the leader flies its PID. Brax's `Env` interface.

    Of a pair observations are (n,), actions (3,) and the reward (). Of F > 1 followers they are (F, n), (F, 3) and
    (F,), each in its mount frame; worlds of smaller teams are padded to the plant's drones (`scenario.team_sizes`).

    `reset` draws goal, start, CG motion and object mass anew. `step` takes the network's action (3,) and clips it to
    [-1, 1]. An episode terminates at |e_o| > d_term or when the world diverges, and is truncated at
    `timing.episode_steps`: `done` is 1 in both cases, `info["truncation"]` only in the second. Inside Brax's
    EpisodeWrapper the wrapper keeps the time. A non-finite action counts as divergence.
    """

    def __init__(self, config: Config, physics: str = "mjx"):
        if physics not in TRAINING_ENGINES:
            raise ValueError(f"physics must be one of {TRAINING_ENGINES}, not {physics!r}")
        if "brax.envs.base" in sys.modules:  # Brax's trainers ask whether it is an `Env` of Brax's
            sys.modules["brax.envs.base"].Env.register(type(self))
        self.config = config
        self._backend = physics
        self._disturbances = RandomDisturbances(config)
        self._resets = ResetDistribution(config)
        self._followers = followers_axis(config)
        self._loop = None if self._resets.rigs else self._make_loop()
        self._ball_limit = ball_limit(config.plant)
        self._law = law = follower_law(config)
        # Calls of their own, which `scalar_form` leaves as they are if their arrays are large. A law has no
        # hash, as `jax.jit` wants; `partial` has.
        parts = self._input, self._answer, law.next if law.size else lambda *_: ()
        self._law_seen, self._answered, self._remembered = (jax.jit(functools.partial(part)) for part in parts)
        self._cg = make_cg_offset(config)
        commanded = layout.commanded(config.follower.load_axis_only, config.plant.cg_axis)
        self._commanded = np.append(commanded, np.ones(law.units))
        self._unloaded = 1 if config.plant.cg_axis == "y" else 0  # of roll and pitch the one that no load turns
        self._in_plane = len(config.plant.directions) == 2
        self._privileged_size = 0
        if config.follower.privileged_critic:
            self._privileged_size = jax.eval_shape(self._first_privileged, jax.random.key(0)).shape[-1]

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickled by its arguments: what it traces and compiles is made again where it arrives."""
        return type(self), (self.config, self._backend)

    @property
    def observation_size(self) -> int:
        """Length of the networks' input."""
        return len(self.input_mask)

    @property
    def policy_input_size(self) -> int:
        """How many numbers of the observation the follower sees and remembers; only critics are told the rest."""
        return self._law.input_size + self._law.units

    @property
    def input_mask(self) -> list[float]:
        """1 for each number of the observation that the policy uses, else 0."""
        return [*self._law.mask(self.config.follower.ignore_position), *[0.0] * self._privileged_size]

    @property
    def critic_mask(self) -> list[float]:
        """1 for each number of the observation that the critics use, else 0."""
        return [*self._law.mask(self.config.follower.ignore_position), *[1.0] * self._privileged_size]

    @property
    def team_sizes(self) -> tuple[int, ...] | None:
        """Numbers of drones of worlds 0, 1, ..., again and again; None for a pair, which has no followers' axis."""
        return (self.config.scenario.team_sizes or (self.config.plant.count,)) if self._followers else None

    @property
    def action_size(self) -> int:
        """Roll, pitch, vertical acceleration, and behind them the next state of a recurrent network."""
        return layout.ACTION_SIZE + self._law.units

    @property
    def recurrent_slots(self) -> slice:
        """Where the observation holds the state of a recurrent network; empty without one."""
        return slice(self.policy_input_size - self._law.units, self.policy_input_size)

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
        """A fresh world at rest or nearly so; its `number` and `rig` as in `ResetDistribution.draw`."""
        world, observation = self._fresh_world(rng, number, rig)
        zero = jnp.zeros(())
        names = ("error", "steady_error", "steady", "diverged", "tilt_error", "vertical_error")
        metrics = dict.fromkeys(names, zero)
        reward = jnp.zeros(self._followers)
        return State(world, self.seen(world, observation), reward, zero, metrics, {"truncation": zero})

    def step(self, state: State, action: Float[Array, "... actions"], physics: ControlStep | None = None) -> State:
        """Apply the network's `action` for one control period, with `physics` in place of the engine.

        What lies outside [-1, 1] is clipped: followers, history and reward know no more. What a recurrent network
        remembers is part of the state and of the observation: it is then a function without memory, whose answer
        (..., 3 + H) ends with its next state. Raises InputError, as JAX traces it, for an action of another shape.
        """
        world: PipelineState = state.pipeline_state
        shape = (*self._followers, self.action_size)
        if jnp.shape(action) != shape:
            raise InputError(f"an action of one world must have shape {shape}, not {jnp.shape(action)}")
        finite = jnp.all(jnp.isfinite(action))
        action = jnp.where(finite, jnp.clip(action, -1.0, 1.0), jnp.zeros_like(action)) * self._commanded
        command, memory = self._answered(action, self._observed(state), world.history)
        return self._step(state, command, memory, action, ~finite | world.loop.diverged, 1.0, physics)

    def step_with_command(self, state: State, follower_command: Float[Array, "... 3"]) -> State:
        """`step` of a follower that is no network: `follower_command` is flown as it is."""
        world = state.pipeline_state
        action = jnp.zeros((*follower_command.shape[:-1], self.action_size))
        memory = self._remembered(world.history, self._observed(state), action)
        return self._step(state, follower_command, memory, action, world.loop.diverged, 0.0)

    def commands(self, state: State, action: Float[Array, "... 3"]) -> tuple[Float[Array, "drones 3"], Load]:
        """What the physics is given for one control period at the network's `action`; see `step`."""
        given: list[Any] = []

        def physics(plant: PlantState, commands: Float[Array, "drones 3"], load: Load) -> PlantState:
            given.extend((commands, load))
            return plant

        self.step(state, action, physics)
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
        on_pid: float,
        physics: ControlStep | None = None,
    ) -> State:
        """The next state at the followers' `command`, who then have that `memory`; `on_pid`: see `ClosedLoop.step`."""
        world: PipelineState = state.pipeline_state
        observation = self._observed(state)
        load = world.load
        if self._disturbances.present:
            load = load._replace(external_force=world.disturbances.force)
        disturbances, sample = self._disturbances.step(world.disturbances)
        before, goals = world.loop._replace(diverged=diverged), (world.goal, world.goal)
        own = self._loop_of(world.rig)
        loop, after, commands = own.step(before, observation, command, load, goals, sample, on_pid, physics)
        moved = world._replace(
            loop=loop,
            disturbances=disturbances,
            history=memory,
            action=action[..., : layout.ACTION_SIZE],
            command=command,
            steps=world.steps + 1,
        )
        distance = jnp.linalg.norm(world.goal - loop.plant.position)
        terminated = jnp.logical_or(loop.diverged, distance > self.config.scenario.termination_distance)
        # Brax's EpisodeWrapper keeps the time limit itself, and takes an end that it did not set for a termination.
        wrapped = "steps" in state.info
        truncated = jnp.logical_and(moved.steps >= self.config.timing.episode_steps, ~terminated) & (not wrapped)
        steady = (loop.plant.time > STEADY_IN_TRAINING_AFTER).astype(jnp.float32)
        difference = commands.follower - commands.leader
        return state.replace(
            pipeline_state=moved,
            obs=self.seen(moved, after),
            reward=rewards.reward(self.config.reward, self._transition(world, moved, commands, terminated)),
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

    def _make_loop(self, rig: PlantParameters | None = None) -> ClosedLoop:
        physics = _made_when_called(functools.partial(make_physics, self.config, self._backend, rig))
        return ClosedLoop(self.config, physics, self._disturbances.sensors, rig)

    def _loop_of(self, rig: Any) -> ClosedLoop:
        """The closed loop of a world with that `rig`."""
        return self._loop or self._make_loop(whole(rig, self.config.plant.gravity) if self.config.rigs.number else rig)

    def _fresh_world(
        self,
        rng: Array,
        number: Int[Array, ""] | None = None,
        chosen: RigTable | None = None,
    ) -> tuple[PipelineState, Float[Array, "... 18"]]:
        """(world, observation at its start)."""
        load, plant, goal, rig = self._resets.draw(rng, number, chosen)
        numbers = () if rig is None else rig.numbers if rig.drawn is None else rig.drawn.numbers
        disturbances, sample = self._disturbances.start(jax.random.fold_in(rng, 1))
        delay = disturbances.delay if self._disturbances.present else 0
        begins = self._resets.has_battery and self.config.follower.residual_on_pid
        integral = self._resets.initial_integrals(load, jax.random.fold_in(rng, 5)) if begins else None
        loop, observation = self._loop_of(numbers).start(plant, goal, sample, delay, integral)
        world = PipelineState(
            loop=loop,
            load=load,
            goal=goal,
            disturbances=disturbances,
            history=self._law.start(observation, self._geometry(rig)) if self._law.size else (),
            action=jnp.zeros((*self._followers, 3)),
            command=jnp.zeros((*self._followers, 3)),
            steps=jnp.zeros((), jnp.int32),
            rig=numbers,
        )
        return world, observation

    def _geometry(self, rig: Rig | None) -> Any:
        """Where the drones of a world are mounted, as its followers are told it; None if they are not."""
        if not self._law.geometry:
            return None
        plant = self.config.plant
        if rig is not None and rig.drawn is not None:
            return team_geometry(plant, rig.drawn.numbers.mounts, rig.drawn.size)
        numbers = plant_parameters(plant, self.config.attitude) if rig is None else rig.numbers
        mounts, masses = jnp.asarray(numbers.mounts, jnp.float32), jnp.asarray(numbers.drone_mass)
        return team_geometry(plant, mounts, (masses > 0).sum().astype(jnp.float32))

    def seen(self, world: PipelineState, observation: Float[Array, "... 18"]) -> Float[Array, "... input"]:
        """The networks' input: what followers see and remember, and behind it what only critics are given."""
        shown = self._law_seen(observation, world.history) if self._law.size else observation
        if self.config.follower.privileged_critic:
            shown = jnp.concatenate([shown, self._privileged(world)], axis=-1)
        return shown

    def _input(self, observation: Float[Array, "... 18"], memory: Float[Array, "... m"]) -> Array:
        """Input of the network."""
        if self._law.geometry:  # nothing is learnt from what never changes: no derivatives need be carried through it
            changes, told = memory[..., :-GEOMETRY_SIZE], memory[..., -GEOMETRY_SIZE:]
            memory = jnp.concatenate([changes, jax.lax.stop_gradient(told)], axis=-1)
        return self._law.network_input(observation, memory)

    def _answer(
        self, action: Float[Array, "... actions"], observation: Float[Array, "... 18"], memory: Any
    ) -> tuple[Float[Array, "... 3"], Any]:
        """(command, memory of the next step) of the network's `action`."""
        law = self._law
        return law.command(action, observation), law.next(memory, observation, action) if law.size else ()

    def _first_privileged(self, rng: Array) -> Float[Array, "... privileged"]:
        return self._privileged(self._fresh_world(rng)[0])

    def _privileged(self, world: PipelineState) -> Float[Array, "... privileged"]:
        """CG offset, first moment, object mass, error of the believed one; of disturbed worlds the truth as well."""
        loop, load = self._loop_of(world.rig), world.load
        offset, mass = self._cg(world.plant, load), object_mass(world.plant.time, load)
        if self._in_plane:
            offset = loop.seen_by_followers(offset)
        place = jnp.atleast_1d(offset)
        masses = jnp.stack([mass, mass - load.believed_mass])
        parts: list[Any] = [place, mass * place, masses]
        if self._disturbances.present:
            truth, disturbed = loop.observe(world.plant, world.goal), world.disturbances
            levels = jnp.stack([disturbed.noise, disturbed.delay.astype(jnp.float32)])
            force = loop.seen_by_followers(disturbed.force) if self._followers else disturbed.force
            parts += [truth[..., 3:], force, levels]
        if self._resets.varies:
            lag: Array = load.rotor_lag_scale
            thrust: Array = load.thrust_scale
            parts += [lag[None], self._own_and_leaders(thrust), load.added_inertia]
        if world.plant.loops is not None:
            integrals = crazyflie.unpack(world.plant.loops).rate_integral
            parts += [(integrals / jnp.asarray(crazyflie.RATE_LIMITS)).ravel()]
        if self.config.motion.kind == "rolling":
            rate = world.plant.ball_rate
            parts += [loop.seen_by_followers(rate) if self._in_plane else rate[None]]
        if self.config.follower.residual_on_pid:
            parts += [world.loop.integral]
        if load.battery is not None:
            battery: Array = load.battery
            uncompensated: Array = load.uncompensated
            parts += [jnp.stack([battery, uncompensated])]
        if self.config.scenario.team_sizes:
            parts += [(world.rig.drone_mass > 0).sum()[None] / self.config.plant.count]
        return jnp.concatenate([jnp.broadcast_to(part, (*self._followers, part.shape[-1])) for part in parts], axis=-1)

    def _own_and_leaders(self, each: Float[Array, " drones"]) -> Float[Array, "... 2"]:
        """Of a number of every drone the leader's and the follower's own."""
        if not self._followers:
            return each
        own = each[np.array(self.config.plant.followers)]
        return jnp.stack([jnp.broadcast_to(each[self.config.plant.leader], own.shape), own], axis=-1)

    def _transition(
        self, before: PipelineState, after: PipelineState, commands: Commands, terminated: Bool[Array, ""]
    ) -> rewards.Transition:
        plant = after.plant
        remembers = bool(self.config.follower.observation_averages)
        return rewards.Transition(
            error=after.goal - plant.position,
            velocity=plant.velocity,
            euler=rotations.euler_from_matrix(rotations.matrix_from_quaternion(plant.quaternion)),
            rates=plant.rates,
            action=after.action,
            last_action=before.action,
            command_change=after.command - before.command,
            action_average=self._law.history.slowest_action(before.history) if remembers else None,
            leader_command=commands.leader,
            follower_command=commands.follower,
            tilt_disagreement=(commands.follower - commands.leader)[..., self._unloaded],
            spread=self._spread(commands.follower, after.rig) if self._followers else None,
            ball=jnp.atleast_1d(plant.ball_offset / self._ball_limit),
            terminated=terminated,
        )

    def _spread(self, commands: Float[Array, "followers 3"], rig: Any) -> Float[Array, "followers 3"]:
        """Commands less their mean over the followers that fly."""
        if rig == ():
            return commands - commands.mean(axis=0)
        flies = (rig.drone_mass[np.array(self.config.plant.followers)] > 0)[:, None]
        return flies * (commands - (flies * commands).sum(axis=0) / flies.sum())

    @staticmethod
    def report(totals: Any, peaks: Any, count: float, evaluation: bool) -> dict[str, Any]:
        """What metrics.csv says of `metrics` summed over `count` steps: arrays (members,), `peaks` (members, worlds).

        steady_error: mean |e_o| later than 8 s into an episode [m]; peak: mean over worlds of the largest; tilt_error,
        vertical_error: rms difference of the commands to the leader's [rad, m/s2].
        """
        steady = totals["steady"]
        nothing = np.where(steady > 0, 0.0, np.nan)
        found = {"steady_error": totals["steady_error"] / np.maximum(steady, 1) + nothing}
        if evaluation:
            found["peak"] = peaks["steady_error"].mean(axis=-1) + nothing
            found |= {name: np.sqrt(totals[name] / count) for name in ("tilt_error", "vertical_error")}
        return found


def _made_when_called(make: Callable[[], ControlStep]) -> ControlStep:
    """What `make` returns, made at the first call: programs that only reset worlds need no engine.

    A call may be traced by JAX, and what is made is then no part of what is traced.
    """

    @functools.cache
    def made() -> ControlStep:
        with jax.ensure_compile_time_eval():
            return make()

    def control_step(state: PlantState, commands: Float[Array, "... drones 3"], load: Load) -> PlantState:
        return made()(state, commands, load)

    return control_step


def make_physics(config: Config, physics: str, rig: PlantParameters | None = None) -> ControlStep:
    """The control step of the engine `physics`, mjx or newton-euler, for one world; use `jax.vmap` for many.

    `rig`: the world's own numbers, if they are not those of `config.plant`.
    """
    make = newton_euler.make_engine
    if physics == "mjx":
        from mjxball.physics.mjx import make_engine as make  # takes a second to import
    return make_control_step(config, make(config.plant, config.attitude, rig), jax_repeat, rig)
