"""The twin's firmware against the real one: rows of the table of differences that was measured on it."""

from __future__ import annotations

import itertools
import math
import struct

import pytest
from twin_peer import ask, written

from mjxfly import packets
from mjxfly.packets import ARMED, AUTO_ARMED, CAN_ARM, CAN_FLY, CRASHED, FLYING, LOCKED, TUMBLED, ZERO, Setpoint
from mjxfly.twin import logs
from mjxfly.twin.arming import PERIOD, ArmingPhase
from mjxfly.twin.conditions import (
    DELIVERED,
    DRONES,
    FAULT_KINDS,
    BodyFault,
    DroneFaults,
    DroneKind,
    LinkFaults,
    Surroundings,
)
from mjxfly.twin.drone import TwinDrone, advance
from mjxfly.twin.firmware import BOOT_TIME, Firmware, Motors, Order
from mjxfly.twin.parameters import PARAMETERS
from mjxfly.twin.physics import SimplePair
from mjxfly.twin.protocol import Peer, header

BRUSHLESS = DRONES["brushless"]
HIGH = Setpoint(8.0, -5.0, 10.0, 45000)
FINISHED = 0x200  # bit of the high-level commander, always set
LEVEL, OFF, ON = (0.0, 0.0, 1.0), (0.0,) * 4, (45000.0,) * 4
TICK = 0.005  # [s]


class Bench:
    """A firmware alone: motors that follow its orders at once, an accelerometer that a test holds."""

    def __init__(self, kind: DroneKind = DELIVERED) -> None:
        self.firmware, self.kind = Firmware(kind), kind
        self.now, self.acceleration = 0.0, LEVEL
        self.order = Order()
        self.sent: Setpoint | None = None  # again and again, every 10 ms
        self.seen: list[tuple[float, int, Order]] = []

    def send(self, value: Setpoint) -> None:
        self.firmware.commander.receive(value, self.now)

    def run(self, seconds: float) -> Order:
        """Live on for `seconds`."""
        for count in range(round(seconds / TICK)):
            self.now += TICK
            if self.sent is not None and count % 2 == 0:
                self.send(self.sent)
            self.order = self.firmware.step(self.now, self.acceleration, self.pwm)
            self.seen.append((self.now, self.firmware.info, self.order))
        return self.order

    @property
    def pwm(self) -> tuple[float, ...]:
        if self.order.motors is Motors.OFF:
            return OFF
        return (max(float(self.order.setpoint.thrust), float(self.kind.idle)),) * 4

    def since(self, bit: int, begun: float, wanted: bool = True) -> float:
        """How long after `begun` an info bit first was as `wanted`."""
        return next(now - begun for now, info, _ in self.seen if now > begun and bool(info & bit) == wanted)

    def fly(self) -> Bench:
        """Zeros, then thrust for a second."""
        self.sent = ZERO
        self.run(0.1)
        self.sent = HIGH
        self.run(1.0)
        assert self.firmware.info & FLYING
        return self


# Row: parameters that clear themselves.


def test_row_reset_estimation_clears_itself() -> None:
    peer = Peer(Firmware())
    assert written(peer, "kalman.resetEstimation", 1, 1.0) == 0
    assert written(peer, "pid_attitude.roll_kp", 4.5, 1.0) == 4.5
    kalman = Peer(Firmware(), decks={"stabilizer.estimator": 2})
    assert [written(kalman, "stabilizer.estimator", value, 1.0) for value in (2, 9, 0)] == [2, 2, 1]  # 0: the default


# Row: flying.


def test_row_flying_from_the_first_motor_until_two_seconds_after_the_last() -> None:
    bench = Bench()
    bench.sent = ZERO
    bench.run(0.1)
    bench.sent, begun = Setpoint(0.0, 0.0, 0.0, 1000), bench.now  # any thrust that turns a motor
    bench.run(0.5)
    assert bench.since(FLYING, begun) <= 2 * PERIOD + 2 * TICK  # measured: 70 ms
    bench.sent, stopped = ZERO, bench.now
    bench.run(2.5)
    # 2 s after the last look that saw a motor turn, at the next look.
    assert 2.0 - PERIOD <= bench.since(FLYING, stopped, wanted=False) <= 2.0 + 2 * PERIOD
    assert bench.firmware.supervisor.phase is ArmingPhase.LANDED
    assert not bench.firmware.info & LOCKED
    bench.run(4.0)  # landed for 3 s: it starts over, and a 2.1 arms itself again
    infos = [info for now, info, _ in bench.seen if now > stopped + 2.2]
    # As logged by the real firmware: two looks of 40 ms, and one each.
    assert [info for info, _ in itertools.groupby(infos)] == [0x20E, 0x204, 0x207, 0x206, 0x20E]
    assert bench.firmware.info == CAN_FLY | ARMED | AUTO_ARMED | FINISHED
    bench.fly()  # without a reboot


# Row: lock rules.


@pytest.mark.parametrize("last", [HIGH, ZERO])
def test_row_silence_while_flying_locks_with_motors_on_or_off(last: Setpoint) -> None:
    bench = Bench().fly()
    bench.sent = None
    bench.send(last)
    begun = bench.now
    bench.run(3.0)
    levels = [order.setpoint for now, _, order in bench.seen if 0.55 < now - begun < 1.95]
    assert all(setpoint == Setpoint(0.0, 0.0, 0.0, last.thrust) for setpoint in levels)
    assert 2.0 < bench.since(LOCKED, begun) <= 2.0 + 2 * PERIOD + 2 * TICK
    bench.sent = ZERO
    bench.run(5.0)
    bench.sent = HIGH
    assert bench.run(1.0).motors is Motors.OFF  # until reboot
    bench.firmware.reboot(bench.now)
    bench.sent = ZERO
    bench.run(BOOT_TIME + 0.5)
    assert bench.firmware.info == CAN_FLY | ARMED | AUTO_ARMED | FINISHED


def test_row_zeros_until_flying_clears_leave_it_unlocked() -> None:
    bench = Bench().fly()
    bench.sent = ZERO
    bench.run(2.2)
    bench.sent = None
    bench.run(30.0)
    assert not any(info & LOCKED for _, info, _ in bench.seen)


def test_row_setpoints_that_come_back_end_the_warning() -> None:
    bench = Bench().fly()
    bench.sent = None
    bench.run(1.5)
    assert bench.firmware.supervisor.phase is ArmingPhase.LEVEL_OUT
    bench.sent = HIGH
    assert bench.run(0.2).setpoint == HIGH


def test_row_cannot_fly_comes_before_locked() -> None:
    for stop in ("silence", "emergency"):
        bench = Bench().fly()
        begun = bench.now
        if stop == "silence":
            bench.sent = None
        else:
            bench.firmware.supervisor.emergency = True
        bench.run(3.0)
        gap = bench.since(LOCKED, begun) - bench.since(CAN_FLY, begun, wanted=False)
        assert gap == pytest.approx(PERIOD, abs=TICK)
        off = next(now - begun for now, _, order in bench.seen if now > begun and order.motors is Motors.OFF)
        assert off <= (PERIOD + 2 * TICK if stop == "emergency" else 2.0 + PERIOD + 2 * TICK)


def test_row_an_emergency_keepalive_that_was_begun_must_go_on() -> None:
    bench = Bench().fly()
    bench.firmware.supervisor.keepalive = bench.now
    assert bench.run(0.9).motors is not Motors.OFF
    assert bench.run(0.2).motors is Motors.OFF


# Row: CAN_ARM and info bits.


def test_row_info_on_the_ground_and_flying() -> None:
    bench = Bench()
    bench.sent = ZERO
    bench.run(0.1)
    assert bench.firmware.info == 0x20E
    bench.fly()
    assert bench.firmware.info == 0x21E
    assert all(info & FINISHED for _, info, _ in bench.seen)
    assert not any(info & CAN_ARM for _, info, _ in bench.seen)


def test_row_can_arm_only_before_arming() -> None:
    bench = Bench(BRUSHLESS)
    bench.run(0.2)
    assert bench.firmware.info == CAN_ARM | FINISHED
    assert bench.firmware.supervisor.request_arming(True)
    bench.run(0.2)
    assert bench.firmware.info == ARMED | CAN_FLY | FINISHED
    assert bench.firmware.supervisor.request_arming(True)  # it is
    bench.firmware.supervisor.emergency = True
    bench.run(0.2)
    assert not bench.firmware.supervisor.request_arming(True)


# Row: DISARM.


def test_row_a_disarmed_21_arms_itself_again() -> None:
    for flying in (False, True):
        bench = Bench()
        if flying:
            bench.fly()
        bench.sent, begun = ZERO, bench.now
        bench.firmware.supervisor.request_arming(False)
        bench.run(0.5)
        assert bench.since(CAN_FLY, begun, wanted=False) <= PERIOD + TICK
        again = next(now - begun for now, info, _ in bench.seen if now > begun + 0.06 and info & CAN_FLY)
        assert again <= 5 * PERIOD + 2 * TICK  # five looks: 0.2 s
        assert bench.firmware.info & ARMED


# Row: arming required.


def test_row_an_armed_brushless_idles_until_it_is_disarmed() -> None:
    bench = Bench(BRUSHLESS)
    bench.sent = ZERO
    bench.run(0.2)
    assert bench.pwm == OFF
    bench.firmware.supervisor.request_arming(True)
    bench.run(0.2)
    assert bench.pwm == (7000.0,) * 4
    assert not bench.firmware.info & FLYING  # idle does not fly
    bench.sent = Setpoint(0.0, 0.0, 0.0, 40000)
    bench.run(1.0)
    assert bench.firmware.info & FLYING
    bench.sent = None
    bench.firmware.commander.stop(bench.now)
    bench.run(0.1)
    assert bench.pwm == (7000.0,) * 4  # during stop as well
    bench.firmware.supervisor.request_arming(False)
    bench.run(0.2)
    assert bench.pwm == OFF
    bench.run(10.0)
    assert not bench.firmware.info & ARMED


def test_row_arming_spins_a_stale_setpoint_up_at_once() -> None:
    bench = Bench(BRUSHLESS)
    bench.sent = ZERO
    bench.run(0.1)
    bench.sent = HIGH
    assert bench.run(0.2).motors is Motors.OFF
    bench.firmware.supervisor.request_arming(True)
    assert bench.run(0.2).setpoint == HIGH


# Row: tumble.


@pytest.mark.parametrize(
    ("acceleration", "first", "last"),  # [g], [s] between which it counts as tumbled; None: never
    [
        ((0.8, 0.0, 0.45), 1.0, 1.1),
        ((0.8, 0.0, 0.55), None, None),
        ((0.0, 0.3, -0.25), 0.1, 0.2),
        ((0.0, 0.3, -0.15), 1.0, 1.1),
        ((0.05, -0.05, 0.05), None, None),  # free fall
    ],
)
def test_row_tumble(acceleration: tuple[float, float, float], first: float | None, last: float | None) -> None:
    bench = Bench().fly()
    bench.acceleration, begun = acceleration, bench.now
    bench.run(2.0)
    if first is None or last is None:
        assert not any(info & (TUMBLED | CRASHED) for _, info, _ in bench.seen)
        return
    assert first < bench.since(CRASHED, begun) <= last
    assert bench.order.motors is Motors.OFF
    assert not bench.firmware.supervisor.recover()  # it still lies there
    bench.acceleration, bench.sent = LEVEL, ZERO
    bench.run(1.0)
    assert bench.firmware.info & CRASHED
    assert bench.firmware.supervisor.recover()
    bench.run(0.5)
    assert bench.firmware.info == 0x20E


def test_row_a_tumbled_drone_on_the_ground_is_not_armed() -> None:
    bench = Bench()
    bench.acceleration = (0.0, 0.0, -1.0)
    bench.run(0.5)
    assert bench.firmware.info == TUMBLED | AUTO_ARMED | FINISHED
    bench.acceleration = LEVEL
    bench.run(0.5)
    assert bench.firmware.info == 0x20E


# Row: 30 s on the ground armed.


def test_row_thirty_seconds_on_the_ground_disarm() -> None:
    for kind in (DELIVERED, BRUSHLESS):
        bench = Bench(kind)
        bench.sent = ZERO
        bench.run(0.1)
        bench.firmware.supervisor.request_arming(True)
        begun = bench.now
        bench.run(31.0)
        gone = next(now - begun for now, info, _ in bench.seen if now > begun + 1.0 and not info & ARMED)
        assert 29.8 < gone < 30.3
        assert bool(bench.firmware.info & ARMED) == kind.auto_arm  # a 2.1 arms itself again


# Thrust lock, stop, priorities: not in the table, since the firmware was found to do the same.


def test_thrust_lock_and_bounds() -> None:
    bench = Bench()
    bench.sent = HIGH
    assert bench.run(0.2).setpoint.thrust == 0
    bench.sent = ZERO
    bench.run(0.05)
    for sent, flown in ((999, 0), (1000, 1000), (60000, 60000), (65535, 60000)):
        bench.sent = Setpoint(0.0, 0.0, 0.0, sent)
        assert bench.run(0.05).setpoint.thrust == flown


def test_a_stop_setpoint_leaves_the_thrust_lock_open() -> None:
    bench = Bench().fly()
    bench.sent = None
    bench.firmware.commander.stop(bench.now)
    assert bench.run(0.01).setpoint.thrust == 0
    bench.sent = HIGH
    assert bench.run(0.02).setpoint == HIGH


def test_notified_that_setpoints_stop_it_turns_off_and_is_never_silent() -> None:
    bench = Bench().fly()
    bench.sent = None
    bench.firmware.commander.relax()
    assert bench.run(0.02).setpoint.thrust == 0
    bench.run(5.0)
    assert not any(info & LOCKED for _, info, _ in bench.seen)


def test_numbers_that_are_not_finite_never_reach_the_physics() -> None:
    bench = Bench()
    bench.sent = Setpoint(math.nan, math.inf, -math.inf, 45000)
    assert all(map(math.isfinite, bench.run(0.1).setpoint))


# Row: stabilizer task dead, and the other faults of a drone.


def flown(kind: DroneKind = DELIVERED) -> tuple[SimplePair, tuple[TwinDrone, TwinDrone], list[float]]:
    pair = SimplePair(kind=kind)
    return pair, (TwinDrone(pair, 0), TwinDrone(pair, 1)), [0.0]


def test_row_a_dead_stabilizer_logs_on_with_frozen_values() -> None:
    pair, drones, _ = flown()
    state, leader = pair.start(), drones[0]
    names = [name for name, _ in logs.LOG_VARIABLES]
    entry = bytes([7]) + names.index("stateEstimate.z").to_bytes(2, "little")
    for request in (bytes([6, 1]) + entry, bytes([3, 1, 1])):
        leader.receive(bytes([header(5, 1)]) + request, 0.0)
    seen: list[tuple[float, int, float, float]] = []
    for number in range(1, 700):
        now = number * TICK
        value = ZERO if now < 0.1 else Setpoint(0.0, 0.0, 0.0, 52000)
        for drone in drones:
            drone.receive(bytes([header(3, 0)]) + packets.pack_setpoint(value), now)
        if number == 300:
            leader.faults = DroneFaults(stabilizer_dead=True)
            died = now
        state = advance(pair, drones, state, now, TICK)
        for datagram in leader.send(now):
            if datagram[0] == header(5, 2):
                stamp, height = struct.unpack("<I", datagram[2:5] + b"\0")[0], struct.unpack("<f", datagram[5:])[0]
                seen.append((now, stamp, height, state.report.pwm[0].max()))
    held = [row for row in seen if died < row[0] < died + 0.34]
    assert len(held) > 30
    assert len({height for _, _, height, _ in held}) == 1
    assert all(b[1] > a[1] for a, b in itertools.pairwise(held))  # fresh stamps
    assert all(row[3] > 40000 for row in held)  # PWM stays
    assert seen[-1][0] < died + 0.37  # the restarted program has no log blocks
    assert leader.firmware.order.motors is Motors.RUN  # on the ground, booted, and not flown again
    assert leader.firmware.commander.setpoint.thrust == 0  # thrust is locked


def test_rows_of_faults_end_with_motors_off() -> None:
    for kind in ("stopped", "killed", "imu", "stabilizer"):
        what = FAULT_KINDS[kind].what
        assert isinstance(what, DroneFaults)
        bench = Bench().fly()
        hung = what.stopped or what.stabilizer_dead
        begun, offs = bench.now, []
        while bench.now < begun + 3.0:
            bench.now += TICK
            still = hung and (bench.firmware.supervisor is not None) and not offs
            order = bench.firmware.step(bench.now, LEVEL, ON, still, what.restarts)
            offs += [bench.now] if order.motors is Motors.OFF else []
        assert offs[0] - begun == pytest.approx(0.35, abs=0.02)
        assert bench.firmware.dead == (kind == "killed")
    for kind in ("pose-frozen", "pose-lost", "pose-jump", "sag", "weak"):
        assert isinstance(FAULT_KINDS[kind].what, BodyFault)
    assert FAULT_KINDS["loss"].what == LinkFaults(loss=0.3)


# Row: tables.


def test_row_tables_have_the_real_size() -> None:
    assert (len(PARAMETERS), len(logs.LOG_VARIABLES)) == (240 + 8, 355 + 8)  # the real firmware's, and its decks'
    variables = [logs.item(logs.LOG_TYPES[kind][0], name) for name, kind in logs.LOG_VARIABLES]
    for items in ([logs.item(one.type_byte, one.name) for one in PARAMETERS], variables):
        assert len(set(items)) == len(items)
        assert max(map(len, items)) + 3 <= 30  # one packet each
    by_name = {parameter.name: parameter for parameter in PARAMETERS}
    for name, kind in (("stabilizer.estimator", "uint8_t"), ("powerDist.idleThrust", "uint32_t")):
        assert by_name[name].kind == kind
    logged = dict(logs.LOG_VARIABLES)
    for name, kind in (*packets.STATE_VARIABLES, ("motor.m1", "uint16_t"), ("motor.m1req", "int32_t")):
        assert logged[name] == kind
    assert dict.fromkeys(logged) != {}


# Row: default estimator, versions, limits of the log.


def test_row_what_it_says_of_itself() -> None:
    for name, device in (("2.1", b"Crazyflie 2.1"), ("brushless", b"Crazyflie 2.1 Brushless")):
        peer = Peer(Firmware(DRONES[name]))
        assert ask(peer, 13, 1, b"\0") == [b"\0" + struct.pack("<i", 12)]
        assert ask(peer, 13, 1, b"\1") == [b"\x012026.08"]
        assert ask(peer, 13, 1, b"\2") == [b"\2" + device]
    assert Peer(Firmware()).values["stabilizer.estimator"] == 1
    assert Peer(Firmware(BRUSHLESS)).values["powerDist.idleThrust"] == 7000


def test_limits_of_the_log() -> None:
    peer = Peer(Firmware())
    assert ask(peer, 5, 0, b"\3")[0][-2:] == bytes([16, 128])
    one, wide = bytes([1, 0, 0]), bytes([7, 0, 0])
    for number in range(16):
        assert ask(peer, 5, 1, bytes([6, number]) + 8 * one) == [bytes([6, number, 0])]
    assert ask(peer, 5, 1, bytes([6, 99]) + one) == [bytes([6, 99, 12])]  # no 17th block
    assert ask(peer, 5, 1, bytes([7, 3]) + one) == [bytes([7, 3, 12])]  # no 129th variable
    assert ask(peer, 5, 1, bytes([6, 3])) == [bytes([6, 3, 17])]
    assert ask(peer, 5, 1, bytes([2, 5])) == [bytes([2, 5, 0])]
    assert ask(peer, 5, 1, bytes([7, 5]) + one) == [bytes([7, 5, 2])]
    assert ask(peer, 5, 1, bytes([7, 3]) + 5 * wide) == [bytes([7, 3, 7])]  # 8 + 4 * 4 bytes fit, 8 + 5 * 4 do not
    assert ask(peer, 5, 1, bytes([7, 4, 1]) + b"\xff\x7f") == [bytes([7, 4, 2])]


def test_parameters_that_cannot_be_written() -> None:
    peer = Peer(Firmware())
    names = [parameter.name for parameter in PARAMETERS]
    fixed = names.index("firmware.revision0").to_bytes(2, "little")
    assert ask(peer, 2, 2, fixed + b"\0\0\0\0") == []  # read-only: no answer
    assert ask(peer, 2, 2, b"\xff\xff\0") == [b"\xff\xff\x02"]
    assert ask(peer, 2, 1, b"\xff\xff") == [b"\xff\xff\x02"]


# Round trips.


@pytest.mark.parametrize("delay", [0.0, 0.005, 0.0125])
def test_row_round_trips_hold_from_the_first_packet(delay: float) -> None:
    pair = SimplePair(surroundings=Surroundings(delay=delay))
    drone = TwinDrone(pair, 0)
    drone.receive(b"\xfd\x00", 1.0)
    arrived = []
    for number in range(300):
        now = 1.0 + number * 1e-4
        drone.answer(now)
        arrived += [now] * len(drone.send(now))
    assert arrived == [pytest.approx(1.0 + 2 * delay, abs=2e-4)]
