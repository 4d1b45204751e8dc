"""The controllers of a pair in flight: one control step of the leader's PID and of the follower."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from mjxball.control import rotations
from mjxball.policy import Policy
from mjxball.sim.controllers import Body, Controllers, relative_to_goal
from mjxfly.classical import ClassicalFollower
from mjxfly.policy_setup import config_of, mount_angle


class PairCommands(NamedTuple):
    """Commands of both controllers at one control step."""

    leader: np.ndarray  # (3,) roll, pitch [rad], vertical acceleration [m/s2]
    follower: np.ndarray  # (3,) likewise
    observation: np.ndarray  # (18,) of the follower
    hidden: np.ndarray | None = None  # (H,) state of its GRU after the step; None: no GRU


class FlightController:
    """Leader PID and follower, with the gains, limits and control period of the follower's configuration."""

    def __init__(self, policy: Policy | ClassicalFollower):
        config = config_of(policy.metadata)
        self.policy, self.config, self.period = policy, config, policy.control_period
        self._controllers, self._angle = Controllers(config), mount_angle(policy.metadata)
        # Networks fly worse with an input that was constant in training: the error's rate plus the velocity.
        self._knows_rates = isinstance(policy, ClassicalFollower) or config.scenario.goal_motion_probability > 0
        self.reset()

    def reset(self) -> None:
        """Begin a flight: zero the integrals and what the follower remembers."""
        self._integral = np.zeros(3)
        self.policy.reset()

    @property
    def integral(self) -> np.ndarray:
        """Integral (3,) of the leader's error [m s]."""
        return self._integral

    def step(self, state: Body, goal: np.ndarray, goal_rate: np.ndarray | None = None) -> PairCommands:
        """Commands at `state` for the `goal` (3,) of O [m], which moves with `goal_rate` (3,) [m/s] or rests.

        A follower that was trained with goals at rest takes a goal that moves for one at rest, and so does its leader.
        Call it once per control period.
        """
        rate = goal_rate if self._knows_rates else None
        observation, state = self._controllers.observe(state, goal, rate), relative_to_goal(state, rate)
        leader = self._controllers.leader_command(state, goal, self._integral)
        command = np.asarray(self.policy(rotations.turned_about_z(observation, -self._angle)), float)
        follower = rotations.turned_about_z(command, self._angle)
        self._integral = self._controllers.integrate(self._integral, state, goal, self.period)
        return PairCommands(leader, follower, observation, self.policy.hidden)
