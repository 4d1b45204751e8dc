"""Which physics the twin flies: the coupled Crazyflie model, or for policies of other plants the stand-in."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mjxball.errors import InputError
from mjxball.fly.card import config_of, is_crazyflie
from mjxball.fly.pair import Rig
from mjxball.fly.twin.body import Pair
from mjxball.fly.twin.standin import StandIn, StandInPlant


def make_pair(card: Mapping[str, Any] | None = None) -> Pair:
    """Physics of the rig that a policy's `card` describes; whatever is heavy is imported here, not above.

    Raises InputError if the coupled model is needed and MuJoCo is not installed.
    """
    if card is None:
        return StandIn()
    config = config_of(card)
    if not is_crazyflie(config):
        rig = Rig.of_card(card)
        return StandIn(StandInPlant(mounts=(rig.leader_mount, rig.follower_mount)))
    try:
        from mjxball.fly.twin.coupled import CoupledPair
    except ModuleNotFoundError as error:
        raise InputError(f"the twin of a Crazyflie pair needs {error.name}; pip install 'mjxball[fly]'") from None
    return CoupledPair(config)
