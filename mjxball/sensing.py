"""What comes between a flight and its follower: sensor noise, a relayed object error, delay; and gusts on the object.

Everything is drawn from the scenario's seed before the flight, so a scenario is the same in every batch and on every
engine. Only the follower's senses are disturbed; the leader flies on the truth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mjxball.control.observation import ERROR, ERROR_RATE, OBSERVATION_SIZE
from mjxball.errors import InputError

# Standard deviation of each observation slot at noise level 1: motion capture and a small drone's inertial sensors.
NOISE = np.array([*[0.003] * 3, *[0.005] * 3, *[0.02] * 3, *[0.02] * 3, *[0.003] * 3, *[0.02] * 3])
GUST_TIME = 1.0  # [s] over which a gust is correlated
Vector3 = tuple[float, float, float]


@dataclass(frozen=True)
class Disturbance:
    """What disturbs one flight. The default is nothing."""

    noise: float = 0.0  # standard deviations of the follower's measurements, in units of `NOISE`
    delay: float = 0.0  # of the follower's measurements, a multiple of the control period [s]
    relay_rate: float = 0.0  # e_o and its rate reach the follower this often, held in between; 0: at once [Hz]
    relay_bias: Vector3 = (0.0, 0.0, 0.0)  # added to the relayed e_o [m]
    relay_loss: float = 0.0  # share of the relayed messages that is lost
    gust: float = 0.0  # rms of a random force on O, each axis of the world [N]
    seed: int = 0


def check(disturbance: Disturbance, period: float) -> None:
    """Raise InputError with one sentence if `disturbance` makes no sense."""
    numbers = (disturbance.noise, disturbance.delay, disturbance.relay_rate, disturbance.gust, *disturbance.relay_bias)
    if not np.isfinite(numbers).all():
        raise InputError("every number of a disturbance must be finite")
    if min(disturbance.noise, disturbance.delay, disturbance.relay_rate, disturbance.gust) < 0:
        raise InputError("noise, delay, relay rate and gust must not be negative")
    if abs(disturbance.delay / period - round(disturbance.delay / period)) > 1e-6:
        raise InputError(f"delay must be a multiple of the control period {period:g} s, not {disturbance.delay:g} s")
    if not 0 <= disturbance.relay_loss < 1:
        raise InputError(f"relay loss must be at least 0 and below 1, not {disturbance.relay_loss:g}")


class Senses:
    """The disturbances of n flights of `count` control steps. `observe` must be called once a step, in order."""

    def __init__(self, disturbances: Sequence[Disturbance], count: int, period: float):
        self._noise = _stack([_noise(d, count) for d in disturbances])
        self._arrives = _stack([_arrivals(d, count, period) for d in disturbances])
        self._push = _stack([_gusts(d, count, period) for d in disturbances])
        self._bias = np.array([d.relay_bias for d in disturbances])
        self._delays = np.array([round(d.delay / period) for d in disturbances])
        self._relayed: np.ndarray | None = None
        self._past: list[np.ndarray] = []

    @property
    def pushes(self) -> np.ndarray | None:
        """Force on O (count + 1, n, 3) in the world [N]; None if there is none."""
        return self._push

    def observe(self, number: int, seen: np.ndarray) -> np.ndarray:
        """What the followers get to see (n, 18) of what is true (n, 18) at control step `number`."""
        seen = seen if self._noise is None else seen + self._noise[number]
        if self._arrives is not None:
            relayed = np.concatenate([seen[:, ERROR] + self._bias, seen[:, ERROR_RATE]], axis=1)
            new = self._arrives[number][:, None]
            self._relayed = relayed if self._relayed is None else np.where(new, relayed, self._relayed)
            seen = np.concatenate([seen[:, : ERROR.start], self._relayed], axis=1)
        elif self._bias.any():
            seen = seen.copy()
            seen[:, ERROR] += self._bias
        if not self._delays.any():
            return seen
        self._past = [seen, *self._past][: self._delays.max() + 1]
        age = np.minimum(self._delays, len(self._past) - 1)
        return np.stack(self._past)[age, np.arange(len(age))]


def _stack(tables: list[np.ndarray | None]) -> np.ndarray | None:
    """Tables of all flights along axis 1, with what 'nothing' means where one has none; None if nobody has one."""
    given = [table for table in tables if table is not None]
    if not given:
        return None
    nothing = np.ones_like(given[0]) if given[0].dtype == bool else np.zeros_like(given[0])
    return np.stack([nothing if table is None else table for table in tables], axis=1)


def _random(disturbance: Disturbance, stream: int) -> np.random.Generator:
    return np.random.default_rng([disturbance.seed, stream])


def _noise(disturbance: Disturbance, count: int) -> np.ndarray | None:
    if not disturbance.noise:
        return None
    drawn = _random(disturbance, 1).standard_normal((count + 1, OBSERVATION_SIZE), np.float32)
    return drawn * (disturbance.noise * NOISE).astype(np.float32)


def _arrivals(disturbance: Disturbance, count: int, period: float) -> np.ndarray | None:
    """True at the steps where a relayed message arrives; the first one always does."""
    if not disturbance.relay_rate:
        return None
    sent = np.floor(np.arange(count + 1) * period * disturbance.relay_rate + 1e-9)
    arrives = np.diff(sent, prepend=-1.0) > 0
    arrives &= _random(disturbance, 2).random(count + 1) >= disturbance.relay_loss
    arrives[0] = True
    return arrives


def _gusts(disturbance: Disturbance, count: int, period: float) -> np.ndarray | None:
    """A first-order Gauss-Markov force (count + 1, 3) that starts in its steady state."""
    if not disturbance.gust:
        return None
    drawn = _random(disturbance, 3).standard_normal((count + 1, 3))
    keep = math.exp(-period / GUST_TIME)
    force = np.empty_like(drawn)
    force[0] = drawn[0]
    for number in range(1, count + 1):
        force[number] = keep * force[number - 1] + math.sqrt(1 - keep * keep) * drawn[number]
    return disturbance.gust * force
