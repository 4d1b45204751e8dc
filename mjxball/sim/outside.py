"""Checks a rig against the random rigs that a follower was trained on (ours)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mjxball.config import Config, Plant, Range
from mjxball.plant.parameters import plant_parameters
from mjxball.sim import rigs


def outside(config: Config, trained: Config) -> list[str]:
    """Properties of the rig of `config` outside the ranges of random rigs in `trained`, one phrase each."""
    plant, sizes = config.plant, trained.scenario.team_sizes
    drones, gravity = plant.drones, plant.gravity
    masses = [drone.mass for drone in drones]
    weight = sum(masses) + plant.carrier_mass + plant.object_mass
    strongest = 4 * sum(plant.of_drones("rotor_force_max"))
    found: list[tuple[str, Sequence[float], Range, str]] = [
        ("drones", [plant.count], (min(sizes), max(sizes)), ""),
        ("mass of a drone", masses, rigs.DRONE_MASS, " kg"),
        ("rotor arm over 0.12 m (mass / kg)^(1/3)", _over_usual_arm(plant), rigs.ARM_SCALE, ""),
        ("object's mass over that of all drones", [plant.object_mass / sum(masses)], rigs.OBJECT_SHARE, ""),
        ("largest thrust over the weight", [strongest / gravity / weight], rigs.THRUST_TO_WEIGHT, ""),
        ("rotor lag", plant.of_drones("rotor_lag"), rigs.ROTOR_LAG, " s"),
    ]
    if config.autopilot.kind == "ideal":
        loops, damping = config.attitude.natural_frequency[:2], config.attitude.damping
        slow, fast = rigs.LOOP_FREQUENCY
        found += [
            ("attitude loop", loops, (slow * rigs.FREQUENCY_RATIO[0], fast * rigs.FREQUENCY_RATIO[1]), " rad/s"),
            ("damping of the attitude loop", [damping], rigs.LOOP_DAMPING, ""),
        ]
    texts = [
        f"{name} {value:.3g}{unit}, trained from {low:g} to {high:g}{unit}"
        for name, values, (low, high), unit in found
        for value in sorted({min(values), max(values)})
        if not low * (1 - 1e-6) <= value <= high * (1 + 1e-6)
    ]
    answered = _answered_tilt(config, gravity * weight / (4 * plant.count))
    if config.autopilot.kind == "ideal" and answered < rigs.UNSATURATED_TILT * (1 - 1e-6):
        texts.append(
            f"rotors saturate from a tilt step of {answered:.3g} rad on, "
            f"trained from {rigs.UNSATURATED_TILT:g} rad upwards"
        )
    return texts


def _answered_tilt(config: Config, hover: float) -> float:
    """Tilt step [rad] that all drones' loops answer without saturation; `hover` is a rotor's force at hover [N]."""
    plant = config.plant
    arms, strongest = (np.array(plant.of_drones(name)) for name in ("arm", "rotor_force_max"))
    gains = plant_parameters(plant, config.attitude).gains
    return float(np.min(rigs.torque_room(arms, plant.layout, hover, strongest)) / np.max(gains.kp[:2]))


def _over_usual_arm(plant: Plant) -> list[float]:
    arms = zip(plant.drones, plant.of_drones("arm"), strict=True)
    return [arm / rigs.ARM / math.cbrt(drone.mass) for drone, arm in arms]
