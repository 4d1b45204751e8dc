"""From thrust commands to motor force, both drones at once: battery compensation, PWM, supply voltage, true force."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from mjxball.control import crazyflie, motors
from mjxball.fly.twin.conditions import Battery
from mjxball.fly.twin.kind import OLDER_FORCE, DroneKind

TAKEN = 0.01  # share of the measured voltage that the firmware's low-pass filter takes, 1000 times a second
FIRST = 4.2  # [V] that the filter starts from


class Power:
    """Batteries, the firmware's view of their voltage, and the force at a PWM."""

    def __init__(self, kind: DroneKind, battery: Battery, strength: tuple[float, float]):
        self.kind, self.strength = kind, np.array(strength, float)[:, None]
        self._battery = battery
        self._charge = np.full(2, battery.full)  # [V] without load
        self._filtered = np.full((2, 1), FIRST)
        self.requested = np.zeros((2, 4))
        self.voltage = self._charge.copy()
        self.compensate: Callable[[np.ndarray], np.ndarray] = self._compensate

    def sag_to(self, drone: int, volts: float) -> None:
        """The battery of `drone` holds `volts` [V] without load from here on."""
        self._charge[drone] = volts

    def _compensate(self, thrust: np.ndarray) -> np.ndarray:
        """Uncapped PWM (2, 4) of `thrust` commands (2, 4)."""
        if self.kind.compensated:
            found = motors.compensated(self.kind.constants, thrust, self._filtered)
        else:
            found = thrust
        self.requested = np.trunc(found)
        return self.requested

    def one(self, drone: int) -> Callable[[np.ndarray], np.ndarray]:
        """`compensate` for one drone's thrust commands (4,)."""

        def compensate(thrust: np.ndarray) -> np.ndarray:
            found = thrust
            if self.kind.compensated:
                found = motors.compensated(self.kind.constants, thrust, self._filtered[drone])
            found = np.trunc(found)
            self.requested = self.requested.copy()
            self.requested[drone] = found
            return found

        return compensate

    def drain(self, pwm: np.ndarray, seconds: float) -> None:
        """Time goes on by `seconds` [s] at `pwm` (2, 4); the voltage follows the load at once."""
        load = pwm.mean(axis=1) / motors.FULL
        self._charge = self._charge - self._battery.drain * seconds * load
        self.voltage = self._charge - self._battery.sag * load
        share = 1 - (1 - TAKEN) ** round(1000 * seconds)
        self._filtered = self._filtered + share * (self.voltage[:, None] - self._filtered)

    def force(self, pwm: np.ndarray) -> np.ndarray:
        """Steady force (2, 4) [N] of every motor at `pwm` (2, 4)."""
        if self.kind.older_force:
            return self.strength * crazyflie.motor_force(OLDER_FORCE, pwm)
        return self.strength * motors.force(self.kind.constants, pwm, self.voltage[:, None])
