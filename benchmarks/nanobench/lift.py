"""Force over mass of real flights against motor command and battery voltage: candidate models, fitted and held out."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjxball.control import motors
from mjxball.control.motors import FULL, MOTORS
from nanobench.flights import ROW, Array, Flight
from nanobench.rotation import TICK, lagged

OLDER = motors.OLDER  # [N] a p^2 + b p without voltage, `Autopilot.motor_curve`
LINEAR = 0.12  # [N] at full command
AVERAGED = 25  # rows that one sample averages: 0.25 s, beyond propeller noise


class Lift(NamedTuple):
    """A flight's rows in flight, motor commands passed through the motors' lag."""

    force: Array  # (k,) specific force along body z [m/s2]
    product: Array  # (k,) mean of command times voltage [V]
    command: Array  # (k,) mean PWM as a share of full
    supply: Array  # (k,) [V]
    thrust: Array | None  # (k,) thrust command before compensation, share of full; None without the PID controller
    curves: dict[str, Array]  # model -> (k,) sum of the four forces [N]


class Fit(NamedTuple):
    """A model's coefficients and, per flight, what is left of the specific force [m/s2]."""

    coefficients: Array
    errors: Array
    left: dict[str, Array]


def lift_of(flight: Flight, lag: float, delay: float) -> Lift:
    """`flight`'s specific force beside what its motors were sent `delay` before, through the lag."""
    rows = np.arange(flight.time[flight.airborne.start], flight.time[flight.airborne.stop], ROW)
    rows = rows[: len(rows) // AVERAGED * AVERAGED]
    grid = np.arange(rows[0] - 0.5, rows[-1] + TICK, TICK)
    duty = np.stack([np.interp(grid, flight.time, column) for column in flight.pwm.T], axis=1) / FULL
    supply = np.interp(grid, flight.time, flight.supply)

    def late(values: Array) -> Array:
        return np.interp(rows - delay, grid, lagged(values, lag)).reshape(-1, AVERAGED).mean(axis=1)

    curves = {
        f"cubic {name}": late(motors.force(motor, duty * FULL, supply[:, None]).sum(axis=1))
        for name, motor in MOTORS.items()
    }
    curves["older curve, no voltage"] = late((OLDER[0] * duty**2 + OLDER[1] * duty).sum(axis=1))
    curves["linear, no voltage"] = late(LINEAR * duty.sum(axis=1))
    force = np.interp(rows, flight.time, flight.acceleration[:, 2]).reshape(-1, AVERAGED).mean(axis=1)
    thrust = late(np.interp(grid, flight.time, flight.thrust) / FULL) if flight.has_cascade else None
    return Lift(
        force, late((duty * supply[:, None]).mean(axis=1)), late(duty.mean(axis=1)), late(supply), thrust, curves
    )


def compare(fitted: dict[str, Lift], others: dict[str, Lift]) -> dict[str, Fit]:
    """Every candidate model fitted to `fitted` by least squares, and its residuals on all flights."""
    every = {**fitted, **others}
    terms: dict[str, dict[str, Array]] = {}  # model -> flight -> columns (k, terms)
    for flight, lift in every.items():
        one = np.ones_like(lift.force)
        columns = {f"factor x {name}": [curve] for name, curve in lift.curves.items()}
        columns["a + b command x voltage"] = [one, lift.product]
        columns["a + b command + c voltage"] = [one, lift.command, lift.supply]
        for model, parts in columns.items():
            terms.setdefault(model, {})[flight] = np.stack(parts, axis=1)
    force = np.concatenate([lift.force for lift in fitted.values()])
    found = {}
    for model, mine in terms.items():
        coefficients, errors = _least_squares(np.concatenate([mine[key] for key in fitted]), force)
        left = {key: every[key].force - mine[key] @ coefficients for key in every}
        found[model] = Fit(coefficients, errors, left)
    return found


def elasticities(lifts: list[Lift]) -> dict[str, tuple[float, float]]:
    """Exponents with standard errors: force ~ command^a voltage^b, and force / thrust command ~ voltage^c.

    The second is the loss that battery compensation leaves; it takes flights of the PID controller alone.
    """
    force, command, supply = (np.log(np.concatenate([getattr(lift, n) for lift in lifts])) for n in _LOGS)
    found, error = _least_squares(np.stack([np.ones_like(force), command, supply], axis=1), force)
    result = {"command": (float(found[1]), float(error[1])), "voltage": (float(found[2]), float(error[2]))}
    with_thrust = [lift for lift in lifts if lift.thrust is not None]
    if with_thrust:
        ratio = np.concatenate([np.log(lift.force / lift.thrust) for lift in with_thrust])
        supply = np.log(np.concatenate([lift.supply for lift in with_thrust]))
        found, error = _least_squares(np.stack([np.ones_like(ratio), supply], axis=1), ratio)
        result["voltage, compensated"] = (float(found[1]), float(error[1]))
    return result


_LOGS = ("force", "command", "supply")


def _least_squares(columns: Array, values: Array) -> tuple[Array, Array]:
    found = np.linalg.lstsq(columns, values, rcond=None)[0]
    left = values - columns @ found
    # Neighbouring samples are alike: errors as if every fourth counted.
    variance = 4 * np.mean(left**2) * np.linalg.inv(columns.T @ columns)
    return found, np.sqrt(np.diag(variance))


def nominal_factor(fit: dict[str, Fit]) -> float:
    """Force over mass per newton of the nominal curve [1/kg]."""
    return float(fit["factor x cubic 2.1"].coefficients[0])
