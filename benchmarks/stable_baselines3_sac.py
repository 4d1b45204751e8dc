"""Stable-Baselines3's SAC on `mjxball/Transport-v0`: does it learn? Prints a table, writes JSON with --json.

Needs stable-baselines3, and with it PyTorch, which this project does not install: see docs/gym.md.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import stable_baselines3
import torch
from stable_baselines3 import SAC
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

import mjxball.gym  # noqa: F401  registers the environments

DRAWN = 1000  # seed of the worlds that every follower is evaluated in; training draws others
SETTINGS = {
    "learning_rate": lambda left: 2e-3 * max(left, 0.02),  # linear, as the preset's own
    "gamma": 0.97,
    "n_steps": 5,
    "batch_size": 256,
    "learning_starts": 12_800,
    "train_freq": 1,
    "policy_kwargs": {"net_arch": [64, 64]},
}


def evaluated(act: Any, name: str, physics: str, episodes: int) -> dict[str, float]:
    """Mean return, and |e_o| [m] over the second half, of `act(observation) -> action` in `episodes` fixed worlds."""
    env = gymnasium.make(name, physics=physics)
    returns, errors = [], []
    for number in range(episodes):
        seen, _ = env.reset(seed=DRAWN + number)
        total, late, ended = 0.0, [], False
        while not ended:
            seen, reward, terminated, truncated, info = env.step(act(seen))
            total, ended = total + float(reward), terminated or truncated
            late.append(info["error"])
        returns.append(total)
        errors.append(np.mean(late[len(late) // 2 :]))
    return {"return": float(np.mean(returns)), "late_error": float(np.mean(errors))}


class Worlds(VecEnv):
    """A `FollowerVectorEnv` with same-step autoreset as Stable-Baselines3's `VecEnv`."""

    def __init__(self, env: Any):
        self.render_mode = None
        super().__init__(env.num_envs, env.single_observation_space, env.single_action_space)
        self._env, self._actions = env, None

    def reset(self) -> np.ndarray:
        """First observations (N, n)."""
        return self._env.reset(seed=self._seeds[0])[0]

    def step_async(self, actions: np.ndarray) -> None:
        """Keep `actions` (N, 3) for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Observations, rewards, endings, and what SB3 wants to know of each world that ended."""
        seen, reward, terminated, truncated, info = self._env.step(self._actions)
        ended, told = terminated | truncated, [{} for _ in range(self.num_envs)]
        for world in np.flatnonzero(ended):
            told[world] = {
                "terminal_observation": info["final_obs"][world],
                "TimeLimit.truncated": bool(truncated[world]),
            }
        return seen, reward.astype(np.float32), ended, told

    def close(self) -> None:
        """Nothing to free."""

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """The same for all worlds."""
        return [getattr(self._env, attr_name)] * self.num_envs

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Not needed."""
        raise NotImplementedError

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> list[Any]:
        """Not needed."""
        raise NotImplementedError

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        """No world has a wrapper of its own."""
        return [False] * self.num_envs


def train(name: str, options: argparse.Namespace) -> Any:
    """`act` of a follower that SB3's SAC has trained for `options.steps` control steps of all worlds together."""
    torch.set_num_threads(1)
    made = gymnasium.make_vec(
        name, options.worlds, vectorization_mode="vector_entry_point", physics="newton-euler", autoreset_mode="SameStep"
    )
    env = VecNormalize(Worlds(made), norm_reward=False)
    model = SAC("MlpPolicy", env, seed=options.seed, device="cpu", gradient_steps=options.updates, **SETTINGS)
    model.learn(options.steps)
    env.training = False

    def act(seen: np.ndarray) -> np.ndarray:
        return model.predict(env.normalize_obs(seen), deterministic=True)[0]

    return act


def main() -> None:
    """Train and compare with followers that have learnt nothing."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="mjxball/Transport-v0")
    parser.add_argument(
        "--physics", default="mujoco", help="that the follower is evaluated on: mujoco, newton-euler or mjx"
    )
    parser.add_argument("--steps", type=int, default=192_000)
    parser.add_argument("--num-envs", "--worlds", dest="worlds", metavar="N", type=int, default=64)
    parser.add_argument("--updates", type=int, default=6, help="gradient updates after each step of all worlds")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--episodes", type=int, default=5, help="worlds that each follower is evaluated in")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()

    random = np.random.default_rng(options.seed)
    untrained = {"copies its leader": lambda seen: np.zeros(3), "random": lambda seen: random.uniform(-1, 1, 3)}
    place = (options.env, options.physics, options.episodes)
    rows = {label: evaluated(act, *place) for label, act in untrained.items()}
    started = time.perf_counter()
    act = train(options.env, options)
    seconds = time.perf_counter() - started
    rows["SB3 SAC"] = evaluated(act, *place)
    for label, row in rows.items():
        print(f"{label:<20}{row['return']:12.1f}{row['late_error']:10.4f} m")
    print(f"{options.steps} steps in {seconds:.0f} s")
    if options.json:
        versions = {"stable-baselines3": stable_baselines3.__version__, "torch": torch.__version__}
        record = {"rows": rows, "seconds": seconds, "versions": versions, **vars(options), "json": None}
        options.json.write_text(json.dumps(record, indent=1, default=str) + "\n")


if __name__ == "__main__":
    main()
