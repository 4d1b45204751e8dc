"""Command line of `train.py`."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import functools
import math
import os
import shlex
import statistics
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from mjxball import __version__, cli, config
from mjxball.algorithms import ALGORITHMS
from mjxball.errors import InputError, TrainingDivergedError
from mjxball.evaluate.results import RESULTS
from mjxball.evaluate.scenarios import rig_line, standard_scenarios
from mjxball.physics.step import TRAINING_ENGINES
from mjxball.policy.file import policy_path
from mjxball.terminal import say, warn
from mjxball.train import processes, shares
from mjxball.train.curves import draw_training
from mjxball.train.lock import LOCK, check_free
from mjxball.train.run_directory import (
    CHECKPOINTS,
    EXTENSIONS,
    LARGEST_SEED,
    MOST_MEMBERS,
    POLICY,
    commit,
    differences,
    file_hash,
    members_of,
    read_sweep,
    source_hash,
    start_policy,
    versions,
)
from mjxball.xla import check_address_space, compile_small_loops_whole, enable_compilation_cache

# What `--help` shows of the settings; `--help all` has the rest.
COMMON = (
    *("scenario.cg_speed", "scenario.cg_amplitude", "scenario.object_mass", "scenario.noise", "scenario.delay"),
    *("follower.action_scale_tilt", "follower.recurrent_units", "reward.kind"),
    *("sac.total_steps", "sac.num_envs", "sac.learning_rate", "ppo.total_steps", "ppo.num_envs", "ppo.learning_rate"),
    *("gradient.gradient_steps", "gradient.num_envs", "gradient.learning_rate"),
)
SECTIONS = tuple(dict.fromkeys(path.partition(".")[0] for path, _, _ in config.leaves(config.Config())))


def parser() -> cli.Parser:
    """The argument parser; configuration flags are generated from `mjxball.config`."""
    result = cli.make_parser(
        "train.py",
        usage="%(prog)s [PRESET] [FLAG ...]",
        description="Train a follower, export it to NumPy and compare it with `copy`.",
        epilog="Writes DIR/config.json, metrics.csv, checkpoints/, policy.npz and eval/. Ctrl-C saves and stops.",
        describe=_describe,
    )
    names = ", ".join(config.PRESETS)
    preset = result.add_argument("preset", nargs="?", metavar="PRESET", help=f"one of {names} (default transport)")
    vars(preset)["suggested"] = tuple(config.PRESETS)
    run = result.add_argument_group("the run")
    run.add_argument("--seed", type=int, metavar="N", help="seed of everything random (default 0)")
    about = "run directory (default runs/PRESET-<time>, with --env runs/CLASS-<time>)"
    run.add_argument("--out", type=Path, metavar="DIR", help=about)
    run.add_argument("--resume", type=Path, metavar="DIR", help="continue the run in DIR from its newest checkpoint")
    about = "train K followers at once, seeds N, N + 1 ... (default 1)"
    run.add_argument("--num-seeds", "--seeds", type=int, metavar="K", help=about)
    run.add_argument("--sweep", type=Path, metavar="FILE", help="JSON: settings with K numbers each, one a member")
    about = "begin with the weights of a policy file or shipped policy, or each member with those of a run's"
    run.add_argument("--start-from", type=policy_path, metavar="POLICY", help=about)
    about = f"one of {', '.join(ALGORITHMS)} (default sac), or MODULE:CLASS, your own"
    run.add_argument("--algorithm", metavar="NAME", help=about)
    about = "engine, mjx (default) or newton-euler, which is quicker"
    run.add_argument("--physics", choices=TRAINING_ENGINES, metavar="ENGINE", help=about)
    about = f"{', '.join(config.PLANTS)}, or a rig in TOML, JSON, MJCF or URDF (docs/howto/own-rig.md)"
    run.add_argument("--plant", type=Path, metavar="NAME|FILE", help=about)
    own = result.add_argument_group("in place of ours")
    own.add_argument("--env", metavar="MODULE:CLASS", help="train on a Brax environment of your own")
    own.add_argument("--reward", metavar="MODULE:FUNCTION", help="reward of (state, action, next state)")
    about = "start(name, settings), which returns log(row) for every row of metrics.csv: docs/howto/trackers.md"
    own.add_argument("--tracker", metavar="MODULE:FUNCTION", help=about)
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
    """See `cli.Help`: the topic is `all`, a section of the configuration or a preset, whose values are shown."""
    known = ("all", *SECTIONS, *config.PRESETS)
    if topic is not None and topic not in known:
        raise InputError(f"no help on {topic!r}; there is --help {', '.join(known)}")
    name = topic if topic in config.PRESETS else given.preset
    plant = cli.read_plant(given.plant) if given.plant else None
    name = name or (plant.preset if plant else None) or "transport"
    cli.show_defaults(parser, config.with_plant(config.preset(name), given.plant, {}))
    flown = f" on the plant {given.plant}" if given.plant else ""
    parser.epilog = (
        f"Defaults of settings are those of the preset {name}{flown}; tuples are comma-separated. "
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
    return cli.run_command(lambda: _train(options, command))


def _train(options: argparse.Namespace, command: str) -> int:
    meeting, started = _meeting(options), time.monotonic()
    if options.gather is not None:
        return _gather(options)
    check_address_space()
    # To take three quarters of a large GPU's memory at once takes 1.6 s; taken as it is needed it is as fast.
    os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")
    if options.resume is not None:
        _refuse_beside(options, "--resume continues with the run's own configuration", ())
        out, (settings, origin) = options.resume, _recorded(options.resume)
    else:
        settings, origin, out = _new_run(options, command)
    enable_compilation_cache()
    resume = options.resume is not None
    check = (lambda: None) if resume else (lambda: _output_directory(out))  # what the lock's holder may have left there
    from mjxball.train.compilation import jax_setting

    # Float32 also where JAX_ENABLE_X64 is set: a run is the same then, and can be resumed.
    with contextlib.ExitStack() as hold, jax_setting("jax_enable_x64", False):
        if meeting:
            processes.join(meeting)
        with processes.exit_when_a_process_is_lost(f"--resume {out}") if meeting else contextlib.nullcontext():
            hold.enter_context(processes.holding(out, meeting is not None, check))
            writes = not meeting or processes.is_writer()  # to ask wakes the devices, and waits
            with ThreadPoolExecutor(1) as beside:

                def prepare() -> None:
                    if writes and options.plant:
                        warn(rig_line(settings))
                    if writes and _is_evaluated(origin):
                        beside.submit(_prepare_evaluation, settings, origin["physics"])

                code = _run(settings, origin, out, resume, prepare, options.tracker)
            if meeting:
                processes.leave()
        return _finish(settings, origin, out, code, started) if writes else code or 0


def _finish(settings: config.Config, origin: dict[str, Any], out: Path, code: int | None, started: float) -> int:
    """Print and draw what came of a training that ended with `code`, see `_run`; return the exit code."""
    if code is None and (out / "eval" / RESULTS).exists():
        print(f"{out} was finished and evaluated before; nothing is left to do")
        return 0
    if code == 1:
        return code
    print(f"policy: {out / POLICY}  ({time.monotonic() - started:.0f} s)", flush=True)
    if code:
        return code
    draw_training(out, settings, out / "eval" / "training.png")
    if not _is_evaluated(origin):
        return 0
    if origin["seeds"] > 1:
        _compare_members(settings, out, origin)
    return _evaluate(settings, origin["physics"], out, out / POLICY)


def _output_directory(out: Path) -> Path:
    try:
        return cli.output_directory(out, but=(LOCK,))
    except InputError:
        check_free(out)  # whoever holds it is the better reason
        raise


def _run(
    settings: config.Config,
    origin: dict[str, Any],
    out: Path,
    resume: bool,
    beside: Callable[[], None],
    tracker: str | None = None,
) -> int | None:
    """Train; return 0, 1 if training diverged, 130 if it was interrupted, None if nothing was left to train.

    `beside` is called when everything is compiled and the device begins to train.
    """
    _wake_devices()
    # The algorithm's libraries are imported meanwhile, before anything asks for devices.
    from mjxball.train import loop, requirements
    from mjxball.train.extensions import find
    from mjxball.train.run import Run

    algorithm = (origin.get("extensions") or {}).get("algorithm") or "sac"
    find(algorithm, "--algorithm")
    told = None if tracker is None else find(tracker, "--tracker")
    if algorithm in ALGORITHMS:  # of others nobody knows what they take
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
    try:
        return 0 if loop.train(Run(settings, out, origin, state, told), beside) else 130
    except TrainingDivergedError as error:
        if processes.is_writer():
            kept = any(path.name.isdecimal() for path in (out / CHECKPOINTS).glob("*"))
            where = f"the last good policy and checkpoint are in {out}" if kept else "no checkpoint came before"
            warn(f"training diverged: {error}; {where}")
        return 1


@functools.cache
def _wake_devices() -> None:
    """Start the accelerator's runtime (2 s of waiting on a GPU) beside the imports that follow.

    Whatever ends the process waits for the thread: one that Python stops inside XLA aborts it.
    """
    import jax  # here: two threads must not both import it

    threading.Thread(target=_first_kernel, args=(jax.numpy,)).start()


def _first_kernel(xp: Any) -> None:
    with contextlib.suppress(RuntimeError, AssertionError):  # without a device; who needs one says so
        xp.zeros(1).block_until_ready()


def _meeting(options: argparse.Namespace) -> processes.Rendezvous | None:
    given = (options.coordinator, options.processes, options.process)
    if options.distributed:
        return processes.Rendezvous(*given)
    if any(value is not None for value in given):
        raise InputError("--coordinator, --processes and --process need --distributed")
    return None


def _new_run(options: argparse.Namespace, command: str) -> tuple[config.Config, dict[str, Any], Path]:
    """Configuration, origin and directory of a new run; everything that can be refused is refused here."""
    measured = cli.read_plant(options.plant).preset if options.plant else None
    name, seed = options.preset or measured or "transport", options.seed or 0
    _refuse_settings_of_others(options)
    settings = cli.apply_config_flags(config.preset(name), options)
    if not 0 <= seed <= LARGEST_SEED:
        raise InputError(f"--seed must be between 0 and {LARGEST_SEED}, not {seed}")
    for section in ALGORITHMS:
        if (units := getattr(getattr(settings, section), "activation", "relu")) != "relu":
            raise InputError(f"--{section}.activation {units}: policy files hold relu; see mjxball.train.train")
    called = options.env.rpartition(":")[2] if options.env else name
    out = _output_directory(options.out or Path("runs") / f"{called}-{time.strftime('%Y%m%d-%H%M%S')}")
    standard_scenarios(settings)
    members = 1 if options.num_seeds is None else options.num_seeds
    if not 1 <= members <= MOST_MEMBERS:
        raise InputError(f"--num-seeds must be between 1 and {MOST_MEMBERS}, not {members}")
    extensions = {name: getattr(options, name) for name in EXTENSIONS if getattr(options, name)}
    if extensions.get("algorithm") == "sac":  # the default, of which nothing is to be checked
        del extensions["algorithm"]
    physics = options.physics or "mjx"
    if extensions:
        physics = _check_extensions(extensions, settings, options.physics, bool(options.distributed))
    origin: dict[str, Any] = {
        "command": command,
        "seed": seed,
        "physics": physics,
        "seeds": members,
        "sweep": None if options.sweep is None else read_sweep(options.sweep, members, settings),
        "package_version": __version__,
        "commit": commit(),
        "source_hash": source_hash(),
        "versions": versions(),
    }
    if options.start_from is not None:
        origin["start_from"] = _start_from(options, settings, members)
    if options.share is not None:
        shares.take(origin, *shares.read(options.share))
    if extensions:
        origin |= {"extensions": extensions, "extension_hash": _digest(extensions)}
    return settings, origin, out


def _start_from(options: argparse.Namespace, settings: config.Config, members: int) -> Any:
    """Which policy file the run, or each of `members`, starts from, see `run_directory.start_policy`."""
    if (options.algorithm or "sac") != "gradient" or options.env:
        raise InputError(
            "--start-from needs --algorithm gradient and no --env: the others begin with more than a policy"
        )
    if not options.start_from.is_dir():
        return _start(options.start_from, settings)
    files = members_of(options.start_from)
    if len(files) != members:
        raise InputError(
            f"{options.start_from} has {len(files)} members and the run {members}; say --num-seeds {len(files)}"
        )
    return [_start(path, settings) for path in files]


def _start(path: Path, settings: config.Config) -> dict[str, str]:
    start = {"policy": str(path), "sha256": file_hash(path)}
    sizes = [len(bias) for bias in start_policy(start, settings).biases[:-1]]
    if sizes != list(settings.gradient.policy_layers):
        layers = ",".join(map(str, sizes))
        raise InputError(f"{path} has hidden layers {layers}; say --gradient.policy_layers {layers}")
    return start


def _digest(names: dict[str, str]) -> str | None:
    from mjxball.train.extensions import digest

    return digest(names)


def _refuse_settings_of_others(options: argparse.Namespace) -> None:
    """Refuse a setting of an algorithm of ours that is not the one which trains."""
    used = options.algorithm or "sac"
    given = [name.removeprefix("config:") for name, value in vars(options).items() if value and "config:" in name]
    for path in given:
        section = path.partition(".")[0]
        if used in ALGORITHMS and section in ALGORITHMS and section != used:
            raise InputError(
                f"--{path} is a setting of {section}, and {used} trains; drop it or say --algorithm {section}"
            )


def _check_extensions(names: dict[str, str], settings: config.Config, wanted: str | None, meeting: bool) -> str:
    """The physics engine to train on; refuses what cannot be found or does not fit, before anything is written."""
    from mjxball.train.extensions import Extensions, make_env, resolve

    extensions = resolve(Extensions(**names))
    _choose_processor(extensions.algorithm)
    if not meeting:
        _wake_devices()
    engines = getattr(extensions.algorithm, "engines", TRAINING_ENGINES)
    physics = wanted or engines[0]
    if physics not in engines:
        raise InputError(
            f"--algorithm {names['algorithm']} cannot train on --physics {physics}; it can on {', '.join(engines)}"
        )
    if not meeting:  # else the processes meet before anything asks for devices, and training makes the same check
        make_env(extensions, settings, physics)
    missing = [name for name in ("init", "collect", "update", "policy") if not hasattr(extensions.algorithm, name)]
    if extensions.algorithm is not None and missing:
        raise InputError(
            f"--algorithm {names['algorithm']} lacks {', '.join(missing)}; see docs/howto/own-algorithm.md"
        )
    return physics


def _choose_processor(algorithm: Any) -> None:
    """Train on the CPU, its small loops compiled whole, what is done there before a GPU has compiled it.

    Where JAX_PLATFORMS says otherwise it stays so.
    """
    import jax

    if not getattr(algorithm, "prefers_cpu", False):
        return
    compile_small_loops_whole()
    if not os.environ.get("JAX_PLATFORMS"):
        settings: Any = jax.config
        settings.update("jax_platforms", "cpu")


def _recorded(run: Path) -> tuple[config.Config, dict[str, Any]]:
    """Configuration and origin of the run to be continued; InputError if this program is not the one that made it."""
    from mjxball.train.run_directory import read_config

    settings, origin = read_config(run)
    changed = differences(origin)
    extensions = origin.get("extensions") or {}
    if extensions and _digest(extensions) != origin.get("extension_hash"):
        changed.append(f"{', '.join(extensions.values())} has changed")
    if extensions.get("algorithm"):
        from mjxball.train.extensions import find

        _choose_processor(find(extensions["algorithm"], "--algorithm"))
    if changed:
        raise InputError(f"{run} was made by another program and cannot be continued exactly: {'; '.join(changed)}")
    return settings, origin


def _compare_members(settings: config.Config, out: Path, origin: dict[str, Any]) -> None:
    """Print every member on the reference scenario and their median, draw them over training, and tell the card."""
    from mjxball.evaluate.policies import load_policy
    from mjxball.evaluate.results import fly_scenarios, table
    from mjxball.policy.file import load_file, save_file
    from mjxball.train.curves import POLICIES, draw_members

    policies = [load_policy(path, settings) for path in sorted((out / POLICIES).glob("*.npz"), key=_seed_of)]
    reference = standard_scenarios(settings)[-1]
    results = fly_scenarios(settings, policies, [reference], origin["physics"])
    print(table(results, reference))
    compared = ("rmse", "settling_time", "x_peak", "overshoot")
    chosen = load_file(out / POLICY)
    seeds = [int(result.follower.removeprefix("seed")) for result in results]
    spread = {name: [None if c.metrics.failed else getattr(c.metrics, name) for c in results] for name in compared}
    spread["failed"] = [result.metrics.failed for result in results]
    save_file(out / POLICY, dataclasses.replace(chosen, card={**chosen.card, "population": {"seed": seeds, **spread}}))
    for name in compared:
        values = sorted(math.inf if value is None else value for value in spread[name])
        numbers = (statistics.median(values), values[0], values[-1])
        missing = "never" if name == "settling_time" else "failed"
        middle, low, high = (missing if math.isinf(value) else f"{value:.4g}" for value in numbers)
        print(f"{name}: median {middle}, best {low}, worst {high} of {len(values)}")
    (out / "eval").mkdir(exist_ok=True)
    draw_members(out, out / "eval" / "members.png")


def _seed_of(path: Path) -> int:
    return int(path.stem.removeprefix("seed"))


def _refuse_beside(options: argparse.Namespace, why: str, but: tuple[str, ...]) -> None:
    """InputError that begins with `why` if something is given that makes a new run, `but` those."""
    given = [f"--{name[7:]}" for name, value in vars(options).items() if name.startswith("config:") and value]
    own = ("out", "seed", "num_seeds", "sweep", "share", "physics", "plant", "start_from", *EXTENSIONS)
    given += [f"--{name.replace('_', '-')}" for name in own if name not in but and getattr(options, name) is not None]
    given += [options.preset] if options.preset else []
    if given:
        raise InputError(f"{why}; drop {', '.join(given)}")


def _gather(options: argparse.Namespace) -> int:
    """Bring the parts of a population together and compare its members, as a run of all of them would."""
    _refuse_beside(options, "--gather takes runs as they are", ("out",))
    if options.resume or options.distributed or options.out is None:
        raise InputError("--gather RUN ... needs --out DIR, a new directory, and neither --resume nor --distributed")
    _output_directory(options.out)
    settings, origin = shares.gather(options.gather, options.out)
    say(f"gathered {origin['seeds']} members; the best is {options.out / POLICY}")
    _compare_members(settings, options.out, origin)
    return _evaluate(settings, origin["physics"], options.out, options.out / POLICY)


def _is_evaluated(origin: dict[str, Any]) -> bool:
    """Whether what was trained is compared with `copy`: that and the standard scenarios are for ours alone."""
    return not (origin.get("extensions") or {}).get("env")


def _prepare_evaluation(settings: config.Config, physics: str) -> None:
    """Import and compile what `_evaluate` needs, while the device trains: on two cores it then begins at once."""
    import jax

    from mjxball.baselines import make_baseline
    from mjxball.plotting import pyplot
    from mjxball.sim.rollout import simulate_batch

    if jax.default_backend() != "cpu":
        return  # a GPU trains for so short a time that this would only delay its host
    pyplot()
    period = settings.timing.control_period
    scenarios = [dataclasses.replace(one, seconds=period) for one in standard_scenarios(settings)]
    copies = [make_baseline("copy", settings) for _ in range(2)]  # as many flights as it will be
    simulate_batch(settings, [(copy, scenarios) for copy in copies], physics)


def _evaluate(settings: config.Config, physics: str, out: Path, policy: Path) -> int:
    """Compare the exported policy with `copy` on its own plant and physics; figures go to DIR/eval."""
    from mjxball.baselines import make_baseline
    from mjxball.evaluate.plots import write_results
    from mjxball.evaluate.policies import check_bounds, load_policy
    from mjxball.evaluate.results import fly_scenarios, table

    scenarios = standard_scenarios(settings)
    trained = load_policy(policy, settings)
    results = fly_scenarios(settings, [make_baseline("copy", settings), trained], scenarios, physics)
    print(table(results, scenarios[-1]))
    write_results(results, out / "eval")
    reference = next(
        result for result in results if result.follower == trained.name and result.scenario == scenarios[-1]
    )
    misses = check_bounds(trained, reference.metrics)
    verdict = "meets the bounds of its card" if not misses else f"misses its bounds: {'; '.join(misses)}"
    say(f"{policy} {verdict}; figures in {out / 'eval'}")
    return 0
