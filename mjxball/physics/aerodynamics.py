"""Effects of the air on drones: ground effect, download on the object below rotors, rotor drag in wind."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mjxball.arrays import Array, joined
from mjxball.control import rotations
from mjxball.physics.engine import Air
from mjxball.plant.rotors import RADIUS

if TYPE_CHECKING:
    from mjxball.physics.engine import Load, PlantState
    from mjxball.plant import PlantParameters

BODY_LIFT = 2.0  # K_b of Sanchez-Cuevas et al. 2017: what the air that rises between the rotors adds
NEAREST = 0.5  # rotor radii: the lowest height for which ground effect is computed


def ground_effect(height: Array, radius: Array | float, arm: Array | float) -> Array:
    """Thrust near the ground over that far from it, at a rotor plane `height` (...) [m] above it.

    A quadrotor's (Sanchez-Cuevas, Heredia and Ollero 2017, eq. 11), with its rotors' `radius` and `arm` [m]: the rotor
    itself (Cheeseman and Bennett 1955), both neighbours and the opposite rotor as images, and the fountain between
    them. For a Crazyflie 1.18 at 2 cm and 1.08 at 5 cm.
    """
    xp = height.__array_namespace__()
    z = xp.maximum(height, NEAREST * radius)
    near, across = 2.0**0.5 * arm, 2.0 * arm  # distances of neighbouring and of opposite rotors
    square, four = radius * radius, 4.0 * z * z
    images = (
        square / (4.0 * four)
        + square * z * (near * near + four) ** -1.5
        + 0.5 * square * z * (across * across + four) ** -1.5
        + 2.0 * BODY_LIFT * square * z * (across * across + four) ** -1.5
    )
    return 1.0 / (1.0 - images)


def effects(parameters: PlantParameters, state: PlantState, load: Load) -> Air:
    """What the air does to the drones in `state`."""
    return Air(lift(parameters, state, load), drag(parameters, state, load))


def lift(parameters: PlantParameters, state: PlantState, load: Load) -> Any:
    """Factors (..., N, 4) on the lift of all rotors by ground effect and download; None without either."""
    found: Any = None
    if load.floor is not None:
        matrix = rotations.matrix_from_quaternion(state.quaternion)
        above = state.position[..., None, 2] - load.floor[..., None]
        height = above + (matrix[..., None, 2, :] * parameters.mounts).sum(axis=-1)
        found = ground_effect(height, RADIUS * parameters.arm, parameters.arm)[..., None]
    if load.download is not None and parameters.blocked is not None:
        lost = 1.0 - load.download[..., None, None] * parameters.blocked
        found = lost if found is None else found * lost
    return found


def drag(parameters: PlantParameters, state: PlantState, load: Load) -> Any:
    """Force (..., N, 3) of the air on each drone in body axes [N]; None without rotor drag.

    -k m_i (v_i - wind) in the plane of the rotors, k = `load.rotor_drag` and m_i the drone's mass (Faessler, Franchi
    and Scaramuzza 2018, with equal coefficients along x and y).
    """
    if load.rotor_drag is None:
        return None
    matrix = rotations.matrix_from_quaternion(state.quaternion)
    air = state.velocity if load.wind is None else state.velocity - load.wind
    velocity = rotations.rotate_back(matrix, air)[..., None, :]
    velocity = velocity + rotations.cross(state.rates[..., None, :], parameters.mounts)
    scale = -load.rotor_drag[..., None] * parameters.drone_mass
    x, y = scale * velocity[..., 0], scale * velocity[..., 1]
    return joined([x, y, 0.0 * x])


def drag_force(air: Air, state: PlantState) -> Any:
    """The drag of all drones on the assembly in the world, (..., 3) [N]; None without."""
    if air.drag is None:
        return None
    return rotations.rotate(rotations.matrix_from_quaternion(state.quaternion), air.drag.sum(axis=-2))
