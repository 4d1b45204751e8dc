"""Where the drones of a team are mounted, as a follower's network is told it."""

from __future__ import annotations

import math

from mjxball.arrays import Array, joined
from mjxball.config import Plant
from mjxball.control import rotations
from mjxball.control.observation import mount_frames

GEOMETRY = ("command_share", "roll_acceleration_per_lift", "pitch_acceleration_per_lift", "rotor_room")
GEOMETRY_SIZE = len(GEOMETRY)
# Medians of random rigs (`sim.rigs`), with tilt torques of a ring of N drones N a m r^2, a = 1 for a pair and 1/2 else:
# what lifting 1 m/s2 more than the leader turns, times N a r [1]; what rotors hold as a tilt of the loops [m/s2].
LEVER, ROOM = 1.25, 1.75


def team_geometry(plant: Plant, mounts: Array, count: Array) -> Array:
    """`ring_geometry` of every follower of `count` () drones like those of `plant` at `mounts` (N, 3) [m].

    (F, 4), or (4,) of one follower; drones from `count` on only pad.
    """
    xp = mounts.__array_namespace__()
    angles, lead = mount_frames(plant, mounts), mounts[plant.leader]
    place = xp.broadcast_to(lead, (*angles.shape, 3))
    seen = rotations.turned_about_z(place, -angles)
    return ring_geometry(xp.astype(xp.broadcast_to(count, angles.shape), mounts.dtype), seen[..., :2])


def ring_geometry(count: Array, leader: Array) -> Array:
    """What a follower knows of a team of `count` (...) drones whose leader stands at `leader` (..., 2) [m] (..., 4).

    In its mount frame, from O. N / (N - 1); angular accelerations about roll and pitch that lifting 1 m/s2 more than
    the leader gives [1/m]; torque of the rotors over the inertia [1/s2], the last two as of a middling rig on a ring.
    """
    xp = leader.__array_namespace__()
    x, y = leader[..., 0], leader[..., 1]
    spread = xp.where(count < 2.5, xp.ones_like(count), 0.5)
    lever = LEVER / ((x * x + y * y) * count * spread)
    room = ROOM * 2.0 * xp.sin(math.pi / count) / (spread * xp.sqrt(x * x + y * y))
    return joined([count / (count - 1.0), -y * lever, x * lever, room])
