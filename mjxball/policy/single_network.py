"""A network that answers one observation at a time, on NumPy, and the follower that is one on the leader's PD law.

An operation of NumPy on the few numbers of one follower takes about as long whatever it computes. What is linear is
therefore one matrix, made once by putting unit vectors through the law. All of it is in double precision.
"""

from __future__ import annotations

import math

import numpy as np

from mjxball.control.follower_law import NEAR_ERROR, NEAR_ERROR_RATE, FollowerLaw
from mjxball.control.network import Network
from mjxball.control.observation import ACTION_SIZE, ERROR, ERROR_RATE, OBSERVATION_SIZE

TURNED = (0, 1), (2, 3), (5, 8), (6, 9), (7, 10), (15, 16), (20, 21)  # features about roll and pitch that are vectors


class SingleNetwork:
    """The network with the history that it sees and the state of its GRU, if it has one.

    Every input has a 1 in it, for the biases. What comes of a GRU is found from half of its gates, whose logistic
    function is then a hyperbolic tangent.
    """

    def __init__(self, law: FollowerLaw, network: Network):
        """`law` and the `network` in it, both of NumPy."""
        history, size, units = law.history, OBSERVATION_SIZE + law.history.size, law.units
        features = law.shown - history.size - units
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
        self._of_features, self._of_state = self._first[units:one].copy(), weights[0][:units].copy()
        self._seen = np.zeros(self._first.shape[1])
        self._gates, self._kept, self._candidate, self._below = np.split(self._seen, np.cumsum([2, 1, 1]) * units)
        self._reset, self._update = np.split(self._gates, 2)
        self._change, self._of_next = np.zeros(units), np.zeros(first.shape[1])
        # Units of a layer, a 1, and in the last the GRU's next state -> the layer above.
        outputs = [np.ones(weight.shape[1] + 1) for weight in weights[:-1]]
        outputs[-1] = np.ones(len(outputs[-1]) + units)
        widths = [weight.shape[1] for weight in weights[:-1]]
        above = [np.insert(*row, axis=0) for row in zip(weights[1:], widths, network.biases[1:], strict=True)]
        self._inner = outputs[0][: widths[0]]
        parts = zip(outputs[:-1], above[:-1], outputs[1:], widths[1:], strict=True)
        self._layers = [(given, weight, output[:width]) for given, weight, output, width in parts]
        self._top, self._last, self._next = outputs[-1], above[-1], outputs[-1][widths[-1] + 1 :]
        seen = np.zeros(one + 1 + size + ACTION_SIZE)
        seen[one] = 1.0
        self.state, self._features, self._input = seen[:units], seen[units:one], seen[:-ACTION_SIZE]
        self._past = seen[one + 1 :]
        self._observation, self.history, self._action = np.split(self._past, [OBSERVATION_SIZE, size])
        self._zero, self._half = np.zeros(()), np.full((), 0.5)

    def tell(self, cos: float, sin: float) -> None:
        """Take features about axes that are turned in the mount frame, of which the network has learnt."""
        for one, other in TURNED if len(self._features) > max(TURNED[-1]) else TURNED[:-1]:
            x, y = self._of_features[one], self._of_features[other]
            self._first[one], self._first[other] = cos * x + sin * y, cos * y - sin * x

    def act(self, features: list[float], observation: np.ndarray) -> list[float]:
        """Action in [-1, 1] (3)."""
        self._features[:], self._observation[:] = features, observation
        np.dot(self._input, self._first, out=self._seen)
        if self.state.size:
            self._advance()
        np.maximum(self._below, self._zero, out=self._inner)
        for given, weight, output in self._layers:
            np.dot(given, weight, out=output)
            np.maximum(output, self._zero, out=output)
        return [math.tanh(value) for value in np.dot(self._top, self._last).tolist()]

    def _advance(self) -> None:
        """The next state, and what the first layer sees of it: `control.network.gru_cell`."""
        state, candidate, change, following = self.state, self._candidate, self._change, self._next
        np.tanh(self._gates, out=self._gates)
        np.multiply(self._reset, self._kept, out=self._kept)
        np.add(candidate, self._kept, out=candidate)
        np.tanh(candidate, out=candidate)
        np.subtract(state, candidate, out=change)
        np.multiply(change, self._update, out=change)
        np.add(state, candidate, out=following)
        np.add(following, change, out=following)
        np.multiply(following, self._half, out=following)
        np.dot(following, self._of_state, out=self._of_next)
        np.add(self._below, self._of_next, out=self._below)

    def remember(self, action: list[float]) -> None:
        """Move the history on by the newest observation and its `action`, and the state of the GRU."""
        self._action[:] = action
        self.history[:] = np.dot(self._past, self._next_history)
        self.state[:] = self._next


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


class SinglePdFollower:
    """Network and memory of one follower whose action is added to the leader's PD law, or flown as it is."""

    def __init__(self, law: FollowerLaw, network: Network):
        """Prepare `law`, which has no LQG, and its `network`."""
        self._network, self._recurrent, self._residual = SingleNetwork(law, network), law.units > 0, law.residual
        self._reach, self._limits, self._leader = law.action_scale, law.limits, (law.gravity, *law.kp, *law.kd)
        self._told: list[float] = []

    @property
    def memory(self) -> np.ndarray:
        """(m,) float64, laid out as that of `FollowerLaw`."""
        return np.concatenate([self._network.history, self._network.state, self._told])

    @memory.setter
    def memory(self, memory: np.ndarray) -> None:
        history, state = self._network.history, self._network.state
        history[:], state[:], told = np.split(memory, np.cumsum([history.size, state.size]))
        self._told = told.tolist()

    def answer(self, observation: np.ndarray) -> tuple[list[float], list[float]] | None:
        """(action in [-1, 1] (3), command (3)) for `observation` (18,), which is remembered.

        None, and nothing is remembered, if the command is not finite.
        """
        seen = observation.tolist()
        error, rate, features = seen[ERROR], seen[ERROR_RATE], self._told
        if self._recurrent:
            small = [value / NEAR_ERROR for value in error] + [value / NEAR_ERROR_RATE for value in rate]
            features = [*map(math.tanh, small), *features]
        action = self._network.act(features, observation)
        tilt, vertical = self._reach
        command = [tilt * action[0], tilt * action[1], vertical * action[2]]
        if self._residual:
            led = led_command(self._leader, self._limits, *error, *rate)
            command = [own + other for own, other in zip(command, led, strict=True)]
        tilt, vertical = self._limits
        command = [clipped(command[0], tilt), clipped(command[1], tilt), clipped(command[2], vertical)]
        if not math.isfinite(sum(command)):
            return None
        self._network.remember(action)
        return action, command


def led_command(
    leader: tuple[float, ...], limits: tuple[float, float], x: float, y: float, z: float, *rate: float
) -> tuple[float, float, float]:
    """`observation.copy_command` of an error (x, y, z) and its `rate`; `leader`: gravity, kp (3), kd (3)."""
    (gravity, kp_x, kp_y, kp_z, kd_x, kd_y, kd_z), (tilt, vertical), (vx, vy, vz) = leader, limits, rate
    return (
        clipped(-(kp_y * y + kd_y * vy) / gravity, tilt),
        clipped((kp_x * x + kd_x * vx) / gravity, tilt),
        clipped(kp_z * z + kd_z * vz, vertical),
    )


def clipped(value: float, limit: float) -> float:
    """`value` within +-`limit`; what is no number stays so."""
    return min(max(value, -limit), limit)
