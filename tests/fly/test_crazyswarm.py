"""Crazyswarm2 files: who leads, what is written to the drones, what is refused."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import TRANSPORT, assert_one_line, call
from tables import rows

from mjxball.errors import InputError
from mjxfly.crazyswarm import read_pair
from mjxfly.main import main
from mjxfly.telemetry import Rig

yaml = pytest.importorskip("yaml")
RIG = Rig((0.0, 0.15, 0.0), (0.0, -0.15, 0.0))
FILE = """\
fileversion: 3
robots:
  cf231:
    enabled: true
    uri: radio://0/80/2M/E7E7E7E7E7
    initial_position: [0.0, 0.15, 0.0]
    type: cf21
    firmware_params:
      kalman:
        pNAcc_xy: 0.7
  spare:
    enabled: false
    uri: radio://0/80/2M/E7E7E7E7E9
    initial_position: [0.0, 1.0, 0.0]
    type: cf21
  cf5:
    enabled: true
    uri: radio://0/80/2M/E7E7E7E705
    initial_position: [0, -0.15, 0]
    type: cf21
  wand:
    enabled: true
    initial_position: [0, 0, 0]
    type: marker
robot_types:
  cf21:
    motion_capture: {tracking: vendor}
    big_quad: false
    battery: {voltage_warning: 3.8, voltage_critical: 3.7}
    firmware_params: {kalman: {pNAcc_xy: 0.6, pNAcc_z: 0.9}}
  marker: {connection: none}
all:
  firmware_logging: {enabled: true}
  firmware_params:
    commander: {enHighLevel: 1}
    stabilizer: {estimator: 2, controller: 2}
    locSrv: {extPosStdDev: 1e-3}
    kalman: {pNAcc_xy: 0.5, resetEstimation: 1}
  broadcasts: {num_repeats: 15}
"""


def written(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "crazyflies.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def changed(path: list[str], value: Any) -> str:
    """`FILE` with one value changed, as another program writes it."""
    data = copy.deepcopy(yaml.safe_load(FILE))
    place = data
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    return yaml.safe_dump(data, sort_keys=False)


def test_the_first_enabled_robot_leads_and_the_second_follows(tmp_path: Path) -> None:
    pair = read_pair(written(tmp_path, FILE))
    assert pair.uris == ("radio://0/80/2M/E7E7E7E7E7", "radio://0/80/2M/E7E7E7E705")
    assert pair.bodies == ("cf231", "cf5")
    told = pair.describe(RIG)
    assert "cf231 leads, cf5 follows, in the order of the file" in told[0]
    np.testing.assert_array_equal(pair.robots[1].place, [0, -0.15, 0])


def test_a_robots_parameters_come_before_its_types_and_these_before_all(tmp_path: Path) -> None:
    """Only those of positioning and estimator: controllers, gains and setpoints are the flight's own."""
    leader, follower = read_pair(written(tmp_path, FILE)).parameters
    assert leader == {"kalman.pNAcc_xy": 0.7, "kalman.pNAcc_z": 0.9, "locSrv.extPosStdDev": 1e-3}
    assert follower == {**leader, "kalman.pNAcc_xy": 0.6}


def test_what_is_not_used_is_named_once(tmp_path: Path) -> None:
    *_, last = read_pair(written(tmp_path, FILE)).describe(RIG)
    names = last.split("not used: ")[1].split(", ")
    expected = {"battery", "broadcasts", "commander.enHighLevel", "firmware_logging", "kalman.resetEstimation"}
    assert set(names) == expected | {"stabilizer.controller", "stabilizer.estimator"}
    assert len(names) == len(set(names))


def test_names_choose_the_two(tmp_path: Path) -> None:
    path = written(tmp_path, changed(["robots", "spare", "enabled"], True))
    pair = read_pair(path, "spare", "cf5")
    assert [robot.name for robot in pair.robots] == ["spare", "cf5"]
    assert "1.15" in pair.describe(RIG)[1]  # m between them, which is told and not used


def test_swapped_places_are_refused(tmp_path: Path) -> None:
    path = written(tmp_path, FILE)
    with pytest.raises(InputError, match="cf5 is the leader, not cf231"):
        read_pair(path).describe(Rig(RIG.follower_mount, RIG.leader_mount))
    swapped = read_pair(path, "cf5", "cf231")
    assert len(swapped.describe(Rig(RIG.follower_mount, RIG.leader_mount))) == 2


@rows(
    "text, reason",
    [
        ("robots: [", "no YAML: line 1"),
        ("a: 1\na: 2\n", "'a' stands twice"),
        ("a: &a [1]\nb: [" + ", ".join(["*a"] * 21) + "]\n", "more than 20 aliases"),
        ("a: !!python/object/apply:os.system ['true']\n", "no YAML"),
        ("? [1, 2]\n: 3\n", "no YAML"),
        ("- 1\n", "must be a mapping, not a list"),
        ("", "must be a mapping, not nothing"),
        ("{}", "robots must be a mapping, not nothing"),
        ("[" * 5000, "no YAML"),
        (changed(["robots", "cf5", "enabled"], False), "1 of the 2 robots"),
        (changed(["robots", "cf5", "enabled"], "yes please"), "enabled must be true or false"),
        (changed(["robots", "spare", "enabled"], True), "3 robots are enabled (cf231, spare, cf5)"),
        (changed(["robots", "cf5", "type"], "cf22"), "type cf22 is not in robot_types, which has cf21, marker"),
        (changed(["robots", "cf5", "uri"], "radio://0/80/2M/e7e7e7e7e7"), "cf231 and cf5 are the same drone"),
        (changed(["robots", "cf5", "uri"], "radio://0/90/2M/E7E7E7E705"), "one channel and data rate"),
        (changed(["robots", "cf5", "firmware_params"], {"kalman": {"pNAcc_xy": 0}}), "pNAcc_xy of the follower"),
        (changed(["robots", "cf5", "uri"], None), "cf5 has no uri"),
        (changed(["robots", "cf5", "uri"], "http://x"), "no URI such as"),
        (changed(["robots", "cf5", "uri"], "radio://1/81/2M/E7E7E7E705"), "channels 80 and 81"),
        (changed(["robots", "cf5", "initial_position"], [0, 0]), "three numbers"),
        (changed(["robots", "cf5", "initial_position"], [0, 0, ".inf"]), "finite number"),
        (changed(["robots", "cf5"], 3), "robot cf5 must be a mapping"),
        (changed(["robot_types", "cf21", "big_quad"], True), "big_quad"),
        (changed(["all", "firmware_params", "locSrv", "extPosStdDev"], "wide"), "finite number, not wide"),
        (changed(["all", "firmware_params"], [1]), "firmware_params of all must be a mapping"),
        (changed(["all", "firmware_params", "locSrv", "extPosStdDev"], True), "finite number, not True"),
        (changed(["fileversion"], 99), "fileversion 99 is none of 1, 2, 3"),
        (changed(["fileversion"], "three"), "fileversion 'three' is none of 1, 2, 3"),
        (FILE.replace("cf5:", '"cf\\e[31m5":'), "the name 'cf\\x1b[31m5' of a robot cannot be printed"),
        (FILE.replace("type: cf21", 'type: "cf\\e[31m"'), "type cf [31m is not in robot_types"),
    ],
)
def test_refusals(text: str, reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("cflib")
    path = written(tmp_path, text)
    assert call(main, [TRANSPORT, "--crazyflies", path]) == 2
    error = capsys.readouterr().err
    assert reason in error
    assert_one_line(error)


@rows(
    "more, reason",
    [
        (["--rehearse"], "leave it out with --rehearse"),
        (["--leader", "cf231"], "no --follower"),
        (["--leader", "spare", "--follower", "cf5"], "spare is no enabled robot"),
        (["--leader", "cf5", "--follower", "cf5"], "same drone"),
    ],
)
def test_flags_that_do_not_fit(more: list[str], reason: str, tmp_path: Path, capsys: Any) -> None:
    pytest.importorskip("cflib")
    assert call(main, [TRANSPORT, "--crazyflies", written(tmp_path, FILE), *more]) == 2
    assert reason in capsys.readouterr().err


def test_a_file_that_is_not_there(capsys: pytest.CaptureFixture[str]) -> None:
    assert call(main, [TRANSPORT, "--crazyflies", "/no/such.yaml"]) == 2
    assert "does not exist" in capsys.readouterr().err
