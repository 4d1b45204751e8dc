"""What is assumed where a model is silent: in a line each, in the reference pair's proportions, flown by a policy."""

from __future__ import annotations

import math
from pathlib import Path

import models
import numpy as np
import pytest
from models import DRONE, INERTIAL, mjcf, motors, rotors, written
from tables import rows, weekly

from mjxball.cli import plant_setup
from mjxball.config import Plant, read_plant, thrust_over_weight
from mjxball.evaluate.metrics import measure
from mjxball.evaluate.policies import load_policy
from mjxball.evaluate.scenarios import standard_scenarios
from mjxball.policy.file import shipped_policy
from mjxball.sim.rollout import simulate

# The reference pair's drone, of which the model says all that MJCF can.
REFERENCE = mjcf(
    '<body name="quad"><freejoint/><inertial pos="0 0 0" mass="1" diaginertia="0.0023 0.0023 0.004"/>'
    f"{rotors(arm=0.12)}</body>",
    motors(force=5.5),
)


def assumed(path: Path) -> set[str]:
    """Paths of the settings that are assumed."""
    lines = [line.split() for line in read_plant(path).assumed]
    return {words[1] for words in lines if words[0] == "assumed" and "." in words[1]}


def test_two_of_the_reference_drone_are_the_reference_pair(tmp_path: Path) -> None:
    plant, pair = plant_setup(written(tmp_path, REFERENCE)).plant, Plant()
    for field in ("object_mass", "object_size", "ball_radius", "arm", "rotor_force_max", "rotor_lag", "yaw_per_thrust"):
        assert getattr(plant, field) == pytest.approx(getattr(pair, field)), field
    for one, other in zip(plant.drones, pair.drones, strict=True):
        assert (one.mass, *one.inertia, *one.mount) == pytest.approx((other.mass, *other.inertia, *other.mount))


def test_what_the_file_beside_says_is_not_assumed(tmp_path: Path) -> None:
    everything = assumed(written(tmp_path, DRONE))
    assert everything > {"plant.rotor_lag", "plant.object_mass", "plant.object_size", "plant.cg_axis"}
    for setting, value in (("rotor_lag", 0.02), ("object_mass", 0.1), ("ball_radius", 0.01)):
        path = written(tmp_path, DRONE, f"[plant]\n{setting} = {value}")
        assert assumed(path) == everything - {f"plant.{setting}"}
        assert getattr(plant_setup(path).plant, setting) == value
    both = written(tmp_path, DRONE, "leader.kp = [0.4, 0.4, 0.4]\nscenario.cg_amplitude = [0.0, 0.01]")
    assert assumed(both) == everything - {"scenario.cg_amplitude"}
    assert plant_setup(both).leader.kp == (0.4, 0.4, 0.4)
    assert not any("leader" in line for line in read_plant(both).assumed)


def test_every_line_is_said_once_by_a_command(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    path = written(tmp_path, DRONE)
    plant_setup(path)
    assert capsys.readouterr().err.splitlines() == [f"model.xml: {line}" for line in read_plant(path).assumed]


@rows("count", [2, 3, 5])
def test_a_ring_of_drones_with_neighbours_17_sixths_of_an_arm_apart(count: int, tmp_path: Path) -> None:
    plant = plant_setup(written(tmp_path, DRONE, f"drones = {count}")).plant
    places = np.array([drone.mount for drone in plant.drones])
    apart = np.linalg.norm(places - np.roll(places, 1, axis=0), axis=-1)
    np.testing.assert_allclose(apart, 17 / 6 * 0.15, atol=2e-6)
    assert (plant.carrier_mass > 0) == (count > 2) == plant.is_disc
    assert plant.cg_axis == ("x" if count == 2 else "xy")


def test_listed_mounts_take_the_rest_from_the_model(tmp_path: Path) -> None:
    listed = "[[plant.drones]]\nmount = [0.5, 0, 0]\n[[plant.drones]]\nmount = [-0.3, 0, 0.1]\nmass = 2.0"
    one, other = plant_setup(written(tmp_path, DRONE, listed)).plant.drones
    assert (one.mount, one.mass, other.mount, other.mass) == ((0.5, 0, 0), 1.2, (-0.3, 0, 0.1), 2.0)
    assert one.inertia == other.inertia == pytest.approx((0.003, 0.004, 0.006))


def test_thrust_without_places_or_yaw_is_a_quarter_a_rotor_and_the_arm_goes_with_the_mass(tmp_path: Path) -> None:
    """A model with the thrust of the whole drone and three moments, of little thrust: its load is lighter."""
    inertial = '<inertial pos="0 0 0" mass="0.027" diaginertia="2e-5 2e-5 3e-5"/>'
    turning = "".join(f'<motor site="c" gear="0 0 0 {axes}" ctrlrange="-1 1"/>' for axes in ("1 0 0", "0 1 0", "0 0 1"))
    actuators = f'<motor site="c" gear="0 0 1 0 0 0" ctrlrange="0 0.35"/>{turning}'
    path = written(tmp_path, mjcf(f'<body><freejoint/>{inertial}<site name="c"/></body>', actuators))
    plant = plant_setup(path).plant
    assert (plant.rotor_force_max, plant.arm) == pytest.approx((0.0875, 0.12 * 0.3))
    assert assumed(path) >= {"plant.arm", "plant.yaw_per_thrust"}
    assert plant.object_mass < 0.0054
    assert thrust_over_weight(plant) > 1.2
    named = plant_setup(written(tmp_path, models.urdf(), name="quad.urdf")).plant
    assert named.rotor_force_max == pytest.approx(5.5 * 0.6)  # as strong for its weight as the pair's


LEFT_OUT = {
    "a long cross": (DRONE.replace('<site name="0" pos="0.15', '<site name="0" pos="0.17'), "off a square"),
    "a centre beside the rotors": (
        DRONE.replace('<inertial pos="0 0 0"', '<inertial pos="0.02 0 0"'),
        "0.02 m by which",
    ),
    "a drone that is tilted": (
        DRONE.replace('diaginertia="0.003 0.004 0.006"', 'fullinertia="0.003 0.004 0.006 0 0.0008 0"'),
        "products of inertia of quad, up to 0.0008 kg m2",
    ),
    "air": (DRONE.replace("<worldbody>", '<option density="1.2"/><worldbody>'), "air: density"),
    "a weak rotor": (DRONE.replace('ctrlrange="0 7.0"', 'ctrlrange="0 6"', 1), "beyond the 6 N of the weakest"),
    "thrust both ways": (DRONE.replace('ctrlrange="0 7.0"', 'ctrlrange="-7 7"'), "rotors that push down"),
}


@rows("what", LEFT_OUT)
def test_what_the_plant_has_no_place_for_is_said(what: str, tmp_path: Path) -> None:
    text, said = LEFT_OUT[what]
    assert text != DRONE
    lines = [line for line in read_plant(written(tmp_path, text)).assumed if said in line]
    assert len(lines) == 1
    assert lines[0].startswith("left out: ")
    assert not [line for line in read_plant(written(tmp_path, DRONE)).assumed if line.startswith("left out")]


def test_yaw_gears_that_cannot_turn_the_drone_alone_are_taken_to_alternate(tmp_path: Path) -> None:
    """Left rotors + and right ones -: yaw would come with roll, always."""
    body = f'<body name="quad" pos="0 0 1"><freejoint/>{INERTIAL}{rotors(places=models.SQUARE)}</body>'
    same = "".join(
        f'<motor site="{n}" gear="0 0 1 0 0 {0.02 * math.copysign(1, y)}" ctrlrange="0 7"/>'
        for n, (_, y) in enumerate(models.SQUARE)
    )
    path = written(tmp_path, mjcf(body, same))
    *_, last = read_plant(path).assumed
    assert last.startswith("warning: yaw gears of quad go ")
    assert plant_setup(path).plant.yaw_per_thrust == pytest.approx(0.02)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rig", *weekly("drone", "mirrored", "urdf")])
def test_the_policy_for_any_rig_flies_them(name: str, tmp_path: Path) -> None:
    """To within 2 % of the way in less than 4 s, and the load's sway stays below 1 cm."""
    mirrored = mjcf(f"<body><freejoint/>{INERTIAL}{rotors(places=models.SQUARE)}</body>", motors())
    text = {"drone": DRONE, "mirrored": mirrored, "urdf": models.urdf(), "rig": models.rig()}[name]
    setup = plant_setup(written(tmp_path, text, name=f"model.{'urdf' if name == 'urdf' else 'xml'}"))
    flight = simulate(
        setup, load_policy(shipped_policy("universal"), setup), standard_scenarios(setup)[0], "newton-euler"
    )
    found = measure(flight, setup.scenario.termination_distance)
    assert not found.failed
    assert found.settling_time is not None
    assert found.settling_time < 4
    assert found.x_peak is not None
    assert found.x_peak < 0.01
