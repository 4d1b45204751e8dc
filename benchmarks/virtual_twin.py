"""Flights in virtual time: the runner's `Flight` on the twin's drones, without sockets, processes and clock.

For tests and benchmarks of hundreds of flights: a second of flight takes about a quarter of a second. The preparation
of a real flight (gains, reset of the estimators, waiting) is done by packets to the drones' protocol. The link's delay
applies to setpoints and states.
"""

from __future__ import annotations

import dataclasses
import math
import struct
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from mjxball.control import rotations
from mjxball.policy import Policy
from mjxfly import app_flight, packets, positioning
from mjxfly.app.host import Library
from mjxfly.app.protocol import APP_VARIABLES, sample_of
from mjxfly.classical import ClassicalFollower
from mjxfly.controller import FlightController
from mjxfly.flight import Flight
from mjxfly.limits import NAMES, FlightSettings
from mjxfly.monitor import down_reason
from mjxfly.packets import Packet
from mjxfly.policy_setup import motor_of, times_of, variants
from mjxfly.preflight import parameters_of
from mjxfly.setpoints import CURVE_NAMES, CommandMap, CurveName, Variant, Variants
from mjxfly.supervisor import FlightState, Supervisor
from mjxfly.telemetry import HealthSample, Note, Rig, SensedSample, Telemetry
from mjxfly.twin import logs
from mjxfly.twin.arming import PERIOD
from mjxfly.twin.conditions import DELIVERED, QUIET, Conditions, DroneKind, Surroundings
from mjxfly.twin.drone import TwinDrone, advance
from mjxfly.twin.pair import Pair, PairState
from mjxfly.twin.physics import pair_of
from mjxfly.twin.protocol import header

STEP = 0.005  # [s] between two steps of the drones; delays are a whole number of them
GROUNDED = 3e-3  # [m] largest height above rest that counts as touched down
BLOCK, HEALTH_BLOCK, APP_BLOCK, SENSED_BLOCK = 1, 2, 3, 4  # ids of the log blocks; BLOCK: state
HEALTH = (*packets.VARIANCES, *packets.MOTORS[0], packets.ACTING_THRUST)
_HEALTH, _SENSED = struct.Struct("<3f4Hf"), struct.Struct("<3e3f4e")


class VirtualLink:
    """Substitute for `link.Link` that passes packets directly to a drone of the twin."""

    def __init__(self, drone: TwinDrone, clock: Callable[[], float], name: str, note: Note):
        self.drone, self._clock = drone, clock
        self.name, self._note = name, note
        self.telemetry: Telemetry = Telemetry()
        self.lost: str | None = None
        self.stuck = 0.0
        self.busy: bool | str = False
        self.packets: list[tuple[float, Packet]] = []

    def send(self, packet: Packet) -> None:
        """Send `packet`, with the link's delay."""
        now = self._clock()
        self.packets.append((now, packet))
        self.drone.receive(bytes([header(packet.port, packet.channel)]) + packet.data, now)

    command = pose = send

    def stuck_for(self, now: float) -> float:
        """Time for which nothing could be sent [s]; tests set it by `stuck`."""
        return max(self.stuck - (self._clock() - now), 0.0)

    def ask(self, port: int, channel: int, data: bytes) -> list[bytes]:
        """Return the answers to a request, without delay and loss."""
        return self.drone.peer.receive(bytes([header(port, channel)]) + data, self._clock())

    def write_parameters(self, values: Mapping[str, float]) -> None:
        """Write parameters by name."""
        parameters = self.drone.peer.parameters
        names = [parameter.name for parameter in parameters]
        for name, value in values.items():
            number = names.index(name)
            self.ask(2, 2, number.to_bytes(2, "little") + parameters[number].pack(value))

    write_later = write_parameters

    def start_states(self) -> None:
        """Start the log blocks: state at 100 Hz, sensors and app at 50 Hz, health at 20 Hz."""
        names = [name for name, _ in logs.KNOWN]
        blocks = [(BLOCK, packets.STATE_VARIABLES, 1), (HEALTH_BLOCK, HEALTH, 5), (SENSED_BLOCK, packets.SENSED, 2)]
        blocks += [(APP_BLOCK, APP_VARIABLES, 2)] if self.drone.app is not None else []
        for block, variables, period in blocks:
            entries = [
                bytes([logs.LOG_TYPES[kind][0]]) + names.index(name).to_bytes(2, "little") for name, kind in variables
            ]
            self.ask(5, 1, bytes([2, block]))
            self.ask(5, 1, bytes([6, block]) + b"".join(entries[:9]))
            self.ask(5, 1, bytes([7, block]) + b"".join(entries[9:]))
            self.ask(5, 1, bytes([3, block, period]))

    def take(self, datagram: bytes, now: float) -> None:
        """Handle a datagram of the drone at `now` [s]."""
        logged = datagram[:1] == bytes([header(5, 2)])
        if logged and len(datagram) == 5 + _HEALTH.size and datagram[1] == HEALTH_BLOCK:
            values = zip((name for name, _ in HEALTH), _HEALTH.unpack(datagram[5:]), strict=True)
            health = packets.health_of(dict(values))
            self._note("health", t=now, drone=self.name, **health._asdict())
            self.telemetry.health = HealthSample(health, now)
        elif logged and len(datagram) == 5 + _SENSED.size and datagram[1] == SENSED_BLOCK:
            values = zip((name for name, _ in packets.SENSED), _SENSED.unpack(datagram[5:]), strict=True)
            stamp = int.from_bytes(datagram[2:5], "little")
            self.telemetry.sensed = SensedSample(packets.sensed_of(dict(values)), stamp)
        elif logged and len(datagram) == 5 + len(APP_VARIABLES) and datagram[1] == APP_BLOCK:
            self.telemetry.app = sample_of(
                dict(zip((name for name, _ in APP_VARIABLES), datagram[5:], strict=True)), now
            )
        elif logged and len(datagram) == 5 + packets.STATE_SIZE and datagram[1] == BLOCK:
            try:
                state = packets.unpack_state(datagram[5:])
            except packets.PacketError:
                self.telemetry.damaged += 1
                return
            self._note("state", t=now, drone=self.name, raw=datagram[1:].hex())
            self.telemetry.take(state, int.from_bytes(datagram[2:5], "little"), now)


class MemoryLog:
    """Substitute for the flight log, in memory; with `keep`, ticks, states and health are kept as well."""

    def __init__(self, keep: bool = True) -> None:
        self.records: list[dict[str, Any]] = []
        self._keep = keep

    def note(self, kind: str, t: float | None = None, **fields: Any) -> None:
        """Append one record."""
        if self._keep or kind not in ("tick", "state", "health"):
            self.records.append({"kind": kind, "t": t, **fields})

    def transitions(self) -> list[str]:
        """Return the states that the flight's supervisor has entered, in order."""
        return [record["after"] for record in self.records if record["kind"] == "transition"]


class TrueState(NamedTuple):
    """True state at one time."""

    time: float  # [s]
    state: str  # of the flight's supervisor
    position: np.ndarray  # (3,) of O [m]
    velocity: np.ndarray  # (3,) mean of both drones [m/s]
    tilt: float  # of the pair [rad]
    roll: float  # of the stick [rad]
    pwm: np.ndarray  # (2, 4)
    ball: float  # CG offset from O along the stick [m]
    battery: float  # the lower one's [V]


class VirtualTwin:
    """A pair, its two drones, and consecutive flights with them."""

    def __init__(
        self,
        policy: Policy | ClassicalFollower,
        settings: FlightSettings | None = None,
        *,
        kind: DroneKind = DELIVERED,
        surroundings: Surroundings = QUIET,
        conditions: Conditions | None = None,
        physics: Pair | None = None,
        maps: Sequence[CommandMap] | None = None,
        log: Any = None,
        settle: float = 0.05,
        checks: bool = False,
        cores: tuple[Library, Library] | None = None,
    ):
        """Put the pair on the ground and begin a flight, `settle` [s] after the states have started.

        `physics` and `maps` (by force curve) default to those of the policy's metadata. `log`: a `MemoryLog` or a
        `flight_log.Journal`. With `checks`, a drone that cannot fly refuses the flight, as before a real flight.
        `cores`: compiled apps of both drones, which then control the flight, see `app.host`.
        """
        self.policy, self.rig, self._checks = policy, Rig.from_metadata(policy.metadata), checks
        self.config = FlightController(policy).config
        self.pair: Pair = physics or pair_of(self.config, kind, surroundings, conditions)
        self.state: PairState = self.pair.start()
        self.rest = float(self.state.position[:, 2].mean())
        self.now, self._count = 0.0, 0
        one, other = cores or (None, None)
        self.drones = TwinDrone(self.pair, 0, one), TwinDrone(self.pair, 1, other)
        self.log: Any = log or MemoryLog()
        named = zip(NAMES, self.drones, strict=True)
        self.links = [VirtualLink(drone, lambda: self.now, name, self.log.note) for name, drone in named]
        self.variants: Sequence[Variants] = variants(self.config)
        if maps is not None:
            self.variants = [{name: Variant(one, {}) for name in CURVE_NAMES} for one in maps]
        self._onboard = cores is not None
        stand, times = self.config.plant.stand != "free", times_of(self.config)
        settings = settings or FlightSettings(seconds=2.0, stand=stand, times=times)
        limits = positioning.system_of(self.drones[0].peer.values.defaults).widen(settings.limits)
        self.settings = dataclasses.replace(settings, motor=motor_of(self.config), limits=limits)
        if self._onboard:
            self.settings = app_flight.settings_of(self.settings)
            self.variants = app_flight.variants_of(self.variants, self.rig, self.settings)
        self.track: list[TrueState] = []
        self._start_flight(settle)

    def _start_flight(self, settle: float) -> None:
        """Prepare the drones, wait `settle` [s], begin a flight; with `checks` it is ready only if both can fly."""
        curve: CurveName = "linear" if "linear" in self.variants[0] else "older"
        controller, curves = FlightController(self.policy), [curve, curve]
        kind = app_flight.OnboardFlight if self._onboard else Flight
        self.flight = kind(self.links, controller, self.variants, curves, self.rig, self.settings, self.log.note)
        for link, own in zip(self.links, self.variants, strict=True):
            link.telemetry = Telemetry()
            link.write_parameters(parameters_of(own[curve].gains, self._onboard))
            link.write_parameters({"kalman.resetEstimation": 1.0})
            link.start_states()
        self.advance(max(settle, 4 * STEP) + 2 * self.pair.surroundings.delay)
        infos = [drone.firmware.info for drone in self.drones]
        able = [info & (packets.CAN_ARM | packets.CAN_FLY) and not down_reason(info, armed=False) for info in infos]
        unfit = [name for name, can_fly in zip(NAMES, able, strict=True) if not can_fly]
        self.flight.ready = not (unfit and self._checks)
        self.flight.refusal = f"{unfit[0]} cannot fly" if unfit else ""
        self.flight.begin(self.now)

    def start_in_air(self, start: Any) -> None:
        """Begin the flight in the air under both controllers, from a simulation's `PlantState` (no batch).

        Only `CoupledPair` supports it. The position is relative to that at rest.
        """
        late = 2 * self.pair.surroundings.delay
        self.advance(2 * PERIOD)
        for thrusts in ((0.0, 0.0), (one.hover_thrust for one in self.flight.maps)):
            for link, thrust in zip(self.links, thrusts, strict=True):
                link.send(packets.setpoint_packet(packets.Setpoint(0.0, 0.0, 0.0, round(thrust))))
            self.advance(STEP + late)
        self.state = getattr(self.pair, "place")(start)  # noqa: B009 - not every pair has it
        self.advance(0.02 + late)
        self.flight.supervisor = Supervisor(FlightState.FLY, self.now)

    def next_flight(self, pause: float = 3.0, settle: float = 1.0) -> Flight:
        """Begin another flight of the same drones without reboot, after `pause` [s] of a silent link.

        The laptop then connects again and prepares the drones, which takes `settle` [s].
        """
        self.advance(pause)
        self._start_flight(settle)
        return self.flight

    def advance(self, seconds: float) -> None:
        """Step the twin for `seconds` without the flight."""
        for _ in range(round(seconds / STEP)):
            self._count += 1
            self.now = self._count * STEP
            self.state = advance(self.pair, self.drones, self.state, self.now, STEP)
            for drone, link in zip(self.drones, self.links, strict=True):
                for datagram in drone.send(self.now):
                    link.take(datagram, self.now)

    def tick(self) -> bool:
        """Run one period of twin and flight; return false once the flight has ended."""
        self.advance(self.flight.settings.period)
        going = self.flight.tick(self.now)
        self.track.append(self.moment())
        return going

    def run(self, limit: float = 120.0) -> str:
        """Tick to the end of the flight, for at most `limit` [s]; return the last state of its supervisor."""
        self.fly_for(limit)
        return self.flight.supervisor.state.value

    def fly_until(self, wanted: FlightState, limit: float = 30.0) -> None:
        """Tick until the supervisor is in the state `wanted`. Raises AssertionError after `limit` [s]."""
        end = self.now + limit
        while self.flight.supervisor.state is not wanted:
            assert self.now < end, f"still in {self.flight.supervisor} after {limit} s"
            assert self.tick() or self.flight.supervisor.state is wanted

    def fly_for(self, seconds: float) -> None:
        """Tick for `seconds`, or until the flight has ended."""
        end = self.now + seconds
        while self.now < end and self.tick():
            pass

    # True state.

    def moment(self) -> TrueState:
        """Return the true state now."""
        state = self.state
        line = state.position[0] - state.position[1]
        return TrueState(
            time=self.now,
            state=self.flight.supervisor.state.value,
            position=state.position.mean(axis=0),
            velocity=state.velocity.mean(axis=0),
            tilt=rotations.tilt_of_quaternion(state.quaternion[0]),
            roll=math.atan2(float(line[2]), float(line[1])),
            pwm=state.report.pwm,
            ball=self.pair.cg_offset,
            battery=float(state.battery.min()),
        )

    def running(self) -> list[bool]:
        """Whether any motor turns, of leader and follower."""
        return [bool(row.max() > 0) for row in self.state.report.pwm]

    def touchdown_speed(self) -> float:
        """Return the downward speed [m/s] at the first contact after the highest point of `track`, NaN without one."""
        heights = np.array([moment.position[2] for moment in self.track]) - self.rest
        if not len(heights) or heights.max() < 0.02:
            return math.nan
        top = int(heights.argmax())
        down = np.nonzero(heights[top:] < GROUNDED)[0]
        if not len(down):
            return math.nan
        contact = top + int(down[0])
        return float(max(-moment.velocity[2] for moment in self.track[max(contact - 3, 0) : contact + 1]))

    # Faults.

    def fault_drone(self, number: int, **faults: Any) -> None:
        """Set fields of one drone's `DroneFaults`."""
        self.drones[number].faults = dataclasses.replace(self.drones[number].faults, **faults)

    def fault_link(self, number: int, **faults: Any) -> None:
        """Set fields of one drone's `LinkFaults`."""
        self.drones[number].link = dataclasses.replace(self.drones[number].link, **faults)
