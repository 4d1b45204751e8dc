"""`oracle`: the LQR of the true state, told all parameters, loads, forces and attitude loops of the flight (ours).

It has the linear model of `lqg` and no filter: what it does is what a controller could do that knew everything.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mjxball.arrays import Array, joined
from mjxball.baselines.assembly_model import ideal_model
from mjxball.baselines.hover_model import (
    LOAD,
    LOAD_CURVE,
    LOAD_RATE,
    STATES,
    TORQUE,
    HoverModel,
    LoadModel,
    hover_model,
)
from mjxball.baselines.linear import times
from mjxball.baselines.lqg import Feedback, feedback
from mjxball.baselines.lqg_tuning import Costs
from mjxball.baselines.sharing import Assumed, level, sharing
from mjxball.config import Config
from mjxball.control.followers import PrivilegedInfo
from mjxball.control.observation import ERROR, ERROR_RATE
from mjxball.plant import plant_parameters
from mjxball.plant.parameters import rigid_moment

if TYPE_CHECKING:
    from jaxtyping import Float

LOOP_SCALES = tuple(2.0 ** (0.25 * step) for step in range(-6, 9))  # factors on the loops' frequency with own gains
LOADS = (0.5, 2.0)  # masses of the load over the plant's with own gains, which are linear in the inverse of the whole


class OracleTuning(NamedTuple):
    """Those of `Costs`, and the frequency at which it expects loads to swing: the best of 720 sets on 60 loads."""

    position: float = 0.03919
    velocity: float = 0.2003
    height: float = 0.07244
    climb: float = 0.2886
    error_limit: float = 0.3552
    tilt_limit: float = 0.4461
    height_limit: float = 0.3988
    climb_limit: float = 3.82
    load_frequency: float = 2.157  # [rad/s]

    @property
    def costs(self) -> Costs:
        """Those of the LQR."""
        return Costs(*self[:-1])


class Gains(NamedTuple):
    """`Feedback` for S factors on the loops' frequency and two masses, on torques in N m; may have leading axes."""

    rows: Float[Array, "... S 2 14 22"]
    position: Float[Array, "... S 3 3"]
    error_limit: Float[Array, "... 3"]
    limit: Float[Array, "... 3"]


def gains(
    config: Config, tuning: OracleTuning, scales: Sequence[float] = LOOP_SCALES
) -> tuple[Gains, Float[np.ndarray, "2"]]:
    """(gains for the plant of `config`, the inverse of the two masses [1/kg]); `scales` are the loops' factors."""
    assembly, load = ideal_model(config, "oracle"), LoadModel(tuning.load_frequency)
    models = [
        [hover_model(config, assembly, load, scale, share * config.plant.object_mass) for share in LOADS]
        for scale in scales
    ]
    found = [[feedback(model, tuning.costs, assembly.gravity) for model in pair] for pair in models]
    rows = [
        [each.rows @ over_torques(model) for each, model in zip(*both, strict=True)]
        for both in zip(found, models, strict=True)
    ]
    position = np.array([pair[0].position for pair in found])
    return Gains(np.array(rows), position, *found[0][0][2:]), np.array([1.0 / model.mass for model in models[0]])


def over_torques(model: HoverModel) -> Float[np.ndarray, "22 22"]:
    """The model's state for one with torques in N m and the lift in m/s2."""
    found, over_inertia = np.eye(STATES), np.linalg.inv(model.inertia)
    for part in (TORQUE, LOAD, LOAD_RATE, LOAD_CURVE):
        found[part, part] = over_inertia
    return found


class Oracle:
    """The controller of every follower; all know the same and agree.

    Its load torque is that of the CG at the present lift, (T / M) m c, and wind is taken to stay as it is.
    """

    name = "oracle"
    needs_privileged = True
    tuning = OracleTuning()

    def __init__(self, config: Config, tuning: OracleTuning | None = None):
        self._model = ideal_model(config, self.name)
        self._sharing = sharing(config, self._model)
        self.gains, self._inverse_masses = gains(config, tuning or self.tuning)
        self._moment = rigid_moment(plant_parameters(config.plant, config.attitude))[:2]

    def start(self, observation: Array) -> Any:
        """See `Controller.start`."""
        return ()

    def step(self, state: Any, observation: Array, privileged: PrivilegedInfo) -> tuple[Any, Array]:
        """See `Controller.step`."""
        xp, model, scale = observation.__array_namespace__(), self._model, privileged.loop_scale
        seen, known = model.in_body_axes(observation), privileged
        carried = model.carried(known.believed_mass)
        own = self._feedback(seen, known)
        wanted = own.wanted(times(own.rows, self._state(seen, known)), None if scale is None else scale**2)
        # The load's torque grows with the lift.
        kp = len(model.own_mass) * xp.asarray(model.kp, dtype=seen.dtype)
        more = wanted.command[..., 2:] * _turning(self._in_plane(known.moment)) / kp
        more = more if scale is None else more / scale[..., None] ** 2
        wanted = wanted._replace(command=xp.concat([wanted.command[..., :2] - more, wanted.command[..., 2:]], axis=-1))
        return state, model.own(
            self._sharing(wanted, Assumed(carried, known.total_mass, level(seen), known.thrust, scale))[0]
        )

    def _feedback(self, seen: Array, known: PrivilegedInfo) -> Feedback:
        """Gains for the loops and the mass of each flight."""
        xp, own = seen.__array_namespace__(), self.gains
        rows, position = (xp.asarray(part, dtype=seen.dtype) for part in own[:2])
        if known.loop_scale is None:
            nominal = LOOP_SCALES.index(1.0) if rows.shape[-4] > 1 else 0
            rows, position = rows[..., nominal, :, :, :], position[..., nominal, :, :]
        else:
            place = xp.asarray(np.log2(LOOP_SCALES), dtype=seen.dtype)
            far = xp.abs(xp.clip(xp.log2(known.loop_scale), place[0], place[-1])[..., None] - place)
            weights = xp.clip(1.0 - far / (place[1] - place[0]), 0.0, 1.0)
            rows = (weights[..., None, None, None] * rows).sum(axis=-4)
            position = (weights[..., None, None] * position).sum(axis=-3)
        first, second = self._inverse_masses.tolist()
        share = ((1.0 / known.total_mass - first) / (second - first))[..., None, None]
        rows = (1.0 - share) * rows[..., 0, :, :] + share * rows[..., 1, :, :]
        return Feedback(rows, position, own.error_limit, own.limit)

    def _state(self, seen: Array, known: PrivilegedInfo) -> Array:
        """The state (..., 22) of `hover_model`, with torques in N m."""
        xp, model, mass = seen.__array_namespace__(), self._model, known.total_mass[..., None]
        places = [self._in_plane(part) for part in (known.moment, known.moment_rate, known.moment_acceleration)]
        loads = [model.gravity * _turning(part) for part in places]
        moment = xp.asarray(self._moment, dtype=seen.dtype)
        lift, turn = known.rotors[..., 0], known.rotors[..., 1:].sum(axis=-2)
        total, tilt, rates = lift.sum(axis=-1)[..., None] / mass, seen[..., 3:5], seen[..., 9:11]
        turn = turn + model.lever_torque(lift) + total * _turning(moment)

        def of_cg(error: Array, angles: Array, place: Array) -> list[Array]:
            flat = error[..., :2] - place / mass
            return [flat, error[..., 2:] + (_turning(moment) * angles).sum(axis=-1)[..., None] / mass]

        wind = xp.zeros_like(seen[..., :3]) if known.force is None else model.in_body_axes(known.force) / mass
        parts = [
            *of_cg(seen[..., ERROR], tilt, places[0]),
            *of_cg(seen[..., ERROR_RATE], rates, places[1]),
            *(tilt, rates, turn, total - model.gravity, *loads, wind),
        ]
        return xp.concat(parts, axis=-1)

    def _in_plane(self, moment: Array) -> Array:
        """A vector (..., 2) of the load in body axes, of one in the form of `PrivilegedInfo`."""
        xp, model = moment.__array_namespace__(), self._model
        if model.angles is not None:
            return model.in_body_axes(xp.concat([moment, 0.0 * moment[..., :1]], axis=-1))[..., :2]
        zero = 0.0 * moment
        return joined([moment, zero] if model.axes == (1,) else [zero, moment])


def _turning(moment: Array) -> Array:
    """Roll and pitch torque (..., 2) about O of weights with this first `moment` (..., 2), over gravity."""
    return joined([-moment[..., 1], moment[..., 0]])
