"""Stable-Baselines3, where it is installed: its `VecEnv`, and policy files of what it trained."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mjxball.errors import InputError
from mjxball.foreign import from_sb3
from mjxball.policy import Policy

sb3 = pytest.importorskip("stable_baselines3")
pytestmark = pytest.mark.release

from stable_baselines3.common.env_checker import check_env  # noqa: E402
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize  # noqa: E402

from mjxball.gym.sb3 import FollowerVecEnv  # noqa: E402
from mjxball.gym.single import FollowerEnv  # noqa: E402


def sac(env: Any) -> Any:
    model = sb3.SAC("MlpPolicy", env, policy_kwargs={"net_arch": [16, 16]}, learning_starts=64, seed=1)
    return model.learn(256)


def test_the_environments_are_what_it_asks_for() -> None:
    check_env(FollowerEnv(physics="newton-euler"))
    env = FollowerVecEnv(3)
    env.seed(np.int64(5))
    first, second = env.reset(), env.reset()
    assert first.shape == (3, 18)
    assert np.abs(first - second).max() > 0  # the chain goes on
    env.seed(5)
    np.testing.assert_array_equal(env.reset(), first)
    ended, infos = np.zeros(3, bool), []
    while not ended.any():
        env.step_async(np.ones((3, 3), np.float32))
        _, _, ended, infos = env.step_wait()
    world = int(np.flatnonzero(ended)[0])
    assert infos[world]["terminal_observation"].shape == (18,)


@pytest.mark.parametrize("normalised", [False, True])
def test_a_policy_file_answers_as_the_model(normalised: bool) -> None:
    env: Any = FollowerVecEnv(16)
    env = VecNormalize(env) if normalised else env
    model = sac(env)
    seen = FollowerVecEnv(20).reset()  # within the ten deviations to which a `VecNormalize` clips
    expected = model.predict(env.normalize_obs(seen) if normalised else seen, deterministic=True)[0]
    np.testing.assert_allclose(Policy(from_sb3(model), "sb3").action(seen), expected, atol=1e-4)
    model.env = None  # as after `load` without it
    with pytest.raises(InputError, match="no environment, which may normalise observations"):
        from_sb3(model)


def test_what_a_policy_file_cannot_hold_is_refused() -> None:
    import torch

    with pytest.raises(InputError, match=r"PPO clips its actions.*FollowerVecEnv\(tanh=True\)"):
        from_sb3(sb3.PPO("MlpPolicy", FollowerVecEnv(2)))
    with pytest.raises(InputError, match=r"SAC has a tanh of its own.*FollowerVecEnv\(tanh=False\)"):
        from_sb3(sb3.SAC("MlpPolicy", FollowerVecEnv(2, tanh=True)))
    wide = FollowerVecEnv(2, tanh=True)
    with pytest.raises(InputError, match="ReLU"):
        from_sb3(sb3.PPO("MlpPolicy", wide))
    with pytest.raises(InputError, match="normalises observations elsewhere"):
        from_sb3(sb3.SAC("MlpPolicy", VecNormalize(VecNormalize(FollowerVecEnv(2)))))
    from_sb3(sb3.SAC("MlpPolicy", VecMonitor(VecNormalize(FollowerVecEnv(2)))))
    from_sb3(sb3.PPO("MlpPolicy", wide, policy_kwargs={"activation_fn": torch.nn.ReLU}))
