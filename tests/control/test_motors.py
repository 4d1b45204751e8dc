"""Motors: force from voltage, its inverse, and battery compensation."""

import numpy as np
import pytest

from mjxball.control import crazyflie, motors
from mjxball.control.motors import MOTORS


@pytest.mark.parametrize("name", MOTORS)
def test_voltage_inverts_the_cubic(name):
    motor = MOTORS[name]
    volts = np.linspace(0.8, 4.2, 200)
    forces = motors.force(motor, np.full(200, motors.FULL), volts)
    assert np.all(np.diff(forces) > 0)
    np.testing.assert_allclose(motors.voltage(motor, forces), volts, atol=1e-9)


@pytest.mark.parametrize("name", MOTORS)
def test_compensated_thrust_does_not_depend_on_the_battery(name):
    motor = MOTORS[name]
    command = np.linspace(0.15, 0.6, 50) * motors.FULL
    for supply in (3.4, 3.8, 4.2):
        pwm = motors.compensated(motor, command, np.float64(supply))
        assert pwm.max() < motors.FULL
        np.testing.assert_allclose(motors.force(motor, pwm, supply), command / motors.FULL * motor.max_force, rtol=1e-9)


def test_small_commands_and_dead_batteries_stop_the_motor():
    motor = MOTORS["2.1"]
    least = motor.min_force / motor.max_force * motors.FULL
    commands = np.array([0.0, least - 1, least + 1])
    assert list(motors.compensated(motor, commands, np.float64(4.0)) > 0) == [False, False, True]
    assert not motors.compensated(motor, np.array([5e4]), np.float64(1.9)).any()


def test_pwm_rises_as_the_battery_falls_and_is_capped_after_compensation():
    """At 2.8 V full thrust needs more than full PWM; the excess is taken off all four motors."""
    motor = MOTORS["2.1"]
    output = np.array([8000.0, 0.0, 0.0])
    high, low = (
        crazyflie.mix(np.float64(58000), output, lambda m, v=v: motors.compensated(motor, m, np.float64(v)))
        for v in (4.2, 2.8)
    )
    assert high.max() < motors.FULL
    assert low.max() == motors.FULL
    uncapped = motors.compensated(motor, 58000 + np.array([-4000.0, -4000.0, 4000.0, 4000.0]), np.float64(2.8))
    np.testing.assert_allclose(low.max() - low.min(), uncapped.max() - uncapped.min(), rtol=1e-12)
