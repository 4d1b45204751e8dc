"""Validity of the poses of a motion capture system, and when valid ones are missing for too long. Pure.

An invalid pose is dropped, and the estimator coasts on its IMU. The age of the last valid pose ends a flight. One bad
frame therefore has no effect, and no wrong pose reaches a flying drone.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from mjxball.control import rotations
from mjxfly.limits import NAMES
from mjxfly.supervisor import Event, Fault


@dataclass(frozen=True)
class MocapLimits:
    """Bounds on poses, before and in flight."""

    answer: float = 5.0  # from the start until any body is seen [s]
    appear: float = 1.0  # from then until both drones' bodies are seen [s]
    measure: float = 0.5  # time over which the bodies are watched before the drones are connected [s]
    rate: float = 45.0  # least rate of both bodies [Hz]: 50 with a margin for jitter in half a second
    age: float = 0.1  # gap in the poses that is logged, and age of a pose too old to compare [s]
    lost: float = 0.3  # gap that ends the flight: until then the estimator coasts [s]
    frozen: float = 0.2  # of bit-identical poses, which no camera measures twice [s]
    still: float = 0.2  # of one bit-identical coordinate while others change [s]
    length_error: float = 0.03  # of the distance between standing bodies [m]: 10 % of a rig of 0.3 m
    speed: float = 5.0  # between two frames [m/s]
    jitter: float = 0.02  # allowed in addition to `speed` times step [m]
    longest_step: float = 0.1  # longest step in that product, after a gap [s]
    disagreement: float = 0.15  # of a pose from the drone's own estimate [m]
    apart: float = 0.05  # bodies that are closer count as one body [m]
    rig_error: float = 0.1  # of the line between the bodies against the rig [m]
    tilt: float = math.radians(8)  # of a standing body before flight [rad]
    yaw: float = math.radians(15)  # of the same from the world's x axis [rad]
    farthest: float = 100.0  # coordinate, beyond which the firmware's estimator resets [m]


class Pose(NamedTuple):
    """Measured pose of one body."""

    time: float  # of arrival on the monotonic clock [s]
    position: tuple[float, float, float]  # in the world [m]
    quaternion: tuple[float, float, float, float]  # body -> world (w, x, y, z), unit length


Frame = tuple[Pose | None, Pose | None]  # leader and follower; None: not seen, or not finite


@dataclass(frozen=True)
class Track:
    """Newest poses of one body and their validity."""

    last: Pose | None = None  # newest pose
    good: Pose | None = None  # newest valid pose
    reason: str = "it was never seen"  # why the newest pose is invalid, empty if it is valid
    changed: tuple[float, ...] = (-math.inf,) * 3  # time of the last change of each coordinate [s]
    received: int = 0
    jumps: int = 0

    def age(self, now: float) -> float:
        """Age of the newest valid pose at `now` [s]."""
        return math.inf if self.good is None else now - self.good.time


Tracks = tuple[Track, Track]
Places = Sequence[Sequence[float] | None]  # position of each drone by its own estimator [m], None: unknown


def pose_of(time: float, values: Sequence[float], limits: MocapLimits = MocapLimits()) -> Pose | None:
    """Pose from x, y, z, qw, qx, qy, qz, its quaternion normalised, w >= 0; None if the values are no pose."""
    if len(values) != 7 or not all(map(math.isfinite, values)):
        return None
    x, y, z, *quaternion = map(float, values)
    length = math.sqrt(sum(part * part for part in quaternion))
    if abs(length - 1) > 0.05 or max(abs(x), abs(y), abs(z)) > limits.farthest:
        return None
    sign = math.copysign(1 / length, quaternion[0])
    w, i, j, k = (sign * part for part in quaternion)
    return Pose(time, (x, y, z), (w, i, j, k))


def follow(
    tracks: Tracks, frame: Frame, limits: MocapLimits, span: np.ndarray, places: Places = (None, None)
) -> Tracks:
    """The tracks after one more `frame`; `span` (3,) [m] is the leader relative to the follower in body axes.

    A track's `good` is replaced only by a valid pose.
    """
    after = [_follow_one(track, pose, limits, place) for track, pose, place in zip(tracks, frame, places, strict=True)]
    wrong = pair_fault((after[0], after[1]), limits, span)
    if wrong and not any(track.reason for track in after):  # else it is known which one is wrong
        after = [dataclasses.replace(new, good=old.good, reason=wrong) for old, new in zip(tracks, after, strict=True)]
    return after[0], after[1]


def _follow_one(track: Track, pose: Pose | None, limits: MocapLimits, place: Sequence[float] | None) -> Track:
    if pose is None:
        return track if track.reason else dataclasses.replace(track, reason="it is not seen")
    changed = (pose.time,) * 3
    if track.last is not None:
        parts = zip(track.changed, track.last.position, pose.position, strict=True)
        changed = tuple(since if old == new else pose.time for since, old, new in parts)  # type: ignore[assignment]
    seen = dataclasses.replace(track, last=pose, received=track.received + 1, changed=changed)
    if track.last is not None and track.last[1:] == pose[1:]:
        return dataclasses.replace(seen, reason=FROZEN)
    still = [axis for axis, since in zip("xyz", changed, strict=True) if pose.time - since >= limits.still]
    if still:
        return dataclasses.replace(seen, reason=f"its {still[0]} stands still")
    if track.good is not None and pose.time - track.good.time <= limits.lost:
        step = math.dist(track.good.position, pose.position)
        elapsed = min(pose.time - track.good.time, limits.longest_step)
        if step > limits.jitter + limits.speed * elapsed:
            return dataclasses.replace(seen, reason=f"it jumped by {step:.2f} m", jumps=track.jumps + 1)
    if place is not None:
        error = math.dist(place, pose.position)
        if error > limits.disagreement:
            return dataclasses.replace(seen, reason=f"it is {error:.2f} m from where the drone believes to be")
    return dataclasses.replace(seen, good=pose, reason="")


FROZEN = "its numbers stand still"


def pair_fault(tracks: Tracks, limits: MocapLimits, span: np.ndarray) -> str:
    """The contradiction between the newest poses of both bodies and the rig, empty if none or not comparable."""
    one, other = tracks[0].last, tracks[1].last
    if one is None or other is None or abs(one.time - other.time) > limits.age:
        return ""
    line = np.subtract(one.position, other.position)
    expected = rotations.matrix_from_quaternion(np.array(other.quaternion)) @ span
    if np.linalg.norm(line) < limits.apart:
        return "both bodies have one pose"
    if np.linalg.norm(line - expected) <= limits.rig_error:
        return ""
    if np.linalg.norm(line + expected) <= limits.rig_error:
        return "the two bodies are swapped"
    far, known = float(np.linalg.norm(line)), float(np.linalg.norm(span))
    if abs(far - known) > limits.rig_error:
        return f"the bodies are {far:.2f} m apart on a rig of {known:.2f} m"
    return "the line between the bodies does not lie as the follower's attitude says"


def scale_fault(tracks: Tracks, limits: MocapLimits, span: np.ndarray) -> str:
    """Message if the distance of two standing bodies does not fit the rig, else empty."""
    one, other = tracks[0].last, tracks[1].last
    if one is None or other is None:
        return ""
    far, known = math.dist(one.position, other.position), float(np.linalg.norm(span))
    if abs(far - known) <= limits.length_error:
        return ""
    return (
        f"the bodies are {far:.3f} m apart on a rig of {known:.3f} m: is the scale {far / known:.2f}, "
        "or are their origins not at the drones' centres?"
    )


def faults(tracks: Tracks, now: float, limits: MocapLimits = MocapLimits()) -> list[Fault]:
    """Faults at `now` [s]: bodies without a valid pose for too long."""
    found = []
    for name, track in zip(NAMES, tracks, strict=True):
        age = track.age(now)
        allowed = limits.frozen if track.reason == FROZEN else limits.lost
        if age > allowed:
            text = "ever" if math.isinf(age) else f"for {1000 * age:.0f} ms"
            found.append(Fault(Event.POSE, f"no good pose of the {name} {text}: {track.reason or 'none came'}"))
    return found


def standing_fault(tracks: Tracks, now: float, limits: MocapLimits, span: np.ndarray) -> str:
    """Why the poses of a pair that stands on the ground are not fit for flight at `now` [s], empty if they are."""
    wrong = pair_fault(tracks, limits, span) or scale_fault(tracks, limits, span)
    if wrong:
        return wrong
    for name, track in zip(NAMES, tracks, strict=True):
        age = track.age(now)
        if track.reason and age > (limits.frozen if track.reason == FROZEN else limits.age):
            return f"the {name}'s body: {track.reason}"
        if age > limits.age:
            return f"the {name}'s body was last seen {1000 * age:.0f} ms ago"
        if track.jumps:
            return f"the {name}'s body jumps while it stands"
        assert track.good is not None
        wrong = posture_fault(track.good, limits)
        if wrong:
            return f"the {name}'s body {wrong}"
    return ""


def posture_fault(pose: Pose, limits: MocapLimits) -> str:
    """How `pose` differs from that of a body that stands level and points along +x, empty if it does not."""
    quaternion = np.array(pose.quaternion)
    yaw = rotations.euler_from_matrix(rotations.matrix_from_quaternion(quaternion))[2]
    tilt = rotations.tilt_of_quaternion(quaternion)
    if tilt > limits.tilt:
        return f"tilts {math.degrees(tilt):.0f} degrees as it stands; are Z up and the body's axes set as the drone's?"
    if abs(yaw) > limits.yaw:
        return f"points {math.degrees(yaw):.0f} degrees off the world's x axis as it stands"
    return ""
