"""Disturbances of a flight: its settings, and their samples for recorded flights and for training.

A `Sample` holds the disturbances of one control step. It is sampled beforehand from the seeds of scenarios (`record`;
the same in every batch and on every engine), or during the flight from a JAX key (`RandomDisturbances`; training, with
one key per environment). The leader flies on the true state, or on the first follower's measurements with
`scenario.leader_uses_measurements`; constant errors of the attitude (`attitude_errors`) are those of all drones.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mjxball.config import Config
from mjxball.control.observation import OBSERVATION_SIZE
from mjxball.errors import InputError
from mjxball.sim.sensors import ATTITUDE_OFFSET, DRIFT, DRIFT_TIME, NOISE, OFFSET, Sample, SensorModel, SensorSettings

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

    from mjxball.arrays import Array

GUST_TIME = 1.0  # [s] over which a gust is correlated
LONGEST_GAP = 0.5  # of the measurements [s]; gaps last between one control period and this


@dataclass(frozen=True)
class Disturbance:
    """Settings of the disturbances of one flight. The default is none."""

    noise: float = 0.0  # standard deviations of the followers' measurements, in units of `NOISE`
    delay: float = 0.0  # of the followers' measurements, a multiple of the control period [s]
    gust: float = 0.0  # rms of a random force on O, each axis of the world [N]
    seed: int = 0
    gust_seed: int | None = None  # of the gusts; None: `seed`
    estimator_drift: float = 0.0  # slow error of the followers' measurements, in units of `DRIFT`
    quantize: bool = False  # measurements arrive with the resolution `RESOLUTION`
    offset: float = 0.0  # constant errors of each drone, in units of `OFFSET` and `ATTITUDE_OFFSET`
    pose_lag: float = 0.0  # time constant with which measured position and velocity follow the true ones [s]
    gap_rate: float = 0.0  # mean number of gaps in the measurements, which are held meanwhile [1/s]
    jitter: float = 0.0  # commands take effect up to so late, a part of the control period [s]
    object_sensor: bool = False  # the object's error has a sensor of its own instead of following from the own state


def check_disturbance(disturbance: Disturbance, period: float) -> None:
    """Raise InputError with one sentence if `disturbance` makes no sense at a control `period` [s]."""
    names = ("noise", "delay", "gust", "estimator_drift", "offset", "pose_lag", "gap_rate", "jitter")
    levels = [getattr(disturbance, name) for name in names]
    if not np.isfinite(levels).all():
        raise InputError("every number of a disturbance must be finite")
    if min(levels) < 0:
        raise InputError(f"{', '.join(names).replace('_', ' ')} must not be negative")
    if abs(disturbance.delay / period - round(disturbance.delay / period)) > 1e-6:
        raise InputError(f"delay must be a multiple of the control period {period:g} s, not {disturbance.delay:g} s")
    if disturbance.jitter >= period:
        raise InputError(f"jitter must be below the control period {period:g} s, not {disturbance.jitter:g} s")
    if disturbance.gap_rate * period >= 1:
        raise InputError(f"gap rate must be below one a control period, 1/{period:g} s, not {disturbance.gap_rate:g}/s")


def followers_axis(config: Config) -> tuple[int, ...]:
    """Shape of the followers' axis: () for a pair, (F,) for several."""
    count = len(config.plant.followers)
    return (count,) if count > 1 else ()


def sensors_of(
    disturbances: Sequence[Disturbance], period: float, followers: tuple[int, ...] = ()
) -> tuple[SensorModel, SensorSettings]:
    """The sensors of n flights and their settings; `followers` from `followers_axis`."""
    shape = (len(disturbances),) + (1,) * len(followers)
    delays = np.array([round(disturbance.delay / period) for disturbance in disturbances]).reshape(shape)
    lags = np.array([disturbance.pose_lag for disturbance in disturbances]).reshape(shape)
    quantized = np.array([disturbance.quantize for disturbance in disturbances]).reshape(*shape, 1)
    own = {disturbance.object_sensor for disturbance in disturbances}
    if len(own) > 1:
        raise InputError("flights of one batch must all have a sensor of the object, or none of them")
    keep = np.exp(-period / np.maximum(lags, 1e-9)) if lags.any() else None
    exact = (one for one in disturbances if one != _of_plant(one))
    return SensorModel(int(delays.max()), quantized, own.pop(), any(True for _ in exact)), SensorSettings(delays, keep)


def _of_plant(disturbance: Disturbance) -> Disturbance:
    """`disturbance` without what it does to measurements."""
    return Disturbance(
        gust=disturbance.gust, seed=disturbance.seed, gust_seed=disturbance.gust_seed, jitter=disturbance.jitter
    )


def record(
    disturbances: Sequence[Disturbance],
    count: int,
    period: float,
    followers: tuple[int, ...] = (),
    physics_steps: int = 1,
) -> Sample:
    """Disturbances (count, n, ...) of n flights at `count` control steps, sampled from the flights' seeds.

    The first steps do not depend on `count`. `followers` from `followers_axis`; a period has `physics_steps`.
    """
    errors = _stack([_recorded_errors(disturbance, (count, *followers), period) for disturbance in disturbances])
    received = _stack([_received(disturbance, count, period) for disturbance in disturbances])
    force = _stack([_gusts(disturbance, count, period) for disturbance in disturbances])
    late = _stack([_late(disturbance, count, period / physics_steps) for disturbance in disturbances])
    if received is not None and followers:
        received = received[..., None]
    return Sample(() if errors is None else (errors,), received, force, late)


def attitude_errors(disturbance: Disturbance, drones: int) -> Float[np.ndarray, "drones 3"]:
    """What the attitude of each drone is off: roll, pitch and the turn of its mount [rad], from the flight's seed."""
    return disturbance.offset * ATTITUDE_OFFSET * _random(disturbance, 7).standard_normal((drones, 3))


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
    """Noise, estimator drift and offsets of all steps in float32, or None without any."""
    if not (disturbance.noise or disturbance.estimator_drift or disturbance.offset):
        return None
    white = _random(disturbance, 1).standard_normal((*shape, OBSERVATION_SIZE), np.float32)
    slow: Any = None
    if disturbance.estimator_drift:
        fresh = _random(disturbance, 4).standard_normal((*shape, OBSERVATION_SIZE))
        slow = disturbance.estimator_drift * _walk(fresh, period / DRIFT_TIME)
    errors = [error.astype(np.float32) for error in measurement_errors(disturbance.noise, white, slow)]
    if disturbance.offset:
        constant = _random(disturbance, 5).standard_normal((*shape[1:], OBSERVATION_SIZE))
        errors.append(np.broadcast_to((disturbance.offset * OFFSET * constant).astype(np.float32), white.shape))
    return np.sum(errors, axis=0)


def _received(disturbance: Disturbance, count: int, period: float) -> Bool[np.ndarray, " count"] | None:
    """(count,) true at the steps where a measurement arrives; the first one always does."""
    if not disturbance.gap_rate:
        return None
    begins, longs = _random(disturbance, 2).random((count, 2)).T
    lengths = gap_steps(longs, period)
    arrives, left = np.ones(count, bool), 0
    for number in range(1, count):
        left = max(left - 1, 0)
        if arrives[number - 1] and begins[number] < disturbance.gap_rate * period:
            left = int(lengths[number])
        arrives[number] = not left
    return arrives


def gap_steps(share: Array, period: float) -> Array:
    """Length of a gap in control steps for a uniform random `share` in 0 to 1: one to the longest, by factor."""
    return share.__array_namespace__().ceil((LONGEST_GAP / period) ** share - 1e-4)


def _late(disturbance: Disturbance, count: int, step: float) -> Float[np.ndarray, " count"] | None:
    """(count,) whole physics steps of length `step` [s] by which commands are late, uniform up to the jitter."""
    if not disturbance.jitter:
        return None
    return np.floor(_random(disturbance, 6).random(count) * (disturbance.jitter / step + 1))


def _gusts(disturbance: Disturbance, count: int, period: float) -> Float[np.ndarray, "count 3"] | None:
    """(count, 3) first-order Gauss-Markov force [N] that starts in its steady state."""
    if not disturbance.gust:
        return None
    seed = disturbance.seed if disturbance.gust_seed is None else disturbance.gust_seed
    return disturbance.gust * _walk(np.random.default_rng([seed, 3]).standard_normal((count, 3)), period / GUST_TIME)


def _walk(fresh: Float[np.ndarray, "count ..."], share: Any) -> Float[np.ndarray, "count ..."]:
    """All steps of `gauss_markov` driven by white noise `fresh`, whose first value is the start."""
    slow = fresh.copy()
    for number in range(1, len(fresh)):
        slow[number] = gauss_markov(slow[number - 1], fresh[number], share)
    return slow


def gauss_markov(before: Array, fresh: Array, share: Any, deviation: Array | float = 1.0) -> Array:
    """The next value of a first-order Gauss-Markov process with this standard `deviation`.

    `fresh` is white noise of deviation 1; `share` is the step over the time constant, of each slot or of all.
    """
    keep = np.exp(-np.asarray(share)).astype(fresh.dtype)
    return keep * before + deviation * np.sqrt(1 - keep * keep) * fresh


def measurement_errors(noise: Array | float, white: Array, drift: Array | None) -> tuple[Array, ...]:
    """Errors of a measurement: `noise` () level times `white` (..., 18), and the slow `drift` (..., 18) if given.

    `white` has deviation 1, `drift` has its level as deviation.
    """
    xp = white.__array_namespace__()
    noisy = noise * xp.asarray(NOISE, dtype=white.dtype) * white
    return (noisy,) if drift is None else (noisy, drift * xp.asarray(DRIFT, dtype=drift.dtype))


class RandomState(NamedTuple):
    """State of one environment's random disturbances between control steps; () for what is absent."""

    key: Array
    noise: Float[Array, ""]  # level, in units of `NOISE`
    settings: SensorSettings
    gust: Float[Array, ""]  # rms of each axis of `force` [N]
    force: Float[Array, "3"]  # external force on O in the world, now [N]
    drift: Any = ()  # (..., 18) slow error, now, in units of `DRIFT`
    drift_level: Any = ()  # () in units of `DRIFT`
    constant: Any = ()  # (..., 18) constant errors
    gap_rate: Any = ()  # () [1/s]
    gap_left: Any = ()  # () control steps of the present gap
    jitter: Any = ()  # () [s]
    late: Any = None  # () physics steps by which the next commands come late


class RandomDisturbances:
    """Random disturbances of one training environment, with levels sampled from `config.scenario` at its reset. JAX."""

    def __init__(self, config: Config):
        scenario, self._period = config.scenario, config.timing.control_period
        self._step = self._period / config.timing.physics_steps
        self._ranges = (scenario.noise, scenario.delay, scenario.gust)
        self._drift, self._calm = scenario.estimator_drift, scenario.calm_probability
        self._offset, self._lag = scenario.offset, scenario.pose_lag
        self._gaps, self._jitter = scenario.gap_rate, scenario.jitter
        measured = (scenario.noise, scenario.delay, self._drift, self._offset, self._lag, self._gaps)
        exact = not (any(high > 0 for _, high in measured) or scenario.quantize)
        self.jitters = self._jitter[1] > 0
        self.present = not exact or scenario.gust[1] > 0 or self.jitters
        longest = math.floor(scenario.delay[1] / self._period + 0.5)
        self.sensors = SensorModel(longest, scenario.quantize, scenario.object_sensor, not exact)
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

        def sampled(ends: tuple[float, float], stream: int) -> Array:
            return ends[0] + (ends[1] - ends[0]) * random.uniform(random.fold_in(noise_key, stream))

        steps = jnp.round(delay / self._period).astype(jnp.int32)
        lag = jnp.where(calm, 0.0, sampled(self._lag, 4)) if self._lag[1] > 0 else None
        keep = None if lag is None else jnp.exp(-self._period / jnp.maximum(lag, 1e-6))
        state = RandomState(key, noise, SensorSettings(steps, keep), gust, gust * random.normal(force_key, (3,)))
        if self._drift[1] > 0:
            level = jnp.where(calm, 0.0, sampled(self._drift, 2))
            slow = level * random.normal(random.fold_in(noise_key, 3), self._shape)
            state = state._replace(drift=slow, drift_level=level)
        if self._offset[1] > 0:
            constant = random.normal(random.fold_in(noise_key, 6), self._shape)
            state = state._replace(constant=sampled(self._offset, 5) * jnp.asarray(OFFSET, jnp.float32) * constant)
        if self._gaps[1] > 0:
            rate = jnp.where(calm, 0.0, sampled(self._gaps, 7))
            state = state._replace(gap_rate=rate, gap_left=jnp.zeros(()))
        if self.jitters:
            state = state._replace(jitter=jnp.where(calm, 0.0, sampled(self._jitter, 8)))
        return self._sampled(state, noise_key)

    def step(self, state: Any) -> tuple[Any, Sample]:
        """(state, sample) one control period later."""
        from jax import numpy as jnp
        from jax import random

        if not self.present:
            return (), Sample()
        key, noise_key, force_key = random.split(state.key, 3)
        if self._drift[1] > 0:
            fresh = random.normal(random.fold_in(noise_key, 1), self._shape)
            state = state._replace(drift=gauss_markov(state.drift, fresh, self._period / DRIFT_TIME, state.drift_level))
        if self._gaps[1] > 0:
            begins, long = random.uniform(random.fold_in(noise_key, 2), (2,))
            left = jnp.maximum(state.gap_left - 1.0, 0.0)
            starts = (state.gap_left == 0) & (begins < state.gap_rate * self._period)
            state = state._replace(gap_left=jnp.where(starts, gap_steps(long, self._period), left))
        force = gauss_markov(state.force, random.normal(force_key, (3,)), self._period / GUST_TIME, state.gust)
        return self._sampled(state._replace(key=key, force=force), noise_key)

    def _sampled(self, state: RandomState, key: Array) -> tuple[RandomState, Sample]:
        from jax import numpy as jnp
        from jax import random

        errors: tuple[Any, ...] = ()
        if self.sensors.present:
            white = random.normal(key, self._shape)
            errors = measurement_errors(state.noise, white, state.drift if self._drift[1] > 0 else None)
            errors += (state.constant,) * (self._offset[1] > 0)
        received = None
        if self._gaps[1] > 0:
            received = jnp.broadcast_to(state.gap_left == 0, self._shape[:-1])
        if self.jitters:
            share = random.uniform(random.fold_in(key, 9))
            state = state._replace(late=jnp.floor(share * (state.jitter / self._step + 1.0)))
        return state, Sample(errors, received)
