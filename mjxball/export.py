"""Export a follower: `python -m mjxball.export RUN_DIR OUT`, of a run's newest checkpoint or of a policy file.

OUT ends in .npz (policy file), .onnx (ONNX model) or .h (C99 header); see docs/policy-file.md.
"""

from __future__ import annotations

import sys
from pathlib import Path

from mjxball.cli import make_parser, output_file, quit_on_interrupt, run_command
from mjxball.errors import InputError
from mjxball.policy.file import PolicyFile, load_file, save_file, write_whole


def policy_of_run(run: Path) -> PolicyFile:
    """The policy of the newest checkpoint in the run directory `run`."""
    from mjxball.policy.export import is_sound, policy_file
    from mjxball.sim.follower import follower_law
    from mjxball.train.checkpoint import restore_policy
    from mjxball.train.curves import training_summary

    config, learnt, steps, origin = restore_policy(run)
    policy = policy_file(
        config, follower_law(config), learnt, steps, {**origin, **training_summary(run, origin["seed"])}
    )
    if not is_sound(policy):
        raise InputError(f"the newest checkpoint of {run} holds values that are not finite")
    return policy


def contents_of(source: Path) -> PolicyFile:
    """The policy in `source`, a policy file or a run directory."""
    return load_file(source) if source.suffix == ".npz" else policy_of_run(source)


def _write_onnx(out: Path, policy: PolicyFile) -> None:
    from mjxball.policy.formats.onnx_model import onnx_model

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
    parser = make_parser("python -m mjxball.export", about, epilog=formats)
    parser.add_argument("source", metavar="RUN_DIR", type=Path, help="run directory of train.py, or a policy file .npz")
    parser.add_argument("out", metavar="OUT", type=Path, help="file to write, .npz, .onnx or .h; must not exist")
    options = parser.parse_args(arguments)

    def command() -> int:
        export(options.source, options.out)
        print(options.out)  # noqa: T201
        return 0

    return run_command(command)


if __name__ == "__main__":
    quit_on_interrupt()
    sys.exit(main())
