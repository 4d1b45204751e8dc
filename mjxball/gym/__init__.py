"""Gymnasium environments: `import mjxball.gym`, then `gymnasium.make("mjxball/Transport-v0")`.

Every preset of a pair is registered. `gymnasium.make` gives one world on C MuJoCo, `gymnasium.make_vec(...,
num_envs=N, vectorization_mode="vector_entry_point")` N worlds on MJX. Observation, reward, terminations and the reset
distribution are those of `mjxball.env`. Teams, whose followers are several agents, are
`mjxball.gym.parallel.FollowersParallelEnv`, for PettingZoo.
"""

from __future__ import annotations

try:
    import gymnasium
except ModuleNotFoundError:
    raise ModuleNotFoundError("gymnasium is not installed; pip install 'mjxball[gym]'", name="gymnasium") from None

from mjxball.config import PRESETS

__all__ = ["environment_id"]


def environment_id(preset: str) -> str:
    """Gymnasium's id of the environment of `preset`."""
    return f"mjxball/{preset.capitalize()}-v0"


for _preset in (name for name, config in PRESETS.items() if config.plant.count == 2):
    gymnasium.register(
        environment_id(_preset),
        entry_point="mjxball.gym.single:FollowerEnv",
        vector_entry_point="mjxball.gym.vector:FollowerVectorEnv",
        kwargs={"preset": _preset},
    )
