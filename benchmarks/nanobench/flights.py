"""Real flights in the NanoBench CSV layout (Ullah and Baca 2026): motion capture and on-board logs, a row every 10 ms.

Columns and units as found in the data: motion capture in metres, radians and quaternions (x, y, z, w); the gyro in
rad/s and the accelerometer in g, body axes; `att_stateEstimate_*` and `pid_controller_*` in degrees with the
firmware's pitch; `motor_motor_m1..4` the PWM after battery compensation. On-board rows arrive by radio and were
interpolated linearly onto the rows of the motion capture.
"""

from __future__ import annotations

import gzip
import io
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mjxball.errors import InputError
from mjxball.reading import GAP, check_times

Array = np.ndarray
GRAVITY = 9.81  # [m/s2], of the accelerometer's g as well
ROW = 0.01  # [s] between rows
AIRBORNE = 30000.0  # mean PWM above which a drone flies
ENDS = 2.0  # [s] left out after take-off and before landing
LEAST = 5.0  # [s] of flight that a file must hold
STALL = 3  # rows on one straight line in the IMU's or the motors' columns: at least 30 ms were not received
LOST = (
    0.006,
    0.012,
)  # jump of the estimate [m] and [rad] beyond its own velocity and rate: rows were lost, or a pose fused
SPREAD = 3  # rows either side of a damaged one that count as damaged
SUFFIXES = (".csv", ".csv.gz")

GROUPS: dict[str, tuple[str, ...]] = {
    "time": ("t",),
    "velocity": ("vx", "vy", "vz"),
    "quaternion": ("qw", "qx", "qy", "qz"),
    "acceleration": ("imu_acc_x", "imu_acc_y", "imu_acc_z"),
    "gyro": ("imu_gyro_x", "imu_gyro_y", "imu_gyro_z"),
    "pwm": tuple(f"motor_motor_m{number}" for number in (1, 2, 3, 4)),
    "place": tuple(f"est_stateEstimate_{axis}" for axis in "xyz"),
    "drift": tuple(f"est_stateEstimate_v{axis}" for axis in "xyz"),
    "estimate": tuple(f"att_stateEstimate_{axis}" for axis in ("roll", "pitch", "yaw")),
    "wanted": tuple(f"pid_controller_{axis}" for axis in ("roll", "pitch", "yaw")),
    "thrust": ("pid_controller_cmd_thrust",),
    "supply": ("pwr_pm_vbat",),
}


class Flight(NamedTuple):
    """One flight, rows of 10 ms, SI units and this project's axes unless said otherwise."""

    name: str
    time: Array  # (n,) [s] from the file's first row
    velocity: Array  # (n, 3) [m/s] world axes, motion capture
    quaternion: Array  # (n, 4) w, x, y, z, motion capture
    acceleration: Array  # (n, 3) specific force [m/s2], body axes
    gyro: Array  # (n, 3) [rad/s], body axes
    pwm: Array  # (n, 4) 0 .. 65535, as sent to the motors
    estimate: Array  # (n, 3) roll, pitch, yaw of the on-board estimator [rad]
    wanted: Array  # (n, 3) roll, pitch, yaw that the attitude loop is given [deg], firmware's signs
    thrust: Array  # (n,) thrust command before battery compensation, 0 .. 65535
    supply: Array  # (n,) battery under load [V]
    airborne: slice  # rows in flight, without take-off and landing
    damaged: Array  # (n,) bool: on-board rows beside a stall of the radio or a jump of the estimator

    @property
    def has_cascade(self) -> bool:
        """Whether the firmware's PID controller flew; another controller leaves its columns at zero."""
        return bool(np.ptp(self.thrust[self.airborne]) > 0)


def find_flights(directory: Path) -> dict[str, Path]:
    """Name -> CSV file of every flight in `directory`. Raises InputError if there is none."""
    if not directory.is_dir():
        raise InputError(f"{directory} is not a directory; give the one that holds the flights' CSV files")
    found = {
        path.name.removesuffix(".gz").removesuffix(".csv"): path
        for path in sorted(directory.iterdir())
        if path.name.endswith(SUFFIXES)
    }
    if not found:
        raise InputError(f"{directory} holds no flight: no file ends in .csv or .csv.gz")
    return found


def read_flight(path: Path) -> Flight:
    """A flight from `path`. Raises InputError in a sentence that names the file."""
    try:
        raw = gzip.decompress(path.read_bytes()) if path.name.endswith(".gz") else path.read_bytes()
        header, _, body = raw.decode().partition("\n")
    except (OSError, EOFError, UnicodeDecodeError) as error:
        raise InputError(f"{path.name} cannot be read: {error}") from None
    names = [name.strip() for name in header.split(",")]
    if len(set(names)) < len(names):
        raise InputError(f"{path.name} has a column twice: {next(n for n in names if names.count(n) > 1)}")
    missing = [name for group in GROUPS.values() for name in group if name not in names]
    if missing:
        raise InputError(f"{path.name} lacks the column{'s' * (len(missing) > 1)} {', '.join(missing[:5])}")
    try:
        table = np.loadtxt(io.StringIO(body), delimiter=",", ndmin=2)
    except ValueError as error:
        raise InputError(f"{path.name} is not a table of numbers: {error}") from None
    if table.shape[0] < LEAST / ROW or table.shape[1] != len(names):
        raise InputError(f"{path.name} holds {table.shape[0]} rows of {table.shape[1]}; {LEAST:g} s are needed")
    parts = {key: table[:, [names.index(name) for name in group]] for key, group in GROUPS.items()}
    for key, group in GROUPS.items():
        if not np.isfinite(parts[key]).all():
            raise InputError(f"{path.name} holds a number that is not finite in {' or '.join(group)}")
    try:
        for remark in check_times(parts["time"][:, 0].tolist(), 0.9 * ROW, 1.1 * ROW):
            print(f"{path.name}: {remark}; rows beside such gaps count as damaged", file=sys.stderr)
    except ValueError as error:
        raise InputError(f"{path.name}: {error}") from None
    return _flight(path.name.removesuffix(".gz").removesuffix(".csv"), parts)


def _flight(name: str, parts: dict[str, Array]) -> Flight:
    time = parts["time"][:, 0] - parts["time"][0, 0]
    up = np.flatnonzero(parts["pwm"].mean(axis=1) > AIRBORNE)
    if len(up) == 0 or time[up[-1]] - time[up[0]] < LEAST + 2 * ENDS:
        raise InputError(f"{name} holds less than {LEAST:g} s of flight between take-off and landing")
    first, last = np.searchsorted(time, (time[up[0]] + ENDS, time[up[-1]] - ENDS))
    estimate = np.radians(parts["estimate"]) * np.array([1.0, -1.0, 1.0])  # the firmware's pitch has the other sign
    return Flight(
        name=name,
        time=time,
        velocity=parts["velocity"],
        quaternion=parts["quaternion"] / np.linalg.norm(parts["quaternion"], axis=1, keepdims=True),
        acceleration=GRAVITY * parts["acceleration"],
        gyro=parts["gyro"],
        pwm=parts["pwm"],
        estimate=estimate,
        wanted=parts["wanted"],
        thrust=parts["thrust"][:, 0],
        supply=parts["supply"][:, 0],
        airborne=slice(int(first), int(last)),
        damaged=_damaged(time, parts, estimate),
    )


def _damaged(time: Array, parts: dict[str, Array], estimate: Array) -> Array:
    """Rows (n,) where the on-board columns are a straight line, their estimate jumps, or rows are missing.

    `SPREAD` rows around count as well.
    """
    bad = _stalled(parts["gyro"]) | _stalled(parts["pwm"])
    step = np.diff(time)[:, None]
    bad[1:] |= step[:, 0] > GAP * ROW
    for column, slope, limit in zip((parts["place"], estimate), (parts["drift"], parts["gyro"]), LOST, strict=True):
        axes = min(column.shape[1], 3) if column is not estimate else 2  # yaw is corrected too slowly to tell
        moved = np.diff(column[:, :axes], axis=0) - step * (slope[1:, :axes] + slope[:-1, :axes]) / 2
        bad[1:] |= np.linalg.norm(moved, axis=1) > limit
    return np.convolve(bad, np.ones(2 * SPREAD + 1), "same") > 0.5


def _stalled(columns: Array) -> Array:
    """Rows (n,) in the middle of `STALL` rows that lie on a straight line in every one of `columns` (n, k)."""
    bend = np.abs(np.diff(columns, 2, axis=0))
    flat = np.all(bend < 2e-3 * np.abs(np.diff(columns, axis=0)).mean(axis=0), axis=1)  # 0.2 %: digits of the file
    return np.concatenate([[False], flat, [False]])
