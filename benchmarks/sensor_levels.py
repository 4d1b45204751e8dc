"""Errors of a drone's measured state, from flights with motion capture: the levels that simulated sensors have.

`python benchmarks/sensor_levels.py FOLDER [--json FILE]` reads the flights `*.csv.gz` of a folder in the layout of
NanoBench (Ullah and Baca 2026): motion capture at 100 Hz, and what a Crazyflie sent, interpolated to the same times.

- noise: standard deviation a sample, from the residual of a local cubic over 50 ms. Of interpolated columns it is a
  lower bound, of body rates an upper one: motion above 20 Hz counts as noise.
- time shift: of each estimated position, the time since motion capture was there. Its median holds the clocks of the
  recording. What varies is the radio: position and gyroscope come in different packets and share it.
- lag of the position behind other columns: difference of their time shifts, in which the clocks cancel
- drift: standard deviation and time constant of a first-order Gauss-Markov process, from the autocorrelation of
  estimate minus motion capture, less these shifts. Of horizontal positions only the part across the path remains.
- offset: mean of estimate minus motion capture. Attitudes are differences of two frames of one drone, markers and
  accelerometer. An offset of motion capture itself does not show, nor does the mount of a drone on a rig.
- gaps: of an interpolated column, from runs of samples on one straight line
- drag: slope of the horizontal specific force over the velocity, both in the drone's axes; 2 standard errors
- thrust: specific force over the mean command, its slope in time, and the uneven commands of the four motors
- attitude loop: bandwidth of the first-order lag from the attitude's setpoint to its estimate, alone and with a delay
"""

from __future__ import annotations

import gzip
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.signal import lfilter, savgol_coeffs, savgol_filter
from scipy.spatial.transform import Rotation

from harness import Row, arguments, table, write
from mjxball.errors import InputError
from mjxball.running import run_command

if TYPE_CHECKING:
    from jaxtyping import Float

    Series = Float[np.ndarray, " T"]
    Vectors = Float[np.ndarray, "T n"]

PERIOD, GRAVITY = 0.01, 9.81
EDGE = 0.5  # [s] after take-off and before landing that do not count
FIT, SMOOTH, SLOW = 5, 11, 21  # samples of the local cubics: of noise, of first and of second derivatives
BLOCK = 2.0  # [s] of the blocks that a standard error leaves out
FARTHEST, STILL = 0.15, 0.05  # [s] largest time shift, [m/s] speed below which it is pulled to zero
LONGEST_LAG = 3.0  # [s] up to which the autocorrelation is fitted
ROUNDING = 4e-9  # of second differences of numbers with nine decimals
MOCAP, ESTIMATE = ("px", "py", "pz"), "stateEstimate_{}"


class Flight(NamedTuple):
    """The part of a flight in the air, at 100 Hz: motion capture, and what the drone sent."""

    columns: Mapping[str, Series]
    position: Vectors  # (T, 3) of motion capture [m]
    velocity: Vectors  # (T, 3) its derivative over 0.1 s
    attitude: Rotation  # of motion capture
    turned: Vectors  # (T, 3) sum of its rotations from sample to sample, in the drone's axes [rad]

    @property
    def estimated(self) -> Rotation:
        """The drone's estimate of its attitude."""
        return Rotation.from_quat(self.of("att_" + ESTIMATE, ("qx", "qy", "qz", "qw")))

    def of(self, form: str, names: Sequence[str]) -> Vectors:
        """Columns `form.format(name)` (T, n)."""
        return np.stack([self.columns[form.format(name)] for name in names], axis=1)


def read_flight(path: Path) -> Flight:
    """The flight of one file; raises InputError if a column is missing or there is no flight of 5 s."""
    try:
        with gzip.open(path, "rt", encoding="utf-8") as stream:
            names = stream.readline().strip().split(",")
            columns = dict(zip(names, np.loadtxt(stream, delimiter=",", ndmin=2).T, strict=True))
        height = columns["pz"]
        in_air = np.flatnonzero(height > 0.8 * np.median(height[height > np.mean(height) / 2]))
        edge = round(EDGE / PERIOD)
        part = slice(in_air[0] + edge, in_air[-1] - edge)
        columns = {name: column[part] for name, column in columns.items()}
        position = np.stack([columns[name] for name in MOCAP], axis=1)
        attitude = Rotation.from_quat(np.stack([columns[name] for name in ("qx", "qy", "qz", "qw")], axis=1))
    except (gzip.BadGzipFile, EOFError, KeyError, IndexError, ValueError) as error:
        raise InputError(f"{path.name} is no flight in the layout of NanoBench: {error}") from error
    if len(position) < 5 / PERIOD or not np.isfinite(position).all():
        raise InputError(f"{path.name} holds no flight of at least 5 s")
    velocity = savgol_filter(position, SMOOTH, 3, deriv=1, delta=PERIOD, axis=0)
    return Flight(columns, position, velocity, attitude, turned(attitude))


def turned(attitude: Rotation) -> Vectors:
    """(T, 3) sum of the rotations from sample to sample, in the body's axes [rad]."""
    steps = (attitude[:-1].inv() * attitude[1:]).as_rotvec()
    return np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])


def white_noise(values: Vectors) -> Float[np.ndarray, " n"]:
    """Standard deviation a sample of white noise on smooth signals (T, n).

    The residual of a local cubic has (1 - h) of the noise's variance, h the middle coefficient of the fit. The median
    over windows of 1 s leaves out steps.
    """
    kept = 1 - savgol_coeffs(FIT, 3)[FIT // 2]
    residual = (values - savgol_filter(values, FIT, 3, axis=0))[FIT:-FIT]
    seconds = len(residual) // 100
    variances = (residual[: 100 * seconds].reshape(seconds, 100, -1) ** 2).mean(axis=1)
    return np.sqrt(np.median(variances, axis=0) / kept)


def at(values: Vectors, shift: Series | float) -> Vectors:
    """`values` (T, n) as they were `shift` [s] before."""
    times = PERIOD * np.arange(len(values))
    return np.stack([np.interp(times - shift, times, column) for column in values.T], axis=1)


def time_shifts(late: Vectors, early: Vectors, rate: Vectors) -> Series:
    """Time [s] since a path (T, n) `early`, of rate of change `rate`, was next to `late`, by Gauss-Newton."""
    found = np.zeros(len(late))
    for _ in range(5):
        error, motion = late - at(early, found), at(rate, found)
        step = (error * motion).sum(axis=1) / ((motion**2).sum(axis=1) + STILL**2)
        found = np.clip(found - step, -FARTHEST, FARTHEST)
    return found


def time_shift(late: Vectors, early: Vectors) -> float:
    """Time [s] by which signals (T, n) `late` follow `early`: least squares, their means removed."""
    inside, found = slice(30, -30), 0.0  # what is shifted in at the ends does not count
    rate = np.gradient(early, PERIOD, axis=0)
    for _ in range(10):
        error, motion = (late - at(early, found))[inside], at(rate, found)[inside]
        error, motion = error - error.mean(axis=0), motion - motion.mean(axis=0)
        found = float(np.clip(found - (error * motion).sum() / (motion**2).sum(), -FARTHEST, FARTHEST))
    return found


def gauss_markov(error: Vectors, components: int) -> tuple[float, float]:
    """(standard deviation, time constant [s]) of each of the independent `components` of an error (T, n).

    Least squares of s^2 (exp(-lag / T) - 2 T / length) over the autocorrelation from two samples on: the second term is
    what the removal of the mean takes; white noise does not count.
    """
    error = error - error.mean(axis=0)
    steps = np.unique(np.geomspace(2, LONGEST_LAG / PERIOD, 60).astype(int))
    seen = np.array([(error[step:] * error[:-step]).sum(axis=1).mean() / components for step in steps])
    best = (math.inf, 0.0, 0.0)
    for time in np.geomspace(0.02, 5, 120):
        form = np.exp(-PERIOD * steps / time) - 2 * time / (PERIOD * len(error))
        variance = max((form * seen).sum() / (form**2).sum(), 0.0)
        best = min(best, (float(((variance * form - seen) ** 2).sum()), math.sqrt(variance), float(time)))
    return best[1], best[2]


def gaps(column: Series) -> tuple[float, float]:
    """(gaps of at least 30 ms a minute, longest gap [ms]) of a column that was interpolated to 100 Hz.

    A run of k second differences that vanish lies in one interval of the source, which lasts at least k + 1 samples.
    """
    straight = np.abs(np.diff(column, 2)) < ROUNDING
    ends = np.flatnonzero(np.diff(np.concatenate([[False], straight, [False]]).astype(int)))
    runs = ends[1::2] - ends[::2]
    found = runs[runs >= 2]
    return 60 * len(found) / (PERIOD * len(column)), 1e3 * PERIOD * (max(runs, default=0) + 1)


def slope(value: Series, over: Series) -> tuple[float, float, float]:
    """(slope, intercept, 2 standard errors of the slope) of a regression; the errors by leaving out blocks of 2 s."""
    blocks = np.arange(len(value)) // round(BLOCK / PERIOD)
    found = np.array([np.polyfit(over[blocks != one], value[blocks != one], 1)[0] for one in np.unique(blocks)])
    first, constant = np.polyfit(over, value, 1)
    return float(first), float(constant), 2 * math.sqrt((len(found) - 1) * found.var())


def attitude_loop(setpoint: Series, measured: Series, longest: int) -> tuple[float, float]:
    """(bandwidth [rad/s], delay [ms], at most `longest` samples) of delay and first-order lag, of any gain."""
    best = (math.inf, 0.0, 0.0)
    for bandwidth in np.geomspace(3, 60, 40):
        keep = math.exp(-bandwidth * PERIOD)
        lagged = lfilter([1 - keep], [1, -keep], setpoint - setpoint.mean())
        for delay in range(longest + 1):
            x, y = lagged[100 : len(lagged) - delay], (measured - measured.mean())[100 + delay :]
            left = float(((y - x * (x @ y) / (x @ x)) ** 2).mean())
            best = min(best, (left, float(bandwidth), 1e3 * PERIOD * delay))
    return best[1], best[2]


def noise_levels(flight: Flight) -> Row:
    """White noise of motion capture and of what the drone sent."""
    found = {
        "mocap position [mm]": flight.position,
        "mocap roll, pitch, yaw [mrad]": flight.turned,
        "estimate position [mm]": flight.of("est_" + ESTIMATE, "xyz"),
        "estimate roll, pitch, yaw [mrad]": turned(flight.estimated),
        "estimate velocity [mm/s]": flight.of("est_" + ESTIMATE, ("vx", "vy", "vz")),
        "gyro [mrad/s]": flight.of("imu_gyro_{}", "xyz"),
    }
    return {f"noise, {name}": (1e3 * white_noise(values)).tolist() for name, values in found.items()}


def error_levels(flight: Flight) -> Row:
    """Time shift and lags, drift and offset of position, velocity and attitude."""
    rates = savgol_filter(flight.turned, SMOOTH, 3, deriv=1, delta=PERIOD, axis=0)
    position, velocity = (flight.of("est_" + ESTIMATE, names) for names in ("xyz", ("vx", "vy", "vz")))
    shifts = time_shifts(position[:, :2], flight.position[:, :2], flight.velocity[:, :2])
    middle = float(np.median(shifts))
    found: Row = {"time shift of positions [ms]": 1e3 * middle}
    found["its variation [ms], time [s]"] = [*gauss_markov(1e3 * shifts[:, None], 1)]

    def ahead(name: str, late: Vectors, early: Vectors) -> Series:
        own = time_shift(late[:, :2], at(early[:, :2], shifts - middle))
        found[f"lag of positions behind {name} [ms]"] = 1e3 * (middle - own)
        return shifts - middle + own

    ahead("gyro", flight.of("imu_gyro_{}", "xyz"), rates)
    tilt, estimated_tilt = (attitude.as_matrix()[:, :, 2] for attitude in (flight.attitude, flight.estimated))
    moved = Rotation.from_quat(at(continuous(flight.attitude), ahead("attitude", estimated_tilt, tilt)))
    at_velocity = ahead("velocity", velocity, flight.velocity)
    errors = {  # estimate minus motion capture, in mm and mrad, and its independent horizontal components
        "position [mm]": (1e3 * (position - at(flight.position, shifts)), 1),
        "velocity [mm/s]": (1e3 * (velocity - at(flight.velocity, at_velocity)), 2),
        "attitude [mrad]": (1e3 * (moved.inv() * flight.estimated).as_rotvec(), 2),
    }
    for name, (error, components) in errors.items():
        found[f"drift, {name}, time [s], horizontal"] = [*gauss_markov(error[:, :2], components)]
        found[f"drift, {name}, time [s], vertical"] = [*gauss_markov(error[:, 2:], 1)]
        found[f"offset, {name}"] = error.mean(axis=0).tolist()
    along = moved.inv().apply(at(flight.velocity, shifts))
    tilted = errors["attitude [mrad]"][0] - errors["attitude [mrad]"][0].mean(axis=0)
    pairs = np.concatenate([tilted[:, 0], tilted[:, 1]]), np.concatenate([-along[:, 1], along[:, 0]])
    found["attitude error over speed [mrad s/m]"] = slope(*pairs)[0]
    return found


def continuous(attitude: Rotation) -> Vectors:
    """Quaternions (T, 4) of an attitude without jumps of sign, which can be interpolated."""
    found = attitude.as_quat()
    flips = np.sign((found[1:] * found[:-1]).sum(axis=1))
    return found * np.concatenate([[1.0], np.cumprod(flips)])[:, None]


def force_levels(flight: Flight) -> Row:
    """Drag, thrust and attitude loop."""
    force = GRAVITY * savgol_filter(flight.of("imu_acc_{}", "xyz"), SLOW, 3, axis=0)
    along = flight.attitude.inv().apply(flight.velocity)
    found: Row = {}
    for axis, name in enumerate("xy"):
        drag, trim, error = slope(force[:, axis], along[:, axis])
        found[f"drag, {name} [1/s], 2 standard errors"] = [-drag, error]
        found[f"offset, accelerometer {name} [degrees]"] = math.degrees(trim / GRAVITY)
    motors = flight.of("motor_motor_m{}", "1234") / 65535
    found["uneven motors"] = float(motors.mean(axis=0).std() / motors.mean())
    commands = {"motors": motors.mean(axis=1), "command": flight.columns["pid_controller_cmd_thrust"] / 65535}
    for name, command in commands.items():
        if command.std() > 0:  # constant where another controller flew
            ratio = np.log(savgol_filter(force[:, 2], 51, 1) / savgol_filter(command, 51, 1))
            fade, _, error = slope(ratio, flight.columns["t"] - flight.columns["t"][0])
            found[f"thrust over {name} [m/s2]"] = float(np.exp(ratio.mean()))
            found[f"fade over {name} [1/s], 2 standard errors"] = [fade, error]
    for name in ("roll", "pitch"):
        setpoint, measured = (flight.columns[form + name] for form in ("pid_controller_", "att_stateEstimate_"))
        if setpoint.std() > 0:
            found[f"attitude loop, {name} [rad/s], no delay"] = attitude_loop(setpoint, measured, 0)[0]
            found[f"attitude loop, {name} [rad/s], delay [ms]"] = [*attitude_loop(setpoint, measured, 15)]
    return found


def time_levels(flight: Flight) -> Row:
    """Periods of motion capture, and gaps of the columns that came by radio."""
    periods = 1e3 * np.diff(flight.columns["t"])
    found: Row = {"mocap period [ms], deviation, 99 %": [*map(float, (periods.std(), np.quantile(periods, 0.99)))]}
    found["mocap gaps a minute, longest [ms]"] = [
        float(60e3 * (periods > 15).sum() / periods.sum()),
        float(periods.max()),
    ]
    sent = {"state": "est_stateEstimate_x", "attitude": "att_stateEstimate_qx", "IMU": "imu_gyro_x"}
    for name, column in sent.items():
        found[f"gaps of 30 ms a minute, longest [ms], {name}"] = list(gaps(flight.columns[column]))
    return found


def main() -> int:
    """Print and write a table, a column for each flight."""
    parser = arguments(__file__, __doc__ or "")
    parser.add_argument("folder", type=Path, help="folder of flights *.csv.gz")
    options = parser.parse_args()
    paths = sorted(options.folder.glob("*.csv.gz"))
    if not paths:
        raise InputError(f"no flights *.csv.gz in {options.folder}")
    found: dict[str, Row] = {}
    for path in paths:
        flight = read_flight(path)
        try:
            levels = noise_levels(flight) | error_levels(flight) | force_levels(flight) | time_levels(flight)
        except KeyError as error:
            raise InputError(f"{path.name} has no column {error}") from error
        found[path.name.removesuffix(".csv.gz")] = levels
    names = dict.fromkeys(name for levels in found.values() for name in levels)
    rows: list[Row] = [{"level": name, **{flight: found[flight].get(name) for flight in found}} for name in names]
    rows = [{**row, "least - median - most": ranges([row[flight] for flight in found])} for row in rows]
    table(rows, form=".3g")
    write(options.json, {"flights": list(found), "levels": rows})
    return 0


def ranges(values: Sequence[Any]) -> str:
    """Least - median - most over the flights, of every component."""
    known = np.array([np.atleast_1d(value) for value in values if value is not None])
    low, middle, high = (np.quantile(known, share, axis=0) for share in (0, 0.5, 1))
    return ", ".join(f"{a:.3g} - {b:.3g} - {c:.3g}" for a, b, c in zip(low, middle, high, strict=True))


if __name__ == "__main__":
    raise SystemExit(run_command(main))
