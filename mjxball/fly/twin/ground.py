"""The assembly's MuJoCo model with what a rehearsal needs: legs, a floor to stand on, and both drones' sensors."""

from __future__ import annotations

import dataclasses

import mujoco

from mjxball.assembly import FOLLOWER, LEADER, build_spec
from mjxball.config import Config

STEP = 0.001  # [s] of MuJoCo, the sensors and the motors
LEG = 0.03  # [m] from a drone's centre down to what it stands on
REACH = 0.03  # [m] from a drone's centre sideways to each of its legs
FOOT = 0.003  # [m] radius


def grounded_model(config: Config, object_mass: float) -> mujoco.MjModel:
    """The assembly's model with contact: O is at height 0 while the drones' legs stand on the floor."""
    plant = dataclasses.replace(config.plant, object_mass=object_mass)
    spec = build_spec(plant, STEP)
    disabled = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    spec.option.disableflags &= ~int(disabled)
    floor = spec.geom("floor")
    lowest = min(plant.leader_mount[2], plant.follower_mount[2])
    floor.pos = [0.0, 0.0, lowest - LEG - FOOT if plant.stand != "pivot" else -1.0]
    floor.contype, floor.conaffinity = 1, 2
    for name in (LEADER, FOLLOWER):
        drone = spec.body(name)
        places = [(x, y, -LEG) for x in (-REACH, REACH) for y in (-REACH, REACH)]
        for place in (*places, (0.0, 0.0, LEG)):
            leg = drone.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[FOOT, 0, 0], pos=place, mass=0.0)
            leg.contype, leg.conaffinity, leg.solref = 2, 1, [0.008, 1.0]
        drone.add_site(name=f"{name}_imu", pos=[0, 0, 0], size=[0.001, 0.001, 0.001])
        for sensed, sensor in (
            ("force", mujoco.mjtSensor.mjSENS_ACCELEROMETER),
            ("rates", mujoco.mjtSensor.mjSENS_GYRO),
        ):
            spec.add_sensor(
                name=f"{name}_{sensed}", type=sensor, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=f"{name}_imu"
            )
    model = spec.compile()
    model.actuator_ctrllimited[:] = False  # what a motor can give is `twin.power`'s to say, which knows the battery
    return model
