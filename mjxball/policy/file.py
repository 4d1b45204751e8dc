"""The policy file: one `.npz` without pickles (docs/policy-file.md). All contents are checked when it is read."""

from __future__ import annotations

import io
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np

from mjxball.control.geometry import GEOMETRY
from mjxball.control.network import Network
from mjxball.control.network_interface import NetworkInterface
from mjxball.control.observation import (
    ACTION,
    ACTION_SIZE,
    OBSERVATION,
    OBSERVATION_SIZE,
    STALE,
    ObservationHistory,
)
from mjxball.errors import InputError
from mjxball.files import write_atomically
from mjxball.policy.container import PolicyFileError, read_arrays
from mjxball.reading import is_number, near, parse_json

# 5: with a GRU (arrays GRU_ARRAYS); with `context` in the metadata its inputs include the geometry of the team.
FORMAT_VERSIONS = (1, 5)
ENDED = {  # formats of networks on top of an LQG, whose parameters the file holds
    2: "an LQG of a pair",
    3: "an LQG of one of a team",
    4: "LQGs for attitude loops that nobody knows",
}
LAST_VERSION = "0.1.0"  # the last of mjxball that flies them
GRU_ARRAYS = ("gru_kernel", "gru_recurrent", "gru_bias")
MAX_UNITS = 512
MAX_NUMBER = 1e6  # size of any number in the metadata and of any weight; larger ones would overflow
FOLDER = "policies"  # shipped policies
ARCHIVE = "archive"  # in FOLDER: earlier policies that documents name
READ_OF_CONFIG = ("leader", "follower", "attitude", "reward")  # sections of the configuration that evaluation reads
MAX_METADATA = 2**20  # characters
# Metrics with bounds in the metadata; of each smaller values are better.
BOUNDED = ("rmse", "settling_time", "overshoot", "x_peak", "y_peak", "z_peak", "max_tilt", "action_error")
METADATA_FIELDS: dict[str, type] = {
    **dict.fromkeys(("format_version", "history", "training_steps"), int),
    **dict.fromkeys(("gravity", "control_period"), float),
    "previous_action": bool,
    **dict.fromkeys(("action_mode", "preset", "config_hash", "package_version"), str),
    **dict.fromkeys(("observation", "action", "action_reach", "command_limits", "leader_kp", "leader_kd"), list),
    **dict.fromkeys(("plant", "bounds"), dict),
}
LENGTHS = {"action_reach": 2, "command_limits": 2, "leader_kp": 3, "leader_kd": 3}


@dataclass(frozen=True)
class PolicyFile:
    """Contents of a policy file."""

    weights: tuple[np.ndarray, ...]  # float32, (n_in, n_out) each
    biases: tuple[np.ndarray, ...]  # float32, (n_out,) each; outputs of the last layer are means, then deviations
    observation_mean: np.ndarray  # (n,) float32
    observation_scale: np.ndarray  # (n,) float32, 1 / standard deviation, 0 for an input that is not used
    action_scale: np.ndarray  # (3,) float32: [-1, 1] -> rad, rad, m/s2
    metadata: dict[str, Any]
    gru: tuple[np.ndarray, ...] | None = None  # GRU_ARRAYS, float32: (n, 3 H), (H, 3 H), (3 H,)


def interface_of(metadata: dict[str, Any]) -> NetworkInterface:
    """The interface around the network of a policy file with `metadata`; the first files have no `filters`."""
    filters = tuple(metadata.get("filters", ()))
    return NetworkInterface(
        history=ObservationHistory(
            metadata["previous_action"], filters, float(metadata["control_period"]), metadata.get("stale") is True
        ),
        action_scale=tuple(metadata["action_reach"]),
        limits=tuple(metadata["command_limits"]),
        kp=tuple(metadata["leader_kp"]),
        kd=tuple(metadata["leader_kd"]),
        gravity=metadata["gravity"],
        residual=metadata["action_mode"] == "residual",
        units=metadata.get("recurrent_units", 0),
        geometry=metadata["format_version"] == 5 and "context" in metadata,
    )


def observing_stale(policy: PolicyFile) -> PolicyFile:
    """`policy` with the input of `follower.stale`, which has no effect yet; the same if it already has it."""
    interface = interface_of(policy.metadata)
    if interface.history.stale:
        return policy
    place = OBSERVATION_SIZE + interface.history.input_size
    return replace(
        policy,
        weights=(np.insert(policy.weights[0], place + interface.units, 0.0, axis=0), *policy.weights[1:]),
        observation_mean=np.insert(policy.observation_mean, place, 0.0),
        observation_scale=np.insert(policy.observation_scale, place, 1 / STALE),
        metadata={**policy.metadata, "stale": True},
        gru=policy.gru and (np.insert(policy.gru[0], place, 0.0, axis=0), *policy.gru[1:]),
    )


def adds_to_pid(metadata: dict[str, Any]) -> bool:
    """Whether the network was trained on the leader's PID controller with its integrals, as in earlier versions."""
    config = metadata.get("config")
    follower = config.get("follower") if isinstance(config, dict) else None
    return isinstance(follower, dict) and follower.get("residual_on_pid") is True


def save_file(path: str | os.PathLike[str], policy: PolicyFile) -> None:
    """Write `policy` to `path` atomically: a reader sees the old file or the complete new one."""
    check(policy, str(path))
    arrays: dict[str, Any] = {
        "observation_mean": policy.observation_mean,
        "observation_scale": policy.observation_scale,
        "action_scale": policy.action_scale,
        "card": np.array(json.dumps(policy.metadata, sort_keys=True)),
    }
    for number, (weight, bias) in enumerate(zip(policy.weights, policy.biases, strict=True)):
        arrays[f"weight_{number}"], arrays[f"bias_{number}"] = weight, bias
    if policy.gru is not None:
        arrays |= dict(zip(GRU_ARRAYS, policy.gru, strict=True))
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    write_atomically(path, stream.getvalue())


def load_file(path: str | os.PathLike[str]) -> PolicyFile:
    """Read and check a policy file; raise PolicyFileError for anything invalid."""
    name = str(path)
    try:
        arrays = read_arrays(name)
    except PolicyFileError as error:
        if os.path.lexists(path):
            raise
        known = _shipped()
        raise PolicyFileError(f"{error}{near(name, known)}; by name there are {', '.join(known) or 'none'}") from None
    for needed in ("observation_mean", "observation_scale", "action_scale", "card"):
        if needed not in arrays:
            foreign = (
                "; mjxball.policy.load_network reads that of another environment" if needed == "action_scale" else ""
            )
            raise PolicyFileError(f"{name} is not a policy file: it has no {needed}{foreign}")
    metadata = _read_metadata(name, arrays.pop("card"))
    _check_version(metadata, name)  # before the arrays, which may differ in later formats
    layers = 0
    while f"weight_{layers}" in arrays:
        layers += 1
    expected = {"observation_mean", "observation_scale", "action_scale"}
    expected |= {f"{kind}_{i}" for kind in ("weight", "bias") for i in range(layers)}
    recurrent = metadata["format_version"] == 5
    expected |= set(GRU_ARRAYS) if recurrent else set()
    odd = sorted(set(arrays) ^ expected)
    if odd or not layers:
        raise PolicyFileError(f"{name}: unexpected or missing array {odd[0] if odd else 'weight_0'!r}")
    policy = PolicyFile(
        weights=tuple(arrays[f"weight_{i}"] for i in range(layers)),
        biases=tuple(arrays[f"bias_{i}"] for i in range(layers)),
        observation_mean=arrays["observation_mean"],
        observation_scale=arrays["observation_scale"],
        action_scale=arrays["action_scale"],
        metadata=metadata,
        gru=tuple(arrays[label] for label in GRU_ARRAYS) if recurrent else None,
    )
    check(policy, name)
    return policy


def load_network(path: str | os.PathLike[str]) -> Network:
    """The network in `policy.npz` of a run on another environment (`--env`).

    It maps observations (..., n) of float32 to actions (..., a) in [-1, 1]. Raises PolicyFileError if the file holds no
    such network.
    """
    arrays = read_arrays(str(path))
    layers = sum(name.startswith("weight_") for name in arrays)
    try:
        weights = [arrays[f"weight_{number}"] for number in range(layers)]
        biases = [arrays[f"bias_{number}"] for number in range(layers)]
        mean, scale = arrays["observation_mean"], arrays["observation_scale"]
        half = len(biases[-1]) // 2  # the other half is the deviation
        found = Network([*weights[:-1], weights[-1][:, :half]], [*biases[:-1], biases[-1][:half]], mean, scale)
        found(np.zeros_like(mean))
    except (KeyError, IndexError, TypeError, ValueError):
        raise PolicyFileError(f"{path} holds no network of layers from weight_0 and bias_0 on that fit") from None
    return found


def _read_metadata(name: str, text: np.ndarray) -> dict[str, Any]:
    if text.ndim != 0 or text.dtype.kind != "U":
        raise PolicyFileError(f"{name}: the metadata is not one string")
    if text.dtype.itemsize > 4 * MAX_METADATA:  # parsed JSON takes fifty times as much memory
        raise PolicyFileError(f"{name}: the metadata is longer than {MAX_METADATA} characters")
    try:
        metadata = parse_json(str(text))
    except (ValueError, RecursionError) as error:
        raise PolicyFileError(f"{name}: the metadata is not JSON: {error}") from None
    if not isinstance(metadata, dict):
        raise PolicyFileError(f"{name}: the metadata is not a JSON object")
    return metadata


def check(policy: PolicyFile, name: str) -> None:
    """Raise PolicyFileError unless every field, shape, dtype and value of `policy` is valid."""
    _check_metadata(policy.metadata, name)
    interface = interface_of(policy.metadata)
    size = interface.input_size
    vectors = [
        ("observation_mean", policy.observation_mean, size),
        ("observation_scale", policy.observation_scale, size),
        ("action_scale", policy.action_scale, ACTION_SIZE),
    ]
    for label, array, length in vectors:
        _check_array(name, label, array, (length,))
    if (policy.observation_scale < 0).any() or (policy.action_scale <= 0).any():
        raise PolicyFileError(f"{name}: observation_scale must not be negative and action_scale must be positive")
    if not np.allclose(policy.action_scale, _action_scale(policy.metadata), rtol=1e-6, atol=0):
        raise PolicyFileError(f"{name}: action_scale differs from the metadata's action_reach")
    _check_gru(policy, name, size, interface.units)
    width = size + interface.units
    for number, (weight, bias) in enumerate(zip(policy.weights, policy.biases, strict=True)):
        last = number == len(policy.weights) - 1
        width += interface.units if last else 0
        out = 2 * ACTION_SIZE if last else (weight.shape[1] if weight.ndim == 2 else -1)
        _check_array(name, f"weight_{number}", weight, (width, out))
        _check_array(name, f"bias_{number}", bias, (out,))
        width = out


def _check_gru(policy: PolicyFile, name: str, inputs: int, units: int) -> None:
    if (policy.gru is None) != (units == 0):
        raise PolicyFileError(f"{name}: metadata field recurrent_units and arrays gru_* do not belong together")
    if policy.gru is not None:
        shapes = (inputs, 3 * units), (units, 3 * units), (3 * units,)
        for label, array, shape in zip(GRU_ARRAYS, policy.gru, shapes, strict=True):
            _check_array(name, label, array, shape)


def _action_scale(metadata: dict[str, Any]) -> list[float]:
    tilt, vertical = metadata["action_reach"]
    return [tilt, tilt, vertical]


def _check_array(name: str, label: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if array.dtype != np.float32:
        raise PolicyFileError(f"{name}: {label} must be float32, not {array.dtype}")
    if array.shape != shape:
        raise PolicyFileError(f"{name}: {label} must have shape {shape}, not {array.shape}")
    if not np.isfinite(array).all():
        raise PolicyFileError(f"{name}: {label} holds a value that is not finite")
    if array.size == 0 or np.abs(array).max() > MAX_NUMBER:
        raise PolicyFileError(f"{name}: {label} is empty or holds a value beyond {MAX_NUMBER:g}")


def _check_version(metadata: dict[str, Any], name: str) -> None:
    version = metadata.get("format_version")
    if type(version) is int and version in ENDED:
        raise PolicyFileError(
            f"{name} has policy format {version}, a network on top of {ENDED[version]}: mjxball {LAST_VERSION} is the "
            "last version that flies it"
        )
    if version not in FORMAT_VERSIONS or isinstance(version, bool):
        known = ", ".join(map(str, FORMAT_VERSIONS))
        raise PolicyFileError(f"{name} has policy format {version!r}; this version reads formats {known}")


def _check_metadata(metadata: dict[str, Any], name: str) -> None:
    _check_version(metadata, name)
    for fault in _metadata_faults(metadata):
        raise PolicyFileError(f"{name}: {fault}")


def _metadata_faults(metadata: dict[str, Any]) -> Iterator[str]:
    """Phrases on what is wrong with the metadata of a policy; after the first one others need not be right."""
    for field, kind in METADATA_FIELDS.items():
        value = metadata.get(field)
        kinds = (int, float) if kind is float else kind
        if not isinstance(value, kinds) or (isinstance(value, bool) and kind is not bool):
            yield f"metadata field {field} is missing or not {kind.__name__}"
    if metadata["observation"] != [list(slot) for slot in OBSERVATION]:
        yield "the policy was made for another observation than this version's 18 numbers"
    if metadata["action"] != [list(slot) for slot in ACTION]:
        yield "the policy was made for another action than roll, pitch, vertical acceleration"
    config = metadata.get("config", {})
    if not isinstance(config, dict) or not all(isinstance(config.get(part, {}), dict) for part in READ_OF_CONFIG):
        yield "metadata field config is not a configuration"
    if adds_to_pid(metadata):
        yield "it adds to the leader's PID controller with its integrals, which this version no longer does"
    if type(metadata.get("stale", False)) is not bool:
        yield "metadata field stale must be true or false"
    yield from _number_faults(metadata)
    if metadata["format_version"] == 5 and "context" in metadata:
        yield from _geometry_faults(metadata)
    if metadata.get("flown") is not None:
        yield from _flown_faults(metadata["flown"])


def _number_faults(metadata: dict[str, Any]) -> Iterator[str]:
    """Of fields that have the right types."""
    if metadata["action_mode"] not in ("residual", "direct"):
        yield f"action_mode must be residual or direct, not {metadata['action_mode']!r}"
    if metadata["history"] != 1:
        yield f"history must be 1, not {metadata['history']}; more of it mjxball {LAST_VERSION} flies"
    filters = metadata.get("filters", [])
    if not isinstance(filters, list) or len(filters) > 10 or not all(is_finite(t) and t >= 1e-3 for t in filters):
        yield "filters must be up to 10 time constants of at least 1 ms"
    for field, length in LENGTHS.items():
        if len(metadata[field]) != length or not all(is_finite(value) and value >= 0 for value in metadata[field]):
            yield f"metadata field {field} must be {length} finite numbers"
    units, most = metadata.get("recurrent_units", 0), MAX_UNITS if metadata["format_version"] == 5 else 0
    if type(units) is not int or not min(most, 1) <= units <= most:
        yield f"metadata field recurrent_units must be 1 to {MAX_UNITS} in format 5, and absent in others"
    for field in ("control_period", "gravity"):
        if not (is_finite(metadata[field]) and metadata[field] >= 1e-6):
            yield f"metadata field {field} must be positive"
    if not all(map(is_finite, metadata["bounds"].values())):
        yield "metadata field bounds must hold finite numbers"
    for odd in sorted(set(metadata["bounds"]) - set(BOUNDED)):
        yield f"metadata field bounds names {odd!r}; known are {', '.join(BOUNDED)}"


def _geometry_faults(metadata: dict[str, Any]) -> Iterator[str]:
    """Of `context`, and of `team`: the geometry of a team as one of its drones sees it."""
    if metadata["context"] != list(GEOMETRY):
        yield f"the policy needs another context than this version's {', '.join(GEOMETRY)}"
    if "team" not in metadata:
        return
    team = metadata["team"]
    if not isinstance(team, dict) or team.keys() != {"drone", "mount_angle", "context"}:
        yield "metadata field team must hold drone, mount_angle and context"
    if not (is_finite(team["drone"]) and is_finite(team["mount_angle"])):
        yield "metadata fields team.drone and team.mount_angle must be finite numbers"
    context = team["context"]
    if not (isinstance(context, list) and len(context) == len(GEOMETRY) and all(map(is_finite, context))):
        yield f"metadata field team.context must be {len(GEOMETRY)} finite numbers"
    share, _, _, room = context
    if share <= 1 or room <= 0:
        yield "metadata field team.context: command_share must be above 1 and rotor_room positive"


def _flown_faults(flown: Any) -> Iterator[str]:
    """Of `flown`: numbers of drones, and the duration [s] up to which flights were good."""
    fields: dict[str, Any] = flown if isinstance(flown, dict) else {}
    drones, seconds = fields.get("drones"), fields.get("seconds", 0.0)
    counts = isinstance(drones, list) and drones and all(type(count) is int and count > 1 for count in drones)
    if not (counts and is_finite(seconds) and seconds > 0):
        yield "metadata field flown must hold drones, numbers above 1, and positive seconds"


def is_finite(value: Any) -> bool:
    """Whether `value` is a number (no bool) of at most `MAX_NUMBER` in size."""
    return is_number(value, MAX_NUMBER)


def shipped_policies() -> list[Path]:
    """Paths of the shipped policies by name, without archived ones; empty if none are installed."""
    return sorted(_folder().glob("*.npz"))


def shipped_policy(name: str) -> Path:
    """The path of the shipped or archived policy `name`, such as `balance`; InputError if there is none."""
    known = _shipped()
    if name not in known:
        raise InputError(f"no shipped policy is called {name!r}; there are {', '.join(known) or 'none'}")
    return known[name]


def policy_path(text: str | os.PathLike[str]) -> Path:
    """`text` as a path if that exists, else the path of the shipped policy of that name, else `text` as a path."""
    path = Path(text)
    return path if os.path.lexists(path) else _shipped().get(str(text), path)


def policy_name(path: str | os.PathLike[str]) -> str:
    """What the policy in the file `path` is called: its run, for the `policy.npz` of a run directory, else the stem."""
    path = Path(path)
    return path.absolute().parent.name if path.name == "policy.npz" else path.stem


def _shipped() -> dict[str, Path]:
    return {path.stem: path for path in (*shipped_policies(), *sorted((_folder() / ARCHIVE).glob("*.npz")))}


def _folder() -> Path:
    """The folder of shipped policies: inside the package in a wheel, beside it in a source tree."""
    packaged = Path(str(resources.files("mjxball"))) / FOLDER
    return packaged if packaged.is_dir() else Path(__file__).parents[2] / FOLDER
