"""Flights in virtual time on motion capture: drones without a deck, whose poses come from the laptop."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from mjxball.control import rotations
from mjxball.policy import Policy
from mjxfly import mocap_supervision as supervision
from mjxfly.limits import FlightSettings
from mjxfly.mocap import Mocap, MocapSettings
from mjxfly.mocap_supervision import Frame, Pose
from mjxfly.twin.conditions import QUIET
from mjxfly.twin.positioning import ATTITUDE_NOISE, POSITION_NOISE
from virtual_twin import STEP, VirtualTwin

EVERY = 2  # steps of the twin between two frames: 100 Hz
See = Callable[[Frame], Frame]  # what a camera system makes of the true poses


class CapturedTwin(VirtualTwin):
    """See `VirtualTwin`."""

    mocap: Mocap

    def __init__(
        self, policy: Policy, settings: FlightSettings | None = None, see: See = lambda frame: frame, **given: Any
    ):
        """`see` is called with every frame, which has the noise of a camera already."""
        self.see, self._noise = see, np.random.default_rng(0)
        given["surroundings"] = dataclasses.replace(given.get("surroundings", QUIET), deck=False)
        super().__init__(policy, settings, **given)

    def _start_flight(self, settle: float) -> None:
        self.mocap = Mocap(MocapSettings("mock"), self.rig.span)
        self.mocap.note = self.log.note
        for number, link in enumerate(self.links):
            link.write_parameters(self.mocap.parameters())
            self.mocap.feed(number, link)  # type: ignore[arg-type]
        super()._start_flight(settle)
        self.flight._mocap = self.mocap
        self.mocap.guarding = True

    def advance(self, seconds: float) -> None:
        """See `VirtualTwin.advance`; a frame comes every 10 ms."""
        for _ in range(round(seconds / STEP)):
            super().advance(STEP)
            if self._count % EVERY == 0:
                self.mocap.take(self.see(self._frame()), self.now)

    def refusal(self) -> str:
        """Why the check of the poses before a flight would refuse them now, empty if it would not."""
        return supervision.standing_fault(self.mocap.tracks, self.now, self.mocap.limits, self.rig.span)

    def _frame(self) -> Frame:
        one, other = (self._pose(number) for number in range(2))
        return one, other

    def _pose(self, number: int) -> Pose:
        drawn = self._noise.standard_normal(6)
        place = self.state.position[number] + POSITION_NOISE * drawn[:3]
        turned = rotations.multiply_quaternions(
            self.state.quaternion[number], np.array([1.0, *(0.5 * ATTITUDE_NOISE * drawn[3:])])
        )
        pose = supervision.pose_of(self.now, [*place, *turned])
        assert pose is not None
        return pose
