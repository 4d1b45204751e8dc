"""The MuJoCo model is what the configuration says, and any viewer can open it."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from plants import PLANTS

from mjxball.assembly import BALL, BALL_JOINT, FOLLOWER, LEADER, build_model, main, to_mjcf
from mjxball.config import Attitude, preset, with_plant
from mjxball.plant import plant_parameters

DOFS = {"free": 6, "pivot": 1, "heave": 2}


@pytest.mark.parametrize("name", PLANTS)
def test_model_has_the_plants_masses_places_and_joints(name: str) -> None:
    plant = PLANTS[name]
    model = build_model(plant)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert model.nv == DOFS[plant.stand] + 1
    assert model.nu == 8
    total = sum(drone.mass for drone in plant.drones) + plant.object_mass
    assert model.body_mass.sum() == pytest.approx(total)
    for body, drone in zip((LEADER, FOLLOWER), plant.pair, strict=True):
        assert model.body(body).mass[0] == pytest.approx(drone.mass)
        np.testing.assert_allclose(data.body(body).xipos, drone.mount, atol=1e-15)
    assert model.body(BALL).mass[0] == pytest.approx(plant.moving_fraction * plant.object_mass)
    np.testing.assert_array_equal(model.jnt_axis[model.joint(BALL_JOINT).id], np.eye(3)["xy".index(plant.cg_axis)])


@pytest.mark.parametrize("name", PLANTS)
def test_mujocos_mass_matrix_has_the_inertia_about_o(name: str) -> None:
    plant = PLANTS[name]
    constants = plant_parameters(plant, Attitude())
    model = build_model(plant)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    mass = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, mass)
    expected = constants.drone_inertia + np.diag(plant.object_mass * constants.object_inertia_per_mass)
    found = mass[3:6, 3:6] if plant.stand == "free" else mass[[-2], [-2]]
    # 1e-9: MuJoCo keeps principal inertias, ours are already principal
    np.testing.assert_allclose(found, expected if plant.stand == "free" else expected[:1, 0], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", PLANTS)
def test_fused_model_is_smaller_and_weighs_the_same(name: str) -> None:
    whole, fused = build_model(PLANTS[name]), build_model(PLANTS[name], fuse=True)
    assert fused.nbody == 3 < whole.nbody
    assert fused.ngeom == fused.nu == fused.nsite == 0
    assert fused.body_mass.sum() == pytest.approx(whole.body_mass.sum())


def test_mjcf_round_trip_gives_the_same_model() -> None:
    plant = PLANTS["varied"]
    again = mujoco.MjModel.from_xml_string(to_mjcf(plant))
    model = build_model(plant)
    for name in ("nv", "nu", "ngeom", "nsite"):
        assert getattr(again, name) == getattr(model, name)
    # 1e-6: MJCF prints single precision digits
    np.testing.assert_allclose(again.body_mass, model.body_mass, rtol=1e-6)
    np.testing.assert_allclose(again.body_inertia, model.body_inertia, rtol=1e-5)
    np.testing.assert_allclose(again.actuator_gear, model.actuator_gear, rtol=1e-6)


def test_geoms_are_seen_but_touch_nothing() -> None:
    model = build_model(PLANTS["reference"])
    assert model.ngeom > 10
    assert not model.geom_contype.any()
    assert not model.geom_conaffinity.any()


def test_bare_mujoco_hovers_with_the_motors_at_their_share() -> None:
    """The model flies in any MuJoCo program: eight motors at a quarter of each drone's load hold it still."""
    plant = PLANTS["reference"]
    model = build_model(plant, timestep=0.002)
    data = mujoco.MjData(model)
    data.ctrl[:] = (plant.pair[0].mass + plant.object_mass / 2) * plant.gravity / 4
    mujoco.mj_step(model, data, 500)
    assert np.abs(data.qpos[:3]).max() < 1e-9  # one second at rest, rounding only


def test_command_line_writes_any_plant(tmp_path) -> None:
    assert main([str(tmp_path / "team.xml"), "--plant", "team6"]) == 0
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "team.xml"))
    assert (model.nu, model.nv) == (24, 8)
    names = {model.body(number).name for number in range(model.nbody)}
    assert {"leader", *(f"follower{number}" for number in range(1, 6))} <= names


def test_a_plate_is_drawn_with_its_rim_and_a_ring_as_a_disc() -> None:
    plate, ring = (build_model(with_plant(preset("paper"), name).plant) for name in ("plate4", "team3"))
    assert plate.geom("shell").type == mujoco.mjtGeom.mjGEOM_BOX
    assert ring.geom("shell").type == mujoco.mjtGeom.mjGEOM_CYLINDER
    assert ring.geom("shell").size[0] == pytest.approx(0.1963)
    # A chord of 24 is 1 - cos(7.5 degrees) inside the circle.
    assert np.hypot(*plate.geom("rim0").pos[:2]) == pytest.approx(0.14, rel=0.01)
    assert not any("rim" in ring.geom(number).name for number in range(ring.ngeom))


def test_bare_mujoco_hovers_a_team() -> None:
    plant = with_plant(preset("transport"), "plate4").plant
    model = build_model(plant, timestep=0.002)
    data = mujoco.MjData(model)
    weight = sum(drone.mass for drone in plant.drones) + plant.carrier_mass + plant.object_mass
    data.ctrl[:] = weight * plant.gravity / model.nu
    mujoco.mj_step(model, data, 500)
    assert np.abs(data.qpos[:3]).max() < 1e-9  # one second at rest, rounding only


def test_command_line_writes_mjcf_once(tmp_path, capsys) -> None:
    path = tmp_path / "pair.xml"
    assert main([str(path)]) == 0
    assert mujoco.MjModel.from_xml_path(str(path)).nu == 8
    assert main([str(path)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
