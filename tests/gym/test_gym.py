"""Gymnasium: its checker, flights as in the Brax environment and in Gymnasium's own vector, endings, Playground."""

from __future__ import annotations

import copy
import pickle
import re
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from command_line import run
from conftest import compile_env, with_settings
from gymnasium.utils.env_checker import check_env
from gymnasium.utils.seeding import np_random
from tables import weekly

import mjxball.gym
from mjxball.baselines import make_baseline
from mjxball.config import PRESETS, Config, preset, replace
from mjxball.errors import InputError
from mjxball.evaluate.policies import load_policy
from mjxball.evaluate.results import fly_scenarios
from mjxball.evaluate.scenarios import REFERENCE
from mjxball.gym import core
from mjxball.gym.parallel import FollowersParallelEnv
from mjxball.gym.playground import PlaygroundEnv
from mjxball.gym.single import FollowerEnv
from mjxball.gym.vector import FollowerVectorEnv
from mjxball.quiet import import_brax_env

import_brax_env()
from brax.envs.wrappers import training as brax_wrappers  # noqa: E402

STILL = np.zeros(3, np.float32)


@pytest.fixture(scope="module")
def short() -> Config:
    """Episodes of 8 steps."""
    return with_settings(preset("transport"), timing={"episode_steps": 8})


def actions(steps: int, *shape: int) -> np.ndarray:
    """Full-reach random actions (steps, *shape, 3)."""
    return np.random.default_rng(5).uniform(-1, 1, (steps, *shape, 3)).astype(np.float32)


def test_every_preset_of_a_pair_is_registered():
    ours = {name for name in gymnasium.registry if name.startswith("mjxball/")}
    assert ours == {mjxball.gym.environment_id(name) for name, config in PRESETS.items() if config.plant.count == 2}
    assert {"mjxball/Transport-v0", "mjxball/Paper-v0", "mjxball/Balance-v0"} <= ours


@pytest.mark.parametrize(
    "name",
    [
        "Transport",
        pytest.param("Flight", marks=pytest.mark.slow),
        *weekly("Paper", "Stand"),
    ],
)
def test_gymnasiums_checker_finds_nothing(name: str):
    with warnings.catch_warnings(record=True) as raised:
        warnings.simplefilter("always")
        env = gymnasium.make(f"mjxball/{name}-v0")
        assert isinstance(env.unwrapped, FollowerEnv)
        check_env(env.unwrapped, skip_render_check=True)  # the renderer has a test of its own
    # An observation has no bounds; the checker asks whether that is meant.
    odd = [str(each.message) for each in raised if issubclass(each.category, UserWarning)]
    assert [text for text in odd if "infinity" not in text] == []


@pytest.mark.parametrize("name", ["transport", pytest.param("balance", marks=pytest.mark.slow)])
def test_it_flies_as_the_brax_environment(name: str, request: pytest.FixtureRequest):
    """Float64 against the training environment in float32, from the same drawn world, 50 steps.

    C MuJoCo (`balance`: the closed form) against closed-form physics, which compiles fastest; tests/test_env.py holds
    MJX against it.
    """
    config = replace(preset(name), "follower.recurrent_units", 0)  # as Gymnasium has it
    env = FollowerEnv(config=config)
    first, _ = env.reset(seed=7)
    _, key = jax.random.split(jax.random.key(core.seed_number(np_random(7)[0])))
    pair = request.getfixturevalue("fast_pair") if name == "transport" else compile_env(config, "newton-euler")
    state = pair.reset(key)
    size = len(first)
    assert size == env.observation_space.shape[0] <= pair.env.observation_size
    np.testing.assert_allclose(first, state.obs[:size], rtol=0, atol=1e-6)  # the same function, compiled apart
    moved = 0.0
    for action in actions(50):
        seen, reward, terminated, truncated, info = env.step(action)
        state = pair.step(state, action)
        # As between the two training engines: float32 rounding over 200 physics steps.
        np.testing.assert_allclose(seen, state.obs[:size], rtol=0, atol=1e-4)
        # An error of 1e-4 m is worth error / error_scale of that, at most 50 times as much.
        assert reward == pytest.approx(float(state.reward), abs=5e-3)
        assert info["error"] == pytest.approx(float(state.metrics["error"]), abs=1e-4)
        assert (terminated, truncated) == (False, False)
        moved = max(moved, float(np.abs(seen[:3] - first[:3]).max()))
    assert moved > 0.05  # 500 times the tolerance


def test_seeds():
    env = FollowerEnv()
    first, again, other = (env.reset(seed=seed)[0] for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    env.reset(seed=1)
    following = env.reset()[0]
    assert not np.array_equal(first, following)
    assert not np.array_equal(FollowerEnv().reset()[0], FollowerEnv().reset()[0])


@pytest.mark.slow
def test_worlds_are_the_same_where_jax_counts_in_64_bits(short: Config):
    """JAX draws other numbers then, and what was seen was no member of the space."""
    actions = np.full((2, 3), 0.3, np.float32)
    for make in (lambda: FollowerEnv(config=short), lambda: FollowerVectorEnv(2, config=short, physics="newton-euler")):
        found = []
        for wide in (False, True):
            with jax.enable_x64(wide):
                env = make()
                first, _ = env.reset(seed=1)
                assert env.observation_space.contains(first)
                given = actions[0] if isinstance(env, FollowerEnv) else actions
                found.append((first, *env.step(given)[:2]))
        for one, other in zip(*found, strict=True):
            np.testing.assert_array_equal(one, other)


FORKED = """
import multiprocessing
def child():
    import gymnasium, mjxball.gym
    gymnasium.make("mjxball/Transport-v0").reset(seed=1)
if __name__ == "__main__":
    import jax
    jax.jit(lambda x: x @ x)(jax.numpy.ones((300, 300))).block_until_ready()
    process = multiprocessing.get_context("fork").Process(target=child)
    process.start()
    process.join(60)
    print("alive" if process.is_alive() else process.exitcode)
    process.kill()
"""


@pytest.mark.slow
def test_a_process_forked_after_any_use_of_jax_refuses(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    (tmp_path / "forked.py").write_text(FORKED)
    done = run(["forked.py"], tmp_path)
    assert "this process was forked from one in which JAX runs" in done.stderr
    assert done.stdout.split() == ["1"]


def test_the_time_limit_truncates_and_leaving_terminates(short: Config):
    env = FollowerEnv(config=short)
    env.reset(seed=3)
    ends = [env.step(STILL)[2:4] for _ in range(8)]
    assert ends == [*[(False, False)] * 7, (False, True)]
    env.reset(seed=3)
    state = env._world.state
    goal = state.pipeline_state.goal + jnp.array([0.0, 0.0, 5.0])
    env._world.state = state.replace(pipeline_state=state.pipeline_state._replace(goal=goal))
    assert env.step(STILL)[2:4] == (True, False)


OUTSIDE, CLIPPED = np.array([1e39, -1.5, 0.25]), np.array([1.0, -1.0, 0.25])
NO_ACTIONS = {
    "nan": (np.array([0.0, np.nan, 0.0]), "nan"),
    "infinity": (np.array([0.0, 0.0, -np.inf]), "-inf"),
    "too few": (np.zeros(2), r"not of shape \(2,\)"),
    "a batch of one": (np.zeros((1, 3)), r"not of shape \(1, 3\)"),
    "one number": (0.0, r"not of shape \(\)"),
    "words": (np.full(3, "0.5"), "<U3"),
    "dates": (np.full(3, np.datetime64("2026-01-01")), "datetime64"),
    "nothing": (None, "object"),
    "what is masked": (np.ma.array(OUTSIDE, mask=[0, 1, 0]), "masked"),
    "what is masked, in a list": ([0.0, np.ma.masked, 0.0], "masked"),
    "truths": (np.full(3, True), "bool"),
    "a ragged list": ([[0.0], [0.0], [0.0, 0.0]], "no array"),
}


def test_actions_are_clipped_to_the_box_and_refused_unless_they_are_finite(short: Config):
    """Alike in one world, in a vector and of PettingZoo's followers, which stay as they were."""
    single = FollowerEnv(config=short, physics="newton-euler")
    vector = FollowerVectorEnv(2, config=short, physics="newton-euler")
    parallel = FollowersParallelEnv(config=short)
    each = lambda action: parallel.step({"follower_1": action})  # noqa: E731
    for env, step, shape in ((single, single.step, (3,)), (vector, vector.step, (2, 3)), (parallel, each, (3,))):
        found = []
        for action in (OUTSIDE, CLIPPED):
            first = env.reset(seed=3)[0]
            for bad, named in NO_ACTIONS.values():
                both = [bad, bad] if env is vector and getattr(bad, "shape", ()) == (3,) else bad
                with pytest.raises(InputError, match=re.escape(f"of shape {shape}") + ".*" + named):
                    step(both)
            found.append([step(np.broadcast_to(action, shape))[:2] for _ in range(3)])
        jax.tree.map(np.testing.assert_array_equal, *found)
        began, ended = jax.tree.leaves((first, found[0][2][0]))
        assert np.abs(ended - began).max() > 1e-3  # the actions did something


def test_mistakes_are_named():
    with pytest.raises(gymnasium.error.ResetNeeded):
        FollowerEnv().step(STILL)
    with pytest.raises(InputError, match="unknown preset 'nothing'"):
        FollowerEnv("nothing")
    with pytest.raises(InputError, match="unknown physics 'ode'"):
        FollowerEnv(physics="ode")
    with pytest.raises(InputError, match="C MuJoCo has no inertia without mass"):
        FollowerEnv("balance", physics="mujoco")
    with pytest.raises(ValueError, match="render_mode must be"):
        FollowerEnv(render_mode="human")
    vector = FollowerVectorEnv(2, physics="newton-euler")
    with pytest.raises(ValueError, match="3 seeds were given for 2 worlds"):
        vector.reset(seed=[1, 2, 3])


def assert_same_info(ours: dict[str, Any], theirs: dict[str, Any]) -> None:
    """Gymnasium leaves out what no world tells; here it is there, and its mask false."""
    assert set(theirs) <= set(ours)
    for name, value in ours.items():
        if name.startswith("_"):
            np.testing.assert_array_equal(value, theirs.get(name, np.zeros(3, bool)))
        elif name == "final_info":
            assert_same_info(value, theirs[name])
        elif name == "final_obs":
            assert [last is None for last in value] == [last is None for last in theirs[name]]
            pairs = [pair for pair in zip(value, theirs[name], strict=True) if pair[0] is not None]
            np.testing.assert_allclose(*zip(*pairs, strict=True), rtol=0, atol=2e-5)
        else:
            # Squared command errors and |e_o|, float32 against float64.
            np.testing.assert_allclose(value, theirs.get(name, np.zeros(3)), rtol=0, atol=1e-4)


@pytest.mark.parametrize("mode", ["NextStep", pytest.param("SameStep", marks=pytest.mark.slow)])
def test_the_vector_is_gymnasiums_own_vector_of_single_worlds(short: Config, mode: str):
    """Three episodes of 8 steps: seeds, autoreset, endings and info as in `SyncVectorEnv`."""
    ours = FollowerVectorEnv(3, config=short, physics="newton-euler", autoreset_mode=mode)
    single = [lambda: FollowerEnv(config=short, physics="newton-euler")] * 3
    theirs = gymnasium.vector.SyncVectorEnv(single, autoreset_mode=mode)
    assert ours.metadata["autoreset_mode"] == theirs.metadata["autoreset_mode"]
    assert (ours.observation_space, ours.action_space) == (theirs.observation_space, theirs.action_space)
    starts = [vector.reset(seed=11)[0] for vector in (ours, theirs)]
    np.testing.assert_allclose(*starts, rtol=0, atol=1e-6)
    ended = 0
    for given in actions(27, 3):
        (seen, reward, *ends, info), (seen_too, reward_too, *ends_too, info_too) = ours.step(given), theirs.step(given)
        # Float32 against float64 within episodes of 8 steps; the reward multiplies errors by 20.
        np.testing.assert_allclose(seen, seen_too, rtol=0, atol=2e-5)
        np.testing.assert_allclose(reward, reward_too, rtol=0, atol=4e-4)
        np.testing.assert_array_equal(ends, ends_too)
        assert_same_info(info, info_too)
        ended += int(np.sum(ends))
    # Episodes of 8 steps follow each other at once, or with a step between them.
    assert ended == 9


def by_pickle(env: Any) -> Any:
    return pickle.loads(pickle.dumps(env))


@pytest.mark.parametrize("duplicate", [by_pickle, copy.deepcopy])
def test_a_pickled_environment_goes_on_as_the_first_one(short: Config, duplicate: Any):
    """In the middle of an episode, into the next one, and with the same samples of its spaces."""
    wrapped = gymnasium.make("mjxball/Transport-v0", config=short)  # on C MuJoCo
    for env, shape in ((wrapped, (3,)), (FollowerVectorEnv(2, config=short, physics="newton-euler"), (2, 3))):
        env.reset(seed=5)
        env.action_space.seed(1)
        given = actions(6, *shape[:-1])
        for action in given[:3]:
            env.step(action)
        other = duplicate(env)
        for action in given[3:]:
            jax.tree.map(np.testing.assert_array_equal, other.step(action), env.step(action))
        jax.tree.map(np.testing.assert_array_equal, other.reset(), env.reset())
        np.testing.assert_array_equal(other.action_space.sample(), env.action_space.sample())
    new = duplicate(FollowerEnv(config=short))  # one that was never reset
    with pytest.raises(gymnasium.error.ResetNeeded):
        new.step(STILL)
    flown = duplicate(PlaygroundEnv("transport", config=short, physics="newton-euler"))
    assert (flown.config, flown._pair.backend) == (short, "newton-euler")


ASYNC = """
import sys, gymnasium, numpy as np, mjxball.gym
if __name__ == "__main__":
    given = {"vector_kwargs": {"context": "spawn"}} if sys.argv[1] == "spawn" else {}
    make = dict(id="mjxball/Transport-v0", num_envs=2, physics="newton-euler")
    envs = gymnasium.make_vec(**make, vectorization_mode="async", **given)
    try:
        first, _ = envs.reset(seed=3)
    except ValueError as error:
        sys.exit(f"refused: {error}")
    same = gymnasium.make_vec(**make, vectorization_mode="sync")
    np.testing.assert_array_equal(first, same.reset(seed=3)[0])
    actions = np.full((2, 3), 0.5, np.float32)
    np.testing.assert_array_equal(envs.step(actions)[0], same.step(actions)[0])
    envs.close()
"""


@pytest.mark.slow
def test_workers_are_spawned_or_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Forked ones waited for ever at their first reset."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    (tmp_path / "workers.py").write_text(ASYNC)
    done = run(["workers.py", "fork"], tmp_path)
    assert (done.returncode, "refused: " in done.stderr) == (1, True), done.stderr
    assert "{'context': 'spawn'}" in done.stderr
    done = run(["workers.py", "spawn"], tmp_path)
    assert done.returncode == 0, done.stderr


def test_make_vec_takes_mjx():
    vector = gymnasium.make_vec("mjxball/Transport-v0", num_envs=2, vectorization_mode="vector_entry_point")
    assert isinstance(vector.unwrapped, FollowerVectorEnv)
    assert vector.unwrapped._worlds.program.env.backend == "mjx"


RENDER = """
import gymnasium, numpy as np, mjxball.gym
env = gymnasium.make("mjxball/Transport-v0", render_mode="rgb_array")
env.reset(seed=4)
first = env.render()
for _ in range(40):
    env.step(np.ones(3, np.float32))
last = env.render()
env.close()
np.savez("pictures.npz", first=first, last=last)
"""


@pytest.mark.slow
def test_without_a_display_the_variable_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "MUJOCO_GL"):
        monkeypatch.delenv(name, raising=False)
    done = run(["-c", RENDER], tmp_path)
    assert done.returncode == 1
    assert re.search("InputError: .*MUJOCO_GL to egl", done.stderr.splitlines()[-1]), done.stderr


@pytest.mark.slow
def test_rendering(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """In a process of its own, which a failing GL library may end."""
    monkeypatch.setenv("MUJOCO_GL", "egl")
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    done = run(["-c", RENDER], tmp_path)
    if done.returncode and re.search("EGL|OpenGL|gl_context|libGL|GLError", done.stderr):
        pytest.skip("MuJoCo's renderer finds no GL library")
    assert done.returncode == 0, done.stderr
    with np.load(tmp_path / "pictures.npz") as stored:
        first, last = stored["first"].astype(int), stored["last"].astype(int)
    assert first.shape == (360, 480, 3)
    assert (np.abs(first - last).max(axis=-1) > 30).sum() > 200  # the pair has moved


class Restarting:
    """What Playground's auto-reset wrapper asks of an environment and its state, in short."""

    def __init__(self, env: Any):
        self.env = env

    def reset(self, rng: Any) -> Any:
        state = self.env.reset(rng)
        state.info["first_data"], state.info["first_obs"] = state.data, state.obs
        return state

    def step(self, state: Any, action: Any) -> Any:
        state.info.update(steps=jnp.where(state.done, jnp.zeros_like(state.info["steps"]), state.info["steps"]))
        state = self.env.step(state.replace(done=jnp.zeros_like(state.done)), action)

        def where_done(new: Any, old: Any) -> Any:
            return jnp.where(jnp.reshape(state.done, [new.shape[0]] + [1] * (new.ndim - 1)), new, old)

        data = jax.tree.map(where_done, state.info["first_data"], state.data)
        return state.replace(data=data, obs=where_done(state.info["first_obs"], state.obs))


def playground_wrapped(env: PlaygroundEnv, length: int) -> Any:
    """Playground's own wrappers where it is installed, else those that it takes from Brax and a short auto-reset."""
    try:
        from mujoco_playground import wrapper
    except ImportError:
        vmapped = brax_wrappers.VmapWrapper(env)
        return Restarting(brax_wrappers.EpisodeWrapper(vmapped, length, 1))
    return wrapper.wrap_for_brax_training(env, episode_length=length)


@pytest.mark.slow
def test_playgrounds_wrappers_take_the_adapter():
    env = PlaygroundEnv("transport", physics="newton-euler")
    assert (env.dt, env.sim_dt, env.n_substeps, env.action_size) == (0.02, 0.005, 4, 3)
    assert env.unwrapped is env
    assert env.mj_model.nu == 8
    wrapped = playground_wrapped(env, length=4)
    keys = jax.random.split(jax.random.PRNGKey(0), 2)
    first = jax.jit(wrapped.reset)(keys)
    assert first.obs.shape == (2, env.observation_size)
    step, state, dones = jax.jit(wrapped.step), first, []
    jax.tree.map(
        np.testing.assert_array_equal,
        *(
            step(first, jnp.broadcast_to(jnp.asarray(action, jnp.float32), (2, 3)))
            for action in (CLIPPED * [9, 3e38, 1], CLIPPED)
        ),
    )
    with pytest.raises(InputError, match=r"shape \(3,\), not \(2,\)"):
        jax.eval_shape(env.step, env.reset(jax.random.key(0)), jnp.zeros(2))
    for action in actions(8, 2):
        state = step(state, action)
        dones.append(np.asarray(state.done).tolist())
    assert dones == [*[[0, 0]] * 3, [1, 1]] * 2
    np.testing.assert_array_equal(state.info["truncation"], [1, 1])
    np.testing.assert_array_equal(state.obs, first.obs)
    np.testing.assert_array_equal(state.data.plant.position, first.data.plant.position)


@pytest.mark.release
@pytest.mark.parametrize(("trainer", "steps"), [("sb3-sac", 768_000), ("sb3-ppo", 204_800), ("sbx-sac", 768_000)])
def test_stable_baselines3_learns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, trainer: str, steps: int):
    """Its policy file answers as its model does, which the script asserts, and sways less than the copying follower."""
    pytest.importorskip("sbx" if trainer == "sbx-sac" else "stable_baselines3")
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    script = Path(__file__).parents[2] / "benchmarks" / "foreign_trainers.py"
    done = run([script, trainer, "out.npz", "--steps", steps], tmp_path, timeout=1800)
    assert done.returncode == 0, done.stderr
    config = preset("transport")
    followers = [load_policy(tmp_path / "out.npz", config), make_baseline("copy", config)]
    learnt, copied = fly_scenarios(config, followers, [REFERENCE], "newton-euler")
    assert learnt.metrics.x_peak < 0.5 * copied.metrics.x_peak
