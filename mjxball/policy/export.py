"""Policy files from trained networks. Flax's arrays are read as NumPy; only NumPy is imported."""

from __future__ import annotations

import io
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from mjxball import __version__
from mjxball.config import Config, config_hash, to_dict
from mjxball.control.geometry import GEOMETRY
from mjxball.control.motors import firmware
from mjxball.control.network_interface import NetworkInterface
from mjxball.control.observation import ACTION, OBSERVATION, action_mask
from mjxball.files import write_atomically
from mjxball.policy.file import PolicyFile


def policy_file(
    config: Config, interface: NetworkInterface, learnt: Any, steps: int, origin: dict[str, Any] | None = None
) -> PolicyFile:
    """The policy file of a trained network, `learnt` (`algorithms.base.PolicyNetwork`), after `steps` steps.

    `interface`: `sim.follower.network_interface(config)`. `origin` (command, seed, commit, ...) is added to the
    metadata.
    """
    weights, biases = _layers(learnt)
    follower = config.follower
    size = (
        interface.input_size
    )  # further inputs are a GRU's state, and those of critics alone, whose weights are not exported
    mask = np.array(interface.mask(follower.ignore_position))[:size]
    deviation = np.asarray(learnt.deviation, np.float64)[:size]
    action_scale = [follower.action_scale_tilt, follower.action_scale_vertical]
    metadata = {
        "format_version": 5 if interface.units else 1,
        "observation": [list(slot) for slot in OBSERVATION],
        "history": 1,  # number of observations; 0.1.0 and earlier allowed more
        "previous_action": follower.previous_action,
        "filters": list(follower.observation_averages),
        **({"stale": True} if follower.stale else {}),
        **({"recurrent_units": interface.units} if interface.units else {}),
        "action": [list(slot) for slot in ACTION],
        "action_mode": follower.action,
        **({"context": list(GEOMETRY)} if interface.geometry else {}),
        "action_reach": action_scale,
        **flight_record(config),
        "package_version": __version__,
        "training_steps": int(steps),
        "bounds": {name: bound for name, bound in to_dict(config.bounds).items() if bound > 0},
        **(origin or {}),
    }
    # Outputs: means, then deviations of the action. The means of components that are masked become 0.
    keep = np.append(action_mask(follower.load_axis_only, config.plant.cg_axis), np.ones(len(ACTION))).astype(
        np.float32
    )
    weights[-1], biases[-1] = weights[-1] * keep, biases[-1] * keep
    return PolicyFile(
        weights=(weights[0][: size + interface.units], *weights[1:]),
        biases=tuple(biases),
        observation_mean=np.asarray(learnt.mean, np.float32)[:size],
        observation_scale=(mask / deviation).astype(np.float32),
        action_scale=np.array([action_scale[0], action_scale[0], action_scale[1]], np.float32),
        metadata=metadata,
        gru=_gru(learnt),
    )


def flight_record(config: Config) -> dict[str, Any]:
    """The part of a policy's metadata that a flight needs, for a follower that was made for `config`."""
    return {
        "command_limits": [config.command.tilt_limit, config.command.vertical_limit],
        "leader_kp": list(config.leader.kp),
        "leader_kd": list(config.leader.kd),
        "gravity": config.plant.gravity,
        "control_period": config.timing.control_period,
        "plant": to_dict(config.plant),
        **({"firmware": firmware(config)} if config.autopilot.kind == "crazyflie" else {}),
        "preset": config.preset,
        "config": to_dict(config),
        "config_hash": config_hash(config),
    }


def _layers(learnt: Any) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Weights (n_in, n_out) and biases (n_out,) of all layers, float32."""
    names = sorted(learnt.layers.keys() - {"gru"}, key=lambda name: int(name.rsplit("_", 1)[1]))
    layers = [learnt.layers[name] for name in names]
    return tuple([np.asarray(layer[part], np.float32) for layer in layers] for part in ("kernel", "bias"))  # type: ignore[return-value]


def _gru(learnt: Any) -> tuple[np.ndarray, ...] | None:
    """Kernel, recurrent weights and bias of the GRU, float32; None without a GRU."""
    if "gru" not in learnt.layers:
        return None
    return tuple(np.asarray(learnt.layers["gru"][part], np.float32) for part in ("kernel", "recurrent", "bias"))


def network_file(path: Path, learnt: Any, steps: int, origin: dict[str, Any]) -> bool:
    """Write a policy of a foreign environment to `path`. If it is not finite, nothing is written and False returned.

    The arrays are those of a policy file (docs/policy-file.md); the metadata are `origin` and `training_steps` only.
    """
    weights, biases = _layers(learnt)
    scale = np.asarray(learnt.mask) / np.asarray(learnt.deviation, np.float64)
    arrays: dict[str, Any] = {
        "observation_mean": np.asarray(learnt.mean, np.float32),
        "observation_scale": scale.astype(np.float32),
        **{f"weight_{k}": weight for k, weight in enumerate(weights)},
        **{f"bias_{k}": bias for k, bias in enumerate(biases)},
    }
    if not all(np.isfinite(array).all() for array in arrays.values()):
        return False
    stream = io.BytesIO()
    metadata: dict[str, Any] = {"training_steps": steps, "package_version": __version__, **origin}
    np.savez(stream, **arrays | {"card": np.array(json.dumps(metadata, sort_keys=True))})
    write_atomically(path, stream.getvalue())
    return True


def is_sound(policy: PolicyFile) -> bool:
    """Whether every weight and scale of `policy` is finite."""
    return all(
        math.isfinite(float(np.abs(array).sum()))
        for array in (
            *policy.weights,
            *policy.biases,
            policy.observation_mean,
            policy.observation_scale,
            *(policy.gru or ()),
        )
    )
