"""A flown policy fine-tuned for a load that was identified in flight: gradients through the Crazyflies' closed form.

The worlds begin where the flight is, integrals and observation history included, and are flown ahead by the old weights
to where new ones could take over. From there `gradient.horizon` control steps after the other are flown and
differentiated. Everything is compiled beforehand (`FineTuner.compile`); load and flight are arguments of the programs.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjxball.algorithms.base import Phase
from mjxball.algorithms.gradient import FirstOrderGradient, GradientState
from mjxball.config import Config, to_dict
from mjxball.env import PipelineState, TransportEnv
from mjxball.policy import PolicyFile
from mjxball.policy.export import with_network
from mjxball.sim.disturbances import Sample
from mjxball.sim.follower import follower_law
from mjxball.train.compilation import CPU_OPTIONS, TracedProgram
from mjxball.train.program import MATMUL_PRECISION, Environments
from mjxball.train.run_directory import source_hash, versions

Array = Any
LEARN = Phase(np.asarray(False), np.asarray(False))
AHEAD = 4.0  # [s] that the old weights fly before the new ones could
CHECKED = 15.0  # [s] of flight in which old and new weights are compared
COMPARED = 8  # worlds in which they are
PLACES = 16  # waypoints of a CG: an even number, so that it goes to and fro
MOST_STEPS = 12  # of Adam
SHARES = (0.0, 0.25, 0.5, 1.0)  # of the way from the old weights to the last ones: what is compared
RESERVE = 1.2  # times a step's own time that must be left for the next one
WORTH = 0.9  # of the old weights' cost, at most: what is no better than that is not worth a change in flight
BUSY = 1.5  # times what the comparison took before the flight that it may take in flight
# What training varies about what was identified: masses by a share, the others in [m], rad, m/s.
MASS_SPREAD, OFFSET_SPREAD, SWING_SPREAD, SPEED_SPREAD, PHASE_SPREAD = 0.01, 0.001, 0.1, 0.05, 0.2
PLACE_SPREAD, VELOCITY_SPREAD = 0.005, 0.01
SURROUNDINGS: dict[str, Any] = {  # of `config.scenario`: what the twin meets, as far as a simulation knows it
    "noise": (0.0, 0.25),
    "delay": (0.01, 0.03),
    "estimator_drift": (0.0, 0.5),
    "quantize": False,  # no gradient passes what is rounded
    "gust": (0.0, 0.0),
    "rotor_lag_scale": (0.8, 1.25),
    "thrust_scale": (0.997, 1.003),  # how uneven the motors are is part of the CG's offset that was identified
    "thrust_scale_common": (1.0, 1.0),
    "inertia_scale": (0.95, 1.05),
    "cg_waypoint_probability": 1.0,  # a motion about another place than O is a way to and fro between two places
}
OBJECTIVE: dict[str, Any] = {}  # of `config.reward`
SETTINGS: dict[str, Any] = {  # of `config.gradient`
    "num_envs": 16,
    "horizon": 150,
    "learning_rate": 1e-3,
    "learning_rate_final_ratio": 0.1,
    "max_grad_norm": 1.0,
    "gradient_decay": 0.97,
    "windows_per_episode": (1_000_000,),  # one flight, window after window
}


class KnownLoad(NamedTuple):
    """The object with its load as it was identified. Numbers, or traced scalars."""

    mass: Any  # of both together [kg]
    cg_offset: Any  # mean place of their common CG from O along the CG axis [m]
    cg_amplitude: Any  # of its motion about that place, a sine [m]
    cg_speed: Any  # its angular speed [rad/s]
    cg_phase: Any  # its phase now [rad]
    battery: Any  # under load [V]
    uncompensated: Any  # 1 if the firmwares do not compensate for the battery, else 0


class FlightState(NamedTuple):
    """Where a flight is: what its runner measures, and what its laws remember."""

    position: Any  # (3,) of O [m]
    velocity: Any  # (3,) [m/s]
    quaternion: Any  # (4,) body -> world (w, x, y, z)
    rates: Any  # (3,) body axes [rad/s]
    goal: Any  # (3,) of O [m]
    integral: Any  # of both laws, see `sim.laws.Laws`
    history: Any  # (m,) the policy's, see `control.follower_law.FollowerLaw`


class FineTuned(NamedTuple):
    """What came out."""

    contents: PolicyFile | None  # None: not finite, or hardly better than what it came from
    before: float  # minus the mean reward of the old weights in the comparison
    after: float  # that of the best ones
    share: float  # of the way from the old weights to the last ones at which those are
    steps: int  # of Adam
    seconds: float  # that it took


class LoadedEnv(TransportEnv):
    """`TransportEnv` whose worlds begin at one state of a flight, or nearly so, with one known load."""

    def __init__(self, config: Config, load: KnownLoad, flight: FlightState):
        super().__init__(config, "newton-euler")
        self._known, self._flight = load, flight

    def reset(self, rng: Array, difficulty: Any = 1.0, number: Any = None, rig: Any = None) -> Any:
        """A world with that load; see `TransportEnv.reset`."""
        state = super().reset(rng, difficulty, number, rig)
        world: PipelineState = state.pipeline_state
        known, flight, draw = self._known, self._flight, jax.random.normal(jax.random.fold_in(rng, 11), (11,))
        mass = known.mass * (1.0 + MASS_SPREAD * draw[0])
        middle = known.cg_offset + OFFSET_SPREAD * draw[1]
        swing = known.cg_amplitude * (1.0 + SWING_SPREAD * draw[2]) * (-1.0) ** jnp.arange(PLACES)
        # A way from one place to the next, which takes a phase of pi, begins where the sine is at its top.
        phase = (known.cg_phase + PHASE_SPREAD * draw[4] - jnp.pi / 2) % (2 * jnp.pi)
        load = world.load._replace(
            object_mass=mass,
            cg_amplitude=jnp.ones_like(mass),
            cg_speed=known.cg_speed * (1.0 + SPEED_SPREAD * draw[3]),
            cg_phase=phase,
            cg_path=middle + swing,
            follows_path=jnp.ones_like(mass),
            battery=jnp.zeros_like(mass) + known.battery,
            uncompensated=jnp.zeros_like(mass) + known.uncompensated,
        )
        plant = world.plant._replace(
            position=flight.position + PLACE_SPREAD * draw[5:8],
            velocity=flight.velocity + VELOCITY_SPREAD * draw[8:11],
            quaternion=flight.quaternion,
            rates=flight.rates,
        )
        delay = world.disturbances.delay if self._disturbances.present else 0
        loop, observation = self._loop_of(()).start(plant, flight.goal, Sample(), delay, flight.integral)
        history = flight.history if self._law.size else ()
        moved = world._replace(loop=loop, load=load, goal=flight.goal, history=history)
        return state.replace(pipeline_state=moved, obs=self.seen(moved, observation))


def fine_tuning_config(flown: Config, gradient: dict[str, Any]) -> Config:
    """`flown`, a policy's own configuration, for flights of one load near hover."""
    return dataclasses.replace(
        flown,
        scenario=dataclasses.replace(flown.scenario, **SURROUNDINGS),
        reward=dataclasses.replace(flown.reward, **OBJECTIVE),
        follower=dataclasses.replace(flown.follower, privileged_critic=False),
        gradient=dataclasses.replace(flown.gradient, **gradient),
        timing=dataclasses.replace(flown.timing, episode_steps=1_000_000),
    )


class FineTuner:
    """Programs that fine-tune one flown policy.

    `compile` takes half a minute, or five seconds if the cache has the programs; `fine_tune` as long as it is given.
    """

    def __init__(self, config: Config, flown: PolicyFile, settings: dict[str, Any] | None = None):
        hidden = tuple(bias.shape[0] for bias in flown.biases[:-1])
        self.config = fine_tuning_config(config, {**SETTINGS, "policy_layers": hidden, **(settings or {})})
        self._flown, self._worlds = flown, self.config.gradient.num_envs
        self._programs: dict[str, Any] = {}
        self._comparing = 0.0  # [s] that it takes to compare
        environments = self._environments(nominal_load(self.config), resting(self.config))
        self._algorithm = FirstOrderGradient(self.config, environments)
        blank = jax.tree.map(np.asarray, self._algorithm.init(jax.random.PRNGKey(0)))
        self._start = jax.tree.map(jnp.asarray, self._algorithm.start_from(blank, flown))

    def compile(self, progress: Callable[[str], None] = lambda text: None) -> None:
        """Compile all programs; `progress` is called with a few words after each."""
        load, flight, key = nominal_load(self.config), resting(self.config), jax.random.PRNGKey(0)
        worlds = jax.eval_shape(self._begin, load, flight, key)
        stacked = jax.tree.map(lambda leaf: np.stack([leaf] * len(SHARES)), self._start.layers)
        start = self._start
        asked: dict[str, tuple[Any, tuple[Any, ...], Any]] = {  # function, arguments, a tree like its result
            "gradient": (self._step, (start, worlds, load, flight, key, np.float32(0)), (start, worlds)),
            "flight_ahead": (self._ahead, (start, load, flight, key), worlds),
            "comparison": (self._costs, (stacked, worlds, load, flight), 0.0),
        }
        known = {
            "config": to_dict(self.config),
            "policy": self._flown_hash(),  # some of its numbers are constants in the programs
            "source": source_hash(),
            "versions": versions(),
        }
        # Traced one after the other, or found in the cache, and compiled side by side.
        lowered = {
            name: TracedProgram(name, known, function, functools.partial(jax.tree.map, _shape, given), result).lower()
            for name, (function, given, result) in asked.items()
        }
        with ThreadPoolExecutor(len(lowered)) as pool:
            waiting = {pool.submit(one.compile, CPU_OPTIONS): name for name, one in lowered.items()}
            for count, done in enumerate(as_completed(waiting), start=1):
                self._programs[waiting[done]] = done.result()
                progress(f"{count} of {len(waiting)} programs compiled")
        for _ in range(2):  # so that nothing is made for the first time in flight, and the comparison's time is known
            self.fine_tune(load, flight, 0.0)

    def fine_tune(self, load: KnownLoad, flight: FlightState, seconds: float, most: int = MOST_STEPS) -> FineTuned:
        """Fine-tune for `load` from `flight` on, within `seconds` [s] by the clock or little more, in `most` steps."""
        begun = time.monotonic()
        load, flight = _single(load), _single(flight)
        key, own = jax.random.split(jax.random.PRNGKey(0))
        at_handover = worlds = self._programs["flight_ahead"](self._start, load, flight, own)
        jax.block_until_ready(worlds)
        state, count, longest = self._start, 0, 0.0
        # What the comparison takes is known from before the flight, where nothing else ran.
        last = begun + seconds - BUSY * self._comparing
        while count < most and last - time.monotonic() > RESERVE * longest:
            key, own = jax.random.split(key)
            entered = time.monotonic()
            progress = np.float32(count / MOST_STEPS)
            state, worlds = self._programs["gradient"](state, worlds, load, flight, own, progress)
            jax.block_until_ready(state.loss)
            longest, count = max(longest, time.monotonic() - entered), count + 1
        candidates = [_between(self._start.layers, state.layers, share) for share in SHARES]
        stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *candidates)
        compared = time.monotonic()
        costs = np.asarray(self._programs["comparison"](stacked, at_handover, load, flight))
        self._comparing = time.monotonic() - compared
        best = int(np.nanargmin(costs)) if np.isfinite(costs[0]) else 0
        better = costs[best] <= WORTH * costs[0]
        contents = self._contents(state._replace(layers=candidates[best])) if better else None
        return FineTuned(contents, float(costs[0]), float(costs[best]), SHARES[best], count, time.monotonic() - begun)

    def _environments(self, load: KnownLoad, flight: FlightState, count: int | None = None) -> Environments:
        return Environments(LoadedEnv(self.config, load, flight), count or self._worlds)

    def _flown_hash(self) -> str:
        arrays = (
            *self._flown.weights,
            *self._flown.biases,
            self._flown.observation_mean,
            self._flown.observation_scale,
        )
        card = json.dumps(self._flown.card, sort_keys=True).encode()
        return hashlib.sha256(card + b"".join(np.ascontiguousarray(array).tobytes() for array in arrays)).hexdigest()

    def _contents(self, state: GradientState) -> PolicyFile:
        """The policy file of `state`, with the card of the flown one."""
        return with_network(self._flown, self._algorithm.policy(state))

    # The programs.

    def _begin(self, load: KnownLoad, flight: FlightState, key: Array) -> Any:
        return self._environments(load, flight).reset(key)

    def _fly(self, state: GradientState, worlds: Any, load: KnownLoad, flight: FlightState, seconds: float) -> Any:
        """(worlds, mean reward) after `seconds` [s] of flight by the weights in `state`."""
        environments = self._environments(load, flight, len(worlds.done))
        policy = FirstOrderGradient(self.config, environments).policy(state)

        def step(envs: Any, _: None) -> tuple[Any, Array]:
            envs, after = environments.step(envs, policy(envs.states.obs), None)
            return envs, after.reward.mean()

        count = round(seconds / self.config.timing.control_period)
        with jax.default_matmul_precision(MATMUL_PRECISION):
            envs, rewards = jax.lax.scan(step, environments.begin(worlds, 1.0), length=count)
        return envs.states, rewards.mean()

    def _ahead(self, state: GradientState, load: KnownLoad, flight: FlightState, key: Array) -> Any:
        return self._fly(state, self._begin(load, flight, key), load, flight, AHEAD)[0]

    def _costs(self, layers: Any, worlds: Any, load: KnownLoad, flight: FlightState) -> Array:
        """Minus the mean reward of weights (n, ...), all from the same `COMPARED` of the `worlds`."""
        worlds = jax.tree.map(lambda leaf: leaf[:COMPARED], worlds)

        def cost(one: Any) -> Array:
            return -self._fly(self._start._replace(layers=one), worlds, load, flight, CHECKED)[1]

        return jax.vmap(cost)(layers)

    def _step(
        self, state: GradientState, worlds: Any, load: KnownLoad, flight: FlightState, key: Array, progress: Array
    ) -> tuple[GradientState, Any]:
        """One step of Adam along the gradient of the worlds' next `horizon` control steps."""
        environments = self._environments(load, flight)
        algorithm = FirstOrderGradient(self.config, environments)
        with jax.default_matmul_precision(MATMUL_PRECISION):
            state, envs = algorithm.collect(state, environments.begin(worlds, 1.0), [key], LEARN)
            state, _ = algorithm.update(state, [], progress, LEARN)
        return state, envs.states


def _between(old: Any, new: Any, share: float) -> Any:
    """Weights `share` of the way from `old` to `new`, as NumPy arrays."""
    return jax.tree.map(lambda a, b: np.asarray(a) + np.float32(share) * (np.asarray(b) - np.asarray(a)), old, new)


def nominal_load(config: Config) -> KnownLoad:
    """The object alone, at rest in O."""
    return _single(KnownLoad(config.plant.object_mass, 0.0, 0.005, 0.7, 0.0, 3.7, 0.0))


def resting(config: Config) -> FlightState:
    """Hover at the goal."""
    integral = np.zeros(7 if config.follower.residual_on_pid else 3)
    history = np.zeros(follower_law(config).size)
    level = np.array([1.0, 0.0, 0.0, 0.0])
    return _single(FlightState(np.zeros(3), np.zeros(3), level, np.zeros(3), np.zeros(3), integral, history))


def _single(values: Any) -> Any:
    """Leaves as float32 arrays."""
    return jax.tree.map(lambda value: np.asarray(value, np.float32), values)


def _shape(value: Any) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(np.shape(value), value.dtype)
