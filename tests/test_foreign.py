"""Policies of other trainers as policy files: they answer as the trained policy does, or are refused."""

from __future__ import annotations

import contextlib
import itertools
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

from mjxball.config import Config, preset, replace
from mjxball.errors import InputError
from mjxball.foreign import from_brax, from_layers
from mjxball.policy.inference import Policy


class Tensor:
    """What `from_layers` asks of a tensor of PyTorch."""

    def __init__(self, value: np.ndarray):
        self._value = value

    def detach(self) -> Tensor:
        return self

    def cpu(self) -> Tensor:
        return self

    def numpy(self) -> np.ndarray:
        return self._value


@pytest.fixture(scope="module")
def config() -> Config:
    return preset("transport")


def sampled(sizes: tuple[int, ...], seed: int = 0) -> list[tuple[np.ndarray, np.ndarray]]:
    random = np.random.default_rng(seed)
    return [
        (random.standard_normal((n, m)).astype(np.float32) / np.sqrt(n), random.standard_normal(m).astype(np.float32))
        for n, m in itertools.pairwise(sizes)
    ]


def answered(layers: list[tuple[np.ndarray, np.ndarray]], observations: np.ndarray) -> np.ndarray:
    """Actions by plain NumPy in float64."""
    value = np.asarray(observations, float)
    for number, (kernel, bias) in enumerate(layers):
        value = value @ kernel + bias
        value = np.maximum(value, 0) if number < len(layers) - 1 else np.tanh(value[..., :3])
    return value


def test_layers_flax_and_pytorch_give_the_same_file_which_answers_as_the_network(config: Config) -> None:
    layers = sampled((18, 16, 8, 4, 6))
    observations = np.random.default_rng(1).standard_normal((50, 18))
    named = {
        f"{name}": {"kernel": w, "bias": b} for name, (w, b) in zip(("fc1", "fc2", "fc3", "out"), layers, strict=True)
    }
    flax = {"params": {f"Dense_{k}": {"kernel": w, "bias": b} for k, (w, b) in enumerate(layers)}}
    flax["params"] = dict(sorted(flax["params"].items(), reverse=True))
    torch: dict[str, Any] = {}
    for k, (w, b) in enumerate(layers):
        torch |= {f"{2 * k}.weight": Tensor(w.T), f"{2 * k}.bias": Tensor(b)}
    for given in (layers, flax, torch, named):
        policy = from_layers(given, config, act=lambda seen: answered(layers, seen), steps=7)
        assert policy.metadata["training_steps"] == 7
        actions = Policy(policy, "mine").action(observations)
        np.testing.assert_allclose(actions, answered(layers, observations), atol=2e-5)
    along = replace(config, "follower.load_axis_only", True)  # roll is 0, in the environment too
    one = from_layers(layers, along, act=lambda seen: answered(layers, seen))
    np.testing.assert_allclose(Policy(one, "mine").action(observations), actions * [0, 1, 1], atol=2e-5)


def test_three_outputs_are_enough_and_statistics_normalise(config: Config) -> None:
    layers, random = sampled((18, 8, 3)), np.random.default_rng(2)
    mean, deviation = random.standard_normal(18), random.uniform(0.01, 3, 18)
    policy = from_layers(layers, config, mean, deviation, lambda seen: answered(layers, (seen - mean) / deviation))
    assert policy.weights[-1].shape == (8, 6)
    assert not policy.weights[-1][:, 3:].any()


@pytest.mark.parametrize(
    ("layers", "words"),
    [
        (sampled((17, 8, 3)), "layer 0 has the kernel (17, 8) and the bias (8,), and the observation has 18 numbers"),
        ([*sampled((18, 8)), *sampled((7, 3))], "layer 1 has the kernel (7, 3) and the bias (3,), and the"),
        (sampled((18, 8, 4)), "the last layer has 4 outputs; an action has 3, with deviations 6"),
        ([(np.zeros((18, 3)), np.zeros(4))], "the bias (4,); (inputs, outputs) and (outputs,) fit"),
        ({"Dense_0": {"kernel": np.eye(18), "scale": np.zeros(3)}}, "Dense_0 has kernel, scale: not a dense layer"),
        ({"log_std": np.zeros(3)}, "the network has log_std: not a dense layer"),
        ([], "there are no layers"),
        ([(1j * np.ones((18, 3)), np.zeros(3))], "a layer has numbers of the type complex128"),
    ],
)  # fmt: skip
def test_layers_that_do_not_fit_are_refused(config: Config, layers: Any, words: str) -> None:
    with pytest.raises(InputError) as refused:
        from_layers(layers, config)
    assert words in str(refused.value)


def test_a_network_of_another_kind_is_refused(config: Config) -> None:
    layers = sampled((18, 8, 3))

    def with_tanh(seen: np.ndarray) -> np.ndarray:
        return np.tanh(np.tanh(seen @ layers[0][0] + layers[0][1]) @ layers[1][0] + layers[1][1])

    with pytest.raises(InputError, match=r"actions differ from the trained policy's by up to .* has ReLU"):
        from_layers(layers, config, act=with_tanh)
    with pytest.raises(InputError, match=r"answers \(256, 6\) to 256 observations; an action has 3"):
        from_layers(layers, config, act=lambda seen: np.zeros((len(seen), 6)))
    with pytest.raises(InputError, match="deviation must be positive"):
        from_layers(layers, config, deviation=np.zeros(18))
    with pytest.raises(InputError, match=r"mean has the shape \(3,\), and the observation here \(18,\)"):
        from_layers(layers, config, np.zeros(3))


def test_positions_have_an_effect_unless_the_trainer_saw_zeros_there() -> None:
    """`transport` itself ignores positions; its environments show them."""
    layers, seen = sampled((18, 8, 3)), np.random.default_rng(3).standard_normal((9, 18))
    far = seen + np.array([5.0] * 3 + [0.0] * 15)
    for masked in (False, True):
        policy = from_layers(layers, preset("transport"), act=lambda seen: answered(layers, seen), masked=masked)
        actions = [Policy(policy, "mine").action(where) for where in (seen, far)]
        assert np.array_equal(*actions) == masked


def test_brax_networks(config: Config) -> None:
    """SAC's have ReLU layers; PPO's have swish unless told otherwise."""
    from brax.training.acme import running_statistics
    from brax.training.agents.ppo import networks as ppo
    from brax.training.agents.sac import networks as sac

    sizes = {"preprocess_observations_fn": running_statistics.normalize}
    made = [
        (sac.make_sac_networks(18, 3, **sizes), sac.make_inference_fn),
        (ppo.make_ppo_networks(18, 3, activation=jax.nn.relu, **sizes), ppo.make_inference_fn),
        (ppo.make_ppo_networks(18, 3, **sizes), ppo.make_inference_fn),
    ]
    statistics = SimpleNamespace(mean=np.linspace(-1, 1, 18), std=np.linspace(0.1, 2, 18))
    for number, (networks, make) in enumerate(made):
        parameters = statistics, networks.policy_network.init(jax.random.key(0))
        if number < 2:
            for normalize, spoilt in ((True, False), (False, True)):
                with pytest.raises(InputError, match="other processing") if spoilt else contextlib.nullcontext():
                    from_brax(parameters, config, make(networks), normalize)
        else:
            with pytest.raises(InputError, match="ReLU"):
                from_brax(parameters, config, make(networks), normalize_observations=True)
