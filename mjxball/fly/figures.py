"""Figures of a flight under both laws, added up tick by tick: for the runner's last lines and the log's end. Pure."""

from __future__ import annotations

import math
from dataclasses import dataclass

SETTLING = 5.0  # [s] under both laws that are left out, while the pair climbs to its goal


@dataclass
class Figures:
    """Error of O and tilt of the follower over some ticks."""

    ticks: int = 0
    error_rms: float = 0.0  # [m]
    error_peak: float = 0.0  # [m]
    tilt_rms: float = 0.0  # [rad]
    tilt_peak: float = 0.0  # [rad]

    def add(self, error: float, tilt: float) -> None:
        """One tick with O `error` [m] from its goal and a `tilt` [rad]."""
        if not (math.isfinite(error) and math.isfinite(tilt)):
            return
        self.ticks += 1
        self.error_rms = math.sqrt(self.error_rms**2 + (error**2 - self.error_rms**2) / self.ticks)
        self.tilt_rms = math.sqrt(self.tilt_rms**2 + (tilt**2 - self.tilt_rms**2) / self.ticks)
        self.error_peak, self.tilt_peak = max(self.error_peak, error), max(self.tilt_peak, tilt)

    def __str__(self) -> str:
        """In millimetres and degrees."""
        text = f"error rms {1e3 * self.error_rms:.1f} mm, largest {1e3 * self.error_peak:.0f} mm"
        tilt = f"tilt rms {math.degrees(self.tilt_rms):.2f}, largest {math.degrees(self.tilt_peak):.1f} degrees"
        return f"{text}; {tilt}"
