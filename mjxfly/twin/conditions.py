"""Conditions of a rehearsal: kinds of drones, surroundings, load, faults; and their command line flags."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import NamedTuple

from mjxball.config import Config
from mjxball.control import motors
from mjxball.control.motors import MOTORS, Motor
from mjxball.errors import InputError
from mjxfly.mount_modes import Mount

OLDER_FORCE = motors.OLDER  # [N] coefficients of p^2 and p, p = PWM / 65535: a fit that ignores the voltage


@dataclass(frozen=True)
class DroneKind:
    """A Crazyflie and the build of its firmware. The default is a 2.1 as delivered, with firmware 2026.08."""

    device: str = "Crazyflie 2.1"  # device type that it reports
    version: str = "2026.08"  # of its firmware
    motor: str = "2.1"  # key of `control.motors.MOTORS`
    compensated: bool = True  # thrust is converted to PWM by the battery's voltage; else thrust is PWM
    older_force: bool = False  # the true force is `OLDER_FORCE`, whatever the voltage
    auto_arm: bool = True  # arms itself as soon as its checks pass
    idle: int = 0  # PWM of every motor while armed, where arming is required
    rate_gain: float = 250.0  # default of pid_rate.roll_kp; the ki is twice that

    @property
    def constants(self) -> Motor:
        """Constants of its motors."""
        return MOTORS[self.motor]


DRONES = {
    "2.1": DroneKind(),
    "thrust-upgrade": DroneKind(motor="thrust-upgrade"),
    "brushless": DroneKind(
        device="Crazyflie 2.1 Brushless", motor="brushless", auto_arm=False, idle=7000, rate_gain=200.0
    ),
}
CURVES = {
    "linear": {},  # as delivered: thrust is linear in force, compensated for the battery
    "older": {"compensated": False, "older_force": True, "version": "2025.02"},
    "cubic": {"compensated": False},  # today's firmware built without compensation, on the motors as measured
}


def drone_kind(drone: str = "2.1", curve: str = "linear") -> DroneKind:
    """Return the kind of drone for keys of `DRONES` and `CURVES`."""
    return replace(DRONES[drone], **CURVES[curve])  # type: ignore[arg-type]


class AddedLoad(NamedTuple):
    """A small heavy body that is fixed to the stick in flight."""

    mass: float  # [kg]
    offset: float  # of its centre from O along the stick, toward the leader [m]
    after: float  # time since the first motor turned [s]


@dataclass(frozen=True)
class Surroundings:
    """Sensor noise, positioning, link delay and motor gains in a rehearsal, which the laptop does not know."""

    noise: float = 1.0  # factor on the noise of IMU and pose
    pose_hz: float = 100.0  # poses of the positioning system [Hz]
    deck: bool = True  # each drone measures its position on board; else poses come from the laptop or not at all
    delay: float = 0.0  # of every datagram each way [s]
    gains: tuple[float, float] = (1.0, 1.0)  # factors on the motor forces of leader and follower
    exact: bool = False  # the estimates are the true state: for comparisons with the simulation
    load: AddedLoad | None = None  # attached in flight
    mount: Mount | None = None  # of the drones on the stick; None: as in the policy's plant, which is rigid
    seed: int = 0
    pose_loss: float = 0.0  # fraction of the positioning system's poses that are lost
    positioning: str = "mocap"  # positioning system, one of `POSITIONING`


POSITIONING = ("mocap", "lighthouse", "loco", "flow")  # see `positioning`
DELIVERED = DroneKind()
QUIET = Surroundings()


# Bounds of the flags' values.
RANGES = {"noise": (0.0, 100.0), "pose_hz": (1.0, 1000.0), "delay": (0.0, 0.5)}
MOUNT_RANGES = ((1.0, 250.0), (0.0, 1.0))  # of `Mount`; the twin's steps are a quarter of the shortest period
LOAD_RANGES = ((0.0, 0.1), (-0.15, 0.15), (0.0, 3600.0))  # of `AddedLoad`


def add_twin_options(parser: argparse._ActionsContainer) -> None:
    """Add the flags --twin-... to `parser`; their default is None."""
    about = "--rehearse: "
    add = parser.add_argument
    add("--twin-drone", choices=tuple(DRONES), help=f"{about}what drones the twin is (2.1)")
    add("--twin-curve", choices=tuple(CURVES), help=f"{about}linear: compensated for the battery; older, cubic: not")
    add("--twin-noise", type=float, metavar="X", help=f"{about}factor on the noise of its sensors (1)")
    add("--twin-pose-hz", type=float, metavar="HZ", help=f"{about}poses of its positioning system (100)")
    add("--twin-deck", choices=("yes", "no"), help=f"{about}its positioning; no: poses must come from here (yes)")
    about_kind = f"{about}what that deck is (mocap: 0.3 mm at --twin-pose-hz)"
    add("--twin-positioning", choices=POSITIONING, help=about_kind)
    add("--twin-delay", type=float, metavar="S", help=f"{about}of each datagram, from the first one on (0)")
    add("--twin-gains", type=float, nargs=2, metavar=("L", "F"), help=f"{about}factors on the motor forces (1 1)")
    about = f"{about}a load put on the stick: kg, m from O toward the leader, s after the motors first turn"
    add("--twin-load", type=float, nargs=3, metavar=("KG", "M", "S"), help=about)
    about = "--rehearse: elastic mounts: frequency of a drone on the stick, damping ratio (rigid)"
    add("--twin-mount", type=float, nargs=2, metavar=("HZ", "RATIO"), help=about)
    about = "--rehearse: "
    add("--twin-seed", type=int, metavar="N", help=f"{about}of its noise (0)")


def check_surroundings(options: argparse.Namespace) -> None:
    """Raise InputError for values out of range and combinations that the twin does not support."""
    for name, (low, high) in RANGES.items():
        value = getattr(options, f"twin_{name}")
        if value is not None and not low <= value <= high:
            raise InputError(f"--twin-{name.replace('_', '-')} must be {low:g} to {high:g}, not {value:g}")
    for value in options.twin_gains or ():
        if not 0.1 <= value <= 3.0:
            raise InputError(f"--twin-gains must be two numbers of 0.1 to 3, not {value:g}")
    for name, ranges, parts in (("load", LOAD_RANGES, ("KG", "M", "S")), ("mount", MOUNT_RANGES, ("HZ", "RATIO"))):
        given = getattr(options, f"twin_{name}") or ()
        for value, (low, high), what in zip(given, ranges, parts, strict=False):
            if not low <= value <= high:
                raise InputError(f"--twin-{name}: {what} must be {low:g} to {high:g}, not {value:g}")
    if options.twin_positioning not in (None, "mocap"):
        for name in ("deck", "pose_hz"):
            if getattr(options, f"twin_{name}") is not None:
                flag = f"--twin-{name.replace('_', '-')}"
                raise InputError(f"{flag} is for --twin-positioning mocap, not {options.twin_positioning}")
    if options.twin_seed is not None and options.twin_seed < 0:
        raise InputError(f"--twin-seed must not be negative, not {options.twin_seed}")


def twin_arguments(options: argparse.Namespace) -> list[str]:
    """Return the --twin-... flags of `options` as arguments for the twin's process."""
    flags = []
    for name, value in vars(options).items():
        if name.startswith("twin_") and value is not None:
            values = value if isinstance(value, list) else [value]
            flags += [f"--{name.replace('_', '-')}", *map(str, values)]
    return flags


def surroundings(options: argparse.Namespace) -> Surroundings:
    """Return the `Surroundings` that `options` describe. Raises InputError."""
    check_surroundings(options)
    given = {name: getattr(options, f"twin_{name}") for name in ("noise", "pose_hz", "delay", "seed", "gains")}
    given = {name: tuple(one) if name == "gains" else one for name, one in given.items() if one is not None}
    load = AddedLoad(*options.twin_load) if options.twin_load is not None else None
    mount = Mount(*options.twin_mount) if options.twin_mount is not None else None
    deck, system = options.twin_deck != "no", options.twin_positioning or "mocap"
    return Surroundings(deck=deck, load=load, mount=mount, positioning=system, **given)


@dataclass(frozen=True)
class Battery:
    """Voltage of a one-cell battery."""

    full: float = 4.1  # without load [V]
    sag: float = 0.35  # at full power [V]
    drain: float = 0.0008  # at full power [V/s]


@dataclass(frozen=True)
class Conditions:
    """Load, motors and batteries in a rehearsal, unknown to the laptop. The CG moves from the first motor turn on."""

    object_mass: float  # [kg]
    cg_amplitude: float = 0.0  # of a prescribed sine [m]
    cg_speed: float = 0.0  # [rad/s]
    ball: float = 0.0  # offset of a rolling ball from O at the start [m]
    rotor_lag: float = 1.0  # factor on the motors' time constant
    thrust: tuple[float, float] = (1.0, 1.0)  # factor on the motor forces of leader and follower
    battery: Battery = Battery()

    @classmethod
    def of(cls, config: Config) -> Conditions:
        """Return the means of the training ranges of `config`; a rolling ball starts at half its largest offset."""
        ranges = config.scenario
        amplitude, speed = (sum(pair) / 2 for pair in (ranges.cg_amplitude, ranges.cg_speed))
        return cls(sum(ranges.object_mass) / 2, amplitude, speed, ranges.ball_start / 2)


@dataclass(frozen=True)
class LinkFaults:
    """Faults of one drone's link. The default is a perfect link."""

    loss: float = 0.0  # fraction of datagrams that are lost, each way
    delay: float = 0.0  # of every datagram [s]
    jitter: float = 0.0  # added delay, uniform from 0 to this [s]: datagrams may overtake each other
    silent_up: bool = False  # nothing reaches the drone
    silent_down: bool = False  # nothing comes from the drone


@dataclass(frozen=True)
class DroneFaults:
    """Faults of one drone's computer. The default is none."""

    frozen: bool = False  # the estimator repeats its last state, the clock goes on
    clock_stopped: bool = False  # time stamps stand still
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)  # added to the reported position [m]
    battery: float = 0.0  # added to the reported voltage [V]
    garbage: float = 0.0  # datagrams of random bytes sent for each step
    stabilizer_dead: bool = False  # its task hangs: logs have new time stamps and frozen values, PWM is held
    stopped: bool = False  # the program hangs: nothing is answered, PWM is held
    peer_silent: bool = False  # apps: the other drone receives none of its heartbeats
    restarts: bool = True  # the microcontroller's watchdog restarts a program that hangs; else its motors stay off


class BodyFault(NamedTuple):
    """Fault of a drone's positioning, battery or motors, an argument of `Pair.disturb`."""

    what: str  # "battery" [V], "fade" [V/s], "gain" (factor), or of its poses, see `Positioning.disturb`
    value: float


FaultEffect = LinkFaults | DroneFaults | BodyFault | str  # str: an action of the twin, see `TwinDrone.inject`


class FaultKind(NamedTuple):
    """A kind of `--fault KIND:DRONE@S`."""

    what: FaultEffect
    about: str  # description for the documentation


HUNG = DroneFaults(stabilizer_dead=True)
FAULT_KINDS = {
    "silent": FaultKind(LinkFaults(silent_up=True, silent_down=True), "no packet passes its link, either way"),
    "silent-up": FaultKind(LinkFaults(silent_up=True), "no packet reaches it"),
    "silent-down": FaultKind(LinkFaults(silent_down=True), "no packet comes from it"),
    "loss": FaultKind(LinkFaults(loss=0.3), "30 % of the packets are lost, each way"),
    "frozen": FaultKind(DroneFaults(frozen=True), "its estimate stands still, its clock goes on"),
    "clock": FaultKind(DroneFaults(clock_stopped=True), "the time stamps of its states stand still"),
    "jump": FaultKind(DroneFaults(offset=(0.0, 0.0, 0.4)), "the position that it reports jumps up by 0.4 m"),
    "battery": FaultKind(DroneFaults(battery=-1.2), "it reports 1.2 V less than its battery has"),
    "garbage": FaultKind(DroneFaults(garbage=3.0), "it sends 600 datagrams of random bytes a second"),
    "crash": FaultKind("crash", "its firmware finds that it has crashed: motors off"),
    "power": FaultKind("power", "its power fails"),
    "port": FaultKind("port", "its radio task ends: packets are refused, motors run on"),
    "reboot": FaultKind("reboot", "its power fails for a moment: it starts anew, motors off"),
    "stabilizer": FaultKind(HUNG, "its stabilizer task hangs: motors are held, then its watchdog restarts it"),
    "imu": FaultKind(HUNG, "its IMU ends, for which the stabilizer task waits: as `stabilizer`"),
    "stopped": FaultKind(DroneFaults(stopped=True), "its program hangs: motors are held, then it restarts"),
    "peer": FaultKind(DroneFaults(peer_silent=True), "`--onboard`: the other drone does not hear its app"),
    "killed": FaultKind(DroneFaults(stopped=True, restarts=False), "as `stopped`, but it does not start again"),
    "pose-frozen": FaultKind(BodyFault("frozen", 1.0), "its measured pose stands still"),
    "pose-axis": FaultKind(BodyFault("frozen z", 1.0), "the height of its measured pose stands still"),
    "pose-repeated": FaultKind(BodyFault("repeated", 2.0), "it is given each measured pose twice, at half the rate"),
    "pose-lost": FaultKind(BodyFault("lost", 1.0), "it is given no measured pose"),
    "pose-jump": FaultKind(BodyFault("jump", 0.4), "its measured position jumps up by 0.4 m"),
    "sag": FaultKind(BodyFault("battery", 3.0), "its battery gives way, to 3.0 V"),
    "fade": FaultKind(BodyFault("fade", 0.5), "its battery loses 0.5 V a second"),
    "weak": FaultKind(BodyFault("gain", 0.9), "its motors give 10 % less"),
}
BODY_FAULTS = {kind.what.what for kind in FAULT_KINDS.values() if isinstance(kind.what, BodyFault)}
POSE_FAULTS = BODY_FAULTS - {"battery", "fade", "gain"}
# `Surroundings` that the twin of other plants than a Crazyflie pair does not simulate, and body faults that it does.
COUPLED_ONLY = ("noise", "pose_hz", "gains", "load", "mount", "pose_loss", "positioning")
SIMPLE_FAULTS = {"battery"}


class Injection(NamedTuple):
    """A fault to inject during a rehearsal."""

    what: FaultEffect
    drone: int  # 0 leader, 1 follower
    after: float  # time since the first motor turned [s]
    text: str = ""  # the value of --fault


def read_fault(text: str) -> Injection:
    """Parse `KIND:DRONE@S`, such as `frozen:follower@3`. Raises InputError."""
    match = re.fullmatch(r"([\w-]+):(leader|follower)@(\d{1,4}(?:\.\d+)?)", text)
    if match is None or match[1] not in FAULT_KINDS:
        raise InputError(
            f"--fault {text} is no KIND:DRONE@S such as frozen:follower@3; kinds: {', '.join(FAULT_KINDS)}"
        )
    return Injection(FAULT_KINDS[match[1]].what, ("leader", "follower").index(match[2]), float(match[3]), text)


def check_simple(options: argparse.Namespace, faults: Iterable[Injection]) -> None:
    """Raise InputError for flags and faults that the twin of other plants than a Crazyflie pair does not simulate."""
    flags = [name for name in COUPLED_ONLY if getattr(options, f"twin_{name}", None) is not None]
    given = [f"--twin-{name.replace('_', '-')}" for name in flags]
    body = [one for one in faults if isinstance(one.what, BodyFault) and one.what.what not in SIMPLE_FAULTS]
    for what in (*given, *(f"--fault {one.text}" for one in body)):
        raise InputError(f"{what} is for policies that were trained on Crazyflies, such as flight")
