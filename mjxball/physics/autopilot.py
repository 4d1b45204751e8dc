"""Low-level control of each drone: the ideal attitude loop, or a Crazyflie's firmware with its motors and battery."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from mjxball.arrays import Array
from mjxball.config import Config
from mjxball.control import attitude, crazyflie, motors, rotations
from mjxball.physics.engine import Load, PlantState
from mjxball.physics.mounts import own_motion
from mjxball.plant import PlantParameters, plant_parameters

if TYPE_CHECKING:
    from jaxtyping import Float

    from mjxball.physics.engine import Scalar

# autopilot(state, commands, load) -> (loops, rotor forces asked for)
Autopilot = Callable[[PlantState, Array, Load], tuple[Any, Array]]


def rotor_targets(
    config: Config,
    parameters: PlantParameters,
    state: PlantState,
    commands: Float[Array, "... drones 3"],
    load: Load,
) -> Float[Array, "... drones 4"]:
    """Rotor forces [N] that all ideal attitude loops ask for at `commands` (roll, pitch, vertical acceleration)."""
    euler, rates, commands = estimated(parameters, state, commands, load)
    return attitude.rotor_commands(
        commands,
        euler,
        rates,
        carried_mass(parameters, load.believed_mass),
        parameters.gains if load.loop_scale is None else attitude.scaled_gains(parameters.gains, load.loop_scale),
        parameters.gravity,
        parameters.arm,
        parameters.yaw_per_thrust,
        parameters.rotor_force_max,
        config.plant.layout,
        parameters.yaw,
    )


def estimated(
    parameters: PlantParameters, state: PlantState, commands: Float[Array, "... drones 3"], load: Load
) -> tuple[Array, Array, Float[Array, "... drones 3"]]:
    """(roll, pitch, yaw as each drone estimates them, its body rates, `commands` in body axes as it flies them).

    On elastic mounts they have their own (`physics.mounts`), and those with turned mounts fly commands in turned axes.
    Where all are alike, the first two have an axis of 1 in place of N.
    """
    euler, rates = own_motion(state, parameters.yaw)
    if load.attitude_error is None:
        return euler, rates, commands
    return euler + load.attitude_error, rates, rotations.turned_about_z(commands, load.attitude_error[..., 2])


def carried_mass(parameters: PlantParameters, believed_mass: Scalar) -> Float[Array, "... drones"]:
    """Mass that each drone's hover thrust assumes: itself and its shares of the carrier and of the object [kg]."""
    xp, dtype = believed_mass.__array_namespace__(), believed_mass.dtype
    own, share = (xp.asarray(value, dtype=dtype) for value in (parameters.known_mass, parameters.load_share))
    return own + share * believed_mass[..., None]


def make_autopilot(config: Config, parameters: PlantParameters | None = None) -> Autopilot:
    """Return `autopilot(state, commands (..., N, 3), load)` -> (loops, rotor forces (..., N, 4) asked for [N])."""
    constants = plant_parameters(config.plant, config.attitude) if parameters is None else parameters
    if config.autopilot.kind == "ideal":
        return lambda state, commands, load: (
            state.loops,
            rotor_targets(config, constants, state, commands, load),
        )

    with_battery = make_battery_autopilot(config, constants)

    def firmware(
        state: PlantState, commands: Float[Array, "... drones 3"], load: Load
    ) -> tuple[Float[Array, "... drones 13"], Float[Array, "... drones 4"]]:
        if load.battery is not None:
            return with_battery(state, commands, load)
        if config.autopilot.drone and motors.compensates(config.autopilot.motor_curve):
            # A motor gives more than a thrust command of 65 535 where the battery has it: full PWM is the limit.
            zero = commands[..., 0, 0] * 0.0
            return with_battery(state, commands, load._replace(battery=zero + motors.USUAL_BATTERY, uncompensated=zero))
        xp, autopilot, gravity = commands.__array_namespace__(), config.autopilot, config.plant.gravity
        euler, rates, commands = estimated(constants, state, commands, load)
        sent = crazyflie.setpoints(autopilot, commands, carried_mass(constants, load.believed_mass), gravity)
        euler, rates = (xp.broadcast_to(each, commands.shape) for each in (euler, rates))
        integrals = crazyflie.integral_shares(xp, autopilot, state.rates.dtype, config.plant.count, config.plant.leader)
        loops, duty = crazyflie.cascade(autopilot, state.loops, sent, euler, rates, integrals)
        return loops, crazyflie.motor_force(autopilot.motor_curve, duty)

    return firmware


def make_battery_autopilot(config: Config, parameters: PlantParameters | None = None) -> Autopilot:
    """The firmware's loops with motors that follow the battery voltage `load.battery`, with or without compensation.

    Where `load.uncompensated` is 1, setpoints and gains are converted for the uncompensated motor curve
    (`motors.with_curve`), as the flight program does.
    """
    constants = plant_parameters(config.plant, config.attitude) if parameters is None else parameters
    autopilot, gravity = config.autopilot, config.plant.gravity
    motor = motors.MOTORS[autopilot.drone or "2.1"]
    older = motors.with_curve(config, motors.OLDER).autopilot
    slower = older.roll_rate[0] / autopilot.roll_rate[0]
    line = motors.compensates(autopilot.motor_curve)

    def with_battery(
        state: PlantState, commands: Float[Array, "... drones 3"], load: Load
    ) -> tuple[Float[Array, "... drones 13"], Float[Array, "... drones 4"]]:
        xp = commands.__array_namespace__()
        carried = carried_mass(constants, load.believed_mass)
        uncompensated: Array = load.uncompensated
        volts: Array = load.battery
        old, battery = uncompensated[..., None, None] > 0, volts[..., None, None]
        euler, rates, commands = estimated(constants, state, commands, load)
        sent = xp.where(
            old,
            crazyflie.setpoints(older, commands, carried, gravity),
            crazyflie.setpoints(autopilot, commands, carried, gravity),
        )
        euler, rates = (xp.broadcast_to(each, commands.shape) for each in (euler, rates))
        integrals = crazyflie.integral_shares(xp, autopilot, state.rates.dtype, config.plant.count, config.plant.leader)
        rate_share = 1.0 + (slower - 1.0) * uncompensated[..., None, None]

        def duty(command: Array) -> Array:
            return xp.where(old, command, motors.compensated(motor, command, battery)) if line else command

        loops, pwm = crazyflie.cascade(autopilot, state.loops, sent, euler, rates, integrals, duty, rate_share)
        return loops, motors.force(motor, pwm, battery)

    return with_battery
