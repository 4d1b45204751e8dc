"""Train a follower with Brax's own `sac.train` on the environment of a preset, and export it as a policy file.

`python benchmarks/stock_sac.py OUT.npz [--seed N] [--steps N] [--num-envs N] ... [--physics mjx|newton-euler]`

The other side of `benchmarks/training.py`. Brax's evaluations are left out, which makes it faster. Besides OUT.npz,
written at the end, there is OUT-<steps>.npz at each of `--snapshots` equal parts of the way; the files' times tell when
each was reached. What the networks see, how actions are bounded and what is rewarded are the preset's, exactly as in
`train.py`.
"""

from __future__ import annotations

import argparse
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from mjxball import config as configs
from mjxball.algorithms.base import PolicyNetwork
from mjxball.cache import enable_compilation_cache
from mjxball.env import TransportEnv
from mjxball.gym.brax_trainers import brax_trainer
from mjxball.policy import save_file
from mjxball.policy.export import policy_file
from mjxball.sim.follower import follower_law


class Masked:
    """An environment whose observation has zeros where the preset's networks look away."""

    def __init__(self, env: TransportEnv):
        self._env, self._mask = env, jnp.asarray(env.input_mask, jnp.float32)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._env, name)

    def reset(self, key: Any) -> Any:
        """See `TransportEnv.reset`."""
        state = self._env.reset(key)
        return state.replace(obs=state.obs * self._mask)

    def step(self, state: Any, action: Any) -> Any:
        """See `TransportEnv.step`."""
        state = self._env.step(state, action)
        return state.replace(obs=state.obs * self._mask)


def train(config: configs.Config, options: argparse.Namespace, export: Callable[[int, Any], None]) -> None:
    """Train; `export(environment steps, (observation statistics, policy parameters))` at every snapshot."""
    train = brax_trainer("sac")
    from brax.envs.wrappers import training as wrappers
    from brax.training import acting
    from brax.training.agents.sac import networks

    newest: list[Any] = [None]

    def look(self: Any, parameters: Any, training_metrics: dict[str, Any], **_: Any) -> dict[str, Any]:
        newest[0] = parameters  # Brax hands them out nowhere else before the end
        return dict(training_metrics)

    acting.Evaluator.run_evaluation = look
    layers = tuple(int(size) for size in options.layers.split(","))
    with jax.default_matmul_precision("highest"):
        train(
            environment=Masked(TransportEnv(config, options.physics)),
            wrap_env_fn=wrappers.wrap,
            num_timesteps=options.steps,
            episode_length=config.timing.episode_steps,
            num_envs=options.worlds,
            learning_rate=options.learning_rate,
            discounting=options.discount,
            seed=options.seed,
            batch_size=options.batch,
            num_evals=options.snapshots + 1,
            progress_fn=lambda steps, _: export(steps, newest[0]) if steps else None,
            normalize_observations=True,
            max_devices_per_host=1,
            reward_scaling=options.reward_scale,
            tau=options.target_rate,
            min_replay_size=config.sac.warmup_steps,
            max_replay_size=options.replay,
            grad_updates_per_step=options.updates,
            network_factory=functools.partial(
                networks.make_sac_networks, hidden_layer_sizes=layers, activation=jax.nn.relu
            ),
        )


def main() -> None:
    """Train and export."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, metavar="OUT.npz")
    parser.add_argument("--preset", default="transport")
    parser.add_argument("--physics", default="mjx")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--snapshots", type=int, default=1, help="policies exported on the way, the last one included")
    parser.add_argument("--steps", type=int, default=768_000)
    parser.add_argument("--num-envs", "--worlds", dest="worlds", metavar="N", type=int, default=128)
    parser.add_argument("--updates", type=int, default=4)
    parser.add_argument("--batch", type=int, default=256)
    parser.add_argument("--replay", type=int, default=768_000)
    parser.add_argument("--layers", default="64,64")
    parser.add_argument("--learning-rate", type=float, default=1e-3)
    parser.add_argument("--discount", type=float, default=0.97)
    parser.add_argument("--target-rate", type=float, default=0.02)
    parser.add_argument("--reward-scale", type=float, default=50.0)
    options = parser.parse_args()
    enable_compilation_cache()
    config = configs.preset(options.preset)
    card = {"trainer": "brax.training.agents.sac.train", "seed": options.seed, "physics": options.physics}

    def export(steps: int, parameters: Any) -> None:
        seen, mask = parameters[0], TransportEnv(config, options.physics).input_mask
        learnt = PolicyNetwork(parameters[1]["params"], seen.mean, seen.std, mask)
        exported = policy_file(config, follower_law(config), learnt, steps, card)
        save_file(options.out.with_name(f"{options.out.stem}-{steps}.npz"), exported)
        if steps >= options.steps:
            save_file(options.out, exported)

    train(config, options, export)
    print(f"policy: {options.out}", flush=True)


if __name__ == "__main__":
    main()
