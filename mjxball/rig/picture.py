"""The picture beside the gains: why the delivered ones fail on the pair, and what the designed ones do."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjxball.config import Autopilot, Config
from mjxball.control.crazyflie import PERIOD
from mjxball.plotting import pyplot
from mjxball.rig.design import Design, apply, stock
from mjxball.rig.loop import FREQUENCIES, Gains, closed_poles, loop_gain
from mjxball.rig.response import Trial, turn

COLOURS = {"delivered": "#b3382c", "designed": "#2f5fa8"}
STEP, LAGS, DELAY, SECONDS = 8.0, (0.03, 0.05, 0.1, 0.15), 0.01, 4.0


def draw(config: Config, designs: Sequence[Design], path: Path) -> None:
    """Steps, CG torque, root locus and loop gain about the axis that the stick makes heaviest, to `path`."""
    plt = pyplot()
    worst = max(designs, key=lambda one: one.axis.scale)
    figure, places = plt.subplots(2, 2, figsize=(11, 7.6), layout="constrained")
    autopilots = {"delivered": _delivered(config), "designed": apply(config.autopilot, tuple(designs))}
    gains = {"delivered": stock(worst.axis), "designed": worst.gains}
    _steps(places[0, 0], config, autopilots, worst)
    _torque(places[0, 1], config, autopilots, worst)
    _locus(places[1, 0], config, gains, worst)
    _bode(places[1, 1], config, gains, worst)
    ratio = f"{worst.axis.name}: {worst.axis.scale:.0f} times the inertia of the drones alone"
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
        angle = turn(config, autopilot, trials, SECONDS)[..., number]
        for column, width in enumerate(np.linspace(0.6, 2.2, len(trials))):
            label = name if column == 1 else None
            place.plot(np.arange(len(angle)) * PERIOD, angle[:, column], color=COLOURS[name], lw=width, label=label)
    place.set(xlabel="time [s]", ylabel=f"{worst.axis.name} [degrees]")


def _locus(place: Any, config: Config, gains: dict[str, Gains], worst: Design) -> None:
    """Closed-loop poles while the inertia grows from the drones' own to twice the pair's."""
    axis, lag = worst.axis, config.plant.rotor_lag
    for name, one in gains.items():
        for scale in np.geomspace(1 / axis.scale, 2.0, 60):
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
