"""The classical followers of two Crazyflies: gains by hand, a model that is the simulator's, flights that stay put."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from mjxball.baselines import crazyflie_lqg, linear, make_baseline, make_controller
from mjxball.baselines.assembly_model import assembly_model
from mjxball.baselines.crazyflie_model import Decay, linear_model
from mjxball.config import apply_overrides, preset, replace
from mjxball.control import crazyflie
from mjxball.control.constants import drone_loop, thrust_slopes
from mjxball.control.motors import OLDER, with_curve
from mjxball.errors import InputError
from mjxball.physics.step import hover_rotor_force, make_numpy_plant_step
from mjxball.sim.rollout import load_of, simulate_batch, start_of
from mjxball.sim.scenario import Scenario

# With the older curve, whose bend the controllers know of, and a leader whose integrals are its own.
FLIGHT = apply_overrides(
    with_curve(preset("flight"), OLDER),
    {
        "autopilot.drone": "",
        "autopilot.roll_rate": (937.0, 454.0, 28.1),
        "leader.kp": (1.0, 1.0, 4.0),
        "leader.kd": (1.6, 1.6, 3.5),
        "leader.ki": (0.1, 0.1, 2.0),
        "leader.integral_error_limit": (0.05, 0.05, 1e3),
        "leader.integral_lead_time": 0.0,
        "command.vertical_limit": 3.0,
        "follower.action_scale_tilt": 0.2,
        "follower.action_scale_vertical": 3.0,
        "scenario.leader_uses_measurements": False,
    },
)
STAND = preset("stand")
SPEEDS = (0.31, 1.0)
DEGREES = 180 / math.pi


def test_loop_of_one_drone_by_hand() -> None:
    """75.5 g at 45 994 of 65 535 on 0.0915 p^2 + 0.0677 p; four motors 46 mm / sqrt 2 from the axis, each by half."""
    p = 45_994 / 65_535
    torque = 4 * 0.046 / math.sqrt(2) / 2 * (2 * 0.0915 * p + 0.0677) / 65_535 * DEGREES
    loop = drone_loop(FLIGHT, 0)
    expected = (torque * 937 * 3.25, torque * 937, torque * 28.1, torque * 454)
    assert (loop.kp, loop.kd, loop.kdd, loop.integral_gain) == pytest.approx(expected, rel=1e-4)
    model = assembly_model(FLIGHT, "adaptive")
    assert (model.axes, model.kp[0]) == ((0,), loop.kp)
    inertia = 2 * 1.66e-5 + 2 * 0.029 * 0.15**2 + 0.01 * (0.3**2 + 0.01**2) / 12
    assert model.inertia[0] == pytest.approx(inertia, rel=1e-3)


def test_motors_that_work_apart_lift_besides() -> None:
    command, output = 46_000.0, 20_000.0
    motors = crazyflie.mix(np.array(command), np.array([output, 0.0, 0.0]))
    curve = FLIGHT.autopilot.motor_curve
    more = crazyflie.motor_force(curve, motors).sum() - 4 * crazyflie.motor_force(curve, np.array(command))
    loop = drone_loop(FLIGHT, 0)
    torque = loop.kd / 937 / DEGREES * output
    assert loop.thrust_surplus * torque**2 == pytest.approx(more, rel=1e-9)
    assert drone_loop(replace(FLIGHT, "autopilot.motor_curve", (0.0, 0.18)), 0).thrust_surplus == 0


def test_thrust_per_acceleration() -> None:
    assert thrust_slopes(FLIGHT) == pytest.approx((0.03775, 0.03775))
    assert sum(thrust_slopes(STAND)) / 0.0755 == pytest.approx(0.32, abs=0.005)  # docs/hardware.md


def test_ball_on_the_stand_turns_with_five_sevenths_of_gravity() -> None:
    model = linear_model(STAND, Decay())
    assert "y" not in model.names
    row, column = model.names.index("load_rate"), model.names.index("roll")
    assert model.a[row, column] == pytest.approx(5 / 7 * 0.0075 * 9.81**2)


@pytest.mark.parametrize("command", [(0.05, 0.0), (0.0, 0.3)], ids=["roll", "vertical"])
def test_model_moves_as_the_simulator(command: tuple[float, float]) -> None:
    """A command stepped from hover, for 0.3 s: the model without delay against the full physics."""
    config, model = FLIGHT, linear_model(FLIGHT, Decay())
    scenario = Scenario(mass=0.0175, amplitude=0.0, goal=(0.0, 0.0, 0.0), seconds=1.0)
    state, load = start_of(config, [scenario]), load_of(config, [scenario])
    step = make_numpy_plant_step(config, "newton-euler")
    assert state.rotor_force == pytest.approx(hover_rotor_force(config, load.believed_mass))
    transition, drive = linear.discretise(model.a, model.b, config.timing.control_period)
    x = np.zeros(len(model.names))
    for _ in range(30):
        known = dict(zip(model.names, x, strict=True))
        controller = config.leader
        roll = (controller.kp[1] * known["y"] + controller.kd[1] * known["vy"]) / 9.81
        vertical = (
            controller.ki[2] * known["leader_integral"]
            - controller.kp[2] * known["height"]
            - controller.kd[2] * known["climb"]
        )
        told = np.array([[[roll, 0.0, vertical], [command[0], 0.0, command[1]]]])
        state = step(state, told, load)
        x = transition @ x + drive @ np.array(command)
    found = dict(zip(model.names, x, strict=True))
    # The rate loop's derivative is of the last 2 ms and setpoints are held for 10 ms, motors are curved: a tenth.
    assert found["roll"] == pytest.approx(2 * math.asin(state.quaternion[0, 1]), rel=0.12)
    assert found["rate"] == pytest.approx(state.rates[0, 0], rel=0.12)
    # What curved motors lift besides is of second order, and 5 mm/s here.
    assert found["climb"] == pytest.approx(state.velocity[0, 2], rel=0.12, abs=6e-3)


def test_riccati_solution_is_that_of_scipy() -> None:
    random = np.random.default_rng(0)
    a, b, root = random.normal(size=(5, 5)), random.normal(size=(5, 2)), random.normal(size=(5, 5))
    q, r = root @ root.T, np.diag([0.5, 2.0])
    np.testing.assert_allclose(linear.riccati(a, b, q, r), solve_discrete_are(a, b, q, r), rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("config", [FLIGHT, STAND], ids=["flight", "stand"])
def test_filter_and_loop_are_stable(config) -> None:
    own = crazyflie_lqg.design(config, crazyflie_lqg.Tuning())
    n, change = len(own.transition), own.change
    error = (np.eye(n) - own.gain @ own.measured) @ own.transition
    # On the stand one mode, a sum that leader and ball conserve, neither grows nor decays.
    assert np.abs(np.linalg.eigvals(error)).max() < 1 + 1e-9
    whole = np.block([[own.transition, own.drive], [np.zeros((2, n)), np.eye(2)]])
    closed = whole - np.vstack([own.drive, np.eye(2)]) @ change
    assert np.abs(np.linalg.eigvals(closed)).max() < 1 + 1e-9


@pytest.fixture(scope="module")
def sway() -> dict[str, np.ndarray]:
    """Largest |e_y| [m] from 20 s on at SPEEDS, the CG swinging 34 mm, nothing disturbed."""
    common = {"amplitude": 0.034, "mass": 0.0175, "goal": (0.5, 0.5, 0.5), "seconds": 30.0}
    scenarios = [Scenario(omega=speed, **common) for speed in SPEEDS]
    names = ("copy", "adaptive", "oracle", "lqg")
    flown = simulate_batch(FLIGHT, [(make_baseline(name, FLIGHT), scenarios) for name in names], "newton-euler")
    assert not flown.diverged.any()
    largest = np.abs(flown.error[flown.time >= 20, :, 1]).max(axis=0)
    return dict(zip(names, largest.reshape(len(names), len(scenarios)), strict=True))


@pytest.mark.parametrize(("name", "most"), [("adaptive", 0.2), ("oracle", 0.01), ("lqg", 0.03)])
@pytest.mark.slow
def test_flight_sways_less_than_copying(sway, name: str, most: float) -> None:
    assert (sway["copy"] > 0.4).all()
    assert (sway[name] < most).all()


@pytest.mark.slow
def test_lqg_brings_the_ball_back_on_the_stand() -> None:
    """Copying, the ball lies at its stop, 80 mm away."""
    start = Scenario(
        amplitude=0.0, mass=0.0175, goal=(0.0, 0.0, 0.0), seconds=30.0, ball_start=0.03, start_tilt=(0.03, 0.0)
    )
    flown = simulate_batch(STAND, [(make_baseline("lqg", STAND), [start])], "newton-euler")
    ball = np.abs(flown.cg_offset[:, 0]) / STAND.plant.moving_fraction
    assert ball[flown.time > 15].max() < 0.01
    assert ball.max() < 0.079


def test_what_does_not_fly_this_rig_says_so() -> None:
    with pytest.raises(InputError, match="ideal loops"):
        make_controller("pid", FLIGHT)
    with pytest.raises(InputError, match="along y"):
        make_controller("lqg", replace(FLIGHT, "plant.cg_axis", "x"))
