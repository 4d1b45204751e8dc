"""Loads that swing: found, turned ahead by the angle that estimate and rotors are late, and held against in time."""

from __future__ import annotations

import numpy as np
import pytest
from rig_laws import still
from scipy.integrate import solve_ivp

from mjxball.baselines.multi_model_lqg import TUNING, MultiModelOffsetFree, multi_model_lqg
from mjxball.baselines.swing_design import ENERGY_TIME, FREQUENCIES, observers
from mjxball.baselines.team_lqg import angle_filter
from mjxball.cli import plant_setup
from mjxball.config import preset
from mjxball.control.followers import Baseline, copy_gains
from mjxball.control.multi_model_lqg import MultiModelLqg, team_geometry
from mjxball.control.swing import STATES, swings_advanced, swings_grown, swings_seen
from mjxball.sim.rollout import simulate
from mjxball.sim.scenario import CIRCLE, Scenario

UNIVERSAL = preset("universal")
PERIOD = UNIVERSAL.timing.control_period
LOOP = 9.0, 0.08  # natural frequency [rad/s] and lag of the rotors [s]


def phasor(signal: np.ndarray, frequency: float) -> complex:
    """Of a swing of `frequency` [rad/s] in the last half of a `signal` (T,), beside a constant: least squares."""
    time = PERIOD * np.arange(len(signal))
    rows = np.stack([np.cos(frequency * time), -np.sin(frequency * time), np.ones_like(time)], axis=1)
    half = len(time) // 2
    found = np.linalg.lstsq(rows[half:], signal[half:], rcond=None)[0]
    return complex(found[0], found[1])


def loop_under(load: float, frequency: float, law: MultiModelLqg, seconds: float = 40.0) -> np.ndarray:
    """Pitch (T,) of one drone that a torque turns, an angular acceleration of `load` cos(w t) + 2, integrated by SciPy.

    The law commands it alone: N / (N - 1) = 1.
    """
    (natural, lag), damping = LOOP, UNIVERSAL.attitude.damping
    leader, observation = copy_gains(UNIVERSAL), np.zeros(18)
    memory = law.start(observation, np.array([1.0, 0.0, 0.0, 200.0]))
    state, angles = np.zeros(3), []
    for step in range(round(seconds / PERIOD)):
        observation[[4, 10]] = state[:2]
        command = law.command(np.zeros(3), memory, observation, leader)
        memory = law.next(memory, observation, command, leader)

        def change(time: float, now: np.ndarray, pitch: float = command[1]) -> list[float]:
            angle, rate, rotors = now
            asked = natural**2 * (pitch - angle) - 2 * damping * natural * rate
            return [rate, load * np.cos(frequency * time) + 2.0 + rotors, (asked - rotors) / lag]

        ends = step * PERIOD, (step + 1) * PERIOD
        state = solve_ivp(change, ends, state, rtol=1e-8, atol=1e-10).y[:, -1]
        angles.append(state[0])
    return np.array(angles)


@pytest.mark.parametrize(("frequency", "share"), [(1.28, 0.15), (2.3, 0.05), (2.2, 0.7), (2.7, 1.0), (4.2, 0.05)])
def test_a_torque_that_swings_turns_an_integrated_loop_less(frequency: float, share: float) -> None:
    """At one of the frequencies it leaves next to nothing, half way between two of them, 2.7 rad/s, nearly all."""
    law = multi_model_lqg(UNIVERSAL, (LOOP,))
    late, ahead = (abs(phasor(loop_under(5.0, frequency, one), frequency)) for one in (still(law), law))
    assert ahead < share * late


@pytest.mark.parametrize("place", range(len(FREQUENCIES)))
def test_the_factor_is_that_of_a_filter_in_time(place: int) -> None:
    """The filter runs on a loop that a torque turns; its estimate times the factor is what rotors must be told."""
    law, frequency, (natural, lag) = multi_model_lqg(UNIVERSAL, (LOOP,)), FREQUENCIES[place], LOOP
    damping = 2 * UNIVERSAL.attitude.damping * natural
    transition, _, gain, _ = angle_filter(natural**2, damping, lag, PERIOD, TUNING.torque_walk)
    torque = np.cos(frequency * PERIOD * np.arange(4000))
    state, estimate, found = np.zeros(5), np.zeros(5), []
    for now in torque:
        state[2:4] = now, 0.0  # what turns is held over a step, as filters take it
        estimate = estimate + gain @ (state[:2] - estimate[:2])
        found.append(estimate[2])
        state, estimate = transition @ state, transition @ estimate
    factor = 1 + complex(*law.swing_ahead[0, place])
    told = factor * phasor(np.array(found), frequency)
    assert abs(told - (1 + 1j * frequency * lag) * phasor(torque, frequency)) < 0.01


def observed(load: np.ndarray, ahead: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(weights (T, 2, J), growth (T, 2)) of one model with a factor `ahead` (J, 2) for loads (T, 2)."""
    swing, memory = observers(PERIOD), np.zeros(2 * len(FREQUENCIES) * STATES)
    weights, grown = [], []
    for now in load:
        found = swings_seen(swing, 1.0 - PERIOD / ENERGY_TIME, memory, now)
        weights.append(found.weights)
        grown.append(swings_grown(ahead[None], found, np.ones((2, 1))))
        memory = swings_advanced(swing, found)
    return np.array(weights), np.array(grown)


def test_each_axis_finds_its_frequency_and_amplitude() -> None:
    """A factor of 2 at every frequency, 1 more: the growth is the swing itself, without the constant.

    To 7 % of the larger swing, as observers are slow to follow: in 8 s at 1.28 rad/s, and the others have a weight.
    """
    time = PERIOD * np.arange(1500)
    load = np.stack([0.1 * np.sin(FREQUENCIES[2] * time) + 0.3, 0.05 * np.cos(FREQUENCIES[5] * time) - 0.1], axis=1)
    weights, grown = observed(load, np.tile([1.0, 0.0], (len(FREQUENCIES), 1)))
    np.testing.assert_allclose(weights.sum(axis=-1), 1.0)
    assert weights[-1, 0].argmax() == 2
    assert weights[-1, 1].argmax() == 5
    assert weights[-1].max(axis=-1).min() > 0.95
    np.testing.assert_allclose(grown[-250:], load[-250:] - [0.3, -0.1], atol=7e-3)
    _, across = observed(load, np.tile([0.0, 1.0], (len(FREQUENCIES), 1)))
    wanted = np.stack([0.1 * np.cos(FREQUENCIES[2] * time), -0.05 * np.sin(FREQUENCIES[5] * time)], axis=1)
    np.testing.assert_allclose(across[-250:], wanted[-250:], atol=7e-3)


def test_a_load_at_rest_does_not_grow() -> None:
    _, grown = observed(np.tile([0.3, -0.2], (1500, 1)), np.ones((len(FREQUENCIES), 2)))
    assert np.abs(grown[-250:]).max() < 1e-3


def test_three_drones_hold_a_load_that_circles_closer() -> None:
    config = plant_setup("team3")
    mounts = np.array([drone.mount for drone in config.plant.drones])
    follower = MultiModelOffsetFree(UNIVERSAL, np.asarray(team_geometry(config.plant, mounts, np.float64(3))))
    scenario, peaks = Scenario(omega=2.3, amplitude=0.05, path=CIRCLE, seconds=25.0), []
    for law in (still(follower._law), follower._law):
        follower._law = law
        flown = simulate(config, Baseline(follower, config), scenario, "newton-euler")
        peaks.append(np.linalg.norm(flown.error[-500:], axis=-1).max())
    assert peaks[1] < 0.8 * peaks[0]
