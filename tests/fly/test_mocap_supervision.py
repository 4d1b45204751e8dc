"""Which poses of a motion capture are sent and which end a flight: tables of what cameras do, without a clock."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from wire import unpack_pose

from mjxfly import packets
from mjxfly.mocap_supervision import (
    Frame,
    MocapLimits,
    Pose,
    Track,
    Tracks,
    faults,
    follow,
    pair_fault,
    pose_of,
    standing_fault,
)
from mjxfly.packets import PacketError
from mjxfly.supervisor import Event

LIMITS = MocapLimits()
SPAN = np.array([0.0, 0.3, 0.0])  # leader 0.3 m to the left of the follower, as on the Crazyflie rigs
LEVEL = (1.0, 0.0, 0.0, 0.0)
PLACES = ((0.0, 0.15, 0.4), (0.0, -0.15, 0.4))
PERIOD = 0.01


def frame(number: int, places: tuple = PLACES, turns: tuple = (LEVEL, LEVEL)) -> Frame:
    """What a camera system sees of a pair at rest: the same places with 10 um of noise."""
    noise = 1e-5 * np.sin(1.0 + 7 * number + np.arange(3))
    one, other = (Pose(PERIOD * number, tuple(place + noise), turn) for place, turn in zip(places, turns, strict=True))
    return one, other


def watched(frames: list[Frame], places: tuple = (None, None)) -> Tracks:
    tracks = (Track(), Track())
    for one in frames:
        tracks = follow(tracks, one, LIMITS, SPAN, places)
    return tracks


def moved(pose: Pose, far: float) -> Pose:
    return pose._replace(position=(pose.position[0] + far, *pose.position[1:]))


def test_poses_of_a_pair_at_rest_are_all_sent() -> None:
    tracks = watched([frame(number) for number in range(100)])
    assert [track.received for track in tracks] == [100, 100]
    assert all(track.good is track.last for track in tracks)
    assert standing_fault(tracks, 0.99, LIMITS, SPAN) == ""
    assert faults(tracks, 0.99 + LIMITS.lost - 1e-9) == []


STANDING: list[tuple[str, Callable[[int], Frame], str]] = [
    ("one pose", lambda n: frame(n, (PLACES[0], PLACES[0])), "both bodies have one pose"),
    ("swapped", lambda n: frame(n, PLACES[::-1]), "swapped"),
    ("another rig", lambda n: frame(n, ((0, 0.4, 0), (0, -0.4, 0))), "0.80 m apart on a rig of 0.30 m"),
    ("beside", lambda n: frame(n, ((0.3, 0, 0), (0, 0, 0))), "does not lie as the follower's attitude says"),
    ("frozen", lambda n: tuple(pose._replace(time=PERIOD * n) for pose in frame(0)), "its numbers stand still"),
    ("gone", lambda n: frame(n) if n < 40 else (frame(n)[0], None), "the follower's body: it is not seen"),
    ("never there", lambda n: (None, frame(n)[1]), "the leader's body: it was never seen"),
    ("jumping", lambda n: (moved(frame(n)[0], 0.09 * (n % 20 == 3)), frame(n)[1]), "jumps while it stands"),
    ("1.2 times", lambda n: frame(n, tuple(tuple(1.2 * x for x in place) for place in PLACES)), "is the scale 1.20"),
    (
        "a height that stands still",
        lambda n: tuple(with_z_of(p, q) for p, q in zip(frame(n), frame(0), strict=True)),
        "its z stands",
    ),
    # The right angle of a body defined with its x axis to the left, and a world with y up.
    ("turned", lambda n: frame(n, ((-0.15, 0, 0), (0.15, 0, 0)), ((0.5**0.5, 0, 0, 0.5**0.5),) * 2), "90 degrees off"),
    ("y up", lambda n: frame(n, ((0, 0, 0.15), (0, 0, -0.15)), ((0.5**0.5, 0.5**0.5, 0, 0),) * 2), "tilts 90 degrees"),
]


@pytest.mark.parametrize(("make", "reason"), [case[1:] for case in STANDING], ids=[case[0] for case in STANDING])
def test_what_stands_wrong_is_refused(make: Callable[[int], Frame], reason: str) -> None:
    tracks = watched([make(number) for number in range(100)])
    assert reason in standing_fault(tracks, 0.99, LIMITS, SPAN)


def flown(spoilt: Callable[[int, Frame], Frame], places: tuple = PLACES) -> tuple[list[int], float | None, str]:
    """Poses of both bodies fit to be sent in the 0.6 s from frame 100 on, when the fault comes [s after], and why."""
    tracks = watched([frame(number) for number in range(100)])
    sent, first, why = [0, 0], None, ""
    for number in range(100, 160):
        before = tracks
        tracks = follow(tracks, spoilt(number, frame(number)), LIMITS, SPAN, places)
        for body in range(2):
            sent[body] += tracks[body].good is not before[body].good
        found = faults(tracks, PERIOD * number)
        if found and first is None:
            assert {fault.event for fault in found} == {Event.POSE}
            first, why = PERIOD * number - 0.99, found[0].detail
    return sent, first, why


def held(frame: Frame) -> Frame:
    """The follower's body as it was seen in frame 99, with the time of `frame`."""
    return frame[0], HELD._replace(time=frame[0].time)


def with_z_of(pose: Pose, other: Pose) -> Pose:
    return pose._replace(position=(*pose.position[:2], other.position[2]))


HELD = frame(99)[1]
# (what happens to the follower's body from frame 100 on, poses of it that are sent, fault after [s] or None, why)
FLYING: list[tuple[str, Callable[[int, Frame], Frame], int, float | None, str]] = [
    ("nothing", lambda n, f: f, 60, None, ""),
    ("one glitch", lambda n, f: (f[0], moved(f[1], 0.4 * (n == 120))), 59, None, ""),
    ("a gap of 0.25 s", lambda n, f: f if n > 124 else (f[0], None), 35, None, ""),
    ("lost", lambda n, f: (f[0], None), 0, LIMITS.lost, "it is not seen"),
    ("frozen", lambda n, f: held(f), 0, LIMITS.frozen, "its numbers stand still"),
    (
        "jumps 0.4 m and stays",
        lambda n, f: (f[0], moved(f[1], 0.4)),
        0,
        LIMITS.lost,
        "0.40 m from where the drone believes",
    ),
    ("takes the leader's pose", lambda n, f: (f[0], f[0]), 0, LIMITS.lost, "0.30 m from where the drone believes"),
    # One coordinate is not sent from 0.2 s on, and the age of the last pose that was counts from there.
    ("z stands still", lambda n, f: (f[0], with_z_of(f[1], HELD)), 20, 0.2 + LIMITS.lost, "its z stands still"),
    ("every second one repeated", lambda n, f: frame(n - n % 2), 30, None, ""),
    # 1 m/s sideways while the leader and both estimates stand: sent until the rig's line is 10 cm wrong.
    ("creeps away", lambda n, f: (f[0], moved(f[1], 0.01 * (n - 99))), 10, 0.1 + LIMITS.lost, "believes to be"),
]


@pytest.mark.parametrize(("spoilt", "sent", "after", "why"), [c[1:] for c in FLYING], ids=[c[0] for c in FLYING])
def test_what_goes_wrong_in_flight_is_not_sent_and_ends_it(
    spoilt: Callable[[int, Frame], Frame], sent: int, after: float | None, why: str
) -> None:
    assert LIMITS.age < LIMITS.frozen < LIMITS.lost
    passed, first, reason = flown(spoilt)
    assert passed[1] == sent
    assert (first is None) == (after is None)
    if after is not None:
        assert first == pytest.approx(after, abs=1.5 * PERIOD)  # the first tick after the limit
        assert "no good pose of the follower for" in reason
        assert why in reason


def test_both_swapped_in_flight_are_never_sent() -> None:
    passed, first, _ = flown(lambda n, f: (f[1], f[0]))
    assert passed == [0, 0]
    assert first == pytest.approx(LIMITS.lost, abs=1.5 * PERIOD)


def test_fast_flight_is_no_jump() -> None:
    """4 m/s is under the bound of 5, 8 m/s is over it by more than the 2 cm for noise."""
    for speed, fit in ((4.0, True), (8.0, False)):
        far = [frame(n, tuple((speed * PERIOD * n, y, z) for _, y, z in PLACES)) for n in range(20)]
        tracks = watched(far)
        assert (tracks[0].good is tracks[0].last) is fit, speed


def test_a_rig_that_turns_is_judged_in_its_own_axes() -> None:
    for yaw in (0.5, 2.0, -3.0):
        turn = (math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
        ahead = 0.15 * np.array([-math.sin(yaw), math.cos(yaw), 0.0])
        places = (tuple(ahead), tuple(-ahead))
        tracks = tuple(Track(last=pose) for pose in frame(0, places, (turn, turn)))
        assert pair_fault((tracks[0], tracks[1]), LIMITS, SPAN) == ""
        tracks = tuple(Track(last=pose) for pose in frame(0, places[::-1], (turn, turn)))
        assert "swapped" in pair_fault((tracks[0], tracks[1]), LIMITS, SPAN)


def test_two_poses_of_different_times_are_not_compared() -> None:
    old, new = frame(0, PLACES[::-1]), frame(50, PLACES[::-1])
    assert pair_fault((Track(last=old[0]), Track(last=new[1])), LIMITS, SPAN) == ""


NUMBERS = st.floats(allow_nan=True, allow_infinity=True, width=32)


@given(st.lists(NUMBERS, min_size=7, max_size=7))
def test_what_is_cleaned_can_be_sent_and_nothing_else_is(numbers: list[float]) -> None:
    pose = pose_of(0.0, numbers)
    if pose is None:
        return
    position, quaternion = unpack_pose(packets.pose_packet(pose.position, pose.quaternion).data)
    np.testing.assert_allclose(position, numbers[:3], rtol=1e-6)
    assert quaternion[0] >= 0
    assert np.linalg.norm(quaternion) == pytest.approx(1, abs=1e-6)


def test_poses_that_are_none() -> None:
    good = [0.1, 0.2, 0.3, -0.5, 0.5, -0.5, 0.5]
    pose = pose_of(1.0, good)
    assert pose == Pose(1.0, (0.1, 0.2, 0.3), (0.5, -0.5, 0.5, -0.5))  # the same attitude with w positive
    assert pose_of(1.0, [*good[:3], *(1.01 * part for part in good[3:])]) is not None  # rounding of some systems
    bad = [[0, 0, 0, 0, 0, 0, 0], good[:6], [math.nan, *good[1:]], [*good[:6], math.inf], [0, 0, 101, 1, 0, 0, 0]]
    for numbers in (*bad, [*good[:3], 0.9, 0, 0, 0]):
        assert pose_of(1.0, numbers) is None


def test_the_packet_is_the_firmwares() -> None:
    """Port 6, channel 1, kind 8, seven little-endian floats: position, then the quaternion with w last."""
    packet = packets.pose_packet((1.0, -2.0, 0.5), (0.5, -0.5, 0.5, 0.5))
    expected = np.array([1.0, -2.0, 0.5, -0.5, 0.5, 0.5, 0.5], "<f4").tobytes()
    assert (packet.port, packet.channel, packet.data) == (6, 1, b"\x08" + expected)
    assert len(packet.data) <= 30
    for position, quaternion in (
        ((math.nan, 0, 0), LEVEL),
        ((0, 0, 0), (2.0, 0, 0, 0)),
        ((0, 0, 0), (math.inf, 0, 0, 0)),
    ):
        with pytest.raises(PacketError):
            packets.pose_packet(position, quaternion)
    with pytest.raises(PacketError):
        unpack_pose(packet.data[:-1])
