"""Properties of a compiled model that act besides masses, gravity and rotors. Needs MuJoCo.

Known ones are removed and named. Then MuJoCo's accelerations of the rest, at random states, must be those of the masses
and rotors that were read, so that nothing is ignored silently.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from mjxball.errors import InputError

ACTS = {  # attributes of a joint, and their arrays in MjModel
    "armature": ("dof_armature",),
    "damping": ("dof_damping", "dof_dampingpoly"),
    "frictionloss": ("dof_frictionloss",),
    "stiffness": ("jnt_stiffness", "jnt_stiffnesspoly"),
    "range": ("jnt_limited",),
}
ROLLING = 0.4  # armature over mass that makes a slide a rolling ball, as the plant's load is
STATES = 3  # random states at which accelerations are compared
CLOSE = 1e-6  # tolerance, over the largest acceleration
WORST = 1e9  # condition of the mass matrix up to which CLOSE can be reached; every rig is below it
LOCKED = 1e9  # armature that keeps propellers from spinning up [kg m2]
Named = Callable[[str, int], str]
Vector = np.ndarray


class Rigid(NamedTuple):
    """A rigid body in the frame of the model's free body."""

    mass: float  # [kg]
    centre: Vector  # (3,) centre of mass [m]
    inertia: np.ndarray  # (3, 3) about `centre` [kg m2]


class Rotor(NamedTuple):
    """A rotor that pushes along z; None for values that the model does not give."""

    place: Vector  # (3,) in the same frame [m]
    force_max: float | None = None  # [N]
    yaw: float | None = None  # yaw moment over force, signed [m]
    lag: float | None = None  # time constant of the force [s]


class Slide(NamedTuple):
    """A slide joint of the load."""

    joint: int
    axis: np.ndarray  # (3,) in the frame of the free body


class Thruster(NamedTuple):
    """The actuator of a rotor."""

    number: int
    per_input: float  # force over control [N]
    inputs: tuple[float, float]  # least and largest control
    rotor: Rotor


def refuse_other_models(model: Any, root: int, named: Named) -> None:
    """Raise InputError for constraints, other gravity, and springs on the free body, which no plant has."""
    import mujoco

    if model.neq or model.ntendon:
        raise InputError("it has equality constraints or tendons, expected bodies that are fixed to each other")
    gravity = model.opt.gravity
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY:
        raise InputError('<flag gravity="disable"/> takes its weight, expected gravity that pulls along -z')
    if gravity[:2].any() or gravity[2] >= 0:
        shown = " ".join(f"{part:.3g}" for part in gravity + 0.0)
        raise InputError(f"gravity is {shown} m/s2, expected one that pulls along -z")
    for body, share in enumerate(model.body_gravcomp):
        if share and model.body_rootid[body] == root:
            raise InputError(
                f"{named('body', body)} has gravcomp {share:g}, expected 0: rotors carry all of its weight"
            )
    for joint, body in enumerate(model.jnt_bodyid):
        if body == root and model.jnt_stiffness[joint]:
            raise InputError(
                f"{named('joint', joint)} has stiffness {model.jnt_stiffness[joint]:g}, expected 0: it flies free"
            )


def refuse_disabled(model: Any, number: int, named: Named) -> None:
    """Raise InputError if options of the model disable the actuator `number`."""
    import mujoco

    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_ACTUATION:
        raise InputError('<flag actuation="disable"/> stops all actuators, expected rotors that push')
    group = int(model.actuator_group[number])
    if 0 <= group < 31 and model.opt.disableactuator >> group & 1:
        raise InputError(
            f"actuatorgroupdisable stops group {group}, of {named('actuator', number)}, expected rotors that push"
        )


def without(model: Any, slides: Sequence[Slide], load_mass: float, named: Named) -> tuple[Any, list[str]]:
    """(`model` without `ACTS`, air, contacts and delays, a description of each that it had)."""
    import mujoco

    bare, lines = copy.copy(model), []
    if model.opt.density or model.opt.viscosity:
        lines.append("air: density, viscosity and wind of <option>")
    bare.opt.density = bare.opt.viscosity = 0.0
    bare.opt.enableflags = 0
    bare.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    if model.actuator_delay.any():
        lines.append(f"delay {model.actuator_delay.max():g} of actuators")
    bare.actuator_delay[:] = 0
    for joint in (_free(model), *(slide.joint for slide in slides)):
        lines += [f"{what} of {named('joint', joint)}" for what in _taken_out(bare, joint, load_mass)]
    hinges = model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
    bare.dof_armature[model.jnt_dofadr[hinges]] = LOCKED
    mujoco.mj_setConst(bare, mujoco.MjData(bare))  # armature is part of inertias that MuJoCo precomputes
    return bare, lines


def _free(model: Any) -> int:
    import mujoco

    return int(np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)[0])


def _taken_out(bare: Any, joint: int, load_mass: float) -> list[str]:
    """Set the `ACTS` of a joint in `bare` to zero, and describe those that were not."""
    slides, start, place = joint != _free(bare), bare.jnt_dofadr[joint], bare.jnt_qposadr[joint]
    shown = []
    for attribute, arrays in ACTS.items():
        found = 0.0
        for name in arrays:
            array = getattr(bare, name)
            rows = slice(start, start + (1 if slides else 6)) if name.startswith("dof_") else joint
            found = max(found, float(np.abs(array[rows]).max()))
            array[rows] = 0
        if attribute == "range" and found:
            shown.append("range {:g} {:g}".format(*bare.jnt_range[joint]))
        elif attribute == "stiffness" and found:
            shown.append(f"stiffness {found:g} and springref {bare.qpos_spring[place]:g}")
        elif found and not (slides and attribute == "armature" and abs(found / load_mass - ROLLING) < 1e-3):
            shown.append(f"{attribute} {found:g}")
    if slides and bare.qpos0[place]:
        shown.append(f"ref {bare.qpos0[place]:g}")
    return shown


def check_all_was_named(
    bare: Any, parts: Sequence[Rigid], load: Rigid | None, slides: Sequence[Slide], thrusters: Sequence[Thruster]
) -> None:
    """Raise InputError unless `bare` accelerates like `parts` and the `load` on its slides under the rotors' forces.

    Positions of all parts are those of the model's initial state; the free body's attitude, all velocities and the
    rotors' forces are random.
    """
    import mujoco

    if not thrusters:  # the file beside the model gives the rotors
        bare.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    plain = _plain_model(parts, load, slides, bare.opt.gravity)
    if plain is None:
        return
    random, data, own = np.random.default_rng(0), mujoco.MjData(bare), mujoco.MjData(plain)
    place, start = bare.jnt_qposadr[_free(bare)], bare.jnt_dofadr[_free(bare)]
    moving = [*range(start, start + 6), *(bare.jnt_dofadr[slide.joint] for slide in slides)]
    weight = sum(part.mass for part in (*parts, *([load] if load else []))) * -bare.opt.gravity[2]
    for _ in range(STATES):
        turned = random.normal(size=4)
        own.qpos[3:7] = data.qpos[place + 3 : place + 7] = turned / np.linalg.norm(turned)
        own.qvel[:] = data.qvel[moving] = random.normal(size=len(moving))
        forces = _push(bare, data, thrusters, 2 * weight, random)
        mujoco.mj_forward(bare, data)
        mujoco.mj_fwdPosition(plain, own)
        axes, own.qfrc_applied[:] = own.xmat[1].reshape(3, 3), 0
        for rotor, force in forces:
            lift, twist = force * axes[:, 2], force * (rotor.yaw or 0.0) * axes[:, 2]
            mujoco.mj_applyFT(plain, own, lift, twist, own.qpos[:3] + axes @ rotor.place, 1, own.qfrc_applied)
        mujoco.mj_forward(plain, own)
        theirs, ours = data.qacc[moving], own.qacc
        off = np.abs(theirs - ours).max()
        if not off <= CLOSE * np.abs([theirs, ours]).max():
            raise InputError(
                f"MuJoCo's accelerations of it are up to {off:.2g} m/s2 or rad/s2 off those of its masses and "
                "rotors: something else acts on it, or its numbers are those of no rig"
            )


def _plain_model(parts: Sequence[Rigid], load: Rigid | None, slides: Sequence[Slide], gravity: Vector) -> Any:
    """A model of a free body of `parts` with the `load` on `slides`; None for values that validation refuses later."""
    import mujoco

    spec = mujoco.MjSpec()
    spec.option.gravity = gravity
    body = spec.worldbody.add_body()
    body.add_freejoint()
    for part in (*parts, *([load] if load else [])):
        (xx, xy, xz), (_, yy, yz), (_, _, zz) = part.inertia
        solid = body.add_body(mass=part.mass, ipos=part.centre, fullinertia=[xx, yy, zz, xy, xz, yz])
        solid.explicitinertial = True
        for slide in slides if part is load else ():
            solid.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=slide.axis)
    try:
        model = spec.compile()
    except ValueError:
        return None
    data, matrix = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, matrix)
    return model if np.linalg.cond(matrix) < WORST else None


def _push(
    bare: Any, data: Any, thrusters: Sequence[Thruster], most: float, random: np.random.Generator
) -> list[tuple[Rotor, float]]:
    """Set random controls of the rotors in `data`, of at most `most` [N] in all; returns (rotor, force [N])."""
    forces = []
    for number, per_input, (low, high), rotor in thrusters:
        least = max(low, 0.0)
        put = least + random.uniform() * (max(min(high, most / len(thrusters) / per_input), least) - least)
        data.ctrl[number] = put
        if bare.actuator_actadr[number] >= 0:
            data.act[bare.actuator_actadr[number]] = put
        forces.append((rotor, per_input * put))
    return forces
