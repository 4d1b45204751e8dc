"""The two laws in flight: the leader's PID and the follower's policy, those of `wiring` and `control`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjxball.fly.card import config_of
from mjxball.fly.pair import ObjectState
from mjxball.policy import Policy
from mjxball.sim.closed_loop import ClosedLoop


class Commands(NamedTuple):
    """What both laws want at one tick."""

    leader: np.ndarray  # (3,) roll, pitch [rad], vertical acceleration [m/s2]
    follower: np.ndarray  # (3,) likewise
    observation: np.ndarray  # (18,) what the follower saw


class Controller:
    """Leader and follower at the policy's own rate, by the loop, gains and limits in the policy's card."""

    def __init__(self, policy: Policy):
        config = config_of(policy.card)
        self.policy, self.config, self.period = policy, config, policy.control_period
        self._loop = ClosedLoop(config)
        self.reset()

    def reset(self) -> None:
        """Begin a flight: no integral, no memory."""
        self._integral = self._loop.zero_integral(np.zeros(3))
        self.policy.reset()

    def step(self, state: ObjectState, goal: np.ndarray) -> Commands:
        """Both commands at `state` on the way to `goal` (3,) of O [m]; call it once per period."""
        seen = self._loop.observe(state, goal)
        led = self._loop.leader_command(state, goal, self._integral)
        followed = self._loop.follower_command(np.asarray(self.policy(seen), float), self._integral)
        self._integral = self._loop.integrate(self._integral, state, goal, self.period, followed=followed)
        return Commands(led, followed, seen)
