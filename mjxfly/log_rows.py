"""Cleaning the series of a recorded drone: invalid rows are dropped, velocities and rates put into known axes."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np

from mjxball.control import rotations
from mjxball.errors import InputError
from mjxfly.log_consistency import UNEVEN, Motion, known, turn, way
from mjxfly.log_sources import Samples

LONGEST = 4 * 3600.0  # [s] of a recording
NEEDED = ("position", "quaternion", "sent")
IMPOSSIBLE = 1e4  # largest position [m], velocity [m/s] and rate [rad/s]
EXPECTED = {
    "position": f"finite numbers up to {IMPOSSIBLE:g} m",
    "quaternion": "finite numbers and a length of 1",
    "sent": "finite numbers",
}
LEAP, LOST = (0.1, 10.0), 1.0  # [m] + [m/s] times step that counts as a leap; [s] after which the pose must be back
# Likely mistakes by the ratio of measured to recorded motion: ratio, quantity, unit that it may be in.
UNITS = {
    "velocity": ((1000.0, "position", "mm"), (100.0, "position", "cm"), (0.001, "velocity", "mm/s")),
    "rates": ((math.pi / 180, "body rate", "deg/s"),),
}
AXES = ("the world's axes", "the drone's axes")
USUAL = {"velocity": AXES[0], "along": AXES[1], "rates": AXES[1]}  # usual axes of quantities that poses can verify
MAX_ERROR = 0.7  # largest error of a recorded motion over the measured one; 0.2 to 0.4 in public flights (NanoBench)

Drone = dict[str, Samples]  # by quantity


def sound(path: Path, own: Drone, name: str, remark: Callable[[str], None]) -> Drone:
    """The valid rows of every series of `own`; `remark` is called with notes on missing ones.

    Velocities returned are in the world's axes, rates in the drone's. Raises InputError if a `NEEDED` series has fewer
    than two valid rows, a series is too long, or velocities or rates do not agree with the poses.
    """
    found: Drone = {}
    missing: dict[str, list[str]] = {}
    for quantity, (time, rows) in own.items():
        good = _sound_rows(quantity, time, rows)
        lost = len(time) - int(good.sum())
        of_drone = f"{called(quantity)} of {name}"
        if len(time) - lost < 2 or (quantity in USUAL and not rows[good].any()):
            if quantity in NEEDED:
                has = f"{of_drone} has {len(time) - lost} good rows of {len(time)}"
                raise InputError(f"{path}: {has}; expected two or more, of {EXPECTED[quantity]}")
            continue  # all zeros: not measured
        if lost:
            where = f"{lost} of {len(time)} rows, first {time[~good][0] - time[0]:.2f} s after its beginning"
            missing.setdefault(where, []).append(called(quantity))
        found[quantity] = time[good], rows[good]
        if (span := float(np.ptp(time[good]))) > LONGEST:
            raise InputError(f"{path}: {of_drone} goes on for {span:.3g} s; expected {LONGEST:g} s or less")
    for where, quantities in missing.items():
        remark(f"{name} has no {', '.join(quantities)} in {where}")
    for quantity in [one for one in USUAL if one in found]:
        found[quantity] = _in_axes(path, found, quantity, name, remark)
    return found


def _sound_rows(quantity: str, time: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """(n,) whether each row has finite values and a time within plausible bounds."""
    good = np.isfinite(rows).all(axis=1) & (np.abs(time - np.median(time)) <= LONGEST)
    if quantity != "sent":
        good &= (np.abs(rows) <= IMPOSSIBLE).all(axis=1)
    if quantity == "quaternion":
        good[good] = np.abs(np.linalg.norm(rows[good], axis=1) - 1) <= UNEVEN
    if quantity == "position":
        kept = np.flatnonzero(good)
        good[kept[_leaps(time[kept], rows[kept])]] = False
    return good


def _leaps(time: np.ndarray, position: np.ndarray) -> np.ndarray:
    """(n,) where a position leaps away and comes back within `LOST`, as if a tracker mistook another body for it."""
    away = np.zeros(len(time), bool)

    def far(one: np.ndarray, other: np.ndarray) -> np.ndarray:
        apart = np.linalg.norm(position[other] - position[one], axis=1)
        return np.asarray(apart > LEAP[0] + LEAP[1] * (time[other] - time[one]))

    rows = np.arange(len(time))
    leaps = rows[1:][far(rows[:-1], rows[1:])]
    back = ~far(leaps[:-1] - 1, leaps[1:]) & (time[leaps[1:]] - time[leaps[:-1] - 1] <= LOST)
    for begin, end in zip(leaps[:-1][back], leaps[1:][back], strict=True):
        away[begin:end] = not away[begin - 1]
    return away


def _in_axes(path: Path, own: Drone, quantity: str, name: str, remark: Callable[[str], None]) -> Samples:
    """The series `quantity` with velocities in the world's or rates in the drone's axes, whichever it was recorded in.

    The recorded axes are those in which it agrees with the poses, the `USUAL` ones if it agrees in both. Raises
    InputError if it agrees in neither.
    """
    time, rows = own[quantity]
    matrices = rotations.matrix_from_quaternion(attitude(time, own))
    turned = np.einsum("nji,nj->ni" if quantity == "rates" else "nij,nj->ni", matrices, rows)
    within = known(time, own["position"][0]) & known(time, own["quaternion"][0])

    def held(values: np.ndarray) -> Motion:
        if quantity == "rates":
            return turn(time[within], attitude(time[within], own), values[within])
        return way(time[within], at(time[within], own["position"]), values[within])

    usual = USUAL[quantity]
    other = next(one for one in AXES if one != usual)
    options = {axes: rows if (axes == AXES[1]) == (quantity == "rates") else turned for axes in AXES}
    motions = {axes: held(values) for axes, values in options.items()}
    unit, least = ("rad/s", 0.05) if quantity == "rates" else ("m/s", 0.02)  # errors below `least` are noise
    most = max(2 * least, MAX_ERROR * motions[usual].size)
    errors = {axes: f"{one.error:.2g} {unit}" for axes, one in motions.items()}
    if min(one.error for one in motions.values()) > most:
        ratios = [one.ratio for one in motions.values()]
        units = UNITS["rates" if quantity == "rates" else "velocity"]
        likely = [f"; is its {what} in {one}?" for by, what, one in units if any(0.8 < r / by < 1.25 for r in ratios)]
        raise InputError(
            f"{path}: {called(quantity)} of {name} is not that of its poses, {errors[usual]} wrong in {usual} and "
            f"{errors[other]} in {other}; expected {most:.2g} {unit} or less{''.join(likely)}"
        )
    if motions[usual].error <= max(least, 2 * motions[other].error):
        return time, options[usual]
    remark(
        f"{called(quantity)} of {name} is taken in {other}, {errors[other]} from that of its poses; in {usual} it is "
        f"{errors[usual]}"
    )
    return time, options[other]


def at(time: np.ndarray, samples: Samples) -> np.ndarray:
    """(n, k) `samples` interpolated linearly to `time` (n,)."""
    return np.stack([np.interp(time, samples[0], column) for column in samples[1].T], axis=1)


def attitude(time: np.ndarray, own: Drone) -> np.ndarray:
    """(n, 4) unit quaternions interpolated to `time` (n,)."""
    when, rows = own["quaternion"]
    turns = np.cumprod([1.0, *np.where((rows[1:] * rows[:-1]).sum(axis=1) < 0, -1.0, 1.0)])
    found = at(time, (when, rows * turns[:, None]))
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def called(quantity: str) -> str:
    """Name of a quantity in messages."""
    return {"sent": "setpoint", "along": "velocity", "rates": "body rate"}.get(quantity, quantity)
