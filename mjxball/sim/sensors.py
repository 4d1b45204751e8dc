"""Sensors of the followers: from their true states to the measured ones. Any batch shape, NumPy and JAX arrays.

A follower measures its own position, attitude, velocity and body rates, `OWN_STATE` numbers, and computes the
object's error from them: `p_O = p - R r`, as the flight program does. `object_sensor` adds a sensor of the object with
errors of its own, as simulations of the paper had. Several followers have separate errors, and the same delay.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

    from mjxball.arrays import Array
    from mjxball.physics.engine import Vector

    Measured = Float[Array, "... slots"]  # 12, or 18 with a sensor of the object: the slots of an observation
    Errors = Float[Array, "... 18"]

# Errors at level 1 are a Crazyflie's, as `benchmarks/sensor_levels.py` finds them in public flights with motion capture
# (docs/archive/real-flights.md), in the slots of an observation; the last six are those of a sensor of the object.
# White noise, standard deviation: position, roll and pitch and yaw, velocity, body rates.
NOISE = np.array([*[5e-4] * 3, 1.5e-3, 1.5e-3, 5e-4, 5e-3, 5e-3, 1e-3, 0.01, 0.01, 4e-3, *[5e-4] * 3, *[5e-3] * 3])
# Slow errors of the estimator: standard deviation, and time over which they are correlated [s]. Those of roll, pitch
# and velocity grow with the speed, by 0.04 rad and 0.11 m/s per m/s, and are taken at 0.05 m/s.
DRIFT = np.array([*[1e-3] * 3, 2e-3, 2e-3, 5e-3, 5.5e-3, 5.5e-3, 4e-3, *[0.0] * 3, *[1e-3] * 3, *[5.5e-3] * 3])
DRIFT_TIME = np.array([*[0.4] * 3, 1.0, 1.0, 0.3, *[0.3] * 3, *[0.3] * 3, *[0.4] * 3, *[0.3] * 3])
# Constant errors of a drone: position, of the object in the hand, and velocity at rest (ours). Those of its attitude
# also turn its own loops, see `Load.attitude_error`: roll and pitch after a calibration, and the turn of its mount.
OFFSET = np.array([*[2e-3] * 3, *[0.0] * 3, *[1e-3] * 3, *[0.0] * 9])
ATTITUDE_OFFSET = np.radians([0.2, 0.2, 1.0])  # of roll, pitch, yaw [rad]
# Resolution of each slot in a Crazyflie's compressed state: 1 mm, 1 mm/s, 1 mrad/s, a quaternion in 32 bits.
RESOLUTION = np.array([*[1e-3] * 3, *[2.8e-3] * 3, *[1e-3] * 3, *[1e-3] * 3, *[1e-3] * 3, *[1e-3] * 3])
LAGGING = np.array([*[1.0] * 3, *[0.0] * 3, *[1.0] * 3, *[0.0] * 3, *[0.0] * 6])  # slots that the pose's lag delays


class Sample(NamedTuple):
    """Disturbances of one control step, or of all steps of a flight along a leading axis. The default is none."""

    errors: tuple[Errors, ...] = ()  # added to the measurement in this order
    received: Bool[Array, "..."] | None = None  # whether a measurement arrives; None: always
    force: Vector | None = None  # external force on O in the world until the next step [N]; None: none
    late: Float[Array, "..."] | None = None  # physics steps by which the commands at this step come late; None: none

    def at(self, number: int | slice) -> Sample:
        """Step `number` of a flight, or a slice of its steps."""
        errors = tuple(error[number] for error in self.errors)
        return Sample(errors, *(None if part is None else part[number] for part in self[1:]))


class SensorSettings(NamedTuple):
    """Settings of the sensors that differ between flights; any batch shape."""

    delay: Any = ()  # (...) of the measurements, in control steps; () without any
    keep: Float[Array, "..."] | None = None  # share of the last pose in a lagging one, exp(-period / lag); None: 0


EXACT = SensorSettings()


class SensorState(NamedTuple):
    """State of the sensors between control steps; () where an effect is absent."""

    settings: SensorSettings
    lagged: Any = ()  # (..., slots) true state as the lagging pose has it
    held: Any = ()  # (..., slots) measured state as last received
    past: Any = ()  # (longest delay + 1, ..., slots) measured states, newest first


@dataclass(frozen=True, eq=False)
class SensorModel:
    """The sensors of a batch of flights."""

    longest_delay: int = 0  # control steps
    quantized: Bool[np.ndarray, "... 1"] | bool = False  # whether measurements have the resolution `RESOLUTION`
    object_sensor: bool = False  # the object has a sensor of its own
    present: bool = True  # False: measurements are exact

    def start(self, truth: Measured, sample: Sample, settings: SensorSettings = EXACT) -> tuple[SensorState, Measured]:
        """(state, measurement) at the first step, as if the true state had always been `truth`."""
        xp = truth.__array_namespace__()
        measured = self._measure(truth, sample)
        state = SensorState(
            settings if self.longest_delay or settings.keep is not None else EXACT,
            () if settings.keep is None else truth,
            () if sample.received is None else measured,
            xp.broadcast_to(measured, (self.longest_delay + 1, *measured.shape)) if self.longest_delay else (),
        )
        return state, measured

    def step(self, state: SensorState, truth: Measured, sample: Sample) -> tuple[SensorState, Measured]:
        """(state, measurement) one control step later, at the true state `truth`."""
        xp, settings = truth.__array_namespace__(), state.settings
        if settings.keep is not None:
            lags = xp.asarray(LAGGING[: truth.shape[-1]], dtype=truth.dtype)
            truth = truth + lags * settings.keep[..., None] * (state.lagged - truth)
            state = state._replace(lagged=truth)
        measured = self._measure(truth, sample)
        if sample.received is not None:
            measured = xp.where(sample.received[..., None], measured, state.held)
            state = state._replace(held=measured)
        if not self.longest_delay:
            return state, measured
        past = xp.concat([measured[None], state.past[:-1]], axis=0)
        return state._replace(past=past), past[(settings.delay, *np.indices(truth.shape[:-1]))]

    def _measure(self, truth: Measured, sample: Sample) -> Measured:
        xp, size = truth.__array_namespace__(), truth.shape[-1]
        for error in sample.errors:
            truth = truth + error[..., :size]
        if np.any(self.quantized):
            steps = xp.asarray(RESOLUTION[:size], dtype=truth.dtype)
            truth = xp.where(xp.asarray(self.quantized), xp.round(truth / steps) * steps, truth)
        return truth
