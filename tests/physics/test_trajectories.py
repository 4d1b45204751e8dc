"""Closed-loop flights: the engines agree, the default step has converged, mass changes are impulse-free."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from plants import BEAM, HEAVE, LIGHT_BALL, PIVOT, ROLLING, SAMPLES, VARIED, copying, paper_with
from tables import rows

from mjxball.config import replace
from mjxball.control import rotations
from mjxball.errors import InputError
from mjxball.physics.step import make_numpy_plant_step
from mjxball.sim.rollout import load_of, simulate, simulate_batch, start_of
from mjxball.sim.scenario import Scenario
from mjxball.sim.trajectory import Trajectory

CASES = {
    "sine": (paper_with(), Scenario(omega=1.0, seconds=2.5)),
    "waveform": (paper_with(motion=SAMPLES), Scenario(seconds=2.5)),
    "rolling": (paper_with(motion=ROLLING), Scenario(seconds=4, ball_start=0.03, goal=(0.3, 0.2, 0.1))),
    "mass": (paper_with(), Scenario(seconds=2.5, mass_changes=((0.5, 0.2), (1.5, -0.3)), goal=(0.2, 0.2, 0.2))),
    "light_ball": (paper_with(LIGHT_BALL), Scenario(seconds=2.5, amplitude=0.08)),
    "varied": (paper_with(VARIED), Scenario(seconds=2.5, amplitude=0.08, mass=0.35)),
    "pivot": (paper_with(PIVOT, ROLLING), Scenario(seconds=3, goal=(0, 0, 0), ball_start=0.01)),
    "heave": (paper_with(HEAVE), Scenario(seconds=2.5, goal=(0, 0, 0.2))),
}


def assert_same_path(first: Trajectory, second: Trajectory) -> None:
    """They differ by rounding alone (1e-13), which the closed loop does not amplify."""
    assert np.abs(first.position - second.position).max() <= 1e-10
    assert np.abs(first.euler - second.euler).max() <= 1e-10


@rows("name", CASES)
def test_engines_fly_the_same_trajectory(name: str) -> None:
    config, scenario = CASES[name]
    closed, second = (simulate(config, copying(config), scenario, physics) for physics in ("newton-euler", "mujoco"))
    assert_same_path(second, closed)
    # MuJoCo's internal forces against the closed form, newtons of order 1, found within 2e-12
    assert np.abs(second.contact_force - closed.contact_force).max() <= 1e-9
    assert np.abs(second.contact_torque - closed.contact_torque).max() <= 1e-9


# MJX takes seconds to compile: one case in the first tier, two in the second. The others, whose accelerations
# `test_engines` compares on MJX in the second tier, are flown before a release.
ON_MJX = [
    "varied",
    *(pytest.param(name, marks=pytest.mark.slow) for name in ("mass", "pivot")),
    *(pytest.param(name, marks=pytest.mark.release) for name in ("rolling", "heave")),
]


@pytest.mark.parametrize("name", ON_MJX)
def test_mjx_flies_the_same_trajectory(name: str) -> None:
    config, scenario = CASES[name]
    closed, fast = (simulate(config, copying(config), scenario, physics) for physics in ("newton-euler", "mjx"))
    assert_same_path(fast, closed)


def test_an_external_force_acts_along_the_world_however_the_pair_is_turned() -> None:
    """F dt / M of velocity after one control step, for the first of which thrust and tilt hardly change."""
    config = paper_with()
    scenario, step = Scenario(seconds=1), make_numpy_plant_step(config, "newton-euler")
    load, start = load_of(config, [scenario]), start_of(config, [scenario])
    turned = start._replace(quaternion=rotations.quaternion_from_euler(np.array([[0.0, 0.0, np.pi / 2]])))
    commands, force = np.zeros((1, 2, 3)), np.array([[0.7, 0.2, -0.4]])
    pushed, free = (step(turned, commands, one).velocity for one in (load._replace(external_force=force), load))
    np.testing.assert_allclose(pushed - free, force * 0.02 / 2.2, rtol=0.01, atol=1e-6)


def test_default_step_has_converged() -> None:
    config = paper_with()
    scenarios = [Scenario(omega=omega, seconds=20) for omega in (0.31, 1.0, 3.1)]
    fine = replace(config, "timing.physics_steps", 100)  # 0.2 ms
    coarse, exact = (simulate_batch(c, [(copying(c), scenarios)], "newton-euler").position for c in (config, fine))
    assert config.physics_step == 0.005
    assert np.abs(coarse - exact).max() <= 1e-3  # [m], the bound


def test_a_mass_change_is_impulse_free() -> None:
    config = paper_with()
    plain = simulate(config, copying(config), Scenario(seconds=6), "newton-euler")
    changed = simulate(config, copying(config), Scenario(seconds=6, mass_changes=((5.0, 0.2),)), "newton-euler")
    until = plain.time <= 5.0 + 1e-9
    np.testing.assert_array_equal(changed.position[until], plain.position[until])
    np.testing.assert_array_equal(changed.velocity[until], plain.velocity[until])
    assert (changed.object_mass[~until] == 0.4).all()
    # The heavier object sinks: 0.2 kg x g unsupported on 2.4 kg is 0.82 m/s2, one second later about that fast,
    # less what the PD controller regained.
    assert -0.9 < changed.velocity[-1, 2] - plain.velocity[-1, 2] < -0.4


def test_believed_mass_moves_the_hover_thrust_only() -> None:
    config = paper_with()
    right, wrong = (
        simulate(
            config,
            copying(config),
            Scenario(amplitude=0, goal=(0, 0, 0), seconds=40, believed_mass=m),
            "newton-euler",
        )
        for m in (0.2, 0.1)
    )
    assert np.abs(right.position).max() < 1e-9
    # Sag dm g / (2 m^ kp), m^ = m_i + m^_o / 2; 1e-3: what 40 s leave of the transient
    assert wrong.position[-1, 2] == pytest.approx(-0.1 * 9.81 / (2 * 1.05 * 0.5), rel=1e-3)


def test_a_ball_off_the_pivot_rolls_the_beam() -> None:
    """With rotors that carry the drones alone, a CG on the leader's side (+y) turns roll by -m g c / J_x."""
    config = paper_with(BEAM)
    scenario = Scenario(goal=(0, 0, 0), amplitude=0.05, omega=0.0, phase=np.pi / 2, seconds=0.02)
    flight = simulate(config, copying(config), scenario, "newton-euler")
    inertia = 2 * 2.3e-3 + 2 * 0.17**2 + 0.2 * ((0.34**2 + 0.05**2) / 12 + 0.05**2)
    # 5 %: within 20 ms the attitude loop, behind a rotor lag of 30 ms, has only begun to answer
    assert flight.rates[-1, 0] == pytest.approx(-0.2 * 9.81 * 0.05 / inertia * 0.02, rel=0.05)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"mass": -0.1}, "mass"),
        ({"mass": float("nan")}, "finite"),
        ({"goal": (2.0, 2.0, 2.0)}, "d_term"),
        ({"amplitude": 0.3}, "leaves"),
        ({"omega": -1.0}, "not -1"),
        ({"believed_mass": -0.1}, "believed"),
        ({"mass_changes": ((5.0, -0.2),)}, "positive"),
        ({"mass_changes": ((-5.0, 0.2),)}, "time"),
        ({"seconds": 0.0}, "seconds"),
        ({"ball_start": 0.16}, "end stop"),
    ],
)
def test_unsound_scenarios_are_refused(change: dict, word: str) -> None:
    config = paper_with()
    with pytest.raises(InputError, match=word):
        simulate(config, copying(config), dataclasses.replace(Scenario(), **change), "newton-euler")


def test_a_flight_that_diverges_is_marked_and_harms_no_neighbour() -> None:
    class Reckless:
        name = "reckless"

        def reset(self) -> None: ...

        def __call__(self, observation: np.ndarray) -> np.ndarray:
            return np.full((*observation.shape[:-1], 3), np.nan)

    config = paper_with()
    scenario = Scenario(seconds=2)
    both = simulate_batch(config, [(Reckless(), [scenario]), (copying(config), [scenario])], "newton-euler")
    alone = simulate(config, copying(config), scenario, "newton-euler")
    assert both.diverged[-1].tolist() == [True, False]
    assert np.isfinite(both.position).all()
    # 1e-12 m: another batch size may round differently
    np.testing.assert_allclose(both.world(1).position, alone.position, atol=1e-12)


@pytest.mark.parametrize(
    ("section", "leaf", "value", "word"),
    [
        ("plant.drones.0", "mass", -1.0, "drones.0.mass"),
        ("plant.drones.0", "inertia", (0.0, 1e-3, 1e-3), "drones.0.inertia"),
        ("plant", "ball_radius", 1.0, "larger"),
        ("plant", "gravity", 0.0, "gravity"),
        ("timing", "physics_steps", 1, "200 Hz"),
    ],
)
def test_unsound_plants_are_refused(section: str, leaf: str, value: object, word: str) -> None:
    config = replace(paper_with(), f"{section}.{leaf}", value)
    with pytest.raises(InputError, match=word):
        simulate(config, copying(config), Scenario(seconds=1), "newton-euler")


def test_hover_thrust_of_an_object_too_heavy_stays_within_the_rotors_range() -> None:
    config = paper_with()
    flight = simulate(config, copying(config), Scenario(mass=3.0, seconds=0.02), "newton-euler")
    assert flight.rotor_force.max() == config.plant.rotor_force_max
