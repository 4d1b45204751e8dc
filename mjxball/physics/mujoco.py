"""Accelerations of the assembly from C MuJoCo on the unfused model: the second engine, for evaluation and tests."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from mjxball.assembly import BALL, build_model
from mjxball.config import Attitude, Plant
from mjxball.control import rotations
from mjxball.physics.constants import box_inertia_per_mass
from mjxball.physics.engine import Acceleration, PlantState, Wrench
from mjxball.physics.motion import CgState

Array = Any
SLIDE = 6  # degree of freedom of the ball's joint; 0..5 are the free joint's


def make_acceleration(plant: Plant, attitude: Attitude) -> Acceleration:
    """Return the C MuJoCo `engine.Acceleration` of `plant` on NumPy arrays of any batch shape, one world at a time.

    The slide force that gives the ball its prescribed acceleration is computed from MuJoCo's mass matrix and
    applied to the joint; the accelerations are then MuJoCo's own `qacc`.
    """
    model = build_model(plant)
    data = mujoco.MjData(model)
    ball = model.body(BALL).id
    box = box_inertia_per_mass(plant.object_size)
    unit = np.zeros((1, model.nv))
    unit[0, SLIDE] = 1.0

    def one(state: PlantState, wrench: Wrench, object_mass: float, cg: CgState) -> np.ndarray:
        model.body_mass[ball] = object_mass
        model.body_inertia[ball] = object_mass * box
        data.qpos[:] = [*state.position, *state.quaternion, cg.offset]
        data.qvel[:] = [*state.velocity, *state.rates, cg.rate]
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        matrix = rotations.matrix_from_quaternion(state.quaternion)
        data.qfrc_applied[:] = [*(matrix @ wrench.force), *wrench.torque, 0.0]
        free, response = np.zeros((1, model.nv)), np.zeros((1, model.nv))
        mujoco.mj_solveM(model, data, free, (data.qfrc_applied - data.qfrc_bias)[None])
        mujoco.mj_solveM(model, data, response, unit)
        data.qfrc_applied[SLIDE] = (cg.acceleration - free[0, SLIDE]) / response[0, SLIDE]
        mujoco.mj_fwdActuation(model, data)
        mujoco.mj_fwdAcceleration(model, data)
        return data.qacc_smooth[:SLIDE].copy()

    def acceleration(state: PlantState, wrench: Wrench, object_mass: Array, cg: CgState) -> tuple[Array, Array]:
        shape = state.rates.shape[:-1]
        result = np.empty((*shape, SLIDE))
        for index in np.ndindex(shape):
            result[index] = one(
                PlantState(*(leaf[index] for leaf in state)),
                Wrench(*(leaf[index] for leaf in wrench)),
                np.broadcast_to(object_mass, shape)[index],
                CgState(*(np.broadcast_to(leaf, shape)[index] for leaf in cg)),
            )
        return result[..., :3], result[..., 3:]

    return acceleration
