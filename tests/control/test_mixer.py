"""The mixer: the plus layout's formulas, its inverse, and the model's eight motors."""

import mujoco
import numpy as np
import pytest
from euler_angles import matrix_from_euler
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from plants import team

from mjxball.assembly import build_model
from mjxball.config import Attitude, Drone, Plant
from mjxball.control import mixer, rotations
from mjxball.physics.engine import total_wrench
from mjxball.plant import plant_parameters

ARM, YAW = 0.12, 0.02
forces = arrays(np.float64, 4, elements=st.floats(0, 5.5))
wrenches = arrays(np.float64, 4, elements=st.floats(-20, 20))


@given(forces)
def test_wrench_follows_the_plus_layout(force):
    f1, f2, f3, f4 = force
    expected = [f1 + f2 + f3 + f4, ARM * (f2 - f4), ARM * (f3 - f1), YAW * (f1 - f2 + f3 - f4)]
    np.testing.assert_allclose(mixer.wrench_from_rotors(force, ARM, YAW), expected, rtol=0, atol=1e-14)  # ulp of 22 N


@pytest.mark.parametrize(
    ("rotor", "place"), enumerate([(ARM, 0, 0), (0, ARM, 0), (-ARM, 0, 0), (0, -ARM, 0)]), ids=["+x", "+y", "-x", "-y"]
)
def test_a_rotor_pulls_at_its_place(rotor, place):
    wrench = mixer.wrench_from_rotors(np.eye(4)[rotor], ARM, YAW)
    moment = np.cross(place, [0, 0, 1.0])
    np.testing.assert_allclose(wrench[1:3], moment[:2], rtol=0, atol=1e-16)


@given(forces)
def test_rotors_survive_the_wrench(force):
    back = mixer.rotors_from_wrench(mixer.wrench_from_rotors(force, ARM, YAW), ARM, YAW)
    # 1e-16 of 22 N, times 1 / (4 YAW) = 12 for the part that comes through the yaw moment.
    np.testing.assert_allclose(back, force, rtol=0, atol=1e-13)


@given(wrenches)
def test_wrench_survives_the_rotors(wrench):
    back = mixer.wrench_from_rotors(mixer.rotors_from_wrench(wrench, ARM, YAW), ARM, YAW)
    # A yaw moment of 20 N m asks for 250 N of each rotor: some ulp of 1000 N.
    np.testing.assert_allclose(back, wrench, rtol=0, atol=1e-12)


OFF_AXIS = Plant(drones=(Drone(mount=(0.17, 0.05, 0.02)), Drone(mount=(-0.15, -0.05, 0.0))))
TURNED = {layout: team(3, 8, cg_axis="x", layout=layout) for layout in ("plus", "x")}


@pytest.mark.parametrize(
    "plant", [Plant(), OFF_AXIS, *TURNED.values()], ids=["on the x axis", "off the x axis", "turned", "turned, x"]
)
def test_motors_of_the_model_give_the_same_wrench(plant):
    """MuJoCo's generalized force of the free joint is [R F, tau]: force in the world, torque in the body."""
    model = build_model(plant)
    data = mujoco.MjData(model)
    parameters = plant_parameters(plant, Attitude())
    random = np.random.default_rng(1)
    for _ in range(5):
        rotor_force = random.uniform(0, plant.rotor_force_max, (plant.count, 4))
        euler = random.uniform(-1, 1, 3)
        quaternion = rotations.quaternion_from_euler(euler)
        data.qpos[:] = [*random.normal(size=3), *quaternion, 0.05]
        data.ctrl[:] = rotor_force.ravel()
        mujoco.mj_forward(model, data)
        wrench = total_wrench(plant, parameters, rotor_force)
        force = matrix_from_euler(euler) @ wrench.force
        # MuJoCo works in float64; positions of some metres cost an ulp of 4e-16 m times 44 N.
        np.testing.assert_allclose(data.qfrc_actuator, [*force, *wrench.torque, 0.0], rtol=0, atol=1e-13)
