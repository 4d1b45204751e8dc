"""One control step of the plant: autopilot, rotor lag and the integrator, the same for every engine."""

from __future__ import annotations

import contextlib
import functools
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from mjxball.arrays import Array, clipped
from mjxball.config import Config, Drone, Plant
from mjxball.control import crazyflie, rotations
from mjxball.errors import InputError
from mjxball.physics import aerodynamics, motion
from mjxball.physics.autopilot import Autopilot, carried_mass, make_autopilot
from mjxball.physics.engine import Engine, Load, PlantState, Wrench, total_wrench
from mjxball.plant import PlantParameters, plant_parameters
from mjxball.plant.rotors import lag_weights

if TYPE_CHECKING:
    from jaxtyping import Float

    from mjxball.physics.engine import Coordinates, Scalar, Vector

TRAINING_ENGINES = ("mjx", "newton-euler")  # on JAX
ENGINES = (*TRAINING_ENGINES, "mujoco")
# plant_step(state, commands (..., N, 3) of all drones, body axes, load) -> state one control period later: the commands
# are held, sensors and controllers are those of `sim.closed_loop`
PlantStep = Callable[[PlantState, Array, Load], PlantState]
# repeat(body, count, value): apply `body` to `value` `count` times
Repeat = Callable[[Callable[[PlantState], PlantState], int, PlantState], PlantState]


def python_repeat(body: Callable[[PlantState], PlantState], count: int, value: PlantState) -> PlantState:
    """Apply `body` `count` times in a Python loop."""
    for _ in range(count):
        value = body(value)
    return value


def jax_repeat(body: Callable[[PlantState], PlantState], count: int, value: PlantState) -> PlantState:
    """Apply `body` `count` times in one compiled loop."""
    import jax

    return jax.lax.scan(lambda carry, _: (body(carry), None), value, None, length=count)[0]


def make_plant_step(
    config: Config,
    engine: Engine,
    repeat: Repeat = python_repeat,
    parameters: PlantParameters | None = None,
    autopilot: Autopilot | None = None,
) -> PlantStep:
    """Return the function that advances the plant by one control period with commands held.

    `parameters` replace those of `config.plant`; the engine must have the same. `autopilot` replaces the one that
    `config` names; commands are then those that it takes.

    Each physics step samples the attitude loop, advances the rotors' first-order lag exactly (its mean force acts over
    the step), and integrates drift-kick-drift: half a step of motion, the accelerations there, the velocities, half a
    step of motion. Accelerations are evaluated once. The step is of second order for forces that depend on position and
    time, and of first order for the small ones that depend on velocity and for the sampling of the attitude loop.
    """
    plant = config.plant
    params = plant_parameters(plant, config.attitude) if parameters is None else parameters
    h = config.physics_step
    accelerate = make_accelerations(config, engine, params)
    autopilot = autopilot or make_autopilot(config, params)

    def physics_step(state: PlantState, commands: Float[Array, "... drones 3"], load: Load) -> PlantState:
        if load.late is not None:
            number = state.ticks // 2 % config.timing.physics_steps
            before = (number < load.late)[..., None, None]
            commands = commands.__array_namespace__().where(before, load.last_commands, commands)
        loops, target = autopilot(state, commands, load)
        keep, mean = lag_weights(params.rotor_lag, load.rotor_lag_scale, h)
        if load.thrust_scale is not None:
            target = target * load.thrust_scale[..., None]
        if load.thrust_fade is not None:
            target = target * (1.0 - load.thrust_fade * state.time)[..., None, None]
        if load.stop_time is not None:
            target = target * (state.time[..., None] < load.stop_time)[..., None]
        acting = target + mean * (state.rotor_force - target)
        middle = _drift(state, h / 2)
        wrench = acting_wrench(plant, params, acting, middle, load)
        linear, angular, ball, *swing = accelerate(middle._replace(rotor_force=acting), wrench, load)
        kicked = middle._replace(
            velocity=state.velocity + h * linear,
            rates=state.rates + h * angular,
            rotor_force=target + keep * (state.rotor_force - target),
            ball_rate=state.ball_rate + h * ball,
            loops=loops,
        )
        if swing:
            kicked = kicked._replace(mount_rate=state.mount_rate + h * swing[0])
        return _drift(kicked, h / 2)

    def plant_step(state: PlantState, commands: Float[Array, "... drones 3"], load: Load) -> PlantState:
        return repeat(lambda s: physics_step(s, commands, load), config.timing.physics_steps, state)

    return plant_step


def make_accelerations(
    config: Config, engine: Engine, parameters: PlantParameters | None = None
) -> Callable[[PlantState, Wrench, Load], tuple[Array, ...]]:
    """Return `accelerate(state, wrench, load)` -> accelerations (linear, angular, ball) for any kind of CG motion.

    The ball's acceleration is 0 for prescribed motions, whose offset is a function of time alone. That of elastic
    mounts follows, see `Engine`.
    """
    params = plant_parameters(config.plant, config.attitude) if parameters is None else parameters
    share = params.moving_fraction
    if config.motion.kind == "rolling":
        force = motion.make_rolling_force(config, params)

        def roll(state: PlantState, wrench: Wrench, load: Load) -> tuple[Array, ...]:
            mass = motion.object_mass(state.time, load)
            on_ball = force(state.ball_offset, state.ball_rate, share * mass)
            return engine.rolling(state, wrench, mass, on_ball, load.added_inertia)

        return roll
    cg_motion = motion.make_cg_motion(config)

    def follow(state: PlantState, wrench: Wrench, load: Load) -> tuple[Array, ...]:
        mass = motion.object_mass(state.time, load)
        cg = cg_motion(state.time, load)
        linear, angular, *swing = engine.prescribed(state, wrench, mass, cg, load.added_inertia)
        return linear, angular, state.ball_rate.__array_namespace__().zeros_like(state.ball_rate), *swing

    return follow


def make_cg_offset(config: Config) -> Callable[[PlantState, Load], Coordinates]:
    """Return `cg_offset(state, load)`, the present offset of the CG from O along the load's directions [m]."""
    if config.motion.kind == "rolling":
        return lambda state, load: config.plant.moving_fraction * state.ball_offset
    cg_motion = motion.make_cg_motion(config)
    return lambda state, load: cg_motion(state.time, load).offset


def acting_wrench(
    plant: Plant, parameters: PlantParameters, rotor_force: Float[Array, "... drones 4"], state: PlantState, load: Load
) -> Wrench:
    """Wrench of rotors with `rotor_force` [N], of the air, and of the external force on O."""
    wrench = total_wrench(plant, parameters, rotor_force, aerodynamics.effects(parameters, state, load))
    if load.external_force is None:
        return wrench
    matrix = rotations.matrix_from_quaternion(state.quaternion)
    return wrench._replace(force=wrench.force + rotations.rotate_back(matrix, load.external_force))


def hover_rotor_force(
    config: Config, believed_mass: Scalar, parameters: PlantParameters | None = None
) -> Float[Array, "... drones 4"]:
    """Rotor forces [N] that hover with an object of `believed_mass` [kg] and the CG at O."""
    xp = believed_mass.__array_namespace__()
    params = plant_parameters(config.plant, config.attitude) if parameters is None else parameters
    per_rotor = carried_mass(params, believed_mass) * params.gravity / 4
    per_rotor = clipped(per_rotor, 0.0, params.rotor_force_max)
    return xp.stack([per_rotor] * 4, axis=-1)


def start_state(
    config: Config,
    position: Vector,
    euler: Vector,
    velocity: Vector,
    believed_mass: Scalar,
    ball_offset: Coordinates,
    parameters: PlantParameters | None = None,
) -> PlantState:
    """State at time 0 with the rotors at hover thrust for `believed_mass`.

    A stand sets to 0 what it locks: position and velocity (height and climb stay free with `heave`), pitch, yaw.
    """
    xp = position.__array_namespace__()
    if config.plant.stand != "free":
        free = xp.asarray([0.0, 0.0, float(config.plant.stand == "heave")], dtype=position.dtype)
        position, velocity = position * free, velocity * free
        euler = euler * xp.asarray([1.0, 0.0, 0.0], dtype=euler.dtype)
    loops = None
    if config.autopilot.kind == "crazyflie":
        each = xp.stack([euler] * config.plant.count, axis=-2)
        loops = crazyflie.start_loops(each, xp.zeros_like(each))
    still = xp.zeros((*position.shape[:-1], config.plant.count, 2)) if config.plant.mount_frequency else None
    return PlantState(
        loops=loops,
        mount_angle=still,
        mount_rate=still,
        position=position,
        quaternion=rotations.quaternion_from_euler(euler),
        velocity=velocity,
        rates=xp.zeros_like(velocity),
        rotor_force=hover_rotor_force(config, believed_mass, parameters),
        ticks=xp.zeros_like(position[..., 0], dtype=xp.int32),
        time=xp.zeros_like(position[..., 0]),
        ball_offset=ball_offset,
        ball_rate=xp.zeros_like(ball_offset),
    )


def _drift(state: PlantState, h: float) -> PlantState:
    ticks, mount_angle = state.ticks + 1, cast(Array, state.mount_angle)
    return state._replace(
        position=state.position + h * state.velocity,
        quaternion=rotations.integrate_quaternion(state.quaternion, h * state.rates),
        ticks=ticks,
        time=h * ticks.__array_namespace__().astype(ticks, state.time.dtype),
        ball_offset=state.ball_offset + h * state.ball_rate,
        mount_angle=None if state.mount_rate is None else mount_angle + h * state.mount_rate,
    )


def make_numpy_plant_step(config: Config, physics: str, parameters: PlantParameters | None = None) -> PlantStep:
    """Return an engine's step for batches (n, ...) of NumPy float64 arrays; raise InputError for an unknown engine.

    `parameters` (n, ...) of the closed form are those of each flight's plant, all of the `structure` of `config`.
    """
    if physics == "mujoco":
        from mjxball.physics.mujoco import make_engine

        return make_plant_step(config, make_engine(config.plant, config.attitude, config.physics_step))
    if physics not in ENGINES:
        raise InputError(f"unknown physics {physics!r}; choose from {', '.join(ENGINES)}")
    return _compiled_step(config, physics, parameters)


def make_jax_plant_step(config: Config, physics: str, parameters: PlantParameters | None = None) -> PlantStep:
    """Return the step of the engine `physics`, mjx or newton-euler, for one world on JAX; use `jax.vmap` for many.

    `parameters`: those of the world's plant, if they are not those of `config.plant`.
    """
    from mjxball.physics.newton_euler import make_engine as make

    if physics == "mjx":
        from mjxball.physics.mjx import make_engine as make  # takes a second to import
    return make_plant_step(config, make(config.plant, config.attitude, parameters), jax_repeat, parameters)


def _compiled_step(config: Config, physics: str, each: PlantParameters | None) -> PlantStep:
    alike = structure(config) if physics == "newton-euler" else None
    compiled = _compiled(alike or config, physics, alike is not None, 0 if each else None)
    parameters = each or plant_parameters(config.plant, config.attitude)

    def stepper(state: PlantState, commands: Any, load: Load) -> PlantState:
        import jax

        with jax.enable_x64(True), on_the_host():
            return PlantState(*compiled(parameters, state, commands, load)).each(np.asarray)

    return stepper


def structure(config: Config) -> Config | None:
    """What decides the program of a closed-form step whose parameters are arguments, so that one serves many plants.

    None where a program is of one plant: of Crazyflies, and of loads that follow samples.
    """
    if config.autopilot.kind != "ideal" or config.motion.kind == "waveform":
        return None
    plant = config.plant
    alike = Plant(
        drones=(Drone(),) * plant.count,
        leader=plant.leader,
        layout=plant.layout,
        stand=plant.stand,
        cg_axis=plant.cg_axis,
    )
    return Config(plant=alike, timing=config.timing, motion=config.motion, autopilot=config.autopilot)


@functools.lru_cache(maxsize=16)  # compiling takes seconds
def _compiled(config: Config, physics: str, shared: bool, axis: int | None) -> Any:
    """`step(parameters, state, commands, load)` for batches; `parameters` are constants of `config` unless `shared`.

    `axis` of the batch in `parameters`; None: all flights have the same.
    """
    import jax

    from mjxball.xla import enable_compilation_cache

    enable_compilation_cache()

    def step(parameters: PlantParameters, *arguments: Any) -> PlantState:
        return make_jax_plant_step(config, physics, parameters if shared else None)(*arguments)

    with jax.enable_x64(True), on_the_host():
        return jax.jit(jax.vmap(step, in_axes=(axis, 0, 0, 0)))


def on_the_host() -> AbstractContextManager[Any]:
    """Context in which JAX computes on the CPU: a GPU takes 4 ms for a control step of a few environments."""
    import jax

    try:
        return jax.default_device(jax.local_devices(backend="cpu")[0])
    except RuntimeError:  # the CPU backend is disabled
        return contextlib.nullcontext()
