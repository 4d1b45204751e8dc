"""The closed loop of teams: mount frames, the order of drones, drones that fail, and the pair as one of them."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from plants import copying, team

from mjxball.config import Config, preset, with_plant
from mjxball.control import observation as layout
from mjxball.control import rotations
from mjxball.control.followers import PrivilegedInfo
from mjxball.control.observation import mount_angles
from mjxball.errors import InputError
from mjxball.sim.controllers import BodyState, Controllers
from mjxball.sim.disturbances import Disturbance
from mjxball.sim.rollout import load_of, make_privileged_info, simulate, simulate_batch, start_of
from mjxball.sim.scenario import CIRCLE, Scenario

PAPER = preset("paper")
TEAM4 = with_plant(PAPER, "team4")


def some_body(seed: int = 0) -> BodyState:
    draw = np.random.default_rng(seed).normal(size=(4, 3))
    return BodyState(draw[0], draw[1], rotations.quaternion_from_euler(0.3 * draw[2]), draw[3])


def turned(body: BodyState, angle: float) -> BodyState:
    """The same body and all that it does, seen in axes turned by `angle` about z, to first order in tilt."""
    about = lambda vector: rotations.turned_about_z(vector, -np.float64(angle))  # noqa: E731
    euler = rotations.euler_from_matrix(rotations.matrix_from_quaternion(body.quaternion))
    return BodyState(
        about(body.position), about(body.velocity), rotations.quaternion_from_euler(about(euler)), about(body.rates)
    )


@pytest.mark.parametrize("name", ["team3", "team4", "team6", "plate4"])
def test_every_follower_sits_on_the_negative_half_of_its_own_x(name: str) -> None:
    plant = with_plant(PAPER, name).plant
    mounts = np.array([plant.drones[number].mount for number in plant.followers])
    own = rotations.turned_about_z(mounts, -mount_angles(plant))
    np.testing.assert_allclose(
        own, np.column_stack([-np.hypot(*mounts[:, :2].T), 0 * mounts[:, 0], mounts[:, 2]]), atol=1e-12
    )


@pytest.mark.parametrize("leader", range(4))
def test_commands_stand_in_the_order_of_the_drones(leader: int) -> None:
    plant = dataclasses.replace(TEAM4.plant, leader=leader)
    own = np.arange(12.0).reshape(4, 3)  # of drone 0, 1, 2, 3
    controllers = Controllers(dataclasses.replace(TEAM4, plant=plant))
    np.testing.assert_array_equal(controllers.stack(own[leader], own[list(plant.followers)]), own)


def test_a_follower_across_from_the_leader_sees_what_a_pairs_follower_sees() -> None:
    """Drone 2 of the ring of four sits where a pair's follower does, and its mount frame is the body's."""
    body, goal = some_body(), np.array([0.4, -0.3, 0.8])
    far = dataclasses.replace(TEAM4.plant, drones=TEAM4.plant.drones[::2], cg_axis="x")
    alone = Controllers(dataclasses.replace(TEAM4, plant=far)).observe(body, goal)
    np.testing.assert_allclose(Controllers(TEAM4).observe(body, goal)[1], alone, atol=1e-12)


def test_followers_of_a_ring_see_the_same_flight_from_their_own_side() -> None:
    """Small tilts: what drone 1 sees is what drone 2 sees of the flight turned by the angle between them."""
    loop, goal, angles = Controllers(TEAM4), np.array([0.4, -0.3, 0.8]), mount_angles(TEAM4.plant)
    calm = some_body()
    euler = 1e-5 * rotations.euler_from_matrix(rotations.matrix_from_quaternion(calm.quaternion))
    calm = calm._replace(quaternion=rotations.quaternion_from_euler(euler))
    seen = loop.observe(calm, goal)
    for number, angle in enumerate(angles):
        again = loop.observe(turned(calm, angle), rotations.turned_about_z(goal, -angle))
        # The second order of tilts of 1e-5 rad.
        np.testing.assert_allclose(seen[number], again[1], atol=1e-9)


def test_copying_in_the_own_frame_is_copying_in_the_bodys() -> None:
    loop, body, goal = Controllers(TEAM4), some_body(), np.array([0.1, -0.1, 0.2])
    still = body._replace(velocity=0.01 * body.velocity, position=0.1 * body.position)
    copied = copying(TEAM4)(loop.observe(still, goal))
    led = loop.leader_command(still, goal, np.zeros(3))
    np.testing.assert_allclose(loop.in_body_axes(copied), np.broadcast_to(led, (3, 3)), atol=1e-12)
    assert np.abs(copied - led).max() > 0.005  # in its own frame it is another command


def test_an_observation_of_a_team_tells_the_body_that_it_was_made_of() -> None:
    loop, body, goal = Controllers(TEAM4), some_body(), np.array([0.1, -0.1, 0.2])
    again = loop.body_from_observation(loop.observe(body, goal), goal)
    for mine, theirs in zip(again, body, strict=True):
        np.testing.assert_allclose(mine, theirs, atol=1e-12)


@pytest.mark.parametrize("leader", [1, 3])
def test_any_drone_can_lead(leader: int) -> None:
    """Drones listed in another order, the leader among them at another place: the same flight."""
    plant = TEAM4.plant
    order = [*range(1, leader + 1), 0, *range(leader + 1, 4)]
    other = dataclasses.replace(plant, drones=tuple(plant.drones[number] for number in order), leader=leader)
    scenario = Scenario(seconds=3, mass=0.4, path=CIRCLE, amplitude=0.03, disturbance=Disturbance(gust=0.2))
    flights = [
        simulate(config, copying(config), scenario, "newton-euler")
        for config in (TEAM4, dataclasses.replace(TEAM4, plant=other))
    ]
    np.testing.assert_allclose(flights[1].position, flights[0].position, atol=1e-10)
    np.testing.assert_allclose(flights[1].rotor_force[:, leader], flights[0].rotor_force[:, 0], atol=1e-8)


def test_engines_agree_on_a_teams_noisy_flight() -> None:
    scenario = Scenario(
        seconds=2, mass=0.4, path=CIRCLE, amplitude=0.05, omega=2.0, disturbance=Disturbance(noise=1.0, delay=0.04)
    )
    mine, theirs = (simulate(TEAM4, copying(TEAM4), scenario, engine) for engine in ("newton-euler", "mujoco"))
    assert mine.follower_command.shape == (101, 3, 3)
    assert mine.observation.shape == (101, 3, 18)
    assert mine.cg_offset.shape == (101, 2)
    np.testing.assert_allclose(mine.position, theirs.position, atol=1e-6)
    assert np.abs(mine.observation[:, 0, 3] - mine.observation[:, 1, 3]).max() > 1e-3  # each has noise of its own


def test_a_team_is_the_same_alone_and_in_a_batch() -> None:
    noisy = Scenario(
        seconds=1,
        mass=0.4,
        disturbance=Disturbance(noise=1.0, gap_rate=0.5, jitter=0.01, offset=1.0, delay=0.02, seed=5),
    )
    lost = Scenario(seconds=1, mass=0.4, lost=((2, 0.5),), thrust=(1.0, 0.9, 1.0, 1.0))
    batch = simulate_batch(TEAM4, [(copying(TEAM4), [lost, noisy])], "newton-euler")
    for number, scenario in enumerate((lost, noisy)):
        alone = simulate(TEAM4, copying(TEAM4), scenario, "newton-euler")
        np.testing.assert_allclose(batch.world(number).position, alone.position, atol=1e-12)


def test_a_lost_drones_rotors_stop_and_a_weak_one_gives_its_share() -> None:
    scenario = Scenario(seconds=2, mass=0.4, lost=((2, 0.5),), thrust=(1.0, 0.9, 1.0, 1.0), amplitude=0.0)
    force = simulate(TEAM4, copying(TEAM4), scenario, "newton-euler").rotor_force
    # A lag of 30 ms: after a tenth of a second e^-3.3 = 4 % are left, after half a second nothing.
    assert (force[25, 2] > 1.0).all()
    assert force[31, 2].max() < 0.05 * force[25, 2].max()
    assert force[51, 2].max() < 1e-6
    first = force[10]
    np.testing.assert_allclose(first[1].sum() / first[3].sum(), 0.9, rtol=0.02)


def test_privileged_information_is_in_each_followers_frame() -> None:
    scenario = Scenario(mass=0.4, amplitude=0.05, phase=np.pi / 2, omega=0.01)
    told = make_privileged_info(TEAM4)(start_of(TEAM4, [scenario]), load_of(TEAM4, [scenario]))
    assert isinstance(told, PrivilegedInfo)
    assert told.believed_mass.shape == (1, 3)
    # The CG lies at +x: ahead of drone 2, across for drones 1 and 3, which look at O from +y and -y.
    np.testing.assert_allclose(told.moment[0] / (0.4 * 0.05), [[0, 1], [1, 0], [0, -1]], atol=1e-3)


@pytest.mark.parametrize(
    ("config", "change", "word"),
    [
        (PAPER, {"path": CIRCLE}, "cg_axis xy"),
        (TEAM4, {"thrust": (1.0, 1.0)}, "4 factors"),
        (TEAM4, {"lost": ((4, 1.0),)}, "0 to 3"),
        (TEAM4, {"path": dataclasses.replace(CIRCLE, width=20.0)}, "leaves the object"),
    ],
)
def test_unsound_scenarios_of_teams_are_refused(config: Config, change: dict, word: str) -> None:

    with pytest.raises(InputError, match=word):
        simulate(config, copying(config), Scenario(seconds=1, **change), "newton-euler")


def test_random_teams_fly_at_all() -> None:
    """Any mounts and yaws: shapes hold, and the observation's error is the object's in the follower's frame."""
    config = dataclasses.replace(PAPER, plant=team(5, seed=3, cg_axis="xy"))
    flight = simulate(config, copying(config), Scenario(seconds=0.1), "newton-euler")
    own = rotations.turned_about_z(flight.observation[:, :, layout.ERROR], mount_angles(config.plant))
    np.testing.assert_allclose(own, np.broadcast_to(flight.error[:, None], own.shape), atol=1e-12)
