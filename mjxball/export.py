"""Export a follower: `python -m mjxball.export RUN_DIR OUT`, of a run's newest checkpoint or of a policy file.

OUT ends in .npz (policy file), .onnx (ONNX model) or .h (C99 header); see docs/export.md.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import Any

import numpy as np

from mjxball import __version__
from mjxball.cli import Parser, output_file, run_command
from mjxball.config import Config, config_hash, to_dict
from mjxball.control.observation import ACTION, OBSERVATION
from mjxball.control.recall import recall_of
from mjxball.errors import InputError
from mjxball.policy import PolicyFile, load_file, save_file
from mjxball.policy.file import FORMAT_VERSION, write_whole


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
    return PolicyFile(
        weights=(weights[0][:size], *weights[1:]),
        biases=tuple(np.asarray(layers[name]["bias"], np.float32) for name in names),
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


def policy_of_run(run: Path) -> PolicyFile:
    """The policy of the newest checkpoint in the run directory `run`."""
    from mjxball.train.checkpoint import restore_policy
    from mjxball.train.curves import told_by_the_run

    config, learner, steps, origin = restore_policy(run)
    policy = policy_file(config, learner, steps, {**origin, **told_by_the_run(run, origin["seed"])})
    if not is_sound(policy):
        raise InputError(f"the newest checkpoint of {run} holds values that are not finite")
    return policy


def contents_of(source: Path) -> PolicyFile:
    """The policy in `source`, a policy file or a run directory."""
    return load_file(source) if source.suffix == ".npz" else policy_of_run(source)


def _write_onnx(out: Path, policy: PolicyFile) -> None:
    from mjxball.policy.formats.onnx_file import onnx_model

    write_whole(out, onnx_model(policy, out.stem).SerializeToString())


def _write_header(out: Path, policy: PolicyFile) -> None:
    from mjxball.policy.formats.c_header import c_header

    write_whole(out, c_header(policy, out.stem).encode("ascii"))


WRITERS = {".npz": save_file, ".onnx": _write_onnx, ".h": _write_header}


def export(source: Path, out: Path) -> None:
    """Export `source` to the new file `out`, in the format that its ending names; raise InputError if that fails."""
    if out.suffix not in WRITERS:
        raise InputError(f"output file {out} must end in {', '.join(WRITERS)}, which chooses the format")
    output_file(out, out.suffix)
    WRITERS[out.suffix](out, contents_of(source))


def main(arguments: list[str] | None = None) -> int:
    """Command line of `python -m mjxball.export`."""
    about, formats = __doc__.split("\n\n")
    parser = Parser(prog="python -m mjxball.export", description=about, epilog=formats)
    parser.add_argument("source", metavar="RUN_DIR", type=Path, help="run directory of train.py, or a policy file .npz")
    parser.add_argument("out", metavar="OUT", type=Path, help="file to write, .npz, .onnx or .h; must not exist")
    options = parser.parse_args(arguments)

    def command() -> int:
        export(options.source, options.out)
        print(options.out)  # noqa: T201
        return 0

    return run_command(command)


if __name__ == "__main__":
    sys.exit(main())
