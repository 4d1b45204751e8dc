"""Random rigs: teams of drones, carriers and loads of every size (ours).

Lengths grow with the cube root of a drone's mass, inertia with mass and square of length, as from a Crazyflie to a
drone of 3 kg. Random factors apply on top. Needs NumPy alone.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from mjxball.arrays import Array
from mjxball.config import Attitude, Config, Drone, Plant, Range
from mjxball.control.mixer import torque_per_force
from mjxball.plant.parameters import AttitudeGains, PlantParameters, design_gains, rigid_inertia
from mjxball.plant.rotors import shares_on_object
from mjxball.plant.trim import safe_radius

# A drone of 1 kg: arm [m], inertia over mass and arm^2 about (roll, pitch, yaw); the pair's.
ARM, GYRATION = 0.12, np.array([0.16, 0.16, 0.28])
CARRIER_THICKNESS = 0.04  # edge of the carrier across, over its diameter
# Sampled ranges: uniform, or log-uniform where marked "by factor".
DRONE_MASS = (0.03, 3.0)  # of each drone, by factor [kg]
ARM_SCALE = (0.8, 1.25)  # on the rotors' arm, which is ARM at 1 kg
INERTIA_SCALE = (0.7, 1.4)  # on a drone's inertia
SPACING = (2.3, 4.5)  # distance of neighbours on the ring over the arm
MOUNT_JITTER = 0.1  # each mount is off the even ring by up to this share of its radius and of the angle between two
YAW_PER_THRUST = (0.1, 0.25)  # yaw moment of a rotor over its force, over the arm
THRUST_TO_WEIGHT = (1.6, 4.0)  # all rotors' largest force over the weight with the load
ROTOR_LAG = (0.015, 0.15)  # time constant, by factor [s]
CARRIER_SHARE = (0.02, 0.1)  # mass of the carrier over that of all drones
OBJECT_SHARE = (0.05, 0.6)  # mass of the object over that of all drones
BELIEVED_SCALE = (0.5, 2.0)  # on the object's mass, by factor: what every drone assumes
THRUST_SCALE = (0.8, 1.2)  # factor on each drone's rotor forces
THRUST_FADE = (0.0, 0.002)  # share of all thrust that is lost in a second as batteries empty [1/s]
LOOP_FREQUENCY = (4.0, 20.0)  # natural frequency of the pitch loop, by factor [rad/s]
FREQUENCY_RATIO = (0.8, 1.25)  # of the roll loop to that of pitch, by factor
YAW_RATIO = 0.4  # of the yaw loop to that of pitch
LOOP_DAMPING = (0.5, 1.1)  # of the attitude loops without rotor lag
UNSATURATED_TILT = 0.15  # smallest step that rotors must answer without saturation: it caps the pitch loop [rad]
LEAST_DAMPING = 0.3  # of the attitude loops with rotor lag; a rig with less is rejected
# While the CG's reach is below a tenth of the rig's length, believed mass and thrusts are moved towards the truth by
# three tenths, at most 8 times. A rig with a reach below a fiftieth is rejected.
TRAINING = 1  # seed
SHRINKS, ENOUGH_REACH, LEAST_REACH = 8, 0.1, 0.02


class RigTable(NamedTuple):
    """R rigs, padded to the largest number of drones. Drone 0 leads; padding comes last."""

    parameters: PlantParameters  # (R, ...); None for values common to all rigs, see `whole`
    size: Array  # (R,) number of drones without padding
    object_mass: Array  # (R,) true [kg]
    believed_mass: Array  # (R,) that every drone assumes [kg]
    thrust: Array  # (R, N) factor on each drone's rotor forces, with a full battery
    thrust_fade: Array  # (R,) share of all thrust that is lost in a second as batteries empty [1/s]
    reach: Array  # (R,) largest distance of the CG from O that followers can trim, on the carrier [m]
    length: Array  # (R,) largest distance of a drone from O [m]
    frequency: Array  # (R, 3) natural frequency of the attitude loops about roll, pitch, yaw [rad/s]
    damping: Array  # (R,) of these loops without rotor lag

    @property
    def total(self) -> int:
        """Number of rigs, R."""
        return len(self.size)

    def rows(self, chosen: Any) -> RigTable:
        """The rigs `chosen`, by any index of the first axis."""
        return RigTable(_each(lambda part: part[chosen], self.parameters), *(part[chosen] for part in self[1:]))


class SampledRigs(NamedTuple):
    """Sampled rigs, and the numbers of samples and rejections."""

    rigs: RigTable
    candidates: int
    unstable: int  # rejected: damping with rotor lag below LEAST_DAMPING, or rotors too weak for the slowest loop
    untrimmed: int  # rejected: CG reach too short even with believed mass and thrusts close to the truth


def sample_rigs(config: Config, size: int, count: int, seed: int) -> SampledRigs:
    """`count` rigs of `size` drones, padded to the drones of `config.plant`; the same `seed` gives the same rigs."""
    random = np.random.default_rng([seed, size])
    parts: list[RigTable] = []
    candidates = damped = untrimmed = 0
    while sum(part.total for part in parts) < count:
        table, steady, held = _sample(config, size, 2 * count + 16, random)
        good = steady & held
        missing = count - sum(part.total for part in parts)
        last = np.flatnonzero(good)[:missing][-1] + 1 if good.sum() >= missing else len(good)
        candidates, damped, untrimmed = (
            candidates + last,
            damped + (~steady[:last]).sum(),
            untrimmed + (steady & ~held)[:last].sum(),
        )
        parts.append(table.rows(np.flatnonzero(good[:last])))
    return SampledRigs(concatenated(parts), int(candidates), int(damped), int(untrimmed))


def training_rigs(config: Config) -> RigTable:
    """`rigs.number` rigs of each of `scenario.team_sizes`, (sizes, number, ...), in float32."""
    sampled = [sample_rigs(config, size, config.rigs.number, TRAINING).rigs for size in config.scenario.team_sizes]
    table = concatenated(sampled)
    shape = (len(sampled), config.rigs.number)

    def folded(part: Array) -> Array:
        return np.asarray(part, np.float32).reshape(*shape, *part.shape[1:])

    return RigTable(_each(folded, table.parameters), *(folded(part) for part in table[1:]))


def concatenated(tables: list[RigTable]) -> RigTable:
    """The rigs of all `tables`, one table after the other."""
    parameters = _each(lambda *parts: np.concatenate(parts), *(table.parameters for table in tables))
    return RigTable(parameters, *(np.concatenate(parts) for parts in zip(*(t[1:] for t in tables), strict=True)))


def whole(parameters: PlantParameters, gravity: float) -> PlantParameters:
    """`parameters` with the values common to all rigs filled in, as constants that fold into a compiled program."""
    count = parameters.drone_mass.shape[-1]
    return parameters._replace(
        yaw=np.zeros(count),
        moving_fraction=np.array(1.0),
        shell_inertia_per_mass=np.zeros(3),
        gravity=np.array(gravity),
    )


def _each(function: Callable[..., Any], *parameters: PlantParameters) -> PlantParameters:
    """Apply `function` to every array of all `parameters`."""
    found: dict[str, Any] = {}
    for name in PlantParameters._fields:
        parts = [getattr(one, name) for one in parameters]
        if name == "gains":
            found[name] = AttitudeGains(*(function(*gains) for gains in zip(*parts, strict=True)))
        else:
            found[name] = None if parts[0] is None else function(*parts)
    return PlantParameters(**found)


def loop_damping(frequency: Array, damping: Array, lag: Array) -> Array:
    """Damping (...) of the least damped poles of an attitude loop (rad/s, 1) with rotors of `lag` [s].

    Poles p of T p^3 + p^2 + 2 zeta p + 1 in units of the natural frequency, T = lag wn: a real one by bisection, and
    the other two in closed form.
    """
    scaled = np.asarray(lag * frequency, float)
    low, high = np.zeros_like(scaled) - (1 / scaled + 2 * damping + 2), np.zeros_like(scaled)
    for _ in range(60):
        middle = 0.5 * (low + high)
        above = ((scaled * middle + 1) * middle + 2 * damping) * middle + 1 > 0
        low, high = np.where(above, low, middle), np.where(above, middle, high)
    real = 0.5 * (low + high)
    product = -1 / (scaled * real)
    return (1 / scaled + real) / 2 / np.sqrt(product)


def _sample(config: Config, size: int, count: int, random: np.random.Generator) -> tuple[RigTable, Array, Array]:
    """`count` sampled rigs, whether each one's loops are damped enough, and whether its load can be trimmed."""
    most, gravity = max(config.plant.count, size), config.plant.gravity

    def even(ends: Range, *shape: int) -> Array:
        return random.uniform(*ends, (count, *shape))

    def by_factor(ends: Range, *shape: int) -> Array:
        return np.exp(even((math.log(ends[0]), math.log(ends[1])), *shape))

    mass = by_factor(DRONE_MASS)
    arm = ARM * np.cbrt(mass) * even(ARM_SCALE)
    inertia = (mass * arm**2)[:, None] * GYRATION * even(INERTIA_SCALE)[:, None]
    radius = arm * even(SPACING) / (2 * math.sin(math.pi / size))
    jitter = MOUNT_JITTER if size > 2 else 0.0  # two drones hold only what lies on the line between them
    around = 2 * np.pi / size * (np.arange(size) + even((-jitter, jitter), size))
    away = radius[:, None] * (1 + even((-MOUNT_JITTER, MOUNT_JITTER), size))
    mounts = np.stack([away * np.cos(around), away * np.sin(around), 0.0 * away], axis=-1)
    length = away.max(axis=-1)
    carrier = mass * size * even(CARRIER_SHARE)
    load = mass * size * even(OBJECT_SHARE)
    believed = load * by_factor(BELIEVED_SCALE)
    thrust = even(THRUST_SCALE, size)
    strongest = even(THRUST_TO_WEIGHT) * gravity * (mass * size + carrier + load) / (4 * size)
    lag = by_factor(ROTOR_LAG)
    place, ratio = random.uniform(0, 1, count), by_factor(FREQUENCY_RATIO)
    damping = even(LOOP_DAMPING)
    fade = even(THRUST_FADE)
    shares = _load_shares(mounts)

    def alike(value: Array) -> Array:
        return np.repeat(value[:, None], size, axis=1)

    own = alike(mass)
    ball = 0.4 * (0.1 * length) ** 2
    parameters = PlantParameters(
        drone_mass=own,
        own_inertia=np.repeat(inertia[:, None], size, axis=1),
        mounts=mounts,
        yaw=None,
        arm=alike(arm),
        yaw_per_thrust=alike(arm * even(YAW_PER_THRUST)),
        rotor_force_max=alike(strongest),
        rotor_lag=alike(lag),
        known_mass=own + shares * carrier[:, None],
        load_share=shares,
        gains=AttitudeGains(np.zeros((count, 3)), np.zeros((count, 3))),
        carrier_mass=carrier,
        carrier_inertia=(carrier * length**2)[:, None] * np.array([0.25, 0.25, 0.5]),
        moving_fraction=None,
        shell_inertia_per_mass=None,
        ball_inertia_per_mass=np.stack([ball] * 3, axis=-1),
        ball_limit=length,
        gravity=None,
        blocked=shares_on_object(mounts, 0.0 * own, alike(arm), config.plant.layout, np.stack([length] * 2, -1), True),
    )
    empty = rigid_inertia(whole(parameters, gravity))
    about = [empty[:, axis, axis] + load * ball for axis in range(3)]
    # The sampled frequency is capped where the rotors saturate at a step of `UNSATURATED_TILT`.
    hover = gravity * (mass * size + carrier + load) / (4 * size)
    room = torque_room(arm, config.plant.layout, hover, strongest)
    slowest, fastest = LOOP_FREQUENCY
    stiffest = np.sqrt(size * room / UNSATURATED_TILT / np.maximum(about[0] * ratio**2, about[1]))
    pitch = slowest * (np.clip(stiffest, slowest, fastest) / slowest) ** place
    frequency = np.stack([pitch * ratio, pitch, YAW_RATIO * pitch], axis=-1)
    kp, kd = (np.stack(list(gain), axis=-1) for gain in design_gains(about, frequency.T, damping, size))
    parameters = parameters._replace(gains=AttitudeGains(kp, kd))
    steady = loop_damping(frequency[:, :2].max(axis=-1), damping, lag) >= LEAST_DAMPING
    steady &= stiffest >= slowest

    constants, limits = whole(parameters, gravity), (config.scenario.trim_margin, *command_limits(config))
    reach = trimmed_reach(constants, load, believed, thrust, *limits)
    for _ in range(SHRINKS):
        short = reach < ENOUGH_REACH * length
        believed = np.where(short, load * (believed / load) ** 0.7, believed)
        thrust = np.where(short[:, None], 1 + 0.7 * (thrust - 1), thrust)
        reach = trimmed_reach(constants, load, believed, thrust, *limits)
    table = RigTable(
        parameters=_with_padding(parameters, most),
        size=np.full(count, size),
        object_mass=load,
        believed_mass=believed,
        thrust=np.concatenate([thrust, np.ones((count, most - size))], axis=1),
        thrust_fade=fade,
        reach=np.minimum(reach, 0.9 * radius),
        length=length,
        frequency=frequency,
        damping=damping,
    )
    return table, steady, reach >= LEAST_REACH * length


def trimmed_reach(
    parameters: PlantParameters,
    load: Array,
    believed: Array,
    thrust: Array,
    margin: float,
    tilt_limit: float,
    vertical_limit: float,
) -> Array:
    """Distance of the CG from O (...) [m] that rotors and command limits of the followers can hold; negative: none.

    The smaller of `safe_radius` and what commands hold with the same `margin` of their limits (rad, m/s2) left. Tilt
    commands hold the moments of load and uneven thrusts; vertical ones share what the leader does not lift.
    """
    xp = load.__array_namespace__()
    rotors = safe_radius(parameters, 0, load, margin, believed, thrust)
    gravity = float(parameters.gravity)
    flies = xp.astype(parameters.drone_mass > 0, load.dtype)[..., 1:]
    followers = flies.sum(axis=-1)
    fair = gravity * (parameters.known_mass + parameters.load_share * load[..., None])
    assumed = parameters.known_mass + parameters.load_share * believed[..., None]
    lacking = fair[..., 0] - gravity * assumed[..., 0] * thrust[..., 0]
    middle = (flies[..., None] * parameters.mounts[..., 1:, :2]).sum(axis=-2) / followers[..., None]
    lever = middle - parameters.mounts[..., 0, :2]
    uneven = xp.abs(lacking) * xp.hypot(lever[..., 0], lever[..., 1])
    gain = xp.min(parameters.gains.kp[..., :2], axis=-1) * (flies * thrust[..., 1:]).sum(axis=-1)
    held = (1 - margin) * gain * tilt_limit
    wanted = (fair[..., 1:] + (lacking / followers)[..., None]) / thrust[..., 1:]
    asked = xp.abs(wanted / xp.where(flies > 0, assumed[..., 1:], 1.0) - gravity)
    lifts = xp.max(flies * asked, axis=-1) < (1 - margin) * vertical_limit
    return xp.where(lifts, xp.minimum(rotors, (held - uneven) / (gravity * load)), -1.0)


def command_limits(config: Config) -> tuple[float, float]:
    """Largest tilt [rad] and vertical acceleration [m/s2] of a follower, its action scale included."""
    follower, most = config.follower, config.command
    return min(follower.action_scale_tilt, most.tilt_limit), min(follower.action_scale_vertical, most.vertical_limit)


def _load_shares(mounts: Array) -> Array:
    """(R, N) share of the load's weight that each drone carries, see `config.Plant.load_shares`."""
    places = mounts[..., :2]
    mean = places.mean(axis=1)
    off = places - mean[:, None]
    scatter = np.einsum("rni,rnj->rij", off, off)
    weights = np.einsum("rij,rj->ri", np.linalg.pinv(scatter, rcond=1e-6), mean)
    return 1 / places.shape[1] - np.einsum("rni,ri->rn", off, weights)


def _with_padding(parameters: PlantParameters, count: int) -> PlantParameters:
    """`parameters` padded to `count` drones; added drones have no mass, no thrust and no share of the load."""
    missing = count - parameters.size
    nothing = {"drone_mass", "own_inertia", "rotor_force_max", "load_share", "known_mass", "blocked"}
    found: dict[str, Any] = {}
    for name in (*nothing, "mounts", "arm", "yaw_per_thrust", "rotor_lag"):
        value = getattr(parameters, name)
        more = np.repeat(value[:, -1:], missing, axis=1)
        found[name] = np.concatenate([value, 0.0 * more if name in nothing else more], axis=1)
    return parameters._replace(**found)


def unpadded(rigs: RigTable, size: int) -> RigTable:
    """`rigs`, all of `size` drones, without padding."""
    padded = {"drone_mass", "own_inertia", "rotor_force_max", "load_share", "known_mass", "mounts", "arm"}
    padded |= {"yaw_per_thrust", "rotor_lag", "blocked"}
    cut: dict[str, Any] = {name: getattr(rigs.parameters, name)[:, :size] for name in padded}
    return rigs._replace(parameters=rigs.parameters._replace(**cut), thrust=rigs.thrust[:, :size])


def rig_config(config: Config, rigs: RigTable, row: int) -> Config:
    """`config` for the rig `row` alone, with its plant, attitude loops and nominal load."""
    parameters, size = rigs.parameters, int(rigs.size[row])
    drones = tuple(
        Drone(
            mass=float(parameters.drone_mass[row, k]),
            inertia=_tuple(parameters.own_inertia[row, k]),
            mount=_tuple(parameters.mounts[row, k]),
            arm=float(parameters.arm[row, k]),
            rotor_force_max=float(parameters.rotor_force_max[row, k]),
            rotor_lag=float(parameters.rotor_lag[row, k]),
            yaw_per_thrust=float(parameters.yaw_per_thrust[row, k]),
        )
        for k in range(size)
    )
    length, load = float(rigs.length[row]), float(rigs.object_mass[row])
    plant = Plant(
        drones=drones,
        carrier_mass=float(parameters.carrier_mass[row]),
        carrier_inertia=_tuple(parameters.carrier_inertia[row]),
        object_mass=load,
        object_size=(2 * length, 2 * length, 2 * CARRIER_THICKNESS * length),
        ball_radius=0.1 * length,
        cg_axis="xy",
        arm=drones[0].arm,
        rotor_force_max=drones[0].rotor_force_max,
        rotor_lag=drones[0].rotor_lag,
        yaw_per_thrust=drones[0].yaw_per_thrust,
        gravity=config.plant.gravity,
    )
    attitude = Attitude(_tuple(rigs.frequency[row]), float(rigs.damping[row]), load)
    scenario = dataclasses.replace(
        config.scenario, team_sizes=(), object_mass=(load, load), cg_amplitude=(0.0, float(rigs.reach[row]))
    )
    rigs_off = dataclasses.replace(config.rigs, number=0)
    return dataclasses.replace(config, plant=plant, attitude=attitude, scenario=scenario, rigs=rigs_off)


def torque_room(arm: Array, layout: str, hover: Array, strongest: Array) -> Array:
    """Largest roll or pitch torque of a drone at hover [N m]; rotor forces `hover` and `strongest` in [N]."""
    return torque_per_force(arm, layout) * np.minimum(hover, strongest - hover)


def _tuple(values: Array) -> Any:
    return tuple(float(value) for value in values)
