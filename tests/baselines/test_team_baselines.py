"""Classical followers of teams: shares of a wrench, peaks beside copying's, noise, the order of drones, a loss."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from plants import team
from tables import rows, weekly

from batch import fly_compiled
from mjxball.baselines import make_baseline, make_controller
from mjxball.baselines.assembly_model import assembly_model
from mjxball.config import Attitude, Config, apply_overrides, preset, replace, with_plant
from mjxball.control.followers import PrivilegedInfo
from mjxball.errors import InputError
from mjxball.evaluate.metrics import Metrics, measure_batch
from mjxball.physics.engine import total_wrench
from mjxball.plant import plant_parameters
from mjxball.sim.disturbances import Disturbance
from mjxball.sim.rollout import simulate, simulate_batch
from mjxball.sim.scenario import CIRCLE, CgPath, Scenario

PAPER = preset("paper")
TEAMS = {name: with_plant(PAPER, name) for name in ("team3", "team4", "team6")}
LINE, ELLIPSE = CgPath(direction=0.7), CgPath(direction=0.5, width=0.5, lead=math.pi / 2)
FASTEST = 3.1
SPEEDS = (0.31, 1.0, FASTEST)
# Largest |e_o| from 20 s on [m] that each leaves of a CG that moves 5 cm; copying leaves 0.15 to 0.6 m of the slowest.
# What `adaptive` estimates fades: the slowest load is not cancelled completely.
MOST = {"adaptive": 0.08, "oracle": 0.002, "lqg": 0.02}


def flown(config: Config, names: list[str], scenarios: list[Scenario]) -> dict[str, list[Metrics]]:
    """Metrics of every follower's flights."""
    flights = simulate_batch(config, [(make_baseline(name, config), scenarios) for name in names], "newton-euler")
    found, count = measure_batch(flights, 2.5, config.plant.rotor_force_max, config.plant.leader), len(scenarios)
    return {name: found[number * count : (number + 1) * count] for number, name in enumerate(names)}


@pytest.mark.parametrize("name", [pytest.param("team6", marks=pytest.mark.slow), *weekly("team3", "team4")])
def test_what_is_left_of_a_load_that_moves_in_the_plane(name: str) -> None:
    config = TEAMS[name]
    scenarios = [
        Scenario(omega=speed, mass=config.plant.object_mass, path=path, seconds=26.0)
        for path in (CIRCLE, ELLIPSE, LINE)
        for speed in SPEEDS
    ]
    found = flown(config, ["copy", *MOST], scenarios)
    slow = [number for number, scenario in enumerate(scenarios) if scenario.omega == SPEEDS[0]]
    assert min(found["copy"][number].peak for number in slow) > 0.1
    for follower, most in MOST.items():
        worst = max(run.peak for run in found[follower])
        assert worst < most, (follower, worst)
    for number, run in enumerate(found["lqg"]):
        assert run.settling_time < 3.0
        assert number in slow or 7.0 < found["adaptive"][number].settling_time < 10.0


def test_estimates_do_not_drift_apart() -> None:
    """Each follower's could walk away from the others', which no motion shows until rotors reach their limits."""
    noisy = Scenario(mass=0.4, path=CIRCLE, seconds=26.0, disturbance=Disturbance(noise=1.0, delay=0.04))
    apart = [dataclasses.replace(noisy, disturbance=Disturbance(offset=1.0, seed=seed)) for seed in range(2)]
    found = flown(TEAMS["team4"], ["adaptive", "lqg"], [noisy, *apart])
    for name, most in (("adaptive", (0.06, 0.15, 0.15)), ("lqg", (0.03, 0.03, 0.03))):
        for run, peak in zip(found[name], most, strict=True):
            assert run.peak < peak, name
            assert run.rotor_limit_share < 0.02, name


@pytest.mark.parametrize("name", ["adaptive-mass", "lqg"])
def test_a_follower_of_a_team_uses_its_own_measurements_alone(name: str) -> None:
    """What another measures changes no command of its own, in any of twenty steps."""
    controller, random = make_controller(name, TEAMS["team4"]), np.random.default_rng(3)
    seen = 0.02 * random.standard_normal((20, 3, 18))
    other = seen.copy()
    other[:, 2] += 0.02 * random.standard_normal((20, 18))
    given = []
    for flight in (seen, other):
        state, commands = controller.start(flight[0]), []
        for observation in flight:
            state, command = controller.step(state, observation, PrivilegedInfo.of_believed(np.full(3, 0.4)))
            commands.append(command)
        given.append(np.array(commands))
    np.testing.assert_array_equal(given[0][:, :2], given[1][:, :2])
    assert np.abs(given[0][:, 2] - given[1][:, 2]).max() > 1e-3


@rows("seed", list(range(5)))
def test_shares_add_up_to_the_wrench_by_the_least_forces(seed: int) -> None:
    """The physics' wrench of all rotors changes by what is asked for; no other forces do it with less."""
    plant = dataclasses.replace(team(5, seed), leader=2, rotor_force_max=1e3)
    plant = dataclasses.replace(
        plant, drones=tuple(dataclasses.replace(drone, rotor_force_max=1e3) for drone in plant.drones)
    )
    config, random = dataclasses.replace(PAPER, plant=plant), np.random.default_rng(seed)
    model, constants = assembly_model(config, "adaptive"), plant_parameters(plant, Attitude())
    followers = list(plant.followers)
    wrench, carried = random.normal(size=3), random.uniform(1, 2, 5)
    for thrust in (None, np.array([1.0, 0.6, 1.0, 0.0, 0.8])):
        given = model.corrections(wrench, carried, thrust)
        asked = np.zeros((5, 3))
        asked[followers] = np.column_stack([carried[followers] * given[:, 2], given[:, :2] * model.kp])
        forces = _rotor_forces(asked, plant, constants)
        acting = forces if thrust is None else forces * thrust[:, None]
        found = total_wrench(plant, constants, acting)
        np.testing.assert_allclose([found.force[2], *found.torque[:2]], wrench, atol=1e-9)
        effect = _effect_of_rotors(plant, constants, thrust)
        least = np.linalg.lstsq(effect, wrench, rcond=None)[0]
        np.testing.assert_allclose((forces**2).sum(), (least**2).sum(), rtol=1e-9)


def _rotor_forces(asked: np.ndarray, plant, constants) -> np.ndarray:
    """(N, 4) for (lift, roll, pitch torque) (N, 3) in body axes and no yaw torque."""
    from mjxball.control import mixer

    wrench = mixer.turned(np.column_stack([asked, 0.0 * asked[:, 0]]), -constants.yaw)
    return mixer.rotors_from_wrench(wrench, constants.arm, constants.yaw_per_thrust, plant.layout)


def _effect_of_rotors(plant, constants, thrust: np.ndarray | None) -> np.ndarray:
    """(3, 4 F) lift and torque per force asked of each of the followers' rotors, of which no drone may yaw."""
    columns = []
    for number in plant.followers:
        for pattern in ([1, 1, 1, 1], [1, 0, -1, 0], [0, 1, 0, -1]):
            force = np.zeros((plant.count, 4))
            force[number] = np.array(pattern) / np.linalg.norm(pattern) * (1 if thrust is None else thrust[number])
            found = total_wrench(plant, constants, force)
            columns.append([found.force[2], *found.torque[:2]])
    return np.array(columns).T


def test_the_one_follower_of_a_pair_gives_a_torque_by_its_rotors() -> None:
    model = assembly_model(PAPER, "adaptive")
    given = model.corrections(np.array([0.0, 0.0, 0.5]), np.array([1.1, 1.1]))
    np.testing.assert_allclose(given, [[0.0, 0.5 / model.kp[1], 0.0]], atol=1e-15)
    # What it lifts more turns the pair, which its rotors undo: 0.17 m behind O, nose down.
    given = model.corrections(np.array([1.0, 0.0, 0.0]), np.array([1.1, 1.1]))
    np.testing.assert_allclose(given, [[0.0, -0.17 / model.kp[1], 1 / 1.1]], atol=1e-15)


@pytest.mark.parametrize("name", ["adaptive-mass", "oracle", "lqg"])
def test_any_drone_can_lead(name: str) -> None:
    config = TEAMS["team4"]
    drones = config.plant.drones
    other = dataclasses.replace(config.plant, drones=(drones[3], drones[1], drones[0], drones[2]), leader=2)
    scenario = Scenario(seconds=3, mass=0.4, path=ELLIPSE, omega=2.0, disturbance=Disturbance(gust=0.2))
    flights = [
        simulate(plant, make_baseline(name, plant), scenario, "newton-euler")
        for plant in (config, dataclasses.replace(config, plant=other))
    ]
    np.testing.assert_allclose(flights[1].position, flights[0].position, atol=1e-9)
    np.testing.assert_allclose(flights[1].rotor_force[:, 2], flights[0].rotor_force[:, 0], atol=1e-7)


def test_a_turned_rig_flies_the_turned_flight() -> None:
    """Equal drones on a ring that is turned by 60 degrees, goal and path with it: the same flight, turned."""
    config, scenario = TEAMS["team3"], Scenario(seconds=3, mass=0.3, path=ELLIPSE, omega=2.0, goal=(0.5, 0.0, 0.5))
    angle = math.radians(60)
    turn = np.array([[math.cos(angle), -math.sin(angle), 0], [math.sin(angle), math.cos(angle), 0], [0, 0, 1]])
    drones = tuple(
        dataclasses.replace(drone, mount=tuple(turn @ drone.mount), yaw=angle) for drone in config.plant.drones
    )
    there = dataclasses.replace(config, plant=dataclasses.replace(config.plant, drones=drones))
    path = dataclasses.replace(scenario.path, direction=scenario.path.direction + angle)
    moved = dataclasses.replace(scenario, path=path, goal=tuple(turn @ scenario.goal))
    for name in ("adaptive",):
        here = simulate(config, make_baseline(name, config), scenario, "newton-euler")
        other = simulate(there, make_baseline(name, there), moved, "newton-euler")
        # Z-X-Y angles turn as a vector to first order in tilt: 0.2 rad, squared, of the way of 0.7 m.
        np.testing.assert_allclose(other.position, here.position @ turn.T, atol=0.01)
        assert np.abs(other.position - here.position).max() > 0.3


STRONG = replace(TEAMS["team6"], "command.vertical_limit", 12.0)


@pytest.mark.slow
def test_who_knows_of_a_failure_holds_it() -> None:
    """Each follower of six lost in turn: 5 cm again within 10 s; who copies falls."""
    scenarios = [Scenario(mass=0.6, path=CIRCLE, seconds=25.0, lost=((number, 8.0),)) for number in range(1, 6)]
    names = ["oracle", "copy"]
    flights = simulate_batch(STRONG, [(make_baseline(name, STRONG), scenarios) for name in names], "newton-euler")
    distance = np.linalg.norm(flights.error, axis=-1)
    assert distance[flights.time >= 8, :5].max() < 0.3
    assert distance[flights.time >= 18, :5].max() < 0.05
    assert (distance[:, 5:].max(axis=0) > 2.5).all()


def test_with_a_known_failure_the_plan_is_at_once_for_those_that_are_left() -> None:
    controller = make_controller("oracle", STRONG)
    mass, still, total = np.full(5, 0.6), np.zeros((5, 2)), np.full(5, 6.9)
    observation = np.zeros((5, 18))
    whole, less = np.ones((5, 6)), np.ones((5, 6))
    less[:, 3] = 0
    hover = np.zeros((5, 6, 3))  # the rotors as they were before the loss
    hover[..., 0] = 1.15 * 9.81
    commands = [
        controller.step(
            controller.start(observation),
            observation,
            PrivilegedInfo(mass, still, still, total, thrust, still, hover),
        )[1]
        for thrust in (whole, less)
    ]
    np.testing.assert_allclose(commands[0], 0, atol=1e-12)
    left = less[0, 1:] > 0
    assert 1.15 * (9.81 + commands[1][left, 2]).sum() == pytest.approx(5 * 1.15 * 9.81)
    # Drone 3, across from the leader, is lost: its neighbours lift more, those beside the leader less.
    np.testing.assert_allclose(commands[1][left, 2], [-1.47, 6.38, 6.38, -1.47], atol=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["oracle", *weekly("adaptive-mass", "lqg")])
def test_a_batch_of_a_team_equals_its_recorded_flights(name: str) -> None:
    """On JAX in float32, a loss among them: 1e-3 m, or half a per cent of a fall."""
    common = {"mass": 0.6, "path": ELLIPSE, "seconds": 21.0}
    scenarios = [Scenario(**common), Scenario(**common, lost=((2, 19.0),), disturbance=Disturbance(noise=0.3))]
    batched = fly_compiled(STRONG, make_baseline(name, STRONG), scenarios)
    for mine, other in zip(batched, flown(STRONG, [name], scenarios)[name], strict=True):
        assert mine.rmse == pytest.approx(other.rmse, abs=1e-3)
        assert mine.x_peak == pytest.approx(other.x_peak, rel=5e-3, abs=1e-3)


def test_what_they_cannot_fly_is_refused() -> None:
    crazyflies = apply_overrides(preset("flight"), {"plant.cg_axis": "xy"})
    with pytest.raises(InputError, match="Crazyflies in pairs"):
        make_controller("adaptive", crazyflies)
    with pytest.raises(InputError, match="ideal loops"):
        make_controller("mpc", preset("flight"))
