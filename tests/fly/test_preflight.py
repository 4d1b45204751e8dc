"""What both drones are asked on the ground, on firmwares in memory: kind, gains, poses, a fresh estimator, caches."""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Mapping
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from tables import rows

from mjxball.control import rotations
from mjxball.errors import InputError
from mjxfly.connection import READ, Deadlines, Element, Identity, LinkError, Parameters, connect
from mjxfly.limits import Limits
from mjxfly.packets import DroneState, Health, Packet, Sensed
from mjxfly.preflight import Preflight, check_kind, gravity_checks, heading_check, prepare, reset_estimator, stick_check
from mjxfly.setpoints import CommandMap, Variant
from mjxfly.telemetry import HealthSample, Rig, SensedSample

KALMAN, COMPLEMENTARY = 2.0, 1.0
ASKED = Preflight(reset=0.0, converge=1.0)
OWN = {"linear": Variant(CommandMap(), {"pid_rate.roll_kp": 100.0})}


class Drone:
    """In the place of a `Link`: the real parameter protocol, answered by a firmware that clears a reset by itself."""

    def __init__(self, name: str = "leader", estimator: float = KALMAN, device: str = "Crazyflie 2.1"):
        self.name, self.identity = name, Identity(12, "2026.08", device)
        self.values = {"stabilizer.estimator": estimator, "kalman.resetEstimation": 0.0, "pid_rate.roll_kp": 250.0}
        self.values["stabilizer.controller"] = 2.0  # Crazyswarm2's, which takes none of the gains
        self.names = list(self.values)
        self.events: list[str] = []
        self.parameters = Parameters(name, self._find, self._answer, wait=0.5)

    def _find(self, name: str) -> Element | None:
        return Element(self.names.index(name), "<f", False) if name in self.values else None

    def _answer(self, request: Packet) -> None:
        (ident,) = struct.unpack("<H", request.data[:2])
        name = self.names[ident]
        if request.channel == READ:
            data = request.data + b"\0" + struct.pack("<f", self.values[name])
        else:
            (value,) = struct.unpack("<f", request.data[2:])
            self.events.append(f"{name} = {value:g}")
            self.values[name] = 0.0 if name == "kalman.resetEstimation" else value
            data = request.data
        self.parameters.received(Packet(request.port, request.channel, data))

    @property
    def telemetry(self) -> SimpleNamespace:
        """A filter that has converged, whenever it is looked at."""
        return SimpleNamespace(health=HealthSample(Health((1e-5,) * 3, (0,) * 4, 0.0), time.monotonic()))

    def open(self, progress: object) -> None:
        self.events.append("open")

    def write_parameters(self, values: Mapping[str, float], check: bool = True) -> None:
        self.parameters.write(values, check)

    def start_states(self) -> None:
        self.events.append("states")


class Cameras:
    """In the place of `Mocap`."""

    def parameters(self) -> dict[str, float]:
        return {"stabilizer.estimator": KALMAN}

    def feed(self, number: int, link: Drone) -> None:
        link.events.append(f"poses of {number}")


def test_a_reset_that_the_firmware_clears_by_itself_is_no_error() -> None:
    drone = Drone()
    reset_estimator(drone, ASKED)
    assert drone.events[0] == "kalman.resetEstimation = 1"
    assert drone.values["kalman.resetEstimation"] == 0


def test_a_drone_that_knows_no_position_is_refused_unless_it_is_measured() -> None:
    check_kind(Drone(), ASKED)
    check_kind(Drone(estimator=COMPLEMENTARY), ASKED, measured=True)
    with pytest.raises(LinkError, match="is not the Kalman filter"):
        check_kind(Drone(estimator=COMPLEMENTARY), ASKED)


def test_another_kind_of_drone_is_refused() -> None:
    brushless = Preflight(drone="brushless")
    check_kind(Drone(device="Crazyflie 2.1 Brushless"), brushless)
    for device, asked in (("Crazyflie 2.1 Brushless", ASKED), ("Crazyflie 2.1", brushless)):
        with pytest.raises(LinkError, match="the policy was trained for"):
            check_kind(Drone(device=device), asked)


@pytest.mark.parametrize("measured", [False, True])
def test_gains_and_poses_come_before_the_reset(measured: bool) -> None:
    """An estimator that is reset without poses has none to start from."""
    drones = [Drone("leader", COMPLEMENTARY if measured else KALMAN), Drone("follower", KALMAN)]
    assert prepare(drones, [OWN, OWN], ASKED, print, Cameras() if measured else None) == ["linear", "linear"]
    for number, drone in enumerate(drones):
        poses = ["stabilizer.estimator = 2", f"poses of {number}"] if measured else []
        assert drone.events[:-1] == [
            *("open", "pid_rate.roll_kp = 100", "stabilizer.controller = 1"),
            *(*poses, "states", "kalman.resetEstimation = 1"),
        ]
        assert drone.values["stabilizer.estimator"] == KALMAN


def test_another_programs_controller_is_replaced() -> None:
    """By the PID for the laptop's controllers; for those on board by the app's own, which is handed the state."""
    for on_board, wanted in ((False, 1.0), (True, 6.0)):
        drones = [Drone("leader"), Drone("follower")]
        prepare(drones, [OWN, OWN], ASKED, print, None, (lambda number, link: None) if on_board else None)
        assert [drone.values["stabilizer.controller"] for drone in drones] == [wanted, wanted]


def test_a_drone_without_an_app_is_refused_before_anything_is_written() -> None:
    def refuse(number: int, link: Drone) -> None:
        raise InputError("no app")

    drone = Drone()
    with pytest.raises(InputError, match="no app"):
        prepare([drone], [OWN], ASKED, print, None, refuse)
    assert drone.events == ["open"]


def test_what_is_refused_says_what_to_do() -> None:
    """ "The estimator is not the Kalman filter" was all that was said; a check that failed told what it found."""
    with pytest.raises(LinkError, match="--mocap"):
        check_kind(Drone(estimator=COMPLEMENTARY), ASKED)
    with pytest.raises(LinkError, match=r"version|--curve"):
        prepare([Drone()], [{"older": OWN["linear"]}], ASKED, print)
    bad = [standing(0, 1.2, yaw=-12.0), standing(1, 1.2)]
    sensed = SensedSample(Sensed((0.0, 0.0, 6.0), (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)), 0)
    link = SimpleNamespace(name="leader", telemetry=SimpleNamespace(sensed=sensed))
    found = [stick_check(bad, RIG, Limits(), Preflight()), heading_check(bad, Preflight())]
    for one in [*found, *gravity_checks(link, bad[0], Preflight())]:
        assert not one.passed
        assert ": " in one.found, one  # what to do


def test_gains_for_another_firmware_are_refused() -> None:
    with pytest.raises(LinkError, match="has the linear force curve"):
        prepare([Drone()], [{"older": OWN["linear"]}], ASKED, print)


def test_tables_of_contents_are_cached_below_the_users_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """cflib lists 600 entries over the radio unless it finds them there."""
    cflib = pytest.importorskip("cflib.crazyflie")
    caches = []

    class Unreachable(cflib.Crazyflie):
        def __init__(self, ro_cache: str | None = None, rw_cache: str | None = None):
            super().__init__(ro_cache=ro_cache, rw_cache=rw_cache)
            caches.append(rw_cache)

        def open_link(self, link_uri: str) -> None:
            self.connection_failed.call(link_uri, "no radio")

    monkeypatch.setattr(cflib, "Crazyflie", Unreachable)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(LinkError, match="no radio"):
        connect("radio://0/80/2M", "leader", Deadlines(), print, print, print)
    assert caches == [str(tmp_path / "mjxball" / "crazyflie")]
    assert Path(caches[0]).is_dir()


RIG = Rig((0.0, 0.15, 0.0), (0.0, -0.15, 0.0))


def standing(number: int, scale: float = 1.0, roll: float = 0.0, yaw: float = 0.0) -> DroneState:
    """A drone of the pair at its mount, with attitude angles in degrees."""
    quaternion = rotations.quaternion_from_euler(np.radians([roll, 0.0, yaw]))
    return DroneState(scale * RIG.mounts[number], np.zeros(3), quaternion, np.zeros(3), 0, 4.0)


@rows("scale, passed", [(1.0, True), (1.08, True), (1.2, False), (0.85, False)])
def test_two_drones_that_stand_are_as_far_apart_as_their_stick_is_long(scale: float, passed: bool) -> None:
    found = stick_check([standing(number, scale) for number in range(2)], RIG, Limits(), Preflight())
    assert found.passed is passed
    assert f"{0.3 * scale:.3f} m long, 0.300 m needed" in found.found


@rows("yaw, passed, text", [(0.0, True, "+0.0"), (5.0, True, "+5.0 degrees"), (-12.0, False, "-12.0 degrees")])
def test_the_yaw_between_both_is_told_with_what_it_costs(yaw: float, passed: bool, text: str) -> None:
    found = heading_check([standing(0, yaw=yaw), standing(1)], Preflight())
    assert found.passed is passed
    assert text in found.found
    assert "6 mm" in found.found


@rows(
    "roll, force, passed",
    [
        (0.0, (0.0, 0.0, 9.81), True),
        (7.0, (0.0, 9.81 * math.sin(math.radians(7)), 9.81 * math.cos(math.radians(7))), True),  # it does stand so
        (7.0, (0.0, 0.0, 9.81), False),  # a body that was defined while it stood oblique
        (0.0, (0.0, 9.81, 0.0), False),
        (0.0, (0.0, 0.0, -9.81), False),
        (0.0, (0.0, 0.0, 6.0), False),
    ],
)
def test_gravity_is_felt_where_the_attitude_says(roll: float, force: tuple[float, ...], passed: bool) -> None:
    sensed = SensedSample(Sensed(force, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)), 0)
    link = SimpleNamespace(name="leader", telemetry=SimpleNamespace(sensed=sensed))
    assert [one.passed for one in gravity_checks(link, standing(0, roll=roll), Preflight())] == [passed]
    link.telemetry.sensed = None
    assert gravity_checks(link, standing(0), Preflight()) == []
