"""MuJoCo model of the twin's pair: that of `mjxball.assembly` with legs and a floor, a load, and elastic mounts.

The pair stands on the ground (on a stand: at its lowest position) and takes off and lands by contact.
"""

from __future__ import annotations

import dataclasses

import mujoco

from mjxball.assembly import ASSEMBLY, FOLLOWER, LEADER, build_spec
from mjxball.config import Config, Plant
from mjxfly.mount_modes import Mount

STEP = 0.001  # [s] of MuJoCo, the sensors and the motors
LEG = 0.03  # [m] from a drone's centre down to the centre of its feet
FOOT_OFFSET = 0.03  # [m] from a drone's centre to its feet, along x and along y
FOOT = 0.003  # [m] radius of a foot


def with_mount(config: Config, mount: Mount | None) -> Config:
    """`config` with the elastic mounts `mount`, if any."""
    if mount is None:
        return config
    plant = dataclasses.replace(config.plant, mount_frequency=mount.frequency, mount_damping=mount.damping)
    return dataclasses.replace(config, plant=plant)


def grounded_model(config: Config, object_mass: float) -> mujoco.MjModel:
    """Return the assembly's model with legs, floor and contact; O is at height 0 when the drones stand on the floor."""
    plant = dataclasses.replace(config.plant, object_mass=object_mass)
    spec = build_spec(plant, STEP)
    disabled = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    spec.option.disableflags &= ~int(disabled)
    floor = spec.geom("floor")
    lowest = min(drone.mount[2] for drone in plant.drones)
    floor.pos = [0.0, 0.0, lowest - LEG - FOOT if plant.stand != "pivot" else -1.0]
    floor.contype, floor.conaffinity = 1, 2
    for name in (LEADER, FOLLOWER):
        drone = spec.body(name)
        places = [(x, y, -LEG) for x in (-FOOT_OFFSET, FOOT_OFFSET) for y in (-FOOT_OFFSET, FOOT_OFFSET)]
        for place in (*places, (0.0, 0.0, LEG)):
            leg = drone.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[FOOT, 0, 0], pos=place, mass=0.0)
            leg.contype, leg.conaffinity, leg.solref = 2, 1, [0.008, 1.0]
        drone.add_site(name=f"{name}_imu", pos=[0, 0, 0], size=[0.001, 0.001, 0.001])
        for sensor in (mujoco.mjtSensor.mjSENS_ACCELEROMETER, mujoco.mjtSensor.mjSENS_GYRO):
            spec.add_sensor(type=sensor, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=f"{name}_imu")
    model = spec.compile()
    model.actuator_ctrllimited[:] = False  # `BatteriesAndMotors` limits the motors, by the battery's voltage
    return model


def attach_load(model: mujoco.MjModel, plant: Plant, mass: float, offset: float) -> None:
    """Fix a point mass of `mass` [kg] to the stick of `model` at `offset` [m] from O, its centre, along the CG axis.

    Position and velocity of O do not change: the load moves with the stick when it is attached.
    """
    body, axis = model.body(ASSEMBLY).id, "xy".index(plant.cg_axis)
    before = float(model.body_mass[body])
    after = before + mass
    across = before * mass / after * offset**2  # about the common centre
    model.body_mass[body] = after
    model.body_ipos[body][axis] = mass / after * offset
    model.body_inertia[body] += [0.0 if i == axis else across for i in range(3)]
    mujoco.mj_setConst(model, mujoco.MjData(model))
