"""Populations of every algorithm on two devices, which XLA partitions: two of a CPU, in a process of their own."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
from command_line import HASTY, REPOSITORY
from tables import weekly

from mjxball.algorithms import ALGORITHMS
from mjxball.train.extensions import find

TINY = {
    **{"sac.num_envs": 4, "sac.replay_size": 160, "sac.warmup_steps": 80, "sac.batch_size": 16},
    **{"sac.updates_per_step": 1, "sac.policy_layers": (8,), "sac.critic_layers": (8,)},
    **{"ppo.num_envs": 8, "ppo.minibatches": 2, "ppo.unroll_length": 4, "ppo.policy_layers": (8,)},
    **{"gradient.num_envs": 4, "gradient.horizon": 4, "gradient.policy_layers": (8,), "timing.episode_steps": 8},
}
CODE = f"""
import sys
import jax, numpy as np
from mjxball import config as configs
from mjxball.algorithms import ALGORITHMS
from mjxball.train import program as programs
from mjxball.train.extensions import Extensions, resolve
from mjxball.train.population import Population
tiny = configs.preset("transport")
for name, value in {TINY!r}.items():
    tiny = configs.replace(tiny, name, value)
config = configs.replace(tiny, "follower.recurrent_units", int(sys.argv[2]))
for algorithm in ALGORITHMS:
    extensions = resolve(Extensions(algorithm=ALGORITHMS[algorithm]))
    if sys.argv[1] in extensions.algorithm.engines:
        population = Population(config, sys.argv[1], 2, extensions=extensions)
        assert population.devices == jax.local_device_count() == 2
        compiled = population.compile(creating=True)
        state = population.start(compiled, 5)
        for mode in (programs.warmup_mode, programs.train_mode, programs.train_mode, programs.evaluate_mode):
            state, *_ = population.advance(compiled, state, mode(20))
        floats = [leaf for leaf in jax.tree.leaves(state.algorithm) if leaf.dtype == np.float32]
        assert all(len(leaf.sharding.device_set) == 2 for leaf in floats)
        assert all(np.isfinite(np.asarray(leaf)).all() for leaf in floats)
        assert any(not np.array_equal(*np.asarray(leaf)) for leaf in floats)  # two members
        print(algorithm, "trained", flush=True)
"""


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["newton-euler", *weekly("mjx")])
@pytest.mark.parametrize("units", [4, *weekly(0)])
def test_every_algorithm_trains_two_members_on_two_devices(engine: str, units: int) -> None:
    """PPO ended the process in XLA's partitioner, exit code 134."""
    flags = f"{HASTY} --xla_force_host_platform_device_count=2"
    environment = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", CODE, engine, str(units)]
    done = subprocess.run(
        command, check=False, cwd=REPOSITORY, env=environment, capture_output=True, text=True, timeout=900
    )
    assert done.returncode == 0, done.stderr[-3000:]
    algorithms = [name for name in ALGORITHMS if engine in find(name, "--algorithm").engines]
    assert done.stdout.splitlines() == [f"{name} trained" for name in algorithms]


FRESH = """
import jax
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from mjxball.algorithms.recurrent import fresh_layers

each = NamedSharding(Mesh(jax.devices(), ("members",)), PartitionSpec("members"))
keys = jax.device_put(jax.random.split(jax.random.key(0), 4), each)
start = jax.jit(jax.vmap(lambda key: fresh_layers(key, 8, 64, (8, 6))), in_shardings=each, out_shardings=each)
for _ in range(50):
    jax.block_until_ready(start(keys))
print("started")
"""


def test_members_on_two_devices_start() -> None:
    """Four on two cores waited for each other for ever, in the QR factorisations of their initial weights."""
    environment = {**os.environ, "XLA_FLAGS": "--xla_force_host_platform_device_count=2", "JAX_PLATFORMS": "cpu"}
    command = [sys.executable, "-c", FRESH]
    done = subprocess.run(
        command, check=False, cwd=REPOSITORY, env=environment, capture_output=True, text=True, timeout=100
    )
    assert (done.returncode, done.stdout) == (0, "started\n"), done.stderr[-3000:]


CUT = """
import jax, numpy as np
from mjxball import config as configs
from mjxball.config import preset
from mjxball.train import processes
from mjxball.train import program as programs
from mjxball.train.extensions import Extensions, resolve
from mjxball.train.population import Population

def population(config, devices=None):
    gradient = resolve(Extensions(algorithm="gradient"))
    return Population(config, "newton-euler", devices=devices, extensions=gradient)

def trained(config, devices=None, stored=False):
    one = population(config, devices)
    compiled = one.compile(creating=True)
    state = one.start(compiled, 5)
    state, *_ = one.advance(compiled, state, programs.warmup_mode(8))
    state, statistics, metrics, _ = one.advance(compiled, state, programs.train_mode(40))
    if stored:
        state = one.place_state(processes.gather(state))
    state, *_ = one.advance(compiled, state, programs.train_mode(40))
    return one.parts, processes.gather(state), processes.gather((statistics, metrics))

def close(first, second, **tolerance):
    for one, other in zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True):
        np.testing.assert_allclose(one, other, **tolerance)

settings = {"gradient.num_envs": %s, "gradient.horizon": 8, "gradient.policy_layers": (8,)}
settings |= {"gradient.windows_per_episode": (2, 3), "gradient.learning_rate": 1e-3, "follower.recurrent_units": 4}
config = preset("%s")
for name, value in settings.items():
    config = configs.replace(config, name, value)
parts, whole, seen = trained(config, jax.local_devices()[:1])
assert parts == 1
parts, cut, of_cut = trained(config)
assert parts == 2
close(whole.algorithm.layers, cut.algorithm.layers, rtol=1e-3, atol=2e-5)
close(whole.envs.obs, cut.envs.obs, rtol=1e-2, atol=1e-3)
close(seen, of_cut, rtol=1e-2, atol=1e-3)
assert whole.steps == cut.steps
close(trained(config, stored=True)[1], cut, rtol=0, atol=0)  # a run that is continued, to the bit
assert population(configs.replace(config, "gradient.num_envs", %s)).parts == 1
print("the same")
"""


@pytest.mark.slow
@pytest.mark.parametrize("case", [("transport", 12, 9), *weekly(("universal", 22, 11))])
def test_environments_cut_over_two_cores_train_what_one_core_trains(case: tuple[str, int, int]) -> None:
    """Sampled worlds, starts of episodes, statistics, the network; `universal` has teams of several sizes."""
    flags = f"{HASTY} --xla_force_host_platform_device_count=2"
    environment = {**os.environ, "XLA_FLAGS": flags, "JAX_PLATFORMS": "cpu"}
    preset, worlds, odd = case
    command = [sys.executable, "-c", CUT % (worlds, preset, odd)]
    done = subprocess.run(
        command, check=False, cwd=REPOSITORY, env=environment, capture_output=True, text=True, timeout=900
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert done.stdout == "the same\n"
