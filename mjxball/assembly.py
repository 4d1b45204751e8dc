"""MuJoCo model of drones, carrier, object and ball, built with MjSpec from a `Plant`.

`python -m mjxball.assembly OUT.xml [--plant NAME|FILE]` writes a plant as MJCF, for any MuJoCo viewer.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjxball.cli import make_parser, output_file, plant_setup
from mjxball.config import Attitude, Plant
from mjxball.errors import InputError
from mjxball.files import write_atomically
from mjxball.plant import ROLLING_INERTIA, plant_parameters, rotors
from mjxball.plant.mounts import hinge
from mjxball.running import quit_on_interrupt, run_command

ASSEMBLY = "assembly"
LEADER = "leader"
FOLLOWER = "follower"
BALL = "ball"
BALL_JOINT = "cg"  # the ball's first slide joint
BALL_JOINTS = (BALL_JOINT, "cg_across")
RIM_PARTS = 24  # number of capsules that draw a plate's rim
COLOURS = {LEADER: (0.85, 0.25, 0.2, 1.0), FOLLOWER: (0.2, 0.4, 0.85, 1.0)}


def drone_names(plant: Plant) -> list[str]:
    """Names of the drones' bodies in the plant's order: leader and follower, or follower1, follower2, ... of a team."""
    followers = plant.count - 1
    numbered = iter([FOLLOWER] if followers == 1 else [f"{FOLLOWER}{number + 1}" for number in range(followers)])
    return [LEADER if number == plant.leader else next(numbered) for number in range(plant.count)]


def build_spec(plant: Plant, timestep: float = 0.002) -> mujoco.MjSpec:
    """MjSpec of the assembly: carrier and shell, drones, and the moving mass on one or two slide joints.

    The drones' centres are at their mounts, turned by their yaw; they are welded, or with `plant.mount_frequency` on
    two hinges each (`plant.mounts`). In the reference plant the shell is massless, and the ball has the object's whole
    mass with the box's inertia. The root is free, or on a stand: a hinge along x (`pivot`), or a vertical slide and
    that hinge (`heave`). Each drone has four `motor` actuators, in the drones' order, whose controls are rotor forces
    [N]; their gear contains the yaw moment. `timestep` [s] affects viewers, MuJoCo's own integrator, and elastic
    mounts. Raises InputError if it is too long for these.
    """
    parameters = plant_parameters(plant, Attitude())
    fixed, moving = (1 - plant.moving_fraction) * plant.object_mass, plant.moving_fraction * plant.object_mass
    spec = mujoco.MjSpec()
    spec.modelname = "mjxball"
    spec.option.timestep = timestep
    spec.option.gravity = [0.0, 0.0, -plant.gravity]
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    if plant.mount_frequency and fixed + plant.carrier_mass == 0:
        raise InputError(
            "elastic mounts need a carrier that has a mass: set plant.carrier_mass and carrier_inertia, or "
            "plant.moving_fraction below 1"
        )
    if plant.mount_frequency:  # the hinges' own damping is implicit already, see `plant.mounts.hinge`
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    _add_scenery(spec)
    shell_inertia = parameters.carrier_inertia + plant.object_mass * parameters.shell_inertia_per_mass
    body = spec.worldbody.add_body(
        name=ASSEMBLY,
        mass=fixed + plant.carrier_mass,
        explicitinertial=True,
        ipos=[0, 0, 0],
        inertia=shell_inertia.tolist(),
    )
    _add_root_joints(body, plant.stand)
    _add_shell(body, plant)
    body.add_site(name="origin", pos=[0, 0, 0], size=[0.01, 0.01, 0.01])
    if plant.count > 2:
        _add_spokes(body, plant)
    for number, name in enumerate(drone_names(plant)):
        _add_drone(spec, body, name, number, plant)
    ball = body.add_body(
        name=BALL,
        mass=moving,
        explicitinertial=True,
        ipos=[0, 0, 0],
        inertia=(plant.object_mass * parameters.ball_inertia_per_mass).tolist(),
    )
    for joint, direction in zip(BALL_JOINTS, plant.directions, strict=False):
        axis = np.eye(3)[direction].tolist()
        ball.add_joint(name=joint, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis, armature=ROLLING_INERTIA * moving)
    _add_visual(ball, "cg", mujoco.mjtGeom.mjGEOM_SPHERE, [plant.ball_radius, 0, 0], (0.95, 0.75, 0.1, 1.0))
    return spec


def build_model(plant: Plant, timestep: float = 0.002, fuse: bool = False) -> mujoco.MjModel:
    """Compile `build_spec`. `fuse` merges the welded drones into the assembly's body and drops visual elements.

    The fused model, which MJX steps, has the same dynamics. Contact wrenches need the unfused one.
    """
    spec = build_spec(plant, timestep)
    if fuse:
        for element in [*spec.actuators, *spec.sites, *spec.geoms, *spec.lights, *spec.cameras, *spec.textures]:
            spec.delete(element)
        for material in [*spec.materials]:
            spec.delete(material)
        spec.compiler.fusestatic = True
    return spec.compile()


def to_mjcf(plant: Plant) -> str:
    """The model as MJCF text for any MuJoCo viewer."""
    spec = build_spec(plant)
    spec.compile()
    return spec.to_xml()


def _add_root_joints(body: mujoco.MjsBody, stand: str) -> None:
    if stand == "free":
        body.add_freejoint(name="free")
        return
    if stand == "heave":
        body.add_joint(name="heave", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1])
    body.add_joint(name="roll", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[1, 0, 0])


def _add_scenery(spec: mujoco.MjSpec) -> None:
    spec.add_texture(
        name="grid",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=[0.32, 0.36, 0.42],
        rgb2=[0.38, 0.42, 0.48],
        width=256,
        height=256,
    )
    material = spec.add_material(name="grid", texrepeat=[8, 8], texuniform=True)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "grid"
    floor = spec.worldbody.add_geom(
        name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[4, 4, 0.1], pos=[0, 0, -1], material="grid"
    )
    floor.contype = floor.conaffinity = 0
    spec.worldbody.add_light(pos=[0, -2, 4], dir=[0, 0.4, -1], type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL)
    spec.worldbody.add_camera(name="side", pos=[0.5, -3.2, 1.0], xyaxes=[1, 0, 0, 0, 0.2, 1])


def _add_visual(body: mujoco.MjsBody, name: str, kind: mujoco.mjtGeom, size: Any, rgba: Any) -> mujoco.MjsGeom:
    geom = body.add_geom(name=name, type=kind, rgba=rgba, group=1)
    geom.size[: len(size)] = size
    geom.contype = geom.conaffinity = 0
    geom.mass = 0.0
    return geom


def _add_shell(body: mujoco.MjsBody, plant: Plant) -> None:
    """Visual of the object. A load that moves in the plane has a plate, drawn thin so that drones show, and its rim."""
    half, colour = np.array(plant.object_size) / 2, (0.75, 0.65, 0.45, 0.35)
    if len(plant.directions) == 2:
        half[2] *= 0.2
    if plant.is_disc:
        _add_visual(body, "shell", mujoco.mjtGeom.mjGEOM_CYLINDER, half[[0, 2]], colour)
    else:
        _add_visual(body, "shell", mujoco.mjtGeom.mjGEOM_BOX, half, colour)
    if len(plant.directions) == 2 and plant.ball_stop:
        angle = 2 * np.pi * np.arange(RIM_PARTS + 1) / RIM_PARTS
        edge = plant.ball_stop * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle])
        for number, (begin, end) in enumerate(itertools.pairwise(edge)):
            part = _add_visual(body, f"rim{number}", mujoco.mjtGeom.mjGEOM_CAPSULE, [0.003], (0.55, 0.43, 0.16, 0.9))
            part.fromto[:] = [*begin, *end]


def _add_spokes(body: mujoco.MjsBody, plant: Plant) -> None:
    """Visual rods from O to every drone."""
    for number, drone in enumerate(plant.drones):
        rod = _add_visual(body, f"spoke{number}", mujoco.mjtGeom.mjGEOM_CAPSULE, [0.008], (0.75, 0.65, 0.45, 0.8))
        rod.fromto[:] = [0, 0, 0, *drone.mount]


def _add_drone(spec: mujoco.MjSpec, parent: mujoco.MjsBody, name: str, number: int, plant: Plant) -> None:
    """Body, visuals, sites and actuators of drone `number` of `plant`; the body is called `name`."""
    mounted = plant.drones[number]
    arm, force, yaw_per_thrust = (
        plant.of_drones(field)[number] for field in ("arm", "rotor_force_max", "yaw_per_thrust")
    )
    colour = COLOURS[LEADER if number == plant.leader else FOLLOWER]
    drone = parent.add_body(
        name=name,
        pos=mounted.mount,
        quat=[np.cos(mounted.yaw / 2), 0, 0, np.sin(mounted.yaw / 2)],
        mass=mounted.mass,
        explicitinertial=True,
        ipos=[0, 0, 0],
        inertia=list(mounted.inertia),
    )
    if plant.mount_frequency:
        _add_hinges(drone, plant, mounted.inertia, spec.option.timestep)
    _add_visual(drone, f"{name}_hub", mujoco.mjtGeom.mjGEOM_BOX, [0.035, 0.035, 0.015], colour)
    places, spins = rotors.PLACES[plant.layout], rotors.SPIN[plant.layout]
    for rotor, (axis, spin) in enumerate(zip(places, spins, strict=True), start=1):
        place = rotors.lever(arm, plant.layout) * np.array([*axis, 0.0])
        label = f"{name}_rotor{rotor}"
        rod = _add_visual(drone, f"{label}_arm", mujoco.mjtGeom.mjGEOM_CAPSULE, [0.005], colour)
        rod.fromto[:] = [0, 0, 0, *place]
        disc = _add_visual(
            drone, f"{label}_disc", mujoco.mjtGeom.mjGEOM_CYLINDER, [0.4 * arm, 0.003], (0.2, 0.2, 0.2, 0.4)
        )
        disc.pos = [place[0], place[1], 0.015]
        drone.add_site(name=label, pos=place, size=[0.005, 0.005, 0.005])
        motor = spec.add_actuator(name=label, target=label, trntype=mujoco.mjtTrn.mjTRN_SITE)
        motor.set_to_motor()
        motor.gear[:] = [0, 0, 1, 0, 0, spin * yaw_per_thrust]
        motor.ctrllimited = True
        motor.ctrlrange[:] = [0, force]


def _add_hinges(drone: mujoco.MjsBody, plant: Plant, inertia: Sequence[float], timestep: float) -> None:
    """Elastic mount: hinges about the drone's own x, then y; `inertia` about its own axes [kg m2]."""
    for number, axis in enumerate(("roll", "pitch")):
        joint = drone.add_joint(name=f"{drone.name}_{axis}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=np.eye(3)[number])
        own = hinge(plant, inertia[number], timestep)
        joint.armature = own.armature
        for field, value in (("stiffness", own.stiffness), ("damping", own.damping)):
            # MuJoCo 4 takes the coefficients of a polynomial.
            setattr(joint, field, value if np.ndim(getattr(joint, field)) == 0 else [value, 0.0, 0.0])


def main(arguments: list[str] | None = None) -> int:
    """Command line of `python -m mjxball.assembly`; returns the exit code."""
    parser = make_parser("python -m mjxball.assembly", "Write a plant as MJCF.")
    parser.add_argument("out", metavar="OUT.xml", type=Path, help="file to write; must not exist")
    parser.add_argument(
        "--plant", type=Path, metavar="NAME|FILE", help="shipped plant, or a file of a rig or drone (pair)"
    )
    options = parser.parse_args(arguments)

    def command() -> int:
        plant = plant_setup(options.plant).plant
        write_atomically(output_file(options.out, ".xml"), to_mjcf(plant))
        return 0

    return run_command(command)


if __name__ == "__main__":
    quit_on_interrupt()
    sys.exit(main())
