"""One firmware's thrust commands in another's units, and the motors that follow the battery in training."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjxball.config import Config, apply_overrides, preset, read_plant, validate
from mjxball.control import crazyflie, motors
from mjxball.control.constants import drone_loop, hover
from mjxball.control.motors import OLDER, compensates, firmware, with_curve
from mjxball.env import TransportEnv
from mjxball.physics.autopilot import make_battery_autopilot
from mjxball.physics.engine import Load
from mjxball.physics.step import start_state
from mjxball.sim.randomization import LIFT, ResetDistribution

NEWER = (0.0, 0.12)


class TestConversion:
    @pytest.mark.parametrize("name", ["flight", "stand"])
    def test_the_loop_about_hover_stays(self, name: str) -> None:
        """Stiffness and damping of roll and pitch: equal to rounding, and back again are the gains that there were."""
        config = preset(name)
        other = validate(with_curve(config, OLDER))
        assert other.autopilot.roll_rate[0] < 0.7 * config.autopilot.roll_rate[0]  # its curve is 1.63 times as steep
        for axis in (0, 1):
            mine, theirs = drone_loop(config, axis), drone_loop(other, axis)
            for part in ("kp", "kd", "kdd", "integral_gain"):
                assert getattr(theirs, part) == pytest.approx(getattr(mine, part), rel=1e-6)
        back = with_curve(other, NEWER)
        for axis in ("roll_rate", "pitch_rate", "yaw_rate"):
            assert getattr(back.autopilot, axis) == pytest.approx(getattr(config.autopilot, axis), rel=1e-9)

    def test_the_papers_law_keeps_force_and_slope(self) -> None:
        """46 000 and 1000 units on the older curve; a unit more per acceleration gives the same force on both."""
        config = preset("stand")
        uncompensated = with_curve(config, OLDER)
        assert uncompensated.autopilot.hover_thrust == pytest.approx(46000, abs=50)
        assert uncompensated.autopilot.thrust_per_acceleration == pytest.approx(1000, rel=2e-3)
        for vertical in (-0.1, 0.0, 0.1):
            forces = [
                crazyflie.motor_force(
                    autopilot.motor_curve,
                    np.float64(autopilot.hover_thrust + autopilot.thrust_per_acceleration * vertical),
                )
                for autopilot in (config.autopilot, uncompensated.autopilot)
            ]
            # 100 units off hover the older curve bends by 3e-7 N of 0.09 N.
            assert forces[0] == pytest.approx(forces[1], rel=1e-5)

    def test_the_same_curve_changes_nothing(self) -> None:
        assert with_curve(preset("flight"), NEWER) is preset("flight")

    def test_delivered_pair_hovers_at_50562_units(self) -> None:
        assert hover(preset("flight"))[0] == pytest.approx(50562, abs=1)

    def test_cards_name_the_firmware(self) -> None:
        assert firmware(preset("flight")) == {"drone": "2.1", "curve": "linear", "converts": ["older"]}
        assert firmware(with_curve(preset("flight"), OLDER))["curve"] == "older"
        for name, drone in (("crazyflie-brushless", "brushless"), ("crazyflie-thrust-upgrade", "thrust-upgrade")):
            assert firmware(apply_overrides(preset("flight"), read_plant(name).settings)) == {
                "drone": drone,
                "curve": "linear",
                "converts": [],
            }
        assert compensates(NEWER)
        assert not compensates(OLDER)


def battery_load(volts: float, uncompensated: float, scale: tuple[float, float] = (1.0, 1.0)) -> Load:
    mass, zero, none = np.array(0.0175), np.array(0.0), np.zeros(0)
    return Load(mass, mass, zero, zero, zero, none, none, thrust_scale=np.array(scale), battery=np.array(volts),
                uncompensated=np.array(uncompensated))  # fmt: skip


def asked(config: Config, volts: float, uncompensated: float, vertical: float) -> np.ndarray:
    """Rotor forces (2, 4) that a level pair at rest is given for a vertical command."""
    still = np.zeros(3)
    state = start_state(config, still, still, still, np.array(0.0175), np.array(0.0))
    return make_battery_autopilot(config)(
        state, np.array([[0.0, 0.0, vertical]] * 2), battery_load(volts, uncompensated)
    )[1]


class TestBattery:
    def test_compensated_force_is_the_commands_until_the_battery_has_no_more(self) -> None:
        config = preset("flight")
        weight = 0.03775 * 9.81 / 4
        for volts in (4.2, 3.7, 3.2):
            # Whole units of command: 1e-5 of hover.
            assert asked(config, volts, 0.0, 0.0) == pytest.approx(np.full((2, 4), weight), rel=2e-5)
        empty = asked(config, 2.7, 0.0, 0.0)
        most = float(motors.force(motors.MOTORS["2.1"], np.array(65535.0), np.array(2.7)))
        assert empty == pytest.approx(np.full((2, 4), most), rel=1e-9)
        assert most < weight

    def test_without_compensation_force_falls_with_the_battery(self) -> None:
        config = preset("flight")
        forces = [float(asked(config, volts, 1.0, 0.0).mean()) for volts in (4.2, 3.7, 3.2)]
        command = round(hover(with_curve(config, OLDER))[0])
        for volts, force in zip((4.2, 3.7, 3.2), forces, strict=True):
            assert force == pytest.approx(
                float(motors.force(motors.MOTORS["2.1"], np.array(float(command)), np.array(volts))), rel=1e-4
            )
        assert forces[0] / forces[2] > 1.4

    def test_an_integral_that_hovers_a_drawn_world_hovers_it(self) -> None:
        """`hover_commands` give each drone its share of the weight, whatever battery and firmware."""
        config, resets = preset("flight"), ResetDistribution(preset("flight"))
        for volts, uncompensated, scale in ((3.3, 1.0, (0.95, 1.05)), (4.1, 1.0, (1.0, 0.9)), (3.7, 0.0, (0.97, 1.1))):
            parts = (jnp.array([volts]), jnp.array([uncompensated]), jnp.array([scale]))
            command = np.asarray(resets.hover_commands(jnp.array(0.0175), *parts))[0]
            still = np.zeros(3)
            state = start_state(config, still, still, still, np.array(0.0175), np.array(0.0))
            commands = np.array([[0.0, 0.0, one] for one in command])
            force = (
                make_battery_autopilot(config)(state, commands, battery_load(volts, uncompensated))[1]
                * np.array(scale)[:, None]
            )
            # float32 and whole units of command
            assert force == pytest.approx(np.full((2, 4), 0.03775 * 9.81 / 4), rel=1e-4)


class TestDrawnWorlds:
    @pytest.mark.slow
    def test_every_world_can_be_flown(self) -> None:
        config = preset("flight")
        env = TransportEnv(config, "newton-euler")
        state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(3), 512))
        load = state.pipeline_state.load
        # Some candidates of the others are refused.
        assert 0.8 < float(load.uncompensated.mean()) / config.scenario.uncompensated_probability < 1.3
        assert float(load.battery.min()) >= 3.2
        assert float(load.battery.max()) <= 4.2
        resets = ResetDistribution(config)
        flyable = jax.vmap(
            lambda one: resets.flyable(
                one.object_mass, one.battery[None], one.uncompensated[None], one.thrust_scale[None]
            )[0]
        )
        good = jax.jit(flyable)(load)
        assert bool(good.all())

    def test_a_drone_too_weak_for_its_share_is_refused(self) -> None:
        resets = ResetDistribution(preset("flight"))
        cap = 0.12 * 60000 / 65535
        need = (1 + LIFT) * 0.03775 * 9.81 / 4 / cap  # factor on the force with which it just can
        for factor, fine in ((need + 0.002, True), (need - 0.002, False)):
            scale = jnp.array([[1.0, factor]])
            command = resets.flyable(jnp.array(0.0175), jnp.array([4.0]), jnp.array([0.0]), scale)
            assert bool(command[0]) is fine

    def test_other_presets_draw_no_battery(self) -> None:
        env = TransportEnv(preset("balance"), "newton-euler")
        load = jax.eval_shape(env.reset, jax.random.PRNGKey(0)).pipeline_state.load
        assert load.battery is None
        assert load.uncompensated is None


def test_rate_share_is_a_factor_on_all_rate_gains() -> None:
    autopilot = preset("flight").autopilot
    halved = dataclasses.replace(
        autopilot,
        **{
            name: tuple(0.5 * gain for gain in getattr(autopilot, name))
            for name in ("roll_rate", "pitch_rate", "yaw_rate")
        },
    )
    euler, rates = np.array([0.02, -0.03, 0.1]), np.array([0.1, 0.2, -0.1])
    loops = crazyflie.start_loops(euler, rates)
    setpoint = np.array([3.0, -2.0, 0.0, 45000.0])
    mine = crazyflie.cascade(autopilot, loops, setpoint, euler, rates, rate_share=np.array([0.5]))
    theirs = crazyflie.cascade(halved, loops, setpoint, euler, rates)
    for one, other in zip(mine, theirs, strict=True):
        np.testing.assert_allclose(one, other, atol=1.0)  # truncation to whole units
