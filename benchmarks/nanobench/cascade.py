"""The firmware's cascade as computed here, from a real flight's logged setpoints and states, beside its motor commands.

Nothing is fitted: delivered gains at 500 Hz, and the battery compensation of the nominal motor at the logged voltage.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjxball.config import Autopilot
from mjxball.control import crazyflie, motors
from mjxball.control.motors import MOTORS
from nanobench.flights import ROW, Array, Flight
from nanobench.rotation import MOTOR, SIGNS

WINDOW = 0.5  # [s] whose rms is one sample of an error


class Replayed(NamedTuple):
    """Motor commands computed beside the logged ones, every 10 ms in flight."""

    time: Array  # (k,) [s]
    computed: Array  # (k, 4) PWM
    logged: Array  # (k, 4) PWM


def replay(flight: Flight) -> Replayed:
    """Run the cascade over `flight` from its first thrust on, integrals included."""
    time = flight.time
    begin = time[np.flatnonzero(flight.thrust > crazyflie.IDLE)[0]]
    grid = np.arange(begin, time[flight.airborne.stop], crazyflie.PERIOD)

    def on(columns: Array) -> Array:
        return np.stack([np.interp(grid, time, column) for column in columns.T], axis=1)

    euler, rates, wanted = on(flight.estimate), on(flight.gyro), on(flight.wanted)
    thrust, supply = np.interp(grid, time, flight.thrust), np.interp(grid, time, flight.supply)
    loops, autopilot, found = crazyflie.start_loops(euler[0], rates[0]), Autopilot(), np.empty((len(grid), 4))
    for tick in range(len(grid)):
        loops[12] = wanted[tick, 2]  # an absolute yaw, which the wire's yaw rate does not move
        setpoint = np.array([wanted[tick, 0], wanted[tick, 1], 0.0, thrust[tick]])
        # The firmware's position controller may ask for more than a setpoint's 60 000.
        beyond = max(thrust[tick] - crazyflie.THRUST_CEILING, 0.0)

        def compensate(command: Array, beyond: float = beyond, volts: Array = supply[tick]) -> Array:
            return motors.compensated(MOTOR, command + beyond, volts)

        loops, found[tick] = crazyflie.cascade(autopilot, loops, setpoint, euler[tick], rates[tick], None, compensate)
    rows = time[flight.airborne]
    computed = np.stack([np.interp(rows, grid, column) for column in found.T], axis=1)
    return Replayed(rows, computed, flight.pwm[flight.airborne])


def errors(replayed: Replayed, level: bool = True) -> dict[str, Array]:
    """Rms over windows of 0.5 s (w,) of every motor and of collective, roll, pitch, yaw, in PWM units of one motor.

    Rows that the radio lost leave the integrals at a level that cannot be known: with `level` every window's mean is
    taken from the logged commands, except that of the collective, which no integral is part of.
    """
    motor = replayed.computed - replayed.logged
    parts = {f"m{number + 1}": motor[:, number] for number in range(4)}
    parts |= dict(zip(("roll", "pitch", "yaw"), (motor @ SIGNS.T / 4).T, strict=True))
    found = {name: _windowed(values, level) for name, values in parts.items()}
    return {**found, "collective": _windowed(motor.mean(axis=1), False)}


def sizes(replayed: Replayed) -> dict[str, Array]:
    """Rms over windows of the logged commands themselves, about means as in `errors`, to hold errors against."""
    still = np.broadcast_to(replayed.logged.mean(axis=0), replayed.logged.shape)
    return errors(replayed._replace(computed=still))


def compensation(flight: Flight) -> dict[str, float]:
    """Motor -> median of computed minus logged mean PWM if its curve had been the one that the firmware compensates."""
    rows = flight.airborne
    thrust, supply, logged = flight.thrust[rows], flight.supply[rows], flight.pwm[rows].mean(axis=1)
    return {
        name: float(np.median(motors.compensated(motor, thrust, supply) - logged)) for name, motor in MOTORS.items()
    }


def _windowed(values: Array, level: bool) -> Array:
    size = round(WINDOW / ROW)
    windows = values[: len(values) // size * size].reshape(-1, size)
    if level:
        windows = windows - windows.mean(axis=1, keepdims=True)
    return np.sqrt((windows**2).mean(axis=1))
