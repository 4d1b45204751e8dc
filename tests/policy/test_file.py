"""The policy file: what is saved is what flies, and it flies what the network would."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import Recurrent, Trained, policy_of, with_repeats, with_settings

from mjxball.algorithms.gradient import FirstOrderGradient
from mjxball.config import Config, from_record
from mjxball.control import observation as layout
from mjxball.env import TransportEnv
from mjxball.policy import Policy, PolicyFile, PolicyFileError, load_file, save_file
from mjxball.policy.export import policy_file
from mjxball.policy.file import check, interface_of, observing_stale, shipped_policy
from mjxball.sim.follower import network_interface
from mjxball.train.environments import Environments
from mjxball.train.extensions import DEFAULTS, make_env

OBSERVATIONS = np.random.default_rng(0).normal(size=(40, 18))


def flax_mean(trained: Trained, learner: Any, seen: Any) -> Any:
    """The deterministic action of the Brax network in [-1, 1]."""
    parameters = trained.networks.policy_network.apply(learner.normaliser, learner.average, seen)
    return trained.networks.parametric_action_distribution.mode(parameters)


class TestRoundTrip:
    def test_file_gives_back_what_was_saved(self, trained, saved):
        loaded = load_file(saved)
        for field in dataclasses.fields(PolicyFile):
            expected, found = getattr(trained.contents, field.name), getattr(loaded, field.name)
            if field.name == "metadata":
                assert found == json.loads(json.dumps(expected))  # tuples become lists
            else:
                jax.tree.map(np.testing.assert_array_equal, found, expected)

    def test_second_generation_is_the_same_policy(self, saved, tmp_path):
        again = tmp_path / "again.npz"
        save_file(again, load_file(saved))
        first, second = Policy.load(saved), Policy.load(again)
        np.testing.assert_array_equal(first(OBSERVATIONS), second(OBSERVATIONS))

    def test_policy_is_named_after_its_file_and_knows_its_period(self, saved, trained):
        policy = Policy.load(saved)
        assert policy.name == "follower"
        assert policy.control_period == trained.config.timing.control_period
        assert policy.metadata["training_steps"] == 1234

    def test_saving_leaves_nothing_else_behind_and_replaces_the_old_file(self, trained, saved):
        save_file(
            saved, dataclasses.replace(trained.contents, metadata={**trained.contents.metadata, "training_steps": 5})
        )
        assert [path.name for path in saved.parent.iterdir()] == ["follower.npz"]
        assert load_file(saved).metadata["training_steps"] == 5

    @pytest.mark.parametrize("existing", [False, True], ids=["new", "over an old file"])
    def test_unsound_policy_writes_nothing(self, trained, tmp_path, existing):
        path = tmp_path / "follower.npz"
        if existing:
            path.write_bytes(b"old")
        mean = trained.contents.observation_mean.copy()
        mean[4] = np.nan
        with pytest.raises(PolicyFileError, match="observation_mean"):
            save_file(path, dataclasses.replace(trained.contents, observation_mean=mean))
        assert [p.name for p in tmp_path.iterdir()] == (["follower.npz"] if existing else [])
        assert not existing or path.read_bytes() == b"old"

    def test_arrays_stored_column_by_column_are_the_same_policy(self, saved, tmp_path):
        """Fortran order, as `np.savez` keeps it of an array that has it."""
        other = tmp_path / "columns.npz"
        with np.load(saved) as data:
            np.savez(
                other, **{name: np.asfortranarray(array) if array.ndim == 2 else array for name, array in data.items()}
            )
        jax.tree.map(np.testing.assert_array_equal, load_file(other).weights, load_file(saved).weights)


class TestInference:
    def test_the_action_is_the_mean_and_not_the_deviation(self, trained):
        """Of the last layer's six numbers the first three are the mean: without weights they are its biases."""
        contents = trained.contents
        biases = [np.zeros_like(bias) for bias in contents.biases]
        biases[-1][:] = (0.1, -0.2, 0.3, 4.0, 5.0, 6.0)
        still = dataclasses.replace(
            contents, weights=tuple(np.zeros_like(weight) for weight in contents.weights), biases=tuple(biases)
        )
        found = Policy(still, "still", np.float64).action(OBSERVATIONS)
        np.testing.assert_allclose(found, np.tile(np.tanh([0.1, -0.2, 0.3]), (40, 1)), rtol=1e-7)  # float32 biases

    def test_float32_agrees_with_flax(self, trained, saved):
        seen = np.asarray(3 * OBSERVATIONS, np.float32)
        with jax.default_matmul_precision("highest"):
            expected = flax_mean(trained, trained.learner, jnp.asarray(seen))
        found = Policy.load(saved).action(seen)
        assert found.dtype == np.float32
        assert np.ptp(found) > 0.1  # the actions differ from world to world
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5)  # docs/policy-file.md

    def test_float64_agrees_with_flax(self, trained, saved):
        """The file's numbers are float32, so the network is given its mean and scale; then both are exact."""
        contents = load_file(saved)
        with jax.enable_x64(True):
            wide = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), trained.learner.average)
            # A scale of 0 hides a slot: any finite deviation will do behind the network's mask.
            scale = np.where(contents.observation_scale > 0, contents.observation_scale, 1).astype(np.float64)
            normaliser = trained.learner.normaliser.replace(
                mean=jnp.asarray(contents.observation_mean, jnp.float64), std=jnp.asarray(1 / scale)
            )
            learner = trained.learner._replace(average=wide, normaliser=normaliser)
            expected = np.asarray(flax_mean(trained, learner, jnp.asarray(OBSERVATIONS)))
        found = Policy(contents, "wide", np.float64).action(OBSERVATIONS)
        assert found.dtype == expected.dtype == np.float64
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-10)  # docs/policy-file.md

    def test_command_is_the_scaled_action_on_top_of_the_copy_law(self, trained, saved):
        config = trained.config
        policy = Policy.load(saved)
        seen = OBSERVATIONS.astype(np.float32)
        follower, leader, limits = config.follower, config.leader, config.command
        gravity = config.plant.gravity
        reach = np.array([follower.action_scale_tilt, follower.action_scale_tilt, follower.action_scale_vertical])
        limit = np.array([limits.tilt_limit, limits.tilt_limit, limits.vertical_limit])
        wanted = np.array(leader.kp) * seen[:, 12:15] + np.array(leader.kd) * seen[:, 15:18]
        copied = np.stack([-wanted[:, 1] / gravity, wanted[:, 0] / gravity, wanted[:, 2]], axis=1)
        expected = np.clip(np.clip(copied, -limit, limit) + policy.action(seen) * reach, -limit, limit)
        np.testing.assert_allclose(policy(seen), expected, rtol=0, atol=1e-5)  # float32 of up to 6 m/s2

    def test_ignored_position_does_not_matter(self, trained, saved):
        policy = Policy.load(saved)
        moved = OBSERVATIONS.copy()
        moved[:, :3] += 100.0
        np.testing.assert_array_equal(policy.action(moved), policy.action(OBSERVATIONS))

    def test_batch_equals_single(self, saved):
        policy = Policy.load(saved)
        batch = policy(OBSERVATIONS)
        single = np.stack([policy(seen) for seen in OBSERVATIONS])
        # The matrix product may add in another order: float32 rounding of commands up to 6.
        np.testing.assert_allclose(batch, single, rtol=0, atol=1e-5)

    def test_wrong_shape_is_refused(self, saved):
        with pytest.raises(ValueError, match="18 numbers"):
            Policy.load(saved)(np.zeros(17))

    def test_memory_inside_the_policy_is_the_environment_memory(self, remembering, remembering_pair):
        """Two episodes flown by the environment; the policy sees only the 18 numbers of each step."""
        policy = Policy(remembering.contents, "remembering")
        for seed in (1, 2):
            state = remembering_pair.reset(jax.random.key(seed))
            policy.reset()
            for _ in range(6):
                with jax.default_matmul_precision("highest"):
                    expected = flax_mean(remembering, remembering.learner, state.obs)
                found = policy.action(np.asarray(state.obs[: layout.OBSERVATION_SIZE]))
                # 1e-5 for the network (docs/policy-file.md); its own rounding returns through the last action.
                np.testing.assert_allclose(found, expected, rtol=0, atol=2e-5)
                state = remembering_pair.step(state, jnp.asarray(expected))

    def test_memory_matters_and_reset_forgets_it(self, remembering):
        policy = Policy(remembering.contents, "remembering")
        first = policy.action(OBSERVATIONS[0])
        policy.action(OBSERVATIONS[1])
        later = policy.action(OBSERVATIONS[0])
        policy.reset()
        np.testing.assert_array_equal(policy.action(OBSERVATIONS[0]), first)
        assert (later != first).any()

    def test_memory_of_a_batch_is_the_memory_of_each(self, remembering):
        batch = Policy(remembering.contents, "batch")
        single = Policy(remembering.contents, "single")
        together = np.stack([batch.action(OBSERVATIONS[k : k + 4]) for k in range(5)])
        alone = np.stack([single.action(OBSERVATIONS[k + 2]) for k in range(5)])
        np.testing.assert_allclose(together[:, 2], alone, rtol=0, atol=1e-5)  # float32, other order of sums


def test_a_policy_with_the_input_of_stale_commands_the_same_until_it_is_trained(recurrent: Recurrent, tmp_path: Path):
    """With a GRU, and without one; in a file, of whose metadata a reader that does not know the field refuses it."""
    random = np.random.default_rng(6)
    seen, _ = with_repeats(random.normal(scale=0.3, size=(40, 18)).astype(np.float32))
    for contents in (recurrent.contents, *(load_file(shipped_policy(name)) for name in ("stand", "paper"))):
        added = observing_stale(contents)
        assert interface_of(added.metadata).input_size == interface_of(contents.metadata).input_size + 1
        assert observing_stale(added) is added
        save_file(tmp_path / "added.npz", added)
        policies = (Policy(contents, "one", np.float64), Policy(load_file(tmp_path / "added.npz"), "one", np.float64))
        commands = [[policy(row) for row in seen] for policy in policies]
        np.testing.assert_allclose(commands[1], commands[0], rtol=0, atol=1e-12)  # sums of other lengths
        for metadata, found in ((contents.metadata, added), (added.metadata, contents)):
            with pytest.raises(PolicyFileError, match="observation_mean must have shape"):
                save_file(tmp_path / "other.npz", dataclasses.replace(found, metadata=metadata))


def test_a_policy_that_shared_the_leaders_integrals_is_refused():
    """Of earlier versions, whose logs and plants are read without those settings."""
    contents = load_file(shipped_policy("flight"))
    config = contents.metadata["config"]
    earlier = {
        **config,
        "follower": {**config["follower"], "residual_on_pid": True},
        "leader": {**config["leader"], "tilt_integral_gain": 10.0},
    }
    with pytest.raises(PolicyFileError, match="adds to the leader's PID controller with its integrals"):
        check(dataclasses.replace(contents, metadata={**contents.metadata, "config": earlier}), "one")
    assert from_record(earlier) == from_record(config)


def test_a_policy_trained_with_stale_says_so(transport: Config):
    """And one that was not says nothing, so that its file is the same as before."""
    for stale, said in ((False, None), (True, True)):
        config = with_settings(transport, follower={"stale": stale, "recurrent_units": 3})
        env = TransportEnv(config, "newton-euler")
        algorithm = FirstOrderGradient(config, Environments(env, 4))
        network = algorithm.policy(algorithm.init(jax.random.key(0)))
        contents = policy_file(config, network_interface(config), network, steps=0)
        assert contents.metadata.get("stale") is said
        check(contents, "one")


def test_export_masks_what_the_network_ignores(trained):
    scale = trained.contents.observation_scale
    np.testing.assert_array_equal(scale == 0, [True] * 3 + [False] * 15)
    np.testing.assert_allclose(scale[3:], 1 / np.asarray(trained.learner.normaliser.std[3:]), rtol=1e-6)  # float32


def test_export_takes_the_averaged_policy(trained):
    learner = trained.learner._replace(policy=jax.tree.map(jnp.zeros_like, trained.learner.policy))
    contents = policy_file(
        trained.config,
        network_interface(trained.config),
        policy_of(make_env(DEFAULTS, trained.config, "newton-euler"), learner),
        steps=1,
    )
    jax.tree.map(np.testing.assert_array_equal, contents.weights, trained.contents.weights)
