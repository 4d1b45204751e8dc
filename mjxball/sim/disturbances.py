"""Disturbances of a flight: sensor noise, estimator drift, quantization, a relayed object error, delay, external force.

`SensorModel` is the model of a follower's sensors, on NumPy and JAX arrays. A `Sample` holds the disturbances of one
control step. It is sampled beforehand from the seeds of scenarios (`record`; the same in every batch and on every
engine), or during the flight from a JAX key (`RandomDisturbances`; training, with one key per environment). Several
followers have separate errors, but the same delay and messages. The leader flies on the true state, or on the first
follower's measurements with `scenario.leader_uses_measurements`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mjxball.config import Config
from mjxball.control.observation import ERROR, ERROR_RATE, OBSERVATION_SIZE
from mjxball.errors import InputError

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

    from mjxball.arrays import Array
    from mjxball.physics.engine import Vector

    Observation = Float[Array, "... 18"]

# Standard deviation of each observation slot at noise level 1: motion capture and a small drone's inertial sensors.
NOISE = np.array([*[0.003] * 3, *[0.005] * 3, *[0.02] * 3, *[0.02] * 3, *[0.003] * 3, *[0.02] * 3])
GUST_TIME = 1.0  # [s] over which a gust is correlated
# Slow error of each slot at level 1, a Crazyflie's estimator: position 1 mm, attitude 1 mrad, velocity 4 mm/s.
DRIFT = np.array([*[1e-3] * 3, *[1e-3] * 3, *[4e-3] * 3, *[0.0] * 3, *[1e-3] * 3, *[4e-3] * 3])
DRIFT_TIME = 1.0  # [s] over which it is correlated
# Resolution of each slot in a Crazyflie's compressed state: 1 mm, 1 mm/s, 1 mrad/s, a quaternion in 32 bits.
RESOLUTION = np.array([*[1e-3] * 3, *[2.8e-3] * 3, *[1e-3] * 3, *[1e-3] * 3, *[1e-3] * 3, *[1e-3] * 3])
Vector3 = tuple[float, float, float]


@dataclass(frozen=True)
class Disturbance:
    """Settings of the disturbances of one flight. The default is none."""

    noise: float = 0.0  # standard deviations of the follower's measurements, in units of `NOISE`
    delay: float = 0.0  # of the follower's measurements, a multiple of the control period [s]
    relay_rate: float = 0.0  # rate at which e_o and its rate reach the follower, held in between; 0: at once [Hz]
    relay_bias: Vector3 = (0.0, 0.0, 0.0)  # added to the relayed e_o [m]
    relay_loss: float = 0.0  # share of the relayed messages that is lost
    gust: float = 0.0  # rms of a random force on O, each axis of the world [N]
    seed: int = 0
    estimator_drift: float = 0.0  # slow error of the follower's measurements, in units of `DRIFT`
    quantize: bool = False  # measurements arrive with the resolution `RESOLUTION`


def check_disturbance(disturbance: Disturbance, period: float) -> None:
    """Raise InputError with one sentence if `disturbance` makes no sense at a control `period` [s]."""
    names = ("noise", "delay", "relay_rate", "gust", "estimator_drift")
    levels = [getattr(disturbance, name) for name in names]
    if not np.isfinite((*levels, *disturbance.relay_bias)).all():
        raise InputError("every number of a disturbance must be finite")
    if min(levels) < 0:
        raise InputError("noise, delay, relay rate, gust and estimator drift must not be negative")
    if abs(disturbance.delay / period - round(disturbance.delay / period)) > 1e-6:
        raise InputError(f"delay must be a multiple of the control period {period:g} s, not {disturbance.delay:g} s")
    if not 0 <= disturbance.relay_loss < 1:
        raise InputError(f"relay loss must be at least 0 and below 1, not {disturbance.relay_loss:g}")


class Sample(NamedTuple):
    """Disturbances of one control step, or of all steps of a flight along a leading axis. The default is none."""

    errors: tuple[Observation, ...] = ()  # added to the measurement in this order
    received: Bool[Array, "..."] | None = None  # whether a relayed message arrives, for each observation; None: always
    force: Vector | None = None  # external force on O in the world until the next step [N]; None: none

    def at(self, number: int | slice) -> Sample:
        """Step `number` of a flight, or a slice of its steps."""
        errors = tuple(error[number] for error in self.errors)
        return Sample(errors, *(None if part is None else part[number] for part in self[1:]))


class SensorState(NamedTuple):
    """State of the sensors between control steps; () where a disturbance is absent."""

    delay: Any = ()  # (...) delay of the measurements in control steps
    relayed: Any = ()  # (..., 6) object error and its rate as last received
    past: Any = ()  # (longest delay + 1, ..., 18) measurements, newest first


@dataclass(frozen=True, eq=False)
class SensorModel:
    """From the true observation to the measured one. Any batch shape, NumPy and JAX arrays."""

    longest_delay: int = 0  # control steps
    relay_bias: Float[np.ndarray, "... 3"] | None = None  # added to the object error [m]
    quantized: Bool[np.ndarray, "... 1"] | bool = False  # whether measurements have the resolution `RESOLUTION`

    def start(
        self, truth: Observation, sample: Sample, delay: Int[Array, "..."] | int = 0
    ) -> tuple[SensorState, Observation]:
        """(state, observation) at the first step, as if the true observation had always been `truth`."""
        xp = truth.__array_namespace__()
        measured, relayed = self._measure(truth, sample._replace(received=None), ())
        relayed = () if sample.received is None else relayed
        if not self.longest_delay:
            return SensorState((), relayed, ()), measured
        past = xp.broadcast_to(measured, (self.longest_delay + 1, *measured.shape))
        return SensorState(delay, relayed, past), measured

    def step(self, state: SensorState, truth: Observation, sample: Sample) -> tuple[SensorState, Observation]:
        """(state, observation) one control step later, with the true observation `truth`."""
        xp = truth.__array_namespace__()
        measured, relayed = self._measure(truth, sample, state.relayed)
        relayed = () if sample.received is None else relayed
        if not self.longest_delay:
            return SensorState((), relayed, ()), measured
        past = xp.concat([measured[None], state.past[:-1]], axis=0)
        return SensorState(state.delay, relayed, past), past[(state.delay, *np.indices(truth.shape[:-1]))]

    def _measure(self, truth: Observation, sample: Sample, held: Any) -> tuple[Observation, Float[Array, "... 6"]]:
        """The measurement now (..., 18), and its object part (..., 6) before it is quantized."""
        xp = truth.__array_namespace__()
        for error in sample.errors:
            truth = truth + error
        if self.relay_bias is not None:
            error = truth[..., ERROR] + xp.asarray(self.relay_bias, dtype=truth.dtype)
            truth = xp.concat([truth[..., : ERROR.start], error, truth[..., ERROR_RATE]], axis=-1)
        relayed = truth[..., ERROR.start :]
        if sample.received is not None:
            relayed = xp.where(sample.received[..., None], relayed, held)
            truth = xp.concat([truth[..., : ERROR.start], relayed], axis=-1)
        if np.any(self.quantized):
            truth = xp.where(xp.asarray(self.quantized), quantize(truth), truth)
        return truth, relayed


def quantize(observation: Observation) -> Observation:
    """`observation` rounded to the resolution in which a Crazyflie sends it."""
    xp = observation.__array_namespace__()
    steps = xp.asarray(RESOLUTION, dtype=observation.dtype)
    return xp.round(observation / steps) * steps


def followers_axis(config: Config) -> tuple[int, ...]:
    """Shape of the followers' axis: () for a pair, (F,) for several."""
    count = len(config.plant.followers)
    return (count,) if count > 1 else ()


def sensors_of(
    disturbances: Sequence[Disturbance], period: float, followers: tuple[int, ...] = ()
) -> tuple[SensorModel, Int[np.ndarray, "n ..."]]:
    """The sensors of n flights, and the delay of each in control steps; `followers` from `followers_axis`."""
    shape = (len(disturbances),) + (1,) * len(followers)
    delays = np.array([round(disturbance.delay / period) for disturbance in disturbances]).reshape(shape)
    bias = np.array([disturbance.relay_bias for disturbance in disturbances]).reshape(*shape, 3)
    quantized = np.array([disturbance.quantize for disturbance in disturbances]).reshape(*shape, 1)
    return SensorModel(int(delays.max()), bias if bias.any() else None, quantized), delays


def record(disturbances: Sequence[Disturbance], count: int, period: float, followers: tuple[int, ...] = ()) -> Sample:
    """Disturbances (count, n, ...) of n flights at `count` control steps, sampled from the flights' seeds.

    The first steps do not depend on `count`. `followers` from `followers_axis`.
    """
    errors = _stack([_recorded_errors(disturbance, (count, *followers), period) for disturbance in disturbances])
    received = _stack([_received(disturbance, count, period) for disturbance in disturbances])
    force = _stack([_gusts(disturbance, count, period) for disturbance in disturbances])
    if received is not None and followers:
        received = received[..., None]
    return Sample(() if errors is None else (errors,), received, force)


def _stack(tables: list[np.ndarray | None]) -> np.ndarray | None:
    """Tables of all flights along axis 1, neutral values for a flight without a table; None if no flight has one."""
    given = [table for table in tables if table is not None]
    if not given:
        return None
    nothing = np.ones_like(given[0]) if given[0].dtype == bool else np.zeros_like(given[0])
    return np.stack([nothing if table is None else table for table in tables], axis=1)


def _random(disturbance: Disturbance, stream: int) -> np.random.Generator:
    return np.random.default_rng([disturbance.seed, stream])


def _recorded_errors(
    disturbance: Disturbance, shape: tuple[int, ...], period: float
) -> Float[np.ndarray, "count ... 18"] | None:
    """Noise plus estimator drift of all steps in float32, or None without either."""
    if not (disturbance.noise or disturbance.estimator_drift):
        return None
    white = _random(disturbance, 1).standard_normal((*shape, OBSERVATION_SIZE), np.float32)
    slow = None
    if disturbance.estimator_drift:
        fresh = _random(disturbance, 4).standard_normal((*shape, OBSERVATION_SIZE))
        slow = disturbance.estimator_drift * _walk(fresh, period / DRIFT_TIME)
    return np.sum([error.astype(np.float32) for error in measurement_errors(disturbance.noise, white, slow)], axis=0)


def _received(disturbance: Disturbance, count: int, period: float) -> Bool[np.ndarray, " count"] | None:
    """(count,) true at the steps where a relayed message arrives; the first one always does."""
    if not disturbance.relay_rate:
        return None
    sent = np.floor(np.arange(count) * period * disturbance.relay_rate + 1e-9)
    arrives = np.diff(sent, prepend=-1.0) > 0
    arrives &= _random(disturbance, 2).random(count) >= disturbance.relay_loss
    arrives[0] = True
    return arrives


def _gusts(disturbance: Disturbance, count: int, period: float) -> Float[np.ndarray, "count 3"] | None:
    """(count, 3) first-order Gauss-Markov force [N] that starts in its steady state."""
    if not disturbance.gust:
        return None
    return disturbance.gust * _walk(_random(disturbance, 3).standard_normal((count, 3)), period / GUST_TIME)


def _walk(fresh: Float[np.ndarray, "count ..."], share: float) -> Float[np.ndarray, "count ..."]:
    """All steps of `gauss_markov` driven by white noise `fresh`, whose first value is the start."""
    slow = fresh.copy()
    for number in range(1, len(fresh)):
        slow[number] = gauss_markov(slow[number - 1], fresh[number], share)
    return slow


def gauss_markov(before: Array, fresh: Array, share: float, deviation: Array | float = 1.0) -> Array:
    """The next value of a first-order Gauss-Markov process with this standard `deviation`.

    `fresh` is white noise of deviation 1; `share` is the step over the time constant.
    """
    keep = math.exp(-share)
    return keep * before + deviation * math.sqrt(1 - keep * keep) * fresh


def measurement_errors(noise: Array | float, white: Array, drift: Array | None) -> tuple[Array, ...]:
    """Errors of a measurement: `noise` () level times `white` (..., 18), and the slow `drift` (..., 18) if given.

    `white` has deviation 1, `drift` has its level as deviation.
    """
    xp = white.__array_namespace__()
    noisy = noise * xp.asarray(NOISE, dtype=white.dtype) * white
    return (noisy,) if drift is None else (noisy, drift * xp.asarray(DRIFT, dtype=drift.dtype))


class RandomState(NamedTuple):
    """State of one environment's random disturbances between control steps."""

    key: Array
    noise: Float[Array, ""]  # level, in units of `NOISE`
    delay: Int[Array, ""]  # whole control steps
    gust: Float[Array, ""]  # rms of each axis of `force` [N]
    force: Float[Array, "3"]  # external force on O in the world, now [N]
    drift: Any = ()  # (..., 18) slow error, now, in units of `DRIFT`; () if there is none
    drift_level: Any = ()  # () in units of `DRIFT`


class RandomDisturbances:
    """Random disturbances of one training environment, with levels sampled from `config.scenario` at its reset. JAX."""

    def __init__(self, config: Config):
        scenario, self._period = config.scenario, config.timing.control_period
        self._ranges = (scenario.noise, scenario.delay, scenario.gust)
        self._drift, self._calm = scenario.estimator_drift, scenario.calm_probability
        self.present = any(high > 0 for _, high in (*self._ranges, self._drift)) or scenario.quantize
        self.sensors = SensorModel(math.floor(scenario.delay[1] / self._period + 0.5), None, scenario.quantize)
        self._shape = (*followers_axis(config), OBSERVATION_SIZE)

    def start(self, key: Array) -> tuple[Any, Sample]:
        """(state, sample of the first step) of an environment at its reset; the state is () if nothing is disturbed."""
        from jax import numpy as jnp
        from jax import random

        if not self.present:
            return (), Sample()
        level_key, key = random.split(key)
        share = random.uniform(level_key, (3,))
        noise, delay, gust = (low + (high - low) * u for (low, high), u in zip(self._ranges, share, strict=True))
        calm = random.uniform(random.fold_in(level_key, 1)) < self._calm
        noise, gust = jnp.where(calm, 0.0, noise), jnp.where(calm, 0.0, gust)
        key, noise_key, force_key = random.split(key, 3)
        drift: Any = ()
        level: Any = ()
        if self._drift[1] > 0:
            low, high = self._drift
            level = jnp.where(calm, 0.0, low + (high - low) * random.uniform(random.fold_in(noise_key, 2)))
            drift = level * random.normal(random.fold_in(noise_key, 3), self._shape)
        steps = jnp.round(delay / self._period).astype(jnp.int32)
        state = RandomState(key, noise, steps, gust, gust * random.normal(force_key, (3,)), drift, level)
        return state, self._sample(state, noise_key)

    def step(self, state: Any) -> tuple[Any, Sample]:
        """(state, sample) one control period later."""
        from jax import random

        if not self.present:
            return (), Sample()
        key, noise_key, force_key = random.split(state.key, 3)
        drift = state.drift
        if self._drift[1] > 0:
            fresh = random.normal(random.fold_in(noise_key, 1), self._shape)
            drift = gauss_markov(drift, fresh, self._period / DRIFT_TIME, state.drift_level)
        force = gauss_markov(state.force, random.normal(force_key, (3,)), self._period / GUST_TIME, state.gust)
        state = state._replace(key=key, force=force, drift=drift)
        return state, self._sample(state, noise_key)

    def _sample(self, state: RandomState, key: Array) -> Sample:
        from jax import random

        white = random.normal(key, self._shape)
        drift = state.drift if self._drift[1] > 0 else None
        return Sample(measurement_errors(state.noise, white, drift), force=state.force)
