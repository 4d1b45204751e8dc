"""A policy that answers one observation at a time, on NumPy: what `FollowerLaw` and `Network` compute, in few steps.

An operation of NumPy on the few numbers of one follower takes about as long whatever it computes. What is linear is
therefore one matrix, made once by putting unit vectors through the law, and the rest are Python's floats. All of it is
in double precision.
"""

from __future__ import annotations

import math

import numpy as np

from mjxball.control.follower_law import NEAR_ERROR, NEAR_ERROR_RATE, SATURATED, FollowerLaw
from mjxball.control.network import Network
from mjxball.control.observation import ACTION_SIZE, ERROR, ERROR_RATE, OBSERVATION_SIZE

PER_ERROR = 1 / NEAR_ERROR, 1 / NEAR_ERROR_RATE


class SingleFollower:
    """Network, law and memory of one follower, whose network has a hidden layer or more.

    Every input has a 1 in it, for the biases. What comes of a GRU is found from half of its gates, whose logistic
    function is then a hyperbolic tangent.
    """

    def __init__(self, law: FollowerLaw, network: Network):
        """Prepare `law` and the `network` in it, both of NumPy."""
        history, size, units = law.history, OBSERVATION_SIZE + law.history.size, law.units
        self._recurrent, self._residual = units > 0, law.residual
        self._reach, self._limits, self._gains = law.action_scale, law.limits, (law.gravity, *law.kp, *law.kd)
        features = law.input_size - size  # what a recurrent network sees besides
        unit = np.eye(size + ACTION_SIZE)
        observation, past, action = np.split(unit, [OBSERVATION_SIZE, size], axis=1)
        self._next_history = history.next(past, observation, action)
        shown = history.network_input(observation[:size], past[:size])
        # State, features, 1, observation, history -> the normalised input.
        count, one = shown.shape[1], units + features
        normal = np.zeros((one + 1 + size, count + features))
        normal[units:one, count:], normal[one, :], normal[one + 1 :, :count] = np.eye(features), -network.mean, shown
        normal *= network.scale
        weights = [weight.astype(np.float64) for weight in network.weights]
        # -> halves of the gates, of the candidate what the reset gate lets through and all the rest; the first layer.
        first = normal @ weights[0][units:]
        first[one] += network.biases[0]
        self._first = np.concatenate([*_halved(normal, one, network), first], axis=1)
        self._of_state, self._seen = 0.5 * weights[0][:units], np.zeros(self._first.shape[1])
        self._gates, self._kept, self._candidate, self._below = np.split(self._seen, np.cumsum([2, 1, 1]) * units)
        self._reset, self._update = np.split(self._gates, 2)
        self._change, self._of_next = np.zeros(units), np.zeros(first.shape[1])
        # Units of a layer, a 1, and in the last twice the GRU's next state -> the layer above.
        outputs = [np.ones(weight.shape[1] + 1) for weight in weights[:-1]]
        outputs[-1] = np.ones(len(outputs[-1]) + units)
        widths = [weight.shape[1] for weight in weights[:-1]]
        above = [np.insert(*row, axis=0) for row in zip(weights[1:], widths, network.biases[1:], strict=True)]
        above[-1][widths[-1] + 1 :] *= 0.5
        self._inner = outputs[0][: widths[0]]
        parts = zip(outputs[:-1], above[:-1], outputs[1:], widths[1:], strict=True)
        self._layers = [(given, weight, output[:width]) for given, weight, output, width in parts]
        self._top, self._last, self._twice = outputs[-1], above[-1], outputs[-1][widths[-1] + 1 :]
        seen = np.zeros(one + 1 + size + ACTION_SIZE)
        seen[one] = 1.0
        self._state, self._near, self._told, _ = np.split(seen, [units, units + (SATURATED if units else 0), one])
        self._input, self._past = seen[:-ACTION_SIZE], seen[one + 1 :]
        self._observation, self._history, self._action = np.split(self._past, [OBSERVATION_SIZE, size])
        self._errors, self._per_error = self._observation[ERROR.start : ERROR_RATE.stop], np.repeat(PER_ERROR, 3)
        self._zero, self._half = np.zeros(()), np.full((), 0.5)

    @property
    def memory(self) -> np.ndarray:
        """(m,) float64, laid out as that of `FollowerLaw`."""
        return np.concatenate([self._history, self._state, self._told])

    @memory.setter
    def memory(self, memory: np.ndarray) -> None:
        history, state, told = self._history, self._state, self._told
        history[:], state[:], told[:] = np.split(memory, np.cumsum([history.size, state.size]))

    def answer(self, observation: np.ndarray) -> tuple[list[float], list[float]] | None:
        """(action in [-1, 1] (3), command (3)) for `observation` (18,), which is remembered.

        None, and nothing is remembered, if the command is not finite.
        """
        self._observation[:] = observation
        if self._recurrent:
            np.multiply(self._errors, self._per_error, out=self._near)
            np.tanh(self._near, out=self._near)
        action = self._act()
        (tilt, vertical), (tilt_limit, vertical_limit) = self._reach, self._limits
        roll, pitch, rise = tilt * action[0], tilt * action[1], vertical * action[2]
        if self._residual:  # added to `observation.copy_command`
            x, y, z, vx, vy, vz = self._errors.tolist()
            gravity, kp_x, kp_y, kp_z, kd_x, kd_y, kd_z = self._gains
            roll += _clipped(-(kp_y * y + kd_y * vy) / gravity, tilt_limit)
            pitch += _clipped((kp_x * x + kd_x * vx) / gravity, tilt_limit)
            rise += _clipped(kp_z * z + kd_z * vz, vertical_limit)
        command = [_clipped(roll, tilt_limit), _clipped(pitch, tilt_limit), _clipped(rise, vertical_limit)]
        if not math.isfinite(sum(command)):
            return None
        self._action[:] = action
        self._history[:] = np.dot(self._past, self._next_history)
        np.multiply(self._twice, self._half, out=self._state)
        return action, command

    def _act(self) -> list[float]:
        """Action in [-1, 1] (3)."""
        np.dot(self._input, self._first, out=self._seen)
        if self._recurrent:
            self._advance()
        np.maximum(self._below, self._zero, out=self._inner)
        for given, weight, output in self._layers:
            np.dot(given, weight, out=output)
            np.maximum(output, self._zero, out=output)
        return [math.tanh(value) for value in np.dot(self._top, self._last).tolist()]

    def _advance(self) -> None:
        """Twice the next state, and what the first layer sees of it: `control.network.gru_cell`."""
        state, candidate, change, twice = self._state, self._candidate, self._change, self._twice
        np.tanh(self._gates, out=self._gates)
        np.multiply(self._reset, self._kept, out=self._kept)
        np.add(candidate, self._kept, out=candidate)
        np.tanh(candidate, out=candidate)
        np.subtract(state, candidate, out=change)
        np.multiply(change, self._update, out=change)
        np.add(state, candidate, out=twice)
        np.add(twice, change, out=twice)
        np.dot(twice, self._of_state, out=self._of_next)
        np.add(self._below, self._of_next, out=self._below)


def _halved(normal: np.ndarray, one: int, network: Network) -> list[np.ndarray]:
    """Columns of the matrix for a GRU, none without one; `one`: the row of the biases."""
    if network.gru is None:
        return []
    kernel, recurrent, bias = (part.astype(np.float64) for part in network.gru)
    units = len(recurrent)
    given, kept = normal @ kernel, np.zeros((len(normal), 3 * units))
    given[one] += bias
    kept[:units] = 0.5 * recurrent
    gates, candidate = slice(2 * units), slice(2 * units, None)
    return [0.5 * given[:, gates] + kept[:, gates], kept[:, candidate], given[:, candidate] + kept[:, candidate]]


def _clipped(value: float, limit: float) -> float:
    """`value` within +-`limit`; what is no number stays so."""
    return min(max(value, -limit), limit)
