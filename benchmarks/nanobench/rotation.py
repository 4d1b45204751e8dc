"""What real flights tell of a drone: motor lag, torque over inertia, force over mass with command and voltage.

The mass is not known. Forces are those of a nominal motor curve (`mjxball.control.motors`), of which only the ratio to
mass and inertia is found. About each axis

    rate' = gain * lagged(sum of +- nominal forces) + blow_back * velocity across + disturbance

with one first-order lag and one delay for all motors. In flight the disturbance is as large as the motors' moments,
and the controller answers it, so that plain least squares of rates on commands finds too little gain. Both sides
therefore pass the filter ((1 - q) / (1 - POLE q))^2, the innovation of a Kalman filter whose disturbance walks at
random: slow commands, which answer the disturbance, count little. Gain and blow-back then are linear least squares;
lag and delay are searched for. Rows 10 ms apart hide short commands, which limits how far the filter may go; what other
poles find is the fit's systematic error. On simulated flights a pole of 0.6 finds gain and lag too small and the delay
too large by the same time, the more so the larger the disturbance.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from scipy.signal import lfilter

from mjxball.control import motors, rotations
from mjxball.control.motors import MOTORS
from mjxball.plant.rotors import PLACES, SPIN
from nanobench.flights import ROW, Array, Flight

MOTOR = MOTORS["2.1"]  # nominal curve: the one whose compensation the flights' firmware computed
TICK = 0.002  # [s] of the grid that forces are filtered on
SETTLE = 0.5  # [s] before a flight's first row in which filters settle
BLOCKS = 12  # of the flights' time, left out in turn for standard errors
AXES = ("roll", "pitch", "yaw")
# Signs of the motors' forces in roll, pitch and yaw torque.
SIGNS = np.array([[y for _, y in PLACES["x"]], [-x for x, _ in PLACES["x"]], [*SPIN["x"]]], float)
POLE = 0.3  # of the whitening filter, per row: counts little below 10 Hz
POLES = (0.15, 0.6)  # to see how much the fit depends on it
STARTS = ((np.log(0.05), 0.5), (np.log(0.03), 2.0))  # log lag [s], delay [10 ms]


class Rotation(NamedTuple):
    """Attitude dynamics as fitted; gains per newton of nominal +- force, standard errors under the same index."""

    lag: float  # [s]
    delay: float  # [s], beyond the logged rows' own alignment
    gain: Array  # (3,) [rad/s2 per N]
    blow_back: Array  # (2,) roll per lateral, pitch per forward velocity [rad/s2 per m/s]
    errors: dict[str, Array]  # one standard error of each of the above
    explained: Array  # (3,) share of the whitened rates' variance
    rows: int  # that counted


class Track(NamedTuple):
    """A flight as the fit needs it."""

    grid: Array  # (m,) [s], 2 ms apart
    force: Array  # (m, 3) sums of +- nominal forces without lag [N]
    lift: Array  # (m,) sum of nominal forces [N]
    time: Array  # (k,) [s], 10 ms apart, in flight
    rates: Array  # (k, 3) [rad/s]
    across: Array  # (k, 2) lateral and forward velocity in the drone's heading [m/s]
    good: Array  # (k,) bool


def track_of(flight: Flight) -> Track:
    """`flight` on even grids."""
    time = flight.time
    begin, end = time[flight.airborne.start], time[flight.airborne.stop]
    grid = np.arange(begin - SETTLE, end, TICK)
    force = nominal_forces(flight, grid)
    rows = np.arange(begin, end, ROW)
    euler = rotations.euler_from_matrix(rotations.matrix_from_quaternion(flight.quaternion))
    cos, sin = np.cos(euler[:, 2]), np.sin(euler[:, 2])
    vx, vy = flight.velocity[:, 0], flight.velocity[:, 1]
    across = _on(rows, time, np.stack([cos * vy - sin * vx, cos * vx + sin * vy], axis=1))
    good = np.interp(rows, time, flight.damaged.astype(float)) < 0.01
    good[: round(SETTLE / ROW)] = False
    return Track(grid, force @ SIGNS.T, force.sum(axis=1), rows, _on(rows, time, flight.gyro), across, good)


def nominal_forces(flight: Flight, grid: Array) -> Array:
    """Steady forces (m, 4) [N] of the nominal curve at the logged PWM and voltage, at times `grid` (m,)."""
    pwm, supply = _on(grid, flight.time, flight.pwm), np.interp(grid, flight.time, flight.supply)
    return motors.force(MOTOR, pwm, supply[:, None])


def lagged(values: Array, lag: float) -> Array:
    """`values` (m, ...) on the 2 ms grid after a first-order lag [s] that starts settled."""
    keep = np.exp(-TICK / lag)
    return values[0] + lfilter([1 - keep], [1, -keep], values - values[0], axis=0)


def fit_rotation(tracks: list[Track], pole: float = POLE) -> Rotation:
    """Lag and delay common to roll and pitch, gains and blow-back; errors by leaving out blocks of time in turn."""
    whole = [track.good for track in tracks]
    best = min(_search(tracks, whole, start, pole) for start in STARTS)[1]
    parts = []
    for block in range(BLOCKS):
        kept = [_without(good, block) for good in whole]
        parts.append(_solve(tracks, kept, _search(tracks, kept, best, pole)[1], pole))
    errors = {}
    for name in ("lag", "delay", "gain", "blow_back"):
        values = np.array([getattr(part, name) for part in parts])
        errors[name] = np.sqrt((BLOCKS - 1) * values.var(axis=0))  # jackknife
    return _solve(tracks, whole, best, pole)._replace(errors=errors)


def _without(good: Array, block: int) -> Array:
    kept = good.copy()
    kept[len(good) * block // BLOCKS : len(good) * (block + 1) // BLOCKS] = False
    return kept


def _search(
    tracks: list[Track], good: list[Array], start: tuple[float, float], pole: float
) -> tuple[float, tuple[float, float]]:
    def cost(z: Array) -> float:
        return float(sum(np.log(_regress(tracks, good, axis, *_unpack(z), pole)[0]) for axis in (0, 1)))

    found = minimize(cost, start, method="Nelder-Mead", options={"maxiter": 120, "xatol": 1e-3, "fatol": 1e-6})
    return float(found.fun), (float(found.x[0]), float(found.x[1]))


def _unpack(z: Array | tuple[float, float]) -> tuple[float, float]:
    """(lag [s], delay [s]) of the search's numbers; lag from 2 ms to 0.5 s."""
    return float(np.clip(np.exp(z[0]), TICK, 0.5)), ROW * float(z[1])


def _regress(
    tracks: list[Track], good: list[Array], axis: int, lag: float, delay: float, pole: float
) -> tuple[float, Array, float]:
    """(variance of what is left, coefficients, share explained) of the whitened rates about `axis`."""
    bottom = np.polymul([1.0, -pole], [1.0, -pole])
    left, right = [], []
    for track, rows in zip(tracks, good, strict=True):
        force = lagged(track.force[:, axis], lag) - track.force[:, axis].mean()
        impulse = (np.cumsum(force) - force / 2) * TICK
        columns = [track.rates[:, axis], np.interp(track.time - delay, track.grid, impulse)]
        if axis < 2:
            columns.append(np.cumsum(track.across[:, axis]) * ROW)
        white = [lfilter([1.0, -2.0, 1.0], bottom, column - column[0])[rows] for column in columns]
        left.append(white[0])
        right.append(np.stack(white[1:], axis=1))
    y, x = np.concatenate(left), np.concatenate(right)
    found = np.linalg.lstsq(x, y, rcond=None)[0]
    variance = float(np.mean((y - x @ found) ** 2))
    return variance, found, 1 - variance / float(np.mean(y**2))


def _solve(tracks: list[Track], good: list[Array], z: tuple[float, float], pole: float) -> Rotation:
    lag, delay = _unpack(z)
    fits = [_regress(tracks, good, axis, lag, delay, pole) for axis in range(3)]
    gain, blow_back = np.array([fit[1][0] for fit in fits]), np.array([fit[1][1] for fit in fits[:2]])
    rows = int(sum(part.sum() for part in good))
    return Rotation(lag, delay, gain, blow_back, {}, np.array([fit[2] for fit in fits]), rows)


def _on(grid: Array, time: Array, columns: Array) -> Array:
    return np.stack([np.interp(grid, time, column) for column in columns.T], axis=1)
