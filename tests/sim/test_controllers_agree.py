"""One function, one home: every function in `control/` gives the same on NumPy and on JAX."""

import inspect
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from euler_angles import matrix_from_euler
from tables import rows

from mjxball.baselines import CONTROLLERS as FOLLOWERS
from mjxball.baselines import make_controller
from mjxball.config import Autopilot, preset
from mjxball.control import attitude, crazyflie, leader, mixer, observation, rotations
from mjxball.control.followers import PrivilegedInfo
from mjxball.control.geometry import ring_geometry
from mjxball.control.network_interface import NetworkInterface
from mjxball.control.observation import ObservationHistory
from mjxball.plant import AttitudeGains
from mjxball.sim.follower import network_interface

WORLDS = 64
random = np.random.default_rng(7)


def normal(*shape: int) -> np.ndarray:
    return random.normal(size=(WORLDS, *shape))


# Roll within +-1 rad: at +-pi/2 the Euler angles are singular and no two roundings agree.
EULER = random.uniform(-1, 1, (WORLDS, 3))
MATRIX = matrix_from_euler(EULER)
QUATERNION = rotations.quaternion_from_euler(EULER)
HALF = normal(3, 3)
SYMMETRIC = HALF @ np.swapaxes(HALF, -1, -2) + 3 * np.eye(3)  # well conditioned, as inertias are
KP, KD, KI = (0.5, 0.4, 0.3), (1.0, 0.9, 0.8), (0.1, 0.0, 0.2)
GAINS = AttitudeGains((0.24, 3.22, 0.543), (0.0433, 0.579, 0.244))
MOUNT = np.array([-0.17, 0.0, 0.0])
LIMITS, REACH, G = (0.6, 6.0), (0.2, 2.0), 9.81
RECURRENT = network_interface(preset("team"))
GIVEN, STATE = random.uniform(1, 3, (WORLDS, 4)), random.uniform(-1, 1, (WORLDS, RECURRENT.units))
KEPT = 0.1 * normal(RECURRENT.size)
HISTORY = ObservationHistory(previous_action=True, filters=(0.1, 0.5))
SEEN, MEMORY, ACTION = normal(18), normal(HISTORY.size), random.uniform(-1, 1, (WORLDS, 3))
MASSES = random.uniform(0.1, 0.3, WORLDS)
TOTAL, THRUST = random.uniform(2.1, 2.3, WORLDS), np.linspace(0.8, 1.0, 2 * WORLDS).reshape(WORLDS, 2)
PRIVILEGED = PrivilegedInfo(
    *(MASSES, 0.01 * normal(), 0.01 * normal(), TOTAL, THRUST),
    moment_rate=0.01 * normal(),
    rotors=np.array([10.8, 0.0, 0.0]) + 0.1 * normal(2, 3),
    force=0.1 * normal(3),
    loop_scale=random.uniform(0.7, 2.0, WORLDS),
    loops=0.1 * normal(2, 13),
)
FLIGHT = 0.1 * normal(2, 18)  # two observations in a row


def flown(name: str, plant: str = "paper") -> Callable[..., Any]:
    """The commands (WORLDS, 2, 3) of a classical follower of the preset `plant` that is shown `FLIGHT`."""
    controller = make_controller(name, preset(plant))

    def commands(flight: Any, *privileged: Any) -> Any:
        memory, given = controller.start(flight[..., 0, :]), []
        for step in range(2):
            memory, command = controller.step(memory, flight[..., step, :], PrivilegedInfo(*privileged))
            given.append(command)
        return flight.__array_namespace__().stack(given, axis=-2)

    return commands


COMMANDS = random.uniform(0, 65535, (WORLDS, 4))
CASCADE = (
    np.concatenate([0.1 * normal(6), 20 * normal(7)], axis=-1),
    np.concatenate([5 * normal(3), random.uniform(1e4, 6e4, (WORLDS, 1)).round()], axis=-1),
    0.2 * EULER,
    0.1 * normal(3),
)

# name -> (function of arrays alone, its arrays). Clipping happens in some worlds and not in others.
FUNCTIONS: dict[str, tuple[Callable[..., Any], tuple[np.ndarray, ...]]] = {
    "rotations.rotate": (rotations.rotate, (MATRIX, normal(3))),
    "rotations.rotate_back": (rotations.rotate_back, (MATRIX, normal(3))),
    "rotations.cross": (rotations.cross, (normal(3), normal(3))),
    "rotations.turned_about_z": (rotations.turned_about_z, (normal(18), EULER[:, 2])),
    "matrix_from_euler": (matrix_from_euler, (EULER,)),
    "rotations.euler_from_matrix": (rotations.euler_from_matrix, (MATRIX,)),
    "rotations.matrix_from_quaternion": (rotations.matrix_from_quaternion, (QUATERNION,)),
    "rotations.multiply_quaternions": (rotations.multiply_quaternions, (QUATERNION, QUATERNION[::-1])),
    "rotations.quaternion_from_euler": (rotations.quaternion_from_euler, (EULER,)),
    "rotations.integrate_quaternion": (rotations.integrate_quaternion, (QUATERNION, 0.2 * EULER)),
    "rotations.solve_symmetric": (rotations.solve_symmetric, (SYMMETRIC, normal(3))),
    "rotations.dot": (rotations.dot, (normal(3), normal(3))),
    "rotations.conjugate": (rotations.conjugate, (QUATERNION,)),
    "rotations.tilt_of_quaternion": (rotations.tilt_of_quaternion, (QUATERNION,)),
    "rotations.roll_of_quaternion": (rotations.roll_of_quaternion, (QUATERNION,)),
    "leader.pid_command": (
        lambda *errors: leader.pid_command(*errors, (KP, KD, KI), G, *LIMITS),
        (normal(3), normal(3), normal(3)),
    ),
    "leader.command": (lambda a, yaw: leader.command(a, yaw, G, *LIMITS), (8 * normal(3), EULER[:, 2])),
    "leader.clip_command": (lambda c: leader.clip_command(c, *LIMITS), (normal(3),)),
    "mixer.wrench_from_rotors": (lambda f: mixer.wrench_from_rotors(f, 0.12, 0.02), (normal(4),)),
    "mixer.rotors_from_wrench": (lambda w: mixer.rotors_from_wrench(w, 0.12, 0.02), (normal(4),)),
    "mixer.turned": (lambda w: mixer.turned(w, 0.7), (normal(4),)),
    "mixer.wrench_from_rotors x": (lambda f: mixer.wrench_from_rotors(f, 0.046, 0.006, "x"), (normal(4),)),
    "mixer.rotors_from_wrench x": (lambda w: mixer.rotors_from_wrench(w, 0.046, 0.006, "x"), (normal(4),)),
    "crazyflie.to_firmware": (crazyflie.to_firmware, (EULER,)),
    "crazyflie.start_loops": (crazyflie.start_loops, (EULER, normal(3))),
    "crazyflie.motor_force": (lambda c: crazyflie.motor_force((0.0915, 0.0677), c), (COMMANDS,)),
    "crazyflie.motor_command": (lambda f: crazyflie.motor_command((0.0915, 0.0677), f), (COMMANDS / 4e5,)),
    "crazyflie.setpoints": (
        lambda a, m: crazyflie.setpoints(Autopilot(), a, m, G),
        (0.3 * ACTION, random.uniform(0.03, 0.04, WORLDS)),
    ),
    "crazyflie.cascade loops": (lambda *a: crazyflie.cascade(Autopilot(), *a)[0], CASCADE),
    "crazyflie.cascade motors": (lambda *a: crazyflie.cascade(Autopilot(), *a)[1], CASCADE),
    "crazyflie.mix": (crazyflie.mix, (COMMANDS[:, 0], 6e3 * normal(3))),
    "attitude.rotor_commands": (
        lambda c, e, w, m: attitude.rotor_commands(c, e, w, m, GAINS, G, 0.12, 0.02, 5.5),
        (ACTION, EULER, normal(3), random.uniform(0.9, 1.3, WORLDS)),
    ),
    "attitude.scaled_gains": (
        lambda s: attitude.scaled_gains(GAINS, s).kp + attitude.scaled_gains(GAINS, s).kd,
        (random.uniform(0.6, 4.0, WORLDS),),
    ),
    "observation.observe": (
        observation.observe,
        (normal(3), MATRIX, normal(3), normal(3), normal(3), np.array([-0.17, 0, 0])),
    ),
    "observation.own_state": (
        observation.own_state,
        (normal(3), MATRIX, normal(3), normal(3), np.array([-0.17, 0, 0])),
    ),
    "history.network_input": (HISTORY.network_input, (SEEN, MEMORY)),
    "history.start": (HISTORY.start, (SEEN,)),
    "history.next": (HISTORY.next, (MEMORY, SEEN, ACTION)),
    "observation.copy_command": (lambda s: observation.copy_command(s, KP, KD, G, *LIMITS), (3 * SEEN,)),
    "observation.repeats": (
        lambda seen, last: seen * observation.repeats(seen, last),
        (SEEN, SEEN[:, : observation.OWN_STATE] * (np.arange(WORLDS)[:, None] % 2)),
    ),
    "observation.scale_action": (lambda a: observation.scale_action(a, *REACH), (ACTION,)),
    "network_interface.command": (
        lambda a, s: NetworkInterface(HISTORY, REACH, LIMITS, KP, KD, G).command(a, s),
        (ACTION, 3 * SEEN),
    ),
    "network_interface.start": (RECURRENT.start, (SEEN, GIVEN)),
    "network_interface.next": (RECURRENT.next, (KEPT, SEEN, np.concatenate([ACTION, STATE], axis=-1))),
    "network_interface.network_input": (RECURRENT.network_input, (SEEN, KEPT)),
    "geometry.ring_geometry": (ring_geometry, (np.arange(WORLDS) % 5 + 2.0, normal(2))),
    **{f"baseline {name}": (flown(name), (FLIGHT, *PRIVILEGED)) for name in FOLLOWERS},
    **{
        f"baseline {name} {plant}": (flown(name, plant), (FLIGHT, *PRIVILEGED))
        for name, plant in (("adaptive", "flight"), ("oracle", "flight"), ("lqg", "flight"), ("lqg", "stand"))
    },
}
# Computed once in NumPy float64, from the config, not from arrays.
OTHERS = {
    "mixer.torque_per_force",
    "crazyflie.unpack",
    "crazyflie.cascade",
    "crazyflie.integral_shares",
    "observation.action_mask",
    "observation.mount_angles",
    "observation.mount_frames",
    "observation.observation_history",
    *(
        f"crazyflie.{name}"
        for name in ("gains_of", "pair_gains", "read_pair_gains", "gains_to_json", "with_gains", "with_stock_gains")
    ),
}
each_function = rows("name", FUNCTIONS)


def difference(first: Any, second: Any) -> float:
    """Largest difference over the full scale of the result."""
    first, second = np.asarray(first), np.asarray(second)
    assert first.shape == second.shape
    return np.abs(first - second).max() / (np.abs(second).max() or 1.0)  # `stay` commands nothing


def test_every_law_is_compared():
    public = {
        f"{module.__name__.rsplit('.', 1)[1]}.{name}"
        for module in (rotations, leader, mixer, attitude, observation, crazyflie)
        for name, member in inspect.getmembers(module, inspect.isfunction)
        if member.__module__ == module.__name__ and not name.startswith("_")
    }
    assert public - set(FUNCTIONS) == OTHERS


@each_function
def test_float64_agrees(name):
    function, arrays = FUNCTIONS[name]
    expected = function(*arrays)
    with jax.enable_x64(True):
        result = jax.jit(function)(*map(jax.numpy.asarray, arrays))
        assert result.dtype == np.float64
    # Both round to 1e-16; sin and cos of the two libraries differ by an ulp; a call back answers in float32.
    assert difference(result, expected) < (1e-5 if name == "baseline mpc" else 1e-10)


@each_function
def test_float32_agrees(name):
    function, arrays = FUNCTIONS[name]
    single = [array.astype(np.float32) for array in arrays]
    on_numpy = function(*single)
    on_jax = jax.jit(function)(*map(jax.numpy.asarray, single))
    assert on_numpy.dtype == on_jax.dtype == np.float32
    # float32 rounding, about 1e-5 of full scale; motors' and thrust's commands are whole numbers, of which rounding may
    # move one by 2. Quadratic programs amplify it twofold.
    coarse = ("crazyflie.cascade motors", "crazyflie.setpoints", "baseline mpc")
    tolerance = 2.5 / 65535 if name in coarse else 1e-5
    assert difference(on_jax, on_numpy) < tolerance
    assert difference(on_numpy, function(*arrays)) < tolerance


@each_function
def test_batch_equals_single(name):
    function, arrays = FUNCTIONS[name]
    batched = function(*arrays)
    single = function(*(array[5] if len(array) == WORLDS else array for array in arrays))
    # The same operations in the same order, but NumPy's vectorised sine may differ by an ulp.
    np.testing.assert_allclose(batched[5], single, rtol=1e-14, atol=1e-15)
