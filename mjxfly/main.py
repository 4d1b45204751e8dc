"""Command line of `python -m mjxfly`: fly a policy with two Crazyflies, or rehearse it with their twin."""

from __future__ import annotations

import argparse
import contextlib
import importlib.util
import math
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from mjxball import cli, terminal
from mjxball.control.crazyflie import PairGains
from mjxball.errors import InputError
from mjxball.policy import policy_name, policy_path
from mjxball.policy.formats.c_header import weight_bytes
from mjxball.running import run_command
from mjxfly import app_flight, clock, limits
from mjxfly.app import generate
from mjxfly.classical import NAMES as CLASSICAL
from mjxfly.classical import PLANT, is_classical
from mjxfly.controller import FlightController
from mjxfly.crazyswarm import CrazyswarmPair, read_pair
from mjxfly.display import live_view
from mjxfly.limits import FlightSettings, Limits
from mjxfly.mocap import KINDS, MocapSettings, ready
from mjxfly.mount_modes import add_mount_options, mount_of
from mjxfly.parameters import check_mount, check_parameters
from mjxfly.policy_setup import (
    UNKNOWN_MASS,
    ThrustOptions,
    drone_of,
    goal_of,
    is_crazyflie,
    limits_of,
    load_follower,
    load_policy,
    motor_of,
    times_of,
    variants,
)
from mjxfly.preflight import Preflight, read_gains
from mjxfly.rehearsal import Rehearsal
from mjxfly.session import FlightSetup, fly
from mjxfly.setpoints import CURVE_NAMES
from mjxfly.telemetry import Rig
from mjxfly.twin.conditions import (
    FAULT_KINDS,
    POSE_FAULTS,
    BodyFault,
    DroneFaults,
    add_twin_options,
    check_simple,
    check_surroundings,
    read_fault,
    twin_arguments,
)
from mjxfly.uri import HERE, Udp, Uri, check_pair, parse_uri, share_dongle

SLOW = ("slow", 1.0, clock.SLOWEST)
# Flags with their bounds: battery, and the rehearsal's link.
LINK = (("battery", 2.5, 4.2), ("loss", 0.0, 1.0), ("delay", 0.0, 2.0), ("jitter", 0.0, 2.0))
IMPAIRMENTS = {  # impairments of the link once the motors turn: cflib connects over a good link only
    "loss": "share of lost datagrams",
    "delay": "seconds that each is late",
    "jitter": "seconds more, at random",
}


# Flags that only `--help all` lists, besides those of the groups `twin` and `thrust`.
RARE = {"--upload", "--mocap-rate", "--mocap-std", "--mocap-option"}


def make_parser() -> cli.Parser:
    """The parser of the command line. A flag that is None has the value of the policy's configuration."""
    rare = set(RARE)

    def common(parser: cli.Parser, _: argparse.Namespace, topic: str | None) -> set[str] | None:
        if topic == "all":
            return None
        parser.epilog = "Defaults are in brackets. --help all has the twin's faults and surroundings, and rare flags."
        every = {flag for action in parser._actions for flag in action.option_strings}
        return {"policy", *every} - rare

    about = "Fly a follower with two Crazyflies, or rehearse it with their software twin."
    usage = "%(prog)s FOLLOWER --leader URI --follower URI [FLAG ...]\n       %(prog)s FOLLOWER --rehearse [FLAG ...]"
    parser = cli.make_parser("python -m mjxfly", about, usage=usage, describe=common)
    policy = f"the follower: a policy file, a shipped one's name, or {', '.join(CLASSICAL)}, which need no file"
    parser.add_argument("policy", type=policy_path, metavar="FOLLOWER", help=policy)

    add = parser.add_argument_group("the drones").add_argument
    add("--leader", metavar="URI", help="radio://0/80/2M/E7E7E7E7E7 or udp://127.0.0.1:19850")
    add("--follower", metavar="URI", help="likewise, on a dongle of its own if there are two")
    about = "links and parameters of two robots of a Crazyswarm2 file; --leader and --follower then are names in it"
    add("--crazyflies", type=Path, metavar="FILE.yaml", help=about)
    about = f"the rig that {', '.join(CLASSICAL)} know: a shipped plant or a file ({PLANT})"
    add("--plant", type=Path, metavar="NAME|FILE", help=about)
    add("--rehearse", action="store_true", help="fly the software twin; its ports are the URIs', if given")
    add("--slow", type=float, metavar="FACTOR", help="--rehearse: on a clock so many times slower than real time (1)")
    add("--dry-run", action="store_true", help="connect, log, send zeros only; nothing is armed")

    add = parser.add_argument_group("the flight").add_argument
    add("--seconds", type=float, default=20.0, metavar="S", help="time under both controllers before landing (20)")
    about = "of O from its start, m (0 0 0.4; a stand: 0 0 0.08)"
    add("--goal", type=float, nargs=3, metavar=("X", "Y", "Z"), help=about)
    add("--battery", type=float, metavar="V", help="land below it (3.2; 3.35 for the brushless)")
    about = "write all to this new file, JSON lines or .mcap (flight-DATE.jsonl; none for --rehearse)"
    add("--log", type=Path, metavar="FILE", help=about)
    about = "a live page of the log, for a browser on this machine (a free port)"
    add("--view", type=int, nargs="?", const=0, metavar="PORT", help=about)
    add("--foxglove", type=int, metavar="PORT", help="--view: for Foxglove too, on this machine alone")
    about = "the controllers run on the drones (docs/hardware.md); --rehearse: the app's C, with these weights"
    add("--onboard", nargs="?", const="float32", choices=("float32", "int8"), help=about)
    add("--upload", action="store_true", help="--onboard int8: put the policy's weights into the follower's app first")

    _add_mocap(parser.add_argument_group("motion capture"))
    thrust = parser.add_argument_group("thrust and firmware")
    _add_firmware(thrust)

    twin = parser.add_argument_group("faults and surroundings of the twin")
    kinds = ", ".join(FAULT_KINDS)
    about = f"--rehearse: after S seconds with motors on; may be repeated: {kinds}"
    twin.add_argument("--fault", action="append", default=[], metavar="KIND:DRONE@S", help=about)
    for name, _, high in LINK[1:]:
        about = f"--rehearse: {IMPAIRMENTS[name]}, up to {high:g}"
        twin.add_argument(f"--{name}", type=float, metavar="X", help=about)
    add_twin_options(twin)
    rare.update(flag for group in (thrust, twin) for action in group._group_actions for flag in action.option_strings)
    return parser


def _add_firmware(group: argparse._ArgumentGroup) -> None:
    add = group.add_argument
    about = "JSON of firmware parameters to upload, for both drones or each, over the policy's"
    add("--gains", type=Path, metavar="FILE", help=about)
    about = "m (g + az) through the force curve, or the paper's HOVER + 1000 az (the policy's)"
    add("--thrust", choices=("calibrated", "paper"), help=about)
    add("--hover", type=float, metavar="UNITS", help="--thrust paper: thrust at hover (the policy's)")
    add("--curve", choices=CURVE_NAMES, help="force curve of the firmware (found by itself)")
    add("--mass", type=float, metavar="KG", help="--thrust calibrated: total mass (the policy's)")
    add_mount_options(group)


def _add_mocap(group: argparse._ArgumentGroup) -> None:
    add = group.add_argument
    add("--mocap", choices=KINDS, metavar="KIND", help=f"forward poses from: {', '.join(KINDS)}")
    add("--mocap-host", metavar="HOST", help="--mocap: its server; optitrack: as numbers")
    add("--bodies", nargs=2, metavar=("LEADER", "FOLLOWER"), help="--mocap: names of the rigid bodies")
    about = "--mocap: poses a second to each drone, 50 to 100 (100; on a shared dongle 50)"
    add("--mocap-rate", type=float, metavar="HZ", help=about)
    about = "--mocap: deviations of a pose for the estimators (0.01 0.05)"
    add("--mocap-std", type=float, nargs=2, metavar=("M", "RAD"), help=about)
    about = "--mocap: more for this kind, such as port=22222; may be repeated"
    add("--mocap-option", action="append", default=[], metavar="KEY=VALUE", help=about)


def mocap_settings(options: argparse.Namespace, links: Sequence[Uri]) -> MocapSettings | None:
    """Settings of motion capture for the drones at `links`, None without --mocap. Raises InputError."""
    if options.mocap is None:
        for name in ("mocap_host", "bodies", "mocap_rate", "mocap_std", "mocap_option"):
            if getattr(options, name):
                raise InputError(f"--{name.replace('_', '-')} needs --mocap KIND")
        return None
    if options.rehearse:
        raise InputError("--mocap is for drones that the cameras see: leave it out with --rehearse")
    if options.mocap_host is None and options.mocap != "mock":
        raise InputError(f"--mocap {options.mocap} needs --mocap-host HOST")
    if options.bodies is None:
        raise InputError("--mocap needs --bodies LEADER FOLLOWER, the names of the two rigid bodies")
    if options.bodies[0] == options.bodies[1]:
        raise InputError("--bodies names one body for both drones")
    # 400 packets a second would saturate a shared dongle.
    rate = options.mocap_rate or (50.0 if share_dongle(links) else 100.0)
    if not 50 <= rate <= 100:
        raise InputError(f"--mocap-rate must be 50 to 100, not {rate:g}")
    deviation = tuple(options.mocap_std or MocapSettings.deviation)
    if not all(1e-4 <= value <= 1 for value in deviation):
        raise InputError("--mocap-std must be two numbers of 0.0001 to 1")
    pairs = [text.partition("=") for text in options.mocap_option]
    for text, (key, sign, _) in zip(options.mocap_option, pairs, strict=True):
        if not key or not sign:
            raise InputError(f"--mocap-option {text} is no KEY=VALUE")
    more = {key: value for key, _, value in pairs}
    bodies = (options.bodies[0], options.bodies[1])
    return MocapSettings(options.mocap, options.mocap_host or "", bodies, rate, (deviation[0], deviation[1]), more)


def crazyflies(options: argparse.Namespace) -> CrazyswarmPair | None:
    """The pair of --crazyflies; its URIs and rigid bodies are entered in `options`. Raises InputError."""
    if options.crazyflies is None:
        return None
    if options.rehearse:
        raise InputError("--crazyflies names drones to fly: leave it out with --rehearse")
    pair = read_pair(options.crazyflies, options.leader, options.follower)
    options.leader, options.follower = pair.uris
    options.bodies = options.bodies or (pair.bodies if options.mocap else None)
    return pair


def parameters_of(options: argparse.Namespace, swarm: CrazyswarmPair | None) -> list[tuple[Path, PairGains]]:
    """(file, its firmware parameters) in order of increasing precedence. Raises InputError."""
    found = [] if swarm is None else [(swarm.path, swarm.parameters)]
    return found + ([(options.gains, read_gains(options.gains))] if options.gains else [])


def check_options(options: argparse.Namespace) -> list[Uri]:
    """The drones' links that are given by URI. Raises InputError for invalid flags."""
    if importlib.util.find_spec("cflib") is None:
        raise InputError("cflib is not installed; pip install 'mjxball[fly]'")
    links: list[Uri] = []
    for flag in limits.NAMES:
        uri = getattr(options, flag)
        if uri is None and not options.rehearse:
            raise InputError(f"--{flag} URI is needed, or --rehearse to fly the software twin")
        links += [parse_uri(uri, f"--{flag}")] if uri is not None else []
        if uri is not None and options.rehearse and not (isinstance(links[-1], Udp) and links[-1].host == HERE):
            raise InputError(f"--{flag} {uri}: the twin of --rehearse answers at udp://{HERE}:PORT only")
    if len(links) == 2:
        check_pair(links[0], links[1])
    for name, low, high in (("seconds", 0.0, 3600.0), ("hover", 10001.0, 60000.0), ("mass", 1e-3, 10.0), SLOW, *LINK):
        value = getattr(options, name)
        if value is not None and not low <= value <= high:
            raise InputError(f"--{name} must be {low:g} to {high:g}, not {value:g}")
    if options.goal is not None and not all(math.isfinite(value) for value in options.goal):
        raise InputError("--goal must be three finite numbers")
    if options.log is not None:
        check_log(options.log, viewed=options.view is not None)
    check_view(options)
    return links


def check_view(options: argparse.Namespace) -> None:
    """Raise InputError if --view or --foxglove cannot be used."""
    if options.view is not None and ((options.rehearse and options.log is None) or not 0 <= options.view <= 65535):
        raise InputError("--view takes a port of 1 to 65535, or none, and shows what is logged: it needs --log FILE")
    if options.foxglove is not None and (options.view is None or not 0 <= options.foxglove <= 65535):
        raise InputError("--foxglove takes a port of 1 to 65535, or 0 for a free one, and goes with --view")


def check_log(log: Path, viewed: bool) -> None:
    """Raise InputError if the new file `log` cannot be written, or cannot be `viewed` live."""
    if log.exists():
        raise InputError(f"log file {log} exists; choose another name")
    if log.suffix not in (".jsonl", ".mcap"):
        raise InputError(f"log file {log} must end in .jsonl or .mcap; mjxfly.log makes other formats of it")
    if not log.absolute().parent.is_dir():
        raise InputError(f"the directory of log file {log} does not exist")
    if log.suffix == ".mcap":
        try:
            importlib.import_module("mcap_ros2.writer")  # with what it needs itself
        except ImportError:
            raise InputError("a log in MCAP needs mcap-ros2-support; pip install 'mjxball[fly]'") from None
    if log.suffix == ".mcap" and viewed:
        raise InputError("--view follows a log of JSON lines: --log FILE.jsonl")


def check_twin_options(options: argparse.Namespace) -> None:
    """Raise InputError for invalid flags of a rehearsal or of --onboard."""
    own = [f"--{name}" for name in (*IMPAIRMENTS, "fault", "slow") if getattr(options, name)]
    given = [*own, *twin_arguments(options)]
    if given and not options.rehearse:
        raise InputError(f"{given[0]} is for --rehearse only")
    if options.upload and options.onboard != "int8":
        raise InputError("--upload takes weights of 8 bits: --onboard int8 --upload")
    if options.onboard and options.mocap:
        raise InputError("--onboard cannot show that the axes of --mocap are right: leave one of them out")
    check_surroundings(options)
    for fault in options.fault:
        what = read_fault(fault).what
        if isinstance(what, DroneFaults) and what.peer_silent and not options.onboard:
            raise InputError(f"--fault {fault} is for --onboard: else no drone hears the other")
        if isinstance(what, BodyFault) and what.what in POSE_FAULTS and options.twin_deck == "no":
            raise InputError(f"--fault {fault} is of the deck's poses, which --twin-deck no takes away")


def rehearsed_options(options: argparse.Namespace) -> list[str]:
    """The twin's flags that name the pair: ports, policy, apps."""
    ports = [uri.rsplit(":", 1)[1] if uri else "0" for uri in (options.leader, options.follower)]
    pair = ["--ports", *ports, "--policy", str(options.policy)]
    pair += ["--plant", str(options.plant)] if options.plant is not None else []
    pair += ["--onboard", options.onboard] if options.onboard else []
    return pair


def twin_options(options: argparse.Namespace) -> list[str]:
    """The twin's flags for link, faults, drones and surroundings."""
    worse = [f"--{name}={getattr(options, name)}" for name in IMPAIRMENTS if getattr(options, name) is not None]
    return [*worse, *(f"--fault={fault}" for fault in options.fault), *twin_arguments(options)]


def on_board(
    options: argparse.Namespace, setup: FlightSetup, settings: FlightSettings
) -> tuple[FlightSetup, FlightSettings]:
    """`setup` and `settings` for --onboard. Raises InputError for a policy that cannot run on board."""
    if is_classical(options.policy):
        raise InputError(f"--onboard runs a network in C, and {options.policy} is none: name a policy")
    if options.thrust or options.hover or options.mass:
        raise InputError("--onboard flies the thrust map in the app: leave --thrust, --hover and --mass out")
    policy, name = load_policy(options.policy), policy_name(options.policy)
    generate.check_policy(policy, name)
    idents = [generate.weights_crc(policy, int8) for int8 in (False, True)]
    weights = (weight_bytes(policy), generate.key_of(policy)) if options.upload else None
    apps = app_flight.OnboardApps(name, idents, round(1000 * policy.metadata["control_period"]), weights)
    variants = app_flight.variants_of(setup.variants, setup.rig, settings)
    return replace(setup, variants=variants, apps=apps), app_flight.settings_of(settings)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return exit code 0 without faults, 1 after a fault, 2 on bad input."""
    options = make_parser().parse_args(arguments)

    def command() -> int:
        swarm = crazyflies(options)
        links = check_options(options)
        check_twin_options(options)
        capture = mocap_settings(options, links)
        log = options.log or (None if options.rehearse else Path(time.strftime("flight-%Y%m%d-%H%M%S.jsonl")))
        policy = load_follower(options.policy, options.plant)
        controller = FlightController(policy)
        config = controller.config
        choice = ThrustOptions(options.thrust, options.hover, options.curve, options.mass)
        more: PairGains = ({}, {})
        for path, given in parameters_of(options, swarm):
            check_parameters(config, list(variants(config, choice)[0]), given, f"{path}")
            more = {**more[0], **given[0]}, {**more[1], **given[1]}
        if not is_crazyflie(config):
            check_simple(options, map(read_fault, options.fault))
            grams = 1e3 * (choice.mass or UNKNOWN_MASS)
            terminal.say(f"{options.policy.name} was made for another plant: two Crazyflies of {grams:g} g fly it")
        check_mount(config, variants(config, choice, more), mount_of(options, config.plant))
        rig = Rig.from_metadata(policy.metadata)
        period = policy.control_period / limits.ticks_per_command(policy.control_period)
        goal = tuple(options.goal or goal_of(config))
        if not limits.within_fence(goal, rig, Limits()):
            raise InputError(f"--goal {' '.join(f'{value:g}' for value in goal)} puts a drone beyond the fence")
        bounds, stand = limits_of(config, goal, options.battery), config.plant.stand != "free"
        settings = FlightSettings(
            options.seconds, goal, options.dry_run, period, motor_of(config), stand, bounds, times_of(config)
        )
        setup = FlightSetup(
            controller, variants(config, choice, more), choice.curve or "linear", rig, Preflight(drone=drone_of(config))
        )
        if options.onboard:
            setup, settings = on_board(options, setup, settings)
        for text in swarm.describe(rig) if swarm is not None else []:
            terminal.say(text)
        with contextlib.ExitStack() as stack:
            uris = (options.leader, options.follower)
            if options.rehearse:
                clock.slow_down(options.slow or 1.0)
                twin = stack.enter_context(Rehearsal([*rehearsed_options(options), *twin_options(options)]))
                uris, setup = twin.uris, replace(setup, rehearsal=twin)
            if capture is not None:
                setup = replace(setup, mocap=stack.enter_context(ready(capture, rig.span)))
            if options.view is not None and log is not None:
                print(stack.enter_context(live_view(log, options.view, options.foxglove)).line, flush=True)  # noqa: T201
            if log and not options.log:
                print(f"log: {log}", flush=True)  # noqa: T201
            return fly(uris, setup, settings, log, list(sys.argv if arguments is None else arguments))

    return run_command(command)
