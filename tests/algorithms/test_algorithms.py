"""PPO and first-order gradients against known optima, and through the command line like SAC."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
import toys
from command_line import TRANSPORT, assert_refused
from conftest import noticing_stale, with_settings
from tables import weekly

from mjxball.algorithms.base import Shards, TrainingPhase
from mjxball.algorithms.gradient import FirstOrderGradient, begins_episode
from mjxball.commands.train import main
from mjxball.config import Config, preset
from mjxball.control.network import Network
from mjxball.env import TransportEnv
from mjxball.errors import InputError
from mjxball.policy import Policy
from mjxball.policy.export import policy_file
from mjxball.policy.file import PolicyFile, load_file, observing_stale, save_file, shipped_policy
from mjxball.sim.follower import network_interface
from mjxball.train import program as programs
from mjxball.train.environments import Environments
from mjxball.train.extensions import Extensions, find
from mjxball.train.program import TrainingProgram
from mjxball.train.run_directory import file_hash, start_policy

A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]])
Q, R = np.diag([1.0, 0.1]), np.array([[0.05]])
TRAIN = TrainingPhase(jnp.asarray(False), jnp.asarray(False))
SMALL = {
    "ppo": {"total_steps": 40_960, "num_envs": 64, "unroll_length": 16, "minibatches": 4, "learning_rate": 3e-3},
    "gradient": {"gradient_steps": 60, "num_envs": 16, "horizon": 40, "num_evaluations": 2, "policy_layers": (16, 16)},
    "sac": {"total_steps": 3200, "num_envs": 16, "replay_size": 3200, "batch_size": 64, "warmup_steps": 400,
            "policy_layers": (16, 16), "critic_layers": (16, 16)},
}  # fmt: skip


class LinearQuadratic(toys.Env):
    """x' = A x + B u at the cost x'Q x + u'R u, from |x| of some 0.002: there tanh is as good as linear."""

    observation_size, action_size, backend = 2, 1, "none"

    def reset(self, rng: Any) -> Any:
        zero = jnp.zeros(())
        return toys.State(None, 0.002 * jax.random.normal(rng, (2,)), zero, zero, {}, {"truncation": zero})

    def step(self, state: Any, action: Any) -> Any:
        x = state.obs
        cost = x @ Q @ x + action @ R @ action
        return state.replace(obs=A @ x + B @ action, reward=-cost)


def gradient_of(
    config: Config, gain: np.ndarray, swept: dict[str, float] | None = None, **settings: Any
) -> tuple[np.ndarray, float, np.ndarray]:
    """(start states (32, 2), loss, its gradient (1, 2)) of u = -gain x on 32 worlds, none of which begins anew.

    `swept` settings are traced, as in a population. The training is about to end.
    """
    settings = {"num_envs": 32, "windows_per_episode": (33,), "policy_layers": (), "gradient_steps": 1, **settings}
    environments = Environments(LinearQuadratic(), 32, Shards())
    states = environments.reset(jax.random.PRNGKey(0))
    kernel = jnp.concatenate([-jnp.asarray(gain.T, jnp.float32), jnp.zeros((2, 1))], axis=1)

    def collected(traced: dict[str, Any]) -> tuple[Any, Any]:
        own = dataclasses.replace(config.gradient, **settings, **traced)
        algorithm = FirstOrderGradient(dataclasses.replace(config, gradient=own), environments)
        state = algorithm.init(jax.random.PRNGKey(1))._replace(
            layers={"hidden_0": {"kernel": kernel, "bias": jnp.zeros(2)}},
            windows=jnp.ones((), jnp.int32),
            progress=jnp.ones(()),
        )
        after, _ = algorithm.collect(state, environments.begin(states), [jax.random.PRNGKey(2)], TRAIN)
        return after.loss, after.slope["hidden_0"]["kernel"]

    loss, slope = jax.jit(collected)(swept or {})
    return np.asarray(states.obs, float), float(loss), -np.asarray(slope)[:, :1].T


def test_the_gradient_of_a_linear_policy_is_that_of_the_lyapunov_equations(transport: Config) -> None:
    """Fazel et al. 2018, lemma 1: dC/dK = 2 ((R + B'P B) K - B'P A) S, which is 0 at the Riccati solution."""
    riccati = scipy.linalg.solve_discrete_are(A, B, Q, R)
    best = np.linalg.solve(R + B.T @ riccati @ B, B.T @ riccati @ A)
    for gain in (best, 0.7 * best, best + np.array([[0.5, -0.3]])):
        start, _, found = gradient_of(transport, gain, horizon=300)
        closed = A - B @ gain
        value = scipy.linalg.solve_discrete_lyapunov(closed.T, Q + gain.T @ R @ gain)
        visited = scipy.linalg.solve_discrete_lyapunov(closed, start.T @ start / len(start))
        wanted = 2 * ((R + B.T @ value @ B) @ gain - B.T @ value @ A) @ visited / 300  # the loss is a mean over steps
        # Float32; at the optimum what is left is a thousandth of what it is elsewhere.
        np.testing.assert_allclose(found, wanted, rtol=0.01, atol=1e-11)


@pytest.mark.parametrize("swept", [False, True])
@pytest.mark.parametrize("decay", [1.0, 0.9])
def test_a_gradient_decays_by_its_factor_at_every_step_and_the_loss_stays(
    decay: float, swept: bool, transport: Config
) -> None:
    gain, steps, own = np.array([[2.0, 1.5]]), 30, {"gradient_decay": decay}
    x, loss, found = gradient_of(transport, gain, horizon=steps, **({"swept": own} if swept else own))
    states = [x]
    for _ in range(steps):
        states.append(states[-1] @ (A - B @ gain).T)
    later, wanted, cost = np.zeros_like(x), np.zeros((1, 2)), 0.0
    for x in states[-2::-1]:  # backwards: `later` is the gradient with respect to the next state
        u = -x @ gain.T
        pushed = 2 * u @ R + decay * later @ B
        wanted -= pushed.T @ x / (steps * len(x))
        later = 2 * x @ Q + decay * later @ A - pushed @ gain
        cost += ((x @ Q) * x).sum() / (steps * len(x)) + ((u @ R) * u).sum() / (steps * len(x))
    np.testing.assert_allclose(loss, cost, rtol=1e-3)
    np.testing.assert_allclose(found, wanted, rtol=2e-3)


def impulse_cost(gain: np.ndarray, impulse: np.ndarray, steps: int) -> float:
    """Mean of log(1 + |answer|^2 / 1e-6) of u = -gain x to `impulse` (worlds, 1) of the first action, in float64."""
    x, total = np.zeros((len(impulse), 2)), 0.0
    for number in range(steps):
        u = -x @ gain.T + (impulse if number == 0 else 0.0)
        x = x @ A.T + u @ B.T
        total += np.log1p(((x**2).sum(axis=1) + (u**2).sum(axis=1)) / 1e-6).mean() / steps
    return total


@pytest.mark.parametrize("swept", [False, True])
def test_an_impulse_response_costs_its_logarithm(swept: bool, transport: Config) -> None:
    """Loss and gradient against central differences of an independent simulation."""
    gain, steps, weight = np.array([[2.0, 1.5]]), 25, 0.3
    own = {"impulse_response": weight}
    _, without, slope = gradient_of(transport, gain, horizon=steps)
    _, loss, found = gradient_of(transport, gain, horizon=steps, **({"swept": own} if swept else own))
    key = jax.random.fold_in(jax.random.PRNGKey(2), 1)
    impulse = np.asarray(jax.random.normal(key, (32, 1)), float)
    assert loss - without == pytest.approx(weight * impulse_cost(gain, impulse, steps), rel=1e-4)
    steps_of = 1e-5 * np.eye(2)[:, None]
    wanted = [
        (impulse_cost(gain + step, impulse, steps) - impulse_cost(gain - step, impulse, steps)) / 2e-5
        for step in steps_of
    ]
    np.testing.assert_allclose((found - slope)[0], weight * np.array(wanted), rtol=2e-3)


@pytest.mark.slow
def test_an_impulse_response_begins_to_count_late_in_one_branch_for_all_members(transport: Config) -> None:
    """Two members side by side; the program has both windows and computes one."""
    gain, steps = np.array([[2.0, 1.5]]), 25
    losses = [gradient_of(transport, gain, horizon=steps, impulse_response=weight)[1] for weight in (0.0, 0.3)]
    own = dataclasses.replace(
        transport.gradient,
        **{"num_envs": 32, "windows_per_episode": (199,), "policy_layers": (), "horizon": steps},
        **{"gradient_steps": 100, "impulse_response": 0.3},
    )
    environments = Environments(LinearQuadratic(), 32, Shards())
    algorithm = FirstOrderGradient(dataclasses.replace(transport, gradient=own), environments)
    kernel = jnp.concatenate([-jnp.asarray(gain.T, jnp.float32), jnp.zeros((2, 1))], axis=1)
    states = environments.reset(jax.random.PRNGKey(0))

    def loss(progress: Any) -> Any:
        state = algorithm.init(jax.random.PRNGKey(1))._replace(
            layers={"hidden_0": {"kernel": kernel, "bias": jnp.zeros(2)}},
            windows=jnp.ones((), jnp.int32),
            progress=progress,
        )
        after, _ = algorithm.collect(state, environments.begin(states), [jax.random.PRNGKey(2)], TRAIN)
        return after.loss

    both = jax.vmap(loss)
    for progress, wanted in ((0.74, losses[0]), (0.75, losses[1])):
        np.testing.assert_allclose(both(jnp.array([progress, progress])), wanted, rtol=1e-5)
    primitives = [str(equation.primitive) for equation in jax.make_jaxpr(both)(jnp.array([1, 1])).eqns]
    assert "cond" in primitives


class Standing(LinearQuadratic):
    """It stays at observations of mean 3 and deviation 0.5, whatever the action."""

    def reset(self, rng: Any) -> Any:
        return super().reset(rng).replace(obs=3.0 + 0.5 * jax.random.normal(rng, (2,)))

    def step(self, state: Any, action: Any) -> Any:
        return state


class Pursuing(LinearQuadratic):
    """Its cost has a target, which a loop of unknown length moves: nothing goes backwards through that."""

    def reset(self, rng: Any) -> Any:
        return super().reset(rng).replace(pipeline_state={"target": jnp.ones(()), "nothing": jnp.zeros(0)})

    def step(self, state: Any, action: Any) -> Any:
        world, moved = state.pipeline_state, super().step(state, action)
        target = jax.lax.while_loop(lambda value: value > 0.5, lambda value: 0.9 * value, world["target"])
        return moved.replace(reward=-((moved.obs[0] - target) ** 2), pipeline_state=world | {"target": target})


def test_what_no_action_reaches_needs_no_gradient(transport: Config) -> None:
    environments = Environments(Pursuing(), 32, Shards())
    algorithm = FirstOrderGradient(transport, environments)
    states = environments.reset(jax.random.PRNGKey(0))
    begun = environments.begin(states)
    known, _ = algorithm.collect(algorithm.init(jax.random.PRNGKey(1)), begun, [jax.random.PRNGKey(2)], TRAIN)
    assert all(np.abs(slope["bias"]).max() > 0 for slope in known.slope.values())


def test_the_first_window_normalises_the_observations(transport: Config) -> None:
    environments = Environments(Standing(), 32, Shards())
    algorithm = FirstOrderGradient(transport, environments)
    states = environments.reset(jax.random.PRNGKey(0))
    first = TrainingPhase(jnp.asarray(True), jnp.asarray(False))
    known, _ = algorithm.collect(
        algorithm.init(jax.random.PRNGKey(1)), environments.begin(states), [jax.random.PRNGKey(2)], first
    )
    policy = algorithm.policy(known)
    # Some of the environments begin anew with the window, at states of the same distribution.
    np.testing.assert_allclose(policy.mean, 3.0, atol=0.4)
    np.testing.assert_allclose(policy.deviation, 0.5, atol=0.2)


def returns(config: Config, name: str, env: Any, seed: int = 0) -> np.ndarray:
    """Mean reward a step of the policy after the whole training, and of the one before it."""
    program = TrainingProgram(config, "newton-euler", extensions=Extensions(env, None, find(name, "--algorithm")))
    advance, evaluate = jax.jit(program.advance), programs.evaluate_mode(80)
    state = jax.jit(program.create)(jax.random.PRNGKey(seed))
    fresh = program.evaluation_envs(jax.random.PRNGKey(7))
    found = []
    warmup = program.warmup_steps_each
    for mode in (programs.warmup_mode(warmup), programs.train_mode(program.total_steps_each - warmup)):
        state, *_ = advance(state, mode)
        found.append(float(advance(state._replace(envs=fresh), evaluate)[1].reward) / 80)
    return np.array(found)


@pytest.mark.parametrize(("slow", "square"), [(0.9, 0.999), (0.7, 0.99), (0.0, 0.0)])
def test_adam_keeps_what_the_settings_say(slow: float, square: float, transport: Config) -> None:
    changes = {"adam_betas": (slow, square), "learning_rate": 1.0, "learning_rate_final_ratio": 1.0}
    own = dataclasses.replace(transport.gradient, **changes)
    environments = Environments(LinearQuadratic(), 4)
    algorithm = FirstOrderGradient(dataclasses.replace(transport, gradient=own), environments)
    state = algorithm.init(jax.random.key(0))
    expected, mean, mean_square = np.asarray(state.layers["hidden_0"]["bias"])[0], 0.0, 0.0
    for step, slope in enumerate((0.3, -0.1), 1):
        slopes = jax.tree.map(jnp.zeros_like, state.layers)
        slopes["hidden_0"]["bias"] = slopes["hidden_0"]["bias"].at[0].set(slope)
        state, _ = algorithm.update(state._replace(slope=slopes), [], jnp.zeros(()), TRAIN)
        mean, mean_square = slow * mean + (1 - slow) * slope, square * mean_square + (1 - square) * slope**2
        unbiased = mean / (1 - slow**step), mean_square / (1 - square**step)
        expected -= unbiased[0] / (math.sqrt(unbiased[1]) + 1e-8)
    np.testing.assert_allclose(state.layers["hidden_0"]["bias"][0], expected, rtol=1e-5)  # float32


@pytest.mark.parametrize("name", [pytest.param("ppo", marks=pytest.mark.slow), "gradient"])
def test_a_point_is_pushed_to_rest(name: str, transport: Config) -> None:
    """Over 80 steps a clipped LQR whose push is free earns -0.022 a step, one that does nothing -2.5 (NumPy)."""
    config = with_settings(transport, timing={"episode_steps": 80}, **{name: SMALL[name]})
    before, after = returns(config, name, toys.DoubleIntegrator)
    assert before < -0.5
    assert after > -0.06


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ppo", "gradient", *weekly("sac")])
def test_training_goes_on_bit_for_bit(name: str, transport: Config) -> None:
    config = with_settings(transport, timing={"episode_steps": 80}, **{name: SMALL[name]})
    extensions = Extensions(toys.DoubleIntegrator, None, find(name, "--algorithm"))
    program = TrainingProgram(config, "newton-euler", extensions=extensions)
    advance, window = jax.jit(program.advance), program.algorithm.steps_per_collect
    start, *_ = advance(jax.jit(program.create)(jax.random.PRNGKey(0)), programs.warmup_mode(program.warmup_steps_each))
    once, *_ = advance(start, programs.train_mode(4 * window))
    half, *_ = advance(start, programs.train_mode(window))
    kept = jax.tree.map(np.asarray, half)  # as a checkpoint keeps it
    twice, *_ = advance(kept, programs.train_mode(3 * window))
    jax.tree.map(np.testing.assert_array_equal, once, twice)
    # An evaluation changes nothing of the policy.
    seen, *_ = advance(once, programs.evaluate_mode(2 * window))
    jax.tree.map(np.testing.assert_array_equal, program.policy(once), program.policy(seen))


def layers_of(contents: PolicyFile, seen: np.ndarray) -> list[np.ndarray]:
    """All weights and biases; those of an input that is not seen are none."""
    return [contents.weights[0][seen], *contents.weights[1:], *contents.biases]


NARROW = ["--gradient.policy_layers", "8"]


@pytest.mark.release  # of a recurrent one, test_recurrent.py
def test_a_run_by_gradient_writes_a_policy_and_resumes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, short_verdict: None, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    flags = ["--gradient.gradient_steps", "2", "--gradient.num_envs", "4", "--gradient.horizon", "20"]
    flags += ["--algorithm", "gradient", "--num-seeds", "2", "--gradient.learning_rate", "1e-9"]
    assert main([*flags, "--out", "run"]) == 0
    record = json.loads(Path("run/config.json").read_text())
    assert (record["physics"], record["extensions"]) == ("newton-euler", {"algorithm": "gradient"})
    header = Path("run/metrics.csv").read_text().splitlines()[0]
    assert "gradient_norm" in header
    assert main(["--resume", "run"]) == 0  # nothing is left to train
    assert main([*flags, "--start-from", "run/policy.npz", "--seed", "5", "--out", "next"]) == 0
    before, after = (load_file(Path(name, "policy.npz")) for name in ("run", "next"))
    seen = before.observation_scale > 0
    for one, other in zip(layers_of(before, seen), layers_of(after, seen), strict=True):
        np.testing.assert_allclose(other, one, atol=1e-6)
    np.testing.assert_allclose(after.observation_mean, before.observation_mean, atol=1e-6)
    np.testing.assert_allclose(after.observation_scale, before.observation_scale, rtol=1e-3)
    assert after.metadata["start_from"]["policy"] == "run/policy.npz"
    assert main([*flags, "--start-from", "run", "--seed", "5", "--out", "each"]) == 0
    for seed in (0, 1):
        paths = f"run/members/seed{seed}.npz", f"each/members/seed{5 + seed}.npz"
        before, after = (load_file(Path(path)) for path in paths)
        for one, other in zip(layers_of(before, seen), layers_of(after, seen), strict=True):
            np.testing.assert_allclose(other, one, atol=1e-6)
        assert after.metadata["start_from"]["policy"] == f"run/members/seed{seed}.npz"
    assert main([*flags, "--num-seeds", "3", "--start-from", "run", "--out", "other"]) == 2
    assert "say --num-seeds 2" in capsys.readouterr().err


def test_training_starts_from_what_a_policy_does(recurrent: Any) -> None:
    """A policy file, made into what is trained and back, gives the same commands to float32."""
    algorithm = FirstOrderGradient(recurrent.config, Environments(TransportEnv(recurrent.config, "newton-euler"), 4))
    begun = algorithm.start_from(algorithm.init(jax.random.key(0)), recurrent.contents)
    again = policy_file(recurrent.config, network_interface(recurrent.config), algorithm.policy(begun), steps=0)
    observations = np.random.default_rng(1).normal(size=(50, 18))
    old, new = (Policy(one, "one", np.float64) for one in (recurrent.contents, again))
    np.testing.assert_allclose([new(row) for row in observations], [old(row) for row in observations], atol=1e-5)
    aware = with_settings(recurrent.config, follower={"stale": True})
    algorithm = FirstOrderGradient(aware, Environments(TransportEnv(aware, "newton-euler"), 4))
    begun = algorithm.start_from(algorithm.init(jax.random.key(0)), observing_stale(recurrent.contents))
    again = policy_file(aware, network_interface(aware), algorithm.policy(begun), steps=0)
    new, old = Policy(again, "one", np.float64), Policy(recurrent.contents, "one", np.float64)
    observations[1::2, :12] = observations[::2, :12]
    np.testing.assert_allclose([new(row) for row in observations], [old(row) for row in observations], atol=1e-5)


@pytest.mark.parametrize(("units", "layers"), [(11, (9, 5)), (7, (20, 12)), (11, (20, 12))])
def test_a_larger_network_starts_from_what_a_smaller_one_does(recurrent: Any, units: Any, layers: Any) -> None:
    """And its new units can learn: what they add to the action is 0, its gradient by their weights is not."""
    config, small = recurrent.config, recurrent.contents
    larger = with_settings(config, follower={"recurrent_units": units}, gradient={"policy_layers": layers})
    algorithm = FirstOrderGradient(larger, Environments(TransportEnv(larger, "newton-euler"), 4))
    begun = algorithm.start_from(algorithm.init(jax.random.key(0)), small)
    again = policy_file(larger, network_interface(larger), algorithm.policy(begun), steps=0)
    observations = np.random.default_rng(1).normal(size=(50, 18))
    old, new = (Policy(one, "one", np.float64) for one in (small, again))
    np.testing.assert_allclose([new(row) for row in observations], [old(row) for row in observations], atol=1e-5)
    added = [*range(5, layers[1]), *range(layers[1] + 7, layers[1] + units)]
    assert added
    assert len(again.weights[2]) == layers[1] + units
    assert not again.weights[2][added].any()
    network = Network(again.weights, again.biases, again.observation_mean, again.observation_scale, again.gru)
    inputs = np.concatenate([np.random.default_rng(2).normal(size=(50, 27)), np.zeros((50, units))], axis=-1)

    def total(last: Any) -> Any:
        weights = (*again.weights[:-1], last)
        return network._replace(weights=weights).like(jnp.asarray(inputs)).outputs(jnp.asarray(inputs))[0].sum()

    slope = jax.grad(total)(jnp.asarray(again.weights[2]))
    assert np.asarray(slope)[added].any(axis=1).all()


def test_a_network_starts_from_none_with_other_inputs(recurrent: Any) -> None:
    aware = with_settings(recurrent.config, follower={"stale": True})
    algorithm = FirstOrderGradient(aware, Environments(TransportEnv(aware, "newton-euler"), 4))
    with pytest.raises(InputError, match="the policy to start from has 27 inputs, and the run 28"):
        algorithm.start_from(algorithm.init(jax.random.key(0)), recurrent.contents)


def test_a_network_starts_from_none_that_is_larger(recurrent: Any, tmp_path: Path) -> None:
    path = tmp_path / "policy.npz"
    save_file(path, recurrent.contents)
    start = {"policy": str(path), "sha256": file_hash(path)}
    start_policy(start, with_settings(recurrent.config, follower={"recurrent_units": 9}))
    start_policy(start, with_settings(recurrent.config, gradient={"policy_layers": (9, 6)}))
    with pytest.raises(InputError, match=r"other settings than the run's: follower\.recurrent_units$"):
        start_policy(start, with_settings(recurrent.config, follower={"recurrent_units": 6}))
    for layers in ((9, 4), (9,), (9, 5, 5)):
        with pytest.raises(InputError, match=r"say --gradient\.policy_layers 9,5, or more units"):
            start_policy(start, with_settings(recurrent.config, gradient={"policy_layers": layers}))


def test_a_run_that_observes_stale_starts_from_a_policy_that_does_not_and_not_the_reverse(
    recurrent: Any, tmp_path: Path
) -> None:
    without, path = recurrent.config, tmp_path / "unaware.npz"
    save_file(path, recurrent.contents)
    start, aware = {"policy": str(path), "sha256": file_hash(path)}, with_settings(without, follower={"stale": True})
    assert start_policy(start, without).metadata.get("stale") is None
    assert start_policy(start, aware).metadata["stale"] is True
    contents = noticing_stale(recurrent.contents)
    config = contents.metadata["config"]
    config = {**config, "follower": {**config["follower"], "stale": True}}
    path = tmp_path / "aware.npz"
    save_file(path, dataclasses.replace(contents, metadata={**contents.metadata, "config": config}))
    start = {"policy": str(path), "sha256": file_hash(path)}
    np.testing.assert_array_equal(start_policy(start, aware).weights[0], contents.weights[0])
    with pytest.raises(InputError, match=r"other settings than the run's: follower\.stale$"):
        start_policy(start, without)


def test_a_policy_to_start_from_that_has_changed_is_refused() -> None:
    path = shipped_policy("universal")
    start = {"policy": str(path), "sha256": file_hash(path)}
    assert start_policy(start, preset("universal")).metadata["preset"] == "universal"
    with pytest.raises(InputError, match="SHA-256 has changed"):
        start_policy({**start, "sha256": "0" * 64}, preset("universal"))


@pytest.mark.parametrize(
    ("flags", "word"),
    [
        (["--algorithm", "gradient", "--physics", "mjx"], "newton-euler"),
        (["--algorithm", "ppo", "--sac.tau", "0.1"], "--sac.tau is a setting of sac"),
        (["--algorithm", "sac", "--gradient.horizon", "10"], "--algorithm gradient"),
        (["--algorithm", "td3"], "sac, ppo, gradient, package.module:Name"),
        (["--algorithm", "ppo", "--ppo.minibatches", "7"], "ppo.minibatches"),
        (["--algorithm", "ppo", "--ppo.activation", "swish"], "unrecognized arguments: --ppo.activation"),
        (["transport", "--start-from", TRANSPORT], "--start-from needs --algorithm gradient"),
        (["--algorithm", "gradient", "--start-from", "none.npz"], "none.npz"),
        (["paper", "--algorithm", "gradient", "--start-from", shipped_policy("universal")], "follower."),
        (
            ["universal", "--algorithm", "gradient", *NARROW, "--start-from", shipped_policy("universal")],
            "--gradient.policy_layers 64",
        ),
        (["--algorithm", "gradient", "--resume", "run", "--start-from", TRANSPORT], "drop"),
    ],
)
def test_what_does_not_fit_is_refused(
    flags: list[str], word: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    assert word in assert_refused(main, flags, tmp_path, capsys)


def test_environments_have_episodes_of_each_length_and_begin_them_in_turn():
    turn = np.arange(48)
    begins = np.array([begins_episode(turn, windows, (3, 8)) for windows in range(48)])
    for place, length in ((0, 3), (1, 8)):
        gaps = [np.diff(np.flatnonzero(begins[:, number])) for number in turn[place::2]]
        assert {int(gap) for one in gaps for gap in one} == {length}
        each = begins[:, place::2].sum(axis=1)
        assert each.max() - each.min() <= 1, "as many begin in every window"
    assert (
        np.array([begins_episode(turn, windows, (4,)) for windows in range(8)])
        == ((turn + np.arange(8)[:, None]) % 4 == 0)
    ).all()


def test_only_small_trainings_prefer_the_cpu() -> None:
    """`quick` trains within two minutes there; `balance` would take hours beside a GPU that is idle."""
    prefers = FirstOrderGradient.prefers_cpu
    assert prefers(preset("quick"), 1)
    assert prefers(preset("transport"), 4)
    assert not prefers(preset("quick"), 64)
    assert not any(prefers(preset(name), 1) for name in ("balance", "universal", "lost"))
