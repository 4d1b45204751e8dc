"""The numbers of `control.swing` (ours)."""

from __future__ import annotations

from typing import Any

import numpy as np

from mjxball.baselines.lqg_design import kalman_gain

Array = Any
FREQUENCIES = (0.7, 0.95, 1.28, 1.73, 2.3, 3.1, 4.2, 5.7)  # [rad/s]
# How fast amplitude and phase may change, over the frequency, and how fast the constant may [1/s].
CHANGE, CONSTANT_CHANGE = 0.1, 0.3
ENERGY_TIME = 4.0  # [s] in which the energies are forgotten


def observers(period: float) -> Array:
    """(J, 5), see `swings_seen`: steady-state Kalman gains, of a measurement with a deviation of 1."""
    rows = []
    for frequency in FREQUENCIES:
        cos, sin = np.cos(frequency * period), np.sin(frequency * period)
        transition, sees = np.array([[1, 0, 0], [0, cos, -sin], [0, sin, cos]]), np.array([[1.0, 1.0, 0.0]])
        walks = np.array([CONSTANT_CHANGE, CHANGE * frequency, CHANGE * frequency]) * period
        gain, _ = kalman_gain(transition, sees, np.diag(walks**2), np.eye(1))
        rows.append([cos, sin, *gain[:, 0]])
    return np.array(rows)


def ahead(axis: Array, gain: Array, lag: float, period: float) -> Array:
    """(J, 2), see `swings_grown`: of a filter `axis` (5, 6), `gain` (5, 2) of loops behind rotors with a `lag` [s].

    A torque that swings reaches the loops through the filter's own model; what the filter then makes of their angle and
    rate is its estimate.
    """
    found = []
    transition, sees = axis[:, :5], np.eye(2, 5)
    loop = [0, 1, 4]  # angle, rate, rotors
    for frequency in FREQUENCIES:
        turn = np.exp(1j * frequency * period)
        swung = np.linalg.solve(turn * np.eye(3) - transition[np.ix_(loop, loop)], transition[loop, 2])[:2]
        onward = transition @ (np.eye(5) - gain @ sees)
        predicted = np.linalg.solve(turn * np.eye(5) - onward, transition @ gain @ swung)
        estimate = (predicted + gain @ (swung - predicted[:2]))[2]
        factor = (1 + 1j * frequency * lag) / estimate - 1
        found.append([factor.real, factor.imag])
    return np.array(found)
