"""What computed gains do for the coupled pair of Crazyflies, beside the delivered ones: steps, poles, loop gain.

    python benchmarks/attitude_gains.py docs/crazyflie-gains.svg [--preset stand] [--plant PLANT.json]

`simulate` flies the firmware's cascade around the attitude alone.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjxball import cli
from mjxball.config import Autopilot, Config, preset
from mjxball.control import crazyflie, mixer, rotations
from mjxball.control.constants import hover
from mjxball.control.crazyflie import PERIOD
from mjxball.plotting import pyplot
from mjxball.rig.attitude import inertia_about_o
from mjxball.rig.design import FREQUENCIES, Design, Gains, apply, closed_poles, delivered_gains, design, loop_gain
from mjxball.rig.gains import PRESETS

COLOURS = {"delivered": "#b3382c", "designed": "#2f5fa8"}
STEP, LAGS, DELAY, SECONDS = 8.0, (0.03, 0.05, 0.1, 0.15), 0.01, 4.0
UPSET = 90.0  # attitude beyond which a case counts as diverged and is frozen [deg]


@dataclass(frozen=True)
class Trial:
    """One thing to try: a step of the commanded attitude or of an outer torque at time 0, on some plant."""

    step: tuple[float, float, float] = (0.0, 0.0, 0.0)  # roll, pitch [deg]; yaw is not commanded
    torque: tuple[float, float, float] = (0.0, 0.0, 0.0)  # [N m]
    lag: float = 0.05  # of the motors [s]
    inertia: float = 1.0  # factor
    delay: float = 0.0  # of the motor commands, whole ticks of 2 ms [s]
    yaw: float = 0.0  # at the start, to be held at 0 [deg]


class Body(NamedTuple):
    """What the cascade turns."""

    inertia: np.ndarray  # (3,) principal, about the axes that it turns about [kg m2]
    hover: float  # motor command in hover
    arm: float  # [m]
    yaw_per_thrust: float  # [m]
    drones: int  # that turn it, all sent the same


def pair(config: Config) -> Body:
    """The two drones of `config` and their object, turning about O."""
    plant = config.plant
    return Body(inertia_about_o(config), hover(config)[0], plant.arm, plant.yaw_per_thrust, 2)


def simulate(body: Body, autopilot: Autopilot, trials: Sequence[Trial], seconds: float = 4.0) -> np.ndarray:
    """Roll, pitch, yaw (ticks + 1, trials, 3) [deg] of the hovering `body`."""
    h, count = crazyflie.PERIOD, len(trials)
    inertia = np.outer([trial.inertia for trial in trials], body.inertia)
    keep = np.exp(-h / np.array([trial.lag for trial in trials]))[:, None]
    outer = np.array([trial.torque for trial in trials])
    wait = np.array([round(trial.delay / h) for trial in trials])
    setpoint = np.array([[t.step[0], -t.step[1], 0.0, round(body.hover)] for t in trials])
    quaternion = rotations.quaternion_from_euler(np.radians([[0.0, 0.0, trial.yaw] for trial in trials]))
    rates = np.zeros((count, 3))
    level = rotations.euler_from_matrix(rotations.matrix_from_quaternion(quaternion * 0 + [1.0, 0, 0, 0]))
    loops = crazyflie.start_loops(level, rates)
    force = np.full((count, 4), float(crazyflie.motor_force(autopilot.motor_curve, np.array(round(body.hover)))))
    sent = [np.full((count, 4), float(round(body.hover)))] * (int(wait.max()) + 1)  # newest first
    seen = [np.array([[0.0, 0.0, trial.yaw] for trial in trials])]
    for _ in range(round(seconds / h)):
        euler = rotations.euler_from_matrix(rotations.matrix_from_quaternion(quaternion))
        loops, motors = crazyflie.cascade(autopilot, loops, setpoint, euler, rates)
        sent = [motors, *sent[:-1]]
        late = np.stack(sent)[wait, np.arange(count)]
        target = crazyflie.motor_force(autopilot.motor_curve, late)
        force = target + keep * (force - target)
        torque = outer + body.drones * mixer.wrench_from_rotors(force, body.arm, body.yaw_per_thrust, "x")[:, 1:]
        upset = (np.abs(seen[-1][:, :2]) > UPSET).any(-1)[:, None]
        turned = rates + h * (torque - np.cross(rates, inertia * rates)) / inertia
        rates = np.where(upset, 0.0, turned)
        quaternion = rotations.integrate_quaternion(quaternion, h * rates)
        now = np.degrees(rotations.euler_from_matrix(rotations.matrix_from_quaternion(quaternion)))
        seen.append(np.where(upset, seen[-1], now))
    return np.stack(seen)


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw; return the exit code."""
    parser = cli.make_parser("python benchmarks/attitude_gains.py", __doc__.split("\n\n")[0])
    parser.add_argument("picture", type=Path, metavar="FILE", help="svg, png or pdf")
    parser.add_argument("--preset", choices=PRESETS, default="flight")
    parser.add_argument("--plant", type=Path, metavar="NAME|FILE")
    options = parser.parse_args(arguments)
    settings = cli.apply_plant(preset(options.preset), options.plant)
    draw(settings, design(settings), options.picture)
    return 0


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
