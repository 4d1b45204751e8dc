"""What training has learned -> a policy file. Reads Flax's arrays as NumPy, and imports NumPy only."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mjxball import __version__
from mjxball.config import Config, config_hash, to_dict
from mjxball.control.observation import ACTION, OBSERVATION, commanded
from mjxball.control.recall import recall_of
from mjxball.policy.file import FORMAT_VERSION, PolicyFile


def policy_file(config: Config, learner: Any, steps: int, origin: dict[str, Any] | None = None) -> PolicyFile:
    """The policy file of a `train.sac.Learner`: its averaged policy and its observation statistics.

    `origin` (command, seed, commit, ...) is added to the card.
    """
    layers = learner.average["params"]
    names = sorted(layers, key=lambda name: int(name.rsplit("_", 1)[1]))
    follower, leader = config.follower, config.leader
    mask = np.array(recall_of(config).mask(follower.ignore_position))
    size = len(mask)  # behind it stands what only the critics were told; the policy's weights for it never moved
    deviation = np.asarray(learner.normaliser.std, np.float64)[:size]
    reach = [follower.tilt_limit, follower.vertical_limit]
    card = {
        "format_version": FORMAT_VERSION,
        "observation": [list(slot) for slot in OBSERVATION],
        "history": follower.history,
        "previous_action": follower.previous_action,
        "filters": list(follower.filters),
        "action": [list(slot) for slot in ACTION],
        "action_mode": follower.action,
        "action_reach": reach,
        "command_limits": [leader.tilt_limit, leader.vertical_limit],
        "leader_kp": list(leader.kp),
        "leader_kd": list(leader.kd),
        "gravity": config.plant.gravity,
        "control_period": config.timing.control_period,
        "plant": to_dict(config.plant),
        "preset": config.preset,
        "config": to_dict(config),
        "config_hash": config_hash(config),
        "package_version": __version__,
        "training_steps": int(steps),
        "bounds": {name: bound for name, bound in to_dict(config.bounds).items() if bound > 0},
        **(origin or {}),
    }
    weights = [np.asarray(layers[name]["kernel"], np.float32) for name in names]
    biases = [np.asarray(layers[name]["bias"], np.float32) for name in names]
    # What the network does not command is 0, the mean of nothing; behind the means stand the deviations.
    keep = np.append(commanded(follower.load_axis_only, config.plant.cg_axis), np.ones(len(ACTION))).astype(np.float32)
    weights[-1], biases[-1] = weights[-1] * keep, biases[-1] * keep
    return PolicyFile(
        weights=(weights[0][:size], *weights[1:]),
        biases=tuple(biases),
        observation_mean=np.asarray(learner.normaliser.mean, np.float32)[:size],
        observation_scale=(mask / deviation).astype(np.float32),
        action_scale=np.array([reach[0], reach[0], reach[1]], np.float32),
        card=card,
    )


def is_sound(policy: PolicyFile) -> bool:
    """True if every number of `policy` is finite."""
    return all(
        math.isfinite(float(np.abs(array).sum()))
        for array in (*policy.weights, *policy.biases, policy.observation_mean, policy.observation_scale)
    )
