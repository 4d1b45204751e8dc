"""Command line of `train.py`."""

from __future__ import annotations

import argparse
import contextlib
import os
import shlex
import sys
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mjxball import cli, config, running
from mjxball.algorithms import ALGORITHMS
from mjxball.commands.compare import compare, compare_members, compile_ahead, is_evaluated
from mjxball.commands.new_run import (
    check_packages,
    clean_up_unless_begun,
    new_run,
    output_directory,
    recorded,
    refuse_new_run_options,
    wake_devices,
)
from mjxball.errors import InputError, TrainingDivergedError
from mjxball.evaluate.results import RESULTS
from mjxball.evaluate.scenarios import rig_summary
from mjxball.physics.step import TRAINING_ENGINES
from mjxball.policy.file import policy_path
from mjxball.terminal import Working, say, warn
from mjxball.train import processes, shares
from mjxball.train.curves import plot_training
from mjxball.train.run_directory import CHECKPOINTS, POLICY
from mjxball.xla import check_address_space, enable_compilation_cache

if TYPE_CHECKING:
    from mjxball.commands.watch import Watch
    from mjxball.train.run import Run

# Settings that `--help` lists; `--help all` lists every one.
COMMON = (
    *("scenario.cg_speed", "scenario.cg_amplitude", "scenario.object_mass", "scenario.noise", "scenario.delay"),
    *("follower.action_scale_tilt", "follower.recurrent_units", "reward.kind"),
    *("sac.total_steps", "sac.num_envs", "sac.learning_rate", "ppo.total_steps", "ppo.num_envs", "ppo.learning_rate"),
    *("gradient.gradient_steps", "gradient.num_envs", "gradient.learning_rate"),
)
SECTIONS = tuple(dict.fromkeys(path.partition(".")[0] for path, _, _ in config.leaves(config.Config())))


def parser() -> cli.Parser:
    """Argument parser of `train.py`. Flags of settings are generated from `mjxball.config`."""
    result = cli.make_parser(
        "train.py",
        usage="%(prog)s [PRESET] [FLAG ...]",
        description="Train a follower, export it to NumPy and compare it with `copy`.",
        epilog="Writes DIR/config.json, metrics.csv, checkpoints/, policy.npz and eval/. Ctrl-C saves and stops.",
        describe=_describe,
    )
    about = "\n\n".join(f"{name}: {text}" for name, text in config.PRESETS_ABOUT.items())
    about = f"default quick; with SAC or PPO transport\n\n{about}"
    preset = result.add_argument("preset", nargs="?", metavar="PRESET", help=about)
    vars(preset)["suggested"] = tuple(config.PRESETS)
    run = result.add_argument_group("the run")
    run.add_argument("--seed", type=int, metavar="N", help="seed of everything random (default 0)")
    about = "run directory (default runs/PRESET-<time>, with --env runs/CLASS-<time>)"
    run.add_argument("--out", type=Path, metavar="DIR", help=about)
    run.add_argument("--resume", type=Path, metavar="DIR", help="continue the run in DIR from its newest checkpoint")
    about = "train for M minutes since the start of the command, in place of as many steps as the settings say"
    run.add_argument("--minutes", type=float, metavar="M", help=about)
    about = "train K followers at once, seeds N, N + 1 ... (default 1)"
    run.add_argument("--num-seeds", "--seeds", type=int, metavar="K", help=about)
    run.add_argument("--sweep", type=Path, metavar="FILE", help="JSON: settings with K numbers each, one a member")
    about = "begin with the weights of a policy file or shipped policy, or each member with those of a run's"
    run.add_argument("--start-from", type=policy_path, metavar="POLICY", help=about)
    by = [name for name in config.PRESETS if config.algorithm_of(name) == "sac"]
    about = (
        f"one of {', '.join(ALGORITHMS)} (default: sac for {', '.join(by)}, else gradient), or MODULE:CLASS, your own"
    )
    run.add_argument("--algorithm", metavar="NAME", help=about)
    about = "engine, mjx (default; SAC and PPO) or newton-euler, which is quicker (gradients: always)"
    run.add_argument("--physics", choices=TRAINING_ENGINES, metavar="ENGINE", help=about)
    about = f"{', '.join(config.PLANTS)}, or a rig in TOML, JSON, MJCF or URDF (docs/howto/own-rig.md)"
    run.add_argument("--plant", type=Path, metavar="NAME|FILE", help=about)
    extensions = result.add_argument_group("in place of ours")
    extensions.add_argument("--env", metavar="MODULE:CLASS", help="train on a Brax environment of your own")
    extensions.add_argument("--reward", metavar="MODULE:FUNCTION", help="reward of (state, action, next state)")
    about = "start(name, settings), which returns log(row) for every row of metrics.csv: docs/howto/trackers.md"
    extensions.add_argument("--tracker", metavar="MODULE:FUNCTION", help=about)
    parts = result.add_argument_group("a population in parts")
    about = "train the I-th of N equal parts of --num-seeds and --sweep, I = 0 .. N - 1"
    parts.add_argument("--share", metavar="I/N", help=about)
    about = "bring the runs of all parts together in --out DIR and compare their members"
    parts.add_argument("--gather", type=Path, nargs="+", metavar="RUN", help=about)
    several = result.add_argument_group("several processes")
    several.add_argument("--distributed", action="store_true", help="train with the other processes of this job")
    several.add_argument("--coordinator", metavar="HOST:PORT", help="where process 0 is reached, if nothing tells it")
    several.add_argument("--processes", type=int, metavar="N", help="how many there are, with --coordinator")
    several.add_argument("--process", type=int, metavar="I", help="this process's number, 0 .. N - 1")
    cli.add_config_flags(result)
    return result


def _describe(parser: cli.Parser, given: argparse.Namespace, topic: str | None) -> set[str] | None:
    """Flags that `--help TOPIC` lists, None for all (see `cli.Help`).

    The topic is `all`, a section of the configuration, or a preset, whose values are then the defaults shown.
    """
    known = ("all", *SECTIONS, *config.PRESETS)
    if topic is not None and topic not in known:
        raise InputError(f"no help on {topic!r}; there is --help {', '.join(known)}")
    name = topic if topic in config.PRESETS else given.preset
    plant = cli.read_plant(given.plant) if given.plant else None
    name = name or (plant.preset or "transport" if plant else "quick")
    cli.show_defaults(parser, config.with_plant(config.preset(name), given.plant, {}))
    on_plant = f" on the plant {given.plant}" if given.plant else ""
    parser.epilog = (
        f"Defaults of settings are those of the preset {name}{on_plant}; tuples are comma-separated. "
        f"All settings: --help all, or of one section: --help {', '.join(SECTIONS)}. {parser.epilog}"
    )
    if topic == "all":
        return None
    flags = {flag for action in parser._actions for flag in action.option_strings if "." not in flag}
    if topic in SECTIONS:
        return {f"--{path}" for path, _, _ in config.leaves(config.preset(name)) if path.startswith(f"{topic}.")}
    return {"preset", *flags, *(f"--{path}" for path in COMMON)}


def main(arguments: list[str] | None = None) -> int:
    """Train, export, evaluate; return the exit code."""
    options = parser().parse_args(arguments)
    command = shlex.join(["python", "train.py", *(sys.argv[1:] if arguments is None else arguments)])
    return running.run_command(lambda: _train(options, command))


def _train(options: argparse.Namespace, command: str) -> int:
    rendezvous, started = _rendezvous(options), time.monotonic()
    check_packages()
    if options.gather is not None:
        return _gather(options)
    check_address_space()
    # Preallocating three quarters of a large GPU's memory takes 1.6 s. Allocation on demand trains as fast.
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    if options.resume is not None:
        refuse_new_run_options(options, "--resume continues with the run's own configuration", ())
        out, (settings, origin) = options.resume, recorded(options.resume)
    else:
        settings, origin, out = new_run(options, command)
    enable_compilation_cache()
    resume = options.resume is not None
    # Checked again under the lock: another run may have written there since.
    check = (lambda: None) if resume else (lambda: output_directory(out))
    from mjxball.train.compilation import jax_setting

    watches: list[Watch] = []
    # Float32 even if JAX_ENABLE_X64 is set, so that a run is reproducible and can be resumed.
    with contextlib.ExitStack() as hold, jax_setting("jax_enable_x64", False):
        if rendezvous:
            processes.join(rendezvous)
        with processes.exit_when_a_process_is_lost(f"--resume {out}") if rendezvous else contextlib.nullcontext():
            hold.enter_context(processes.holding(out, rendezvous is not None, check))
            writes = not rendezvous or processes.is_writer()  # `is_writer` waits until the devices have started
            # A run of several processes of which one is lost is continued with --resume, so its files stay.
            undone = () if resume or not writes else InputError if rendezvous else Exception
            begun = hold.enter_context(clean_up_unless_begun(out, undone))
            with ThreadPoolExecutor(1) as pool:

                def prepare() -> None:
                    begun()
                    if writes and options.plant:
                        warn(rig_summary(settings))
                    if writes and is_evaluated(origin):
                        pool.submit(compile_ahead, settings, origin["physics"])

                def watch(run: Run) -> None:
                    if is_evaluated(origin) and origin["seeds"] == 1 and not rendezvous:
                        watches.extend(_watched(run, started))

                code = _run(settings, origin, out, resume, (watch, prepare), options.tracker, started)
            if rendezvous:
                processes.leave()
        return _finish(settings, origin, out, code, started, watches) if writes else code or 0


def _watched(run: Run, began: float) -> list[Watch]:
    """The watch of a run, which it starts; none where the benchmark has no flights for its settings."""
    from mjxball.bench.quick import quick_track
    from mjxball.commands.watch import Watch

    track = quick_track(run.config)
    if track is None:
        return []
    run.on_evaluated = found = Watch(track, began, run.progress.say)
    run.on_traced = found.start
    return [found]


def _finish(
    settings: config.Config,
    origin: dict[str, Any],
    out: Path,
    code: int | None,
    started: float,
    watches: Sequence[Watch],
) -> int:
    """Report a training that ended with `code` (see `_run`) and evaluate its policy; return the exit code."""
    if code is None and (out / "eval" / RESULTS).exists():
        print(f"{out} was finished and evaluated before; nothing is left to do")
        return 0
    if code == 1:
        return code
    print(f"policy: {out / POLICY}  ({time.monotonic() - started:.0f} s)", flush=True)
    if code:
        say(f"stopped, with exit code {code}; python train.py --resume {shlex.quote(str(out))} continues")
        return code
    plot_training(out, settings, out / "eval" / "training.png")
    if not is_evaluated(origin):
        return 0
    if origin["seeds"] > 1:
        compare_members(settings, out, origin)
    code = compare(settings, origin["physics"], out, out / POLICY)
    for watched in watches:
        from mjxball.commands.watch import write

        with Working("flying the follower in flights of the benchmark"):
            watched.end()
        if watched.points:
            print(write(watched, out / "eval"))
    return code


def _run(
    settings: config.Config,
    origin: dict[str, Any],
    out: Path,
    resume: bool,
    on: tuple[Callable[[Run], None], Callable[[], None]],
    tracker: str | None,
    began: float,
) -> int | None:
    """Train; return 0, 1 if training diverged, 130 if it was interrupted, None if nothing was left to train.

    `on`: what is called with the run before it starts, and when everything is compiled and the device begins to train.
    `began`: when the command did.
    """
    wake_devices()
    # The algorithm's libraries are imported while the devices start.
    from mjxball.train import loop, requirements
    from mjxball.train.extensions import find
    from mjxball.train.run import Run

    algorithm = (origin.get("extensions") or {}).get("algorithm") or "sac"
    find(algorithm, "--algorithm")
    start = None if tracker is None else find(tracker, "--tracker")
    if algorithm in ALGORITHMS:  # the memory that other algorithms need is unknown
        requirements.check(settings, algorithm, origin["seeds"])
    state = None
    if resume:
        from mjxball.train.checkpoint import restore_state

        state, total = restore_state(out, settings, origin)
        steps = 0 if state is None else int(np.ravel(state.steps)[0])
        if processes.is_writer():
            warn(f"continuing {out} after {steps:,} of {total:,} steps")
        if steps >= total:
            return None
    run, (on_made, on_start) = Run(settings, out, origin, state, start, began), on
    on_made(run)
    try:
        return 0 if loop.train(run, on_start) else 130
    except TrainingDivergedError as error:
        if processes.is_writer():
            saved = any(path.name.isdecimal() for path in (out / CHECKPOINTS).glob("*"))
            where = f"the last good policy and checkpoint are in {out}"
            if not saved:
                (out / POLICY).unlink(missing_ok=True)  # the untrained network
                where = "no checkpoint came before, so there is no policy; a reward that is not finite does this"
            warn(f"training diverged: {error}; {where}")
        return 1


def _rendezvous(options: argparse.Namespace) -> processes.Rendezvous | None:
    """The rendezvous of a distributed run; None for a run of one process."""
    given = (options.coordinator, options.processes, options.process)
    if options.distributed:
        return processes.Rendezvous(*given)
    if any(value is not None for value in given):
        raise InputError("--coordinator, --processes and --process need --distributed")
    return None


def _gather(options: argparse.Namespace) -> int:
    """Join the runs of a population's parts and compare its members, as one run of all would do."""
    refuse_new_run_options(options, "--gather takes runs as they are", ("out",))
    if options.resume or options.distributed or options.out is None:
        raise InputError("--gather RUN ... needs --out DIR, a new directory, and neither --resume nor --distributed")
    output_directory(options.out)
    settings, origin = shares.gather(options.gather, options.out)
    say(f"gathered {origin['seeds']} members; the best is {options.out / POLICY}")
    compare_members(settings, options.out, origin)
    return compare(settings, origin["physics"], options.out, options.out / POLICY)
