"""Followers with a GRU: its equations, what is learnt through it, and one answer in training, files and flight."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import flax.linen
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toys
from conftest import Recurrent, with_settings
from tables import rows, weekly

from algorithms.test_algorithms import TRAIN, A, B, LinearQuadratic, Q, R, gradient_of
from mjxball.algorithms import ppo, sac
from mjxball.algorithms.base import Shards, TrainingPhase
from mjxball.algorithms.gradient import FirstOrderGradient
from mjxball.algorithms.ppo import ProximalPolicyOptimization
from mjxball.algorithms.sac import SoftActorCritic
from mjxball.commands.train import main
from mjxball.config import Config
from mjxball.control.network import gru_cell
from mjxball.env import TransportEnv
from mjxball.errors import InputError
from mjxball.policy import Policy, PolicyFile, PolicyFileError, load_file, save_file
from mjxball.policy.export import policy_file
from mjxball.policy.file import check
from mjxball.policy.inference import NetworkController
from mjxball.sim.follower import network_interface
from mjxball.train.environments import Environments

UNITS = 7


def test_a_cell_is_that_of_flax() -> None:
    """Flax has biases of its own for the recurrent product; ours are those of the input alone."""
    random = np.random.default_rng(0)
    kernel, recurrent = random.normal(size=(5, 3 * UNITS)), random.normal(size=(UNITS, 3 * UNITS))
    bias, hidden, seen = (random.normal(size=size) for size in (3 * UNITS, (4, UNITS), (4, 5)))
    parts = {"r": slice(UNITS), "z": slice(UNITS, 2 * UNITS), "n": slice(2 * UNITS, None)}
    parameters: dict[str, Any] = {f"i{name}": {"kernel": kernel[:, k], "bias": bias[k]} for name, k in parts.items()}
    parameters |= {f"h{name}": {"kernel": recurrent[:, k]} for name, k in parts.items()}
    parameters["hn"]["bias"] = np.zeros(UNITS)
    with jax.default_matmul_precision("highest"):
        wanted, _ = flax.linen.GRUCell(UNITS).apply({"params": parameters}, jnp.asarray(hidden), jnp.asarray(seen))
    np.testing.assert_allclose(gru_cell(hidden, seen, kernel, recurrent, bias), wanted, atol=2e-6)  # Flax: float32


def test_training_and_file_answer_alike(recurrent: Recurrent) -> None:
    """In every flight: action, state and command of the network in training, the batch controller and `Policy`."""
    env = TransportEnv(recurrent.config, "newton-euler")
    policy, exact = Policy(recurrent.contents, "one"), Policy(recurrent.contents, "one", np.float64)
    controller = NetworkController(exact)
    with jax.default_matmul_precision("highest"):
        step, network = jax.jit(env.step), jax.jit(recurrent.network.__call__)
        for seed in (0, 1):
            state = jax.jit(env.reset)(jax.random.key(seed))
            policy.reset(), exact.reset()
            memory = controller.start(np.asarray(state.obs[:18], float))
            for _ in range(30):
                answer, seen = np.asarray(network(state.obs)), np.asarray(state.obs[:18], float)
                state = step(state, answer)
                commands = np.array([policy(seen), exact(seen)])
                np.testing.assert_allclose(commands[0], state.pipeline_state.command, atol=2e-5)  # float32, 30 steps
                np.testing.assert_allclose(policy.memory[-UNITS:], answer[3:], atol=2e-5)
                memory, command = controller.step(memory, seen, None)
                np.testing.assert_allclose(command, commands[1], atol=1e-12)
                np.testing.assert_allclose(memory, exact.memory, atol=1e-12)
            assert np.abs(answer[3:]).max() > 0.1


def test_a_gradient_through_a_state_is_limited_in_each_world(transport: Config) -> None:
    """Against the recursion written out: worlds whose gradient is longer than the limit pass a shorter one."""
    gain, steps, clip = np.array([[2.0, 1.5]]), 30, 0.005
    x, _, found = gradient_of(transport, gain, horizon=steps, gradient_decay=0.97, state_gradient_clip=clip)
    states = [x]
    for _ in range(steps):
        states.append(states[-1] @ (A - B @ gain).T)
    later, wanted, limited = np.zeros_like(x), np.zeros((1, 2)), 0
    for x in states[-2::-1]:
        length = np.linalg.norm(later, axis=1, keepdims=True)
        limited += int((length > clip).sum())
        later = 0.97 * later * np.minimum(1.0, clip / (length + 1e-30))
        pushed = 2 * (-x @ gain.T) @ R + later @ B
        wanted -= pushed.T @ x / (steps * len(x))
        later = 2 * x @ Q + later @ A - pushed @ gain
    assert 100 < limited < steps * len(x) - 100
    np.testing.assert_allclose(found, wanted, rtol=2e-3)


EPISODE = 10


class Recalling(LinearQuadratic):
    """A number is shown at the first of ten steps and to be answered at all others."""

    observation_size, action_size, recurrent_slots = 2 + UNITS, 1 + UNITS, slice(2, 2 + UNITS)

    def reset(self, rng: Any) -> Any:
        number, zero = jax.random.uniform(rng, minval=-0.8, maxval=0.8), jnp.zeros(())
        seen = jnp.concatenate([jnp.stack([number, 1.0]), jnp.zeros(UNITS)])
        return toys.State((number, zero), seen, zero, zero, {}, {"truncation": zero})

    def step(self, state: Any, action: Any) -> Any:
        number, steps = state.pipeline_state
        done = (steps + 1.0 >= EPISODE).astype(jnp.float32)
        seen = jnp.concatenate([jnp.zeros(2), action[1:]])
        return state.replace(
            pipeline_state=(number, steps + 1.0), obs=seen, reward=-((action[0] - number) ** 2), done=done,
            info={"truncation": done},
        )  # fmt: skip


class Telling(Recalling):
    """Critics alone see the number at every step."""

    observation_size = Recalling.observation_size + 1
    input_mask, critic_mask = [1.0] * (2 + UNITS) + [0.0], [1.0] * (3 + UNITS)

    def reset(self, rng: Any) -> Any:
        return self._shown(super().reset(rng))

    def step(self, state: Any, action: Any) -> Any:
        return self._shown(super().step(state, action))

    def _shown(self, state: Any) -> Any:
        return state.replace(obs=jnp.append(state.obs, state.pipeline_state[0]))


BY_GRADIENTS = {"num_envs": 64, "horizon": EPISODE, "windows_per_episode": (1,), "policy_layers": (8,),
                "learning_rate": 2e-2, "state_gradient_clip": 1e4}  # fmt: skip
BY_SAC = {"num_envs": 64, "batch_size": 320, "recurrent_steps": EPISODE, "replay_size": 64_000, "policy_layers": (8,),
          "critic_layers": (32,), "learning_rate": 1e-2, "discount": 0.0, "alpha": 1e-3, "alpha_fixed": True,
          "updates_per_step": 1, "warmup_steps": 6400}  # fmt: skip
BY_PPO = {"num_envs": 64, "unroll_length": EPISODE, "policy_layers": (8,), "discount": 0.0, "learning_rate": 1e-2}
LEARNING = {
    "gradient": (FirstOrderGradient, "gradient", BY_GRADIENTS, 250),
    "sac": (SoftActorCritic, "sac", BY_SAC, 1500),
    "ppo": (ProximalPolicyOptimization, "ppo", BY_PPO, 250),
}


def algorithm_of(name: str, transport: Config) -> tuple[Any, Environments]:
    kind, part, settings, _ = LEARNING[name]
    environments = Environments(Recalling(), 64, Shards())
    own = dataclasses.replace(getattr(transport, part), **settings)
    return kind(dataclasses.replace(transport, **{part: own}), environments), environments


def test_a_gradient_passes_what_is_remembered_whole_and_the_rest_decayed(transport: Config) -> None:
    config = with_settings(transport, gradient={"gradient_decay": 0.9, "state_gradient_clip": 0.0})
    environments = Environments(Recalling(), 4, Shards())
    damped, states = FirstOrderGradient(config, environments)._damped, environments.reset(jax.random.key(0))
    slope = jax.grad(lambda obs: damped(states.replace(obs=obs)).obs.sum())(states.obs)
    np.testing.assert_allclose(slope, np.broadcast_to([0.9] * 2 + [1.0] * UNITS, slope.shape), rtol=1e-6)


def test_an_estimate_costs_its_squared_error_and_trains_the_memory(transport: Config) -> None:
    """Against a flight of four steps by hand, whose numbers have mean 0.1 and deviation 20; weight 0 adds no layer."""
    worlds, steps, weight = 5, 4, 0.3
    own = {"num_envs": worlds, "horizon": steps, "windows_per_episode": (99,), "policy_layers": (8,)}
    environments = Environments(Telling(), worlds, Shards())
    plain, estimating = (
        FirstOrderGradient(with_settings(transport, gradient={**own, "estimation": size}), environments)
        for size in (0.0, weight)
    )
    random, known = np.random.default_rng(5), {"mean": 0.1, "square": 20.0**2 + 0.1**2, "seen": 1.0}
    state = estimating.init(jax.random.key(1))
    layers = jax.tree.map(lambda leaf: np.float32(random.normal(scale=0.5, size=leaf.shape)), state.layers)
    state = state._replace(
        **{name: np.full_like(getattr(state, name), value) for name, value in known.items()},
        layers=layers,
        windows=jnp.ones((), jnp.int32),  # in which no episode begins
    )
    first = plain.init(jax.random.key(1))
    assert "estimate" not in first.layers
    assert layers["estimate"]["kernel"].shape == (UNITS, 2)
    first = first._replace(
        **{name: getattr(state, name) for name in (*known, "windows")},
        layers={name: layer for name, layer in layers.items() if name != "estimate"},
    )
    assert estimating.policy(state).layers.keys() == first.layers.keys()  # not exported
    envs, key = environments.begin(environments.reset(jax.random.key(0))), [jax.random.key(2)]
    with jax.default_matmul_precision("highest"):
        found, without = (
            jax.jit(algorithm.collect)(begun, envs, key, TRAIN)[0]
            for algorithm, begun in ((estimating, state), (plain, first))
        )
        network, states, costs = estimating.policy(state), envs.states, []
        for _ in range(steps):
            answer = network(states.obs)
            true = (np.asarray(states.obs[:, -1:], float) - 0.1) / 20
            estimate = np.asarray(answer[:, 1:], float) @ layers["estimate"]["kernel"] + layers["estimate"]["bias"]
            costs.append(np.square(estimate - np.hstack([true, np.tanh(20 * true)])).mean())
            states = jax.vmap(Telling().step)(states, answer)
    assert float(found.loss - without.loss) == pytest.approx(weight * np.mean(costs), rel=1e-5)
    assert np.abs(found.slope["estimate"]["kernel"]).min() > 0
    assert np.abs(found.slope["gru"]["kernel"] - without.slope["gru"]["kernel"]).max() > 1e-4  # float32: 1e-7


def test_an_estimate_needs_a_memory_and_something_to_estimate(transport: Config) -> None:
    words = ".*--follower.recurrent_units 48 --follower.privileged_critic true$"
    for follower in ({"privileged_critic": True}, {"recurrent_units": 3}):
        config = with_settings(transport, follower=follower, gradient={"estimation": 0.1})
        environments = Environments(TransportEnv(config, "newton-euler"), 4)
        with pytest.raises(InputError, match="gradient.estimation" + words):
            FirstOrderGradient(config, environments)
        with pytest.raises(InputError, match="sac.estimation" + words):
            SoftActorCritic(with_settings(config, sac={"estimation": 0.1}), environments)
    config = with_settings(
        transport, follower={"privileged_critic": True, "recurrent_units": 3}, gradient={"estimation": 0.1}
    )
    algorithm = FirstOrderGradient(config, Environments(TransportEnv(config, "newton-euler"), 4))
    state = algorithm.init(jax.random.key(0))
    contents = policy_file(config, network_interface(config), algorithm.policy(state), steps=0)
    check(contents, "one")
    begun = algorithm.start_from(state, contents)  # a policy file has no estimate: its layer begins anew
    np.testing.assert_array_equal(begun.layers["estimate"]["kernel"], state.layers["estimate"]["kernel"])


def test_sac_trains_its_memory_to_estimate(transport: Config) -> None:
    """The cost by hand. An update trains layer and memory by it, and the policy has no such layer."""
    steps, weight = 4, 0.3
    environments, random = Environments(Telling(), 8, Shards()), np.random.default_rng(5)
    own = {"num_envs": 8, "batch_size": 8, "recurrent_steps": steps, "policy_layers": (8,), "critic_layers": (8,)}
    plain, estimating = (
        SoftActorCritic(with_settings(transport, sac={**own, "estimation": size}), environments)
        for size in (0.0, weight)
    )
    network = estimating.networks.policy_network
    learner = estimating.init(jax.random.key(1)).learner
    assert learner.policy["params"]["estimate"]["kernel"].shape == (UNITS, 2)
    assert "estimate" not in plain.init(jax.random.key(1)).learner.policy["params"]
    assert "estimate" not in estimating.policy(estimating.init(jax.random.key(1))).layers  # not exported
    policy = jax.tree.map(lambda leaf: jnp.float32(random.normal(scale=0.5, size=leaf.shape)), learner.policy)
    seen = jnp.float32(random.normal(size=(steps, 3, environments.observation_size))).at[0, :, -1].set(90.0)
    statistics = learner.normaliser.replace(mean=learner.normaliser.mean + 0.1, std=learner.normaliser.std + 1.0)
    with jax.default_matmul_precision("highest"):
        _, memory = network.unroll(statistics, policy, seen)
        cost = network.estimation(statistics, policy, memory, seen)
    true = np.clip((np.asarray(seen[..., -1:], float) - 0.1) / 2, -5, 5)  # the first by far beyond
    layer = policy["params"]["estimate"]
    wrong = np.asarray(memory, float) @ layer["kernel"] + layer["bias"] - np.concatenate([true, np.tanh(20 * true)], -1)
    assert float(cost) == pytest.approx(float(np.square(wrong).mean()), rel=1e-5)

    def moved(algorithm: SoftActorCritic) -> Any:
        state = algorithm.init(jax.random.key(1))
        envs, keys = environments.begin(environments.reset(jax.random.key(0))), jax.random.split(jax.random.key(2), 3)
        collect = jax.jit(algorithm.collect)
        for _ in range(8):
            state, envs = collect(state, envs, keys, TRAIN)
        state, _ = jax.jit(algorithm.update)(state, keys[:2], jnp.zeros(()), TRAIN)
        return state.learner.policy["params"]

    first, second = moved(plain), moved(estimating)
    assert np.abs(second["estimate"]["kernel"]).max() > 0
    assert np.abs(first["gru"]["kernel"] - second["gru"]["kernel"]).max() > 1e-3


@pytest.mark.parametrize("share", [0.4, 1.0])
def test_windows_begin_with_the_memory_of_another_environment(share: float, transport: Config) -> None:
    """Some rows, no row its own; nothing else of an observation changes, and nothing at all in an evaluation."""
    worlds = 200
    own = {"num_envs": worlds, "policy_layers": (8,), "exchanged_memory": share}
    environments = Environments(Recalling(), worlds, Shards())
    algorithm = FirstOrderGradient(with_settings(transport, gradient=own), environments)
    envs = environments.begin(environments.reset(jax.random.key(0)))
    before = np.random.default_rng(3).normal(size=envs.states.obs.shape).astype(np.float32)
    envs = envs._replace(states=envs.states.replace(obs=jnp.asarray(before)))
    evaluating = TrainingPhase(random=jnp.zeros((), bool), evaluate=jnp.ones((), bool))
    found, same = (
        np.asarray(algorithm._exchanged(envs, jax.random.key(4), phase).states.obs) for phase in (TRAIN, evaluating)
    )
    np.testing.assert_array_equal(same, before)
    np.testing.assert_array_equal(found[:, :2], before[:, :2])
    rows = [int(np.flatnonzero((before[:, 2:] == memory).all(axis=1))[0]) for memory in found[:, 2:]]
    others = sum(row != number for number, row in enumerate(rows))
    assert others == worlds if share == 1 else 0.25 * worlds < others < 0.55 * worlds  # four deviations


def test_exchanging_memories_needs_one(transport: Config) -> None:
    config = with_settings(transport, gradient={"exchanged_memory": 0.1})
    with pytest.raises(InputError, match=r"--follower.recurrent_units 48$"):
        FirstOrderGradient(config, Environments(TransportEnv(config, "newton-euler"), 4))


def test_a_window_flies_on_with_exchanged_memories(transport: Config) -> None:
    """At share 1 its loss is that of the same flights with all memories passed on by some number of rows."""
    worlds = 6
    own = {**BY_GRADIENTS, "num_envs": worlds, "windows_per_episode": (99,)}
    environments = Environments(Recalling(), worlds, Shards())
    begun = environments.begin(environments.reset(jax.random.key(0)))
    memory = jax.random.normal(jax.random.key(6), (worlds, UNITS))

    def losses(share: float, passed_on: range) -> list[float]:
        config = with_settings(transport, gradient={**own, "exchanged_memory": share})
        algorithm = FirstOrderGradient(config, environments)
        state = algorithm.init(jax.random.key(1))
        layers = jax.tree.map(lambda leaf: 0.5 * jax.random.normal(jax.random.key(5), leaf.shape), state.layers)
        known = {"square": state.square + 1, "seen": jnp.ones(()), "windows": jnp.ones((), jnp.int32)}
        collect, found = jax.jit(algorithm.collect), []
        for number in passed_on:
            seen = begun.states.obs.at[:, 2:].set(jnp.roll(memory, number, axis=0))
            envs = begun._replace(states=begun.states.replace(obs=seen))
            collected, _ = collect(state._replace(layers=layers, **known), envs, [jax.random.key(2)], TRAIN)
            found.append(float(collected.loss))
        return found

    own_memory, *others = losses(0.0, range(worlds))
    (exchanged,) = losses(1.0, range(1))
    differences = np.abs(np.array(others) - exchanged)
    assert differences.min() < 1e-5
    assert abs(own_memory - exchanged) > 1e-3


@pytest.mark.release
def test_the_impulse_response_is_what_a_small_impulse_does(recurrent: Recurrent) -> None:
    """The loss beside flights, one with a small impulse of the first action: observations, actions, GRU and all."""
    worlds, steps, weight, small = 3, 6, 0.3, 2e-3
    own = {"num_envs": worlds, "horizon": steps, "windows_per_episode": (99,), "gradient_steps": 1}
    env, network = TransportEnv(recurrent.config, "newton-euler"), recurrent.network
    key = jax.random.PRNGKey(2)
    with jax.default_matmul_precision("highest"):
        environments = Environments(env, worlds)
        envs = environments.begin(environments.reset(jax.random.key(0)))
        losses = []
        for response in (0.0, weight):
            config = with_settings(recurrent.config, gradient={**own, "impulse_response": response})
            algorithm = FirstOrderGradient(config, environments)
            square = np.square(network.deviation) + np.square(network.mean)
            state = algorithm.init(jax.random.key(1))._replace(
                **{"layers": network.layers, "mean": network.mean, "square": square, "seen": np.float32(1)},
                **{"windows": jnp.ones((), jnp.int32), "progress": jnp.ones(())},
            )
            losses.append(float(jax.jit(algorithm.collect)(state, envs, [key], TRAIN)[0].loss))
        impulse = jax.random.normal(jax.random.fold_in(key, 1), (worlds, env.action_size - 7))
        step = jax.jit(jax.vmap(env.step))
        flown = []
        for size in (small, -small):
            states, rows = envs.states, []
            for number in range(steps):
                answer = network(states.obs)
                answer = answer.at[:, : impulse.shape[1]].add(size * impulse * (number == 0))
                states = step(states, answer)
                seen = states.obs[:, : network.inputs] * (network.mask / network.deviation)[: network.inputs]
                rows.append(np.concatenate([seen, answer[:, : impulse.shape[1]]], axis=1))
            flown.append(np.array(rows, float))
    found = (flown[0] - flown[1]) / (2 * small)
    wanted = weight * np.log1p((found**2).sum(axis=-1) / 1e-6).mean()
    assert losses[1] - losses[0] == pytest.approx(wanted, rel=0.01)  # float32, impulses of 2e-3


@pytest.mark.slow
@pytest.mark.parametrize("name", ["gradient", *weekly("sac", "ppo")])
def test_what_was_seen_once_is_remembered(name: str, transport: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who answers 0 after the first step pays 0.8 ** 2 / 3 in nine of ten steps, 0.19 a step."""
    monkeypatch.setattr(ppo, "REWARD_SCALE", 1.0)  # rewards of at most 1
    monkeypatch.setattr(sac, "POLICY_EMA_RATE", 0.05)  # few updates
    algorithm, environments = algorithm_of(name, transport)

    def one(carry: Any, keys: Any) -> Any:
        known, envs = algorithm.collect(*carry, keys[0], keys[2])
        known, _ = algorithm.update(known, keys[1], jnp.float32(0.5), keys[2])
        return (known, envs), None

    def keys_of(seed: int, count: int, phase: TrainingPhase) -> Any:
        many = jax.random.split(jax.random.key(seed), (count, algorithm.collect_keys + algorithm.update_keys))
        phases = jax.tree.map(lambda part: jnp.broadcast_to(part, count), phase)
        parts = [many[:, k] for k in range(many.shape[1])]
        return parts[: algorithm.collect_keys], parts[algorithm.collect_keys :], phases

    states = environments.reset(jax.random.key(0))
    carry = algorithm.init(jax.random.key(1)), environments.begin(states)
    warm = algorithm.schedule.warmup_steps // (64 * algorithm.steps_per_collect)
    scan = jax.jit(lambda carry, keys: jax.lax.scan(one, carry, keys)[0])
    if warm:
        carry = scan(carry, keys_of(2, warm, TrainingPhase(jnp.asarray(True), jnp.asarray(False))))
    known, _ = scan(carry, keys_of(3, LEARNING[name][3], TRAIN))
    assert paid(algorithm.policy(known)) < 0.02
    assert paid(algorithm.policy(algorithm.init(jax.random.key(1)))) > 0.15


def paid(policy: Any) -> float:
    """Mean cost of a step of `policy` in flights of ten."""
    env = Recalling()

    def flight(key: Any) -> Any:
        step = lambda state, _: 2 * (env.step(state, policy(state.obs)),)  # noqa: E731
        return jax.lax.scan(step, env.reset(key), length=EPISODE)[1].reward.mean()

    return -float(jax.jit(jax.vmap(flight))(jax.random.split(jax.random.key(9), 256)).mean())


def test_sequences_are_answered_as_their_steps_were(transport: Config) -> None:
    """Also where an episode ends among them; and a state that another policy left is not believed."""
    algorithm, environments = algorithm_of("sac", transport)
    state = algorithm.init(jax.random.key(1))
    envs = environments.begin(environments.reset(jax.random.key(0)))
    policy, statistics, network = state.learner.policy, state.learner.normaliser, algorithm.networks.policy_network
    seen, found = [], []
    for _ in range(EPISODE + 4):
        parameters, memory = network.step(statistics, policy, envs.states.obs)
        seen.append(envs.states.obs), found.append(parameters)
        answer = jnp.concatenate([parameters[:, :1], memory], axis=-1)
        envs, _ = environments.step(envs, answer, jax.random.key(len(seen)))
    sequence = jnp.stack(seen)
    assert (sequence[EPISODE, :, 2:] == 0).all()
    assert (sequence[1:EPISODE, :, 2:] != 0).any(axis=-1).all()
    np.testing.assert_allclose(network.unroll(statistics, policy, sequence)[0], jnp.stack(found), atol=1e-6)
    spoilt = sequence.at[3:EPISODE, :, 2:].set(0.3)
    np.testing.assert_allclose(network.unroll(statistics, policy, spoilt)[0], jnp.stack(found), atol=1e-6)


def test_batches_hold_whole_sequences(transport: Config, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    flags = ["--follower.recurrent_units", "4", "--out", str(tmp_path / "run")]
    assert main([*flags, "--sac.batch_size", "250"]) == 2
    assert "make it a multiple of 16" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


@rows(
    "metadata, arrays, words",
    [
        ({"recurrent_units": None}, {}, "recurrent_units"),
        ({"recurrent_units": 6}, {}, "weight_0|gru_kernel"),
        ({"recurrent_units": 513}, {}, "1 to 512"),
        ({"recurrent_units": True}, {}, "1 to 512"),
        ({"format_version": 1}, {}, "gru_bias|recurrent_units"),
        ({}, {"gru_recurrent": np.full((UNITS, 3 * UNITS), np.nan, np.float32)}, "gru_recurrent"),
        ({}, {"gru_bias": np.zeros(3, np.float32)}, "gru_bias"),
        ({}, {"gru_bias": None}, "gru_bias"),
    ],
)
def test_a_damaged_file_is_refused(
    metadata: dict[str, Any], arrays: dict[str, Any], words: str, recurrent: Recurrent, tmp_path: Path
) -> None:
    path = tmp_path / "policy.npz"
    save_file(path, recurrent.contents)
    with np.load(path) as data:
        held: dict[str, Any] = {**{name: data[name] for name in data.files}, **arrays}
    whole = {**json.loads(str(held["card"])), **metadata}
    held["card"] = np.array(json.dumps({name: value for name, value in whole.items() if value is not None}))
    np.savez(path, **{name: array for name, array in held.items() if array is not None})
    with pytest.raises(PolicyFileError, match=words):
        load_file(path)


def test_a_state_that_is_none_is_refused_and_the_flight_goes_on(recurrent: Recurrent) -> None:
    """Not finite, of another size, or beyond what a GRU can reach; alone and in a batch."""
    walk = 0.1 * np.random.default_rng(8).normal(size=(30, 18))
    for shape in ((), (2,)):
        flown, alone = Policy(recurrent.contents, "one"), Policy(recurrent.contents, "one")
        for number, row in enumerate(walk):
            seen = np.broadcast_to(row, (*shape, 18))
            if number == 20:
                size = flown.memory.shape[-1]
                for value, words in ((np.nan, "not finite"), (-np.inf, "not finite"), (1.1, "beyond 1: it is another")):
                    spoilt = flown.memory.copy()
                    spoilt[..., -2] = value
                    with pytest.raises(InputError, match=words):
                        flown.memory = spoilt
                with pytest.raises(InputError, match=f"remembers {size} numbers"):
                    flown.memory = flown.memory[..., 1:]
            np.testing.assert_array_equal(flown(seen), alone(seen))
        flown.memory = flown.memory  # its own is taken
        np.testing.assert_allclose(flown(seen), alone(seen), atol=1e-6)


def test_a_later_format_is_named_whatever_its_arrays(recurrent: Recurrent, tmp_path: Path) -> None:
    path = tmp_path / "policy.npz"
    save_file(path, recurrent.contents)
    with np.load(path) as data:
        held: dict[str, Any] = {name: data[name] for name in data.files if not name.startswith("gru")}
    held["card"] = np.array(json.dumps({**json.loads(str(held["card"])), "format_version": 6}))
    np.savez(path, lstm=np.zeros(3), **held)
    with pytest.raises(PolicyFileError, match=r"has policy format 6; this version reads formats 1, 5$"):
        load_file(path)


def test_a_state_that_cannot_be_is_refused(recurrent: Recurrent) -> None:
    """Of another policy, or not finite: one sentence, and the state stays as it was."""
    policy = Policy(recurrent.contents, "one")
    policy(np.zeros(18))
    kept = policy.memory.copy()
    for memory, words in ((np.zeros(kept.size - 1), "remembers 10 numbers, not"), (kept * np.nan, "must be finite")):
        with pytest.raises(InputError, match=words):
            policy.memory = memory
        np.testing.assert_array_equal(policy.memory, kept)
    for wrong in (np.nan, np.inf):
        with pytest.raises(InputError):
            policy(np.full(18, wrong))
        np.testing.assert_array_equal(policy.memory, kept)


@pytest.mark.slow
def test_a_run_writes_a_policy_resumes_bit_for_bit_and_starts_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, short_verdict: None
) -> None:
    monkeypatch.chdir(tmp_path)
    flags = ["--gradient.num_envs", "4", "--gradient.horizon", "20", "--gradient.policy_layers", "5"]
    flags += ["--follower.recurrent_units", "3", "--algorithm", "gradient", "--num-seeds", "2"]
    flags += ["--gradient.num_evaluations", "2", "--gradient.gradient_steps", "4"]
    assert main([*flags, "--out", "run"]) == 0
    whole = load_file(Path("run/policy.npz"))
    assert (whole.metadata["format_version"], whole.metadata["recurrent_units"]) == (5, 3)
    last = max((path for path in Path("run/checkpoints").iterdir() if path.name.isdigit()), key=lambda p: int(p.name))
    for path in sorted(last.rglob("*"), reverse=True):  # as if it had been stopped before
        path.rmdir() if path.is_dir() else path.unlink()
    last.rmdir()
    Path("run/policy.npz").unlink()
    assert main(["--resume", "run"]) == 0
    resumed = load_file(Path("run/policy.npz"))
    assert whole.gru is not None
    assert resumed.gru is not None
    for one, other in zip((*whole.weights, *whole.gru), (*resumed.weights, *resumed.gru), strict=True):
        np.testing.assert_array_equal(one, other)
    still = [*flags, "--gradient.learning_rate", "1e-9", "--start-from", "run", "--seed", "5", "--out", "next"]
    assert main(still) == 0
    before, after = (load_file(Path(name)) for name in ("run/members/seed0.npz", "next/members/seed5.npz"))
    assert answers(before) == pytest.approx(answers(after), abs=1e-4)


def answers(contents: PolicyFile) -> np.ndarray:
    """Actions on a walk of observations."""
    policy, random = Policy(contents, "one", np.float64), np.random.default_rng(3)
    walk = np.cumsum(random.normal(scale=0.03, size=(20, 18)), axis=0)
    return np.array([policy.action(seen) for seen in walk])


def test_settings_reach_the_network(transport: Config) -> None:
    config = with_settings(transport, follower={"recurrent_units": 5})
    env = TransportEnv(config, "newton-euler")
    assert (env.action_size, env.observation_size) == (3 + 5, 18 + 6 + 5)
    assert env.recurrent_slots == slice(24, 29)
