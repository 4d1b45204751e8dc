"""How many whole rigs are drawn, for a follower that flies any of them."""

from __future__ import annotations

from dataclasses import dataclass

from mjxball.config._leaf import setting


@dataclass(frozen=True)
class Rigs:
    """Random rigs (`mjxball.sim.rigs`) of `scenario.team_sizes` drones, their loads included.

    The object's mass, beliefs, thrusts and how far the CG goes are then those of the rig, and `scenario` says how it
    moves and what disturbs.
    """

    number: int = setting(
        0, "rigs of each size that training draws its worlds from; 0: the plant's own", low=0, high=1_000_000
    )
    mass_step: float = setting(
        0.0,
        "in flight the object's mass changes by up to this share of itself, as far as that can be trimmed",
        low=0,
        high=0.9,
    )
