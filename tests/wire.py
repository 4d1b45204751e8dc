"""Support: the drone's end of packets, states packed and poses unpacked."""

from __future__ import annotations

import math

import numpy as np

from mjxfly.packets import EXTERNAL_POSE, MILLI, POSE, STATE, DroneState, PacketError, compress_quaternion


def pack_state(state: DroneState) -> bytes:
    """The 26 bytes of `STATE_VARIABLES`; values beyond their range saturate, as far as 16 bits reach."""
    rates = state.rates * np.array([1.0, -1.0, 1.0])
    counts = [_int16(value / MILLI) for value in (*state.position, *state.velocity, *rates)]
    battery = min(max(round(state.battery / MILLI), 0), 0xFFFF)
    quaternion = compress_quaternion(state.quaternion)
    return STATE.pack(*counts[:6], quaternion, *counts[6:], state.info & 0xFFFF, battery)


def unpack_pose(data: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Position (3,) [m] and quaternion (4,) (w, x, y, z) of a pose packet's bytes. Raises PacketError if it is none."""
    if len(data) != POSE.size or data[0] != EXTERNAL_POSE:
        raise PacketError(f"a pose has {POSE.size} bytes, of which the first is {EXTERNAL_POSE}")
    _, px, py, pz, x, y, z, w = POSE.unpack(data)
    return np.array([px, py, pz]), np.array([w, x, y, z])


def _int16(value: float) -> int:
    return min(max(round(value), -0x8000), 0x7FFF) if math.isfinite(value) else 0
