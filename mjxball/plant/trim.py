"""Rotor forces that hold a load at hover, and the margin that they leave: a linear program for any plant.

The assembly hovers level. The rotors that may act give the wrench about O that balances all weights without a yaw
moment. A leader that does not act gives four equal forces for its own weight and its share of the load, as its
controller commands at the goal. With h the share of the largest forces that lifting alone takes, a rotor of largest
force F_max hovers at h F_max. A margin m keeps every rotor from both ends of its range by m times the distance from
hover to that end:

    m h F_max <= F <= F_max - m (1 - h) F_max

m = 1 if all rotors hover alike, 0 if one stands still or gives its most, negative if the rotors cannot hold the load
(ours). For a pair the upper bound is that of `mjxball.control.constants.trim_limit`, which has no lower one. A stand is
ignored, as if the plant flew freely. Needs SciPy.

For a whole `Config` the rotors give only forces that can be commanded (`mjxball.plant.commands`), and a margin m leaves
that share of every command limit, too: |command| <= (1 - m) limit.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mjxball.arrays import Array
from mjxball.config import Config, Plant, thrust_over_weight, total_mass
from mjxball.errors import InputError
from mjxball.plant.commands import CommandLimits, command_rows, commanded, wrench_per_force
from mjxball.plant.parameters import PlantParameters

TINY, LEAST_SCATTER = 1e-9, 1e-3  # [N], [m2] below which drones sit in one place
HALVINGS = 12  # of the range of masses in which the heaviest object is looked for

if TYPE_CHECKING:
    from jaxtyping import Float

    Forces = Float[np.ndarray, "drones 4"]


class Trim(NamedTuple):
    """Rotor forces at hover with the largest margin."""

    margin: float  # m above, the smallest over all rotors that act; -inf: cannot be lifted
    rotor_force: Forces | None  # every rotor's [N], rows as in plant.drones; None: cannot be lifted


class _Hover(NamedTuple):
    """Equations of the forces of n acting rotors: effect @ force = wrench + per_offset @ (CG offset along x, along y).

    Forces in units of their mean `unit`, moments in metres times that.
    """

    effect: Float[np.ndarray, "e n"]  # of the whole assembly's four, then of every drone's yaw that is commanded
    wrench: Float[np.ndarray, " e"]
    per_offset: Float[np.ndarray, "e 2"]
    most: Float[np.ndarray, " n"]
    level: Float[np.ndarray, " n"]  # force that hovers, h F_max
    acts: np.ndarray  # (N,) bool
    leader_force: float  # of each of the leader's rotors, unless it acts or is lost [N]
    unit: float  # [N]
    asked: Float[np.ndarray, "c n"]  # asked @ force - level_command: commands over their limits
    level_command: Float[np.ndarray, " c"]


def largest_margin(
    plant: Plant | Config,
    object_mass: float,
    cg: float | Sequence[float],
    believed_mass: float | None = None,
    lost: Collection[int] = (),
    leader_helps: bool = False,
    thrust: Sequence[float] | None = None,
) -> Trim:
    """The trim with the largest margin for a load of `object_mass` [kg] with its CG at `cg` from O [m].

    `cg` is one number along a line and (x, y) in the plane. The followers' rotors act, and the leader's too if
    `leader_helps`; otherwise the leader lifts its share of `believed_mass` [kg], by default the true mass. Rotors of
    the drones `lost` stand still. `thrust` (N,) is the factor on each drone's forces. A plant with rotor_force_max inf
    has no upper bound. For a `Plant` alone any force can be commanded. Raises InputError if an argument does not fit
    the plant.
    """
    plant, commands = commanded(plant)
    hover = _hover(plant, object_mass, believed_mass, lost, leader_helps, thrust, commands)
    if hover is None:
        return Trim(-math.inf, None)
    bounded = np.isfinite(hover.most)
    identity = np.eye(len(hover.most))
    room = np.where(bounded, hover.most - hover.level, 0.0)
    found = _solve(
        np.append(np.zeros(len(hover.most)), -1.0),
        np.column_stack([hover.effect, np.zeros(len(hover.wrench))]),
        hover.wrench + hover.per_offset @ _in_plane(plant, cg),
        [(None, None)] * (len(hover.most) + 1),
        np.vstack(
            [
                np.column_stack([-identity, hover.level]),
                np.column_stack([identity, room])[bounded],
                *(np.column_stack([sign * hover.asked, np.ones(len(hover.asked))]) for sign in (1, -1)),
            ],
        ),
        np.concatenate(
            [np.zeros(len(hover.most)), hover.most[bounded], 1 + hover.level_command, 1 - hover.level_command]
        ),
    )
    if found is None:
        return Trim(-math.inf, None)
    force = np.zeros((plant.count, 4))
    force[plant.leader] = hover.leader_force
    force[hover.acts] = hover.unit * found[:-1].reshape(-1, 4)
    return Trim(float(found[-1]), force)


def largest_amplitude(
    plant: Plant | Config,
    object_mass: float,
    margin: float = 0.15,
    direction: Sequence[float] | None = None,
    believed_mass: float | None = None,
    lost: Collection[int] = (),
    leader_helps: bool = False,
    thrust: Sequence[float] | None = None,
) -> float:
    """Largest CG offset [m] at which the load can be held on both sides of O with `margin`; negative: not even at O.

    The offset is along `direction` (x, y) of any length, by default the load's line or x; -inf if no offset can be
    trimmed. The other arguments are those of `largest_margin`.
    """
    plant, commands = commanded(plant)
    if not margin <= 1:
        raise InputError(f"the margin must be at most 1, not {margin}")
    along = np.eye(2)[plant.directions[0]] if direction is None else np.asarray(direction, dtype=float)
    if along.shape != (2,) or not 0 < np.linalg.norm(along) < math.inf:
        raise InputError(f"the direction must be two numbers that are not both 0, not {direction!r}")
    if any(along[axis] for axis in {0, 1} - set(plant.directions)):
        raise InputError(f"the load moves along {plant.cg_axis}, not in the direction {direction!r}")
    hover = _hover(plant, object_mass, believed_mass, lost, leader_helps, thrust, commands)
    if hover is None:
        return -math.inf
    least, most = margin * hover.level, hover.most - margin * np.nan_to_num(hover.most - hover.level, posinf=0.0)
    equations = np.column_stack([hover.effect, -hover.per_offset @ along / np.linalg.norm(along)])
    bounds = [*zip(least, most, strict=True), (None, None)]
    rows = np.column_stack([np.vstack([hover.asked, -hover.asked]), np.zeros(2 * len(hover.asked))])
    below = 1 - margin + np.concatenate([hover.level_command, -hover.level_command])
    ends = []
    for side in (1.0, -1.0):
        found = _solve(np.append(np.zeros(len(least)), -side), equations, hover.wrench, bounds, rows, below)
        if found is None:
            return -math.inf
        ends.append(side * float(found[-1]))
    return min(ends)


def heaviest_object(settings: Config, amplitude: float) -> float:
    """The heaviest object [kg] whose CG can be held `amplitude` [m] off O with the plant's `trim_margin`, or 0."""
    plant, margin = settings.plant, settings.scenario.trim_margin
    low, high = 0.0, thrust_over_weight(plant, 0.0) * total_mass(plant, 0.0)
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if largest_amplitude(settings, middle, margin) >= amplitude else (low, middle)
    return low


def safe_radius(
    parameters: PlantParameters,
    leader: int,
    object_mass: Array,
    margin: float,
    believed_mass: Array | None = None,
    thrust: Array | None = None,
    flies: Array | None = None,
) -> Array:
    """CG distance from O (...) [m] up to which the followers trim the load in every direction; negative: not even at O.

    A closed form for training, on arrays of any batch shape and namespace, never larger than `largest_margin` allows
    (ours). Every drone lifts its own share, with which most teams are level at c = 0. The F followers hold the load's
    moment by equal torques, at most 1 / (2 L F) of it on any rotor; or along a principal axis of their mounts' scatter
    C about their mean, by thrusts in proportion to their distances d from it, at most |d| / (4 C) on any rotor. Weight
    that a weak or lost drone does not lift is shared equally by the others, and its moment about their mean is held
    like the load's. `thrust` (..., N) is the factor on each drone's forces. Drones that do not fly (`flies` (..., N) is
    0) give nothing: a lost one has to be lifted, one without mass is padding. The other arguments are those of
    `largest_margin`.
    """
    xp = object_mass.__array_namespace__()
    count = parameters.size
    one = xp.ones_like(object_mass)[..., None] * xp.ones(count, dtype=object_mass.dtype)
    factor = one if thrust is None else thrust * one
    alive = (one if flies is None else flies * one) * (parameters.rotor_force_max > 0)
    acts = alive * (xp.arange(count) != leader)
    followers = xp.maximum(acts.sum(axis=-1), 1.0)
    gravity = parameters.gravity
    mass = object_mass[..., None]
    believed = mass if believed_mass is None else believed_mass[..., None]
    fair = gravity * (parameters.known_mass + parameters.load_share * mass)  # [N]
    # Weight that the leader and lost drones leave to the followers; negative if the leader lifts too much.
    given = gravity * (parameters.known_mass + parameters.load_share * believed) * factor * alive
    lacking = xp.where(acts > 0, 0.0, fair - given)
    own = fair + (lacking.sum(axis=-1) / followers)[..., None]
    places = parameters.mounts[..., :2] * one[..., None]
    middle = (acts[..., None] * places).sum(axis=-2) / followers[..., None]
    moment = (lacking[..., None] * (places - middle[..., None, :])).sum(axis=-2)
    moment = moment - ((fair - gravity * parameters.drone_mass)[..., None] * places).sum(axis=-2)

    most = factor * parameters.rotor_force_max
    level = (acts * own).sum(axis=-1) / (4 * xp.maximum((acts * most).sum(axis=-1), TINY))
    least = margin * level[..., None] * most
    upper = most * (1 - margin * (1 - level[..., None]))
    room = xp.where(acts > 0, xp.minimum(own / 4 - least, upper - own / 4), xp.inf).min(axis=-1)

    off = acts[..., None] * (places - middle[..., None, :])
    x, y = off[..., 0], off[..., 1]
    xx, yy, xy = ((a * b).sum(axis=-1) for a, b in ((x, x), (y, y), (x, y)))
    angle = 0.5 * xp.atan2(2 * xy, xx - yy)
    c, s = xp.cos(angle)[..., None], xp.sin(angle)[..., None]
    arms = xp.where(acts > 0, parameters.arm * one, xp.inf).min(axis=-1)
    turning = 1 / (2 * arms * followers)
    along = []
    for distance in (c * x + s * y, c * y - s * x):
        scatter = (distance * distance).sum(axis=-1)
        lifting = xp.abs(distance).max(axis=-1) / (4 * xp.maximum(scatter, TINY))
        along.append(xp.where(scatter > LEAST_SCATTER, xp.minimum(lifting, turning), turning))
    effort = xp.minimum(turning, xp.hypot(*along))
    return (room / effort - xp.hypot(moment[..., 0], moment[..., 1])) / (gravity * object_mass)


def _in_plane(plant: Plant, cg: float | Sequence[float]) -> np.ndarray:
    """(x, y) [m] of the offset `cg` along the load's directions."""
    offset = np.atleast_1d(np.asarray(cg, dtype=float))
    if offset.shape != (len(plant.directions),) or not np.isfinite(offset).all():
        raise InputError(f"the CG of this plant has {len(plant.directions)} finite coordinates [m], not {cg!r}")
    found = np.zeros(2)
    found[list(plant.directions)] = offset
    return found


def _hover(
    plant: Plant,
    object_mass: float,
    believed_mass: float | None,
    lost: Collection[int],
    leader_helps: bool,
    thrust: Sequence[float] | None,
    commands: CommandLimits | None,
) -> _Hover | None:
    """The hover equations, or None if the rotors that act cannot lift the assembly or have nothing to lift."""
    count, gravity = plant.count, plant.gravity
    factor = np.ones(count) if thrust is None else np.asarray(thrust, dtype=float)
    if not 0 < object_mass < math.inf:
        raise InputError(f"the object's mass must be positive, not {object_mass} kg")
    if factor.shape != (count,) or not (factor >= 0).all():
        raise InputError(f"thrust must be {count} factors that are not negative, one for each drone, not {thrust!r}")
    if not set(lost) <= set(range(count)):
        raise InputError(f"lost drones must be numbers from 0 to {count - 1}, not {sorted(lost)}")
    flies = np.array([number not in set(lost) for number in range(count)])
    acts = flies.copy()
    if not leader_helps:
        acts[plant.leader] = False
    limit = factor * plant.of_drones("rotor_force_max")
    masses, mounts = (np.array([getattr(drone, name) for drone in plant.drones]) for name in ("mass", "mount"))
    believed = object_mass if believed_mass is None else believed_mass
    leader = 0.0
    if flies[plant.leader] and not leader_helps:
        asked = plant.known_masses[plant.leader] + plant.load_shares[plant.leader] * believed
        leader = min(factor[plant.leader] * asked * gravity / 4, limit[plant.leader])
    weight = gravity * (masses.sum() + plant.carrier_mass + object_mass)
    lift = weight - 4 * leader
    capacity = np.isinf(limit[acts]).astype(float) if np.isinf(limit[acts]).any() else limit[acts]
    if not 0 < lift < 4 * limit[acts].sum():
        return None
    level = lift / 4 * capacity / capacity.sum()

    drones = [wrench_per_force(plant, number) for number in range(count)]
    # Weights pull at their places: the wrench that holds them is (1, y, -x, 0) times each.
    held = gravity * masses @ np.column_stack([np.ones(count), mounts[:, 1], -mounts[:, 0], np.zeros(count)])
    held[0] = weight
    per_offset = gravity * object_mass * np.array([[0.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, 0.0]])
    unit = lift / (4 * acts.sum())
    believes = np.array(plant.known_masses) + np.array(plant.load_shares) * believed
    answer = np.flatnonzero(acts & (limit > 0))
    twist, commands_asked, level_command = command_rows(plant, commands, answer, factor, believes)
    columns = np.repeat(acts, 4)
    return _Hover(
        effect=np.vstack([np.column_stack(drones), twist])[:, columns],
        wrench=np.append(held - leader * drones[plant.leader].sum(axis=1), np.zeros(len(twist))) / unit,
        per_offset=np.vstack([per_offset, np.zeros((len(twist), 2))]) / unit,
        most=np.repeat(limit[acts], 4) / unit,
        level=np.repeat(level, 4) / unit,
        acts=acts,
        leader_force=leader,
        unit=unit,
        asked=unit * commands_asked[:, columns],
        level_command=level_command,
    )


def _solve(
    cost: np.ndarray,
    equations: np.ndarray,
    equal: np.ndarray,
    bounds: list[Any],
    rows: np.ndarray | None = None,
    below: np.ndarray | None = None,
) -> np.ndarray | None:
    """The unknowns of least `cost` (equations x = equal, rows x <= below), or None if the problem is infeasible."""
    from scipy.optimize import linprog

    result = linprog(cost, A_ub=rows, b_ub=below, A_eq=equations, b_eq=equal, bounds=bounds, method="highs")
    if result.status not in (0, 2):
        raise RuntimeError(f"the trim's linear program was not solved: {result.message}")
    return None if result.status == 2 else np.asarray(result.x)
