"""Export a follower, `python -m mjxball.export POLICY|RUN OUT`.

OUT ends in .npz (policy file), .onnx (ONNX model) or .h (C99 header), and holds a policy file, or a run's newest
checkpoint; see docs/policy-file.md.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from pathlib import Path

from mjxball import config as configs
from mjxball.cli import Parser, make_parser, output_file, plant_setup
from mjxball.errors import InputError
from mjxball.files import write_atomically
from mjxball.policy import team
from mjxball.policy.file import PolicyFile, load_file, policy_path, save_file
from mjxball.running import quit_on_interrupt, run_command


def policy_of_run(run: Path) -> PolicyFile:
    """The policy of the newest checkpoint in the run directory `run`. Raises InputError unless it is finite."""
    from mjxball.policy.export import is_sound, policy_file
    from mjxball.sim.follower import network_interface
    from mjxball.train.checkpoint import restore_policy
    from mjxball.train.curves import training_summary

    config, learnt, steps, origin = restore_policy(run)
    policy = policy_file(
        config, network_interface(config), learnt, steps, {**origin, **training_summary(run, origin["seed"])}
    )
    if not is_sound(policy):
        raise InputError(f"the newest checkpoint of {run} holds values that are not finite")
    return policy


def contents_of(source: Path) -> PolicyFile:
    """The policy in `source`, a policy file or a run directory."""
    return load_file(source) if source.suffix == ".npz" else policy_of_run(source)


def in_team(policy: PolicyFile, name: str, plant: Path | None, drone: int | None = None) -> PolicyFile:
    """`policy.team.in_team` on the plant file `plant`."""
    return team.in_team(policy, name, None if plant is None else plant_setup(plant), drone)


def _write_onnx(out: Path, policy: PolicyFile) -> None:
    from mjxball.policy.formats.onnx_model import onnx_model

    write_atomically(out, onnx_model(policy, out.stem).SerializeToString())


def _save_quantized(out: Path, policy: PolicyFile) -> None:
    from mjxball.policy.quantize import quantized

    save_file(out, quantized(policy))


def _write_header(out: Path, policy: PolicyFile, int8: bool = False) -> None:
    from mjxball.policy.formats.c_header import c_header

    write_atomically(out, c_header(policy, out.stem, int8).encode("ascii"))


Writer = Callable[[Path, PolicyFile], None]
WRITERS: dict[str, Writer] = {".npz": save_file, ".onnx": _write_onnx, ".h": _write_header}
INT8_WRITERS: dict[str, Writer] = {".npz": _save_quantized, ".h": functools.partial(_write_header, int8=True)}


def export(
    source: Path,
    out: Path,
    int8: bool = False,
    plant: Path | None = None,
    drone: int | None = None,
) -> None:
    """Export `source` to the new file `out`, in the format of its suffix. Raises InputError if that is impossible.

    `int8`: 8-bit weights in a header, floats rounded to them in a policy file. `plant`, `drone`: see `in_team`; they
    are optional for a policy file.
    """
    if int8 and out.suffix not in INT8_WRITERS:
        raise InputError("--int8 is for an output file that ends in .h or .npz")
    if out.suffix not in WRITERS:
        raise InputError(f"output file {out} must end in {', '.join(WRITERS)}, which chooses the format")
    output_file(out, out.suffix)
    policy = contents_of(source)
    if out.suffix != ".npz" or plant is not None or drone is not None:
        policy = in_team(policy, source.stem, plant, drone)
    (INT8_WRITERS if int8 else WRITERS)[out.suffix](out, policy)


def main(arguments: list[str] | None = None) -> int:
    """Command line of `python -m mjxball.export`."""
    about, formats = __doc__.split("\n\n")
    parser = make_parser("python -m mjxball.export", about, epilog=formats)
    add_source(parser)
    parser.add_argument("out", metavar="OUT", type=Path, help="file to write, whose ending says what; must not exist")
    parser.add_argument("--int8", action="store_true", help="weights of 8 bits; .npz: rounded to them")
    options = parser.parse_args(arguments)

    def command() -> int:
        export(options.source, options.out, options.int8, options.plant, options.drone)
        print(options.out)  # noqa: T201
        return 0

    return run_command(command)


def add_source(parser: Parser) -> None:
    """Add the arguments for the follower to export and the team in which it flies."""
    about = "policy file, name of a shipped one, or run directory of train.py"
    parser.add_argument("source", metavar="POLICY|RUN", type=policy_path, help=about)
    plants = f"{', '.join(configs.PLANTS)}, or a rig in TOML, JSON, MJCF or URDF"
    about = f"plant to fly, for a policy for any rig or for two Crazyflies: {plants}"
    parser.add_argument("--plant", metavar="NAME|FILE", type=Path, help=about)
    parser.add_argument("--drone", metavar="N", type=int, help="its number in --plant where several drones follow")


if __name__ == "__main__":
    quit_on_interrupt()
    sys.exit(main())
