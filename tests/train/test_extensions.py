"""A user's own environment, reward and algorithm: trained, refused in one sentence; training as a pure function."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
import toys
from command_line import REPOSITORY, call, environment, tiny
from conftest import with_settings
from tables import weekly

from mjxball.algorithms.sac import SoftActorCritic
from mjxball.commands.train import main
from mjxball.config import Config, preset
from mjxball.env import TransportEnv
from mjxball.errors import InputError
from mjxball.policy import load_file, load_network
from mjxball.train import program as programs
from mjxball.train import train
from mjxball.train.extensions import Extensions, find, make_env
from mjxball.train.population import Population
from mjxball.train.program import TrainingProgram

SMALL = {
    "total_steps": 6000, "num_envs": 16, "replay_size": 6400, "batch_size": 64, "warmup_steps": 400,
    "policy_layers": (16, 16), "critic_layers": (16, 16), "updates_per_step": 4, "num_evaluations": 3,
    "learning_rate": 5e-3,
}  # fmt: skip


@pytest.fixture(scope="module")
def small(transport: Config) -> Config:
    return with_settings(transport, sac=SMALL, timing={"episode_steps": 60})


def test_only_programs_of_ours_are_kept() -> None:
    """Traced programs are found again by what they depend on, which nobody knows of an object of the user's own."""
    assert Extensions().ours()
    assert Extensions(algorithm="gradient").ours()
    assert Extensions(algorithm=SoftActorCritic).ours()
    assert not Extensions(env=toys.DoubleIntegrator).ours()
    assert not Extensions(env=toys.DoubleIntegrator()).ours()
    assert not Extensions(reward=len).ours()


def test_an_environment_of_ones_own_is_traced_once(small: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    """Checking it and training on it share what was traced: that of a physics engine may take seconds."""
    traced = []
    step = toys.DoubleIntegrator.step
    monkeypatch.setattr(toys.DoubleIntegrator, "step", lambda *given: (traced.append(1), step(*given))[1])
    key = jax.random.PRNGKey(0)
    jax.make_jaxpr(lambda key: train(small, key, env=toys.DoubleIntegrator, algorithm=SoftActorCritic)[1])(key)
    assert len(traced) == 1


@pytest.mark.slow
def test_any_brax_environment_trains(small: Config) -> None:
    """From pushing at random to standing at 0: the return of 60 steps is about -1.5 for the optimal controller."""
    policy, metrics = jax.jit(lambda key: train(small, key, env=toys.DoubleIntegrator))(jax.random.PRNGKey(0))
    assert metrics["eval_return"].shape == metrics["alpha"].shape == (3,)
    assert metrics["eval_return"][-1] > -8.0
    assert metrics["eval_distance"][-1] < 0.3
    assert policy(np.array([1.0, 0.0]))[0] < 0 < policy(np.array([-1.0, 0.0]))[0]


@pytest.mark.slow
def test_runs_side_by_side_are_the_runs_alone(small: Config) -> None:
    """vmap over keys and over a numeric setting."""
    keys, rates = jax.random.split(jax.random.PRNGKey(1), 2), np.array([1e-3, 5e-3], np.float32)
    tiny = with_settings(small, sac={**SMALL, "total_steps": 800})

    def one(key, rate):
        return train(tiny, key, env=toys.DoubleIntegrator, overrides={"sac.learning_rate": rate})

    together, single = jax.jit(jax.vmap(one))(keys, rates), jax.jit(one)
    for member in range(2):
        alone = single(keys[member], rates[member])
        for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(a[member], b, rtol=2e-3, atol=2e-3)  # batched products round differently


@pytest.mark.slow
def test_the_pure_function_is_the_run(small: Config) -> None:
    """Same steps, same keys: the same policy as `train.py --seed 5`, evaluations left out."""
    tiny = with_settings(small, sac={**SMALL, "total_steps": 800})
    population = Population(tiny, "newton-euler", extensions=Extensions(toys.DoubleIntegrator))
    program, compiled = population.program, population.compile(creating=True)
    warmup, total = program.warmup_steps_each, program.total_steps_each
    state, *_ = population.advance(compiled, population.start(compiled, 5), programs.warmup_mode(warmup))
    state, *_ = population.advance(compiled, state, programs.train_mode(total - warmup))
    policy, _ = jax.jit(lambda key: train(tiny, key, env=toys.DoubleIntegrator))(jax.random.PRNGKey(5))
    for a, b in zip(jax.tree.leaves(policy), jax.tree.leaves(population.policy(state, 0)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5)  # two programs: XLA may fuse them differently


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sac", *weekly("ppo")])
def test_an_episode_that_ends_early_has_its_own_return(name: str, small: Config) -> None:
    """An environment that earns 1 a step and ends after 7: not the 60 of an episode of the time limit."""
    program = TrainingProgram(small, "newton-euler", extensions=Extensions(toys.Brief, None, find(name, "--algorithm")))
    state = jax.jit(program.create)(jax.random.PRNGKey(0))
    state = state._replace(envs=program.evaluation_envs(jax.random.PRNGKey(0)))
    steps = program.evaluation_steps
    _, statistics, _ = jax.jit(program.advance)(state, programs.evaluate_mode(steps))
    assert float(statistics.reward) == steps == 60
    # 60 steps are 8 whole episodes and the begin of a ninth.
    assert float(program.evaluated_return(statistics.reward, statistics.ended)) == pytest.approx(60 / 9)


def test_a_reward_of_the_users_own_replaces_ours() -> None:
    config = preset("transport")
    env = make_env(Extensions(reward=toys.effort), config, "newton-euler")
    state = env.reset(jax.random.PRNGKey(0))
    action = np.array([0.5, 0.0, 0.0], np.float32)
    after = env.step(state, action)
    assert float(after.reward) == pytest.approx(-float(after.metrics["error"]) - 0.25, rel=1e-6)
    assert (env.input_mask, env.observation_size) == (env.env.input_mask, env.env.observation_size)


@pytest.mark.slow
def test_followers_of_a_team_share_a_reward_or_have_their_own() -> None:
    config = with_settings(preset("team"), scenario={"team_sizes": ()})
    for reward in (lambda _, action, after: -after.metrics["error"], lambda _, action, after: action[..., 0] - 1.0):
        env = make_env(Extensions(reward=reward), config, "newton-euler")
        state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
        action = np.zeros((5, env.action_size), np.float32)
        assert jax.eval_shape(env.step, state, action).reward.shape == (5,)
    assert make_env(Extensions(env=toys.Gentle), config, "newton-euler").observation_size == env.observation_size
    with pytest.raises(InputError, match=r"one number or one for each follower, shape \(5,\), not shape \(5, 3\)"):
        make_env(Extensions(reward=lambda _, a, after: a[..., :3]), config, "newton-euler")


@pytest.mark.slow
def test_a_run_on_an_environment_of_ones_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    flags = [word for name, value in SMALL.items() for word in (f"--sac.{name}", str(value).strip("() "))]
    flags = [word.replace(" ", "") for word in flags]
    flags += ["--timing.episode_steps", "60", "--sac.total_steps", "1600"]
    assert main(["--env", "toys:DoubleIntegrator", *flags]) == 0
    (run,) = Path("runs").iterdir()
    assert run.name.startswith("DoubleIntegrator-")
    run.rename("run")
    with np.load("run/policy.npz", allow_pickle=False) as policy:
        assert (policy["weight_0"].shape, policy["bias_2"].shape) == ((2, 16), (2,))
        assert json.loads(str(policy["card"]))["extensions"] == {"env": "toys:DoubleIntegrator"}
        hidden = np.zeros((3, 2)) - policy["observation_mean"]
        hidden *= policy["observation_scale"]
        for number in (0, 1):
            hidden = np.maximum(hidden @ policy[f"weight_{number}"] + policy[f"bias_{number}"], 0)
        action = np.tanh(hidden @ policy["weight_2"] + policy["bias_2"])[:, :1]
    np.testing.assert_allclose(load_network("run/policy.npz")(np.zeros((3, 2), np.float32)), action, atol=1e-6)
    with pytest.raises(InputError, match=r"load_network reads that of another environment"):
        load_file("run/policy.npz")
    np.savez("run/other.npz", weight_0=np.zeros((2, 2)), observation_mean=np.zeros(2))
    with pytest.raises(InputError, match=r"other.npz holds no network"):
        load_network("run/other.npz")
    columns = Path("run/metrics.csv").read_text().splitlines()[0].split(",")
    assert columns[4:6] == ["distance", "alpha"]
    assert columns[-1] == "eval_distance"


@pytest.mark.slow
def test_an_import_of_brax_says_nothing_of_warp(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("from brax.envs.base import Env\n")
    command = [sys.executable, "-c", "from mjxball.train.extensions import find; find('mine:Env', '--env')"]
    done = subprocess.run(command, cwd=tmp_path, env=environment(), capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@pytest.mark.parametrize(
    ("flag", "name", "word"),
    [
        ("--env", "toys", "package.module:Name"),
        ("--env", "nowhere:Env", "no module nowhere"),
        ("--env", "toys:Missing", "has no Missing"),
        ("--env", "toys:Needy", "needs mass"),
        ("--env", "toys:Wide", "obs of shape (3,), not (2,)"),
        ("--env", "toys:Broken", "no such wheel"),
        ("--env", "toys:effort", "needs state"),
        ("--env", "toys:Nothing", "lacks reset, step, observation_size, action_size"),
        ("--env", "toys:Fed", "step must take (state, action)"),
        ("--env", "toys:Sizeless", "observation_size raised ValueError: no ruler"),
        ("--env", "toys:Masked", "input_mask must hold observation_size = 2 numbers"),
        ("--env", "toys:Bare", "whose info is a dictionary"),
        ("--env", "toys:Branching", "in toys.py line 96; use JAX operations"),
        ("--reward", "toys:NUMBER", "--reward toys:NUMBER is no function"),
        ("--reward", "toys:vector", "one number"),
        ("--reward", "toys:binary", "(state, action, next state)"),
        ("--algorithm", "toys:Wide", "lacks init"),
    ],
)
def test_mistakes_are_one_sentence(
    flag: str, name: str, word: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["transport", "--physics", "newton-euler", flag, name]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert flag in line
    assert word in line
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_mistake_ends_the_process_with_one_sentence(tmp_path: Path) -> None:
    """Also while the device's runtime, which a thread starts, is not there yet."""
    command = [sys.executable, REPOSITORY / "train.py", "--env", "toys:Needy", "--physics", "newton-euler"]
    child = {**environment(), "PYTHONPATH": f"{REPOSITORY}:{Path(__file__).parents[1]}"}
    for _ in range(3):
        done = subprocess.run(command, cwd=tmp_path, env=child, capture_output=True, text=True, check=False)
        assert done.returncode == 2
        assert len(done.stderr.splitlines()) == 1


def test_our_environment_and_algorithm_need_no_exception() -> None:
    """The defaults go the same way as a user's own."""
    env = make_env(Extensions(env=TransportEnv), preset("transport"), "newton-euler")
    assert isinstance(env, TransportEnv)
    assert {"init", "collect", "update", "policy"} <= set(vars(SoftActorCritic))


@pytest.mark.slow
def test_a_reward_that_is_not_finite_ends_the_training_and_leaves_no_policy(tmp_path: Path, capsys) -> None:
    assert call(main, ["transport", "--reward", "toys:unsound", "--out", tmp_path / "run", *tiny()]) == 1
    assert "a reward that is not finite does this" in capsys.readouterr().err
    assert not (tmp_path / "run" / "policy.npz").exists()
