"""Command line of `python -m mjxball.rig.gains`: attitude and rate gains for two Crazyflies on one stick."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjxball import cli, config
from mjxball.config import Autopilot, Config
from mjxball.control.crazyflie import PERIOD, gains_to_json, pair_gains
from mjxball.errors import InputError
from mjxball.plotting import pyplot
from mjxball.rig.attitude import Trial, pair, simulate
from mjxball.rig.design import (
    FREQUENCIES,
    REQUIREMENTS,
    Design,
    Gains,
    Margins,
    apply,
    closed_poles,
    delivered_gains,
    design,
    loop_gain,
    nominal_and_worst,
)

PRESETS = ("flight", "stand")
PICTURES = (".svg", ".png", ".pdf")
COLOURS = {"delivered": "#b3382c", "designed": "#2f5fa8"}
STEP, LAGS, DELAY, SECONDS = 8.0, (0.03, 0.05, 0.1, 0.15), 0.01, 4.0


def parser() -> cli.Parser:
    """The flags."""
    result = cli.make_parser("python -m mjxball.rig.gains", "Compute gains for the coupled pair, with their margins.")
    result.add_argument("--preset", choices=PRESETS, default="flight", help="rig (default flight)")
    result.add_argument(
        "--plant", type=Path, metavar="NAME|FILE", help="shipped plant, or file of mjxball.rig.identify or by hand"
    )
    result.add_argument("--out", type=Path, metavar="GAINS.json", help="write what mjxball.fly --gains uploads")
    result.add_argument("--picture", type=Path, metavar="FILE", help="draw steps, poles and margins (svg, png, pdf)")
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Compute, print, write; return the exit code."""
    options = parser().parse_args(arguments)
    return cli.run_command(lambda: _gains(options))


def _gains(options: argparse.Namespace) -> int:
    settings = cli.apply_plant(config.preset(options.preset), options.plant)
    _ = settings.plant.pair  # InputError for teams
    if options.out:
        cli.output_file(options.out, ".json")
    if options.picture:
        if options.picture.suffix not in PICTURES:
            raise InputError(f"picture {options.picture} must end in {', '.join(PICTURES)}")
        cli.output_file(options.picture, options.picture.suffix)
    try:
        designs = design(settings)
    except ValueError as error:
        raise InputError(f"{error}: a lighter or shorter stick, or faster motors, would help") from None
    print(report(designs, settings.plant.rotor_lag))  # noqa: T201
    if options.out:
        options.out.write_text(parameter_file(apply(settings.autopilot, designs)))
    if options.picture:
        draw(settings, designs, options.picture)
    return 0


def parameter_file(autopilot: config.Autopilot) -> str:
    """JSON of both drones' firmware parameters, as `mjxball.fly --gains` reads it."""
    return json.dumps(gains_to_json(pair_gains(autopilot)), indent=1) + "\n"


def report(designs: Sequence[Design], lag: float) -> str:
    """A table: for each axis the designed gains and the delivered ones, with nominal and worst margins."""
    head = ("axis", "inertia", "gains", "attitude kp ki kd", "rate kp ki kd", "phase", "gain", "delay", "worst")
    rows: list[tuple[str, ...]] = [head]
    for one in designs:
        delivered = delivered_gains(one.axis)
        name = "kept" if one.gains == delivered else "designed"
        rows.append(_row(one, name, one.gains, one.nominal, one.worst))
        rows.append(_row(one, "delivered", delivered, *nominal_and_worst(delivered, one.axis, lag)))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]
    (low, high), (light, heavy) = REQUIREMENTS.lags, REQUIREMENTS.inertias
    lines += [
        f"margins at {1e3 * lag:.0f} ms motor lag and {1e3 * REQUIREMENTS.delay:.0f} ms loop delay; worst: phase and "
        f"gain over lag {1e3 * low:.0f} to {1e3 * high:.0f} ms, inertia x {light:g} to {heavy:g}, "
        f"delay {1e3 * REQUIREMENTS.worst_delay:.0f} ms"
    ]
    for one in designs:
        if one.nominal.phase and not one.worst.phase:
            alone = ", as one drone alone with delivered gains is" if one.gains == delivered_gains(one.axis) else ""
            lines.append(
                f"{one.axis.name} is unstable in the worst corner{alone}: measure the lag (mjxball.rig.identify)"
            )
    return "\n".join(lines)


def _row(one: Design, whose: str, gains: Gains, nominal: Margins, worst: Margins) -> tuple[str, ...]:
    numbers = (" ".join(f"{value:g}" for value in row) for row in gains)
    inertia = f"{one.axis.inertia_ratio:.1f} x"
    if not nominal.phase:
        return (one.axis.name, inertia, whose, *numbers, "unstable", "", "", "unstable")
    gain = f"x {nominal.gain_up:.1f}, / {nominal.gain_down:.1f}"
    left = f"{worst.phase:.0f} deg, x {worst.gain_up:.1f}, / {worst.gain_down:.1f}" if worst.phase else "unstable"
    return (one.axis.name, inertia, whose, *numbers, f"{nominal.phase:.0f} deg", gain, _ms(nominal.delay), left)


def _ms(seconds: float) -> str:
    return f"{1e3 * seconds:.0f} ms"


def draw(config: Config, designs: Sequence[Design], path: Path) -> None:
    """Steps, CG torque, root locus and loop gain about the axis that the stick makes heaviest, to `path`."""
    plt = pyplot()
    worst = max(designs, key=lambda one: one.axis.inertia_ratio)
    figure, places = plt.subplots(2, 2, figsize=(11, 7.6), layout="constrained")
    autopilots = {"delivered": _delivered(config), "designed": apply(config.autopilot, tuple(designs))}
    gains = {"delivered": delivered_gains(worst.axis), "designed": worst.gains}
    _steps(places[0, 0], config, autopilots, worst)
    _torque(places[0, 1], config, autopilots, worst)
    _locus(places[1, 0], config, gains, worst)
    _bode(places[1, 1], config, gains, worst)
    ratio = f"{worst.axis.name}: {worst.axis.inertia_ratio:.0f} times the inertia of the drones alone"
    figure.suptitle(f"Attitude loop of the coupled pair, {ratio}")
    figure.savefig(path, dpi=80)
    plt.close(figure)


def _delivered(config: Config) -> Autopilot:
    return Autopilot(kind="crazyflie", motor_curve=config.autopilot.motor_curve)


def _along(axis: str, size: float) -> tuple[float, float, float]:
    return size * (axis == "roll"), size * (axis == "pitch"), size * (axis == "yaw")


def _steps(place: Any, config: Config, autopilots: dict[str, Autopilot], worst: Design) -> None:
    yaw = worst.axis.name == "yaw"
    step = _along(worst.axis.name, 0.0 if yaw else STEP)
    trials = [Trial(step, lag=lag, delay=DELAY, yaw=-STEP if yaw else 0.0) for lag in LAGS]
    _draw_turns(place, config, autopilots, trials, worst)
    place.axhline(0 if yaw else STEP, color="0.6", lw=0.8)
    place.set(title=f"{STEP:g} degree step, motor lag 30 to 150 ms (thin to thick)", ylim=(-12, 28))
    place.legend(loc="upper right")


def _torque(place: Any, config: Config, autopilots: dict[str, Autopilot], worst: Design) -> None:
    axis = worst.axis
    moment = 0.5 * (axis.trim or 0.2 * axis.headroom) * np.radians(axis.gain) * axis.inertia
    trials = [Trial(lag=lag, delay=DELAY, torque=_along(axis.name, float(moment))) for lag in LAGS]
    _draw_turns(place, config, autopilots, trials, worst)
    place.set(title=f"Lasting moment of {1e3 * moment:.1f} mN m (ball half way to its stop)", ylim=(-12, 12))


def _draw_turns(
    place: Any, config: Config, autopilots: dict[str, Autopilot], trials: list[Trial], worst: Design
) -> None:
    number = ("roll", "pitch", "yaw").index(worst.axis.name)
    for name, autopilot in autopilots.items():
        angle = simulate(pair(config), autopilot, trials, SECONDS)[..., number]
        for column, width in enumerate(np.linspace(0.6, 2.2, len(trials))):
            label = name if column == 1 else None
            place.plot(np.arange(len(angle)) * PERIOD, angle[:, column], color=COLOURS[name], lw=width, label=label)
    place.set(xlabel="time [s]", ylabel=f"{worst.axis.name} [degrees]")


def _locus(place: Any, config: Config, gains: dict[str, Gains], worst: Design) -> None:
    """Closed-loop poles while the inertia grows from the drones' own to twice the pair's."""
    axis, lag = worst.axis, config.plant.rotor_lag
    for name, one in gains.items():
        for scale in np.geomspace(1 / axis.inertia_ratio, 2.0, 60):
            poles = closed_poles(one, axis.gain / scale, lag, DELAY)
            place.plot(poles.real, poles.imag, ".", color=COLOURS[name], ms=2, alpha=0.6)
        poles = closed_poles(one, axis.gain, lag, DELAY)
        place.plot(poles.real, poles.imag, "o", mfc="none", color=COLOURS[name], ms=8, label=f"{name}, the pair")
    place.axvline(0, color="0.4", lw=0.8)
    place.set(xlim=(-25, 8), ylim=(-25, 25), xlabel="real [1/s]", ylabel="imaginary [1/s]")
    place.set_title("Poles, inertia from one drone's to twice the pair's")
    place.legend(loc="upper left")


def _bode(place: Any, config: Config, gains: dict[str, Gains], worst: Design) -> None:
    """Loop gain in the plane of phase and size: the point to stay away from is at -180 degrees and 0 dB."""
    for name, one in gains.items():
        value = loop_gain(one, worst.axis.gain, config.plant.rotor_lag, DELAY, FREQUENCIES)
        angle = np.degrees(np.unwrap(np.angle(value)))
        angle += -360 * np.round((angle[np.argmin(np.abs(np.abs(value) - 1))] + 180) / 360)
        place.plot(angle, 20 * np.log10(np.abs(value)), color=COLOURS[name], label=name)
    place.plot([-180], [0], "k+", ms=12, mew=2)
    place.set(xlim=(-280, -80), ylim=(-40, 40), xlabel="phase [degrees]", ylabel="loop gain [dB]")
    place.set_title("Loop gain against phase; cross: instability")
    place.legend(loc="upper left")


if __name__ == "__main__":
    sys.exit(main())
