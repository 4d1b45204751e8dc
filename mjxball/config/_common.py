"""What several presets share."""

from __future__ import annotations

from typing import Any

from mjxball.config._learning import Gradient, Sac
from mjxball.config._settings import Follower

# For a GPU.
LARGE_SAC = Sac(
    total_steps=2_560_000,
    num_envs=512,
    batch_size=512,
    updates_per_step=16,
    replay_size=512_000,
    policy_layers=(128, 128),
    critic_layers=(128, 128),
    n_step=15,
    learning_rate=2e-3,
    learning_rate_final_ratio=0.02,
)
# A window may pass through a termination, so the gradient is limited in every environment.
RECURRENT_GRADIENT = Gradient(
    windows_per_episode=(3,),
    learning_rate=6e-3,
    learning_rate_final_ratio=0.003,
    adam_betas=(0.9, 0.99),
    gradient_decay=0.97,
    state_gradient_clip=1e4,
)
# A recurrent network added to the PD controller, without averages of observations.
RECURRENT = Follower(previous_action=True, recurrent_units=64)
# Disturbed flights of mjxball-bench; delays beyond its range, so that its own are no ends.
DISTURBED: dict[str, Any] = {
    "noise": (0.5, 2.0),
    "estimator_drift": (0.5, 1.5),
    "offset": (1.0, 1.0),
    "pose_lag": (0.0, 0.03),
    "gap_rate": (0.0, 0.25),
    "jitter": (0.0, 0.005),
    "delay": (0.0, 0.075),
    "thrust_scale": (0.95, 1.05),
    "rotor_drag": (0.1, 0.5),
    "wind": (0.0, 2.0),
    "gust": (0.0, 0.1),
    "floor_clearance": (0.06, 1.0),
    "download": (0.0, 0.1),
    "thrust_fade": (0.0, 0.001),
    "calm_probability": 0.35,  # noise hides errors of millimetres
}
