"""Inputs of a team follower's network that describe the ring of drones and the follower's place in it."""

from __future__ import annotations

import math

from mjxball.arrays import Array, joined
from mjxball.config import Plant
from mjxball.control import rotations
from mjxball.control.observation import mount_frames

GEOMETRY = ("command_share", "roll_acceleration_per_lift", "pitch_acceleration_per_lift", "rotor_room")
GEOMETRY_SIZE = len(GEOMETRY)
# Medians over random rigs (`sim.rigs`), for a ring of N drones with inertia N a m r^2, a = 1 for a pair and 1/2 else:
# angular acceleration per 1 m/s2 of lift more than the leader's, times N a r [1]; rotor torque over N a m r [m/s2].
LEVER, ROOM = 1.25, 1.75


def team_geometry(plant: Plant, mounts: Array, count: Array) -> Array:
    """`ring_geometry` of every follower of `count` () drones like those of `plant` at `mounts` (N, 3) [m].

    Returns (F, 4), or (4,) of one follower. Drones from `count` on are padding.
    """
    xp = mounts.__array_namespace__()
    angles, lead = mount_frames(plant, mounts), mounts[plant.leader]
    place = xp.broadcast_to(lead, (*angles.shape, 3))
    leaders = rotations.turned_about_z(place, -angles)
    return ring_geometry(xp.astype(xp.broadcast_to(count, angles.shape), mounts.dtype), leaders[..., :2])


def ring_geometry(count: Array, leader: Array) -> Array:
    """Geometry inputs (..., 4) of a follower among `count` (...) drones; `leader` (..., 2) [m] in its mount frame.

    N / (N - 1); angular accelerations about roll and pitch per 1 m/s2 of lift more than the leader's [1/m]; rotor
    torque over inertia [1/s2]. The last three are those of a median rig on a ring.
    """
    xp = leader.__array_namespace__()
    x, y = leader[..., 0], leader[..., 1]
    spread = xp.where(count < 2.5, xp.ones_like(count), 0.5)
    lever = LEVER / ((x * x + y * y) * count * spread)
    room = ROOM * 2.0 * xp.sin(math.pi / count) / (spread * xp.sqrt(x * x + y * y))
    return joined([count / (count - 1.0), -y * lever, x * lever, room])
