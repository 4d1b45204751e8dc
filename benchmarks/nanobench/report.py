"""The comparison with real flights as tables of text and as a picture."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from mjxball.plotting import pyplot
from nanobench.flights import ROW, Array
from nanobench.forecast import HORIZON_ROWS
from nanobench.rotation import AXES
from nanobench.study import Study

LABELS = {"model": "model", "constant rate": "constant rate", "model, no balance": "no balance"}
COLOURS = {"measured": "#222222", "model": "#2f5fa8", "constant rate": "#b3382c", "model, no balance": "#8a8a8a"}
SECONDS = 4.0  # of the picture
SHOWN = (HORIZON_ROWS[0], HORIZON_ROWS[1])  # rows ahead at which rates and attitude are drawn


def tables(data: dict[str, Any]) -> str:
    """What `study.to_json` holds, for the terminal."""
    parts = [_fit_lines(data), _forecast_lines(data), _cascade_lines(data), _thrust_lines(data), _range_lines(data)]
    return "\n\n".join("\n".join(part) for part in parts)


def _fit_lines(data: dict[str, Any]) -> Iterator[str]:
    yield f"fitted on {', '.join(data['fitted_on'])}"
    yield f"{'':27s}{'lag':>8s}{'delay':>8s}{'roll':>8s}{'pitch':>8s}{'yaw':>8s}{'J/m x':>9s}{'J/m y':>9s}  explained"
    for name, fit in (("fit", data["fit"]), *data["other_fits"].items()):
        errors = fit["standard_errors"]
        rows = [
            (name, fit["lag_s"], fit["delay_s"], fit["gain_rad_s2_per_nominal_N"].values()),
            ("  standard error", errors["lag"], errors["delay"], errors["gain"]),
        ]
        for label, lag, delay, gains in rows:
            line = f"{label:27s}{1e3 * lag:5.0f} ms{1e3 * delay:5.0f} ms" + "".join(f"{gain:8.0f}" for gain in gains)
            if label == name:
                line += "".join(f"{1e6 * value:9.0f}" for value in fit["inertia_over_mass_m2"])
                line += "  " + " ".join(f"{share:.2f}" for share in fit["explained"].values())
            yield line
    yield "gains in rad/s2 per N of the nominal curve, J/m in mm2"


def _forecast_lines(data: dict[str, Any]) -> Iterator[str]:
    for name in data["held_out"]:
        flight = data["forecasts"][name]
        yield f"{name}: {flight['windows']} forecasts, median / 90 % / 99 % of |error|"
        for horizon, cell in flight["horizons"].items():
            for axis in AXES:
                line = f"  {horizon:>4s} s {axis:5s}"
                for predictor, label in LABELS.items():
                    line += f"  {label} {_triple(cell[predictor]['rate_deg_s'][axis], 0)} deg/s"
                    line += f" {_triple(cell[predictor]['attitude_deg'][axis], 1)} deg"
                yield line + f"  floor {_triple(cell['measured rates']['attitude_deg'][axis], 1)} deg"


def _cascade_lines(data: dict[str, Any]) -> Iterator[str]:
    yield "cascade: computed minus logged PWM, rms over 0.5 s, median / 90 % / 99 %; of the command itself"
    for name, found in data["cascade"].items():
        yield name
        for part, values in found["errors_pwm"].items():
            whole = found["errors_with_integrals_of_the_whole_flight_pwm"][part]
            own = found["commands_pwm"][part]
            line = f"  {part:10s} {_triple(values, 0)}  of {_triple(own, 0)}"
            yield line + f"  (levels not taken out {_triple(whole, 0)})"
        curves = found["mean_pwm_if_compensated_for"]
        yield "  mean PWM if compensated for " + ", ".join(f"{motor} {value:+.0f}" for motor, value in curves.items())
    for name in data["forecasts"].keys() - data["cascade"].keys():
        yield f"{name}: its PID columns are zero, another controller flew"


def _thrust_lines(data: dict[str, Any]) -> Iterator[str]:
    yield "specific force: what is left [m/s2], mean and 90 % of |.| of each flight"
    for model, fit in data["thrust"]["models"].items():
        numbers = ", ".join(f"{c:.3g} +- {e:.1g}" for c, e in zip(fit["coefficients"], fit["errors"], strict=True))
        yield f"  {model:34s} {numbers}"
        yield "      " + "  ".join(
            f"{name} {left['mean']:+.3f}, {left['quantiles'][1]:.3f}" for name, left in fit["left_m_s2"].items()
        )
    for group, found in data["thrust"]["exponents"].items():
        yield f"  {group}: " + ", ".join(f"{key} ^{value:.2f} +- {error:.2f}" for key, (value, error) in found.items())


def _range_lines(data: dict[str, Any]) -> Iterator[str]:
    yield "ranges over all fits"
    for name, span in data["ranges"].items():
        if span:
            yield f"  {name:26s} {span[0]:.3f} .. {span[1]:.3f}"


def _triple(values: list[float], digits: int) -> str:
    return "/".join(f"{value:.{digits}f}" for value in values)


def draw(found: Study, path: Path) -> None:
    """Two axes of a held-out flight, measured and forecast, and errors against the horizon, to `path`."""
    plt = pyplot()
    plt.rcParams["svg.fonttype"] = "none"  # text as text: half the size
    name = found.held_out[0]
    figure, places = plt.subplots(3, 2, figsize=(11, 9), layout="constrained")
    for number in (0, 1):
        _drawn(places[0, number], found, name, number, SHOWN[0], f"{AXES[number]} rate [deg/s]")
        _drawn(places[1, number], found, name, 3 + number, SHOWN[1], f"{AXES[number]} [deg]")
    _horizons(places[2, 0], found, "rate [deg/s]", slice(0, 2))
    _horizons(places[2, 1], found, "angle [deg]", slice(3, 5))
    figure.suptitle(f"Held-out flights: {', '.join(found.held_out)}; above, a part of {name}")
    figure.savefig(path, dpi=80)
    plt.close(figure)


def _drawn(place: Any, found: Study, name: str, column: int, ahead: int, label: str) -> None:
    """Measured values and those forecast `ahead` rows before."""
    made = found.forecasts[name]
    begin = _liveliest(made.start, made.measured[0])
    time = made.start + ahead * ROW
    shown = (time >= begin) & (time < begin + SECONDS)
    lines = {"measured": made.measured, "constant rate": made.paths["constant rate"], "model": made.paths["model"]}
    for key, values in lines.items():
        style = {"lw": 2.2, "alpha": 0.6} if key == "measured" else {"lw": 1.0}
        place.plot(time[shown], np.degrees(values[ahead, shown, column]), color=COLOURS[key], label=key, **style)
    place.set(ylabel=label, xlabel="time [s]", title=f"forecast {ahead * ROW:g} s before")
    if column == 0:
        place.legend(loc="lower right", fontsize=8)


def _liveliest(start: Array, measured: Array) -> float:
    """Where the `SECONDS` with the largest roll and pitch rates together begin."""
    count = round(SECONDS / (start[1] - start[0]))
    power = np.convolve(np.minimum(*(measured[:, :2] ** 2).T), np.ones(count), "valid")
    return float(start[int(np.argmax(power))])


def _horizons(place: Any, found: Study, label: str, columns: slice) -> None:
    """Median and 90 % of the errors of roll and pitch over all held-out flights."""
    made = [found.forecasts[name] for name in found.held_out]
    time = np.arange(len(made[0].measured)) * ROW
    for predictor, text in LABELS.items():
        errors = np.concatenate([one.paths[predictor] - one.measured for one in made], axis=1)[..., columns]
        for share, style in ((0.5, "-"), (0.9, "--")):
            values = np.degrees(np.quantile(np.abs(errors), share, axis=(1, 2)))
            place.plot(time, values, style, color=COLOURS[predictor], label=f"{text}, {100 * share:.0f} %")
    top = np.degrees(np.quantile(np.abs(made[0].paths["constant rate"] - made[0].measured)[-1][:, columns], 0.9))
    place.set(xlabel="horizon [s]", ylabel=f"error, {label}", xlim=(0, 0.5), ylim=(0, 1.3 * top))
    place.legend(fontsize=8)
