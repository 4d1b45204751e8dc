"""From two drones' states to the object's: the rig, and where O is. Pure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from mjxball.control import rotations
from mjxball.fly.packets import DroneState


class ObjectState(NamedTuple):
    """The assembly as the laws see it."""

    position: np.ndarray  # (3,) of O in the world [m]
    velocity: np.ndarray  # (3,) [m/s]
    quaternion: np.ndarray  # (4,) attitude body -> world (w, x, y, z), as the follower measures it
    rates: np.ndarray  # (3,) body rates [rad/s], likewise

    @property
    def matrix(self) -> np.ndarray:
        """(3, 3) attitude body -> world."""
        return rotations.matrix_from_quaternion(self.quaternion)


@dataclass(frozen=True)
class Rig:
    """Where the drones sit on the object, from O in body axes [m]."""

    leader_mount: tuple[float, float, float]
    follower_mount: tuple[float, float, float]

    @classmethod
    def of_card(cls, card: Mapping[str, Any]) -> Rig:
        """The rig that a policy was trained for."""
        plant = card["plant"]
        return cls(tuple(plant["leader_mount"]), tuple(plant["follower_mount"]))

    @property
    def mounts(self) -> tuple[np.ndarray, np.ndarray]:
        """(3,) of leader and follower from O [m]."""
        return np.array(self.leader_mount), np.array(self.follower_mount)

    @property
    def span(self) -> np.ndarray:
        """(3,) leader from follower [m]."""
        return np.array(self.leader_mount) - np.array(self.follower_mount)

    @property
    def weights(self) -> tuple[float, float]:
        """Of leader and follower in O's position: where the mounts' weighted mean is O."""
        ahead, behind = (float(np.linalg.norm(mount)) for mount in (self.leader_mount, self.follower_mount))
        return behind / (ahead + behind), ahead / (ahead + behind)


def object_state(states: Sequence[DroneState], rig: Rig) -> ObjectState:
    """O's state from both drones' (leader, follower).

    Position and velocity are the weighted means, which need no attitude and in which the two estimators' errors
    average; attitude and rates are the follower's own, because its policy sees them (paper).
    """
    lead, follow = rig.weights
    position = lead * states[0].position + follow * states[1].position
    velocity = lead * states[0].velocity + follow * states[1].velocity
    return ObjectState(position, velocity, states[1].quaternion, states[1].rates)


def object_of_one(state: DroneState, mount: np.ndarray) -> ObjectState:
    """O's state from one drone's alone: p_O = p - R r, with `mount` r (3,) [m]."""
    matrix = rotations.matrix_from_quaternion(state.quaternion)
    position = state.position - matrix @ mount
    velocity = state.velocity - matrix @ np.cross(state.rates, mount)
    return ObjectState(position, velocity, state.quaternion, state.rates)


def yaw_of(state: DroneState) -> float:
    """Yaw [rad] of one drone."""
    return float(rotations.euler_from_matrix(rotations.matrix_from_quaternion(state.quaternion))[2])
