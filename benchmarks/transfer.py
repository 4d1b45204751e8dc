"""SAC and PPO on two Brax environments beside Brax's own trainers: return and wall clock.

`python benchmarks/transfer.py [--envs inverted_pendulum ant] [--algorithms sac ppo] [--trainers ours stock]
[--seeds K] [--backend NAME] [--scale S] [--json FILE]`

Ours is what `train.py --env` runs, without its files (`mjxball.train.population`); stock is
`brax.training.agents.{sac,ppo}.train`. Both get Brax's published hyper-parameters (notebooks/training.ipynb) but for
those of `OWN`, and backend (`positional`, as there), the same network sizes and steps. Both SACs evaluate once, at the
end, in 128 000 steps. PPO is not evaluated while the clock runs. Brax publishes PPO for both environments; its SAC has
those of walker2d, the nearest that it publishes.

One process, trainers in turn, each with an empty compilation cache of its own for the first seed (cold), which
the other seeds of Brax's find filled (warm). Seconds are those of the whole call: tracing, compiling, training. Ours
traces and compiles for the first seed alone, Brax's trainer traces anew at every call. Every policy
then flies the same 128 episodes of 1000 steps, without noise, up to its first termination.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import json
import math
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental.compilation_cache import compilation_cache

from mjxball import config as configs
from mjxball.algorithms.ppo import ProximalPolicyOptimization
from mjxball.algorithms.sac import SoftActorCritic
from mjxball.gym.brax_trainers import brax_trainer
from mjxball.quiet import import_brax_env
from mjxball.train import program as programs
from mjxball.train.extensions import Extensions
from mjxball.train.population import Executables, Population
from training import say, versions

EPISODE, EPISODES = 1000, 128
SAC = {
    "reward_scaling": 5,
    "discounting": 0.997,
    "learning_rate": 6e-4,
    "num_envs": 128,
    "batch_size": 128,
    "grad_updates_per_step": 32,
    "max_replay_size": 1_048_576,
    "min_replay_size": 8192,
}
PPO = {
    "reward_scaling": 10,
    "discounting": 0.97,
    "learning_rate": 3e-4,
    "entropy_cost": 1e-2,
    "unroll_length": 5,
    "num_minibatches": 32,
    "num_updates_per_batch": 4,
}
# Steps: Brax's for PPO on the pendulum; a part of them elsewhere, so that a run takes a minute.
TASKS: dict[tuple[str, str], dict[str, Any]] = {
    ("inverted_pendulum", "sac"): {"num_timesteps": 131_072, **SAC},
    ("inverted_pendulum", "ppo"): {"num_timesteps": 2_000_000, **PPO, "num_envs": 2048, "batch_size": 1024},
    ("ant", "sac"): {"num_timesteps": 393_216, **SAC},
    ("ant", "ppo"): {"num_timesteps": 10_000_000, **PPO, "num_envs": 4096, "batch_size": 2048},
}
# What ours takes instead: half as many updates at a higher rate, with which one run of seed 10 returned 3722.
OWN: dict[tuple[str, str], dict[str, Any]] = {("ant", "sac"): {"grad_updates_per_step": 16, "learning_rate": 1e-3}}
# What Brax's trainers take where nothing is said.
SAC_LAYERS, PPO_POLICY, PPO_VALUE = (256, 256), (32,) * 4, (256,) * 5


def our_config(algorithm: str, given: dict[str, Any]) -> configs.Config:
    """The same settings by our names."""
    config = configs.Config()
    common = {
        "total_steps": given["num_timesteps"],
        "num_envs": given["num_envs"],
        "discount": given["discounting"],
        "learning_rate": given["learning_rate"],
        "learning_rate_final_ratio": 1.0,
        "reward_scale": float(given["reward_scaling"]),
        "num_evaluations": 1,
    }
    if algorithm == "sac":
        own = {
            "batch_size": given["batch_size"],
            "updates_per_step": given["grad_updates_per_step"],
            "warmup_steps": given["min_replay_size"],
            "replay_size": min(given["max_replay_size"], given["num_timesteps"]),
            "policy_layers": SAC_LAYERS,
            "critic_layers": SAC_LAYERS,
            "tau": 0.005,
            "alpha": 1.0,
            "alpha_learning_rate": 3e-4,
            "target_entropy": -0.5,
        }
    else:
        own = {
            "unroll_length": given["unroll_length"],
            "unrolls": given["batch_size"] * given["num_minibatches"] // given["num_envs"],
            "epochs": given["num_updates_per_batch"],
            "minibatches": given["num_minibatches"],
            "policy_layers": PPO_POLICY,
            "activation": "swish",
            "value_layers": PPO_VALUE,
            "entropy_cost": given["entropy_cost"],
            "clipping": 0.3,
            "max_grad_norm": 1e9,  # Brax clips none
        }
    for name, value in (common | own).items():
        config = configs.replace(config, f"{algorithm}.{name}", value)
    return configs.replace(config, "timing.episode_steps", EPISODE)


Policy = tuple[Callable[[Any, Any], Any], Any]  # action of (parameters, observation), and the parameters


def ours(env: Any, algorithm: str, given: dict[str, Any]) -> Callable[[int], Policy]:
    """Training of a seed, by programs that are compiled for the first."""
    config = our_config(algorithm, given)
    kind = {"sac": SoftActorCritic, "ppo": ProximalPolicyOptimization}[algorithm]

    @functools.cache
    def made() -> tuple[Population, Executables]:
        population = Population(config, "none", devices=jax.devices()[:1], extensions=Extensions(env, None, kind))
        return population, population.compile(creating=True)

    def one(seed: int) -> Policy:
        population, compiled = made()
        program = population.program
        state, total = population.start(compiled, seed), program.total_rounds
        for mode in (programs.warmup(program.warmup_rounds), programs.train(total - program.warmup_rounds)):
            state, *_ = compiled.advance(state, mode)
        if algorithm == "sac":  # as Brax's does, which cannot do without
            evaluating = state._replace(envs=population.evaluation_envs(compiled))
            state, *_ = compiled.advance(evaluating, programs.evaluate(program.evaluation_steps))
        return lambda network, observation: network(observation), jax.block_until_ready(program.policy(state))

    return one


def stock(env: Any, algorithm: str, given: dict[str, Any]) -> Callable[[int], Policy]:
    """The same with Brax's trainer, which is called for every seed."""
    train = brax_trainer(algorithm)

    def one(seed: int) -> Policy:
        make_policy, parameters, _ = train(
            environment=env,
            episode_length=EPISODE,
            normalize_observations=True,
            seed=seed,
            num_evals=1,
            max_devices_per_host=1,
            **({"run_evals": False} if algorithm == "ppo" else {}),
            **given,
        )

        def act(known: Any, observation: Any) -> Any:
            return make_policy(known, deterministic=True)(observation, jax.random.PRNGKey(0))[0]

        return act, jax.block_until_ready(parameters)

    return one


def flights(env: Any, act: Callable[[Any, Any], Any]) -> Callable[[Any], float]:
    """Mean return of the same episodes for every policy, as a function of its parameters."""

    @jax.jit
    def fly(known: Any, keys: Any) -> Any:
        def step(carry: Any, _: None) -> tuple[Any, None]:
            states, alive, total = carry
            states = jax.vmap(env.step)(states, act(known, states.obs))
            return (states, alive * (1 - states.done), total + alive * states.reward), None

        start = (jax.vmap(env.reset)(keys), jnp.ones(EPISODES), jnp.zeros(EPISODES))
        return jax.lax.scan(step, start, length=EPISODE)[0][2].mean()

    return lambda known: float(fly(known, jax.random.split(jax.random.PRNGKey(1), EPISODES)))


def summary(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One row for each environment, algorithm and trainer: seconds cold and warm, median and worst return."""
    found = []
    for name in dict.fromkeys((row["env"], row["algorithm"], row["trainer"]) for row in rows):
        runs = [row for row in rows if (row["env"], row["algorithm"], row["trainer"]) == name]
        returns, warm = [row["return"] for row in runs], [row["seconds"] for row in runs[1:]]
        row = dict(zip(("env", "algorithm", "trainer"), name, strict=True)) | {"steps": runs[0]["steps"]}
        row |= {"cold": runs[0]["seconds"], "warm": statistics.median(warm) if warm else None}
        found.append(row | {"return": statistics.median(returns), "worst": min(returns)})
    return found


def result(options: argparse.Namespace, rows: list[dict[str, Any]]) -> dict[str, Any]:
    """What the JSON file holds."""
    settings = {f"{env} {algorithm}": given for (env, algorithm), given in TASKS.items()}
    own = {f"{env} {algorithm}": given for (env, algorithm), given in OWN.items()}
    found = {"backend": options.backend, "scale": options.scale, "settings": settings, "own": own}
    return found | {"runs": rows, "table": summary(rows), "versions": versions()}


def main() -> None:
    """Train, fly, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", nargs="+", default=["inverted_pendulum", "ant"])
    parser.add_argument("--algorithms", nargs="+", default=["sac", "ppo"], choices=("sac", "ppo"))
    parser.add_argument("--trainers", nargs="+", default=["ours", "stock"], choices=("ours", "stock"))
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--backend", default="positional", help="of Brax's physics")
    parser.add_argument("--scale", type=float, default=1.0, help="factor on the steps")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    import_brax_env()
    from brax import envs

    trainers, rows = {"ours": ours, "stock": stock}, []
    settings: Any = jax.config
    settings.update("jax_persistent_cache_min_compile_time_secs", 0.3)
    settings.update("jax_default_matmul_precision", "highest")  # what ours trains with
    jnp.zeros(1).block_until_ready()  # the device has started before the clock runs
    tasks = list(itertools.product(options.envs, options.algorithms))
    with tempfile.TemporaryDirectory() as place:
        for env_name, algorithm in tasks:
            given = dict(TASKS[env_name, algorithm])
            # Brax's PPO rounds up to whole updates.
            unit = given["num_envs"] if algorithm == "sac" else PPO["unroll_length"] * PPO["num_minibatches"]
            unit *= 1 if algorithm == "sac" else given["batch_size"]
            given["num_timesteps"] = math.ceil(given["num_timesteps"] * options.scale / unit) * unit
            env = envs.get_environment(env_name, backend=options.backend)
            settings_of = {"ours": given | OWN.get((env_name, algorithm), {}), "stock": given}
            train_with = {name: trainers[name](env, algorithm, settings_of[name]) for name in options.trainers}
            judges: dict[str, Callable[[Any], float]] = {}  # one a trainer: its seeds have the same network
            for seed, trainer in itertools.product(range(options.seeds), options.trainers):
                settings.update("jax_compilation_cache_dir", f"{place}/{env_name}-{algorithm}-{trainer}")
                compilation_cache.reset_cache()
                started = time.perf_counter()
                act, known = train_with[trainer](seed)
                seconds = time.perf_counter() - started
                judge = judges.setdefault(trainer, flights(env, act))
                row = {"env": env_name, "algorithm": algorithm, "trainer": trainer, "seed": seed}
                row |= {"steps": given["num_timesteps"], "seconds": seconds, "return": judge(known)}
                rows.append(row)
                say(row)
                if options.json:  # what is measured stays, whatever ends the rest
                    options.json.write_text(json.dumps(result(options, rows), indent=2) + "\n")
    for row in summary(rows):
        say(row)


if __name__ == "__main__":
    main()
