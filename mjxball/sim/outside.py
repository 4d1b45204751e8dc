"""What of a rig lies outside the ranges that a follower for any rig was trained with (ours)."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mjxball.config import Config, Plant, Range
from mjxball.plant.parameters import plant_parameters
from mjxball.sim.rigs import ARM, FREQUENCY_RATIO, torque_room


def outside(config: Config, trained: Config) -> list[str]:
    """What of the rig of `config` lies outside the ranges that `trained` draws rigs from, one phrase each."""
    plant, ranges = config.plant, trained.rigs
    drones, gravity, sizes = plant.drones, plant.gravity, trained.scenario.team_sizes
    masses = [drone.mass for drone in drones]
    weight = sum(masses) + plant.carrier_mass + plant.object_mass
    strongest = 4 * sum(plant.of_drones("rotor_force_max"))
    found: list[tuple[str, Sequence[float], Range, str]] = [
        ("drones", [plant.count], (min(sizes), max(sizes)), ""),
        ("mass of a drone", masses, ranges.drone_mass, " kg"),
        ("rotor arm over 0.12 m (mass / kg)^(1/3)", _over_usual_arm(plant), ranges.arm_scale, ""),
        ("object's mass over that of all drones", [plant.object_mass / sum(masses)], ranges.object_share, ""),
        ("largest thrust over the weight", [strongest / gravity / weight], ranges.thrust_to_weight, ""),
        ("rotor lag", plant.of_drones("rotor_lag"), ranges.rotor_lag, " s"),
    ]
    if config.autopilot.kind == "ideal":
        loops, damping = config.attitude.natural_frequency[:2], config.attitude.damping
        slow, fast = ranges.loop_frequency
        found += [
            ("attitude loop", loops, (slow * FREQUENCY_RATIO[0], fast * FREQUENCY_RATIO[1]), " rad/s"),
            ("damping of the attitude loop", [damping], ranges.loop_damping, ""),
        ]
    texts = [
        f"{name} {value:.3g}{unit}, trained from {low:g} to {high:g}{unit}"
        for name, values, (low, high), unit in found
        for value in sorted({min(values), max(values)})
        if not low * (1 - 1e-6) <= value <= high * (1 + 1e-6)
    ]
    answered = _answered_tilt(config, gravity * weight / (4 * plant.count))
    if config.autopilot.kind == "ideal" and answered < ranges.unsaturated_tilt * (1 - 1e-6):
        texts.append(
            f"rotors saturate from a tilt step of {answered:.3g} rad on, "
            f"trained from {ranges.unsaturated_tilt:g} rad upwards"
        )
    return texts


def _answered_tilt(config: Config, hover: float) -> float:
    """Tilt step that all drones' loops answer without saturation [rad]; a rotor hovers with `hover` [N]."""
    plant = config.plant
    arms, strongest = (np.array(plant.of_drones(name)) for name in ("arm", "rotor_force_max"))
    gains = plant_parameters(plant, config.attitude).gains
    return float(np.min(torque_room(arms, plant.layout, hover, strongest)) / np.max(gains.kp[:2]))


def _over_usual_arm(plant: Plant) -> list[float]:
    arms = zip(plant.drones, plant.of_drones("arm"), strict=True)
    return [arm / ARM / math.cbrt(drone.mass) for drone, arm in arms]
