"""The twin as the unmodified cflib sees it: connection, tables, parameters, log, supervisor, and both ends' signs."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from mjxball.control import rotations
from mjxfly import packets
from mjxfly.packets import Setpoint
from mjxfly.process import wait_until
from mjxfly.twin import logs, protocol
from mjxfly.twin.pair import RUNNING, PairState, SupervisorOutputs
from mjxfly.twin.parameters import PARAMETERS
from mjxfly.twin.physics import SimplePair
from mjxfly.twin.server import HOST, MOST_BEHIND, Twin

cflib = pytest.importorskip("cflib")
pytestmark = pytest.mark.clock  # by the clock
LIMIT = 10.0  # [s] that an answer may take on a busy machine


class GivenRotor(SimplePair):
    """The stand-in, and what it was told."""

    def __init__(self) -> None:
        self.parameters: list[tuple[int, str, float]] = []
        self.setpoints = np.zeros((2, 4))
        super().__init__()

    def set_parameter(self, drone: int, name: str, value: float) -> None:
        self.parameters.append((drone, name, value))

    def advance(self, setpoints: np.ndarray, dt: float, modes: SupervisorOutputs = RUNNING) -> PairState:
        self.setpoints = setpoints
        return super().advance(setpoints, dt, modes)


@pytest.fixture(scope="module")
def flown() -> Iterator[tuple[Twin, GivenRotor, Any]]:
    """A twin, its physics, and cflib connected to the leader."""
    import cflib.crtp
    from cflib.crazyflie import Crazyflie

    if not cflib.crtp.CLASSES:
        cflib.crtp.init_drivers()
    physics = GivenRotor()
    with Twin(physics) as twin:
        crazyflie, ready = Crazyflie(), threading.Event()
        crazyflie.fully_connected.add_callback(lambda uri: ready.set())
        crazyflie.open_link(twin.uris[0])
        assert ready.wait(10)
        yield twin, physics, crazyflie
        crazyflie.close_link()
    assert twin.failure is None


def test_cflib_finds_every_table_entry(flown: tuple[Twin, GivenRotor, Any]) -> None:
    crazyflie = flown[2]
    assert crazyflie.platform.get_protocol_version() == 12
    for name, kind in logs.LOG_VARIABLES:
        assert crazyflie.log.toc.get_element_by_complete_name(name).ctype == kind
    booted = flown[0].drones[0].peer.values.defaults
    for parameter in PARAMETERS:
        element = crazyflie.param.toc.get_element_by_complete_name(parameter.name)
        assert element.ctype == parameter.kind
        assert element.is_persistent() == parameter.persistent
        assert (element.access == element.RO_ACCESS) == parameter.read_only
        assert float(crazyflie.param.get_value(parameter.name)) == pytest.approx(booted[parameter.name], rel=1e-6)


def test_a_parameter_is_written_read_back_and_reaches_the_physics(flown: tuple[Twin, GivenRotor, Any]) -> None:
    _, physics, crazyflie = flown
    crazyflie.param.set_value("pid_attitude.roll_kp", 4.5)
    assert wait_until(lambda: crazyflie.param.get_value("pid_attitude.roll_kp") == "4.5", LIMIT)
    assert (0, "pid_attitude.roll_kp", 4.5) in physics.parameters
    defaults: list[Any] = []
    crazyflie.param.get_default_value("pid_attitude.roll_kp", lambda name, value: defaults.append(value))
    assert wait_until(lambda: bool(defaults), LIMIT)
    assert defaults == [6.0]


def test_all_of_a_state_comes_in_one_packet_at_100_hz(flown: tuple[Twin, GivenRotor, Any]) -> None:
    from cflib.crazyflie.log import LogConfig

    _, _, crazyflie = flown
    block, seen = LogConfig("state", 10), []
    for name, kind in packets.STATE_VARIABLES:
        block.add_variable(name, kind)
    block.data_received_cb.add_callback(lambda stamp, values, config: seen.append((stamp, values)))
    crazyflie.log.add_config(block)
    block.start()
    assert wait_until(lambda: len(seen) >= 30, LIMIT)
    block.stop()
    block.delete()
    assert set(seen[-1][1]) == {name for name, _ in packets.STATE_VARIABLES}
    stamps = np.array([stamp for stamp, _ in seen])
    assert set(np.diff(stamps)) <= {5, 10, 15}  # the twin's own clock, whatever this machine's does
    assert seen[-1][1]["stateEstimateZ.y"] == pytest.approx(-150, abs=1)
    assert seen[-1][1]["supervisor.info"] & packets.CAN_FLY


def test_setpoints_and_supervisor(flown: tuple[Twin, GivenRotor, Any]) -> None:
    twin, physics, crazyflie = flown
    crazyflie.commander.send_setpoint(0, 0, 0, 0)
    crazyflie.commander.send_setpoint(1.0, 2.0, 3.0, 12000)
    assert wait_until(lambda: physics.setpoints[0, 3] == 12000, LIMIT)
    assert physics.setpoints[0].tolist() == [1.0, -2.0, 3.0, 12000]
    crazyflie.commander.send_stop_setpoint()
    assert wait_until(lambda: physics.setpoints[0, 3] == 0, LIMIT)
    assert crazyflie.supervisor.is_armed
    assert crazyflie.supervisor.can_fly
    crazyflie.supervisor.send_emergency_stop()
    assert wait_until(lambda: bool(twin.truth.info[0] & packets.LOCKED), LIMIT)
    assert wait_until(lambda: crazyflie.supervisor.is_locked, LIMIT)
    assert not twin.truth.info[1] & packets.LOCKED


def test_a_scan_is_answered(flown: tuple[Twin, GivenRotor, Any]) -> None:
    port = int(flown[0].uris[1].rsplit(":", 1)[1])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.settimeout(2)
        sock.sendto(b"\xff", (HOST, port))
        assert sock.recv(64)


@pytest.mark.parametrize(
    ("wire", "axis", "sign"),
    [((8, 0, 0), 1, -1), ((0, -8, 0), 0, +1)],  # crazyflie.md: +8 roll moves toward -y, +8 pitch toward +x
)
def test_tilts_move_the_way_a_crazyflie_moves(wire: tuple[float, float, float], axis: int, sign: int) -> None:
    pair = SimplePair()
    row = Setpoint(*wire, round(pair.plant.curve.thrust(pair.plant.mass * 9.81 / 2)) + 3000)
    for _ in range(200):
        state = pair.advance(np.array([row, row], float), 0.005)
    assert sign * state.velocity[0, axis] > 0.2
    tilt = rotations.euler_from_matrix(rotations.matrix_from_quaternion(state.quaternion[0]))
    assert np.degrees(tilt[:2]) == pytest.approx([wire[0], -wire[1]], abs=0.5)


def test_a_positive_yaw_rate_turns_clockwise() -> None:
    pair = SimplePair()
    row = Setpoint(0, 0, 40.0, round(pair.plant.curve.thrust(pair.plant.mass * 9.81 / 2)) + 3000)
    for _ in range(200):
        state = pair.advance(np.array([row, row], float), 0.005)
    assert np.degrees(state.rates[0, 2]) == pytest.approx(-40, abs=2)


def test_the_stick_is_rigid_and_what_falls_falls() -> None:
    pair = SimplePair()
    for number in range(400):
        thrust = 50000 if number < 200 else 0
        row = Setpoint(5.0, 3.0, 20.0, thrust)
        state = pair.advance(np.array([row, row], float), 0.005)
        assert np.linalg.norm(state.position[0] - state.position[1]) == pytest.approx(0.3, abs=1e-9)
        if thrust and state.position[0, 2] > 0.05:
            assert state.specific_force[0, 2] > 0.5 * 9.81
    assert state.velocity[0, 2] < 0 or state.position[:, 2].max() < 0.01


class Slow(GivenRotor):
    """Physics of which 5 ms take longer."""

    def advance(self, setpoints: np.ndarray, dt: float, modes: SupervisorOutputs = RUNNING) -> PairState:
        time.sleep(0.02)
        return super().advance(setpoints, dt, modes)


def test_a_twin_that_is_late_hears_all_the_same_and_ends_by_saying_so() -> None:
    """It read its sockets only while it waited: a busy one heard neither setpoints nor stops."""
    heard = []
    with Twin(Slow()) as twin, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        begun = wait_until(lambda: twin.behind > 0.05, LIMIT)
        host, port = twin.uris[0].removeprefix("udp://").split(":")
        for thrust in (0, 12000):  # the first one opens the firmware's thrust lock
            packet = packets.setpoint_packet(packets.Setpoint(0.0, 0.0, 0.0, thrust))
            sock.sendto(bytes([protocol.header(packet.port, packet.channel)]) + packet.data, (host, int(port)))
        heard.append(wait_until(lambda: twin.truth.last_wire_thrust[0] == 12000, LIMIT))
        ended = wait_until(lambda: twin.failure is not None, LIMIT)
    assert begun
    assert heard == [True]
    assert ended
    assert "too slow for a rehearsal in real time: the twin is 0.5" in str(twin.failure)
    assert twin.most_behind == pytest.approx(MOST_BEHIND, abs=0.1)
