"""Flights of one Crazyflie simulated here and written in the NanoBench CSV layout, with everything known."""

from __future__ import annotations

import gzip
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mjxball.config import Autopilot
from mjxball.control import crazyflie, motors, rotations
from mjxball.control.motors import FULL
from nanobench.flights import GRAVITY, GROUPS
from nanobench.rotation import MOTOR, SIGNS

COLUMNS = [name for group in GROUPS.values() for name in group]
PERIOD = crazyflie.PERIOD
GROUND = 250  # ticks of 2 ms before take-off and after landing


class Truth(NamedTuple):
    """The drone that is simulated."""

    lag: float = 0.05  # [s]
    delay: int = 4  # ticks of 2 ms
    gain: tuple[float, float, float] = (1300.0, 1500.0, 150.0)  # [rad/s2 per N]
    blow_back: float = 15.0  # [rad/s2 per m/s]
    force_over_mass: float = 22.0  # per newton of the nominal curve [1/kg]
    gusts: float = 2.0  # rms of the disturbance, correlated over 0.1 s [rad/s2]
    noise: float = 0.003  # of the gyro [rad/s]


def fly(truth: Truth, seconds: float, flights: int, seed: int = 0) -> list[dict[str, np.ndarray]]:
    """Of every flight column -> values every 10 ms: rest, take-off, tilts every 0.3 s on a sagging battery, landing.

    Attitude loops at 500 Hz around rates that answer lagged, delayed forces, blow-back and gusts; the yaw is held.
    """
    rng, ticks = np.random.default_rng(seed), round(seconds / PERIOD)
    fade, keep = np.exp(-PERIOD / 0.1), np.exp(-PERIOD / truth.lag)
    autopilot, gain = Autopilot(), np.array(truth.gain)
    rates, velocity, gust, place = (np.zeros((flights, 3)) for _ in range(4))
    quaternion = np.tile([1.0, 0.0, 0.0, 0.0], (flights, 1))
    loops = crazyflie.start_loops(rates, rates)
    sent, force, wanted = np.zeros((truth.delay + 1, flights, 4)), np.zeros((flights, 4)), np.zeros((flights, 3))
    rows = []
    for tick in range(ticks):
        flying = GROUND <= tick < ticks - GROUND
        supply = np.full((flights, 1), 3.8 - 0.3 * tick / ticks)
        euler = rotations.euler_from_matrix(rotations.matrix_from_quaternion(quaternion))
        if tick % 150 == 0:
            # Firmware's signs: a positive roll pushes to -y, a positive pitch to -x, which leads back to rest.
            home = velocity[:, 1::-1] + 0.5 * place[:, 1::-1]
            goal = np.pad(np.clip(5 * rng.normal(size=(flights, 2)) + 6 * home, -15, 15), ((0, 0), (0, 1)))
        wanted = wanted + PERIOD / 0.05 * (goal - wanted)  # smooth, as from a position controller
        level = (GRAVITY - 2 * velocity[:, 2:] - 2 * place[:, 2:]) / truth.force_over_mass / 4 / MOTOR.max_force
        thrust = FULL * np.clip(level, 0.3, 0.95) * flying
        seen = rates + truth.noise * rng.normal(size=(flights, 3))
        setpoint = np.concatenate([wanted, thrust], axis=1)
        # The cascade caps thrust commands at 60 000; the firmware's position controller goes beyond.
        extra = np.maximum(thrust - crazyflie.THRUST_CEILING, 0.0)

        def compensate(command: np.ndarray, extra: np.ndarray = extra, supply: np.ndarray = supply) -> np.ndarray:
            return motors.compensated(MOTOR, command + extra, supply)

        loops, pwm = crazyflie.cascade(autopilot, loops, setpoint, euler, seen, None, compensate)
        sent = np.concatenate([sent[1:], pwm[None]])
        force = keep * force + (1 - keep) * motors.force(MOTOR, sent[0], supply)
        specific = truth.force_over_mass * force.sum(axis=1, keepdims=True)
        if tick % 5 == 0:
            group = {
                "time": np.full((flights, 1), 1e5 + tick * PERIOD),
                "velocity": velocity,
                "quaternion": quaternion,
                "acceleration": np.pad(specific / GRAVITY, ((0, 0), (2, 0))),
                "gyro": seen,
                "pwm": pwm,
                "place": place,
                "drift": velocity,
                "estimate": crazyflie.to_firmware(euler),
                "wanted": wanted,
                "thrust": thrust,
                "supply": supply,
            }
            rows.append(np.concatenate([group[name] for name in GROUPS], axis=1))
        if flying:
            white = rng.normal(size=(flights, 3)) * [1, 1, 0.1]
            gust = fade * gust + truth.gusts * np.sqrt(1 - fade**2) * white
            blown = truth.blow_back * np.stack([velocity[:, 1], -velocity[:, 0], np.zeros(flights)], axis=1)
            turning = gain * (force @ SIGNS.T) + blown + gust
            quaternion = rotations.integrate_quaternion(quaternion, PERIOD * (rates + 0.5 * PERIOD * turning))
            rates = rates + PERIOD * turning
            up = rotations.matrix_from_quaternion(quaternion)[..., 2]
            velocity = velocity + PERIOD * (specific * up - [0, 0, GRAVITY])
            place = place + PERIOD * velocity
    table = np.stack(rows, axis=1)
    return [dict(zip(COLUMNS, one.T, strict=True)) for one in table]


def write(columns: dict[str, np.ndarray], path: Path) -> Path:
    """`columns` as a CSV file, packed if `path` ends in .gz."""
    rows = zip(*columns.values(), strict=True)
    text = "\n".join([",".join(columns), *(",".join(f"{value:.9f}" for value in row) for row in rows)]) + "\n"
    path.write_bytes(gzip.compress(text.encode()) if path.suffix == ".gz" else text.encode())
    return path
