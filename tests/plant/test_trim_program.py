"""The trim of a team by a linear program: against the pair's closed form, balances by hand and the physics' wrench."""

from __future__ import annotations

import dataclasses
import itertools
import math
import re

import numpy as np
import pytest
from plants import team
from tables import rows

from batch import fly_compiled
from mjxball.baselines import make_baseline
from mjxball.config import Attitude, Config, Drone, Plant, preset, replace, with_plant
from mjxball.control.attitude import rotor_commands
from mjxball.control.constants import trim_limit
from mjxball.control.mixer import torque_per_force
from mjxball.errors import InputError
from mjxball.physics.engine import total_wrench
from mjxball.plant import plant_parameters
from mjxball.plant.trim import Trim, largest_amplitude, largest_margin, safe_radius
from mjxball.sim.scenario import CgPath, Scenario

PAPER = Plant()
TEAMS = {name: with_plant(preset("paper"), name).plant for name in ("team3", "team4", "team6")}
SIDEWAYS = dataclasses.replace(
    PAPER, cg_axis="y", drones=(Drone(mount=(0.0, 0.2, 0.0)), Drone(mass=0.9, mount=(0.0, -0.15, 0.0)))
)
EXACT = 1e-9  # HiGHS ends at a vertex, which it solves to rounding


def wrench_of(plant: Plant, force: np.ndarray) -> np.ndarray:
    """(T, tau_x, tau_y, tau_z) about O of rotor forces (..., N, 4), by the physics."""
    wrench = total_wrench(plant, plant_parameters(plant, Attitude()), force)
    return np.concatenate([np.asarray(wrench.force)[..., 2:], np.asarray(wrench.torque)], axis=-1)


def needed(plant: Plant, mass: float, cg: tuple[float, float]) -> np.ndarray:
    """The wrench that holds all weights level."""
    weights = [(one.mass, one.mount) for one in plant.drones] + [(plant.carrier_mass, (0, 0)), (mass, cg)]
    return plant.gravity * sum(m * np.array([1.0, place[1], -place[0], 0.0]) for m, place in weights)


@rows("plant", [PAPER, SIDEWAYS, dataclasses.replace(PAPER, layout="x"), dataclasses.replace(PAPER, arm=0.06)])
def test_of_a_pair_it_is_the_closed_form(plant: Plant) -> None:
    """Where rotors reach their most before they stand still; the closed form has no lower bound, here added by hand."""
    upper = 0
    believed, thrust = (None, 0.2, 0.4), ((1.0, 1.0), (0.93, 0.9), (1.04, 1.1))
    for mass, given, margin, (lead, own) in itertools.product(
        (0.1, 0.25, 0.4, 0.6, 0.9), believed, (0, 0.15, 0.6), thrust
    ):
        expected = trim_limit(plant, mass, margin, given, (lead, own))
        found = largest_amplitude(plant, mass, margin, None, given, thrust=(lead, own))
        first, second = plant.drones
        share = plant.load_shares[0] * (mass if given is None else given)
        follower = (first.mass + second.mass + mass - lead * (first.mass + share)) * plant.gravity / 4
        room, least = own * plant.rotor_force_max - follower, follower
        if room <= 0:
            assert expected < 0
            assert found == -math.inf
            continue
        upper += room <= least
        torque = (1 - margin) * torque_per_force(plant.arm, plant.layout)
        expected += torque * min(least - room, 0.0) / (mass * plant.gravity)
        assert found == pytest.approx(expected, rel=EXACT, abs=EXACT)
    assert upper > 60  # of 135


def test_of_a_pair_the_safe_radius_is_the_largest_amplitude() -> None:
    """Light loads leave rotors nearest to 0, heavy ones nearest to their most."""
    numbers = plant_parameters(PAPER, Attitude())
    for mass in (0.1, 0.2, 0.4, 0.6):
        found = float(safe_radius(numbers, PAPER.leader, np.array(mass), 0.15))
        assert found == pytest.approx(largest_amplitude(PAPER, mass, 0.15), rel=EXACT)


@rows("plant, mass", [(PAPER, 0.4), *((plant, 0.15 * plant.count) for plant in TEAMS.values())])
def test_at_the_largest_amplitude_the_margin_is_what_was_asked_for(plant: Plant, mass: float) -> None:
    for direction in (None,) if plant is PAPER else ((1.0, 0.0), (0.0, 2.0), (-1.0, 0.5)):
        amplitude = largest_amplitude(plant, mass, 0.15, direction)
        along = 1.0 if direction is None else np.array(direction) / np.linalg.norm(direction)
        ends = [largest_margin(plant, mass, sign * amplitude * along).margin for sign in (1, -1)]
        assert min(ends) == pytest.approx(0.15, abs=EXACT)


def random_cases() -> list[tuple]:
    """(plant, mass, CG, lost drones, whether the leader helps, thrust factors)"""
    found, random = [], np.random.default_rng(3)
    for count, helps in itertools.product((3, 4, 6), (False, True)):
        plant = team(count, seed=count, leader=count - 1, rotor_force_max=9.0)
        lost = (0,) if count == 6 else ()
        found.append((plant, 0.2, tuple(random.uniform(-0.03, 0.03, 2)), lost, helps, random.uniform(0.9, 1.1, count)))
    return found


@rows("plant, mass, cg, lost, helps, thrust", random_cases())
def test_the_forces_hold_all_weights_and_no_others_leave_more(
    plant: Plant, mass: float, cg: tuple, lost: tuple, helps: bool, thrust: np.ndarray
) -> None:
    margin, force = largest_margin(plant, mass, cg, None, lost, helps, thrust)
    assert force is not None
    np.testing.assert_allclose(wrench_of(plant, force), needed(plant, mass, cg), atol=1e-8)
    assert (force[list(lost)] == 0).all()
    acts = [number for number in range(plant.count) if number not in lost and (helps or number != plant.leader)]
    if not helps:
        asked = plant.known_masses[plant.leader] + plant.load_shares[plant.leader] * mass
        np.testing.assert_allclose(force[plant.leader], thrust[plant.leader] * asked * plant.gravity / 4)
    most = (thrust * plant.of_drones("rotor_force_max"))[acts, None]
    lifting = force[acts].sum() / (4 * most.sum())

    def left(forces: np.ndarray) -> np.ndarray:
        """The margin (...) of forces (..., n, 4)."""
        share = forces / most
        return np.minimum(share / lifting, (1 - share) / (1 - lifting)).min(axis=(-2, -1))

    assert left(force[acts]) == pytest.approx(margin, abs=EXACT)
    # The margin is concave in the forces: none in reach that hold the same weights leave more.
    units = np.zeros((4 * len(acts), plant.count, 4))
    units[np.arange(len(units)), np.repeat(acts, 4), np.tile(range(4), len(acts))] = 1.0
    unseen = np.linalg.svd(wrench_of(plant, units).T)[2][4:]
    steps = np.random.default_rng(1).normal(size=(20_000, len(unseen))) @ unseen
    assert left(force[acts] + 1e-3 * steps.reshape(-1, len(acts), 4)).max() <= margin + EXACT


@rows("angle", [0.3, -2.0, math.pi / 2])
def test_turning_the_whole_plant_changes_nothing(angle: float) -> None:
    plant, cg = team(4, seed=4, leader=1), np.array([0.02, -0.03])
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    drones = tuple(
        dataclasses.replace(one, mount=(*(turn @ one.mount[:2]), one.mount[2]), yaw=one.yaw + angle)
        for one in plant.drones
    )
    turned = dataclasses.replace(plant, drones=drones)
    for lost in ((), (2,)):
        before, after = largest_margin(plant, 0.3, cg, lost=lost), largest_margin(turned, 0.3, turn @ cg, lost=lost)
        assert after.margin == pytest.approx(before.margin, abs=EXACT)
    reach = largest_amplitude(plant, 0.3, -0.5, cg)
    assert largest_amplitude(turned, 0.3, -0.5, turn @ cg) == pytest.approx(reach, abs=EXACT)


@rows("plant", [PAPER, *TEAMS.values()])
def test_a_heavier_load_leaves_less(plant: Plant) -> None:
    cg = 0.05 if plant is PAPER else (0.05, 0.02)
    found = [largest_margin(plant, mass, cg).margin for mass in np.linspace(0.25, 0.8, 6)]
    assert (np.diff(found) < -1e-3).all()


@rows("name", ["team4", "team6"])
def test_a_lost_drone_and_a_weak_one_leave_less_and_a_leader_that_helps_more(name: str) -> None:
    plant = TEAMS[name]
    every = {"margin": 0.0, "direction": (1.0, 2.0)}
    whole = largest_amplitude(plant, 0.5, **every)
    weak = (1.0, 0.6, *[1.0] * (plant.count - 2))
    assert whole < largest_amplitude(plant, 0.5, **every, leader_helps=True)
    assert largest_amplitude(plant, 0.5, **every, lost=(1,)) < whole - 0.05
    assert largest_amplitude(plant, 0.5, **every, thrust=weak) < whole


class TestByHand:
    def test_equal_drones_that_all_help_hover_alike(self) -> None:
        found = largest_margin(dataclasses.replace(TEAMS["team6"], leader=3), 0.6, (0.0, 0.0), leader_helps=True)
        assert found.margin == pytest.approx(1.0)
        np.testing.assert_allclose(found.rotor_force, (6 + 0.3 + 0.6) * 9.81 / 24)

    def test_four_drones_that_lost_the_one_opposite_the_leader(self) -> None:
        """The leader's 1.15 kg g pitch with the ring's radius R; two drones lift 3.45 kg g across.

        Without a yaw moment half of that is on the fore and aft rotors, so that these can turn it all by at most
        3.45 kg g L / 2 of the 1.15 kg g R.
        """
        ring = TEAMS["team4"]
        radius = ring.drones[0].mount[0]
        for size in (1000.0, math.inf):
            plant = dataclasses.replace(ring, rotor_force_max=size)
            found = largest_margin(plant, 0.4, (0.0, 0.0), lost=[2])
            assert found.margin == pytest.approx(1 - 1.15 * radius / (3.45 * 0.12 / 2))
        longer = dataclasses.replace(plant, arm=1.15 * radius / (3.45 / 2))
        assert largest_margin(longer, 0.4, (0.0, 0.0), lost=[2]).margin == pytest.approx(0.0, abs=EXACT)

    def test_rotors_that_cannot_lift(self) -> None:
        weak = dataclasses.replace(PAPER, rotor_force_max=2.6)
        assert largest_margin(weak, 0.2, 0.0) == Trim(-math.inf, None)
        assert largest_margin(PAPER, 0.2, 0.0, lost=[1]).margin == -math.inf
        assert largest_amplitude(weak, 0.2) == -math.inf

    def test_a_pair_cannot_leave_more_than_one_follower_has(self) -> None:
        """0.4 kg at 5 cm: 0.1962 N m of 2 x 0.12 m (5.5 N - 1.2 kg g / 4)."""
        found = largest_margin(PAPER, 0.4, 0.05)
        assert found.margin == pytest.approx(1 - 0.1962 / (0.24 * (5.5 - 1.2 * 9.81 / 4)))


def test_no_rotors_let_four_drones_lose_any_follower_whose_leader_flies_its_hover_law() -> None:
    plant = dataclasses.replace(TEAMS["team4"], rotor_force_max=math.inf)
    radius = 0.2
    places = [(0.0, 0.0), *((radius * math.cos(a), radius * math.sin(a)) for a in np.arange(8) * math.pi / 4)]
    for mass, cg in itertools.product((0.2, 0.8, 1.6), places):
        assert min(largest_margin(plant, mass, cg, lost=[one]).margin for one in (1, 2, 3)) < -0.2
    assert min(largest_margin(plant, 0.4, (0.0, 0.0), lost=[one], leader_helps=True).margin for one in (1, 2, 3)) > 0.15
    assert min(largest_margin(TEAMS["team6"], 0.6, (0.0, 0.0), lost=[one]).margin for one in range(1, 6)) > 0.15


IN_PLANE = replace(preset("paper"), "plant.cg_axis", "xy")


def test_a_pair_whose_roll_command_is_too_large_is_not_trimmed() -> None:
    """0.2 kg 10 cm beside the line of a pair: the follower's loop of 0.2404 N m/rad is asked for 0.816 of 0.6 rad."""
    moment, gain = 0.2 * 9.81 * 0.1, float(plant_parameters(IN_PLANE.plant, IN_PLANE.attitude).gains.kp[0])
    assert (gain, moment / gain) == pytest.approx((0.2404, 0.816), abs=1e-3)
    assert largest_margin(IN_PLANE.plant, 0.2, (0.0, 0.1)).margin > 0.6  # by its rotors alone
    assert largest_margin(IN_PLANE, 0.2, (0.0, 0.1)).margin == pytest.approx(1 - moment / gain / 0.6)
    across = largest_amplitude(IN_PLANE, 0.2, 0.15, (0.0, 1.0))
    assert across == pytest.approx(0.85 * 0.6 * gain / (0.2 * 9.81))
    along = largest_amplitude(IN_PLANE, 0.2, 0.15, (1.0, 0.0))
    assert along == pytest.approx(largest_amplitude(IN_PLANE.plant, 0.2, 0.15, (1.0, 0.0)))
    assert largest_margin(replace(IN_PLANE, "command.tilt_limit", 1.2), 0.2, (0.0, 0.1)).margin > 0.15


@pytest.mark.slow
def test_a_pair_holds_what_its_roll_commands_trim_and_loses_what_they_do_not() -> None:
    """The load rests beside the line of a pair that `oracle`, which knows where it is, flies; 5 % below, 20 % above."""
    wide = replace(IN_PLANE, "plant.object_size", (0.34, 0.3, 0.05))
    most = largest_amplitude(wide, 0.2, 0.0, (0.0, 1.0))
    assert most == pytest.approx(0.0939, abs=1e-4)
    rest = Scenario(omega=0.0, phase=math.pi / 2, path=CgPath(direction=math.pi / 2), seconds=22.0)
    flights = [dataclasses.replace(rest, amplitude=share * most) for share in (0.95, 1.2)]
    held, lost = fly_compiled(wide, make_baseline("oracle", wide), flights)
    assert (held.failed, held.y_peak) == (False, pytest.approx(0.0, abs=1e-3))
    assert lost.y_peak is not None
    assert lost.y_peak > 0.5


def test_an_unknown_mass_takes_vertical_commands() -> None:
    """A believed 0.1 kg of 0.5: the follower lifts 0.4 kg more than its hover thrust of 1.05 kg is for."""
    config = replace(preset("paper"), "command.vertical_limit", 4.0)
    lifted = (1.0 + 0.5 - 0.05) / 1.05  # without the leader's 1.05 kg, over what is believed
    expected = 1 - 9.81 * (lifted - 1) / 4.0
    # The follower's lift at its own mount is a moment, which a CG on its side takes back.
    own = 0.17 * ((1.45 - 1.0) - (1.05 - 1.0)) / 0.5
    assert largest_margin(config.plant, 0.5, -own, 0.1).margin > expected + 0.05
    assert largest_margin(config, 0.5, -own, 0.1).margin == pytest.approx(expected)


@rows("config, mass", [(IN_PLANE, 0.15), *((with_plant(preset("paper"), name), 0.3) for name in TEAMS)])
def test_attitude_loops_give_the_forces_of_the_trim(config: Config, mass: float) -> None:
    """The commands that the forces say, to the loops that fly; the largest of them leaves the margin."""
    plant, gains = config.plant, plant_parameters(config.plant, config.attitude).gains
    margin, force = largest_margin(config, mass, (0.01, 0.03))
    assert force is not None
    believes = np.array(plant.known_masses) + np.array(plant.load_shares) * mass
    alone = dataclasses.replace(
        plant, drones=tuple(dataclasses.replace(d, mount=(0.0, 0.0, 0.0)) for d in plant.drones)
    )
    wrench = np.array(
        [wrench_of(alone, np.where(np.arange(plant.count)[:, None] == k, force, 0.0)) for k in range(plant.count)]
    )
    command = np.column_stack([wrench[:, 1:3] / gains.kp[:2], wrench[:, 0] / believes - plant.gravity])
    level, arms = np.zeros((plant.count, 3)), np.array(plant.of_drones("arm"))
    yaw = np.array(plant.of_drones("yaw_per_thrust"))
    found = rotor_commands(command, level, level, believes, gains, plant.gravity, arms, yaw, 5.5, plant.layout)
    assert found == pytest.approx(force, abs=1e-9)
    shares = np.abs(command) / [config.command.tilt_limit, config.command.tilt_limit, config.command.vertical_limit]
    assert shares.max() <= 1 - margin + 1e-9


def test_where_loops_integrate_any_force_can_be_commanded() -> None:
    config = preset("flight")
    assert largest_margin(config, 0.01, 0.02).margin == pytest.approx(largest_margin(config.plant, 0.01, 0.02).margin)


@rows(
    "change, sentence",
    [
        ({"cg": (0.0, 0.0)}, "1 finite coordinates"),
        ({"cg": math.nan}, "1 finite coordinates"),
        ({"object_mass": 0.0}, "mass must be positive"),
        ({"lost": [2]}, "numbers from 0 to 1"),
        ({"thrust": (1.0,)}, "thrust must be 2 factors"),
    ],
)
def test_what_does_not_fit_the_plant_is_refused(change: dict, sentence: str) -> None:
    with pytest.raises(InputError, match=re.escape(sentence)):
        largest_margin(PAPER, **({"object_mass": 0.2, "cg": 0.0} | change))


def test_directions_that_the_load_does_not_have_are_refused() -> None:
    for direction in ((0.0, 1.0), (0.0, 0.0), (1.0,)):
        with pytest.raises(InputError, match="direction"):
            largest_amplitude(PAPER, 0.2, direction=direction)
    with pytest.raises(InputError, match="at most 1"):
        largest_amplitude(PAPER, 0.2, 1.5)
