"""Export a follower, `python -m mjxball.export POLICY|RUN OUT`, or a flight log, `python -m mjxball.export LOG OUT`.

Of a policy file, or a run's newest checkpoint, OUT ends in .npz (policy file), .onnx (ONNX model) or .h (C99 header);
see docs/policy-file.md. With --crazyflie it is a new directory of apps for both drones; see docs/onboard.md. Of a
flight log, .jsonl, a bag or cfclient's folder, it ends in .mcap (ROS 2 messages; of .jsonl alone), .csv or .parquet;
see docs/flight-log.md.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable
from pathlib import Path

from mjxball import config as configs
from mjxball.cli import make_parser, output_file, plant_setup, quit_on_interrupt, run_command
from mjxball.errors import InputError
from mjxball.files import write_whole
from mjxball.policy import team
from mjxball.policy.file import PolicyFile, load_file, policy_path, save_file
from mjxball.terminal import warn


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


def in_team(policy: PolicyFile, name: str, plant: Path | None, drone: int | None = None) -> PolicyFile:
    """`policy.team.in_team` on the plant file `plant`."""
    return team.in_team(policy, name, None if plant is None else plant_setup(plant), drone)


def _write_onnx(out: Path, policy: PolicyFile) -> None:
    from mjxball.policy.formats.onnx_model import onnx_model

    write_whole(out, onnx_model(policy, out.stem).SerializeToString())


def _save_rounded(out: Path, policy: PolicyFile) -> None:
    from mjxball.policy.quantize import quantized

    save_file(out, quantized(policy))


def _write_header(out: Path, policy: PolicyFile, int8: bool = False) -> None:
    from mjxball.policy.formats.c_header import c_header

    write_whole(out, c_header(policy, out.stem, int8).encode("ascii"))


Writer = Callable[[Path, PolicyFile], None]
WRITERS: dict[str, Writer] = {".npz": save_file, ".onnx": _write_onnx, ".h": _write_header}
ROUNDED: dict[str, Writer] = {".npz": _save_rounded, ".h": functools.partial(_write_header, int8=True)}  # with --int8


def export(
    source: Path,
    out: Path,
    crazyflie: bool = False,
    int8: bool = False,
    plant: Path | None = None,
    drone: int | None = None,
) -> None:
    """Export `source` to the new file `out`, in the format that its ending names; raise InputError if that fails.

    `crazyflie`: to the new directory `out`, as apps for both drones. `int8`: weights of 8 bits in an app or a header,
    floats rounded to them in a policy file. `plant`, `drone`: see `in_team`; a policy file need not be told them.
    Apps of a policy for any rig are for the plant `crazyflie` by default.
    """

    def policy() -> PolicyFile:
        found = contents_of(source)
        return found if untold else in_team(found, source.stem, plant, drone)

    untold = out.suffix == ".npz" and not crazyflie and plant is None and drone is None
    if crazyflie:
        from mjxfly.app.generate import check_place, write_app

        check_place(out)
        if plant is None and team.is_for_any(contents_of(source).card):
            plant = team.CRAZYFLIES
        drones = 2 if plant is None else plant_setup(plant).plant.count
        if drones != 2:
            raise InputError(f"an app is for pairs of Crazyflies, and {plant} has {drones} drones")
        write_app(policy(), source.stem, out, int8)
        return
    if int8 and out.suffix not in ROUNDED:
        raise InputError("--int8 is for --crazyflie, or for an output file that ends in .h or .npz")
    if out.suffix not in WRITERS:
        raise InputError(f"output file {out} must end in {', '.join(WRITERS)}, which chooses the format")
    output_file(out, out.suffix)
    (ROUNDED if int8 else WRITERS)[out.suffix](out, policy())


def export_log(log: Path, out: Path) -> list[str]:
    """Export the flight log `log` to the new file `out`; returns what a reader should know. Raises InputError."""
    from mjxfly.log_export import WRITERS as OF_LOGS

    if out.suffix not in OF_LOGS:
        raise InputError(
            f"output file {out} of a flight log must end in {', '.join(OF_LOGS)}, which chooses the format"
        )
    return OF_LOGS[out.suffix](output_file(out, out.suffix), log)


def main(arguments: list[str] | None = None) -> int:
    """Command line of `python -m mjxball.export`."""
    about, formats = __doc__.split("\n\n")
    parser = make_parser("python -m mjxball.export", about, epilog=formats)
    about_source = "policy file, name of a shipped one, run directory of train.py, flight log, or bag"
    parser.add_argument("source", metavar="POLICY|RUN|LOG", type=policy_path, help=about_source)
    parser.add_argument("out", metavar="OUT", type=Path, help="file to write, whose ending says what; must not exist")
    parser.add_argument("--crazyflie", action="store_true", help="OUT is a directory: apps for a pair of Crazyflies")
    parser.add_argument("--int8", action="store_true", help="weights of 8 bits; .npz: rounded to them")
    plants = f"{', '.join(configs.PLANTS)}, or a rig in TOML, JSON, MJCF or URDF"
    about = f"team in which a policy flies that has to be told: {plants}"
    parser.add_argument("--plant", metavar="NAME|FILE", type=Path, help=about)
    parser.add_argument("--drone", metavar="N", type=int, help="its number in --plant where several drones follow")
    options = parser.parse_args(arguments)

    def command() -> int:
        from mjxfly.log_import import is_recording

        if options.source.suffix == ".jsonl" or is_recording(options.source):
            if options.crazyflie or options.int8 or options.plant or options.drone is not None:
                raise InputError("a flight log takes no other flag")
            for remark in export_log(options.source, options.out):
                warn(f"note: {remark}")
            print(options.out)  # noqa: T201
            return 0
        export(options.source, options.out, options.crazyflie, options.int8, options.plant, options.drone)
        print(options.out)  # noqa: T201
        return 0

    return run_command(command)


if __name__ == "__main__":
    quit_on_interrupt()
    sys.exit(main())
