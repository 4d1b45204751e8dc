"""What drones the twin is, what surrounds them, and the flags by which a rehearsal varies both."""

from __future__ import annotations

import argparse
import math
from dataclasses import dataclass, replace

from mjxball.control import motor_curves
from mjxball.control.motors import MOTORS, Motor
from mjxball.errors import InputError

OLDER_FORCE = motor_curves.OLDER  # [N] shares of p^2 and p, p = PWM / 65535: a fit that ignores the voltage


@dataclass(frozen=True)
class DroneKind:
    """A Crazyflie and the build of its firmware. The default is a 2.1 as delivered, with firmware 2026.08."""

    device: str = "Crazyflie 2.1"  # what it calls itself
    version: str = "2026.08"  # of its firmware
    motor: str = "2.1"  # of `control.motors.MOTORS`
    compensated: bool = True  # thrust is converted to PWM by the battery's voltage; else thrust is PWM
    older_force: bool = False  # the true force is `OLDER_FORCE`, whatever the voltage
    auto_arm: bool = True  # arms itself as soon as its checks pass
    idle: int = 0  # PWM of every motor while armed, where arming is required
    rate_gain: float = 250.0  # default of pid_rate.roll_kp; the ki is twice that

    @property
    def constants(self) -> Motor:
        """Its motor's."""
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
    """The kind of drone by the names of `DRONES` and `CURVES`."""
    return replace(DRONES[drone], **CURVES[curve])  # type: ignore[arg-type]


@dataclass(frozen=True)
class Surroundings:
    """What a rehearsal meets around the drones and the laptop is not told."""

    noise: float = 1.0  # factor on the noise of IMU and pose
    pose_hz: float = 100.0  # poses of the positioning system [Hz]
    deck: bool = True  # each drone has its own positioning; else poses come from the laptop, or none do
    delay: float = 0.0  # of every datagram each way, from the first one on [s]
    gains: tuple[float, float] = (1.0, 1.0)  # factors on the motor forces of leader and follower
    exact: bool = False  # the estimates are the truth: for comparisons with the simulation
    seed: int = 0


DELIVERED = DroneKind()
QUIET = Surroundings()


FLAGS = ("drone", "curve", "noise", "pose_hz", "deck", "delay", "gains", "seed")
# Numbers with least and most.
RANGES = {"noise": (0.0, 100.0), "pose_hz": (1.0, 1000.0), "delay": (0.0, 0.5)}


def add_twin_options(parser: argparse.ArgumentParser) -> None:
    """Add --twin-drone and the others to `parser`; None where nothing is asked for."""
    about = "--rehearse: "
    add = parser.add_argument
    add("--twin-drone", choices=tuple(DRONES), help=f"{about}what drones the twin is (2.1)")
    add("--twin-curve", choices=tuple(CURVES), help=f"{about}linear: compensated for the battery; older, cubic: not")
    add("--twin-noise", type=float, metavar="X", help=f"{about}factor on the noise of its sensors (1)")
    add("--twin-pose-hz", type=float, metavar="HZ", help=f"{about}poses of its positioning system (100)")
    add("--twin-deck", choices=("yes", "no"), help=f"{about}its positioning; no: poses must come from here (yes)")
    add("--twin-delay", type=float, metavar="S", help=f"{about}of each datagram, from the first one on (0)")
    add("--twin-gains", type=float, nargs=2, metavar=("L", "F"), help=f"{about}factors on the motor forces (1 1)")
    add("--twin-seed", type=int, metavar="N", help=f"{about}of its noise (0)")


def check_twin(options: argparse.Namespace) -> None:
    """Raise InputError for what no twin can be."""
    for name, (low, high) in RANGES.items():
        value = getattr(options, f"twin_{name}")
        if value is not None and not low <= value <= high:
            raise InputError(f"--twin-{name.replace('_', '-')} must be {low:g} to {high:g}, not {value:g}")
    for value in options.twin_gains or ():
        if not 0.1 <= value <= 3.0:
            raise InputError(f"--twin-gains must be two numbers of 0.1 to 3, not {value:g}")
    if options.twin_seed is not None and options.twin_seed < 0:
        raise InputError(f"--twin-seed must not be negative, not {options.twin_seed}")


def asked_of_twin(options: argparse.Namespace) -> list[str]:
    """The flags that were given, as the twin's process takes them."""
    flags = []
    for name in FLAGS:
        value = getattr(options, f"twin_{name}")
        if value is not None:
            values = value if isinstance(value, list) else [value]
            flags += [f"--twin-{name.replace('_', '-')}", *map(str, values)]
    return flags


def surroundings(options: argparse.Namespace) -> Surroundings:
    """The `Surroundings` that were asked for. Raises InputError."""
    check_twin(options)
    given = {name: getattr(options, f"twin_{name}") for name in ("noise", "pose_hz", "delay", "seed")}
    given = {name: value for name, value in given.items() if value is not None and math.isfinite(value)}
    if options.twin_gains is not None:
        given["gains"] = tuple(options.twin_gains)
    return Surroundings(deck=options.twin_deck != "no", **given)
