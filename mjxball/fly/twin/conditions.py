"""What a rehearsal on the coupled model meets, and the laptop is not told."""

from __future__ import annotations

from dataclasses import dataclass

from mjxball.config import Config


@dataclass(frozen=True)
class Battery:
    """Voltage of a one-cell battery."""

    full: float = 4.1  # without load [V]
    sag: float = 0.35  # at full power [V]
    drain: float = 0.0008  # at full power [V/s]


@dataclass(frozen=True)
class Conditions:
    """What a rehearsal meets that the laptop is not told. The CG moves from when the first motor turns."""

    object_mass: float  # [kg]
    cg_amplitude: float = 0.0  # of a prescribed sine [m]
    cg_speed: float = 0.0  # [rad/s]
    ball: float = 0.0  # where a rolling ball lies at the start, from O [m]
    rotor_lag: float = 1.0  # factor on the motors' time constant
    thrust: tuple[float, float] = (1.0, 1.0)  # factor on the motor forces of leader and follower
    battery: Battery = Battery()

    @classmethod
    def of(cls, config: Config) -> Conditions:
        """The middle of what the policy was trained for; a rolling ball lies half way to its farthest start."""
        ranges = config.scenario
        amplitude, speed = (sum(pair) / 2 for pair in (ranges.cg_amplitude, ranges.cg_speed))
        return cls(sum(ranges.object_mass) / 2, amplitude, speed, ranges.ball_start / 2)
