"""The Brax environment: reset and step of one world; nothing but wiring of config, control and physics."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjxball.config import Config, ball_reach
from mjxball.control import crazyflie, observation, rotations
from mjxball.control.recall import recall_of
from mjxball.draws import Draws
from mjxball.nuisance import Nuisances
from mjxball.physics import newton_euler
from mjxball.physics.engine import Load, PlantState
from mjxball.physics.mjx import jax_repeat, make_engine
from mjxball.physics.motion import object_mass
from mjxball.physics.step import ControlStep, make_cg_offset, make_control_step
from mjxball.physics.stepper import TRAINING_ENGINES
from mjxball.quiet import import_brax_env
from mjxball.rewards import paper_reward, task_reward
from mjxball.wiring import Wiring

Array = Any
if TYPE_CHECKING:
    from brax.envs.base import Env, State
else:
    Env, State = import_brax_env()
STEADY_AFTER = 8.0  # [s] of an episode, after which its error counts as steady state in the metrics
SECRETS = 4  # numbers that privileged critics see more where nothing is disturbed
RATE_BOUND = 50.0  # [rad/s] beyond which a world has diverged


class World(NamedTuple):
    """Everything that one world carries from step to step."""

    plant: PlantState
    load: Load
    goal: Array  # (3,) of O [m]
    integral: Array  # (3,) of the leader's error [m s]
    nuisance: Any  # see `nuisance.Nuisance`, () if there is none
    memory: Any  # (m,) see `control.recall`, () if there is none: XLA's partitioner cannot bear arrays of no elements
    action: Array  # (3,) last network action in [-1, 1]
    steps: Array  # () control steps since the reset


class Orders(NamedTuple):
    """What both drones are told for one control period, and what that follows from."""

    led: Array  # (3,) the leader's command
    followed: Array  # (3,) the follower's
    action: Array  # (3,) the network's, zeros if it was not finite
    sound: Array  # () whether it was finite
    seen: Array  # (18,) the observation that it answers


class CoupledPairEnv(Env):
    """Two drones, one object with a moving CG: the follower acts, the leader flies its PID.

    `reset` draws goal, start, CG motion and object mass anew. `step` takes the network's action in
    [-1, 1] (3,). An episode terminates at |e_o| > d_term or when the world diverges, and is truncated at
    `timing.episode_steps`: `done` is 1 in both cases, `info["truncation"]` only in the second. Inside Brax's
    EpisodeWrapper the wrapper keeps the time. A non-finite action counts as divergence.
    """

    def __init__(self, config: Config, physics: str = "mjx"):
        if physics not in TRAINING_ENGINES:
            raise ValueError(f"physics must be one of {TRAINING_ENGINES}, not {physics!r}")
        self.config = config
        self._backend = physics
        self._control_step = _make_step(config, physics)
        self._wiring = Wiring(config)
        self._ball_reach = ball_reach(config.plant)
        self._recall = recall_of(config)
        self._nuisances = Nuisances(config)
        self._draws = Draws(config)
        self._secrets = self._count_secrets() if config.sac.privileged else 0
        self._cg = make_cg_offset(config)
        self._commanded = np.array(observation.commanded(config.follower.load_axis_only, config.plant.cg_axis))

    @property
    def observation_size(self) -> int:
        """Length of the networks' input."""
        return len(self.input_mask)

    @property
    def seen_size(self) -> int:
        """How many numbers of the observation the follower sees and remembers; only critics are told the rest."""
        return observation.OBSERVATION_SIZE + self._recall.size

    @property
    def input_mask(self) -> list[float]:
        """1 for each number of the observation that the policy uses, else 0."""
        return [*self._recall.mask(self.config.follower.ignore_position), *[0.0] * self._secrets]

    @property
    def critic_mask(self) -> list[float]:
        """1 for each number of the observation that the critics use, else 0."""
        return [*self._recall.mask(self.config.follower.ignore_position), *[1.0] * self._secrets]

    @property
    def action_size(self) -> int:
        """Roll, pitch, vertical acceleration."""
        return observation.ACTION_SIZE

    @property
    def backend(self) -> str:
        """Name of the physics engine."""
        return self._backend

    @property
    def dt(self) -> float:
        """Control period [s]."""
        return self.config.timing.control_period

    def reset(self, rng: Array, reach: Array | float = 1.0) -> State:
        """A fresh world at rest or nearly so, drawn from `config.scenario`; `reach` as in `Draws.draw`."""
        load, plant, goal = self._draws.draw(rng, reach)
        truth = self._observe(plant, goal)
        nuisance, first = self._nuisances.start(jax.random.fold_in(rng, 1), truth)
        world = World(
            plant=plant,
            load=load,
            goal=goal,
            integral=jnp.zeros(3),
            nuisance=nuisance,
            memory=self._recall.start(first) if self._recall.size else (),
            action=jnp.zeros(3),
            steps=jnp.zeros((), jnp.int32),
        )
        zero = jnp.zeros(())
        names = ("error", "steady_error", "steady", "diverged", "tilt_error", "vertical_error")
        metrics = dict.fromkeys(names, zero)
        return State(world, self._input(first, truth, world), zero, zero, metrics, {"truncation": zero})

    def step(self, state: State, action: Array) -> State:
        """Apply the network's `action` (3,) in [-1, 1] for one control period."""
        return self._obeyed(state, *self.command(state, action))

    def step_told(self, state: State, followed: Array) -> State:
        """`step` of a follower that is no network: its command `followed` (3,) is flown as it is."""
        orders, load = self.command(state, jnp.zeros(observation.ACTION_SIZE))
        return self._obeyed(state, orders._replace(followed=followed), load)

    def _obeyed(self, state: State, orders: Orders, load: Load) -> State:
        plant = self._control_step(state.pipeline_state.plant, jnp.stack([orders.led, orders.followed]), load)
        return self.arrive(state, orders, plant)

    def command(self, state: State, action: Array) -> tuple[Orders, Load]:
        """What the physics is given for one control period at the network's `action` (3,)."""
        world: World = state.pipeline_state
        sound = jnp.all(jnp.isfinite(action))
        action = jnp.where(sound, action, jnp.zeros_like(action)) * self._commanded
        seen = state.obs[: observation.OBSERVATION_SIZE]
        led = self._wiring.leader_command(world.plant, world.goal, world.integral)
        followed = self._follower_command(action, seen)
        load = world.load._replace(push=world.nuisance.push) if self._nuisances.present else world.load
        return Orders(led, followed, action, sound, seen), load

    def arrive(self, state: State, orders: Orders, plant: PlantState) -> State:
        """What follows once the physics has brought the plant of `state` to `plant`: reward, end, senses, memory."""
        world: World = state.pipeline_state
        led, followed, action, sound, seen = orders
        timing = self.config.timing
        diverged = jnp.logical_or(self._diverged(plant), ~sound)
        plant = jax.tree.map(lambda new, old: jnp.where(diverged, old, new), plant, world.plant)
        error = world.goal - plant.position
        distance = jnp.linalg.norm(error)
        terminated = jnp.logical_or(diverged, distance > self.config.scenario.termination_distance)
        steps = world.steps + 1
        # Brax's EpisodeWrapper keeps the time limit itself, and takes an end that it did not set for a termination.
        wrapped = "steps" in state.info
        truncated = jnp.logical_and(steps >= timing.episode_steps, ~terminated) & (not wrapped)
        reward = self._reward(led, followed, plant, error, action, world.action, terminated)

        truth = self._observe(plant, world.goal)
        nuisance, after = self._nuisances.step(world.nuisance, truth)
        moved = world._replace(
            plant=plant,
            nuisance=nuisance,
            integral=self._wiring.integrated(world.integral, world.plant, world.goal, timing.control_period),
            memory=self._recall.next(world.memory, seen, action) if self._recall.size else (),
            action=action,
            steps=steps,
        )
        steady = (plant.time > STEADY_AFTER).astype(jnp.float32)
        return state.replace(
            pipeline_state=moved,
            obs=self._input(after, truth, moved),
            reward=reward,
            done=jnp.logical_or(terminated, truncated).astype(jnp.float32),
            metrics={
                **state.metrics,
                "error": distance,
                "steady_error": distance * steady,
                "steady": steady,
                "diverged": diverged.astype(jnp.float32),
                "tilt_error": jnp.mean((followed - led)[:2] ** 2),
                "vertical_error": (followed - led)[2] ** 2,
            },
            info={**state.info, "truncation": truncated.astype(jnp.float32)},
        )

    def _observe(self, plant: PlantState, goal: Array) -> Array:
        return self._wiring.observe(plant, goal)

    def _input(self, seen: Array, truth: Array, world: World) -> Array:
        """The networks' input: what the follower sees and remembers, and behind it what only critics are told."""
        shown = self._recall.network_input(seen, world.memory) if self._recall.size else seen
        return jnp.concatenate([shown, self._told(truth, world)]) if self._secrets else shown

    def _told(self, truth: Array, world: World) -> Array:
        """CG offset, first moment, object mass, error of the believed one; of disturbed worlds the truth as well."""
        offset, mass = self._cg(world.plant, world.load), object_mass(world.plant.time, world.load)
        parts: list[Any] = [jnp.stack([offset, mass * offset, mass, mass - world.load.believed_mass])]
        if self._nuisances.present:
            nuisance = world.nuisance
            parts += [truth[3:], nuisance.push, jnp.stack([nuisance.noise, nuisance.delay.astype(jnp.float32)])]
        if self._draws.varies:
            lag: Array = world.load.rotor_lag_scale
            parts += [lag[None], world.load.thrust_scale, world.load.added_inertia]
        if world.plant.loops is not None:
            kept = crazyflie.unpack(world.plant.loops).rate_integral
            parts += [(kept / jnp.asarray(self.config.autopilot.rate_limits)).ravel()]
        if self.config.motion.kind == "rolling":
            parts += [world.plant.ball_rate[None]]
        return jnp.concatenate(parts)

    def _count_secrets(self) -> int:
        clean = observation.OBSERVATION_SIZE - 3 + 5 if self._nuisances.present else 0
        firmware, rolls = self.config.autopilot.kind == "crazyflie", self.config.motion.kind == "rolling"
        return SECRETS + clean + 6 * self._draws.varies + 6 * firmware + rolls

    def _follower_command(self, action: Array, seen: Array) -> Array:
        follower, law = self.config.follower, self.config.leader
        return observation.follower_command(
            action,
            seen,
            follower.action == "residual",
            (follower.tilt_limit, follower.vertical_limit),
            law.kp,
            law.kd,
            self.config.plant.gravity,
            (law.tilt_limit, law.vertical_limit),
        )

    def _reward(
        self, led: Array, followed: Array, plant: PlantState, error: Array, action: Array, last: Array, ended: Array
    ) -> Array:
        if self.config.reward.kind == "paper":
            reward = paper_reward(led, followed)
        else:
            euler = rotations.euler_from_matrix(rotations.matrix_from_quaternion(plant.quaternion))
            weights = self.config.reward
            reward = task_reward(weights, error, plant.velocity, euler, plant.rates, action, last)
            if weights.opposition:
                idle = 1 if self.config.plant.cg_axis == "y" else 0
                reward = reward - weights.opposition * (followed - led)[idle] ** 2
            if weights.ball:
                reward = reward - weights.ball * (plant.ball_offset / self._ball_reach) ** 2
        return reward - jnp.where(ended, self.config.reward.termination, 0.0)

    @staticmethod
    def _diverged(plant: PlantState) -> Array:
        finite = jnp.all(jnp.array([jnp.all(jnp.isfinite(leaf)) for leaf in jax.tree.leaves(plant)]))
        return jnp.logical_or(~finite, jnp.linalg.norm(plant.rates) > RATE_BOUND)


def _make_step(config: Config, physics: str) -> ControlStep:
    make = make_engine if physics == "mjx" else newton_euler.make_engine
    return make_control_step(config, make(config.plant, config.attitude), jax_repeat)
