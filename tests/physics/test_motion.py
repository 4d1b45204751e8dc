"""Motions of the CG: consistent derivatives, the object's ends, the rolling ball, mass changes."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from plants import BEAM, ROLLING, SAMPLES, copying, paper_with
from scipy.interpolate import CubicSpline

from mjxball import config as configs
from mjxball.commands.train import main as train
from mjxball.config import Attitude, Drone, Motion, Plant, replace
from mjxball.control import rotations
from mjxball.errors import InputError
from mjxball.evaluate.scenarios import read_waveform
from mjxball.physics import motion, newton_euler
from mjxball.physics.engine import Engine, Load, PathShape, PlantState, Wrench
from mjxball.physics.step import jax_repeat, make_plant_step, start_state
from mjxball.sim.rollout import simulate
from mjxball.sim.scenario import Scenario

GAP = 1e-4  # [s] of the central differences below
PLACES = np.array([0.3, -1.0, 1.0, 0.9, -0.2])


PLATE = Plant(cg_axis="xy", object_size=(0.4, 0.4, 0.02))
ELLIPSE = PathShape(np.array(0.7), np.array(0.6), np.array(1.0), np.array(1.5))
EIGHT = PathShape(np.array(-0.4), np.array(0.8), np.array(2.0), np.array(0.3))
IN_PLANE = {"ellipse": ELLIPSE, "figure of eight": EIGHT, "sine along x": None}


@pytest.mark.parametrize("kind", [*IN_PLANE, "waypoints", "waveform"])
def test_derivatives_of_paths_in_the_plane(kind: str) -> None:
    time = np.linspace(0.013, 18.9, 400)
    waves = dataclasses.replace(SAMPLES, offsets_across=tuple(reversed(SAMPLES.offsets)))
    curve = motion.make_cg_motion(paper_with(PLATE, waves if kind == "waveform" else Motion()))
    none, many = np.zeros((400, 0)), np.full(400, 1.0)
    places = np.broadcast_to(np.stack([PLACES, PLACES[::-1]], axis=-1), (400, len(PLACES), 2))
    load = Load(many, many, 0.1 * many, 0.8 * many, 0.4 * many, none, none, cg_shape=IN_PLANE.get(kind))
    load = load._replace(cg_path=places, follows_path=many) if kind == "waypoints" else load
    here, before, after = curve(time, load), curve(time - GAP, load), curve(time + GAP, load)
    assert here.offset.shape == (400, 2)
    np.testing.assert_allclose((after.offset - before.offset) / (2 * GAP), here.rate, atol=1e-6)
    np.testing.assert_allclose((after.rate - before.rate) / (2 * GAP), here.acceleration, atol=2e-4)
    if kind == "ellipse":  # on the conic of a sine and one of the same speed that leads by 1.5 rad
        c, s = np.cos(0.7), np.sin(0.7)
        u, v = (here.offset @ np.array([[c, -s], [s, c]])).T / np.array([[0.1], [0.06]])
        np.testing.assert_allclose(u**2 + v**2 - 2 * u * v * np.cos(1.5), np.sin(1.5) ** 2, atol=1e-12)


def test_half_an_hour_of_float32_steps_takes_half_an_hour() -> None:
    """The sum of 360 000 steps was 1.60 s too late, and the CG 4.8 rad ahead."""
    config = configs.preset("transport")
    still, period = Engine(lambda *_: (jnp.zeros(3), jnp.zeros(3)), None), config.timing.control_period  # type: ignore[arg-type]
    step = make_plant_step(config, still, jax_repeat, autopilot=lambda state, *_: (None, state.rotor_force))
    sines = (0.05, 3.0, 0.5)  # [m], [rad/s], [rad]
    load = Load(*(jnp.asarray(value) for value in (0.2, 0.2, *sines)), jnp.zeros(1), jnp.full(1, jnp.inf))
    begin = start_state(config, *[jnp.zeros(3)] * 3, load.object_mass, jnp.zeros(()))
    count = round(1800 / period)
    end = jax.jit(lambda state: jax.lax.fori_loop(0, count, lambda _, one: step(one, None, load), state))(begin)
    assert end.time.dtype == jnp.float32
    assert float(end.time) == 1800.0
    places = jnp.asarray(PLACES)
    for kind, path in {
        "sine": motion.sine,
        "ellipse": lambda time, *given: motion.lissajous(time, *given, ELLIPSE),
        "waypoints": lambda time, *given: motion.waypoints(time, *given, places),
    }.items():
        for late in (0.0, 2.345):  # [s] at 3 rad/s, whose product with 1800 s rounds by 2e-4 rad
            told = (jnp.asarray(value) for value in sines)
            found, true = path(end.time + jnp.asarray(late), *told), path(np.float64(1800 + late), *sines)
            np.testing.assert_allclose(found.offset, true.offset, atol=0.05 * 1e-3, err_msg=f"{kind} {late}")


@pytest.mark.parametrize("kind", ["sine", "waveform", "waypoints"])
def test_rate_and_acceleration_are_the_offsets_derivatives(kind: str) -> None:
    time = np.linspace(0.013, 18.9, 400)
    if kind == "sine":
        curve = lambda t: motion.sine(t, 0.1, 2.7, 0.4)  # noqa: E731
    elif kind == "waypoints":
        curve = lambda t: motion.waypoints(t, 0.1, 0.8, 0.4, PLACES)  # noqa: E731
    else:
        spline = motion.fit_spline(SAMPLES.times, SAMPLES.offsets)
        curve = lambda t: motion.follow_spline(spline, t)  # noqa: E731
    here, before, after = curve(time), curve(time - GAP), curve(time + GAP)
    # Central differences: an error of GAP^2 times the third derivative (about 2 m/s3), and near a spline's
    # knot GAP times the jump of c''' (below 1 m/s3).
    np.testing.assert_allclose((after.offset - before.offset) / (2 * GAP), here.rate, atol=1e-6)
    np.testing.assert_allclose((after.rate - before.rate) / (2 * GAP), here.acceleration, atol=2e-4)


def test_visits_rest_at_every_place_and_are_hardly_faster_than_the_sine() -> None:
    amplitude, speed = 0.1, 2.0
    way = np.pi / speed
    resting = motion.waypoints(np.arange(12) * way, amplitude, speed, 0.0, PLACES)
    np.testing.assert_allclose(resting.offset, amplitude * np.resize(PLACES, 12), atol=1e-12)
    np.testing.assert_allclose(resting.rate, 0, atol=1e-12)
    np.testing.assert_allclose(resting.acceleration, 0, atol=1e-10)
    moving = motion.waypoints(np.linspace(0, 5 * way, 5001), amplitude, speed, 0.0, PLACES)
    assert np.abs(moving.offset).max() <= amplitude * (1 + 1e-12)
    # From end to end: 15/8 of the mean speed, 10/sqrt(3) of its change over the time.
    assert np.abs(moving.rate).max() == pytest.approx(15 / 8 * 2 * amplitude / way, rel=1e-4)
    assert np.abs(moving.acceleration).max() == pytest.approx(10 / np.sqrt(3) * 2 * amplitude / way**2, rel=1e-4)


def test_spline_is_scipys_clamped_one_between_its_samples() -> None:
    spline, time = (
        motion.fit_spline(SAMPLES.times, SAMPLES.offsets),
        np.linspace(*SAMPLES.times[:: len(SAMPLES.times) - 1], 999),
    )
    exact = CubicSpline(SAMPLES.times, SAMPLES.offsets, bc_type="clamped")
    for order, found in enumerate(motion.follow_spline(spline, time)):
        np.testing.assert_allclose(found, exact(time, order), rtol=0, atol=1e-12)  # rounding of numbers below 1


def test_spline_passes_its_samples_and_stands_still_outside() -> None:
    spline = motion.fit_spline(SAMPLES.times, SAMPLES.offsets)
    at = motion.follow_spline(spline, np.array(SAMPLES.times))
    np.testing.assert_allclose(at.offset, SAMPLES.offsets, atol=1e-15)
    assert at.rate[0] == pytest.approx(0, abs=1e-15)
    outside = motion.follow_spline(spline, np.array([-5.0, 30.0]))
    np.testing.assert_allclose(outside.offset, [SAMPLES.offsets[0], SAMPLES.offsets[-1]], atol=1e-15)
    assert not outside.rate.any()
    assert not outside.acceleration.any()


@pytest.mark.parametrize(
    ("times", "offsets", "word"),
    [
        ((0.0, 1.0), (0.0, 0.2), "leave the object"),
        ((0.0, 1.0), (0.0, float("nan")), "between"),
        ((0.0, 2.0, 1.0), (0.0, 0.1, 0.0), "increase"),
        ((0.0, 1.0, 1.0), (0.0, 0.1, 0.0), "increase"),
        ((0.0, 1.0), (0.0,), "same number"),
        ((0.0,), (0.0,), "two or more"),
    ],
)
def test_unsound_waveforms_are_refused(times: tuple, offsets: tuple, word: str) -> None:
    with pytest.raises(InputError, match=word):
        configs.validate(paper_with(motion=Motion(kind="waveform", times=times, offsets=offsets)))


def test_waveform_that_swings_out_between_its_samples_is_refused() -> None:
    times, offsets = (0.0, 1.0, 1.2, 2.2), (-0.16, 0.165, 0.165, -0.16)
    config = configs.validate(paper_with(motion=Motion(kind="waveform", times=times, offsets=offsets)))
    with pytest.raises(InputError, match="between its samples"):
        simulate(config, copying(config), Scenario(seconds=1), "newton-euler")


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("", "no samples"),
        ("t,c\n0,0\n1,x\n", "line 3"),
        ("0,0,0\n1,1\n", "line 1"),
        ("0,0.05x\n1,1\n", "line 1"),
        ("0,0\n2\n", "line 2"),
    ],
)
def test_waveform_files_that_make_no_sense_are_refused(text: str, word: str, tmp_path) -> None:
    path = tmp_path / "wave.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=word):
        read_waveform(path)


def test_waveform_file_may_have_a_header(tmp_path) -> None:
    path = tmp_path / "wave.csv"
    path.write_text("time,offset\n0,0\n2.5,0.05\n")
    assert read_waveform(path) == ((0.0, 2.5), (0.0, 0.05))


def test_training_refuses_a_bad_waveform_and_writes_nothing(tmp_path, capsys) -> None:
    out = tmp_path / "run"
    flags = ["--motion.kind", "waveform", "--motion.times", "0,2,1", "--motion.offsets", "0,0.1,0"]
    assert train([*flags, "--out", str(out)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not out.exists()


def ball_alone(plant: Plant, offset: float, rate: float = 0.0, tilt: float = 0.0) -> PlantState:
    half = tilt / 2
    return PlantState(
        np.zeros((1, 3)),
        np.array([[np.cos(half), np.sin(half), 0, 0]]),
        np.zeros((1, 3)),
        np.zeros((1, 3)),
        np.zeros((1, 2, 4)),
        np.zeros(1, int),
        np.zeros(1),
        np.array([offset]),
        np.array([rate]),
    )


def test_ball_rolls_down_a_held_slope_with_five_sevenths_of_g() -> None:
    """On a pivot too heavy to turn, a solid ball rolls with 5/7 g sin(slope)."""
    plant = replace(BEAM, "drones.0.inertia", (1e9, 1e9, 1e9))
    engine = newton_euler.make_engine(plant, Attitude())
    state = ball_alone(plant, 0.0, tilt=0.3)
    zero = np.zeros((1, 3))
    _, _, ball = engine.rolling(state, Wrench(zero, zero), np.array([0.2]), np.zeros(1))
    assert ball[0] == pytest.approx(-5 / 7 * 9.81 * np.sin(0.3), rel=1e-6)  # the pivot yields by 1e-9


def test_ball_on_a_plate_rolls_down_it_whichever_way_it_tilts() -> None:
    """A plate too heavy to turn, tilted about x: straight down with 5/7 g sin(slope), and across nothing."""
    heavy = Drone(mass=1e9, inertia=(1e9, 1e9, 1e9))
    mounts = ((0.3, 0.0, 0.0), (-0.15, 0.26, 0.0), (-0.15, -0.26, 0.0))
    plant = dataclasses.replace(PLATE, drones=tuple(dataclasses.replace(heavy, mount=mount) for mount in mounts))
    state = ball_alone(plant, 0.0, tilt=0.3)._replace(ball_offset=np.array([[0.04, 0.03]]), ball_rate=np.zeros((1, 2)))
    weight = np.array([[0.0, 0.0, 3e9 * 9.81]])
    held = rotations.rotate_back(rotations.matrix_from_quaternion(state.quaternion), weight)
    engine = newton_euler.make_engine(plant, Attitude())
    _, _, ball = engine.rolling(state, Wrench(held, np.zeros((1, 3))), np.array([0.2]), np.zeros((1, 2)))
    # 1e-6: the ball moves 3e9 kg by 1e-9 of its own motion
    np.testing.assert_allclose(ball[0], [0.0, -5 / 7 * 9.81 * np.sin(0.3)], atol=1e-6)


def test_plates_friction_opposes_and_its_rim_pushes_inwards_along_the_radius() -> None:
    plate = dataclasses.replace(PLATE, ball_stop=0.14)
    force = motion.make_rolling_force(paper_with(plate, ROLLING))
    along, across = np.array([0.6, 0.8]), np.array([-0.8, 0.6])
    places = np.array([0 * along, 0.15 * along, 0.15 * along, 0.141 * along])
    rates = np.array([0.5 * across, 0 * across, 0.5 * across, -5.0 * along])
    free, pushed, sliding, leaving = force(places, rates, np.full(4, 0.2))
    friction = 0.005 * 0.2 * 9.81
    np.testing.assert_allclose(free, -friction * across, rtol=1e-12)
    np.testing.assert_allclose(pushed @ across, 0, atol=1e-12)
    assert pushed @ along < -1
    np.testing.assert_allclose(sliding, pushed - friction * across, rtol=1e-12)  # along the rim it rolls on
    np.testing.assert_allclose(leaving, friction * along, rtol=1e-12)  # it never pulls


def test_rolling_friction_opposes_and_stops_push_inwards() -> None:
    force = motion.make_rolling_force(paper_with(motion=ROLLING))
    end = 0.17 - 0.02
    mass = np.full(5, 0.2)
    offset = np.array([0.0, 0.0, end + 0.01, -end - 0.01, end + 0.001])
    rate = np.array([0.5, -0.5, 0.0, 0.0, -5.0])
    pushed = force(offset, rate, mass)
    assert pushed[0] == pytest.approx(-0.005 * 0.2 * 9.81)
    assert pushed[1] == pytest.approx(0.005 * 0.2 * 9.81)
    assert pushed[2] < -1
    assert pushed[3] > 1
    assert pushed[4] == pytest.approx(0.005 * 0.2 * 9.81)  # leaving the stop: it never pulls


def test_ball_stays_between_the_stops_and_comes_to_rest() -> None:
    """On a tilting beam that nobody balances the ball runs into a stop and stays near it."""
    config = paper_with(BEAM, ROLLING)
    flight = simulate(config, copying(config), Scenario(goal=(0, 0, 0), ball_start=0.05, seconds=30), "newton-euler")
    end = 0.17 - 0.02
    # 10 mm: the stop's spring gives (its natural frequency is 60 rad/s, the ball arrives with up to 0.6 m/s)
    assert np.abs(flight.cg_offset).max() < end + 0.01
    assert np.abs(flight.cg_offset).max() > end - 0.001
    assert np.ptp(flight.cg_offset[-100:]) < 1e-3


def test_object_mass_changes_at_its_times() -> None:
    config = paper_with()
    scenario = Scenario(seconds=4, mass_changes=((1.0, 0.3), (2.5, -0.4)))
    flight = simulate(config, copying(config), scenario, "newton-euler")
    for time, mass in ((0.98, 0.2), (1.0, 0.5), (2.48, 0.5), (2.5, 0.1), (4.0, 0.1)):
        assert flight.object_mass[round(time / 0.02)] == pytest.approx(mass)


def test_ball_larger_than_the_rod_is_refused() -> None:
    with pytest.raises(InputError, match="larger than the object"):
        configs.validate(paper_with(dataclasses.replace(Plant(), ball_radius=0.2)))


def test_zero_inertia_and_too_large_a_step_are_refused() -> None:
    with pytest.raises(InputError, match=r"plant\.drones\.0\.inertia"):
        configs.validate(paper_with(replace(Plant(), "drones.0.inertia", (0.0, 1e-3, 1e-3))))
    with pytest.raises(InputError, match="200 Hz"):
        configs.validate(configs.replace(paper_with(), "timing.physics_steps", 3))
