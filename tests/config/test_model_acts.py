"""What acts in a model beside masses and rotors: taken, named, or seen by the accelerations that MuJoCo computes."""

from __future__ import annotations

import re
import subprocess
import tomllib
import venv
from pathlib import Path

import models
import numpy as np
import pytest
from command_line import REPOSITORY, environment
from models import BALL, DRONE, LOAD, written
from tables import rows

from mjxball.cli import plant_setup
from mjxball.config import _model_acts, read_plant
from mjxball.errors import InputError
from mjxball.plant import ROLLING_INERTIA


def free(attributes: str, before: str = "") -> str:
    return DRONE.replace("<freejoint/>", f'<joint name="free" type="free" {attributes}/>').replace(
        "<worldbody>", f"{before}<worldbody>"
    )


def slide(attributes: str, old: str = 'armature="0.12"') -> str:
    assert old in LOAD
    return models.rig(more=LOAD.replace(old, attributes))


def motor(attributes: str) -> str:
    return DRONE.replace('ctrlrange="0 7.0"', attributes)


LEFT_OUT = {
    "armature": (free('armature="0.5"'), ["armature 0.5 of joint free"]),
    "damping": (free('damping="0.25"'), ["damping 0.25 of joint free"]),
    "dry friction": (free('frictionloss="0.1"'), ["frictionloss 0.1 of joint free"]),
    "by default": (
        free("", '<default><joint armature="0.5" damping="1"/></default>'),
        ["armature 0.5 of joint free", "damping 1 of joint free"],
    ),
    "by a class": (
        free("", '<default><default class="c"><joint damping="2"/></default></default>').replace(
            '<body name="quad"', '<body name="quad" childclass="c"'
        ),
        ["damping 2 of joint free"],
    ),
    "rotors that are late": (motor('ctrlrange="0 7" delay="0.02" nsample="20"'), ["delay 0.02 of actuators"]),
    "rotors that idle": (motor('ctrlrange="2 7"'), ["least force of rotors, 2 N"]),
    "forces that idle": (motor('ctrlrange="0 9" forcerange="1 7"'), ["least force of rotors, 1 N"]),
    "wet air": (free("", '<option viscosity="1" wind="1 0 0"/>'), ["air: density, viscosity and wind"]),
    "armature of the load": (slide('armature="0.5"'), ["armature 0.5 of joint slide"]),
    "a load that sticks": (
        slide('armature="0.12" damping="5" frictionloss="1"'),
        ["damping 5 of joint slide", "frictionloss 1 of joint slide"],
    ),
    "a load on a spring": (
        slide('armature="0.12" stiffness="50" springref="0.05"'),
        ["stiffness 50 and springref 0.05 of joint slide"],
    ),
    "a load's reference": (slide('armature="0.12" ref="0.1"'), ["ref 0.1 of joint slide"]),
    "a load's ends": (slide('armature="0.12" range="-0.1 0.2"'), ["range -0.1 0.2 of joint slide"]),
    "a load off O": (slide('name="load" pos="0.1 0 0.05"', 'name="load"'), ["place of the load, 0.1 0 0.05 m from O"]),
    "a load that is no ball": (
        slide('diaginertia="0.0003 0.0003 0.0005"', 'diaginertia="0.0003 0.0003 0.0003"'),
        ["inertia of the load, 0.0003 0.0003 0.0005 kg m2: it is taken for a ball of plant.ball_radius, 0.0003 0.0003"],
    ),
}


def left_out(path: Path) -> list[str]:
    return [line for line in read_plant(path).assumed if line.startswith("left out: ")]


@rows("what", LEFT_OUT)
def test_what_acts_beside_masses_and_rotors_is_named(what: str, tmp_path: Path) -> None:
    """Once each, and nothing else is; the plant is that of the model without it."""
    text, said = LEFT_OUT[what]
    path = written(tmp_path, text, BALL if "load" in text else "")
    lines = left_out(path)
    assert len(lines) == len(said), lines
    for line, words in zip(lines, said, strict=True):
        assert words in line
    plain = written(
        tmp_path, models.rig(more=LOAD) if "load" in text else DRONE, BALL if "load" in text else "", "p.xml"
    )
    assert left_out(plain) == []
    assert plant_setup(path).plant == plant_setup(plain).plant


@rows("what", [what for what, (_, said) in LEFT_OUT.items() if said[0].split()[0] in _model_acts.ACTS])
def test_what_nobody_named_is_seen_by_accelerations(what: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where no attribute is known by name the model is refused, as with those that MuJoCo may have next."""
    text = LEFT_OUT[what][0].replace('range="-0.1 0.2"', 'range="-0.1 -0.05"')
    monkeypatch.setattr(_model_acts, "ACTS", {})
    with pytest.raises(InputError, match="MuJoCo's accelerations of it are up to"):
        read_plant(written(tmp_path, text, BALL if "load" in text else ""))


def test_a_load_has_the_armature_of_a_ball_that_rolls() -> None:
    assert _model_acts.ROLLING == ROLLING_INERTIA


@rows(
    ("attributes", "most"),
    [
        ('ctrlrange="0 9" forcerange="0 6.5"', 6.5),
        ('ctrlrange="0 9" dyntype="filter" dynprm="0.05" actrange="0 6.5"', 6.5),
        ('ctrlrange="0 2" gainprm="3.25"', 6.5),
    ],
)
def test_the_largest_force_is_that_of_every_limit(attributes: str, most: float, tmp_path: Path) -> None:
    text = motor(attributes).replace("<motor", "<general")
    assert plant_setup(written(tmp_path, text)).plant.rotor_force_max == pytest.approx(most)


def test_a_range_that_does_not_clamp_is_no_limit(tmp_path: Path) -> None:
    text = DRONE.replace("<worldbody>", '<option><flag clampctrl="disable"/></option><worldbody>')
    assert any("assumed plant.rotor_force_max" in line for line in read_plant(written(tmp_path, text)).assumed)


TURNED = """<?xml version="1.0"?><robot name="turned"><link name="base"><inertial>
<origin xyz="0 0 0" rpy="{}"/><mass value="1.2"/>
<inertia ixx="0.002" ixy="0.0003" ixz="0" iyy="0.004" iyz="0" izz="0.0055"/></inertial></link>{}</robot>"""
PLACES = "rotors = [[0.15, 0, 0], [0, 0.15, 0], [-0.15, 0, 0], [0, -0.15, 0]]"


@rows(
    ("angles", "inertia"),
    [
        ("0 0 1.5707963267948966", (0.004, 0.002, 0.0055)),
        ("1.5707963267948966 0 0", (0.002, 0.0055, 0.004)),
        # Rz(90) Ry(90): x goes to -z, y to -x, z to y
        ("0 1.5707963267948966 1.5707963267948966", (0.004, 0.0055, 0.002)),
        ("0.3 -0.5 0.7", None),
    ],
)
def test_inertia_of_a_urdf_is_turned_as_it_says(angles: str, inertia: tuple | None, tmp_path: Path) -> None:
    """MuJoCo before 3.14, which pyproject.toml does not allow, loses the turn; rotors are told by their places."""
    if inertia is None:
        from scipy.spatial.transform import Rotation

        own = np.array([[0.002, 0.0003, 0], [0.0003, 0.004, 0], [0, 0, 0.0055]])
        turn = Rotation.from_euler("xyz", [float(word) for word in angles.split()]).as_matrix()
        inertia = tuple(np.diag(turn @ own @ turn.T))
    plant = plant_setup(written(tmp_path, TURNED.format(angles, ""), PLACES, "t.urdf")).plant
    assert plant.drones[0].inertia == pytest.approx(inertia, rel=1e-6)
    assert (plant.arm, plant.layout) == (pytest.approx(0.15), "plus")


READ = """import sys
from mjxball.config import preset, with_plant
print(*with_plant(preset("transport"), sys.argv[1]).plant.drones[0].inertia)"""


@pytest.mark.slow
def test_the_lowest_mujoco_that_is_allowed_turns_inertia(tmp_path: Path) -> None:
    """In an environment of its own; first tier and other packages at their lowest versions are CI's."""
    extras = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    (floor,) = {found[1] for line in extras["fly"] if (found := re.match(r"mujoco>=([\d.]+),", line))}
    venv.create(tmp_path / "venv", with_pip=True)
    python = tmp_path / "venv" / "bin" / "python"
    wanted = ["-c", REPOSITORY / "constraints.txt", "numpy"]
    for packages in (wanted, [f"mujoco=={floor}.*"]):
        done = subprocess.run(
            [python, "-m", "pip", "install", "-q", *packages], capture_output=True, text=True, check=False
        )
        if "(from versions: none)" in done.stderr:  # as without a network
            pytest.skip(f"no packages can be had: {done.stderr.splitlines()[-1]}")
        assert done.returncode == 0, done.stderr
    path = written(tmp_path, TURNED.format("0 0 1.5707963267948966", ""), PLACES, "t.urdf")
    done = subprocess.run(
        [python, "-c", READ, path], cwd=REPOSITORY, env=environment(), capture_output=True, text=True, check=True
    )
    assert [float(word) for word in done.stdout.split()] == pytest.approx((0.004, 0.002, 0.0055), rel=1e-6)


def links(joint: str, last: str = "") -> str:
    """Four propellers on joints of a kind; `last` goes into the last one's."""
    return "".join(
        f'<link name="prop{n}"><inertial><mass value="0.001"/><inertia ixx="1e-6" ixy="0" ixz="0" iyy="1e-6" iyz="0" '
        f'izz="1e-6"/></inertial></link><joint name="j{n}" type="{joint}"><parent link="base"/><child link="prop{n}"/>'
        f'<origin xyz="{0.15 * x} {0.15 * y} 0"/><axis xyz="0 0 1"/>{last if n == 3 else ""}</joint>'
        for n, (x, y) in enumerate(models.CROSS)
    )


def floating(frame: str, more: str = "") -> str:
    """A joint that lets the base float in a frame."""
    ends = f'<parent link="{frame}"/><child link="base"/>'
    return f'<link name="{frame}"/><joint name="f" type="floating">{ends}{more}</joint>'


@rows(
    ("more", "said"),
    [
        (links("continuous", '<mimic joint="j0" multiplier="-1"/>'), []),
        (links("continuous") + floating("world"), []),
        (links("continuous") + floating("odom"), []),
        (links("fixed") + floating("world", '<dynamics damping="0.5"/>'), ["left out: damping 0.5 of joint f"]),
        (links("fixed") + floating("odom", '<dynamics damping="0.5"/>'), ["left out: damping 0.5 of joint f"]),
    ],
)
def test_urdfs_with_propellers_that_mimic_or_a_base_that_floats_fly(more: str, said: list, tmp_path: Path) -> None:
    path = written(tmp_path, TURNED.format("0 0 0", more).replace("0.0003", "0"), name="t.urdf")
    plant = plant_setup(path).plant
    assert (plant.arm, plant.drones[0].mass) == pytest.approx((0.15, 1.204))
    assert left_out(path) == said


def test_rotors_are_told_by_places_in_the_axes_of_a_body(tmp_path: Path) -> None:
    """Of one drone, and by a table of two: the same rig as with motors that say so."""
    silent = models.rig()[: models.rig().index("<actuator>")] + "</mujoco>"
    rows_of = {
        "one": [[0.15 * x, 0.15 * y, 0.02] for x, y in models.CROSS],
        "two": [[0.17 * x, 0.17 * y, 0.02] for x, y in models.CROSS],
    }
    beside = "[rotors]\n" + "\n".join(f"{body} = {places}" for body, places in rows_of.items())
    told = plant_setup(written(tmp_path, silent, beside)).plant
    said = plant_setup(written(tmp_path, models.rig())).plant
    assert told.of_drones("arm") == pytest.approx(said.of_drones("arm"))
    for one, other in zip(told.drones, said.drones, strict=True):
        assert (one.mass, *one.mount) == pytest.approx((other.mass, *other.mount))
        assert np.cos(4 * (one.yaw - other.yaw)) == pytest.approx(1)  # places do not say which way rotors turn
    idle = motor('ctrlrange="2 7"')
    lone = plant_setup(written(tmp_path, idle, f"rotors = {rows_of['two']}")).plant
    assert (lone.arm, lone.layout) == (pytest.approx(0.17), "plus")
