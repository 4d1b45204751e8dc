"""Real flights held against the plant, the cascade and the motors of this project: all numbers of the comparison."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjxball import config
from mjxball.errors import InputError
from mjxball.plant.rotors import lever
from nanobench import cascade, lift
from nanobench.flights import Array, Flight, find_flights, read_flight
from nanobench.forecast import HORIZON_ROWS, HORIZONS, Forecast, Memory, choose_memory, forecast
from nanobench.rotation import AXES, POLE, POLES, Rotation, fit_rotation, track_of

FITTED = ("B3_figure8_slow_rep2", "B10_lissajous_slow_rep1")
QUANTILES = (0.5, 0.9, 0.99)
LEAST_CLEAN = 30  # forecasts of a flight below which no quantiles of clean ones are given
FULL_BATTERY, EMPTY_BATTERY = 4.2, 3.2  # [V]


class Study(NamedTuple):
    """Everything found."""

    flights: dict[str, Flight]
    fitted: list[str]
    held_out: list[str]
    fit: Rotation
    others: dict[str, Rotation]  # other filters, and the held-out flights fitted alone
    memory: Memory
    unbalanced: Memory
    forecasts: dict[str, Forecast]
    cascades: dict[str, cascade.Replayed]
    lifts: dict[str, lift.Lift]
    thrust: dict[str, lift.Fit]


def study(directory: Path, fitted: tuple[str, ...] = FITTED) -> Study:
    """Fit the flights `fitted` of `directory`, hold all others against the fit. Raises InputError."""
    paths = find_flights(directory)
    missing = [name for name in fitted if name not in paths]
    if missing:
        raise InputError(f"{directory} lacks the flight {missing[0]} that the model is to be fitted to; see --fit")
    held_out = [name for name in paths if name not in fitted]
    if not held_out:
        raise InputError(f"{directory} holds no flight besides those that the model is fitted to")
    flights = {name: read_flight(paths[name]) for name in [*fitted, *held_out]}
    tracks = {name: track_of(flight) for name, flight in flights.items()}
    mine, theirs = ([tracks[name] for name in names] for names in (fitted, held_out))
    fit = fit_rotation(mine)
    others = {f"filter pole {pole:g}": fit_rotation(mine, pole) for pole in POLES}
    others["held-out flights alone"] = fit_rotation(theirs)
    memory, unbalanced = choose_memory([flights[name] for name in fitted], mine, fit)
    lifts = {name: lift.lift_of(flight, fit.lag, fit.delay) for name, flight in flights.items()}
    return Study(
        flights=flights,
        fitted=list(fitted),
        held_out=held_out,
        fit=fit,
        others=others,
        memory=memory,
        unbalanced=unbalanced,
        forecasts={name: forecast(flights[name], tracks[name], fit, memory, unbalanced) for name in flights},
        cascades={name: cascade.replay(flight) for name, flight in flights.items() if flight.has_cascade},
        lifts=lifts,
        thrust=lift.compare({n: lifts[n] for n in fitted}, {n: lifts[n] for n in held_out}),
    )


def to_json(found: Study) -> dict[str, Any]:
    """Everything that is reported, as plain numbers: angles in degrees, rates in degrees/s."""
    return {
        "fitted_on": found.fitted,
        "held_out": found.held_out,
        "fit": {**_rotation(found, found.fit), "pole": POLE},
        "other_fits": {name: _rotation(found, fit) for name, fit in found.others.items()},
        "memory_s": found.memory._asdict(),
        "memory_without_balance_s": found.unbalanced._asdict(),
        "forecasts": {name: _forecast(made) for name, made in found.forecasts.items()},
        "cascade": {name: _cascade(found, name) for name in found.cascades},
        "thrust": _thrust(found),
        "ranges": ranges(found),
    }


def inertia_over_mass(found: Study, fit: Rotation) -> Array:
    """(2,) moment of inertia about x and y over mass [m2], from torque over inertia and force over mass."""
    plant = config.preset("flight").plant
    side = lever(plant.arm, plant.layout)
    return side * lift.nominal_factor(found.thrust) / fit.gain[:2]


def plant_inertia_over_mass() -> Array:
    """(2,) of the simulated drone [m2]."""
    plant = config.preset("flight").plant
    return np.array(plant.pair[0].inertia[:2]) / plant.pair[0].mass


def ranges(found: Study) -> dict[str, Any]:
    """What training should draw: from the least to the largest of all fits with one standard error."""
    fits = [found.fit, *found.others.values()]
    share = EMPTY_BATTERY / FULL_BATTERY
    both = [lift.elasticities([found.lifts[n] for n in names]) for names in (found.fitted, found.held_out)]

    def loss(name: str) -> list[float]:
        return sorted(1 - share ** side[name][0] for side in both if name in side)

    scale = [inertia_over_mass(found, fit) / plant_inertia_over_mass() for fit in fits]
    return {
        "motor_lag_s": _span([fit.lag for fit in fits]),
        "delay_s": _span([fit.delay for fit in fits]),
        "lag_plus_delay_s": _span([fit.lag + fit.delay for fit in fits]),
        "inertia_scale": _span(np.concatenate(scale)),
        "thrust_loss_constant_pwm": _span(loss("voltage")),
        "thrust_loss_compensated": _span(loss("voltage, compensated")) if loss("voltage, compensated") else None,
    }


def _span(values: Any) -> list[float]:
    return [float(np.min(values)), float(np.max(values))]


def _rotation(found: Study, fit: Rotation) -> dict[str, Any]:
    errors = {name: np.asarray(value).tolist() for name, value in fit.errors.items()}
    return {
        "lag_s": fit.lag,
        "delay_s": fit.delay,
        "gain_rad_s2_per_nominal_N": dict(zip(AXES, fit.gain.tolist(), strict=True)),
        "blow_back_rad_s2_per_m_s": fit.blow_back.tolist(),
        "inertia_over_mass_m2": inertia_over_mass(found, fit).tolist(),
        "inertia_scale": (inertia_over_mass(found, fit) / plant_inertia_over_mass()).tolist(),
        "standard_errors": errors,
        "explained": dict(zip(AXES, fit.explained.tolist(), strict=True)),
        "rows": fit.rows,
    }


def quantiles(errors: Array) -> dict[str, list[float]]:
    """Axis -> quantiles of |errors| (w, 3) [rad...] in degrees."""
    values = np.degrees(np.quantile(np.abs(errors), QUANTILES, axis=0))
    return {axis: values[:, number].tolist() for number, axis in enumerate(AXES)}


def _forecast(made: Forecast) -> dict[str, Any]:
    result: dict[str, Any] = {"windows": len(made.start), "horizons": {}}
    for number, (horizon, row) in enumerate(zip(HORIZONS, HORIZON_ROWS, strict=True)):
        clean = made.clean[:, number]
        cell: dict[str, Any] = {"clean_windows": int(clean.sum())}
        for predictor in made.paths:
            cell[predictor] = {
                "rate_deg_s": quantiles(made.rates(predictor)[row]),
                "attitude_deg": quantiles(made.attitude(predictor)[row]),
                "attitude_against_gyro_deg": quantiles(made.attitude(predictor, "gyro")[row]),
            }
            if clean.sum() >= LEAST_CLEAN:
                cell[predictor]["rate_clean_deg_s"] = quantiles(made.rates(predictor)[row][clean])
        result["horizons"][f"{horizon:g}"] = cell
    return result


def _cascade(found: Study, name: str) -> dict[str, Any]:
    replayed = found.cascades[name]

    def table(errors: dict[str, Array]) -> dict[str, list[float]]:
        return {part: np.quantile(values, QUANTILES).tolist() for part, values in errors.items()}

    return {
        "windows": len(cascade.errors(replayed)["m1"]),
        "errors_pwm": table(cascade.errors(replayed)),
        "errors_with_integrals_of_the_whole_flight_pwm": table(cascade.errors(replayed, level=False)),
        "commands_pwm": table(cascade.sizes(replayed)),
        "mean_pwm_if_compensated_for": cascade.compensation(found.flights[name]),
    }


def _thrust(found: Study) -> dict[str, Any]:
    def left(fit: lift.Fit) -> dict[str, dict[str, Any]]:
        return {
            name: {"mean": float(rest.mean()), "quantiles": np.quantile(np.abs(rest), QUANTILES).tolist()}
            for name, rest in fit.left.items()
        }

    groups = {"fitted": found.fitted, "held out": found.held_out}
    return {
        "models": {
            model: {"coefficients": fit.coefficients.tolist(), "errors": fit.errors.tolist(), "left_m_s2": left(fit)}
            for model, fit in found.thrust.items()
        },
        "exponents": {key: lift.elasticities([found.lifts[n] for n in names]) for key, names in groups.items()},
    }
