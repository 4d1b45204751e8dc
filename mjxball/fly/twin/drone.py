"""One drone of the twin: its protocol, its firmware, its faults, and both ways of its link."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from mjxball.control import rotations
from mjxball.control.firmware_gains import STOCK, gains_of
from mjxball.fly import packets
from mjxball.fly.packets import DroneState, Setpoint
from mjxball.fly.twin import faults, tables
from mjxball.fly.twin.body import PairState
from mjxball.fly.twin.faults import Channel, DroneFaults, LinkFaults
from mjxball.fly.twin.firmware import Firmware, FirmwareTimes
from mjxball.fly.twin.protocol import Peer

CONVERGING = 0.4  # [s] the estimator's variances take about this long after a reset


class TwinDrone:
    """What answers at one address. `receive`, `step` and `send` are called by one thread."""

    def __init__(self, times: FirmwareTimes, seed: int, on_parameter: Callable[[str, float], None]):
        self.firmware = Firmware(times)
        self.peer = Peer(self.firmware, self._written)
        self._on_parameter = on_parameter
        self.link, self.faults = LinkFaults(), DroneFaults()
        self._random = np.random.default_rng(seed)
        self.up, self.down = Channel(self._random), Channel(self._random)
        self._reset_time = -math.inf
        self._stamp = 0.0
        self._readings: dict[str, float] = {name: 0.0 for name, _ in tables.LOG_VARIABLES}
        self.setpoint = packets.ZERO

    def _written(self, name: str, value: float) -> None:
        if name == "kalman.resetEstimation" and value:
            self._reset_time = self._stamp
        self._on_parameter(name, value)

    def receive(self, datagram: bytes, now: float) -> None:
        """A datagram came from the laptop."""
        self.up.push(datagram, now, self.link, self.link.silent_up)

    def step(self, state: DroneState, force_z: float, now: float) -> Setpoint:
        """Handle what has arrived, and return what the firmware makes of it."""
        for datagram in self.up.due(now):
            for answer in self.peer.receive(datagram, now):
                self.down.push(answer, now, self.link, self.link.silent_down)
        self.setpoint = self.firmware.step(now, force_z, packets.level_share(state.quaternion) > 0)
        if not self.faults.clock_stopped:
            self._stamp = now
        # Every variable is computed only when a packet is due: a twin that is never late needs the time.
        if not self.faults.frozen and self.peer.is_due(now):
            self._readings = self._read(state, force_z, now)
        self._readings["supervisor.info"] = self.firmware.info
        return self.setpoint

    def send(self, now: float) -> list[bytes]:
        """Datagrams that leave for the laptop at `now`."""
        stamped = self.peer.log_data(self._readings, now)
        if self.faults.clock_stopped:
            stamp = (int(self._stamp * 1000) & 0xFFFFFF).to_bytes(3, "little")
            stamped = [datagram[:2] + stamp + datagram[5:] for datagram in stamped]
        junk = int(self._random.poisson(self.faults.garbage)) if self.faults.garbage else 0
        for datagram in (*stamped, *(faults.garbage(self._random) for _ in range(junk))):
            self.down.push(datagram, now, self.link, self.link.silent_down)
        return self.down.due(now)

    def reboot(self) -> None:
        """Power off and on: log blocks and parameters are forgotten."""
        self.firmware.reboot()
        self.peer = Peer(self.firmware, self._written)
        for name, value in gains_of(STOCK).items():
            self._on_parameter(name, value)

    def _read(self, state: DroneState, force_z: float, now: float) -> dict[str, float]:
        """Every log variable."""
        position = state.position + np.array(self.faults.offset)
        counts = [*1000 * position, *1000 * state.velocity]
        rates = np.degrees(state.rates)
        roll, pitch, yaw = np.degrees(rotations.euler_from_matrix(rotations.matrix_from_quaternion(state.quaternion)))
        variance = 1e-5 + math.exp(-(now - self._reset_time) / CONVERGING * 8)
        voltage = state.battery + self.faults.battery
        readings = dict(zip((name for name, _ in packets.STATE_VARIABLES), counts, strict=False))
        readings["stateEstimateZ.quat"] = packets.compress_quaternion(state.quaternion)
        turning = 1000 * state.rates * np.array([1.0, -1.0, 1.0])
        readings |= dict(zip([f"stateEstimateZ.rate{axis}" for axis in ("Roll", "Pitch", "Yaw")], turning, strict=True))
        readings |= {f"kalman.varP{axis}": variance for axis in "XYZ"}
        readings |= {f"gyro.{axis}": rate for axis, rate in zip("xyz", rates, strict=True)}
        readings |= {f"stateEstimate.{axis}": value for axis, value in zip("xyz", position, strict=True)}
        readings |= {"stateEstimate.roll": roll, "stateEstimate.pitch": -pitch, "stateEstimate.yaw": yaw}
        readings |= {"pm.vbatMV": 1000 * voltage, "pm.vbat": voltage, "acc.z": force_z / 9.81}
        readings["stabilizer.thrust"] = self.setpoint.thrust
        return readings


def drone_state(pair: PairState, number: int) -> DroneState:
    """State of drone `number` of the pair."""
    position, velocity, quaternion, rates = (
        leaf[number] for leaf in (pair.position, pair.velocity, pair.quaternion, pair.rates)
    )
    return DroneState(position, velocity, quaternion, rates, 0, float(pair.battery[number]))
