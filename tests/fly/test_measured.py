"""What is measured of a drone: streams that stand still, frames and estimates that its IMU contradicts."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from captured import CapturedTwin
from tables import rows, weekly

from mjxball.control import rotations
from mjxball.physics.step import start_state
from mjxfly import measured, probe
from mjxfly.controller import FlightController
from mjxfly.limits import FlightSettings
from mjxfly.measured import CONTRADICTING, REPEATING, WINDOW, DroneWatch, ImuWatch, Repeats
from mjxfly.mocap_supervision import Frame as PoseFrame
from mjxfly.mocap_supervision import Pose
from mjxfly.packets import DroneState
from mjxfly.policy_setup import load_follower
from mjxfly.supervisor import Event, FlightState
from mjxfly.telemetry import Sample
from mjxfly.twin.conditions import Surroundings
from virtual_twin import VirtualTwin

PACKET = 0.02  # [s]
Parts = tuple[float, ...]


def found_after(
    parts: Callable[[int], Parts | None], begin: float = 2.0, end: float = 12.0
) -> tuple[float | None, str]:
    """(time after `begin` [s] at which a stream is said to stand still, which part); `parts` None: no packet."""
    watch = Repeats(("x", "y"))
    for number in range(round(end / PACKET)):
        one = parts(number)
        name = "" if one is None else watch.update(one, PACKET * number)
        if name:
            return PACKET * number - begin, name
    return None, ""


def frozen(number: int, part: int | None) -> Parts:
    """Numbers that change until packet 100; from there on all, or `part`, are those of that packet."""
    return tuple(float(min(number, 100) if part in (None, axis) else number) for axis in range(2))


@rows(
    "parts, after, name",
    [
        (lambda n: (float(n), float(-n)), None, ""),
        (lambda n: frozen(n, None), REPEATING, "x"),
        (lambda n: frozen(n, 1), REPEATING, "y"),
        (lambda n: (float(n // 2), float(n // 2)), None, ""),  # every second one repeated: half the rate
        (lambda n: (float(n // 10), float(n // 10)), None, ""),  # 5 Hz
        (lambda n: (1.0, 1.0), None, ""),  # never was a stream
        (lambda n: None if 100 < n < 140 else (float(n - n % 2), float(n)), None, ""),
        # Half of the time is a gap of which nothing is known: 0.26 s more must be seen.
        (lambda n: None if 113 <= n < 150 else frozen(n, None), REPEATING + 0.74, "x"),
    ],
)
def test_what_stands_still_is_found_within_half_a_second(
    parts: Callable[[int], Parts | None], after: float | None, name: str
) -> None:
    when, which = found_after(parts)
    assert which == name
    assert when == (None if after is None else pytest.approx(after, abs=1.5 * PACKET))


def test_sparse_poses_are_no_frozen_ones() -> None:
    """10 Hz of which 20 % never come: gaps of half a second are usual, and 0.9 s are a stop."""
    for seed in range(20):
        random, last = np.random.default_rng(seed), [0]

        def poses(number: int, random=random, last=last) -> Parts:
            if number % 5 == 0 and random.random() > 0.2 and number < 3000:
                last[0] = number
            return float(last[0]), float(last[0])

        when, _ = found_after(poses, begin=60.0, end=70.0)
        assert when == pytest.approx(1.0, abs=0.5), seed


Frame = Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def signs(*numbers: float) -> np.ndarray:
    return np.array(numbers)


FRAMES: dict[str, Frame] = {
    "right": lambda p, q: (p, q),
    "mirrored x": lambda p, q: (p * signs(-1, 1, 1), q * signs(1, 1, -1, -1)),
    "mirrored y": lambda p, q: (p * signs(1, -1, 1), q * signs(1, -1, 1, -1)),
    "inverse attitude": lambda p, q: (p, q * signs(1, -1, -1, -1)),
    "y up": lambda p, q: (p[[0, 2, 1]] * signs(1, 1, -1), q[[0, 1, 3, 2]] * signs(1, 1, 1, -1)),
    "z down": lambda p, q: (p * signs(1, 1, -1), q),
    "frozen attitude": lambda p, q: (p, signs(1, 0, 0, 0)),
    "position twice as large": lambda p, q: (2 * p, q),
}


def watched(frame: Frame, late: int = 0) -> tuple[float | None, str]:
    """When (s after the lift) a drone that lifts and turns as in `probe` is contradicted in a `frame`, and how.

    Its attitude follows 3 degrees of both roll and pitch to and fro; it rises with 0.5 m/s2. Poses are `late` packets.
    """
    watch, poses = ImuWatch(), []
    place, speed = np.zeros(3), np.zeros(3)
    for number in range(300):
        time = 0.01 * number
        phase = 2 * math.pi * max(time - 1.0, 0.0) / probe.PERIOD
        angle, rate = math.radians(3) * math.sin(phase), math.radians(3) * math.cos(phase) * 2 * math.pi / probe.PERIOD
        rate = rate if time >= 1.0 else 0.0
        quaternion = rotations.quaternion_from_euler(np.array([angle, angle, 0.0]))
        matrix = rotations.matrix_from_quaternion(quaternion)
        force = np.array([0.0, 0.0, 9.81 + (0.5 if time >= 1.0 else 0.0)])
        felt = matrix @ force - np.array([0.0, 0.0, 9.81]) if time >= 1.0 else np.zeros(3)
        speed, place = speed + 0.01 * felt, place + 0.01 * speed
        rates = np.array([rate, rate * math.cos(angle), -rate * math.sin(angle)])  # of Rz Ry Rx with these two alike
        state = DroneState(place, speed, quaternion, rates, 0, 3.9)
        watch.turn(Sample(state, time, time))
        poses.append(frame(place, quaternion))
        if number % 2 == 0:
            why = watch.update(time, force, *poses[max(len(poses) - 1 - late, 0)])
            if why:
                return time - 1.0, why
    return None, ""


def test_a_frame_is_contradicted_as_soon_as_the_pair_moves() -> None:
    assert watched(FRAMES["right"]) == (None, "")
    assert watched(FRAMES["right"], late=2) == (None, "")  # 20 ms behind the gyroscope
    for name, how in (
        ("mirrored x", "gyroscope"),
        ("mirrored y", "gyroscope"),
        ("inverse attitude", "gyroscope"),
        ("frozen attitude", "gyroscope"),
        ("y up", "gyroscope"),
        ("z down", "accelerometer"),
        ("position twice as large", "accelerometer"),
    ):
        after, why = watched(FRAMES[name])
        assert after is not None, name
        assert how in why, (name, why)
        # It turns within a quarter of a period, or has risen by 5 cm within the window; then it must last.
        assert after <= (0.25 * probe.PERIOD if how == "gyroscope" else WINDOW) + CONTRADICTING + 0.1, (name, after)


def test_what_a_hand_has_not_shown_yet_is_asked_for() -> None:
    """Turned by 20 degrees about each axis, then moved by 0.2 m along each, to and fro in 1.6 s; 2 s of rest before."""
    watch, step, period, asked = ImuWatch(), 0.01, 1.6, []
    for number in range(round((2.0 + 6 * period) / step) + 1):
        time = step * number
        part, since = divmod(max(time - 2.0, 0.0), period)
        phase = 2 * math.pi / period
        size, speed = 0.5 - 0.5 * math.cos(phase * since), 0.5 * phase * math.sin(phase * since)
        axis = np.eye(6)[min(int(part), 5)] * (time > 2.0)
        turned, moved = math.radians(20) * axis[:3], 0.2 * axis[3:]
        quaternion = np.array(
            [math.cos(0.5 * size * math.radians(20)), *(math.sin(0.5 * size * math.radians(20)) * axis[:3])]
        )
        quaternion[0] = math.sqrt(1 - (quaternion[1:] ** 2).sum())
        pushed = 0.5 * phase**2 * math.cos(phase * since) * moved + [0.0, 0.0, 9.81]
        force = rotations.matrix_from_quaternion(quaternion).T @ pushed
        watch.turn(Sample(DroneState(size * moved, speed * moved, quaternion, speed * turned, 0, 3.9), time, time))
        assert watch.update(time, force, size * moved, quaternion) == "", time
        if not asked or asked[-1] != watch.unverified_axes():
            asked.append(watch.unverified_axes())
    turn, move = "turn it 10 degrees about its", "move it 0.1 m along"
    assert asked == [
        f"{turn} x, y, z and {move} x, y, z", f"{turn} y, z and {move} x, y, z", f"{turn} z and {move} x, y, z",
        f"{move} x, y, z", f"{move} y, z", f"{move} z", "",
    ]  # fmt: skip


def test_the_probe_leaves_neither_speed_nor_offset_and_turns_about_the_stick() -> None:
    times = np.arange(0.0, probe.TIME + 0.1, 1e-3)
    for span, axis in ((np.array([0.0, 0.3, 0.0]), 1), (np.array([-0.3, 0.0, 0.0]), 0)):
        sent = np.array([probe.command(time, span) for time in times])
        assert np.abs(sent[:, axis]).max() == pytest.approx(probe.TILT)
        assert np.abs(np.delete(sent, axis, axis=1)).max() == 0
        speed = np.cumsum(9.81 * sent[:, axis]) * 1e-3
        assert abs(speed[-1]) < 1e-3
        assert abs(speed.sum() * 1e-3) < 1e-3
        assert np.abs(np.cumsum(speed) * 1e-3).max() < 0.02  # [m]


def test_a_coarse_quaternion_keeps_its_turn() -> None:
    """11 bits for each number: what is small is fine, what is near 1 is not."""
    exact = rotations.quaternion_from_euler(np.array([0.02, -0.03, 0.1]))
    for sign in (1.0, -1.0):
        coarse = (sign * exact).astype(np.float16).astype(float)
        beside = measured.relative(sign * exact, measured.unit(tuple(coarse)))
        assert np.linalg.norm(beside[1:]) < 5e-5


# Whole flights on the twin of a Crazyflie pair.

FLIGHT = load_follower(Path("lqg"))
HOVER = FlightSettings(seconds=30.0)


def hovering(world: VirtualTwin, seconds: float) -> VirtualTwin:
    """`world` in the air, `seconds` after the controllers took over at the goal."""
    config, place = FlightController(FLIGHT).config, [np.array([0.0, 0.0, 0.4]), np.zeros(3), np.zeros(3)]
    world.start_in_air(start_state(config, *place, np.float64(world.pair.conditions.object_mass), np.float64(0.0)))
    world.fly_for(seconds)
    assert world.flight.supervisor.state is FlightState.FLY
    return world


def ended(world: VirtualTwin, limit: float) -> tuple[float, float, str, str]:
    """(s until a fault of now ends the flight, m that O moved until then, event, detail); inf if nothing does."""
    began, start = world.now, world.moment().position
    while world.now < began + limit:
        world.tick()
        cause = world.flight.supervisor.cause
        if cause is not None:
            assert world.flight.supervisor.state in (FlightState.DESCEND, FlightState.HOLD, FlightState.STOP)
            moved = float(np.linalg.norm(world.moment().position - start))
            return world.now - began, moved, cause.event.name, cause.detail
    return math.inf, float(np.linalg.norm(world.moment().position - start)), "", ""


# What happens to the poses of which drones, within [s], with at most this way of O [m], and what is said.
POSES: list[tuple[str, float, tuple[int, ...], float, float, str]] = [
    ("frozen", 1.0, (0,), 0.6, 0.02, "leader: x of its measured pose stands still"),
    ("frozen", 1.0, (0, 1), 0.6, 0.02, "of its measured pose stands still"),
    ("frozen z", 1.0, (1,), 0.6, 0.02, "follower: z of its measured pose stands still"),
    ("repeated", 2.0, (0, 1), math.inf, 0.03, ""),  # 50 Hz, every pose twice: a sparser stream
    ("jump", 0.2, (0,), 0.6, 0.1, "the stick tilts"),  # and frozen there
]


@pytest.mark.slow
@pytest.mark.parametrize("row", [POSES[0], POSES[3], *weekly(POSES[1], POSES[2], POSES[4])], ids=str)
def test_poses_that_stand_still_end_the_flight_within_half_a_second(row) -> None:
    what, value, drones, within, way, said = row
    world = hovering(VirtualTwin(FLIGHT, HOVER), 1.0)
    for drone in drones:
        world.pair.disturb(drone, what, value)
        if what == "jump":
            world.advance(0.02)
            world.pair.disturb(drone, "frozen", 1.0)
    after, moved, _, detail = ended(world, 2.0)
    assert after <= within
    assert moved <= way
    assert said in detail
    assert math.isinf(within) == math.isinf(after)


@pytest.mark.slow
def test_a_deck_whose_measurements_no_log_shows_is_found_by_the_stick(monkeypatch: pytest.MonkeyPatch) -> None:
    """A frozen pose drags one estimate along until both differ by 15 mm more than they did: measured 4.2 s, 28 mm."""
    monkeypatch.setattr(measured, "LIVE", 10**9)
    world = hovering(VirtualTwin(FLIGHT, HOVER), 1.0)
    world.pair.disturb(0, "frozen", 1.0)
    after, moved, event, detail = ended(world, 6.0)
    assert (event, detail[-28:]) == ("ESTIMATOR", "from where the stick puts it")
    assert after < 6.0
    assert moved < 0.05


@pytest.mark.slow
def test_a_state_that_stands_still_ends_the_flight() -> None:
    """All of it, with the thrust that it echoes: whichever is found first."""
    world = hovering(VirtualTwin(FLIGHT, HOVER), 0.5)
    world.fault_drone(0, frozen=True)
    after, _, event, _ = ended(world, 1.0)
    assert after <= 0.6
    assert event in ("ESTIMATOR", "FROZEN")


def test_an_estimate_or_a_gyroscope_that_repeats_itself_is_found_within_half_a_second() -> None:
    for part, name in ((None, ""), ("position", "estimate"), ("rates", "gyroscope")):
        watch, found = DroneWatch((0, 1, 2)), {}
        for number in range(200):
            moves = {"position": number, "rates": number}
            moves |= {part: min(number, 100)} if part else {}
            numbers = {key: 1e-3 * value * np.ones(3) for key, value in moves.items()}
            state = DroneState(velocity=np.zeros(3), quaternion=signs(1, 0, 0, 0), info=0, battery=4.0, **numbers)
            why = watch.state(Sample(state, 0.01 * number, 0.01 * number))
            if why:
                found.setdefault(why, 0.01 * (number - 100))
        assert [name in why for why in found] == [True] * bool(name), (part, found)
        assert all(after == pytest.approx(REPEATING, abs=0.02) for after in found.values())


CONDITIONS = {
    "noise x 5": Surroundings(noise=5.0),
    "poses at 10 Hz, 20 % lost": Surroundings(pose_hz=10.0, pose_loss=0.2),
    "both": Surroundings(noise=5.0, pose_hz=10.0, pose_loss=0.2),
    "20 ms late": Surroundings(delay=0.02),
    "gains": Surroundings(gains=(1.08, 0.92)),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["both", *weekly(*(name for name in CONDITIONS if name != "both"))])
def test_nothing_is_said_in_good_flights(name: str) -> None:
    world = VirtualTwin(FLIGHT, FlightSettings(seconds=4.0), surroundings=CONDITIONS[name], settle=0.6)
    assert world.run(30.0) == "done"
    assert world.flight.supervisor.cause is None
    assert world.log.transitions() == ["arm", "spin", "ramp", "fly", "land", "stop", "done"]


def mapped(frame: Frame) -> Callable[[PoseFrame], PoseFrame]:
    def one(pose: Pose | None) -> Pose | None:
        if pose is None:
            return None
        position, quaternion = frame(np.array(pose.position), np.array(pose.quaternion))
        return pose._replace(position=tuple(position), quaternion=tuple(quaternion))

    return lambda poses: (one(poses[0]), one(poses[1]))


# "y up" of a pair along x is "x up" for this one, which lies along y: the stick is where it belongs.
X_UP: Frame = lambda p, q: (p[[2, 1, 0]] * signs(-1, 1, 1), q[[0, 3, 2, 1]] * signs(1, -1, 1, 1))  # noqa: E731


@pytest.mark.slow
@pytest.mark.parametrize("name", ["x up", *weekly("mirrored x", "inverse attitude", "z down")])
def test_a_wrong_frame_of_motion_capture_ends_the_flight_low(name: str) -> None:
    world = CapturedTwin(FLIGHT, HOVER, mapped(X_UP if name == "x up" else FRAMES[name]), settle=0.5)
    assert world.refusal() == ""  # nothing that stands shows it
    world.fly_until(FlightState.DESCEND, 8.0)
    world.fly_until(FlightState.STOP, 6.0)
    cause = world.flight.supervisor.cause
    track = [(one.position, one.tilt) for one in world.track]
    height = max(place[2] for place, _ in track) - world.rest
    beside = max(float(np.linalg.norm((place - track[0][0])[:2])) for place, _ in track)
    print(name, cause, height, beside, math.degrees(max(tilt for _, tilt in track)))
    assert cause is not None
    assert cause.event is Event.FRAME
    assert height < (0.05 if "gyroscope" in cause.detail else 0.1)  # what mismeasures the height climbs until it shows
    assert beside < 0.15
    assert max(tilt for _, tilt in track) < math.radians(8)


@pytest.mark.slow
def test_a_frame_of_wrong_scale_is_refused_on_the_ground_and_the_right_one_flies() -> None:
    world = CapturedTwin(FLIGHT, FlightSettings(seconds=4.0), settle=0.3)
    assert world.refusal() == ""
    for scale in (0.85, 1.2):
        other = mapped(lambda p, q, scale=scale: (scale * p, q))
        world.see, before = other, world.mocap.tracks
        world.advance(0.1)
        assert "scale" in world.refusal(), before
    world.see = lambda frame: frame
    world.advance(0.5)
    assert world.run(40.0) == "done"
    assert world.flight.supervisor.cause is None
    late = [one.position for one in world.track if one.state == "fly"][-50:]
    assert np.abs(np.mean(late, axis=0) - world.flight.goal(world.now)).max() < 0.05
