"""Which physics the twin flies. The coupled Crazyflie model plugs in here; until then there is the stand-in."""

from __future__ import annotations

from collections.abc import Sequence

from mjxball.fly.twin.body import Pair
from mjxball.fly.twin.standin import StandIn, StandInPlant


def make_pair(leader_mount: Sequence[float] | None = None) -> Pair:
    """Physics of a pair whose leader sits at `leader_mount` (3,) [m] from O, the follower opposite."""
    if leader_mount is None:
        return StandIn()
    x, y, z = (float(value) for value in leader_mount)
    return StandIn(StandInPlant(mounts=((x, y, z), (-x, -y, -z))))
