"""Which physics the twin flies. The coupled Crazyflie model plugs in here; until then there is the stand-in."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mjxball.fly.pair import Rig
from mjxball.fly.twin.body import Pair
from mjxball.fly.twin.standin import StandIn, StandInPlant


def make_pair(card: Mapping[str, Any] | None = None) -> Pair:
    """Physics of the rig that a policy's `card` describes; whatever is heavy is imported here, not above."""
    if card is None:
        return StandIn()
    rig = Rig.of_card(card)
    return StandIn(StandInPlant(mounts=(rig.leader_mount, rig.follower_mount)))
