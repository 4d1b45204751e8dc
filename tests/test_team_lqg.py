"""Offset-free LQG of teams: what a follower knows of its team, its estimates, noise, policy files."""

from __future__ import annotations

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tables import rows

from mjxball import config as configs
from mjxball.algorithms.base import PolicyNetwork
from mjxball.baselines import make_baseline
from mjxball.baselines.team_lqg import team_lqg
from mjxball.config import Config, preset
from mjxball.control import rotations
from mjxball.control.followers import copy_gains
from mjxball.control.observation import copy_command, mount_angles
from mjxball.control.team_lqg import team_context
from mjxball.env import TransportEnv
from mjxball.errors import InputError
from mjxball.evaluate.policies import load_policy
from mjxball.plant import plant_parameters
from mjxball.plant.teams import ring_config
from mjxball.policy import Policy, PolicyFile
from mjxball.policy.container import PolicyFileError
from mjxball.policy.export import policy_file
from mjxball.policy.file import save_file, shipped_policy
from mjxball.sim.disturbances import Disturbance
from mjxball.sim.follower import follower_law
from mjxball.sim.rollout import simulate, simulate_batch
from mjxball.sim.scenario import CIRCLE, Scenario

TEAM = preset("team")
ENGINE = "newton-euler"


def ring(count: int) -> Config:
    return ring_config(TEAM, count)


@rows("count", [2, 3, 6])
def test_what_a_follower_knows_of_a_ring(count: int) -> None:
    """Lifts of 1 m/s2 more by all followers turn the ring about the leader's mount, as a command of all N does."""
    config = ring(count)
    numbers = plant_parameters(config.plant, config.attitude)
    known = team_context(numbers, config.plant, np.float64(config.plant.object_mass)).reshape(-1, 5)
    assert len(known) == count - 1
    np.testing.assert_allclose(known[:, 0], count / (count - 1))
    lifted = numbers.known_mass[0] + numbers.share[0] * config.plant.object_mass
    torque = lifted * np.hypot(*numbers.mounts[0, :2])
    np.testing.assert_allclose(np.hypot(known[:, 1], known[:, 2]), torque / count / numbers.gains.kp[1], rtol=1e-9)
    if count % 2 == 0:  # the follower across from the leader has it straight ahead: a pure pitch, nose up to the leader
        np.testing.assert_allclose(known[count // 2 - 1, 1:3], [0.0, torque / count / numbers.gains.kp[1]], atol=1e-12)
    room = 2 * numbers.arm[0] * 9.81 * lifted / 4  # all hover below half of their range
    np.testing.assert_allclose(known[:, 3:], np.tile(room / numbers.gains.kp[:2], (count - 1, 1)), rtol=1e-9)


def test_turning_a_team_changes_nothing_that_its_followers_know() -> None:
    config, known = ring(4), []
    for angle in (0.0, 0.7):
        c, s = math.cos(angle), math.sin(angle)
        drones = tuple(
            dataclasses.replace(
                one, mount=(c * one.mount[0] - s * one.mount[1], s * one.mount[0] + c * one.mount[1], 0.0)
            )
            for one in config.plant.drones
        )
        plant = dataclasses.replace(config.plant, drones=drones)
        known.append(team_context(plant_parameters(plant, config.attitude), plant, np.float64(plant.object_mass)))
    np.testing.assert_allclose(known[1], known[0], rtol=1e-9, atol=1e-12)


def test_what_enters_the_filter_is_the_mean_of_all_commands() -> None:
    """It lifts as the height's feedback asks, and tilts against what lifting more than the leader turns."""
    config = ring(4)
    law, leader = team_lqg(config), copy_gains(config)
    observation = 0.05 * np.random.default_rng(0).standard_normal(18)
    led, tilts = copy_command(observation, *leader), []
    for lever in (np.zeros(2), np.array([0.01, -0.02])):
        memory = law.start(observation, np.array([4 / 3, *lever, 9.0, 9.0]))
        own = law.command(np.zeros(3), memory, observation, leader)
        mean, (turning, rising) = (led + 3 * own) / 4, law.estimate(memory, observation)
        assert mean[2] == pytest.approx(law.rise @ (observation[14], observation[17]) - rising[2], rel=1e-9)
        tilts.append(mean[:2] + lever * (own - led)[2])  # with what the lift turns
        states = [np.append(turning[k], tilts[-1][k]) for k in (0, 1)]
        expected = [*(law.axis @ state for state in states), law.height @ np.append(rising, mean[2])]
        np.testing.assert_allclose(law.next(memory, observation, own, leader)[:13], np.concatenate(expected), rtol=1e-9)
    np.testing.assert_allclose(tilts[1], tilts[0], rtol=1e-9)


def test_worlds_of_training_know_what_a_flight_knows() -> None:
    quiet = {f"scenario.{name}": (1.0, 1.0) for name in ("drone_mass_scale", "mount_scale", "carrier_scale")}
    quiet |= {f"scenario.{name}": (1.0, 1.0) for name in ("arm_scale", "attitude_gain_scale", "rotor_force_scale")}
    env = TransportEnv(configs.apply_overrides(TEAM, quiet | {"scenario.drone_inertia_scale": (1.0, 1.0)}), ENGINE)
    world = jax.jit(env.reset)(jax.random.key(0), 1.0, 1).pipeline_state  # of three drones
    own = ring(3)
    numbers = plant_parameters(own.plant, own.attitude)
    expected = team_context(numbers, own.plant, np.float64(own.plant.object_mass))
    np.testing.assert_allclose(world.history[:2, -5:], expected, rtol=1e-4, atol=1e-6)


def test_the_filter_predicts_a_loop_that_turns() -> None:
    """One period from a random state, by the equations of motion integrated in small steps."""
    config, state, drive = ring(4), np.array([0.02, -0.1, 3.0, 5.0, -2.0]), 0.05
    law, lag, steps = team_lqg(config), config.plant.rotor_lag, 20000
    moved, h = state.copy(), config.timing.control_period / 20000
    for _ in range(steps):
        angle, rate, load, growth, rotors = moved
        asked = 100 * (drive - angle) - 18 * rate
        slope = (rate, load + rotors, growth - load / 3.0, -growth / 0.3, (asked - rotors) / lag)
        moved = moved + h * np.array(slope)
    np.testing.assert_allclose(law.axis @ np.append(state, drive), moved, rtol=1e-4, atol=1e-5)


@rows("count", [3, 6])
def test_it_finds_the_loads_torque(count: int) -> None:
    """m g c over the inertia, in every mount frame, less the few percent that is forgotten."""
    config = ring(count)
    follower, mass, offset = make_baseline("lqg-offset-free", config), config.plant.object_mass, 0.04
    scenario = Scenario(omega=0.0, phase=math.pi / 2, amplitude=offset, mass=mass, seconds=12.0)
    flown = simulate(config, follower, scenario, ENGINE)
    assert np.abs(flown.error[-1]).max() < 5e-3
    turning, _ = follower.law._law.estimate(follower._state, flown.observation[-1])
    numbers = plant_parameters(config.plant, config.attitude)
    inertia = count * numbers.gains.kp[1] / 100
    found = np.linalg.norm(turning[0, :, :, 2], axis=-1)
    np.testing.assert_allclose(found, mass * 9.81 * offset / inertia, rtol=0.06)


def test_followers_that_measure_apart_do_not_drift_apart() -> None:
    """For 30 s under noise level 1 and 40 ms of delay: estimates that nothing forgets end up at the rotors' limits."""
    config = ring(6)
    scenario = Scenario(mass=0.6, seconds=30.0, disturbance=Disturbance(noise=1.0, delay=0.04))
    flown = simulate(config, make_baseline("lqg-offset-free", config), scenario, ENGINE)
    assert np.linalg.norm(flown.error[flown.time > 15], axis=-1).max() < 0.03


def silent(config: Config) -> PolicyFile:
    """A network of zeros."""
    law = follower_law(config)
    size = 18 + law.size
    layers = {"hidden_0": {"kernel": np.zeros((size, 8)), "bias": np.zeros(8)}}
    layers["hidden_1"] = {"kernel": np.zeros((8, 6)), "bias": np.zeros(6)}
    learnt = PolicyNetwork(layers, np.zeros(size), np.ones(size), np.ones(size))
    return policy_file(config, law, learnt, steps=0)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory):
    path = tmp_path_factory.mktemp("team") / "silent.npz"
    save_file(path, silent(TEAM))
    return path


@rows("count", [2, 3, 5])
def test_a_network_of_zeros_flies_the_law(count: int, file) -> None:
    config = ring(count)
    scenario = Scenario(amplitude=0.02, omega=1.0, mass=config.plant.object_mass, seconds=5.0)
    policy = load_policy(file, config)
    flown, expected = (
        simulate(config, follower, scenario, ENGINE) for follower in (policy, make_baseline("lqg-offset-free", config))
    )
    np.testing.assert_allclose(flown.position, expected.position, rtol=0, atol=2e-4)  # float32 beside float64


def test_what_a_policy_is_not_told_or_not_made_for_is_refused(file) -> None:
    with pytest.raises(InputError, match="told its team"):
        Policy.load(file)(np.zeros((2, 18)))
    with pytest.raises(InputError, match="2 to 6 drones, not 8"):
        load_policy(file, ring_config(configs.replace(TEAM, "scenario.team_sizes", ()), 8))
    with pytest.raises(InputError, match="10 rad/s, not 8"):
        load_policy(file, configs.replace(ring(4), "attitude.natural_frequency", (8.0, 8.0, 4.0)))
    with pytest.raises(InputError, match="moves in the plane"):
        load_policy(file, preset("transport"))
    with pytest.raises(InputError, match="alike about roll and pitch"):
        team_lqg(configs.replace(ring(4), "attitude.natural_frequency", (8.0, 10.0, 4.0)))


@rows(
    "change",
    [
        "another context",
        "no numbers",
        "a number that is none",
        "no damping",
        "no such team",
        "strings",
        "a pair of one",
    ],
)
def test_unsound_files_are_refused(change, file, tmp_path) -> None:
    contents = silent(TEAM)
    given, said = {
        "another context": ({"context": ["mass"]}, "another context"),
        "no numbers": ({"lqg": None}, "needs card field lqg"),
        "a number that is none": ({"lqg": contents.card["lqg"] | {"damping": float("nan")}}, "lqg.damping"),
        "no such team": ({"team": {"drone": 1, "mount_angle": 0.0, "context": [2.0] * 4}}, "team.context must be"),
        "strings": ({"team": {"drone": 1, "mount_angle": 0.0, "context": ["2.0"] * 5}}, "team.context must be"),
        "a pair of one": ({"team": {"drone": 1, "mount_angle": 0.0, "context": [1.0] * 5}}, "must be above 1"),
        "no damping": ({"lqg": contents.card["lqg"] | {"damping": 0.0}}, "must be positive"),
    }[change]
    with pytest.raises(PolicyFileError, match=said):
        save_file(tmp_path / "unsound.npz", dataclasses.replace(contents, card=contents.card | given))


FACTORS = ("drone_mass", "drone_inertia", "mount", "arm", "yaw_per_thrust", "rotor_force", "carrier", "attitude_gain")


@pytest.fixture(scope="module")
def moved():
    """State after a few steps of strong commands, for a range of one number of the rig at 1.3 and none."""
    strong = jnp.asarray(np.random.default_rng(2).uniform(-1, 1, (2, 3)), jnp.float32) * jnp.array([0.6, 0.6, 40.0])

    steps: list = []  # of the first one's program, to which a rig is data

    def fly(name: str = "") -> np.ndarray:
        changes = {
            "follower.base": "pd",
            "follower.privileged_critic": False,
            "command.vertical_limit": 40.0,
            "scenario.start_tilt": 0.3,
            **{f"scenario.{one}_scale": (1.0, 1.0) for one in (*FACTORS, "rotor_lag", "thrust", "inertia")},
            "scenario.team_sizes": (3,),
        }
        if name:
            changes[f"scenario.{name}_scale"] = (1.3, 1.3)
        base = configs.apply_overrides(preset("team"), changes)
        env = TransportEnv(base, ENGINE)
        state = env.reset(jax.random.key(3), 1.0, 0)
        if not steps:
            steps.append(jax.jit(env.step_with_command))
        for _ in range(3):
            state = steps[0](state, jnp.concatenate([strong, jnp.zeros((3, 3))]))
        plant = state.pipeline_state.plant
        return np.concatenate([np.ravel(leaf) for leaf in (plant.velocity, plant.rates)])

    return fly


def test_every_range_of_a_rig_acts(moved) -> None:
    base = moved()
    for name in (*FACTORS, "rotor_lag", "thrust", "inertia"):
        assert np.abs(moved(name) - base).max() > 1e-5, name


def lifting(config: Config) -> Config:
    return configs.replace(config, "follower.differential_thrust_share", 0.9)


@rows("count", [4, 5, 6])
def test_lifts_apart_give_the_torque_and_no_lift(count: int) -> None:
    """By the wrenches of thrusts at their mounts, which `plant.trim` writes down for itself."""
    config = lifting(ring(count))
    law, plant = team_lqg(config), config.plant
    numbers = plant_parameters(plant, config.attitude)
    known = team_context(numbers, plant, np.float64(plant.object_mass))
    held = np.array([0.03, -0.02])  # what all drones would command, body axes
    angles = mount_angles(plant)
    seen = rotations.turned_about_z(np.broadcast_to([*held, 0.0], (count - 1, 3)), -angles)[:, :2]
    memory = np.concatenate([np.zeros((count - 1, 13)), known], axis=-1)
    lifts = law._apart(np.zeros((count - 1, 3)), seen, memory)[:, 2]
    thrust = lifts * (numbers.known_mass[0] + numbers.share[0] * plant.object_mass)
    x, y, _ = numbers.mounts[1:].T
    torque = np.array([(y * thrust).sum(), -(x * thrust).sum()])
    np.testing.assert_allclose(torque, -count * numbers.gains.kp[:2] * held, rtol=1e-7)  # a root keeps 1e-12 of it
    assert abs(thrust.sum()) < 1e-7


def losing(config: Config) -> list[Scenario]:
    """Six drones with a load on a circle lose each follower in turn."""
    flight = Scenario(omega=1.0, amplitude=0.1, mass=0.6, path=CIRCLE, goal=(0.0, 0.0, 0.0), seconds=12.0)
    return [dataclasses.replace(flight, lost=((k, 3.0),)) for k in config.plant.followers]


def test_a_follower_that_is_lost_is_made_up_for() -> None:
    """Where tilting alone ends far away."""
    config = configs.replace(ring(6), "command.vertical_limit", 12.0)
    flights = losing(config)
    apart, tilting = (
        simulate_batch(c, [(make_baseline("lqg-offset-free", c), flights)], ENGINE) for c in (lifting(config), config)
    )
    distance = np.linalg.norm(apart.error, axis=-1)
    assert distance.max() < 0.3
    assert distance[-50:].max() < 0.05
    assert (np.linalg.norm(tilting.error[-1], axis=-1) > 2.5).all()


@pytest.mark.slow
def test_the_shipped_policy_makes_up_for_it() -> None:
    config = preset("lost")
    flights = simulate_batch(config, [(load_policy(shipped_policy("lost"), config), losing(config))], ENGINE)
    distance = np.linalg.norm(flights.error, axis=-1)
    assert distance.max() < 0.3
    assert distance[-50:].max() < 0.05


@pytest.mark.slow
def test_four_drones_come_down_slowly_and_upright_without_a_neighbour_of_the_leader() -> None:
    """From the goal, for 12 s after the loss, the load resting in the middle."""
    config = preset("descent")
    lost = [Scenario(amplitude=0.0, mass=0.4, seconds=20.0, lost=((number, 8.0),)) for number in (1, 3)]
    flights = simulate_batch(config, [(load_policy(shipped_policy("descent"), config), lost)], ENGINE)
    after = flights.time > 8.0
    assert np.linalg.norm(flights.error[~after][-50:], axis=-1).max() < 0.02
    assert flights.velocity[after][..., 2].min() > -1.0
    tilts = np.arccos(np.cos(flights.euler[after][..., 0]) * np.cos(flights.euler[after][..., 1]))
    assert tilts.max() < np.radians(30)


def test_lifting_apart_takes_four_drones(tmp_path) -> None:
    with pytest.raises(InputError, match=r"follower.differential_thrust_share needs teams of at least 4 drones, not 3"):
        configs.validate(lifting(ring(3)))
    with pytest.raises(InputError, match=r"follower.differential_thrust_share needs teams of at least 4 drones, not 2"):
        configs.validate(configs.override(configs.preset("lost"), "scenario.team_sizes", "2,6"))
    with pytest.raises(InputError, match=r"follower.differential_thrust_share is of teams with follower.base lqg"):
        configs.validate(configs.override(configs.preset("transport"), "follower.differential_thrust_share", "0.5"))
    path = tmp_path / "apart.npz"
    save_file(path, silent(lifting(ring(6))))
    with pytest.raises(InputError, match="apart needs a team of at least 4 drones, not 3"):
        load_policy(path, ring(3))
    contents = silent(lifting(ring(6)))
    odd = dataclasses.replace(contents, card={**contents.card, "lqg": {**contents.card["lqg"], "lifting": 1.5}})
    with pytest.raises(PolicyFileError, match=r"lqg.lifting must be a share from 0 to 1"):
        save_file(path, odd)
