"""Refuse plants with implausible proportions, where a number is probably in a wrong unit."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from mjxball.config._plant import Drone, Plant
from mjxball.config._settings import Config
from mjxball.errors import InputError

MOST_THRUST = 100.0  # thrust over weight; racing drones have 15
WRONG_UNIT = 0.5  # thrust over weight below which a wrong unit is likelier than a weak plant
MOST_GRAVITY = 30.0  # [m/s2]; Jupiter has 25
YAW_OF_ARM = 10.0  # yaw moment per force over the arm; shipped plants have 0.13 to 0.17
LONGEST_LAG = 1.0  # time constant of a rotor [s]
ARM_OF_SPACING = 1.0  # arm over the distance to the nearest drone; shipped plants have 0.15 to 0.43
GYRATION = (0.02, 5.0)  # radius of gyration over the arm; shipped plants have 0.4 to 0.9
CARRIER_OF_REACH = 3.0  # the carrier's radius of gyration over its own reach; shipped plants have 0.5
SIZE_OF_REACH = 20.0  # longest edge of the object over the farthest mount; shipped plants have 1 to 2
LONGEST_ERROR = 20.0  # time constant of the leader's slowest pole [s]; shipped presets have 0.6 to 3
INERTIA_UNITS = {"g mm2": 1e-9, "g cm2": 1e-7, "kg mm2": 1e-6, "g m2": 1e-3}  # [kg m2]
FASTEST = 0.5  # natural frequency times physics step; beyond it sampling takes too much phase


def thrust_over_weight(plant: Plant, object_mass: float | None = None) -> float:
    """Largest force of all rotors over the weight, with the plant's object or one of `object_mass` [kg]."""
    force = 4 * sum(plant.of_drones("rotor_force_max"))
    return force / (plant.gravity * total_mass(plant, object_mass))


def total_mass(plant: Plant, object_mass: float | None = None) -> float:
    """Mass of drones, carrier and object [kg]."""
    load = plant.object_mass if object_mass is None else object_mass
    return sum(drone.mass for drone in plant.drones) + plant.carrier_mass + load


def check_units(config: Config) -> None:
    """Raise InputError for implausible proportions; the sentence names the unit that was probably meant.

    Checked are gravity, thrust over weight, arm over spacing, radii of gyration, yaw moment over arm, object over
    mounts, rotor lag, the attitude loop's natural frequency against rotor lag, physics step and leader, and the
    stability of the leader's position loop.
    """
    plant = config.plant
    if plant.gravity > MOST_GRAVITY:
        hint = f"; {plant.gravity:g} cm/s2 would be {plant.gravity / 100:g} m/s2"
        raise InputError(f"plant.gravity {plant.gravity:g} m/s2 is more than {MOST_GRAVITY:g} m/s2{hint}")
    _check_sizes(plant)
    _check_lags(plant)
    _check_weight(config)
    _check_inertia(plant)
    _check_carrier(plant)
    if config.autopilot.kind == "ideal":
        _check_loop(config)
    _check_leader(config)


def _meant(value: float, unit: str, base: str, cured: bool = True) -> str:
    """The hint that `value` was given in thousandths of `base`; empty unless that would be `cured`."""
    return f"; {value:g} {unit} would be {value / 1000:g} {base}" if cured else ""


def _refuse_above(most: float, value: float, unit: str, name: str, what: str) -> None:
    """Raise InputError, with a hint at thousandths of `unit`, if `value` is more than `most`."""
    if value > most:
        raise InputError(f"{name} {value:g} {unit} is {what}{_meant(value, f'm{unit}', unit, value / 1000 <= most)}")


def _check_sizes(plant: Plant) -> None:
    mounts, arms = [drone.mount for drone in plant.drones], plant.of_drones("arm")
    for number, (arm, mount) in enumerate(zip(arms, mounts, strict=True)):
        nearest = min(math.dist(mount, other) for other in mounts if other is not mount)
        what = f"longer than the {nearest:.3g} m to the next drone"
        _refuse_above(ARM_OF_SPACING * nearest, arm, "m", _place(plant, number, "arm"), what)
    for number, (arm, yaw) in enumerate(zip(arms, plant.of_drones("yaw_per_thrust"), strict=True)):
        what = f"more than {YAW_OF_ARM:g} times the arm of {arm:g} m"
        _refuse_above(YAW_OF_ARM * arm, yaw, "m", _place(plant, number, "yaw_per_thrust"), what)
    reach = max(math.hypot(*mount) for mount in mounts)
    what = f"more than {SIZE_OF_REACH:g} times the {reach:.3g} m at which drones are mounted"
    _refuse_above(SIZE_OF_REACH * reach, max(plant.object_size), "m", "plant.object_size", what)


def _check_lags(plant: Plant) -> None:
    for number, lag in enumerate(plant.of_drones("rotor_lag")):
        _refuse_above(LONGEST_LAG, lag, "s", _place(plant, number, "rotor_lag"), f"more than {LONGEST_LAG:g} s")


def _check_weight(config: Config) -> None:
    """The plant lifts its own object and the heaviest that the scenario samples."""
    for mass in (config.plant.object_mass, config.scenario.object_mass[1]):
        check_lift(config, mass)


def check_lift(config: Config, mass: float) -> None:
    """Raise InputError unless the plant lifts an object of `mass` [kg], or stands on a pivot."""
    plant, force = config.plant, 4 * sum(config.plant.of_drones("rotor_force_max"))
    if plant.stand == "pivot":
        return
    least = 1.0 if config.autopilot.kind == "ideal" else WRONG_UNIT  # a Crazyflie's margin is checked elsewhere
    ratio = thrust_over_weight(plant, mass)
    if least < ratio <= MOST_THRUST:
        return
    weights = f"the rotors give {force:.4g} N, and {total_mass(plant, mass):.4g} kg weigh"
    weighs = f"{weights} {plant.gravity * total_mass(plant, mass):.4g} N: thrust over weight is {ratio:.2g}"
    hint = _weaker(plant, mass) if ratio > 1 else next(_stronger(plant, mass), "") if ratio < WRONG_UNIT else ""
    raise InputError(f"{weighs}, where it must be between 1 and {MOST_THRUST:g}{hint}")


def _stronger(plant: Plant, mass: float) -> Iterator[str]:
    """Hints at masses in grams or forces in kN: each change of units by which alone the plant would fly."""
    light = replace(plant, drones=tuple(replace(drone, mass=drone.mass / 1000) for drone in plant.drones))
    heaviest, force = max(drone.mass for drone in plant.drones), max(plant.of_drones("rotor_force_max"))
    sound = all(_gyrates(drone, arm) for drone, arm in zip(light.drones, light.of_drones("arm"), strict=True))
    carried = replace(plant, carrier_mass=plant.carrier_mass / 1000)
    for name, value, changed, load in (
        ("plant.object_mass", mass, plant, mass / 1000),
        ("plant.carrier_mass", plant.carrier_mass, carried, mass),
        *(
            (("plant.drones' mass", heaviest, light, mass), ("every mass", heaviest, light, mass / 1000))
            if sound
            else ()
        ),
    ):
        if 1.0 < thrust_over_weight(changed, load) <= MOST_THRUST:
            yield f"; {name} was probably given in g: {value:g} g would be {value / 1000:g} kg"
    if 1.0 < 1000 * thrust_over_weight(plant, mass) <= MOST_THRUST:
        yield f"; rotor_force_max was probably given in kN: {force:g} kN would be {1000 * force:g} N"


def _weaker(plant: Plant, mass: float) -> str:
    force = max(plant.of_drones("rotor_force_max"))
    cured = 1.0 < thrust_over_weight(plant, mass) / 1000 <= MOST_THRUST
    return _meant(force, "mN", "N", cured) or f"; {force:g} gf would be {force * 9.81e-3:.3g} N"


def _gyrates(drone: Drone, arm: float) -> bool:
    return GYRATION[0] <= math.sqrt(max(drone.inertia) / drone.mass) / arm <= GYRATION[1]


def _inertia_fault(
    name: str, inertia: float, mass: float, beside: str, length: float, usual: tuple[float, float], *units: str
) -> str:
    """The sentence that `inertia` does not fit `mass`, with a hint at a unit of `usual` gyration over length."""
    radius, hint = math.sqrt(inertia / mass), ""
    for unit in units:
        if usual[0] <= math.sqrt(INERTIA_UNITS[unit]) * radius / length <= usual[1]:
            hint = f"; {inertia:g} {unit} would be {inertia * INERTIA_UNITS[unit]:.3g} kg m2"
    return (
        f"{name} {inertia:g} kg m2 with {mass:g} kg makes a radius of gyration of {radius:.3g} m beside {beside} of "
        f"{length:.3g} m{hint}"
    )


def _check_inertia(plant: Plant) -> None:
    for number, (drone, arm) in enumerate(zip(plant.drones, plant.of_drones("arm"), strict=True)):
        if not _gyrates(drone, arm):
            name, largest = f"plant.drones.{number}.inertia", max(drone.inertia)
            fault = _inertia_fault(name, largest, drone.mass, "an arm", arm, (0.2, 2.0), *INERTIA_UNITS)
            raise InputError(f"{fault}; check mass, inertia and arm")


def _check_carrier(plant: Plant) -> None:
    """The carrier's radius of gyration is not much larger than the distance of its farthest mount or edge."""
    reach = max(*plant.object_size, *(math.hypot(*drone.mount) for drone in plant.drones))
    largest, mass = max(plant.carrier_inertia), plant.carrier_mass
    if mass and math.sqrt(largest / mass) > CARRIER_OF_REACH * reach:
        units = ("g cm2", "g m2")
        raise InputError(_inertia_fault("plant.carrier_inertia", largest, mass, "a reach", reach, (0.1, 1.5), *units))


def _check_loop(config: Config) -> None:
    """The attitude loop is stable with the rotors' lag, slow beside its steps, and faster than the leader's loop."""
    loop, lag, step = config.attitude, max(config.plant.of_drones("rotor_lag")), config.physics_step
    slowest = math.sqrt(max(config.leader.kp[:2]))
    for axis, frequency in zip(("roll", "pitch", "yaw"), loop.natural_frequency, strict=True):
        named = f"attitude.natural_frequency {frequency:g} rad/s of {axis}"
        if frequency * step > FASTEST:
            raise InputError(
                f"{named} is too fast for physics steps of {1e3 * step:.3g} ms: at most {FASTEST / step:g}"
            )
        if frequency * lag >= 2 * loop.damping:
            raise InputError(
                f"{named} is unstable with damping {loop.damping:g} and a rotor lag of {lag:g} s: it must be below "
                f"{2 * loop.damping / lag:.3g} rad/s"
            )
        if axis != "yaw" and frequency < slowest:
            raise InputError(
                f"{named} is slower than the leader's position loop, {slowest:.3g} rad/s by leader.kp, and cannot "
                "follow it"
            )


def _check_leader(config: Config) -> None:
    """The leader's position loop around the attitude loop is stable, and errors decay in time.

    Checked are the poles at hover: horizontal motion by gravity's share at a tilt, vertical motion by thrust with the
    rotors' lag. A small integral gain makes a slow pole, so decay is checked without the integral.
    """
    controller, loop, lag = config.leader, config.attitude, max(config.plant.of_drones("rotor_lag"))
    free = config.plant.stand == "free"
    ways = {"x": (0, "pitch"), "y": (1, "roll")} if free else {}
    ways |= {"z": (2, "")} if config.plant.stand != "pivot" else {}
    slowest = 1 / LONGEST_ERROR if free else 0.0  # the paper's stand takes a minute
    for axis, (place, turned) in ways.items():
        bottom: list[float] = [lag, 1.0]
        below = "rotors"
        if turned and config.autopilot.kind == "ideal":
            frequency, below = loop.natural_frequency[1 - place], f"attitude loop (attitude.damping {loop.damping:g})"
            bottom = [lag / frequency**2, 1 / frequency**2, 2 * loop.damping / frequency, 1.0]
        elif turned:
            gain, below = getattr(config.autopilot, turned)[0], f"autopilot.{turned}"
            bottom = [1.0, gain]
        top = bottom[-1] * np.array([controller.kd[place], controller.kp[place], controller.ki[place]])
        poles = np.roots(np.polyadd([*bottom, 0.0, 0.0, 0.0], top)) if controller.ki[place] else np.zeros(0)
        without = np.roots(np.polyadd([*bottom, 0.0, 0.0], top[:2]))
        if (poles.size and poles.real.max() >= 0) or without.real.max() >= -slowest:
            raise InputError(
                f"leader.kp, kd, ki {controller.kp[place]:g}, {controller.kd[place]:g}, {controller.ki[place]:g} along "
                f"{axis} do not hold the object with this {below}: the loop that they close is unstable, or takes more "
                f"than {LONGEST_ERROR:g} s to forget an error"
            )


def _place(plant: Plant, number: int, name: str) -> str:
    return f"plant.drones.{number}.{name}" if getattr(plant.drones[number], name) else f"plant.{name}"
