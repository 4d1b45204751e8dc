"""Models for MuJoCo as plants: their numbers beside MuJoCo's own, and what is refused in one sentence."""

from __future__ import annotations

import itertools
import os
import struct
from pathlib import Path
from typing import Any

import models
import mujoco
import numpy as np
import pytest
from models import BALL, DRONE, INERTIAL, LOAD, mjcf, motors, rotors, written
from tables import rows

from mjxball import config as configs
from mjxball.assembly import to_mjcf
from mjxball.cli import plant_setup
from mjxball.commands import train
from mjxball.config import Attitude, Plant
from mjxball.control import rotations
from mjxball.errors import InputError
from mjxball.physics.engine import CgState, PlantState, total_wrench
from mjxball.physics.newton_euler import make_engine
from mjxball.plant import plant_parameters
from mjxball.plant.parameters import own_inertia, rigid_inertia, rigid_mass, rigid_moment
from mjxball.plant.rotors import PLACES, SPIN, lever

NO_LOAD = "[plant]\nobject_mass = 1e-9"  # the least that a plant may carry: MuJoCo's model has none
GEOMS = """
<body name="quad" pos="0 0 1"><freejoint/>
  <geom type="ellipsoid" size=".2 .05 .03" mass=".7"/><geom type="box" size=".05 .05 .02" pos="0 0 .04" mass=".3"/>
  {}
</body>
"""


def compiled(path: Path) -> tuple[Any, Any]:
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return model, data


def mass_matrix(model: Any, data: Any) -> np.ndarray:
    """MuJoCo's (6, 6) of the free joint, at the start: mass, first moment and inertia about the body's origin."""
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    return full[:6, :6]


def rotor_places(plant: Plant) -> tuple[np.ndarray, np.ndarray]:
    """(N, 4, 3) places from O, and (N, 4) signs of the yaw moments, of the plant's rotors."""
    own = np.array([[*place, 0.0] for place in PLACES[plant.layout]])
    places = [
        np.array(drone.mount) + lever(arm, plant.layout) * rotations.turned_about_z(own, np.full(4, drone.yaw))
        for drone, arm in zip(plant.drones, plant.of_drones("arm"), strict=True)
    ]
    return np.array(places), np.tile(SPIN[plant.layout], (plant.count, 1))


def actuators(plant: Plant, model: Any, data: Any) -> np.ndarray:
    """(N, 4) the model's motor of each rotor, by its place at the start about the first body."""
    places, signs = rotor_places(plant)
    sites = data.site_xpos[model.actuator_trnid[:, 0]] - data.xpos[1]
    found = np.zeros((plant.count, 4), int)
    for drone, rotor in np.ndindex(plant.count, 4):
        nearest = int(np.linalg.norm((sites - places[drone, rotor])[:, :2], axis=-1).argmin())
        np.testing.assert_allclose(sites[nearest, :2], places[drone, rotor, :2], atol=1e-9)
        yaw = signs[drone, rotor] * plant.of_drones("yaw_per_thrust")[drone]
        assert model.actuator_gear[nearest][5] == pytest.approx(yaw)
        found[drone, rotor] = nearest
    return found


@rows("places", [models.CROSS, models.SQUARE])
def test_a_drone_has_the_mass_and_inertia_that_mujoco_computes(places: tuple, tmp_path: Path) -> None:
    """Of shapes, of a body in a body, in both layouts; the mount is the centre of mass."""
    part = '<body pos="0 0 .1"><geom type="box" size=".03 .03 .03" mass=".2"/></body>'
    path = written(tmp_path, mjcf(GEOMS.format(part + rotors(places=places)), motors()))
    matrix, plant = mass_matrix(*compiled(path)), plant_setup(path).plant
    mass, height = matrix[0, 0], matrix[0, 4] / matrix[0, 0]
    about_centre = matrix[3:, 3:] - mass * np.diag([height**2, height**2, 0.0])
    for number, drone in enumerate(plant.drones):
        assert drone.mass == pytest.approx(mass, rel=1e-12)
        own = own_inertia(plant_parameters(plant, Attitude()))[number]
        np.testing.assert_allclose(own, about_centre, rtol=1e-9, atol=1e-12)
    assert height > 0.01
    assert (plant.arm, plant.rotor_force_max, plant.yaw_per_thrust) == pytest.approx((0.15, 7.0, 0.02))
    assert plant.layout == ("plus" if places is models.CROSS else "x")


def test_a_rig_has_the_mass_centre_and_inertia_that_mujoco_computes(tmp_path: Path) -> None:
    path = written(tmp_path, models.rig(), NO_LOAD)
    plant, matrix = plant_setup(path).plant, mass_matrix(*compiled(path))
    numbers = plant_parameters(plant, Attitude())
    np.testing.assert_allclose(rigid_mass(numbers), matrix[0, 0], rtol=1e-12)
    x, y, z = rigid_moment(numbers)
    np.testing.assert_allclose(matrix[:3, 3:], [[0, z, -y], [-z, 0, x], [y, -x, 0]], atol=1e-12)
    np.testing.assert_allclose(rigid_inertia(numbers), matrix[3:, 3:], rtol=1e-9, atol=1e-9)


def test_a_rig_flies_as_mujoco_steps_its_model(tmp_path: Path) -> None:
    """Uneven forces of all rotors for a second: 0.3 m, 0.4 rad and a turn about every axis; both by Runge-Kutta."""
    path = written(tmp_path, models.rig(), NO_LOAD)
    plant = plant_setup(path).plant
    model, data = compiled(path)
    model.opt.integrator, model.opt.timestep = mujoco.mjtIntegrator.mjINT_RK4, 1e-3
    hover = plant.gravity * model.body_mass.sum() / 8
    data.ctrl[:] = hover * (1 + 0.02 * np.random.default_rng(0).uniform(-1, 1, 8))

    origin = data.xpos[model.body("bar").id]
    force = data.ctrl[actuators(plant, model, data)]
    state = PlantState(
        origin.copy(),
        np.array([1.0, 0, 0, 0]),
        np.zeros(3),
        np.zeros(3),
        force,
        np.int64(0),
        np.float64(0),
        np.float64(0),
        np.float64(0),
    )
    engine, numbers = make_engine(plant, Attitude()), plant_parameters(plant, Attitude())
    wrench, still = total_wrench(plant, numbers, force), CgState(*np.zeros(3))

    def slope(now: PlantState) -> tuple[np.ndarray, ...]:
        linear, angular = engine.prescribed(now, wrench, np.float64(1e-9), still, None)
        return (
            now.velocity,
            rotations.multiply_quaternions(now.quaternion, np.array([0.0, *now.rates])) / 2,
            linear,
            angular,
        )

    def moved(by: tuple[np.ndarray, ...], step: float) -> PlantState:
        position, quaternion, velocity, rates = (value + step * rate for value, rate in zip(state[:4], by, strict=True))
        return state._replace(position=position, quaternion=quaternion, velocity=velocity, rates=rates)

    for _ in range(1000):
        mujoco.mj_step(model, data)
        first = slope(state)
        second = slope(moved(first, 5e-4))
        third = slope(moved(second, 5e-4))
        fourth = slope(moved(third, 1e-3))
        mean = tuple((a + 2 * b + 2 * c + d) / 6 for a, b, c, d in zip(first, second, third, fourth, strict=True))
        state = moved(mean, 1e-3)
    assert np.abs(data.qvel).min() > 1e-3  # it moves in every direction
    np.testing.assert_allclose(state.position, data.qpos[:3], atol=1e-7)
    # MuJoCo before 4 turns by the mean rate of a step, which is 3e-7 off here.
    np.testing.assert_allclose(state.quaternion / np.linalg.norm(state.quaternion), data.qpos[3:7], atol=1e-6)
    np.testing.assert_allclose(state.rates, data.qvel[3:6], atol=1e-6)


@rows("name", ["rig", "pair", "team3", "team6", "plate4"])
def test_a_plant_accelerates_as_mujoco_does_its_model(name: str, tmp_path: Path) -> None:
    """At random states, forces and motions of the load, which slides; where nothing of the model is left out."""
    shipped = plant_setup(Path("pair" if name == "rig" else name)).plant
    beside = f"[plant]\nobject_size = {list(shipped.object_size)}\nball_radius = {shipped.ball_radius}"
    path = written(tmp_path, *((models.rig(more=LOAD), BALL) if name == "rig" else (to_mjcf(shipped), beside)))
    assert not [line for line in configs.read_plant(path).assumed if line.startswith("left out")]
    plant, (model, data) = plant_setup(path).plant, compiled(path)
    engine, numbers = make_engine(plant, Attitude()), plant_parameters(plant, Attitude())
    motors, draw, along = actuators(plant, model, data), np.random.default_rng(1), len(plant.directions)
    for _ in range(5):
        quaternion, velocity, rates, rate = (draw.normal(size=n) for n in (4, 3, 3, along))
        quaternion, offset = quaternion / np.linalg.norm(quaternion), draw.uniform(-0.05, 0.05, along)
        data.ctrl[:] = draw.uniform(0, 1, model.nu) * model.actuator_ctrlrange[:, 1]
        data.qpos[3:], data.qvel[:] = [*quaternion, *offset], [*velocity, *rates, *rate]
        mujoco.mj_forward(model, data)
        force, ball = data.ctrl[motors], (offset, rate) if along > 1 else (offset[0], rate[0])
        state = PlantState(np.zeros(3), quaternion, velocity, rates, force, np.int32(0), np.float64(0), *ball)
        mass, push = np.float64(plant.object_mass), np.zeros_like(ball[0])
        found = engine.rolling(state, total_wrench(plant, numbers, force), mass, push, None)
        np.testing.assert_allclose(np.hstack(found), data.qacc, atol=1e-8 * np.abs(data.qacc).max())


def test_a_drone_hovers_in_mujoco_with_the_forces_of_our_hover(tmp_path: Path) -> None:
    path = written(tmp_path, DRONE)
    plant = plant_setup(path).plant
    model, data = compiled(path)
    data.ctrl[:] = plant.drones[0].mass * plant.gravity / 4
    for _ in range(500):
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(data.qpos, [0, 0, 1, 1, 0, 0, 0], atol=1e-9)


@rows("name", ["pair", "team3", "team6", "plate4", "crazyflie"])
def test_shipped_plants_come_back_from_their_mjcf(name: str, tmp_path: Path) -> None:
    """The fixed part of an object is the carrier's in MJCF; what MJCF has not stands beside it."""
    plant = plant_setup(Path(name)).plant
    size = list(plant.object_size)
    beside = f"[plant]\nrotor_lag = {plant.rotor_lag}\nball_radius = {plant.ball_radius}\nobject_size = {size}"
    found = plant_setup(written(tmp_path, to_mjcf(plant), beside)).plant
    fixed = (1 - plant.moving_fraction) * plant.object_mass
    assert found.carrier_mass == pytest.approx(plant.carrier_mass + fixed)
    assert found.object_mass == pytest.approx(plant.object_mass - fixed)
    assert (found.cg_axis, found.layout) == (plant.cg_axis, plant.layout)
    for field in ("arm", "rotor_force_max", "rotor_lag", "yaw_per_thrust"):
        assert found.of_drones(field) == pytest.approx(plant.of_drones(field))
    for one, other in zip(found.drones, plant.drones, strict=True):
        for field in ("mass", "inertia", "mount", "yaw"):
            assert getattr(one, field) == pytest.approx(getattr(other, field), abs=1e-8), field


def test_a_urdf_needs_no_shapes_and_its_rotors_are_found_by_name(tmp_path: Path) -> None:
    plant = plant_setup(written(tmp_path, models.urdf(), name="quad.urdf")).plant
    assert (plant.layout, plant.arm) == ("x", pytest.approx(0.14))
    for drone in plant.drones:
        assert drone.mass == pytest.approx(0.6)
        assert drone.inertia == pytest.approx((0.002, 0.002, 0.0035))
    named = 'rotors = ["a0", "a1", "a2", "a3"]'
    assert plant_setup(written(tmp_path, models.urdf(names="a"), named, "quad.urdf")).plant == plant


def test_a_filter_is_the_rotors_lag_and_the_smaller_of_both_limits_their_force(tmp_path: Path) -> None:
    """Also where propellers are bodies that spin; no line then says that the lag is assumed."""
    spinning = "".join(
        f'<body pos="{0.15 * x} {0.15 * y} 0"><joint axis="0 0 1"/><geom size="0.01" mass="0.02"/><site name="{n}"/>'
        "</body>"
        for n, (x, y) in enumerate(models.CROSS)
    )
    driven = "".join(
        f'<general site="{n}" gear="0 0 2 0 0 {0.04 * (-1) ** n}" dyntype="filter" dynprm="0.05" ctrlrange="-9 9" '
        'forcerange="-1 4"/>'
        for n in range(4)
    )
    path = written(tmp_path, mjcf(f'<body pos="0 0 1"><freejoint/>{INERTIAL}{spinning}</body>', driven))
    found = configs.read_plant(path)
    plant = plant_setup(path).plant
    assert (plant.rotor_lag, plant.rotor_force_max, plant.yaw_per_thrust) == pytest.approx((0.05, 8.0, 0.02))
    assert plant.drones[0].mass == pytest.approx(1.28)
    assert not any("rotor_lag" in line for line in found.assumed)
    assert sum("propellers" in line for line in found.assumed) == 1


def changed(old: str, new: str, text: str = DRONE) -> str:
    assert old in text
    return text.replace(old, new)


def in_world(what: str) -> str:
    return changed("</worldbody>", f"{what}</worldbody>")


def asset(what: str) -> str:
    return changed("<worldbody>", f"<asset>{what}</asset><worldbody>")


def driven(actuator: str) -> str:
    return changed("</actuator>", f"{actuator}</actuator>")


MESH = asset('<mesh name="m" file="frame.obj"/>').replace(INERTIAL, f'{INERTIAL}<geom type="mesh" mesh="m"/>')
MANY = '<replicate count="2">'
MORE_JOINTS = f'<body name="arm"><joint name="elbow" axis="0 1 0"/>{INERTIAL}</body></body>'
LEVER = f'<body name="lever"><joint name="elbow" axis="0 1 0"/>{INERTIAL}</body>'
REFUSED = {
    "no XML": ("drone", "it is no XML, expected <mujoco>"),
    "another XML": ("<html></html>", "begins with <html>, expected <mujoco>"),
    "half a model": (DRONE[:300], "it is no well-formed XML: "),
    "too long": (DRONE + " " * 2**20, "is larger than 1 MiB"),
    "an include that there is not": ('<mujoco><include file="frame.xml"/></mujoco>', "frame.xml"),
    "an include that is a pipe": ('<mujoco><include file="pipe"/></mujoco>', "its include pipe is no file"),
    "a mesh that is a pipe": (MESH.replace("frame.obj", "pipe"), "its mesh pipe is no file"),
    "a face that is a pipe": (asset('<texture type="cube" fileright="pipe"/>'), "its texture pipe is no file"),
    "repeated": (in_world(f'{50 * MANY}<geom size="0.1"/>{50 * "</replicate>"}'), "it has more than 5000 elements"),
    "a crowd": (in_world(2000 * '<body><geom size="1" pos="0 0 -9"/></body>'), "MuJoCo does not compile it: "),
    "numbers": (changed("<worldbody>", '<custom><numeric name="n" size="9999"/></custom><worldbody>'), "5000 elements"),
    "a field": (
        asset('<hfield name="h" nrow="9999" ncol="999" size="1 1 1 1"/>'),
        "with its hfield it has 9.99e+06 points",
    ),
    "many fields": (
        asset("".join(f'<hfield name="h{n}" nrow="999" ncol="999" size="1 1 1 1"/>' for n in range(9))),
        "with its hfield it has 4.99e+06 points",
    ),
    "endless lengths": (
        changed("<worldbody>", "<compiler><lengthrange/></compiler><worldbody>"),
        "it has <lengthrange>",
    ),
    "nothing free": (changed("<freejoint/>", ""), "no body of it flies, expected one with a <freejoint/>"),
    "two trees": (in_world(f'<body name="b"><freejoint/>{INERTIAL}</body>'), "body quad and body b fly apart"),
    "a door": (in_world(f'<body><joint name="hinge"/>{INERTIAL}</body>'), "joint hinge moves what does not fly"),
    "an arm": (changed("</body>", MORE_JOINTS), "joint elbow moves body arm, expected a rigid drone"),
    "a rig with an arm": (models.rig(LEVER), "elbow moves body lever, expected a rigid rig"),
    "a drone's own weld": (
        changed("<actuator>", '<equality><weld body1="bar" body2="one"/></equality><actuator>', models.rig()),
        "equality constraints or tendons",
    ),
    "on the floor": (
        in_world('<geom name="floor" type="plane" size="1 1 1"/>').replace(
            INERTIAL, INERTIAL + '<geom name="hull" size="1.1"/>'
        ),
        "geom floor touches geom hull at the start",
    ),
    "no mesh": (MESH, "its mesh frame.obj is missing, expected at "),
    "no mass": (changed(INERTIAL, ""), "no mass or no inertia"),
    "a place that is no number": (changed('pos="0.15', 'pos="nan'), "a number of it is NaN"),
    "no rotors": (mjcf(f'<body pos="0 0 1"><freejoint/>{INERTIAL}</body>', ""), "it has no rotors, expected rotors"),
    "five rotors": (driven('<motor site="0" gear="0 0 1 0 0 0" ctrlrange="0 1"/>'), "body quad has 5 rotors"),
    "a joint's motor": (
        changed("<freejoint/>", '<freejoint name="f"/>').replace('site="0"', 'joint="f"'),
        "actuator 0 acts on no site",
    ),
    "a servo": (
        driven('<general name="s" site="0" biastype="affine" biasprm="0 -1 0"/>'),
        "actuator s is no plain motor",
    ),
    "an integrator": (driven('<general name="s" site="0" dyntype="integrator"/>'), "actuator s is no plain motor"),
    "negative gears": (
        changed('gear="0 0 1', 'gear="0 0 -1'),
        "pushes along 0 0 -1 and turns about 0 0 0.02 in the axes",
    ),
    "rotors that lean": (changed('gear="0 0 1', 'gear="0 0.1 1'), "expected 0 0 1 and 0 0 YAW: z is up"),
    "no thrust": (changed('ctrlrange="0 7.0"', 'ctrlrange="-7 0"'), "pushes with at most 0 N"),
    "too weak": (changed('ctrlrange="0 7.0"', 'ctrlrange="0 1"'), "thrust over weight is 0.3"),
    "no cross": (changed('<site name="0" pos="0.15', '<site name="0" pos="0.45'), "expected the corners of a square"),
    "gravity upwards": (changed("<worldbody>", '<option gravity="0 0 9.81"/><worldbody>'), "gravity is 0 0 9.81 m/s2"),
    "no weight": (changed("<worldbody>", '<option><flag gravity="disable"/></option><worldbody>'), "takes its weight"),
    "carried": (changed('pos="0 0 1"', 'pos="0 0 1" gravcomp="0.5"'), "body quad has gravcomp 0.5, expected 0"),
    "on a spring": (
        changed("<freejoint/>", '<joint name="free" type="free" springdamper="1 1"/>'),
        "joint free has stiffness ",
    ),
    "no actuation": (
        changed("<worldbody>", '<option><flag actuation="disable"/></option><worldbody>'),
        '<flag actuation="disable"/> stops all actuators',
    ),
    "a group that is off": (
        changed("<worldbody>", '<option actuatorgroupdisable="0 3"/><worldbody>'),
        "actuatorgroupdisable stops group 0, of actuator 0",
    ),
    "a moment that never ends": (
        driven('<motor site="0" gear="0 0 0 1 0 0" ctrlrange="0.5 1"/>'),
        "MuJoCo's accelerations of it are up to ",
    ),
    "rotors on the carrier": (
        mjcf(
            f'<body name="bar"><freejoint/>{INERTIAL}{rotors("a")}<body>{INERTIAL}{rotors("b")}</body></body>',
            motors("a") + motors("b"),
        ),
        "body bar carries rotors and drones",
    ),
}
URDF = {
    "no inertial": (models.urdf(inertial=False), "no link has a mass, expected <inertial>"),
    "a negative mass": (models.urdf(mass="-1"), "no mass or no inertia"),
    "rotors that lean": (
        models.urdf().replace('0.01"/>', '0.01" rpy="1.2 0 0"/>'),
        "rotor prop0 points along 0 -0.932",
    ),
    "no rotors": (models.urdf(names="link"), "it has no rotors, expected links called like rotors"),
    "a macro": (models.urdf().replace("<link", "<xacro:property/><link", 1), "expand it with xacro first"),
    "a macro's number": (models.urdf(mass="${mass}"), "expand it with xacro first"),
    "a base that is held": (
        models.urdf().replace(
            "</robot>",
            '<link name="world"/><joint name="rail" type="prismatic"><parent link="world"/><child link="base"/></joint>'
            "</robot>",
        ),
        "joint rail holds its base to the world",
    ),
}
BESIDE = {
    "a number of drones that is a word": ('drones = "x"', "drones must be a whole number from 2 to 16, not 'x'"),
    "one drone": ("drones = 1", "from 2 to 16, not 1"),
    "two numbers of drones": (
        "drones = 3\n[[plant.drones]]\nmount = [0.5, 0, 0]\n[[plant.drones]]\nmount = [-0.5, 0, 0]",
        "drones is 3, expected the 2 that plant.drones lists",
    ),
    "rotors that are a word": ('rotors = "x"', "rotors must be a list of names or of places [x, y, z] in m, or"),
    "a flat rotor": ("rotors = [[0.1, 0]]", "rotors must be a list of names or of places [x, y, z] in m, or"),
    "a body that there is not": ("[rotors]\nx = [[0.1, 0, 0]]", "says rotors 'x', expected a site or body"),
    "rotors at no place": ("rotors = [[nan, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]]", "not nan"),
    "a rotor that there is not": ('rotors = ["x"]', "says rotors 'x', expected a site or body"),
    "a base": ('base = "pair"', "not base"),
    "drones that are none": ("[plant]\ndrones = [1, 2]", "a list of tables"),
    "an arm that is a word": ('[plant]\narm = "long"', "plant.arm takes numbers"),
    "a flat mount": ("[[plant.drones]]\nmount = [0.5, 0]\n[[plant.drones]]\nmount = [-0.5, 0]", "takes 3 numbers"),
    "an endless mount": (
        "[[plant.drones]]\nmount = [inf, 0, 0]\n[[plant.drones]]\nmount = [0, 0, 0]",
        "must be between",
    ),
    "two in one place": ("[[plant.drones]]\nmount = [0, 0, 0]\n[[plant.drones]]\nmount = [0, 0, 0]", "the same place"),
    "a mass beyond all floats": (f"[plant.drones.1]\nmass = 1{'0' * 400}", "not inf"),
    "an arm beyond all floats": (f"[plant]\narm = 1{'0' * 400}", "not inf"),
    "an endless arm": ("[plant]\narm = inf", "plant.arm must be between"),
    "no gravity": ("[plant]\ngravity = 0.0", "plant.gravity must be between"),
    "negative rotors": ("[plant]\nrotor_force_max = -1.0", "plant.rotor_force_max must be between"),
    "no axis": ('[plant]\ncg_axis = "z"', "cg_axis must be x or y or xy"),
    "across the drones": ('[plant]\ncg_axis = "y"', "sit at one place along y"),
}
REFUSED_FILES = {
    **{name: (text, "", "model.xml", said) for name, (text, said) in REFUSED.items()},
    **{f"URDF: {name}": (text, "", "model.urdf", said) for name, (text, said) in URDF.items()},
    **{f"beside: {name}": (DRONE, text, "model.xml", said) for name, (text, said) in BESIDE.items()},
    "a macro's file": (models.urdf(), "", "model.urdf.xacro", "expand it with xacro first"),
    "beside a rig: drones": (models.rig(), "drones = 3", "model.xml", "a whole rig of 2 drones"),
}


@rows("mistake", REFUSED_FILES)
def test_mistakes_are_refused_in_one_sentence(mistake: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    text, beside, name, said = REFUSED_FILES[mistake]
    if not (tmp_path / "pipe").exists():
        os.mkfifo(tmp_path / "pipe")
    path, out = written(tmp_path, text, beside, name), tmp_path / "run"
    assert train.main(["--plant", str(path), "--out", str(out)]) == 2
    (error,) = capsys.readouterr().err.splitlines()
    assert error.startswith("error: ")
    assert said in error
    assert not out.exists()


def test_files_of_a_model_are_found_where_mujoco_finds_them(tmp_path: Path) -> None:
    """Included beside the file that includes, meshes of an attached model in its own folder, or by `strippath`."""
    parts, shape = tmp_path / "parts", "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"
    (parts / "meshes").mkdir(parents=True)
    (parts / "meshes" / "frame.obj").write_text(shape)
    mesh = '<geom type="mesh" mesh="m" contype="0" conaffinity="0" mass="0"/>'
    head = '<compiler meshdir="meshes"/><asset><mesh name="m" file="frame.obj"/></asset>'
    (parts / "one.xml").write_text(
        f'<mujoco model="one">{head}<worldbody><body name="b">{mesh}</body></worldbody></mujoco>'
    )
    (parts / "outer.xml").write_text('<mujoco><include file="inner.xml"/></mujoco>')
    (parts / "inner.xml").write_text("<mujoco><worldbody/></mujoco>")
    attached = changed(INERTIAL, f'{INERTIAL}<attach model="one" body="b" prefix="p"/>')
    asked = '<include file="parts/outer.xml"/><asset><model name="one" file="parts/one.xml"/></asset><worldbody>'
    own = '<compiler strippath="true" meshdir="parts/meshes"/><asset><mesh file="away/frame.obj"/></asset><worldbody>'
    text = changed("<worldbody>", asked, attached)
    assert plant_setup(written(tmp_path, text)).plant.drones[0].mass == pytest.approx(1.2)
    assert plant_setup(written(tmp_path, changed("<worldbody>", own))).plant.arm == pytest.approx(0.15)
    many = changed("<attach", 2000 * '<attach model="one" body="b" prefix="q"/>' + "<attach", text)
    with pytest.raises(InputError, match="more than 5000 elements"):
        plant_setup(written(tmp_path, many))
    assert plant_setup(written(tmp_path, f"\n{text}")).plant == plant_setup(written(tmp_path, text)).plant


def test_models_that_hold_models_are_counted_with_all_they_hold(tmp_path: Path) -> None:
    """Each attaches the next 14 times: MuJoCo would take 2 GB. Nor is one read that attaches itself."""
    for number in range(5):
        attach = "".join(f'<frame><attach model="m" body="b" prefix="p{k}"/></frame>' for k in range(14))
        held = f'<asset><model name="m" file="{number + 1}.xml"/></asset>' if number < 4 else ""
        body = f'<worldbody><body name="b">{attach if number < 4 else ""}</body></worldbody>'
        (tmp_path / f"{number}.xml").write_text(f'<mujoco model="m">{held}{body}</mujoco>')
    asked = '<asset><model name="m" file="{}"/></asset><worldbody>'
    for first in ("0.xml", "drone.xml"):
        text = changed(INERTIAL, f'{INERTIAL}<attach model="m" body="b" prefix="p"/>')
        text = changed("<worldbody>", asked.format(first), text)
        (tmp_path / "drone.xml").write_text(text)
        with pytest.raises(InputError, match="more than 5000 elements"):
            plant_setup(written(tmp_path, text))


def test_a_picture_counts_by_its_points(tmp_path: Path) -> None:
    size = struct.pack(">II", 8000, 8000)
    (tmp_path / "sky.png").write_bytes(b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + size)
    with pytest.raises(InputError, match=r"with its texture it has 6.4e\+07 points"):
        plant_setup(written(tmp_path, asset('<texture name="t" type="2d" file="sky.png"/>')))


def test_half_models_are_read_or_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Cut anywhere, and with numbers that are none, a model makes a plant or one sentence; MuJoCo leaves no file."""
    monkeypatch.chdir(tmp_path)
    numbers = [f'{name}="' for name in ("mass", "pos", "gear", "ctrlrange", "diaginertia", "site")]
    texts = [DRONE[:end] + "</mujoco>" for end in range(0, len(DRONE), 97)]
    texts += [
        DRONE.replace(name, f"{name}{word}", 1) for name, word in itertools.product(numbers, ("nan ", "1e999 ", "-"))
    ]
    refused = 0
    for text in texts:
        try:
            plant_setup(written(tmp_path, text))
        except InputError:
            refused += 1
    assert refused > len(texts) / 2
    assert {path.suffix for path in tmp_path.iterdir()} == {".xml"}
