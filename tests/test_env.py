"""The Brax environment: equilibrium, rewards, resets, endings, batches, Brax's wrappers, and both engines."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import CompiledEnv, with_settings

from brax_trainers import brax_trainer
from mjxball.config import Config
from mjxball.env import TransportEnv
from mjxball.errors import InputError
from mjxball.quiet import import_brax_env

import_brax_env()  # silently, before Brax's wrappers import it with its notes
from brax.envs.wrappers import training as wrappers  # noqa: E402

HOVER = {
    "goal_range": 0.0,
    "start_position": 0.0,
    "start_velocity": 0.0,
    "start_tilt": 0.0,
    "cg_amplitude": (0.0, 0.0),
}


def finite(tree: Any) -> bool:
    return all(bool(jnp.isfinite(leaf).all()) for leaf in jax.tree.leaves(tree))


def world_with(state: Any, **parts: Any) -> Any:
    """`state` with parts of its world replaced."""
    return state.replace(pipeline_state=state.pipeline_state._replace(**parts))


def at_distance(state: Any, distance: float) -> Any:
    """`state` with its goal straight above, `distance` away."""
    return world_with(state, goal=state.pipeline_state.plant.position + jnp.array([0.0, 0.0, distance]))


def test_sizes_and_names(pair: CompiledEnv, engine: str, transport):
    state = pair.reset(jax.random.key(0))
    assert state.obs.shape == (pair.env.observation_size,) == (18,)
    assert pair.env.action_size == 3
    assert pair.env.backend == engine
    assert pair.env.dt == transport.timing.control_period
    assert len(pair.env.input_mask) == pair.env.observation_size


def hovering(config: Config, seed: int) -> Any:
    """A state at rest at its goal, the CG at O and standing still. Only the reset depends on it."""
    return TransportEnv(with_settings(config, scenario=HOVER), "newton-euler").reset(jax.random.key(seed))


def test_hover_is_an_equilibrium(pair: CompiledEnv, transport):
    states = pair.roll(hovering(transport, 1), jnp.zeros((200, 3)))
    plant = states.pipeline_state.plant
    assert float(plant.time[-1]) == 4.0
    # The thrust's rounding, an ulp of g = 1e-6 m/s2, moves the equilibrium by 1e-6 / kp = 2e-6 m; five of them.
    assert float(jnp.abs(plant.position).max()) < 1e-5
    assert float(jnp.abs(plant.velocity).max()) < 1e-5
    # Attitude: an ulp of the rotors' torque, 3e-8 N m, over 2 Kp = 6 N m/rad; roll has 2 Kp = 0.5.
    assert float(jnp.abs(states.obs[:, 3:6]).max()) < 1e-6
    assert float(states.done.max()) == 0.0


def test_copying_the_leader_earns_exactly_zero(mimic: CompiledEnv):
    states = mimic.roll(mimic.reset(jax.random.key(2)), jnp.zeros((100, 3)))
    assert float(jnp.abs(states.metrics["error"]).min()) > 0.01  # it moves, so equal commands are not both zero
    np.testing.assert_array_equal(states.reward, 0.0)


def test_paper_reward_counts_the_residual(mimic: CompiledEnv, transport):
    state = mimic.step(mimic.reset(jax.random.key(2)), jnp.array([0.5, -0.25, 0.1]))
    reach = transport.follower
    expected = -10 * (0.75 * reach.action_scale_tilt + 0.1 * reach.action_scale_vertical)
    assert float(state.reward) == pytest.approx(expected, rel=1e-6)  # float32


def test_every_reset_differs_and_stays_in_the_scenario(fast_pair: CompiledEnv, transport):
    worlds = jax.jit(jax.vmap(fast_pair.env.reset))(jax.random.split(jax.random.key(3), 64)).pipeline_state
    scenario = transport.scenario
    load, plant = worlds.load, worlds.plant
    for drawn, (low, high) in (
        (load.object_mass, scenario.object_mass),
        (load.cg_amplitude, scenario.cg_amplitude),
        (load.cg_speed, scenario.cg_speed),
        (load.cg_phase, (0, 2 * np.pi)),
        (worlds.goal, (-scenario.goal_range, scenario.goal_range)),
        (plant.velocity, (-scenario.start_velocity, scenario.start_velocity)),
    ):
        assert np.unique(drawn, axis=0).shape[0] == 64
        assert low <= drawn.min() < low + 0.25 * (high - low)  # 64 draws miss a quarter of the range: 1e-8
        assert high - 0.25 * (high - low) < drawn.max() <= high
    np.testing.assert_array_equal(load.believed_mass, load.object_mass)


def test_same_key_same_world(fast_pair: CompiledEnv):
    first, second = (fast_pair.reset(jax.random.key(4)) for _ in range(2))
    jax.tree.map(np.testing.assert_array_equal, first, second)


def test_unknown_mass_is_not_believed(transport):
    env = TransportEnv(with_settings(transport, scenario={"mass_known": False}), "newton-euler")
    load = jax.jit(env.reset)(jax.random.key(5)).pipeline_state.load
    assert float(load.believed_mass) == pytest.approx(transport.plant.object_mass, rel=1e-7)  # float32
    assert float(load.object_mass) != float(load.believed_mass)


def test_rotors_near_a_limit_cost_by_what_each_drone_can_give(transport):
    """The largest force of every rotor is that of the plant times the thrust of its drone."""
    silent = dict.fromkeys(("error", "velocity", "rates", "effort", "smoothness", "termination"), 0.0)
    settings = with_settings(
        transport, reward={**silent, "rotor_limits": 2.0}, scenario={"thrust_scale": (0.9, 1.1), "trim_margin": 0.0}
    )
    env = TransportEnv(settings, "newton-euler")
    state, step = jax.jit(env.reset)(jax.random.key(8)), jax.jit(env.step)
    for _ in range(8):
        state = step(state, jnp.ones(3))
    world = state.pipeline_state
    most = np.array(settings.plant.of_drones("rotor_force_max")) * np.array(world.load.thrust_scale)
    share = np.array(world.plant.rotor_force) / most[:, None]
    near = np.maximum(np.abs(share - 0.5) - 0.4, 0.0)
    assert near.max() > 0
    assert float(state.reward) == pytest.approx(-2.0 * (near**2).sum(), rel=1e-4)  # float32


def near_the_limit(state: Any, config: Config, left: int) -> Any:
    """`state` with `left` control steps to go."""
    steps = state.pipeline_state.steps
    return world_with(state, steps=jnp.full_like(steps, config.timing.episode_steps - left))


def test_time_limit_truncates(fast_pair: CompiledEnv, transport):
    start = near_the_limit(fast_pair.reset(jax.random.key(6)), transport, left=5)
    states = fast_pair.roll(start, jnp.zeros((5, 3)))
    np.testing.assert_array_equal(states.done, [0, 0, 0, 0, 1])
    np.testing.assert_array_equal(states.info["truncation"], [0, 0, 0, 0, 1])


def test_every_reset_has_the_whole_time(fast_pair: CompiledEnv):
    assert int(fast_pair.reset(jax.random.key(6)).pipeline_state.steps) == 0


def test_leaving_d_term_terminates_and_costs(fast_pair: CompiledEnv, transport):
    state = fast_pair.reset(jax.random.key(7))
    inside = fast_pair.step(at_distance(state, 2.4), jnp.zeros(3))
    outside = fast_pair.step(at_distance(state, 2.6), jnp.zeros(3))
    assert (float(inside.done), float(inside.info["truncation"])) == (0.0, 0.0)
    assert (float(outside.done), float(outside.info["truncation"])) == (1.0, 0.0)
    # 0.2 m more of error costs error / error_scale * 0.2 = 4; the rest is the price of leaving.
    extra = transport.reward.error / transport.reward.error_scale * 0.2
    # The worlds' velocities differ by a control step of 0.1 m/s2: 1e-3 of reward.
    assert float(inside.reward - outside.reward) == pytest.approx(transport.reward.termination + extra, abs=0.05)


def test_termination_at_the_time_limit_is_a_termination(fast_pair: CompiledEnv, transport):
    lost = at_distance(fast_pair.reset(jax.random.key(7)), 2.6)
    state = fast_pair.step(near_the_limit(lost, transport, left=1), jnp.zeros(3))
    assert (float(state.done), float(state.info["truncation"])) == (1.0, 0.0)


def poison_the_mass(state: Any) -> Any:
    load = state.pipeline_state.load
    return world_with(state, load=load._replace(object_mass=jnp.full_like(load.object_mass, jnp.nan)))


def spin_up(state: Any) -> Any:
    plant = state.pipeline_state.plant
    spinning = plant._replace(rates=jnp.array([0.0, 0.0, 60.0]))
    return world_with(state, loop=state.pipeline_state.loop._replace(plant=spinning))


@pytest.mark.parametrize("damage", [poison_the_mass, spin_up])
def test_diverged_world_is_ended_counted_and_left_finite(pair: CompiledEnv, damage):
    before = pair.reset(jax.random.key(8))
    after = pair.step(damage(before), jnp.zeros(3))
    assert float(after.metrics["diverged"]) == 1.0
    assert (float(after.done), float(after.info["truncation"])) == (1.0, 0.0)
    assert finite((after.obs, after.reward, after.metrics, after.pipeline_state.plant, after.pipeline_state.memory))
    sound = pair.step(before, jnp.zeros(3))
    assert (float(sound.metrics["diverged"]), float(sound.done)) == (0.0, 0.0)


def test_an_action_that_is_not_finite_leaves_a_finite_state(remembering_pair: CompiledEnv):
    """A network that diverges must not write NaN into the replay, from where it would never leave."""
    before = remembering_pair.reset(jax.random.key(8))
    after = remembering_pair.step(before, jnp.array([0.0, jnp.nan, 0.0]))
    assert float(after.metrics["diverged"]) == 1.0
    assert (float(after.done), float(after.info["truncation"])) == (1.0, 0.0)
    assert finite((after.obs, after.reward, after.metrics, after.pipeline_state))


def test_actions_are_clipped_to_the_box(remembering_pair: CompiledEnv):
    """Also in the history, in the reward and in what critics are told."""
    before, within = remembering_pair.reset(jax.random.key(8)), jnp.array([1.0, -1.0, 0.25])
    inside, outside = (remembering_pair.step(before, action) for action in (within, within * jnp.array([7.0, 3e38, 1])))
    jax.tree.map(np.testing.assert_array_equal, outside, inside)
    np.testing.assert_array_equal(inside.pipeline_state.action, within)
    with pytest.raises(InputError, match=r"shape \(3,\), not \(1, 3\)"):
        jax.eval_shape(remembering_pair.env.step, before, within[None])


def test_batch_of_worlds_equals_single_worlds(fast_pair: CompiledEnv):
    keys = jax.random.split(jax.random.key(9), 16)
    actions = jax.random.uniform(jax.random.key(10), (16, 10, 3), minval=-1, maxval=1)
    starts = jax.jit(jax.vmap(fast_pair.env.reset))(keys)
    batch = fast_pair._replace(step=jax.jit(jax.vmap(fast_pair.env.step))).roll(starts, actions.swapaxes(0, 1))
    for world in range(16):
        single = fast_pair.roll(fast_pair.reset(keys[world]), actions[world])
        # Float32 operations in another order, 40 physics steps: some ulp of values up to 10.
        np.testing.assert_allclose(batch.obs[:, world], single.obs, rtol=0, atol=2e-5)
        # The reward multiplies errors by error / error_scale = 20.
        np.testing.assert_allclose(batch.reward[:, world], single.reward, rtol=0, atol=4e-4)


def test_engine_flies_the_closed_form_path(transport, fast_pair: CompiledEnv):
    """Full-reach random actions for 50 steps: MJX and the closed form agree."""
    actions = jax.random.uniform(jax.random.key(11), (50, 3), minval=-1, maxval=1)
    start = fast_pair.reset(jax.random.key(12))
    closed_form = fast_pair.roll(start, actions)
    mjx = fast_pair._replace(step=jax.jit(TransportEnv(transport, "mjx").step)).roll(start, actions)
    assert np.abs(mjx.pipeline_state.plant.position).max() > 0.05  # 500 times the tolerance below
    # Float32 rounding over 200 physics steps: 200 ulp of 10 m/s2 and of some rad/s, integrated over 1 s.
    np.testing.assert_allclose(mjx.obs, closed_form.obs, rtol=0, atol=1e-4)


def test_memory_of_the_environment_follows_the_layout(remembering_pair: CompiledEnv):
    first = remembering_pair.reset(jax.random.key(13))
    actions = jax.random.uniform(jax.random.key(14), (4, 3), minval=-1, maxval=1)
    states = remembering_pair.roll(first, actions)
    seen = [first.obs[:18], *states.obs[:, :18]]
    # Behind the observation two averages of 21 numbers, the last action, and what critics are told.
    last, told = slice(18 + 42, 21 + 42), 21 + 42
    assert first.obs.shape == (told + 4,)
    np.testing.assert_array_equal(first.obs[18:told], np.zeros(45))
    average, share = seen[0], 1 - np.exp(-0.02 / 0.1)
    for number in range(4):
        average = average + share * (seen[number] - average)
        np.testing.assert_allclose(states.obs[number][18:36], average - seen[number + 1], rtol=0, atol=1e-5)
        np.testing.assert_array_equal(states.obs[number][last], actions[number])


class TestBraxWrappers:
    """The environment inside `brax.envs.training.wrap`: VmapWrapper, EpisodeWrapper, AutoResetWrapper."""

    WORLDS, STEPS, EPISODE = 8, 30, 10

    @pytest.fixture(scope="class")
    def steps(self, transport) -> Any:
        return self.rolled(TransportEnv(transport, "newton-euler"))

    def rolled(self, env: TransportEnv) -> Any:
        wrapped = wrappers.wrap(env, episode_length=self.EPISODE)

        def roll(key: Any) -> Any:
            actions = 0.1 * jax.random.normal(key, (self.STEPS, self.WORLDS, 3))
            state = wrapped.reset(jax.random.split(key, self.WORLDS))
            return jax.lax.scan(lambda s, a: (wrapped.step(s, a),) * 2, state, actions)

        return jax.jit(roll)(jax.random.PRNGKey(15))[1]  # Brax takes no typed keys

    def test_steps_are_batched_and_finite(self, steps):
        assert steps.obs.shape == (self.STEPS, self.WORLDS, 18)
        assert steps.reward.shape == steps.done.shape == (self.STEPS, self.WORLDS)
        assert finite(steps)

    def test_episode_wrapper_ends_and_auto_reset_restarts(self, steps):
        ends = np.arange(1, self.STEPS + 1) % self.EPISODE == 0
        np.testing.assert_array_equal(steps.done, np.broadcast_to(ends[:, None], steps.done.shape))
        np.testing.assert_array_equal(steps.info["truncation"], steps.done)
        np.testing.assert_array_equal(steps.obs[self.EPISODE - 1], steps.info["first_obs"][0])

    def test_time_limits_of_both_together_are_truncations(self, transport):
        """`episode_length` equal to `timing.episode_steps`, as everybody would choose it."""
        limited = with_settings(transport, timing={"episode_steps": self.EPISODE})
        steps = self.rolled(TransportEnv(limited, "newton-euler"))
        np.testing.assert_array_equal(steps.info["truncation"][self.EPISODE - 1], 1.0)


def test_brax_takes_it_for_its_own(transport):
    base = import_brax_env()[0]
    assert isinstance(TransportEnv(transport, "newton-euler"), base)


class TestStockBrax:
    """Brax's own trainers run on the environment, as docs/gym.md says."""

    @pytest.fixture(autouse=True)
    def without_the_function_again(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """What a trainer gives JAX back is taken away after each test."""
        monkeypatch.setattr(jax, "device_put_replicated", None, raising=False)
        monkeypatch.delattr(jax, "device_put_replicated")

    @pytest.mark.slow
    def test_what_brax_would_randomise_is_refused(self, transport):
        with pytest.raises(InputError, match="every reset draws a world"):
            brax_trainer("ppo")(TransportEnv(transport, "newton-euler"), randomization_fn=lambda sys, rng: (sys, rng))
        with pytest.raises(InputError, match="ppo, sac"):
            brax_trainer("es")

    @pytest.mark.release
    def test_ppo_trains(self, transport):
        seen = []
        _, parameters, _ = brax_trainer("ppo")(
            TransportEnv(transport, "newton-euler"),
            num_timesteps=1024,
            episode_length=40,
            num_envs=16,
            num_eval_envs=4,
            batch_size=8,
            num_minibatches=4,
            unroll_length=8,
            num_updates_per_batch=1,
            num_evals=2,
            normalize_observations=True,
            max_devices_per_host=1,
            progress_fn=lambda steps, metrics: seen.append((steps, float(metrics["eval/episode_reward"]))),
        )
        assert [steps for steps, _ in seen] == [0, 1024]
        assert all(np.isfinite(reward) and reward < 0 for _, reward in seen)
        assert finite(parameters)

    @pytest.mark.release
    def test_sac_trains(self, transport):
        _, parameters, _ = brax_trainer("sac")(
            TransportEnv(transport, "newton-euler"),
            num_timesteps=512,
            episode_length=40,
            num_envs=8,
            num_eval_envs=4,
            batch_size=8,
            min_replay_size=64,
            max_replay_size=512,
            normalize_observations=True,
            max_devices_per_host=1,
        )
        assert finite(parameters)
        assert float(jnp.abs(parameters[0].mean).max()) > 0
