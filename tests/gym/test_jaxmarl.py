"""JaxMARL: its interface, its wrapper in one program, the numbers of PettingZoo and Brax, teams of several sizes."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import with_settings
from gymnasium.utils.seeding import np_random
from tables import weekly

from mjxball.config import Config, preset, with_plant
from mjxball.gym import core
from mjxball.gym.parallel import FollowersParallelEnv

if TYPE_CHECKING:
    from jaxmarl.environments.multi_agent_env import MultiAgentEnv

    from mjxball.gym.jaxmarl import FollowersMultiAgentEnv

pytestmark = pytest.mark.slow  # to import JaxMARL takes 4 s, so that nothing here does while tests are collected
STEPS = 8  # of an episode


@pytest.fixture(scope="module")
def team() -> Config:
    """Four drones with the default training's sensors and rewards."""
    return with_settings(with_plant(preset("transport"), "team4"), timing={"episode_steps": STEPS})


@pytest.fixture(scope="module")
def make() -> Callable[..., FollowersMultiAgentEnv]:
    """The class of the environments."""
    pytest.importorskip("jaxmarl")
    from mjxball.gym.jaxmarl import FollowersMultiAgentEnv

    return FollowersMultiAgentEnv


@pytest.fixture(scope="module")
def env(make: Callable[..., FollowersMultiAgentEnv], team: Config) -> FollowersMultiAgentEnv:
    return make(config=team)


def draws(env: MultiAgentEnv, key: Any) -> dict[str, Any]:
    """An action for every agent."""
    keys = jax.random.split(key, env.num_agents)
    return {agent: env.action_space(agent).sample(own) for agent, own in zip(env.agents, keys, strict=True)}


def start(seed: int) -> Any:
    """The key from which PettingZoo's environment draws its first world."""
    return jax.random.split(jax.random.key(core.seed_number(np_random(seed)[0])))[1]


@pytest.mark.parametrize("name", ["team", *weekly("transport")])
def test_it_is_what_jaxmarl_asks_for(name: str, make: Callable[..., FollowersMultiAgentEnv]):
    from jaxmarl.environments.multi_agent_env import MultiAgentEnv, State
    from jaxmarl.environments.spaces import Space

    env, key = make(name), jax.random.PRNGKey(0)
    assert isinstance(env, MultiAgentEnv)
    assert env.num_agents == len(env.agents)
    assert env.agent_classes == {"follower": env.agents}
    seen, state = env.reset(key)
    assert isinstance(state, State)
    seen, state, rewards, dones, info = env.step(key, state, draws(env, key))
    assert int(state.step) == 1
    assert set(dones) == {*env.agents, "__all__"}
    assert set(seen) == set(rewards) == set(env.observation_spaces) == set(env.action_spaces) == set(env.agents)
    assert {np.shape(value) for value in info.values()} == {(env.num_agents,)}
    for agent in env.agents:
        assert isinstance(env.observation_space(agent), Space)
        assert seen[agent].shape == env.observation_space(agent).shape
        assert env.observation_space(agent).contains(seen[agent])
        assert env.get_avail_actions(state)[agent].shape == env.action_space(agent).shape == (3,)
        assert rewards[agent].shape == dones[agent].shape == ()
        assert dones[agent].dtype == bool


@pytest.mark.parametrize("wrap", [True, *weekly(False)])
def test_it_flies_as_pettingzoos_and_the_brax_environment(team: Config, env: FollowersMultiAgentEnv, wrap: bool):
    """Bit for bit, with and without JaxMARL's own reset at an end, until that end."""
    parallel, program = FollowersParallelEnv(config=team), core.program(team, "newton-euler")
    step = env.step if wrap else jax.jit(env.step_env)
    shown, _ = parallel.reset(seed=7)
    seen, state = env.reset(start(7))
    brax = program.env.reset(start(7))
    jax.tree.map(np.testing.assert_array_equal, seen, shown)
    for number in range(STEPS):
        key = jax.random.key(number)
        actions = draws(env, key)
        shown, wanted, terminated, truncated, told = parallel.step(jax.tree.map(np.asarray, actions))
        brax = program.step(brax, jnp.stack(list(actions.values())))
        seen, state, rewards, dones, info = step(key, state, actions)
        np.testing.assert_array_equal(np.float32(list(wanted.values())), np.stack(list(rewards.values())))
        np.testing.assert_array_equal(np.stack(list(rewards.values())), brax.reward)
        np.testing.assert_array_equal(info["error"], brax.metrics["error"])
        assert told["follower_1"]["error"] == info["error"][0]
        ended = {agent: terminated[agent] or truncated[agent] for agent in terminated}
        assert ended == {agent: bool(dones[agent]) for agent in env.agents}
        if not (wrap and dones["__all__"]):
            jax.tree.map(np.testing.assert_array_equal, seen, shown)
            np.testing.assert_array_equal(np.stack(list(seen.values())), brax.obs)
    assert dones["__all__"]
    assert info["truncation"].tolist() == [1.0] * 3


def test_a_rollout_inside_one_program(env: FollowersMultiAgentEnv):
    """Five worlds, three episodes each, counted by JaxMARL's wrapper; worlds and episodes differ."""
    from jaxmarl.wrappers.baselines import LogWrapper

    logged = LogWrapper(env)

    def rollout(key: Any) -> tuple[Any, Any]:
        first, rest = jax.random.split(key)
        seen, state = logged.reset(first)

        def step(state: Any, key: Any) -> tuple[Any, Any]:
            seen, state, rewards, dones, info = logged.step(key, state, draws(env, key))
            return state, (seen, rewards, dones, info)

        return seen, jax.lax.scan(step, state, jax.random.split(rest, 3 * STEPS))[1]

    first, (seen, rewards, dones, info) = jax.jit(jax.vmap(rollout))(jax.random.split(jax.random.key(3), 5))
    ends = np.arange(STEPS - 1, 3 * STEPS, STEPS)
    assert all(np.flatnonzero(world).tolist() == ends.tolist() for world in np.asarray(dones["__all__"]))
    assert (info["returned_episode_lengths"][:, ends] == STEPS).all()
    for number, agent in enumerate(env.agents):
        sums = np.reshape(rewards[agent], (5, 3, STEPS)).sum(axis=-1)  # in another order: a few bits of float32
        np.testing.assert_allclose(sums, info["returned_episode_returns"][:, ends, number], rtol=1e-6)
        assert len(np.unique(sums)) == sums.size
        starts = np.concatenate([first[agent][:, None], seen[agent][:, ends]], axis=1)
        assert len(np.unique(starts.reshape(-1, starts.shape[-1]), axis=0)) == 5 * 4


def test_an_episode_may_begin_at_a_given_state(env: FollowersMultiAgentEnv):
    _, state = env.reset(jax.random.key(1))
    wanted, given = env.reset(jax.random.key(2))
    for number in range(STEPS):
        seen, state, _, dones, _ = env.step(jax.random.key(number), state, draws(env, jax.random.key(number)), given)
        if number < STEPS - 1:
            assert not np.array_equal(seen["follower_1"], wanted["follower_1"])
    assert dones["__all__"]
    jax.tree.map(np.testing.assert_array_equal, (seen, state), (wanted, given))


def test_teams_of_several_sizes(make: Callable[..., FollowersMultiAgentEnv]):
    """An agent that is not there is done and has zeros; the others have what PettingZoo's have."""
    env, parallel, found = make("team"), FollowersParallelEnv("team"), set()
    step = jax.jit(env.step_env)
    for seed in range(40):
        shown, _ = parallel.reset(seed=seed)
        seen, state = env.reset(start(seed))
        agents, key = list(parallel.agents), jax.random.key(seed)
        actions = draws(env, key)
        moved, wanted, *_ = parallel.step({agent: np.asarray(actions[agent]) for agent in agents})
        after, _, rewards, dones, _ = step(key, state, actions)
        for agent in agents:
            np.testing.assert_array_equal(seen[agent], shown[agent])
            np.testing.assert_array_equal(after[agent], moved[agent])
            assert rewards[agent] == pytest.approx(
                wanted[agent], rel=2.4e-7
            )  # 2 ulp: other sums are fused with the mask
        absent = set(env.agents) - set(agents)
        assert {agent for agent in env.agents if dones[agent]} == absent
        assert not any(np.any(seen[agent]) or np.any(after[agent]) or rewards[agent] for agent in absent)
        found.add(len(agents))
    assert found == {1, 2, 3, 5}
