"""The twin's firmware in trouble, against what was measured on the real one (crazyflie.md, "in trouble")."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mjxball.fly import packets
from mjxball.fly.packets import Setpoint
from mjxball.fly.twin.firmware import Firmware, FirmwareTimes

G = 9.81
TILTED = Setpoint(8.0, -5.0, 10.0, 45000)


def opened(times: FirmwareTimes | None = None) -> Firmware:
    """A firmware whose thrust lock is open, at time 0."""
    firmware = Firmware(times or FirmwareTimes())
    firmware.receive_setpoint(packets.ZERO, 0.0)
    return firmware


def flying(now: float = 0.0) -> Firmware:
    firmware = opened()
    firmware.receive_setpoint(TILTED, now)
    assert firmware.step(now, G, True) == TILTED
    return firmware


def test_no_motor_turns_before_a_zero_was_seen() -> None:
    firmware = Firmware()
    firmware.receive_setpoint(TILTED, 0.0)
    assert firmware.step(0.0, G, True).thrust == 0
    firmware.receive_setpoint(packets.ZERO, 0.1)
    firmware.receive_setpoint(TILTED, 0.2)
    assert firmware.step(0.2, G, True).thrust == 45000


def test_without_setpoints_it_levels_with_kept_thrust_and_then_locks() -> None:
    firmware = flying()
    assert firmware.step(0.49, G, True) == TILTED
    assert firmware.step(0.51, G, True) == Setpoint(0.0, 0.0, 0.0, 45000)
    assert firmware.step(1.99, G, True).thrust == 45000
    assert firmware.step(2.01, G, True).thrust == 0
    assert firmware.locked
    firmware.receive_setpoint(packets.ZERO, 2.1)
    firmware.receive_setpoint(TILTED, 2.2)
    assert firmware.step(2.2, G, True).thrust == 0  # locked until reboot
    assert not firmware.arm(True)
    firmware.reboot()
    assert not firmware.locked


def test_it_does_not_lock_on_the_ground() -> None:
    firmware = opened()
    for now in np.arange(0, 5, 0.1):
        firmware.step(float(now), G, True)
    assert not firmware.locked


def test_arming_spins_a_stale_setpoint_up_at_once() -> None:
    firmware = opened(FirmwareTimes(auto_arm=False))
    firmware.receive_setpoint(TILTED, 0.0)
    assert firmware.step(0.1, G, True).thrust == 0
    assert not firmware.info & packets.CAN_FLY
    assert firmware.arm(True)
    assert firmware.step(0.2, G, True).thrust == 45000
    assert firmware.arm(False)
    assert firmware.step(0.3, G, True).thrust == 0


def test_stop_is_not_a_lock_but_the_emergency_stop_is() -> None:
    firmware = flying()
    firmware.receive_stop()
    assert firmware.step(0.01, G, True).thrust == 0
    assert not firmware.locked
    firmware.receive_setpoint(TILTED, 0.02)
    assert firmware.step(0.02, G, True).thrust == 0  # zero first
    firmware.receive_setpoint(packets.ZERO, 0.03)
    firmware.receive_setpoint(TILTED, 0.04)
    assert firmware.step(0.04, G, True).thrust == 45000
    firmware.emergency_stop()
    assert firmware.step(0.05, G, True).thrust == 0
    assert firmware.locked


def test_a_second_of_free_fall_is_a_crash() -> None:
    firmware, now = flying(), 0.0
    while now < 0.9:
        now += 0.01
        firmware.receive_setpoint(TILTED, now)
        firmware.step(now, 0.4 * G, True)
    assert not firmware.crashed
    firmware.receive_setpoint(TILTED, 1.2)
    firmware.step(1.2, 0.4 * G, True)
    firmware.receive_setpoint(TILTED, 1.21)
    assert firmware.crashed
    assert firmware.step(1.21, G, True).thrust == 0
    assert firmware.info & packets.CRASHED
    assert not firmware.info & packets.CAN_FLY
    assert firmware.recover()
    assert not firmware.crashed


def test_a_short_fall_is_forgiven() -> None:
    firmware = flying()
    for number in range(300):
        now = 0.01 * number
        firmware.receive_setpoint(TILTED, now)
        firmware.step(now, 0.4 * G if number % 50 else G, True)
    assert not firmware.crashed


def test_upside_down_it_is_tumbled_and_cannot_be_recovered() -> None:
    firmware = flying()
    firmware.step(0.01, -G, False)
    assert firmware.info & packets.TUMBLED
    assert not firmware.recover()


def test_a_keepalive_that_was_begun_must_go_on() -> None:
    firmware = flying()
    firmware.keep_alive(0.0)
    firmware.receive_setpoint(TILTED, 0.9)
    assert firmware.step(0.9, G, True).thrust == 45000
    firmware.receive_setpoint(TILTED, 1.1)
    assert firmware.step(1.1, G, True).thrust == 0
    assert firmware.locked


@pytest.mark.parametrize(("sent", "flown"), [(999, 0), (1000, 1000), (60000, 60000), (65535, 60000)])
def test_thrust_bounds(sent: int, flown: int) -> None:
    firmware = opened()
    firmware.receive_setpoint(Setpoint(0.0, 0.0, 0.0, sent), 0.0)
    assert firmware.step(0.0, G, True).thrust == flown


def test_numbers_that_are_not_finite_never_reach_the_physics() -> None:
    firmware = opened()
    firmware.receive_setpoint(Setpoint(math.nan, math.inf, -math.inf, 45000), 0.0)
    assert all(map(math.isfinite, firmware.step(0.0, G, True)))
