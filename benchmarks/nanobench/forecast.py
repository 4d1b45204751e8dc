"""Open-loop forecasts of attitude and body rates from logged motor commands, beside constant rates.

A forecast starts from a row's measured attitude and rates, is given the motor commands that were logged until its end,
and nothing else that was measured later. The angular acceleration that the model leaves unexplained before the start is
averaged (`Memory.past`); its deviation from a slower mean (`Memory.trend`) fades (`Memory.fade`). After the start the
disturbance goes on and the controller answers it, so that a logged command is half cause and half answer: an
acceleration that lasts is taken to be balanced within `Memory.balance`. The four times are chosen on the flights that
the model is fitted to.
"""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

from mjxball.control import rotations
from nanobench.flights import GRAVITY, ROW, Array, Flight
from nanobench.rotation import Rotation, Track, lagged

HORIZONS = (0.1, 0.25, 0.5)  # [s]
HORIZON_ROWS = [round(horizon / ROW) for horizon in HORIZONS]
EVERY = 0.05  # [s] between forecasts
BEFORE = 0.05  # [s] before a clean forecast's start that must be undamaged too
STEP = 0.005  # [s] of the integration
NEVER = 1e3  # [s]
CHOICES = ((0.05, 0.1), (0.05, 0.2, 0.5), (0.3, 3.0), (0.01, 0.02, 0.03, 0.05, 0.1, NEVER))  # [s] to choose from


class Memory(NamedTuple):
    """How the disturbance of the past is carried on."""

    past: float  # [s] it is averaged over
    fade: float  # [s] in which it returns to its slow mean
    trend: float  # [s] of that mean
    balance: float  # [s] in which it balances what the model computes; `NEVER`: the disturbance is carried on alone


class Forecast(NamedTuple):
    """Forecasts of one flight, w of them; rows are 10 ms apart, the last axis is three rates and three angles."""

    start: Array  # (w,) [s]
    clean: Array  # (w, H) bool: no damaged row from just before the start to the horizon
    paths: dict[str, Array]  # predictor -> (rows, w, 6) [rad/s] and [rad]; "measured rates" integrates the gyro
    measured: Array  # (rows, w, 6) gyro and motion capture

    def rates(self, predictor: str) -> Array:
        """Predicted minus measured rates (rows, w, 3) [rad/s]."""
        return self.paths[predictor][..., :3] - self.measured[..., :3]

    def attitude(self, predictor: str, reference: str = "motion capture") -> Array:
        """Predicted minus measured roll, pitch, yaw (rows, w, 3) [rad], or minus the integrated gyro's."""
        truth = self.measured if reference == "motion capture" else self.paths["measured rates"]
        return self.paths[predictor][..., 3:] - truth[..., 3:]


def disturbance(track: Track, fit: Rotation, past: float) -> Array:
    """(k, 3) angular acceleration [rad/s2] that `fit` leaves unexplained, averaged over the last `past` seconds."""
    explained = _explained(track, fit)
    keep = np.exp(-ROW / past)

    def average(values: Array) -> Array:
        return values[0] + lfilter([1 - keep], [1, -keep], values - values[0], axis=0)

    return (track.rates - average(track.rates)) / past - average(explained)


def _explained(track: Track, fit: Rotation) -> Array:
    found = _torque(track, fit, track.time)
    found[:, :2] += fit.blow_back * track.across
    return found


def _torque(track: Track, fit: Rotation, time: Array) -> Array:
    """(..., 3) angular acceleration [rad/s2] by the motors at `time` (...)."""
    force = lagged(track.force, fit.lag)
    return np.stack([fit.gain[a] * np.interp(time - fit.delay, track.grid, force[:, a]) for a in range(3)], axis=-1)


def forecast(flight: Flight, track: Track, fit: Rotation, memory: Memory, unbalanced: Memory | None = None) -> Forecast:
    """Forecasts of `flight` every 50 ms; `unbalanced`, if given, is the memory of the row "model, no balance"."""
    stride, reach = round(EVERY / ROW), round(HORIZONS[-1] / ROW)
    begins = np.arange(round(0.5 / ROW), len(track.time) - reach - 1, stride)
    start = track.time[begins]
    attitude, rates = _quaternions(flight, start), track.rates[begins]
    paths = {
        "model": _fly(track, fit, begins, attitude, memory),
        "constant rate": _turn(np.broadcast_to(rates, (reach + 1, *rates.shape)), attitude),
        "measured rates": _turn(track.rates[begins + np.arange(reach + 1)[:, None]], attitude),
    }
    if unbalanced:
        paths["model, no balance"] = _fly(track, fit, begins, attitude, unbalanced)
    rows = begins + np.arange(reach + 1)[:, None]
    seen = _euler(_quaternions(flight, track.time[rows].ravel())).reshape(*rows.shape, 3)
    measured = np.concatenate([track.rates[rows], seen], axis=2)
    return Forecast(start, _clean(flight, start), paths, measured)


def choose_memory(flights: list[Flight], tracks: list[Track], fit: Rotation) -> tuple[Memory, Memory]:
    """The memories, in general and without balance, with the least errors of roll and pitch rate on `flights`.

    The loss is the mean over the horizons of the log of the mean square error.
    """

    def loss(memory: Memory) -> float:
        made = [forecast(f, t, fit, memory).rates("model") for f, t in zip(flights, tracks, strict=True)]
        errors = np.concatenate(made, axis=1)[HORIZON_ROWS, :, :2]
        return float(np.mean(np.log(np.mean(errors**2, axis=(1, 2)))))

    losses = {memory: loss(memory) for memory in (Memory(*times) for times in itertools.product(*CHOICES))}
    alone = {memory: value for memory, value in losses.items() if memory.balance == NEVER}
    return min(losses, key=losses.__getitem__), min(alone, key=alone.__getitem__)


def _fly(track: Track, fit: Rotation, begins: Array, attitude: Array, memory: Memory) -> Array:
    """Rates and Euler angles (rows, w, 6) of the model, one row every 10 ms from rows `begins` (w,) on."""
    steps, rows = round(HORIZONS[-1] / STEP), []
    torque = _torque(track, fit, track.time[begins] + STEP * (np.arange(steps + 1)[:, None] + 0.5))
    trend = disturbance(track, fit, memory.trend)[begins]
    extra = disturbance(track, fit, memory.past)[begins] - trend
    rates, across, answer = track.rates[begins], track.across[begins], np.zeros_like(trend)
    for step in range(steps + 1):
        euler = _euler(attitude)
        if step % round(ROW / STEP) == 0:
            rows.append(np.concatenate([rates, euler], axis=1))
        turning = torque[step] + trend + extra * np.exp(-(step + 0.5) * STEP / memory.fade)
        turning[:, :2] += fit.blow_back * across
        answer = answer + STEP / memory.balance * (turning - answer)
        turning = turning - answer
        attitude = rotations.integrate_quaternion(attitude, STEP * (rates + 0.5 * STEP * turning))
        rates = rates + STEP * turning
        # Thrust about carries the weight: tilt accelerates the drone to its side, which blow-back answers.
        across = across + STEP * GRAVITY * np.stack([-np.tan(euler[:, 0]), np.tan(euler[:, 1])], axis=1)
    return np.stack(rows)


def _turn(rates: Array, attitude: Array) -> Array:
    """Rates and Euler angles (rows, w, 6) of `rates` (rows, w, 3) integrated from `attitude` (w, 4)."""
    rows = [np.concatenate([rates[0], _euler(attitude)], axis=1)]
    for before, after in itertools.pairwise(rates):
        attitude = rotations.integrate_quaternion(attitude, ROW * (before + after) / 2)
        rows.append(np.concatenate([after, _euler(attitude)], axis=1))
    return np.stack(rows)


def _clean(flight: Flight, start: Array) -> Array:
    """(w, H) whether no row between just before `start` and each horizon is damaged."""
    count = np.concatenate([[0], np.cumsum(flight.damaged)])
    first = np.searchsorted(flight.time, start - BEFORE)
    return np.stack([count[np.searchsorted(flight.time, start + h)] == count[first] for h in HORIZONS], axis=1)


def _quaternions(flight: Flight, time: Array) -> Array:
    found = np.stack([np.interp(time, flight.time, column) for column in flight.quaternion.T], axis=1)
    return found / np.linalg.norm(found, axis=1, keepdims=True)


def _euler(quaternion: Array) -> Array:
    return rotations.euler_from_matrix(rotations.matrix_from_quaternion(quaternion))
