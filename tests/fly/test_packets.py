"""Bytes on the wire: against cflib's own packing, and round trips within one unit of the wire."""

from __future__ import annotations

import math
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from wire import pack_state

from mjxball.control import rotations
from mjxfly import packets
from mjxfly.packets import DroneState, PacketError, Setpoint

cflib_encoding = pytest.importorskip("cflib.utils.encoding")

units = st.floats(-1, 1, allow_nan=False)
quaternions = (
    st.tuples(units, units, units, units)
    .filter(lambda q: math.hypot(*q) > 0.1)
    .map(lambda q: np.array(q) / math.hypot(*q))
)


class Recorder:
    """In the place of a Crazyflie: keeps what cflib would send."""

    def __init__(self) -> None:
        self.sent: list[Any] = []

    def send_packet(self, packet: Any) -> None:
        self.sent.append(packet)


@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(-3, 3), st.integers(0, 65535))
def test_a_setpoint_is_what_cflib_sends(roll: float, pitch: float, yaw_rate: float, thrust: int) -> None:
    from cflib.crazyflie.commander import Commander

    recorder = Recorder()
    # cflib's pitch moves toward +x when positive, its yaw rate turns clockwise (crazyflie.md, "cflib").
    Commander(recorder).send_setpoint(math.degrees(roll), math.degrees(pitch), -math.degrees(yaw_rate), thrust)
    ours = packets.setpoint_packet(packets.setpoint(roll, pitch, yaw_rate, thrust))
    theirs = recorder.sent[0]
    assert (theirs.port, theirs.channel, bytes(theirs.data)) == ours


def test_commands_are_what_cflib_sends() -> None:
    from cflib.crazyflie.commander import Commander

    recorder = Recorder()
    Commander(recorder).send_stop_setpoint()
    packet = recorder.sent[0]
    assert (packet.port, packet.channel, bytes(packet.data)) == packets.STOP
    assert packets.EMERGENCY_STOP == (9, 1, b"\x03")  # crazyflie.md, "Supervisor info"
    assert (packets.ARM.data, packets.DISARM.data) == (b"\x01\x01", b"\x01\x00")


@pytest.mark.parametrize(
    "values", [(math.nan, 0, 0, 0), (0, math.inf, 0, 0), (0, 0, 0, math.nan), (0, 0, 0, 65536), (0, 0, 0, -1)]
)
def test_no_unsound_number_is_packed(values: tuple[float, ...]) -> None:
    with pytest.raises(PacketError):
        packets.setpoint(*values)


@pytest.mark.parametrize("value", [Setpoint(math.nan, 0, 0, 0), Setpoint(0, 0, math.inf, 1), Setpoint(0, 0, 0, 70000)])
def test_no_unsound_setpoint_is_packed(value: Setpoint) -> None:
    with pytest.raises(PacketError):
        packets.pack_setpoint(value)


def turned(a: np.ndarray, b: np.ndarray) -> float:
    """Angle between two attitudes [rad]."""
    # arccos of |a . b| loses half the digits near 1; the chord does not.
    return 4 * math.asin(min(np.linalg.norm(a - math.copysign(1.0, float(a @ b)) * b) / 2, 1.0))


@given(quaternions)
def test_quaternions_survive_the_wire(quaternion: np.ndarray) -> None:
    packed = packets.compress_quaternion(quaternion)
    # Half a step of sqrt(1/2) / 511 in each of three components, doubled to an angle, and the fourth follows.
    assert (
        turned(packets.decompress_quaternion(packed), quaternion) < 2 * math.sqrt(6) * 0.5 * math.sqrt(0.5) / 511 * 1.5
    )


@given(quaternions)
def test_quaternions_are_cflibs(quaternion: np.ndarray) -> None:
    theirs = cflib_encoding.compress_quaternion([*quaternion[1:], quaternion[0]])
    x, y, z, w = cflib_encoding.decompress_quaternion(theirs)
    np.testing.assert_allclose(packets.decompress_quaternion(theirs), [w, x, y, z], atol=1e-12)
    # Where two components are equally large, rounding decides which one is left out.
    ordered = np.sort(np.abs(quaternion))
    if ordered[3] - ordered[2] > 1e-6:
        assert (
            turned(packets.decompress_quaternion(packets.compress_quaternion(quaternion)), np.array([w, x, y, z]))
            < 5e-3
        )


def test_a_quaternion_whose_largest_component_is_not_the_largest_is_refused() -> None:
    """Three components of 1/2 leave 1/2 for the fourth; three of 0.55 leave 0.3, which was not the one to leave out."""
    for size, sound in ((0.3, True), (0.5, True), (0.55, False), (0.6, False)):
        steps = round(size * math.sqrt(2) * 511)
        packed = 3 << 30 | steps << 20 | steps << 10 | steps  # w is left out
        if sound:
            w = math.sqrt(1 - 3 * size**2)
            np.testing.assert_allclose(packets.decompress_quaternion(packed), [w, size, size, size], atol=3e-3)
        else:
            with pytest.raises(PacketError):
                packets.decompress_quaternion(packed)


@given(st.integers(0, 2**32 - 1))
def test_any_32_bits_are_a_unit_quaternion_or_refused(packed: int) -> None:
    try:
        quaternion = packets.decompress_quaternion(packed)
    except PacketError:
        return
    assert abs(float(quaternion @ quaternion) - 1) < 1e-12


@given(st.binary(min_size=0, max_size=40))
def test_any_bytes_are_a_finite_state_or_refused(data: bytes) -> None:
    try:
        state = packets.unpack_state(data)
    except PacketError:
        return
    assert len(data) == packets.STATE_SIZE
    for part in state[:4]:
        assert np.isfinite(part).all()


@given(st.tuples(*[st.floats(-30, 30)] * 3), st.tuples(*[st.floats(-30, 30)] * 6), quaternions, st.integers(0, 65535))
def test_states_survive_the_wire(
    position: tuple[float, ...], rest: tuple[float, ...], quaternion: np.ndarray, info: int
) -> None:
    state = DroneState(np.array(position), np.array(rest[:3]), quaternion, np.array(rest[3:]), info, 3.7)
    data = pack_state(state)
    assert len(data) == 26  # the protocol's limit for a log packet (crazyflie.md)
    back = packets.unpack_state(data)
    for ours, theirs in zip(back[:2] + back[3:4], state[:2] + state[3:4], strict=True):
        np.testing.assert_allclose(ours, theirs, atol=0.5e-3 + 1e-12)  # half a millimetre, mm/s, mrad/s
    assert (back.info, back.battery) == (info, pytest.approx(3.7, abs=5e-4))


def test_the_wire_has_pitch_rate_nose_up() -> None:
    state = DroneState(np.zeros(3), np.zeros(3), np.array([1.0, 0, 0, 0]), np.array([0.0, 0.2, 0.0]), 0, 4.0)
    # int16 number 8 of the packet: after x y z vx vy vz, four bytes of quaternion, and the roll rate.
    assert struct.unpack_from("<h", pack_state(state), 18) == (-200,)


def test_a_far_away_drone_saturates_and_does_not_wrap() -> None:
    state = DroneState(np.array([100.0, -100.0, 0.0]), np.zeros(3), np.array([1.0, 0, 0, 0]), np.zeros(3), 0, 4.0)
    np.testing.assert_allclose(packets.unpack_state(pack_state(state)).position, [32.767, -32.768, 0.0])


def test_variables_fill_the_packet_in_order() -> None:
    sizes = {"int16_t": 2, "uint16_t": 2, "uint32_t": 4}
    assert sum(sizes[kind] for _, kind in packets.STATE_VARIABLES) == packets.STATE_SIZE
    euler = np.array([0.1, -0.2, 0.3])
    quaternion = rotations.quaternion_from_euler(euler)
    state = DroneState(np.zeros(3), np.zeros(3), quaternion, np.zeros(3), 0, 4.0)
    back = packets.unpack_state(pack_state(state)).quaternion
    found = rotations.euler_from_matrix(rotations.matrix_from_quaternion(back))
    np.testing.assert_allclose(found, euler, atol=3e-3)  # the wire's resolution of an angle
