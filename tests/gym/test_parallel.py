"""PettingZoo: its own tests, seeds, spaces, the followers of the Brax environment, teams of several sizes."""

from __future__ import annotations

import pickle
import warnings

import gymnasium
import jax
import numpy as np
import pytest
from conftest import with_settings
from gymnasium.utils.seeding import np_random
from pettingzoo.test import parallel_api_test, parallel_seed_test

from mjxball.config import Config, preset, with_plant
from mjxball.env import TransportEnv
from mjxball.errors import InputError
from mjxball.gym import core
from mjxball.gym.parallel import FollowersParallelEnv
from mjxball.gym.playground import PlaygroundEnv
from mjxball.gym.single import FollowerEnv


@pytest.fixture(scope="module")
def team() -> Config:
    """Four drones with the default training's sensors and rewards, episodes of 8 steps."""
    return with_settings(with_plant(preset("transport"), "team4"), timing={"episode_steps": 8})


def draws(agents: list[str], seed: int) -> dict[str, np.ndarray]:
    random = np.random.default_rng(seed)
    return {agent: random.uniform(-1, 1, 3).astype(np.float32) for agent in agents}


def test_pettingzoos_own_tests(team: Config):
    env = FollowersParallelEnv(config=team)
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        parallel_api_test(env, num_cycles=20)
    parallel_seed_test(lambda: FollowersParallelEnv(config=team), num_cycles=12)


def test_spaces_and_what_is_in_them(team: Config):
    env = FollowersParallelEnv(config=team)
    seen, infos = env.reset(seed=1)
    assert env.agents == env.possible_agents == list(seen) == list(infos) == ["follower_1", "follower_2", "follower_3"]
    for agent in env.agents:
        space = env.observation_space(agent)
        assert isinstance(space, gymnasium.spaces.Box)
        assert type(seen[agent]) is np.ndarray
        assert space.contains(seen[agent])
        assert env.action_space(agent) == gymnasium.spaces.Box(-1.0, 1.0, (3,), np.float32)
    assert not np.allclose(seen["follower_1"], seen["follower_2"])  # each in its own frame


def test_it_flies_as_the_brax_environment(team: Config):
    """The same world and the same actions in the order of the agents' names."""
    env, program = FollowersParallelEnv(config=team), core.program(team, "newton-euler")
    assert isinstance(program.env, TransportEnv)
    first, _ = env.reset(seed=7)
    _, state = program.start(jax.random.key(core.seed_number(np_random(7)[0])))
    np.testing.assert_array_equal(np.stack(list(first.values())), state.obs)
    for number in range(8):
        actions = draws(env.agents, number)
        seen, reward, terminated, truncated, info = env.step(actions)
        state = program.step(state, np.stack(list(actions.values())))
        np.testing.assert_array_equal(np.stack(list(seen.values())), state.obs)
        np.testing.assert_array_equal(np.float32(list(reward.values())), state.reward)
        assert info["follower_1"]["error"] == state.metrics["error"]
    assert list(terminated.values()) == [False] * 3
    assert list(truncated.values()) == [True] * 3
    assert env.agents == []
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step({})


def test_a_pickled_environment_goes_on_as_the_first_one(team: Config):
    env = FollowersParallelEnv(config=team)
    env.reset(seed=5)
    env.step(draws(env.agents, 1))
    other = pickle.loads(pickle.dumps(env))
    assert other.agents == env.agents
    for number in range(2):
        given = draws(env.agents, number)
        jax.tree.map(np.testing.assert_array_equal, other.step(given), env.step(given))
    jax.tree.map(np.testing.assert_array_equal, other.reset(), env.reset())


def test_leaving_terminates_all(team: Config):
    near = with_settings(team, scenario={"termination_distance": 0.5, "goal_range": 0.1, "start_velocity": 0.0})
    env = FollowersParallelEnv(config=with_settings(near, timing={"episode_steps": 1000}))
    env.reset(seed=0)
    ended: dict[str, bool] = {}
    for _ in range(400):
        _, reward, ended, late, _ = env.step({agent: np.array([1, 1, 1], np.float32) for agent in env.agents})
        if not env.agents:
            break
    assert list(ended.values()) == [True] * 3
    assert not any(late.values())
    assert max(reward.values()) < -10  # the cost of an end


def test_a_recurrent_preset_leaves_the_memory_to_the_trainer():
    """No agent has to answer with the state of a GRU."""
    env = FollowersParallelEnv("team")
    assert {env.action_space(agent).shape for agent in env.possible_agents} == {(3,)}
    assert FollowerEnv("balance", physics="newton-euler").action_space.shape == (3,)


@pytest.mark.slow
def test_teams_of_several_sizes():
    """Worlds have 1, 2, 3 or 5 agents; what pads a smaller team is no agent."""
    env, found = FollowersParallelEnv("team"), set()
    assert len(env.possible_agents) == 5
    for seed in range(40):
        seen, _ = env.reset(seed=seed)
        assert list(seen) == env.agents == env.possible_agents[: len(seen)]
        moved, reward, *_ = env.step(draws(env.agents, seed))
        assert list(moved) == list(reward) == env.agents
        assert all(np.isfinite(each).all() for each in moved.values())
        found.add(len(seen))
    assert found == {1, 2, 3, 5}


@pytest.mark.slow
def test_a_pair_is_a_team_of_one_agent():
    env = FollowersParallelEnv("transport")
    seen, _ = env.reset(seed=3)
    alone, _ = FollowerEnv("transport", physics="newton-euler").reset(seed=3)
    np.testing.assert_allclose(seen["follower_1"], alone, atol=1e-6)
    moved = env.step({"follower_1": np.zeros(3, np.float32)})[0]["follower_1"]
    assert moved.shape == alone.shape


def test_what_makes_no_sense_is_refused(team: Config):
    env = FollowersParallelEnv(config=team)
    env.reset(seed=0)
    with pytest.raises(ValueError, match="follower_1"):
        env.step({"follower_1": np.zeros(3)})
    for kind in (FollowerEnv, PlaygroundEnv):
        with pytest.raises(InputError, match=r"mjxball\.gym\.parallel"):
            kind(config=team)
