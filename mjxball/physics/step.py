"""One control step of the plant: attitude loops, rotor lag and the integrator, the same for every engine."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from mjxball.config import Config
from mjxball.control import attitude, crazyflie, mixer, rotations
from mjxball.control.constants import plant_constants
from mjxball.physics import motion
from mjxball.physics.engine import Engine, Load, PlantState, Wrench

Array = Any
# control_step(state, commands (..., 2, 3) of leader and follower, load) -> state one control period later
ControlStep = Callable[[PlantState, Array, Load], PlantState]
# autopilot(state, commands, load) -> (loops, rotor forces asked for)
Autopilot = Callable[[PlantState, Array, Load], tuple[Any, Array]]
# repeat(body, count, value): apply `body` to `value` `count` times
Repeat = Callable[[Callable[[PlantState], PlantState], int, PlantState], PlantState]


def python_repeat(body: Callable[[PlantState], PlantState], count: int, value: PlantState) -> PlantState:
    """Apply `body` `count` times in a Python loop."""
    for _ in range(count):
        value = body(value)
    return value


def make_control_step(config: Config, engine: Engine, repeat: Repeat = python_repeat) -> ControlStep:
    """Return the function that advances the plant one control period with commands held.

    Each physics step samples the attitude loop, moves the rotors' first-order lag exactly (its mean force
    acts over the step), and integrates drift-kick-drift: half a step of motion, the accelerations there,
    the velocities, half a step of motion. One evaluation of the accelerations; second order in the step for
    forces that depend on position and time, first order for the small ones that depend on velocity and for
    the sampling of the attitude loop.
    """
    plant = config.plant
    constants = plant_constants(plant, config.attitude)
    h = config.physics_step
    nominal = math.exp(-h / plant.rotor_lag)  # share of the old rotor force left after a step
    accelerate = make_accelerations(config, engine)

    autopilot = make_autopilot(config)

    def physics_step(state: PlantState, commands: Array, load: Load) -> PlantState:
        xp = commands.__array_namespace__()
        loops, target = autopilot(state, commands, load)
        keep, mean = nominal, plant.rotor_lag / h * (1 - nominal)  # `mean`: its mean share over the step
        if load.rotor_lag_scale is not None:
            lag = (plant.rotor_lag * load.rotor_lag_scale)[..., None, None]
            keep = xp.exp(-h / lag)
            mean = lag / h * (1 - keep)
        if load.thrust_scale is not None:
            target = target * load.thrust_scale[..., None]
        acting = target + mean * (state.rotor_force - target)
        middle = _drift(state, h / 2)
        rotors = total_wrench(xp, acting, constants.mounts, plant.arm, plant.yaw_per_thrust, plant.layout)
        wrench = pushed(rotors, middle, load)
        linear, angular, ball = accelerate(middle, wrench, load)
        kicked = middle._replace(
            velocity=state.velocity + h * linear,
            rates=state.rates + h * angular,
            rotor_force=target + keep * (state.rotor_force - target),
            ball_rate=state.ball_rate + h * ball,
            loops=loops,
        )
        return _drift(kicked, h / 2)

    def control_step(state: PlantState, commands: Array, load: Load) -> PlantState:
        return repeat(lambda s: physics_step(s, commands, load), config.timing.physics_steps, state)

    return control_step


def make_accelerations(config: Config, engine: Engine) -> Callable[[PlantState, Wrench, Load], tuple[Array, ...]]:
    """Return `accelerate(state, wrench, load)` -> (linear, angular, ball), whatever way the CG moves.

    The ball's acceleration (...) is 0 for prescribed motions, whose offset is a function of time alone.
    """
    if config.motion.kind == "rolling":
        force = motion.make_rolling_force(config)

        def roll(state: PlantState, wrench: Wrench, load: Load) -> tuple[Array, ...]:
            mass = motion.object_mass(state.time, load)
            on_ball = force(state.ball_offset, state.ball_rate, config.plant.moving_fraction * mass)
            return engine.rolling(state, wrench, mass, on_ball, load.added_inertia)

        return roll
    prescribed = motion.make_prescribed(config)

    def follow(state: PlantState, wrench: Wrench, load: Load) -> tuple[Array, ...]:
        mass = motion.object_mass(state.time, load)
        cg = prescribed(state.time, load)
        linear, angular = engine.prescribed(state, wrench, mass, cg, load.added_inertia)
        return linear, angular, state.ball_rate.__array_namespace__().zeros_like(state.ball_rate)

    return follow


def make_cg_offset(config: Config) -> Callable[[PlantState, Load], Array]:
    """Return `cg_offset(state, load)` (...) [m], where the CG is now."""
    if config.motion.kind == "rolling":
        return lambda state, load: config.plant.moving_fraction * state.ball_offset
    prescribed = motion.make_prescribed(config)
    return lambda state, load: prescribed(state.time, load).offset


def rotor_targets(config: Config, constants: Any, state: PlantState, commands: Array, believed_mass: Array) -> Array:
    """Rotor forces (..., 2, 4) [N] that both attitude loops ask for at `commands` (..., 2, 3)."""
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

    def firmware(state: PlantState, commands: Array, load: Load) -> tuple[Array, Array]:
        xp, law, gravity = commands.__array_namespace__(), config.autopilot, config.plant.gravity
        own, share = (xp.asarray(value, dtype=state.rates.dtype) for value in (constants.drone_mass, constants.share))
        sent = crazyflie.setpoints(law, commands, own + share * load.believed_mass[..., None], gravity)
        euler = rotations.euler_from_matrix(rotations.matrix_from_quaternion(state.quaternion))
        euler, rates = (xp.broadcast_to(vector[..., None, :], commands.shape) for vector in (euler, state.rates))
        integrals = crazyflie.integral_shares(xp, law, state.rates.dtype)
        loops, motors = crazyflie.cascade(law, state.loops, sent, euler, rates, integrals)
        left = xp.maximum(1.0 - law.sag * state.time, xp.zeros_like(state.time))[..., None, None]
        return loops, left * crazyflie.motor_force(law.motor_curve, motors)

    return firmware


def total_wrench(
    xp: Any, rotor_force: Array, mounts: Array, arm: float, yaw_per_thrust: float, layout: str = "plus"
) -> Wrench:
    """Wrench about O of all rotors, `rotor_force` (..., 2, 4) [N], drones at `mounts` (2, 3) [m]."""
    drones = mixer.wrench_from_rotors(rotor_force, arm, yaw_per_thrust, layout)  # (..., 2, 4)
    thrust = drones[..., 0]
    zero = xp.zeros_like(thrust[..., 0])
    lever_x, lever_y = (xp.asarray(mounts[:, i], dtype=rotor_force.dtype) for i in (0, 1))
    torque = drones[..., 0, 1:] + drones[..., 1, 1:]
    levers = xp.stack([_total(lever_y * thrust), -_total(lever_x * thrust), zero], axis=-1)
    return Wrench(xp.stack([zero, zero, _total(thrust)], axis=-1), torque + levers)


def pushed(wrench: Wrench, state: PlantState, load: Load) -> Wrench:
    """`wrench` with the force on O that the world exerts."""
    if load.push is None:
        return wrench
    matrix = rotations.matrix_from_quaternion(state.quaternion)
    return wrench._replace(force=wrench.force + rotations.rotate_back(matrix, load.push))


def _total(pair: Array) -> Array:
    return pair[..., 0] + pair[..., 1]


def hover_rotor_force(config: Config, believed_mass: Array) -> Array:
    """Rotor forces (..., 2, 4) [N] that hover the believed object mass (...) [kg] with the CG at O."""
    xp = believed_mass.__array_namespace__()
    constants = plant_constants(config.plant, config.attitude)
    own, share = (xp.asarray(value, dtype=believed_mass.dtype) for value in (constants.drone_mass, constants.share))
    per_rotor = (own + share * believed_mass[..., None]) * config.plant.gravity / 4
    per_rotor = xp.clip(per_rotor, 0.0, config.plant.rotor_force_max)
    return xp.stack([per_rotor] * 4, axis=-1)


def start_state(
    config: Config, position: Array, euler: Array, velocity: Array, believed_mass: Array, ball_offset: Array
) -> PlantState:
    """State at time 0 with the rotors at the believed hover thrust; `position`, `euler`, `velocity` (..., 3).

    A stand overrules what it locks: position and velocity (height and climb stay free with `heave`), pitch, yaw.
    """
    xp = position.__array_namespace__()
    if config.plant.stand != "free":
        free = xp.asarray([0.0, 0.0, float(config.plant.stand == "heave")], dtype=position.dtype)
        position, velocity = position * free, velocity * free
        euler = euler * xp.asarray([1.0, 0.0, 0.0], dtype=euler.dtype)
    loops = None
    if config.autopilot.kind == "crazyflie":
        both = xp.stack([euler, euler], axis=-2)
        loops = crazyflie.start_loops(both, xp.zeros_like(both))
    return PlantState(
        loops=loops,
        position=position,
        quaternion=rotations.quaternion_from_euler(euler),
        velocity=velocity,
        rates=xp.zeros_like(velocity),
        rotor_force=hover_rotor_force(config, believed_mass),
        time=xp.zeros_like(position[..., 0]),
        ball_offset=ball_offset,
        ball_rate=xp.zeros_like(ball_offset),
    )


def _drift(state: PlantState, h: float) -> PlantState:
    return state._replace(
        position=state.position + h * state.velocity,
        quaternion=rotations.integrate_quaternion(state.quaternion, h * state.rates),
        time=state.time + h,
        ball_offset=state.ball_offset + h * state.ball_rate,
    )
