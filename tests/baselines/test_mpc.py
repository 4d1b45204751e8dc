"""Model-predictive control of pairs and teams: its LQR, its quadratic program, and what it does at limits."""

from __future__ import annotations

import dataclasses
import math

import jax
import numpy as np
import pytest
from scipy.optimize import minimize
from tables import rows

from batch import fly_compiled
from mjxball import config as configs
from mjxball.baselines import make_baseline, make_controller
from mjxball.baselines.hover_model import STATES
from mjxball.baselines.lqg import TILT_COST
from mjxball.baselines.mpc import BEYOND, BLOCKS, MASSES, Mpc, QuadraticProgram, limit_rows
from mjxball.baselines.mpc_design import MpcDesign, design, limits_of
from mjxball.config import Config, preset, with_plant
from mjxball.control.followers import PrivilegedInfo
from mjxball.control.observation import mount_angles
from mjxball.control.rotations import turned_about_z
from mjxball.errors import InputError
from mjxball.evaluate.metrics import measure_batch
from mjxball.plant.teams import ring_config
from mjxball.sim.disturbances import Disturbance
from mjxball.sim.rollout import simulate_batch
from mjxball.sim.scenario import CgPath, Scenario

PAPER, TEAM = preset("paper"), preset("team")
# Indices in the state: errors and rates of the CG, tilts, turn rates, torques over J, those of the load.
EX, EY, VX, VY, ROLL, PITCH, ROLL_RATE, PITCH_RATE, ROLLING, TORQUE, ROLL_LOAD, LOAD = 0, 1, 3, 4, *range(6, 12), 13, 14
TUNING, LIMITS = Mpc.tuning, limits_of(PAPER)
NOMINAL = MASSES.index(0.2)
HOVER = np.array([1.1 * 9.81 / 4])  # [N] of each rotor, with 0.2 kg


def controller() -> MpcDesign:
    return design(PAPER, TUNING, MASSES[NOMINAL])


def cost(own: MpcDesign, x: np.ndarray, corrections: np.ndarray) -> float:
    """Of errors, speeds and mean commands along x until the motion has died out, after `corrections` (k,) of pitch."""
    total = 0.0
    for step in range(1500):
        moved = np.array([0.0, corrections[step] if step < len(corrections) else 0.0, 0.0])
        command = own.feedback @ x + own.correction @ moved
        mean = 0.5 * (command + own.led @ x)[1]
        total += (x[EX] / TUNING.position) ** 2 + (x[VX] / TUNING.velocity) ** 2 + (mean / TILT_COST) ** 2
        x = own.transition @ x + own.drive @ command
    return total


def test_a_correction_costs_its_square_on_top_of_the_lqr() -> None:
    """J = x'Px + sum of W v^2: without limits the best v is none, and the controller the LQR."""
    own, random = controller(), np.random.default_rng(0)
    x, corrections = np.zeros(STATES), 0.1 * random.normal(size=20)
    x[[EX, VX, PITCH]] = 0.4, -0.2, 0.05
    more = cost(own, x, corrections) - cost(own, x, np.zeros(0))
    assert more == pytest.approx(own.cost[1] * (corrections**2).sum(), rel=1e-6)


@rows("plant", [PAPER, ring_config(TEAM, 3), with_plant(PAPER, "plate4")])
def test_within_the_limits_it_is_the_lqr(plant: Config) -> None:
    """Every follower's command, in body axes; of a team each sees them turned."""
    follower, mass = make_controller("mpc", plant), plant.plant.object_mass
    kind = round(10 * mass)
    own, seen, angles = follower.designs[kind], np.zeros(18), mount_angles(plant.plant)
    seen[12:15], seen[3:5] = (0.02, -0.01, 0.01), (0.005, -0.01)
    observation = seen if angles is None else turned_about_z(np.tile(seen, (len(angles), 1)), -angles)
    still = np.zeros(observation.shape[:-1])
    state = follower.start(observation)
    _, command = follower.step(state, observation, PrivilegedInfo(still + mass, still, still, still))
    # Nothing was commanded before, and measurements are taken to be a step old.
    x = own.transition @ np.reshape(state, (-1, state.shape[-1]))[0, : len(own.transition)]
    limits = limits_of(plant)
    hover = np.array([(limits.own_mass + limits.load_share * mass) * 9.81 / 4])
    assert not QuadraticProgram(own, limits, mass).broken(x[None], hover).any()
    expected = np.broadcast_to(own.feedback @ x, command.shape)
    np.testing.assert_allclose(
        command, expected if angles is None else turned_about_z(expected, -angles), rtol=1e-9, atol=1e-15
    )
    assert follower.solved == 0


@rows("drones", [3, 6])
def test_the_plan_expects_what_a_turned_team_does(drones: int) -> None:
    """Roll and pitch of a ring are one controller, turned, but for what uneven lifts turn: the leader is along x."""
    own = make_controller("mpc", ring_config(TEAM, drones)).designs[drones]
    along, across = [EX, VX, PITCH, PITCH_RATE, TORQUE], [EY, VY, ROLL, ROLL_RATE, ROLLING]
    signs = np.array([-1.0, -1.0, 1.0, 1.0, 1.0])  # pitch nose down drives along +x, roll along -y
    np.testing.assert_allclose(own.feedback[1, along], signs * own.feedback[0, across], rtol=1e-6)
    np.testing.assert_allclose(own.feedback[1, LOAD], own.feedback[0, ROLL_LOAD], rtol=1e-6)


def test_estimates_of_followers_that_measure_apart_are_forgotten() -> None:
    """Where all measure one motion, differences between them die out, for each mass of the object."""
    controller, apart = make_controller("mpc", ring_config(TEAM, 4)), []
    assert controller.delay == 1
    for own in controller.designs:
        kept = np.hstack([np.eye(STATES) - own.gain @ own.measured, np.zeros((STATES, 3))])
        sent = np.hstack([np.zeros((3, STATES)), np.eye(3)])  # the command before: measurements are taken to be late
        moved = own.transition @ kept + own.drive @ sent
        step = np.vstack([moved, own.feedback @ moved])
        apart.append(np.abs(np.linalg.eigvals(step)).max())
    assert max(apart) < math.exp(-0.02 / 20.0), apart  # with a time constant of at most 20 s


def test_the_program_is_solved_as_another_solver_does() -> None:
    """The same program with its slack eliminated, v'Wv + cost of what goes beyond, by L-BFGS."""
    own, random = controller(), np.random.default_rng(1)
    program, count = QuadraticProgram(own, LIMITS, MASSES[NOMINAL]), 3 * len(BLOCKS)
    states, rows, low, high, lifting = limit_rows(own, LIMITS, 1.1)
    weights = np.outer(BLOCKS, own.cost).ravel()
    scaled = np.maximum(np.linalg.norm(rows / np.sqrt(weights), axis=1), 1e-3)
    for _ in range(5):
        x = np.zeros(STATES)
        x[[EX, VX, PITCH, LOAD]] = random.uniform(-1, 1, 4) * (1.0, 0.5, 0.1, 0.2)
        taken = states @ x + HOVER[0] * lifting

        def value(v: np.ndarray, taken: np.ndarray = taken) -> tuple[float, np.ndarray]:
            at = rows @ v + taken
            beyond = (at - np.clip(at, low, high)) / scaled
            slope = weights * v + BEYOND * rows.T @ (beyond / scaled)
            return 0.5 * float(weights @ v**2 + BEYOND * beyond @ beyond), slope

        options = {"maxiter": 5000, "ftol": 1e-15, "gtol": 1e-10}
        best = minimize(value, np.zeros(count), jac=True, method="L-BFGS-B", options=options)
        first = program.corrections(x[None], HOVER)[0]
        np.testing.assert_allclose(first, best.x[:3], atol=1e-5)  # [rad]; [m/s2]: what L-BFGS leaves
    assert program.solved > 0


@rows("plant", [PAPER, ring_config(TEAM, 4)])
def test_limits_are_kept_that_the_lqr_breaks(plant: Config) -> None:
    """Half a metre away, on the linear model: tilt to 5 % of its limit, rotors but for a twentieth of the excess."""
    controller, limits, mass = make_controller("mpc", plant), limits_of(plant), plant.plant.object_mass
    kind = round(10 * mass)
    own, tuning = controller.designs[kind], controller.team_tuning if plant.plant.is_team else controller.tuning
    program, carried = QuadraticProgram(own, limits, MASSES[kind]), limits.own_mass + limits.load_share * mass
    hover = np.array([carried * 9.81 / 4])
    excess = []
    for follows in (False, True):
        x, tilts, forces = np.zeros(len(own.transition)), [], []
        x[EX] = 0.5
        for _ in range(150):
            first = program.corrections(x[None], hover)[0] if follows else np.zeros(3)
            command = own.feedback @ x + own.correction @ first
            torque = limits.kp * (command[:2] - x[[ROLL, PITCH]]) - limits.kd * x[[ROLL_RATE, PITCH_RATE]]
            forces.append(hover + limits.rotors @ np.array([carried * command[2], *torque]))
            tilts.append(abs(x[PITCH]))
            x = own.transition @ x + own.drive @ command
        assert (max(tilts) < 1.05 * tuning.tilt_limit) == follows
        excess.append(max(-np.min(forces), np.max(forces) - limits.rotor_force))
        assert abs(x[EX]) < 0.05
    assert excess[1] < 0.05 * excess[0]


@rows("drones", [2, 4])
@pytest.mark.slow
def test_a_team_takes_off_a_torque_and_a_mass_that_nobody_told(drones: int) -> None:
    """A load at rest aside, 20 % heavier than believed. All forget a little of what they estimate."""
    config = ring_config(TEAM, drones)
    mass = config.plant.object_mass
    scenario = Scenario(omega=0.0, phase=math.pi / 2, amplitude=0.03, path=CgPath(direction=0.7), mass=1.2 * mass)
    scenario = dataclasses.replace(scenario, believed_mass=mass, seconds=45.0)
    names = ("copy", "mpc")
    flown = simulate_batch(config, [(make_baseline(name, config), [scenario]) for name in names], "newton-euler")
    left = dict(zip(names, np.abs(flown.error[-1]).max(axis=-1), strict=True))
    assert left["copy"] > 0.1
    assert left["mpc"] < 0.05 * left["copy"], left


@pytest.fixture(scope="module")
def heavy() -> list[Scenario]:
    """Half a kilogram at 10 cm takes 85 % of what the follower's rotors have."""
    common = {"mass": 0.5, "amplitude": 0.1, "omega": 3.1, "seconds": 21.0}
    return [Scenario(**common), Scenario(**common, disturbance=Disturbance(noise=1.0, delay=0.04))]


def test_a_load_near_the_rotors_limits_does_not_throw_it_over(heavy) -> None:
    """Calm, and with noise and delay."""
    flown = simulate_batch(PAPER, [(make_baseline("mpc", PAPER), heavy)], "newton-euler")
    runs = measure_batch(flown, 2.5, PAPER.plant.rotor_force_max, 0)
    assert max(run.overshoot for run in runs) < 0.2


def test_a_jax_program_calls_it_back(heavy) -> None:
    """In float32: a millimetre."""
    follower = make_baseline("mpc", PAPER)
    batched = fly_compiled(PAPER, follower, heavy)
    recorded = simulate_batch(PAPER, [(follower, heavy)], "newton-euler")
    for mine, other in zip(batched, measure_batch(recorded, 2.5, PAPER.plant.rotor_force_max, 0), strict=True):
        assert mine.rmse == pytest.approx(other.rmse, abs=1e-3)
    assert follower.controller.solved > 100


def test_it_has_no_derivative() -> None:
    follower, zero = make_controller("mpc", PAPER), jax.numpy.zeros(())
    nobody = PrivilegedInfo(zero + 0.2, zero, zero, zero)

    def command(observation: jax.Array) -> jax.Array:
        return follower.step(follower.start(observation), observation, nobody)[1]

    with pytest.raises(InputError, match="no derivative"):
        jax.jacobian(command)(jax.numpy.zeros(18))


def test_what_it_cannot_do_is_refused_in_one_sentence() -> None:
    with pytest.raises(InputError, match="free pair along x"):
        make_controller("mpc", configs.replace(PAPER, "plant.cg_axis", "y"))
    light = dataclasses.replace(TEAM.plant.drones[1], mass=0.8)
    drones = (TEAM.plant.drones[0], light, *TEAM.plant.drones[2:])
    with pytest.raises(InputError, match="drones that are alike"):
        make_controller("mpc", dataclasses.replace(TEAM, plant=dataclasses.replace(TEAM.plant, drones=drones)))
