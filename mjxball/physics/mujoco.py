"""Accelerations and internal forces of the assembly from C MuJoCo, for models whose welded bodies are not merged."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from mjxball.assembly import ASSEMBLY, BALL, build_model, drone_names
from mjxball.config import Attitude, Config, Plant
from mjxball.control import mixer, rotations
from mjxball.physics import motion
from mjxball.physics.engine import CgState, Engine, Load, PlantState, Wrench, total_wrench
from mjxball.plant import ROLLING_INERTIA, plant_parameters

if TYPE_CHECKING:
    from jaxtyping import Float

    from mjxball.arrays import Array
    from mjxball.physics.engine import Coordinates, Scalar, Vector


def make_engine(plant: Plant, attitude: Attitude, step: float = 0.0) -> Engine:
    """Return the C MuJoCo engine of `plant` on NumPy arrays of any batch shape; it computes one environment at a time.

    For a prescribed motion the force on the slide that gives the ball its c'' is computed from MuJoCo's mass matrix and
    applied. The accelerations are then MuJoCo's. Those of elastic mounts are for physics steps of `step` [s], see
    `plant.mounts.hinge`.
    """
    world = MujocoWorld(plant, attitude, step)
    share, mounted = plant.moving_fraction, 2 * plant.count if plant.mount_frequency else 0

    def split(result: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[np.ndarray]]:
        swing = result[..., 6 : 6 + mounted].reshape(*result.shape[:-1], plant.count, -1)
        return result[..., :3], result[..., 3:6], result[..., 6 + mounted :], [swing] if mounted else []

    def prescribed(
        state: PlantState, wrench: Wrench, object_mass: Scalar, cg: CgState, added: Vector | None = None
    ) -> tuple[Array, ...]:
        _refuse(added)

        def one(s: PlantState, w: Wrench, mass: float, c: CgState) -> np.ndarray:
            world.place(s, mass, c.offset / share, c.rate / share)
            world.push(s, w)
            return world.drive(c.acceleration / share)

        linear, angular, _, swing = split(_each((state, wrench, object_mass, cg), state.time.shape, one))
        return linear, angular, *swing

    def rolling(
        state: PlantState, wrench: Wrench, object_mass: Scalar, ball_force: Coordinates, added: Vector | None = None
    ) -> tuple[Array, ...]:
        _refuse(added)

        def one(s: PlantState, w: Wrench, mass: float, force: Array) -> np.ndarray:
            world.place(s, mass, s.ball_offset, s.ball_rate)
            world.push(s, w)
            return world.roll(force)

        linear, angular, ball, swing = split(_each((state, wrench, object_mass, ball_force), state.time.shape, one))
        return linear, angular, ball[..., 0] if len(plant.directions) == 1 else ball, *swing

    return Engine(prescribed, rolling)


def _refuse(added: Vector | None) -> None:
    if added is not None and np.any(added):
        raise NotImplementedError("C MuJoCo knows bodies only, no inertia without mass")


def _each(arguments: Sequence[Any], shape: tuple[int, ...], function: Any) -> np.ndarray:
    """Stack `function` of every environment's slice of the arrays (or named tuples of arrays) in `arguments`."""

    def pick(value: Any, index: tuple[int, ...]) -> Any:
        if isinstance(value, tuple):
            return type(value)(*(pick(leaf, index) for leaf in value))
        return np.asarray(value)[index] if np.ndim(value) else value

    rows = [function(*(pick(value, index) for value in arguments)) for index in np.ndindex(shape)]
    return np.array(rows).reshape(*shape, *rows[0].shape)


class MujocoWorld:
    """MjModel and MjData of one plant, and the operations that the engine and the contact wrenches need."""

    def __init__(self, plant: Plant, attitude: Attitude, step: float = 0.0):
        self.model = build_model(plant, step)
        self.data = mujoco.MjData(self.model)
        self._plant, self._parameters = plant, plant_parameters(plant, attitude)
        self._shell, self._ball = self.model.body(ASSEMBLY).id, self.model.body(BALL).id
        self._drones = [self.model.body(name).id for name in drone_names(plant)]
        self._slides = slice(self.model.nv - len(plant.directions), self.model.nv)
        hinges = 2 * plant.count if plant.mount_frequency else 0
        self._hinges = slice(self._slides.start - hinges, self._slides.start)

    def place(self, state: PlantState, object_mass: float, offset: Array, rate: Array) -> None:
        """Set mass, positions and velocities, and compute what depends on them; all applied forces are 0 afterwards."""
        model, data, share, own = self.model, self.data, self._plant.moving_fraction, self._parameters
        model.body_mass[self._shell] = object_mass * (1 - share) + own.carrier_mass
        model.body_mass[self._ball] = object_mass * share
        model.body_inertia[self._shell] = object_mass * own.shell_inertia_per_mass + own.carrier_inertia
        model.body_inertia[self._ball] = object_mass * own.ball_inertia_per_mass
        model.dof_armature[self._slides] = ROLLING_INERTIA * object_mass * share
        roll = rotations.roll_of_quaternion(state.quaternion)
        root = {
            "free": ([*state.position, *state.quaternion], [*state.velocity, *state.rates]),
            "heave": ([state.position[2], roll], [state.velocity[2], state.rates[0]]),
            "pivot": ([roll], [state.rates[0]]),
        }
        position, velocity = root[self._plant.stand]
        angle, swing = (() if each is None else np.ravel(each) for each in (state.mount_angle, state.mount_rate))
        data.qpos[:] = [*position, *angle, *np.atleast_1d(offset)]
        data.qvel[:] = [*velocity, *swing, *np.atleast_1d(rate)]
        data.qfrc_applied[:] = 0
        data.xfrc_applied[:] = 0
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)

    def push(self, state: PlantState, wrench: Wrench) -> None:
        """Apply the wrench about O to the assembly's body; the part of rotors on elastic mounts to the drones."""
        if state.mount_angle is not None:
            own = total_wrench(self._plant, self._parameters, state.rotor_force)
            wrench = Wrench(wrench.force - own.force, wrench.torque - own.torque)
            self.load_drones(state.rotor_force)
        matrix = rotations.matrix_from_quaternion(state.quaternion)
        self.pull(matrix @ wrench.force, matrix @ wrench.torque)

    def pull(self, force: Vector, torque: Vector) -> None:
        """Apply a force at O and a torque, world axes, to the assembly's body."""
        origin = self.data.xpos[self._shell]
        mujoco.mj_applyFT(self.model, self.data, force, torque, origin, self._shell, self.data.qfrc_applied)

    def drive(self, acceleration: Array) -> Float[np.ndarray, " n"]:
        """Accelerate the ball by `acceleration` along its slides and return what `roll` returns."""
        data = self.data
        pushed = data.qfrc_applied + self._external() + data.qfrc_passive - data.qfrc_bias
        return self.roll(slide_force(self.model, self.data, self._slides, acceleration, pushed))

    def roll(self, force: Array) -> Float[np.ndarray, " n"]:
        """Accelerations (n,): O in the world, angular in body axes, mounts, ball; with `force` on the slides [N]."""
        model, data = self.model, self.data
        data.qfrc_applied[self._slides] += force
        mujoco.mj_fwdActuation(model, data)
        mujoco.mj_fwdAcceleration(model, data)
        data.qacc[:] = data.qacc_smooth
        a = data.qacc
        if self._plant.stand == "free":
            return a.copy()
        rise = a[0] if self._plant.stand == "heave" else 0.0
        roll = a[self._hinges.start - 1]
        return np.array([0.0, 0.0, rise, roll, 0.0, 0.0, *a[self._hinges.start :]])

    def load_drones(self, rotor_force: Float[Array, "drones 4"]) -> None:
        """Apply each drone's rotor wrench to the drone's body, so that its mount carries it to the object."""
        own = self._parameters
        wrenches = mixer.wrench_from_rotors(rotor_force, own.arm, own.yaw_per_thrust, self._plant.layout)
        for body, wrench in zip(self._drones, wrenches, strict=True):
            matrix = self.data.xmat[body].reshape(3, 3)
            self.data.xfrc_applied[body, :3] = matrix[:, 2] * wrench[0]
            self.data.xfrc_applied[body, 3:] = matrix @ wrench[1:]

    def contact_wrenches(self, state: PlantState) -> Float[np.ndarray, "2 drones 3"]:
        """Forces and torques that the drones exert on the carrier at their centres, body axes [N, N m].

        `cfrc_int` of a drone's body is what the weld exerts on the drone: world axes, torque first, about the centre of
        mass of the whole tree. Call `load_drones` and `drive` or `roll` first.
        """
        mujoco.mj_rnePostConstraint(self.model, self.data)
        matrix = rotations.matrix_from_quaternion(state.quaternion)
        about = self.data.subtree_com[self.model.body_rootid[self._shell]]
        result = np.empty((2, len(self._drones), 3))
        for number, body in enumerate(self._drones):
            torque, force = -self.data.cfrc_int[body, :3], -self.data.cfrc_int[body, 3:]
            moved = torque + rotations.cross(about - self.data.xipos[body], force)
            result[:, number] = force @ matrix, moved @ matrix
        return result

    def _external(self) -> Float[np.ndarray, " nv"]:
        """Generalized force (nv,) of `xfrc_applied`."""
        total = np.zeros(self.model.nv)
        for body in self._drones:
            force, torque = self.data.xfrc_applied[body, :3], self.data.xfrc_applied[body, 3:]
            mujoco.mj_applyFT(self.model, self.data, force, torque, self.data.xipos[body], body, total)
        return total


def slide_force(
    model: mujoco.MjModel, data: mujoco.MjData, slides: slice, acceleration: Array, pushed: Float[np.ndarray, " nv"]
) -> Float[np.ndarray, " n"]:
    """Force [N] on the joints `slides` that accelerates them by `acceleration` [m/s2], beside the forces `pushed`."""
    count = slides.stop - slides.start
    pushes, answers = np.zeros((1 + count, model.nv)), np.empty((1 + count, model.nv))
    pushes[0] = pushed
    for number in range(count):
        pushes[1 + number, slides.start + number] = 1.0
    mujoco.mj_solveM(model, data, answers, pushes)
    lacking, response = acceleration - answers[0, slides], answers[1:, slides]
    return lacking / response[0] if count == 1 else np.linalg.solve(response, lacking)


def flown_contact_wrenches(
    config: Config, flown: PlantState, load: Load
) -> tuple[Float[np.ndarray, "T n drones 3"], Float[np.ndarray, "T n drones 3"]]:
    """Contact forces [N] and torques [N m] of recorded states (T, n, ...) from MuJoCo's internal forces.

    `load.external_force` (T, n, 3) acts on O. Rotors have no other air than at rest.
    """
    world = MujocoWorld(config.plant, config.attitude)
    share, rolling = config.plant.moving_fraction, config.motion.kind == "rolling"
    mass = motion.object_mass(flown.time, load)
    if rolling:
        ball = CgState(flown.ball_offset, flown.ball_rate, flown.ball_rate)
        drive = motion.make_rolling_force(config)(flown.ball_offset, flown.ball_rate, share * mass)
    else:
        ball = motion.make_cg_motion(config)(flown.time, load)
        ball = CgState(ball.offset / share, ball.rate / share, ball.acceleration / share)
        drive = ball.acceleration

    def one(state: PlantState, object_mass: float, ball: CgState, drive: Array, force: Array | None) -> np.ndarray:
        world.place(state, object_mass, ball.offset, ball.rate)
        world.load_drones(state.rotor_force)
        if force is not None:
            world.pull(force, np.zeros(3))
        world.roll(drive) if rolling else world.drive(drive)
        return world.contact_wrenches(state)

    result = _each((flown, mass, ball, drive, load.external_force), flown.time.shape, one)
    return result[..., 0, :, :], result[..., 1, :, :]
