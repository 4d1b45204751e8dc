"""Statistics of a flight while both controllers are in command, after settling. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass

SETTLING = 5.0  # [s] after the controllers take over that do not count: the pair climbs to its goal
LEAST = 2.0  # [s] of data below which no figures are given
UNKNOWN = (math.nan, math.nan)


@dataclass
class Figures:
    """Error of O, tilt of the follower and thrust of both drones over some ticks."""

    ticks: int = 0
    seconds: float = 0.0  # duration of these ticks
    error_rms: float = 0.0  # [m]
    error_peak: float = 0.0  # [m]
    tilt_rms: float = 0.0  # [rad]
    tilt_peak: float = 0.0  # [rad]
    thrust: tuple[float, float] = (math.nan, math.nan)  # means of leader and follower over nominal hover thrust

    def add(self, error: float, tilt: float, seconds: float, thrust: tuple[float, float]) -> None:
        """Add a tick of `seconds`: O is `error` [m] from its goal, `tilt` [rad], `thrust` over nominal hover thrust."""
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
        """Errors [mm], tilts [degrees] and thrusts [% from nominal] in words."""
        text = f"error rms {1e3 * self.error_rms:.1f} mm, largest {1e3 * self.error_peak:.0f} mm"
        tilt = f"tilt rms {math.degrees(self.tilt_rms):.2f}, largest {math.degrees(self.tilt_peak):.1f} degrees"
        if not all(map(math.isfinite, self.thrust)):
            return f"{text}; {tilt}"
        # A stronger motor needs less thrust; an uneven load has the same effect.
        leader, follower = (f"{100 * (share - 1):+.0f}" for share in self.thrust)
        return f"{text}; {tilt}; thrust {leader} / {follower} % from nominal"


class Flown:
    """Accumulates the figures of one flight."""

    def __init__(self) -> None:
        self._figures = Figures()
        self._last = -math.inf  # [s]

    @property
    def figures(self) -> Figures | None:
        """The figures of at least `LEAST` seconds, else None."""
        return self._figures if self._figures.seconds >= LEAST else None

    def update(
        self, now: float, elapsed: float, distance: float, tilt: float, thrust: tuple[float, float] = UNKNOWN
    ) -> None:
        """Add a tick at `now` [s], `elapsed` [s] after the controllers took over, O `distance` [m] from its goal.

        `tilt` [rad] is the follower's; `thrust` are leader's and follower's over nominal hover thrust.
        """
        seconds, self._last = now - self._last, now
        if elapsed >= SETTLING:
            self._figures.add(distance, tilt, seconds if self._figures.ticks else 0.0, thrust)
