"""Train a follower with Brax's, Stable-Baselines3's or SBX's own SAC or PPO on a preset's environment -> a policy file.

`python benchmarks/foreign_trainers.py brax-sac|brax-ppo|sb3-sac|sb3-ppo|sbx-sac OUT.npz [--seed N] [--steps N] ...`
`python benchmarks/foreign_trainers.py table [NAME ...] [--json FILE]`: all of them and `train.py`, compared

`--help` behind a trainer's name lists its settings. What the networks see, how actions are bounded and what is rewarded
are the preset's, exactly as in `train.py`. So are the settings, but those of Brax's SAC: the best of 12 on two cores
(docs/archive/training.md). Where the preset has none a library's own holds. A policy file ends in tanh, and so do all
five: SB3's PPO acts through one, too. Its `VecNormalize` scales PPO's rewards. Brax has no decay of learning rates. Its
evaluations are left out, which makes it faster; besides OUT.npz, written at the end, there is OUT-<steps>.npz at each
of `--snapshots` equal parts of the way; the files' times tell when each was reached. `sb3-*` need stable-baselines3 and
PyTorch, `sbx-sac` sbx-rl as well, see docs/gym.md.

`table` trains with each trainer in a process of its own, compiled anew, and prints its CPU seconds (user) from process
start to policy file, the mean return of the policy without noise in the same 256 random episodes, and the metrics of
the reference scenario. `copy` is the action zero: on the preset's PD controller the follower then does what its leader
does.
"""

from __future__ import annotations

import argparse
import functools
import importlib
import resource
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from harness import say, table, write
from mjxball import config as configs
from mjxball.env import TransportEnv
from mjxball.foreign import from_brax, from_sb3
from mjxball.policy import PolicyFile, load_network, save_file
from mjxball.xla import enable_compilation_cache
from training import NO_CACHE, evaluate, launch, until_policy

LAST_RATE = 0.02  # of SB3's learning rates, at the end over the start: linear, as the preset's own
COMMON = {"layers": "64,64", "discount": 0.97}
SETTINGS: dict[str, dict[str, Any]] = {
    "brax-sac": {"steps": 768_000, "num_envs": 128, "updates": 8, "batch": 256, "replay": 768_000, **COMMON}
    | {"learning_rate": 5e-4, "target_rate": 0.01, "reward_scale": 20.0, "snapshots": 1},
    "brax-ppo": {"steps": 4_000_000, "num_envs": 512, **COMMON, "learning_rate": 2e-3, "reward_scale": 0.02}
    | {"snapshots": 1},
    "sb3-sac": {"steps": 768_000, "num_envs": 512, "updates": 8, "batch": 256, **COMMON, "learning_rate": 4e-3},
    "sb3-ppo": {"steps": 4_000_000, "num_envs": 512, **COMMON, "learning_rate": 2e-3},
}
SETTINGS["sbx-sac"] = SETTINGS["sb3-sac"]
LIBRARIES = {"brax": "brax", "sb3": "stable-baselines3", "sbx": "sbx-rl"}
OURS = ("train.py-sac", "train.py-ppo")
EPISODES = 256
Export = Callable[[int, PolicyFile], None]  # environment steps and the policy then


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


def train_brax(config: configs.Config, options: argparse.Namespace, export: Export) -> None:
    """Train with Brax; `export` at every snapshot."""
    from brax_trainers import brax_trainer

    agent = options.trainer.removeprefix("brax-")
    train = brax_trainer(agent)
    from brax.envs.wrappers import training as wrappers
    from brax.training import acting
    from brax.training.agents.ppo.networks import make_ppo_networks
    from brax.training.agents.sac.networks import make_sac_networks

    newest: list[Any] = [None]

    def look(self: Any, parameters: Any, training_metrics: dict[str, Any], **_: Any) -> dict[str, Any]:
        newest[0] = parameters  # Brax hands them out nowhere else before the end
        return dict(training_metrics)

    def snapshot(steps: int, _: Any) -> None:
        if steps:
            export(steps, from_brax(newest[0], config, normalize_observations=True, steps=steps, masked=True))

    acting.Evaluator.run_evaluation = look
    sizes, ppo = options.sizes, config.ppo
    if agent == "sac":
        networks = functools.partial(make_sac_networks, hidden_layer_sizes=sizes)
        own: dict[str, Any] = {
            "batch_size": options.batch,
            "tau": options.target_rate,
            "grad_updates_per_step": options.updates,
        }
        own |= {"min_replay_size": config.sac.warmup_steps, "max_replay_size": options.replay}
    else:
        from mjxball.algorithms import ppo as ours

        networks = functools.partial(
            make_ppo_networks, policy_hidden_layer_sizes=sizes, value_hidden_layer_sizes=ours.VALUE_LAYERS
        )
        own = {"batch_size": options.num_envs // ppo.minibatches, "num_minibatches": ppo.minibatches}
        own |= {"unroll_length": ppo.unroll_length, "num_updates_per_batch": ours.EPOCHS}
        own |= {"gae_lambda": ours.GAE_LAMBDA, "clipping_epsilon": ours.CLIPPING}
        own |= {"entropy_cost": ppo.entropy_cost, "max_grad_norm": ours.MAX_GRAD_NORM}
    with jax.default_matmul_precision("highest"):
        train(
            environment=Masked(TransportEnv(config, options.physics)),
            wrap_env_fn=wrappers.wrap,
            num_timesteps=options.steps,
            episode_length=config.timing.episode_steps,
            num_envs=options.num_envs,
            learning_rate=options.learning_rate,
            discounting=options.discount,
            seed=options.seed,
            num_evals=options.snapshots + 1,
            progress_fn=snapshot,
            normalize_observations=True,
            max_devices_per_host=1,
            reward_scaling=options.reward_scale,
            network_factory=functools.partial(networks, activation=jax.nn.relu),
            **own,
        )


def train_sb3(config: configs.Config, options: argparse.Namespace) -> PolicyFile:
    """Train with Stable-Baselines3 or SBX."""
    import torch
    from stable_baselines3.common.vec_env import VecEnvWrapper, VecNormalize

    from mjxball.gym.sb3 import FollowerVecEnv

    torch.set_num_threads(1)
    is_ppo, ppo = options.trainer == "sb3-ppo", config.ppo
    env = TransportEnv(config, options.physics)
    mask = np.array(env.input_mask[: env.policy_input_size], np.float32)

    class MaskedWorlds(VecEnvWrapper):
        """Observations with zeros where the preset's networks look away."""

        def reset(self) -> np.ndarray:
            return self.venv.reset() * mask

        def step_wait(self) -> Any:
            seen, reward, ended, infos = self.venv.step_wait()
            for world in np.flatnonzero(ended):
                infos[world]["terminal_observation"] *= mask
            return seen * mask, reward, ended, infos

    worlds = FollowerVecEnv(options.num_envs, config=config, physics=options.physics, tanh=is_ppo)
    # A policy file does not clip what its network sees.
    trained_on = VecNormalize(MaskedWorlds(worlds), norm_reward=is_ppo, gamma=options.discount, clip_obs=np.inf)
    is_sbx = options.trainer == "sbx-sac"
    activation: Any = jax.nn.relu if is_sbx else torch.nn.ReLU
    own: dict[str, Any] = {
        "learning_rate": lambda left: options.learning_rate * max(left, LAST_RATE),
        "gamma": options.discount,
        "policy_kwargs": {"net_arch": options.sizes, "activation_fn": activation},
    }
    if is_ppo:
        from mjxball.algorithms import ppo as ours

        own |= {"n_steps": ppo.unroll_length, "batch_size": options.num_envs * ppo.unroll_length // ppo.minibatches}
        own |= {"n_epochs": ours.EPOCHS, "gae_lambda": ours.GAE_LAMBDA, "clip_range": ours.CLIPPING}
        own |= {"ent_coef": ppo.entropy_cost, "max_grad_norm": ours.MAX_GRAD_NORM}
    else:
        own |= {"n_steps": config.sac.n_step, "tau": config.sac.tau, "learning_starts": config.sac.warmup_steps}
        own |= {"batch_size": options.batch, "train_freq": 1, "gradient_steps": options.updates}
    library = importlib.import_module("sbx" if is_sbx else "stable_baselines3")
    kind = library.PPO if is_ppo else library.SAC
    model = kind("MlpPolicy", trained_on, seed=options.seed, device="cpu", **own)
    model.learn(options.steps)
    trained_on.training = False

    return from_sb3(model, config, masked=True)


def mean_return(network: Callable[[np.ndarray], np.ndarray], config: configs.Config, physics: str) -> float:
    """Of `network` in `EPISODES` random episodes, each up to its end."""
    env = TransportEnv(config, physics)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.key(0), EPISODES))
    step, going, total = jax.jit(jax.vmap(env.step)), np.ones(EPISODES), np.zeros(EPISODES)
    for _ in range(config.timing.episode_steps):
        state = step(state, network(np.asarray(state.obs)))
        total += going * np.asarray(state.reward)
        going *= 1 - np.asarray(state.done)
    return float(total.mean())


def compare(options: argparse.Namespace) -> None:
    """Train with each of `options.names`, print and write the table."""
    config, rows = configs.preset(options.preset), []
    with tempfile.TemporaryDirectory() as place:
        for name in options.names:
            out = Path(place) / f"{name}.npz"
            command = ["benchmarks/foreign_trainers.py", name, str(out)]
            if name in OURS:
                algorithm, out = name.removeprefix("train.py-"), out.with_suffix("") / "policy.npz"
                command = ["train.py", "--algorithm", algorithm, "--out", str(out.parent), options.preset]
            before, started = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime, time.time()
            until_policy(launch([*command, "--physics", options.physics], NO_CACHE), started, out)
            used = resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime - before
            steps = SETTINGS[f"sb3-{name[-3:]}"]["steps"]
            row = {"trainer": name, "steps": steps, "cpu_seconds": used, "policy": out}
            rows.append(row | {"return": mean_return(load_network(out), config, options.physics)})
            say(rows[-1])
        evaluate(rows)
    still = np.zeros((EPISODES, TransportEnv(config, options.physics).action_size), np.float32)
    rows.append({"trainer": "copy", "return": mean_return(lambda _: still, config, options.physics)})
    table(rows, ("trainer", "steps", "cpu_seconds", "return", "x_peak", "settling_time"))
    write(options.json, {"preset": options.preset, "physics": options.physics, "episodes": EPISODES, "rows": rows})


def main() -> None:
    """Train and export."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    trainers = parser.add_subparsers(dest="trainer", required=True)
    for name, settings in SETTINGS.items():
        own = trainers.add_parser(name, formatter_class=argparse.ArgumentDefaultsHelpFormatter)
        own.add_argument("out", type=Path, metavar="OUT.npz")
        own.add_argument("--preset", default="transport")
        own.add_argument("--physics", choices=("mjx", "newton-euler"), default="newton-euler")
        own.add_argument("--seed", type=int, default=0)
        for setting, value in settings.items():
            flags = ["--num-envs", "--worlds"] if setting == "num_envs" else [f"--{setting.replace('_', '-')}"]
            own.add_argument(*flags, dest=setting, type=type(value), default=value, metavar="X", help=" ")
    own = trainers.add_parser("table")
    own.add_argument("names", nargs="*", default=[*OURS, *SETTINGS], metavar="NAME", help=", ".join([*OURS, *SETTINGS]))
    own.add_argument("--json", type=Path, metavar="FILE", help="write what was found")
    own.set_defaults(preset="transport", physics="newton-euler")
    options = parser.parse_args()
    enable_compilation_cache()
    if options.trainer == "table":
        return compare(options)
    config = configs.preset(options.preset)
    settings = {name: getattr(options, name) for name in SETTINGS[options.trainer]}
    options.sizes = [int(size) for size in options.layers.split(",")]
    library = LIBRARIES[options.trainer.partition("-")[0]]
    metadata = {"trainer": options.trainer, "library": f"{library} {version(library)}", "settings": settings}
    metadata |= {"seed": options.seed, "physics": options.physics}
    started = time.perf_counter()

    def with_origin(policy: PolicyFile) -> PolicyFile:
        return replace(policy, metadata={**policy.metadata, **metadata})

    def export(steps: int, policy: PolicyFile) -> None:
        policy = with_origin(policy)
        save_file(options.out.with_name(f"{options.out.stem}-{steps}.npz"), policy)
        if steps >= options.steps:
            save_file(options.out, policy)
        print(f"{steps} steps in {time.perf_counter() - started:.0f} s", flush=True)

    if library == "brax":
        train_brax(config, options, export)
    else:
        save_file(options.out, with_origin(train_sb3(config, options)))
    print(f"policy: {options.out}", flush=True)


if __name__ == "__main__":
    main()
