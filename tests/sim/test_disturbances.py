"""Disturbances do what they say, are the same in every batch, and are refused when they make no sense."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from plants import copying

from mjxball.config import preset
from mjxball.errors import InputError
from mjxball.sim import rollout
from mjxball.sim.disturbances import LONGEST_GAP, Disturbance, attitude_errors, record, sensors_of
from mjxball.sim.goals import GoalMotion
from mjxball.sim.rollout import simulate, simulate_batch
from mjxball.sim.scenario import Scenario, check_scenario
from mjxball.sim.sensors import ATTITUDE_OFFSET, NOISE, OFFSET, RESOLUTION, Sample

CONFIG, PERIOD = preset("paper"), 0.02
SEEN = np.arange(18.0)[None]


def seen_by(disturbance: Disturbance, steps: int) -> np.ndarray:
    """Observations (steps + 1, 18) of a truth that counts: at step k every slot holds k."""
    sensors, settings = sensors_of([disturbance], PERIOD)
    samples = record([disturbance], steps + 1, PERIOD)
    state, first = sensors.start(np.zeros((1, 18)), samples.at(0), settings)
    seen = [first[0]]
    for k in range(1, steps + 1):
        state, observed = sensors.step(state, np.full((1, 18), float(k)), samples.at(k))
        seen.append(observed[0])
    return np.array(seen)


def test_nothing_is_disturbed_by_default() -> None:
    np.testing.assert_array_equal(seen_by(Disturbance(), 5), np.arange(6.0)[:, None] * np.ones(18))


def test_quantized_measurements_are_the_nearest_multiples_of_the_resolution() -> None:
    sensors, settings = sensors_of([Disturbance(quantize=True)], PERIOD)
    truth = np.random.default_rng(0).uniform(-1.0, 1.0, (1, 18))
    _, seen = sensors.start(truth, record([Disturbance(quantize=True)], 1, PERIOD).at(0), settings)
    # The nearest: half a step at most.
    assert (np.abs(seen - truth) <= RESOLUTION / 2 * (1 + 1e-9)).all()
    np.testing.assert_allclose(seen / RESOLUTION, np.round(seen / RESOLUTION), atol=1e-9)


def test_noise_has_its_deviation() -> None:
    errors = seen_by(Disturbance(noise=2.0, seed=3), 20_000) - np.arange(20_001.0)[:, None]
    np.testing.assert_allclose(errors.std(axis=0), 2 * NOISE, rtol=0.03)  # 5 deviations of a deviation of 20 000
    assert np.abs(errors.mean(axis=0) / NOISE).max() < 0.1


def test_delay_shows_the_past() -> None:
    np.testing.assert_array_equal(seen_by(Disturbance(delay=0.06), 5)[:, 0], [0, 0, 0, 0, 1, 2])


def test_a_lagging_pose_follows_by_its_time_constant() -> None:
    seen = seen_by(Disturbance(pose_lag=0.1), 400)
    # Behind a ramp of one a step the filter x += (1 - q) (u - x), q = exp(-period / lag), stays q / (1 - q) behind.
    share = np.exp(-PERIOD / 0.1)
    np.testing.assert_allclose(400 - seen[-1, [0, 1, 2, 6, 7, 8]], share / (1 - share), rtol=1e-9)
    np.testing.assert_array_equal(seen[-1, [3, 4, 5, 9, 10, 11]], 400)


def test_gaps_hold_the_measurement_at_their_rate_and_lengths() -> None:
    seen = seen_by(Disturbance(gap_rate=0.5, seed=4), 50_000)
    held = np.diff(seen[:, 0]) == 0
    begins = np.flatnonzero(np.diff(np.concatenate([[False], held]).astype(int)) == 1)
    lengths = np.array([np.argmin(held[first : first + 100]) for first in begins[:-1]])
    # 1000 s: 0.5 gaps a second of those outside of gaps; logarithms of lengths uniform on 1 to 25 steps, so that a gap
    # is longer than k steps with a probability of 1 - ln k / ln 25; four deviations.
    outside = PERIOD * (~held).sum()
    assert abs(len(begins) - 0.5 * outside) < 4 * np.sqrt(0.5 * outside)
    assert lengths.max() == round(LONGEST_GAP / PERIOD)
    for steps in (1, 5, 12):
        longer = 1 - np.log(steps) / np.log(25)
        assert np.mean(lengths > steps) == pytest.approx(longer, abs=4 * 0.5 / np.sqrt(len(lengths)))


def test_constant_errors_have_their_deviation_and_stay() -> None:
    errors = np.array([seen_by(Disturbance(offset=2.0, seed=seed), 1) for seed in range(2000)])
    np.testing.assert_array_equal(errors[:, 1] - 1, errors[:, 0].astype(np.float32))
    np.testing.assert_allclose(errors[:, 0].std(axis=0), 2 * OFFSET, rtol=0.08)  # five deviations of 2000
    attitude = np.array([attitude_errors(Disturbance(offset=2.0, seed=seed), 2) for seed in range(2000)])
    np.testing.assert_allclose(attitude.std(axis=0), np.array([2 * ATTITUDE_OFFSET] * 2), rtol=0.08)


def test_commands_are_late_by_whole_physics_steps_up_to_the_jitter() -> None:
    late = record([Disturbance(jitter=0.01, seed=3)], 30_000, PERIOD, (), 4).late[:, 0]
    assert set(late) == {0.0, 1.0, 2.0}
    np.testing.assert_allclose([np.mean(late == k) for k in range(3)], 1 / 3, atol=0.011)  # four deviations


def test_gusts_have_their_size_and_correlation() -> None:
    force = record([Disturbance(gust=0.4, seed=2)], 200_000, PERIOD).force[:, 0]
    # 4000 s of a process that forgets in 1 s: 2000 independent values, deviations within 5 %.
    np.testing.assert_allclose(force.std(axis=0), 0.4, rtol=0.08)
    after = round(1.0 / PERIOD)
    for k in range(3):
        assert np.corrcoef(force[:-after, k], force[after:, k])[0, 1] == pytest.approx(np.exp(-1), abs=0.08)


def test_a_steady_force_shifts_the_pair_as_statics_says(monkeypatch: pytest.MonkeyPatch) -> None:
    """Against a held force F the PD leader and its copy rest where M kp e = F: e = F / (M kp) along y and z."""
    force = np.array([0.0, 0.11, -0.22])
    monkeypatch.setattr(rollout, "record", lambda _, count, *rest: Sample(force=np.broadcast_to(force, (count, 1, 3))))
    flight = simulate(CONFIG, copying(CONFIG), Scenario(amplitude=0.0, goal=(0, 0, 0), seconds=60), "newton-euler")
    # Thrust along body z makes the same force as commanded acceleration; 2.2 kg, kp 0.5; tilt's second order is 1e-4.
    np.testing.assert_allclose(flight.error[-1, 1:], -force[1:] / (2.2 * 0.5), atol=2e-3)


def test_scenarios_are_the_same_alone_and_in_a_batch() -> None:
    noisy = Scenario(
        seconds=3,
        disturbance=Disturbance(
            noise=1.0, gust=0.3, gap_rate=0.5, jitter=0.01, offset=1.0, pose_lag=0.05, delay=0.04, seed=5
        ),
    )
    other = dataclasses.replace(noisy, disturbance=Disturbance(noise=2.0, seed=6))
    alone = simulate(CONFIG, copying(CONFIG), noisy, "newton-euler")
    batch = simulate_batch(CONFIG, [(copying(CONFIG), [Scenario(seconds=3), other, noisy])], "newton-euler").world(2)
    np.testing.assert_allclose(batch.position, alone.position, atol=1e-12)


@pytest.mark.slow
def test_engines_agree_on_a_gusty_flight() -> None:
    scenario = Scenario(seconds=4, disturbance=Disturbance(gust=0.5, seed=1), start_tilt=(0.1, 0.1))
    flights = [simulate(CONFIG, copying(CONFIG), scenario, engine) for engine in ("newton-euler", "mjx", "mujoco")]
    for flight in flights[1:]:
        np.testing.assert_allclose(flight.position, flights[0].position, atol=1e-6)


def test_waypoints_become_the_goal_at_their_time() -> None:
    scenario = Scenario(goal=(1, 0, 1), waypoints=((2.0, (0.0, 0.0, 1.0)),), seconds=4)
    flight = simulate(CONFIG, copying(CONFIG), scenario, "newton-euler")
    np.testing.assert_array_equal(flight.target[99], (1, 0, 1))
    np.testing.assert_array_equal(flight.target[100], (0, 0, 1))
    np.testing.assert_array_equal(flight.goal, (0, 0, 1))
    np.testing.assert_allclose(flight.observation[100, 12:15], flight.error[100])


def test_start_errors_are_where_the_flight_begins() -> None:
    start = {"start_position": (0.1, 0.2, 0.3), "start_velocity": (0.4, 0.5, 0.6), "start_tilt": (0.1, -0.2)}
    flight = simulate(CONFIG, copying(CONFIG), Scenario(seconds=0.1, **start), "newton-euler")
    np.testing.assert_allclose(flight.position[0], start["start_position"])
    np.testing.assert_allclose(flight.velocity[0], start["start_velocity"])
    np.testing.assert_allclose(flight.euler[0], (0.1, -0.2, 0.0), atol=1e-12)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"disturbance": Disturbance(delay=0.03)}, "multiple of the control period"),
        ({"disturbance": Disturbance(noise=-1.0)}, "negative"),
        ({"disturbance": Disturbance(gust=float("nan"))}, "finite"),
        ({"disturbance": Disturbance(jitter=0.02)}, "below the control period"),
        ({"disturbance": Disturbance(gap_rate=50.0)}, "below one a control period"),
        ({"wind": (1.0, 0.0, 0.0)}, "rotor drag, which is 0"),
        ({"download": 1.0}, "below 1"),
        ({"loop_scale": 0.0}, "positive"),
        ({"thrust_fade": 0.03}, "leaves no thrust"),
        ({"goal_motion": GoalMotion(speed=float("nan"))}, "goal's motion"),
        ({"waypoints": ((5.0, (1.0, 1.0, 1.0)), (2.0, (0.0, 0.0, 0.0)))}, "order of time"),
        ({"waypoints": ((5.0, (9.0, 1.0, 1.0)),)}, "beyond d_term"),
        ({"start_position": (5.0, 0.0, 0.0)}, "beyond d_term"),
    ],
)
def test_unsound_disturbances_are_refused(change, word) -> None:
    with pytest.raises(InputError, match=word):
        check_scenario(CONFIG, dataclasses.replace(Scenario(), **change))
