"""Which physics the twin flies: the coupled Crazyflie model, or for policies of other plants the stand-in."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from mjxball.config import Config
from mjxball.errors import InputError
from mjxball.fly.card import config_of, is_crazyflie
from mjxball.fly.twin.body import Pair
from mjxball.fly.twin.conditions import Conditions
from mjxball.fly.twin.kind import DELIVERED, QUIET, DroneKind, Surroundings
from mjxball.fly.twin.standin import StandIn, StandInPlant


def make_pair(card: Mapping[str, Any] | None = None, kind: DroneKind = DELIVERED, around: Surroundings = QUIET) -> Pair:
    """Physics of the rig that a policy's `card` describes; without one, the stand-in's own rig."""
    return StandIn() if card is None else pair_of(config_of(card), kind, around)


def pair_of(
    config: Config,
    kind: DroneKind = DELIVERED,
    around: Surroundings = QUIET,
    conditions: Conditions | None = None,
) -> Pair:
    """Physics of the rig of `config`; whatever is heavy is imported here, not above.

    Raises InputError if the coupled model is needed and MuJoCo is not installed.
    """
    if not is_crazyflie(config):
        plant = config.plant
        return StandIn(StandInPlant(mounts=(plant.leader_mount, plant.follower_mount)))
    try:
        from mjxball.fly.twin.coupled import CoupledPair
    except ModuleNotFoundError as error:
        raise InputError(f"the twin of a Crazyflie pair needs {error.name}; pip install 'mjxball[fly]'") from None
    return CoupledPair(config, conditions, kind, around)
