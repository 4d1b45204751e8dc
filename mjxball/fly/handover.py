"""From one policy to the next in flight, without a jump in what is commanded; figures of what each one flew. Pure."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mjxball.errors import InputError
from mjxball.fly.telemetry import Note
from mjxball.policy import Policy

Successor = Callable[[], Policy | None]  # a policy that is to take over now, once; neither blocks nor raises
SETTLING = 5.0  # [s] under both laws that are left out, while the pair climbs to its goal
LEAST = 2.0  # [s] of which figures are worth a number
BLEND = 0.5  # [s] over which the command goes from one policy's to the other's
AWAY = 0.15  # [m] further from the goal than when it took over, from where on the new policy has to hand back
UNKNOWN = (math.nan, math.nan)
# What a card says of the laws around the network, which a new policy must share to remember what the old one did.
SAME = (
    "history",
    "previous_action",
    "filters",
    "action_mode",
    "action_reach",
    "command_limits",
    "leader_kp",
    "leader_kd",
    "gravity",
    "control_period",
    "plant",
    "config",
)


def difference(old: Policy, new: Policy) -> str:
    """The field of the cards because of which `new` cannot take over from `old`, empty if it can."""
    return next((name for name in SAME if old.card.get(name) != new.card.get(name)), "")


class Handover:
    """A policy, and perhaps one that takes over from it. Called once per control period.

    Both are computed from then on, so that the first one can come back at any time. It does if the second one's command
    is not finite, or O goes astray under it.
    """

    def __init__(self, policy: Policy):
        self.first = policy
        self.second: Policy | None = None
        self.returned = ""  # why the first one came back
        self._ticks = max(round(BLEND / policy.control_period), 1)
        self._count = 0  # of the ticks of the blend
        self._farthest = math.inf  # from the goal that the second one may let O go [m]

    @property
    def share(self) -> float:
        """Of the second policy in the command, 0 to 1."""
        s = self._count / self._ticks
        return s * s * (3.0 - 2.0 * s)

    def reset(self) -> None:
        """Begin a flight with the first policy."""
        self.second, self.returned, self._count = None, "", 0
        self.first.reset()

    def begin(self, policy: Policy, distance: float) -> None:
        """`policy` takes over, with what the first one remembers; `distance` of O from its goal now [m]."""
        policy.memory = self.first.memory
        self.second, self._farthest = policy, distance + AWAY

    def check_distance(self, distance: float) -> None:
        """Take the first policy back if O is too far from its goal, `distance` [m], for a goal that stands still."""
        if self.second is not None and not self.returned and distance > self._farthest:
            self.returned = f"the object was {distance:.2f} m from its goal"

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """Command (3,) = roll, pitch [rad], vertical acceleration [m/s2]."""
        command = np.asarray(self.first(observation), float)
        if self.second is None:
            return command
        try:
            other = np.asarray(self.second(observation), float)
        except InputError:  # the first one has answered this observation
            self.returned = "its command is not finite"
            self.second, self._count = None, 0
            return command
        self._count = max(self._count - 1, 0) if self.returned else min(self._count + 1, self._ticks)
        if self._count == 0:
            self.second = None
        return command + self.share * (other - command)


@dataclass
class Figures:
    """Error of O, tilt of the follower and thrust of both drones over some ticks."""

    ticks: int = 0
    seconds: float = 0.0  # of them
    error_rms: float = 0.0  # [m]
    error_peak: float = 0.0  # [m]
    tilt_rms: float = 0.0  # [rad]
    tilt_peak: float = 0.0  # [rad]
    thrust: tuple[float, float] = (math.nan, math.nan)  # mean of leader and follower, of what should hover

    def add(self, error: float, tilt: float, seconds: float, thrust: tuple[float, float]) -> None:
        """One tick of `seconds` with O `error` [m] from its goal, a `tilt` [rad] and `thrust` as shares of hover's."""
        if not (math.isfinite(error) and math.isfinite(tilt)):
            return
        self.ticks += 1
        self.seconds += seconds
        before = self.thrust if self.ticks > 1 else thrust
        leader, follower = (old + (new - old) / self.ticks for old, new in zip(before, thrust, strict=True))
        self.thrust = leader, follower
        self.error_rms = math.sqrt(self.error_rms**2 + (error**2 - self.error_rms**2) / self.ticks)
        self.tilt_rms = math.sqrt(self.tilt_rms**2 + (tilt**2 - self.tilt_rms**2) / self.ticks)
        self.error_peak, self.tilt_peak = max(self.error_peak, error), max(self.tilt_peak, tilt)

    def __str__(self) -> str:
        """In millimetres, degrees and percent."""
        text = f"error rms {1e3 * self.error_rms:.1f} mm, largest {1e3 * self.error_peak:.0f} mm"
        tilt = f"tilt rms {math.degrees(self.tilt_rms):.2f}, largest {math.degrees(self.tilt_peak):.1f} degrees"
        if not all(map(math.isfinite, self.thrust)):
            return f"{text}; {tilt}"
        # A motor that gives more needs less; a load that is heavier on one side shows in the same way.
        leader, follower = (f"{100 * (share - 1):+.0f}" for share in self.thrust)
        return f"{text}; {tilt}; thrust {leader} / {follower} % of the card's"


class HandoverMonitor:
    """Asks for a policy that is to take over, and keeps the figures of what each one flew."""

    def __init__(self, handover: Handover, successor: Successor | None, note: Note):
        self._handover, self._successor, self._note = handover, successor, note
        self._returned = False
        self._figures: dict[str, Figures] = {}
        self._last = -math.inf  # [s]

    @property
    def figures(self) -> dict[str, Figures]:
        """Under both laws, by the policy in command; those of at least `LEAST` seconds."""
        return {name: one for name, one in self._figures.items() if one.seconds >= LEAST}

    def update(
        self, now: float, elapsed: float, distance: float, tilt: float, thrust: tuple[float, float] = UNKNOWN
    ) -> None:
        """A tick at `now` [s], `elapsed` [s] under both laws, O `distance` [m] from its goal, at a `tilt` [rad].

        `thrust` of leader and follower are shares of what the card says hovers.
        """
        seconds, self._last = now - self._last, now
        policy = self._successor() if self._successor is not None else None
        if policy is not None:
            self._handover.begin(policy, distance)
            self._note("retrain", now, what="taken", text=policy.name)
        self._handover.check_distance(distance)
        if self._handover.returned and not self._returned:
            self._returned = True
            self._note("retrain", now, what="returned", text=self._handover.returned)
        if elapsed >= SETTLING:
            name = "first policy" if self._handover.second is None else "second policy"
            figures = self._figures.setdefault(name, Figures())
            figures.add(distance, tilt, seconds if figures.ticks else 0.0, thrust)
