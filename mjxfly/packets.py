"""Bytes on the wire <-> values in SI units: the packed state of a drone, setpoints, commands, poses.

All signs and scales of the Crazyflie's protocol are here. Pure; NumPy and the standard library only.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from mjxball.control import crazyflie

THRUST_FLOOR, THRUST_CEILING = crazyflie.THRUST_FLOOR, crazyflie.THRUST_CEILING  # of what is sent [thrust units]

# One log packet of 26 bytes, the protocol's limit, holds the whole state of a drone.
STATE_VARIABLES: tuple[tuple[str, str], ...] = (
    ("stateEstimateZ.x", "int16_t"),  # [mm]
    ("stateEstimateZ.y", "int16_t"),
    ("stateEstimateZ.z", "int16_t"),
    ("stateEstimateZ.vx", "int16_t"),  # [mm/s]
    ("stateEstimateZ.vy", "int16_t"),
    ("stateEstimateZ.vz", "int16_t"),
    ("stateEstimateZ.quat", "uint32_t"),  # body -> world, compressed
    ("stateEstimateZ.rateRoll", "int16_t"),  # [mrad/s]
    ("stateEstimateZ.ratePitch", "int16_t"),  # [mrad/s], positive nose up: minus the rate about +y
    ("stateEstimateZ.rateYaw", "int16_t"),  # [mrad/s]
    ("supervisor.info", "uint16_t"),
    ("pm.vbatMV", "uint16_t"),  # [mV]
)
STATE = struct.Struct("<6hI3hHH")
STATE_SIZE = STATE.size
_SETPOINT = struct.Struct("<fffH")
SETPOINT_SIZE = _SETPOINT.size
MILLI = 1e-3

# A second log packet of at most 24 bytes shows the health of a drone's estimator, motors and uplink. The rows of
# `MOTORS` are alternatives: the first one that the firmware lists is logged.
VARIANCES = tuple((f"kalman.var{axis}", "float") for axis in "XYZ")  # [m2] (varPX and so on are of the velocity)
MOTORS = (
    tuple((f"motor.m{number}", "uint16_t") for number in (1, 2, 3, 4)),  # [PWM]
    tuple((f"motor.m{number}req", "uint16_t") for number in (1, 2, 3, 4)),  # [PWM], not capped
)
ACTING_THRUST = ("controller.cmd_thrust", "float")  # [thrust units] of the setpoint that is in force

# A third log packet of 26 bytes: specific force of the accelerometer, and the newest external pose of the firmware.
SENSED: tuple[tuple[str, str], ...] = (
    *((f"acc.{axis}", "FP16") for axis in "xyz"),  # [g], body axes
    *((f"locSrv.{axis}", "float") for axis in "xyz"),  # [m]
    *((f"locSrv.{part}", "FP16") for part in ("qx", "qy", "qz", "qw")),
)
GRAVITY = 9.81  # [m/s2]

CAN_ARM, ARMED, AUTO_ARMED, CAN_FLY, FLYING, TUMBLED, LOCKED, CRASHED = (1 << bit for bit in range(8))


class PacketError(ValueError):
    """Bytes or values that do not form a valid packet."""


class DroneState(NamedTuple):
    """Estimated state, supervisor bits and battery of one drone."""

    position: np.ndarray  # (3,) in the world [m]
    velocity: np.ndarray  # (3,) in the world [m/s]
    quaternion: np.ndarray  # (4,) body -> world (w, x, y, z)
    rates: np.ndarray  # (3,) about the body axes [rad/s]
    info: int  # bits of the firmware's supervisor, see `CAN_ARM` and following
    battery: float  # [V]


class Health(NamedTuple):
    """Position variance, motor PWM and thrust in force of one drone."""

    variance: tuple[float, float, float]  # of the estimated position [m2]
    motors: tuple[int, int, int, int]  # PWM 0 .. 65535
    thrust: float  # of the setpoint in force [thrust units]


class Sensed(NamedTuple):
    """Specific force of one drone's accelerometer and its newest external pose, unfiltered."""

    force: tuple[float, float, float]  # specific force, body axes [m/s2]
    position: tuple[float, float, float]  # [m]; 0 if no pose ever came
    quaternion: tuple[float, float, float, float]  # body -> world (w, x, y, z), coarse: 11-bit significands


class Setpoint(NamedTuple):
    """Setpoint of one drone in the wire's units and signs, after the negation of pitch in cflib's `send_setpoint`.

    Positive roll moves toward -y, *negative* pitch moves toward +x, positive yaw rate turns clockwise from above.
    """

    roll: float  # [deg]
    pitch: float  # [deg], wire sign
    yaw_rate: float  # [deg/s], wire sign
    thrust: int  # [thrust units] 0 .. 65535


ZERO = Setpoint(0.0, 0.0, 0.0, 0)


def setpoint(roll: float, pitch: float, yaw_rate: float, thrust: float) -> Setpoint:
    """Setpoint for Z-X-Y `roll`, `pitch` [rad] and `yaw_rate` about +z [rad/s]; `thrust` is rounded to units.

    Raises PacketError for a value that is not finite or a thrust beyond 16 bits.
    """
    if not all(map(math.isfinite, (roll, pitch, yaw_rate, thrust))):
        raise PacketError("a command is not finite")
    units = round(thrust)
    if not 0 <= units <= 0xFFFF:
        raise PacketError(f"thrust {units} does not fit 16 bits")
    return Setpoint(math.degrees(roll), -math.degrees(pitch), -math.degrees(yaw_rate), units)


def angles(value: Setpoint) -> tuple[float, float, float]:
    """(roll, pitch [rad], yaw rate [rad/s]) of a setpoint, in the conventions of `control`."""
    return math.radians(value.roll), -math.radians(value.pitch), -math.radians(value.yaw_rate)


def pack_setpoint(value: Setpoint) -> bytes:
    """The 14 bytes of port 3, channel 0. Raises PacketError as `setpoint` does."""
    if not all(map(math.isfinite, value)) or not 0 <= value.thrust <= 0xFFFF:
        raise PacketError("a setpoint is not finite or its thrust does not fit 16 bits")
    return _SETPOINT.pack(*value)


def unpack_setpoint(data: bytes) -> Setpoint:
    """The setpoint in 14 bytes; its floats are not checked. Raises PacketError for another length."""
    if len(data) != SETPOINT_SIZE:
        raise PacketError(f"a setpoint has {SETPOINT_SIZE} bytes, not {len(data)}")
    return Setpoint(*_SETPOINT.unpack(data))


def unpack_state(data: bytes) -> DroneState:
    """The drone's state in 26 bytes. Raises PacketError for another length or an invalid quaternion."""
    if len(data) != STATE_SIZE:
        raise PacketError(f"a state has {STATE_SIZE} bytes, not {len(data)}")
    x, y, z, vx, vy, vz, compressed, roll, pitch, yaw, info, battery = STATE.unpack(data)
    position, velocity = MILLI * np.array([x, y, z], float), MILLI * np.array([vx, vy, vz], float)
    rates = MILLI * np.array([roll, -pitch, yaw], float)
    return DroneState(position, velocity, decompress_quaternion(compressed), rates, info, MILLI * battery)


def health_of(values: Mapping[str, float]) -> Health:
    """Health from log variables by name; missing motors are 0, a missing thrust is NaN."""
    known = next((names for names in MOTORS if names[0][0] in values), ())
    motors = [int(values[name]) for name, _ in known] or [0] * 4
    variance = [float(values[name]) for name, _ in VARIANCES]
    thrust = float(values.get(ACTING_THRUST[0], math.nan))
    return Health((variance[0], variance[1], variance[2]), (motors[0], motors[1], motors[2], motors[3]), thrust)


def sensed_of(values: Mapping[str, float]) -> Sensed:
    """Sensed values from log variables by name; missing ones are 0."""
    x, y, z = (GRAVITY * values.get(f"acc.{axis}", 0.0) for axis in "xyz")
    place = [values.get(f"locSrv.{axis}", 0.0) for axis in "xyz"]
    w, i, j, k = (values.get(f"locSrv.q{part}", 0.0) for part in "wxyz")
    return Sensed((x, y, z), (place[0], place[1], place[2]), (w, i, j, k))


class Packet(NamedTuple):
    """One CRTP packet for a drone."""

    port: int
    channel: int
    data: bytes


def setpoint_packet(value: Setpoint) -> Packet:
    """The packet that `send_setpoint` of cflib would send. Raises PacketError as `pack_setpoint` does."""
    return Packet(3, 0, pack_setpoint(value))


PING = Packet(15, 0, b"\0")
VERSION, DEVICE = Packet(13, 1, b"\x01"), Packet(13, 1, b"\x02")  # requests, answered on the same channel
STOP = Packet(7, 0, b"\0")  # motors off, at once, not locked
EMERGENCY_STOP = Packet(9, 1, b"\x03")  # motors off and locked until reboot
ARM, DISARM = Packet(9, 1, b"\x01\x01"), Packet(9, 1, b"\x01\x00")

POSE = struct.Struct("<B7f")  # of the localization port: kind of packet, x, y, z [m], quaternion (x, y, z, w)
POSE_PORT, EXTERNAL_POSE = 6, 8


def pose_packet(position: Sequence[float], quaternion: Sequence[float]) -> Packet:
    """An external pose for the drone's estimator: position (3,) [m], quaternion (4,) (w, x, y, z), body -> world.

    Raises PacketError for a value that is not finite or a quaternion that is not of unit length.
    """
    w, x, y, z = map(float, quaternion)
    values = (*map(float, position), x, y, z, w)
    if not all(map(math.isfinite, values)) or abs(w * w + x * x + y * y + z * z - 1) > 1e-3:
        raise PacketError("a pose is not finite or its quaternion is not one of unit length")
    return Packet(POSE_PORT, 1, POSE.pack(EXTERNAL_POSE, *values))


_STEPS = 511  # largest magnitude of a component: 9 bits, and a sign


def compress_quaternion(quaternion: np.ndarray) -> int:
    """32 bits: index of the largest component, then the three others in units of sqrt(1/2) / 511.

    `quaternion` is (w, x, y, z); the wire's order is (x, y, z, w) and its largest component is positive.
    """
    wire = np.array([quaternion[1], quaternion[2], quaternion[3], quaternion[0]], float)
    wire /= math.sqrt(float(wire @ wire))
    largest = int(np.argmax(np.abs(wire)))
    if wire[largest] < 0:
        wire = -wire
    packed = largest
    for index in range(4):
        if index != largest:
            size = min(int(_STEPS * abs(wire[index]) * math.sqrt(2) + 0.5), _STEPS)
            packed = packed << 10 | (int(wire[index] < 0) << 9) | size
    return packed


def decompress_quaternion(packed: int) -> np.ndarray:
    """(w, x, y, z) from 32 bits. Raises PacketError if the three small components are too large for unit length."""
    largest, wire = packed >> 30, [0.0] * 4
    for index in (3, 2, 1, 0):
        if index != largest:
            size = (packed & _STEPS) / (_STEPS * math.sqrt(2))
            wire[index] = -size if packed & 0x200 else size
            packed >>= 10
    rest = 1.0 - sum(value * value for value in wire)
    # The square of the largest component is at least 1/4 minus half a step of rounding.
    if rest < 0.24:
        raise PacketError("the quaternion is not one of unit length")
    wire[largest] = math.sqrt(rest)
    return np.array([wire[3], wire[0], wire[1], wire[2]])
