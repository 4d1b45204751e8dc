"""What flies each drone: the ideal attitude loop, or a Crazyflie's firmware with its motors and battery."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from mjxball.config import Config
from mjxball.control import attitude, crazyflie, motors, rotations
from mjxball.control.constants import plant_constants
from mjxball.physics.engine import Array, Load, PlantState

if TYPE_CHECKING:
    from jaxtyping import Float

    from mjxball.physics.engine import Scalar

# autopilot(state, commands, load) -> (loops, rotor forces asked for)
Autopilot = Callable[[PlantState, Array, Load], tuple[Any, Array]]
USUAL_BATTERY = 3.7  # [V] in hover, where none is drawn


def rotor_targets(
    config: Config, constants: Any, state: PlantState, commands: Float[Array, "... 2 3"], believed_mass: Scalar
) -> Float[Array, "... 2 4"]:
    """Rotor forces [N] that both attitude loops ask for at `commands`."""
    xp = commands.__array_namespace__()
    plant = config.plant
    euler = rotations.euler_from_matrix(rotations.matrix_from_quaternion(state.quaternion))
    own, share = (xp.asarray(value, dtype=state.rates.dtype) for value in (constants.drone_mass, constants.share))
    return attitude.rotor_commands(
        commands,
        euler[..., None, :],
        state.rates[..., None, :],
        own + share * believed_mass[..., None],
        constants.gains,
        plant.gravity,
        plant.arm,
        plant.yaw_per_thrust,
        plant.rotor_force_max,
        plant.layout,
    )


def make_autopilot(config: Config) -> Autopilot:
    """Return `autopilot(state, commands (..., 2, 3), load)` -> (loops, rotor forces (..., 2, 4) asked for [N])."""
    constants = plant_constants(config.plant, config.attitude)
    if config.autopilot.kind == "ideal":
        return lambda state, commands, load: (
            state.loops,
            rotor_targets(config, constants, state, commands, load.believed_mass),
        )

    powered = make_powered(config)

    def firmware(
        state: PlantState, commands: Float[Array, "... 2 3"], load: Load
    ) -> tuple[Float[Array, "... 2 13"], Float[Array, "... 2 4"]]:
        if load.battery is not None:
            return powered(state, commands, load)
        if config.autopilot.drone and motors.compensates(config.autopilot.motor_curve):
            # A motor gives more than a thrust command of 65 535 where the battery has it: full PWM is the limit.
            usual = commands[..., 0, 0] * 0.0
            return powered(state, commands, load._replace(battery=usual + USUAL_BATTERY, uncompensated=usual))
        xp, law, gravity = commands.__array_namespace__(), config.autopilot, config.plant.gravity
        own, share = (xp.asarray(value, dtype=state.rates.dtype) for value in (constants.drone_mass, constants.share))
        sent = crazyflie.setpoints(law, commands, own + share * load.believed_mass[..., None], gravity)
        euler = rotations.euler_from_matrix(rotations.matrix_from_quaternion(state.quaternion))
        euler, rates = (xp.broadcast_to(vector[..., None, :], commands.shape) for vector in (euler, state.rates))
        integrals = crazyflie.integral_shares(xp, law, state.rates.dtype)
        loops, duty = crazyflie.cascade(law, state.loops, sent, euler, rates, integrals)
        left = xp.maximum(1.0 - law.sag * state.time, xp.zeros_like(state.time))[..., None, None]
        return loops, left * crazyflie.motor_force(law.motor_curve, duty)

    return firmware


def make_powered(config: Config) -> Autopilot:
    """The firmware's loops with motors that follow the battery, `load.battery`, with or without its compensation.

    Where `load.uncompensated`, what the firmware is sent and its gains are converted for its curve
    (`motors.with_curve`), as the runner does.
    """
    constants = plant_constants(config.plant, config.attitude)
    law, gravity = config.autopilot, config.plant.gravity
    motor = motors.MOTORS[law.drone or "2.1"]
    uncompensated_law = motors.with_curve(config, motors.OLDER).autopilot
    slower = uncompensated_law.roll_rate[0] / law.roll_rate[0]
    line = motors.compensates(law.motor_curve)

    def powered(
        state: PlantState, commands: Float[Array, "... 2 3"], load: Load
    ) -> tuple[Float[Array, "... 2 13"], Float[Array, "... 2 4"]]:
        xp = commands.__array_namespace__()
        own, share = (xp.asarray(value, dtype=state.rates.dtype) for value in (constants.drone_mass, constants.share))
        carried = own + share * load.believed_mass[..., None]
        uncompensated: Array = load.uncompensated
        volts: Array = load.battery
        old, battery = uncompensated[..., None, None] > 0, volts[..., None, None]
        sent = xp.where(
            old,
            crazyflie.setpoints(uncompensated_law, commands, carried, gravity),
            crazyflie.setpoints(law, commands, carried, gravity),
        )
        euler = rotations.euler_from_matrix(rotations.matrix_from_quaternion(state.quaternion))
        euler, rates = (xp.broadcast_to(vector[..., None, :], commands.shape) for vector in (euler, state.rates))
        integrals = crazyflie.integral_shares(xp, law, state.rates.dtype)
        rate_share = 1.0 + (slower - 1.0) * uncompensated[..., None, None]

        def duty(command: Array) -> Array:
            return xp.where(old, command, motors.compensated(motor, command, battery)) if line else command

        loops, pwm = crazyflie.cascade(law, state.loops, sent, euler, rates, integrals, duty, rate_share)
        return loops, motors.force(motor, pwm, battery)

    return powered
