"""Many worlds as a `gymnasium.vector.VectorEnv`, in one compiled program on MJX or the closed form."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import AutoresetMode

from mjxball.arrays import Array
from mjxball.config import Config
from mjxball.env import TransportEnv
from mjxball.gym import common
from mjxball.xla import enable_compilation_cache

METADATA: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}


class Program(NamedTuple):
    """The compiled functions of N worlds."""

    pair: TransportEnv
    start: Any  # chains (N,) -> (chains, State)
    next_step: Any  # (chains, State, actions (N, 3)) -> (chains, State): ended worlds start anew instead of stepping
    same_step: Any  # likewise -> (chains, State as stepped, State with the ended worlds started anew)


@functools.lru_cache(maxsize=8)
def compiled_program(config: Config, physics: str) -> Program:
    """The program of `config` on `physics`, compiled once for each number of worlds."""
    common.check_process()
    enable_compilation_cache()
    pair = TransportEnv(config, physics)

    def start(chain: Array) -> tuple[Array, Any]:
        chain, key = jax.random.split(chain)
        return chain, pair.reset(key)

    @common.in_float32
    def step(state: Any, action: Array) -> Any:
        return pair.step(state.replace(done=jnp.zeros_like(state.done)), action)

    def next_step(chain: Array, state: Any, action: Array) -> tuple[Array, Any]:
        return _where(state.done > 0, start(chain), (chain, step(state, action)))

    def same_step(chain: Array, state: Any, action: Array) -> tuple[Array, Any, Any]:
        moved = step(state, action)
        chain, fresh = _where(moved.done > 0, start(chain), (chain, moved))
        return chain, moved, fresh

    return Program(pair, *(jax.jit(jax.vmap(function)) for function in (start, next_step, same_step)))


def _where(ended: Array, fresh: Any, going: Any) -> Any:
    return jax.tree.map(lambda new, old: jnp.where(ended, new, old), fresh, going)


class FollowerVectorEnv(common.Picklable, gymnasium.vector.VectorEnv):
    """N worlds of the follower's task; world i is `FollowerEnv` seeded with `seed + i`, on another engine.

    `physics` is mjx or newton-euler, in float32. Autoreset as in Gymnasium: by the next step, which ignores that
    world's action and returns its next episode's first observation with reward 0, or with `SameStep` at once, the
    last observation then being in `info["final_obs"]`.
    """

    metadata = METADATA
    _compiled = ("_program",)

    def __init__(
        self,
        num_envs: int = 1,
        preset: str = "transport",
        config: Config | None = None,
        physics: str = "mjx",
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
    ):
        mode = AutoresetMode(autoreset_mode)
        if mode == AutoresetMode.DISABLED:
            raise ValueError("autoreset_mode must be NextStep or SameStep")
        self.metadata = {**METADATA, "autoreset_mode": mode}
        self._same_step = mode == AutoresetMode.SAME_STEP
        if render_mode is not None:
            raise ValueError("the vector environment renders nothing; render one world with gymnasium.make")
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1, not {num_envs}")
        self.config = common.pair_settings(preset, config)
        self.num_envs, self.render_mode, self._physics = num_envs, render_mode, physics
        self._program = compiled_program(self.config, physics)
        self.single_observation_space, self.single_action_space = common.spaces(self._program.pair)
        batch = gymnasium.vector.utils.batch_space
        self.observation_space = batch(self.single_observation_space, num_envs)
        self.action_space = batch(self.single_action_space, num_envs)
        self._chains: Any = None
        self._state: Any = None

    def _arguments(self) -> dict[str, Any]:
        mode = self.metadata["autoreset_mode"]
        return {"num_envs": self.num_envs, "config": self.config, "physics": self._physics, "autoreset_mode": mode}

    @common.in_float32
    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict]:
        """Fresh worlds. `seed` seeds world i with `seed + i`, or each with its own of a list; None goes on."""
        common.check_process()
        super().reset(seed=seed if isinstance(seed, int) else None)
        if self._chains is None or seed is not None:
            self._chains = jax.vmap(jax.random.key)(jnp.asarray(self._numbers(seed), jnp.uint32))
        self._chains, self._state = self._program.start(self._chains)
        return self._seen(), {}

    @common.in_float32
    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Hold `actions` (N, 3), clipped to [-1, 1], for one control period; InputError unless they are finite."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        common.check_process()
        given = common.checked_action(actions, self.action_space.shape)
        going = np.asarray(self._state.done) == 0
        if self._same_step:
            self._chains, moved, self._state = self._program.same_step(self._chains, self._state, given)
        else:
            self._chains, self._state = self._program.next_step(self._chains, self._state, given)
            moved = self._state
        truncated = np.asarray(moved.info["truncation"]) > 0
        terminated = (np.asarray(moved.done) > 0) & ~truncated
        info = self._ended(moved, terminated | truncated) if self._same_step else _vector_info(moved, going)
        return self._seen(), np.array(moved.reward, np.float64), terminated, truncated, info

    def _ended(self, moved: Any, ended: np.ndarray) -> dict[str, Any]:
        """`info` of a step after which the worlds that `ended` (N,) have been started anew."""
        info: dict[str, Any] = dict(_vector_info(moved, ~ended))
        if ended.any():
            last = np.full(self.num_envs, None, object)
            for world in np.flatnonzero(ended):
                last[world] = np.array(moved.obs[world, : self._program.pair.policy_input_size])
            info |= {
                "final_obs": last,
                "_final_obs": ended,
                "final_info": _vector_info(moved, ended),
                "_final_info": ended,
            }
        return info

    def _seen(self) -> np.ndarray:
        return np.array(self._state.obs[:, : self._program.pair.policy_input_size])

    def _numbers(self, seed: int | list[int | None] | None) -> list[int]:
        """One number for each world, drawn as `FollowerEnv` would."""
        if isinstance(seed, list) and len(seed) != self.num_envs:
            raise ValueError(f"{len(seed)} seeds were given for {self.num_envs} worlds")
        if seed is None:
            seeds: list[int | None] = [int(number) for number in self.np_random.integers(2**32, size=self.num_envs)]
        else:
            seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else seed
        return [common.seed_number(gymnasium.utils.seeding.np_random(each)[0]) for each in seeds]


def _vector_info(state: Any, where: np.ndarray) -> dict[str, np.ndarray]:
    """Gymnasium's vector `info`: arrays (N,), 0 but `where` (N,) there is a value, and that mask."""
    info = {}
    for name, value in common.info_of(state).items():
        info[name], info[f"_{name}"] = np.where(where, value, 0.0), where.copy()
    return info
