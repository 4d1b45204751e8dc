"""Where a running flight is, from its log: state of the pair, and what its laws and its policy remember."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from mjxball.fly.card import Controller
from mjxball.fly.supervisor import GUIDED
from mjxball.policy import Policy
from mjxball.sim.laws import BodyState, Laws

GUIDED_NAMES = tuple(state.value for state in GUIDED)
LOOP_RATE = 100.0  # [Hz] of the runner's ticks at least


class Place(NamedTuple):
    """Where a flight is."""

    body: BodyState  # as the follower measures it
    goal: np.ndarray  # (3,) of O [m]
    integral: np.ndarray  # of both laws, see `sim.laws.Laws`
    history: np.ndarray  # (m,) of the policy


class FlightReplay:
    """Both laws once more, on the observations in the log: they remember what the runner's remember."""

    def __init__(self, policy: Policy):
        self._controller = Controller(policy)
        self._laws = Laws(self._controller.config)
        self._every = math.ceil(policy.control_period * LOOP_RATE - 1e-9)
        self._count = 0
        self.place: Place | None = None

    def take(self, record: Mapping[str, Any]) -> None:
        """One record of the log (`fly.log_schema`), in order."""
        if record["kind"] == "transition" and record["before"] == "ramp":
            self._controller.reset()
            self._count = 0
        if record["kind"] != "tick" or record["state"] not in GUIDED_NAMES or "observation" not in record:
            return
        self._count += 1
        if (self._count - 1) % self._every:
            return
        goal = np.asarray(record["goal"], float)
        body = self._laws.body_from_observation(np.asarray(record["observation"], float), goal)
        self._controller.step(body, goal)
        self.place = Place(body, goal, self._controller.integral, self._controller.policy.memory)
