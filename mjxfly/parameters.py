"""Firmware parameters that a file may set on the drones, and checks of its gains.

Gains are checked by the margins of the pair's attitude loop (`margins`), with the gains of one drone on both.
The loop must be stable with a margin, and about as fast as the one that the policy was trained on. With --mount-hz all
gains that are uploaded are checked against the modes of elastic mounts.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from mjxball import config as configs
from mjxball.config import Config
from mjxball.control.axes import Axis, axes
from mjxball.control.crazyflie import PARAMETERS, PairGains, pair_gains, with_gains
from mjxball.errors import InputError
from mjxball.reading import near
from mjxfly.limits import NAMES
from mjxfly.margins import REQUIREMENTS, Margins, gains_of, margins
from mjxfly.mount_modes import MOUNTED, Mount, has_mode_margin, loop_on_mount, lowest_mode
from mjxfly.policy_setup import is_crazyflie, with_curve
from mjxfly.setpoints import CurveName, Variants

ESTIMATION = ("kalman", "locSrv", "lighthouse", "loco", "tdoa2", "tdoa3", "motion", "flowdeck")  # groups of parameters
OWN = ("kalman.resetEstimation", "kalman.initialX", "kalman.initialY", "kalman.initialZ", "kalman.initialYaw")
NOISE = re.compile(r"\.(pN|mN|std|ext\w*Std)")  # standard deviations, by which a filter divides
DEVIATIONS = (1e-6, 1e3)  # bounds of these
SPARE = 1.5  # least gain margin, up and down: motors, battery, inertia
RANGE = 3.0  # allowed change of the bandwidth, up and down: with a third of the gains the shipped loops have 0.38


def is_written(name: str) -> bool:
    """Whether the parameter `name` of a file is written to the drones: a gain, or a setting of their positioning."""
    return name in PARAMETERS or (name.split(".", maxsplit=1)[0] in ESTIMATION and name not in OWN)


def check_parameters(config: Config, curves: Sequence[CurveName], more: PairGains, where: str) -> None:
    """Raise InputError, which begins with `where`, for parameters `more` of leader and follower that are unsafe.

    They are checked for each of the force `curves` that the firmware may have: the policy's gains depend on it.
    """
    for number, (name, given) in enumerate(zip(NAMES, more, strict=True)):
        for parameter, value in given.items():
            _check_value(parameter, value, f"{where}: {parameter} of the {name}")
        if not PARAMETERS.keys() & given.keys():
            continue
        for curve in curves:
            own = with_curve(config, curve)
            trained = pair_gains(own.autopilot)[number]
            _check_loops(own, trained, given, f"{where}: the {name}")


def check_mount(config: Config, both: Sequence[Variants], mount: Mount) -> None:
    """Raise InputError if gains of a drone, leader first, lack their margin at a mode from that of `mount` on."""
    if mount.is_rigid:
        return
    if not is_crazyflie(config):
        raise InputError("--mount-hz is for policies that were trained on Crazyflies, such as flight")
    for name, own in zip(NAMES, both, strict=True):
        for curve, variant in own.items():
            flown = with_curve(config, curve)
            chosen = {key: value for key, value in variant.gains.items() if key in PARAMETERS}
            autopilot = with_gains(flown.autopilot, chosen)
            for axis in axes(flown):
                loop = loop_on_mount(gains_of(autopilot, axis), axis, flown) if axis.name in MOUNTED else None
                if loop is not None and not has_mode_margin(loop, mount):
                    needed = lowest_mode(loop, mount.damping)
                    raise InputError(
                        f"--mount-hz {mount.frequency:g}: on the {curve} force curve the {name}'s {axis.name} gains "
                        f"need mounts of {needed:.0f} Hz: upload others with --gains, which mjxfly.rig.gains "
                        "--mount-hz computes, or name the firmware's --curve"
                    )


def _check_value(parameter: str, value: float, where: str) -> None:
    if not is_written(parameter):
        groups = ", ".join(ESTIMATION)
        raise InputError(
            f"{where} is neither a gain of pid_attitude or pid_rate nor a setting of {groups}"
            f"{near(parameter, PARAMETERS)}: leave it out"
        )
    if parameter in PARAMETERS:
        low, high = configs.range_of(f"autopilot.{PARAMETERS[parameter][0]}")
        if not low <= value <= high:
            raise InputError(f"{where} must be {low:g} to {high:g}, not {value:g}")
    low, high = DEVIATIONS
    if NOISE.search(parameter) and not low <= value <= high:
        raise InputError(f"{where} must be {low:g} to {high:g}, not {value:g}")


def _check_loops(config: Config, trained: Mapping[str, float], given: Mapping[str, float], where: str) -> None:
    chosen = {name: value for name, value in given.items() if name in PARAMETERS}
    before = with_gains(config.autopilot, dict(trained))
    after = with_gains(before, chosen)
    for axis in _turned(config):
        old, new = (
            margins(gains_of(one, axis), axis.gain, config.plant.rotor_lag, REQUIREMENTS.delay)
            for one in (before, after)
        )
        if gains_of(before, axis) != gains_of(after, axis) and (why := _fault(old, new)):
            raise InputError(f"{where}'s {axis.name} loop {why}; mjxfly.rig.gains computes gains for a rig")


def _turned(config: Config) -> list[Axis]:
    """Axes of the attitude loops of the pair of `config`; of a single drone if it is not a pair of Crazyflies."""
    if is_crazyflie(config):
        return list(axes(config))
    return [axis._replace(gain=axis.gain * axis.inertia_ratio) for axis in axes(configs.preset("flight"))]


def _fault(old: Margins, new: Margins) -> str:
    if min(new.gain_up, new.gain_down) < SPARE:
        return f"would be unstable, or has less than a factor of {SPARE:g} to spare"
    if not 1 / RANGE <= new.crossover / old.crossover <= RANGE:
        text = f"would have {new.crossover:.2g} rad/s of bandwidth, and the policy was trained with {old.crossover:.2g}"
        return f"{text}: {old.crossover / RANGE:.2g} to {RANGE * old.crossover:.2g} are flown"
    return ""
