"""The two laws in flight: the leader's PID and the follower's policy, both those of `mjxball.control`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjxball.control import leader, observation
from mjxball.fly.pair import ObjectState, Rig
from mjxball.policy import Policy


class Commands(NamedTuple):
    """What both laws want at one tick."""

    leader: np.ndarray  # (3,) roll, pitch [rad], vertical acceleration [m/s2]
    follower: np.ndarray  # (3,) likewise
    observation: np.ndarray  # (18,) what the follower saw


class Pilot:
    """Leader and follower at the policy's own rate; its gains, limits and period stand in the policy's card."""

    def __init__(self, policy: Policy, rig: Rig):
        card = policy.card
        self.policy, self.period = policy, policy.control_period
        self._mount = np.array(rig.follower_mount)
        gains = card.get("config", {}).get("leader", {})  # files from before it was recorded have no integral gain
        self._kp, self._kd = (np.array(card[name], float) for name in ("leader_kp", "leader_kd"))
        self._ki = np.array(gains.get("ki", (0.0, 0.0, 0.0)), float)
        self._gravity = float(card["gravity"])
        self._tilt_limit, self._vertical_limit = (float(limit) for limit in card["command_limits"])
        self.reset()

    def reset(self) -> None:
        """Begin a flight: no integral, no memory."""
        self._integral = np.zeros(3)
        self.policy.reset()

    def step(self, state: ObjectState, goal: np.ndarray) -> Commands:
        """Both commands at `state` on the way to `goal` (3,) of O [m]; call it once per period."""
        seen = observation.observe(state.position, state.matrix, state.velocity, state.rates, goal, self._mount)
        error, rate = seen[observation.ERROR], seen[observation.ERROR_RATE]
        wanted = leader.desired_acceleration(error, rate, self._integral, self._kp, self._kd, self._ki)
        led = leader.command(wanted, 0.0, self._gravity, self._tilt_limit, self._vertical_limit)
        self._integral = self._integral + self.period * error
        return Commands(led, np.asarray(self.policy(seen), float), seen)
