"""A policy of format 4 that answers one observation at a time, on NumPy: what `FollowerLaw` computes, in few steps.

As in `single_network`, what is linear is one matrix, and the rest are Python's floats.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from mjxball.control.follower_law import FollowerLaw
from mjxball.control.followers import LARGEST
from mjxball.control.multi_model_lqg import (
    ANGLE_STATES,
    AXES,
    CONTEXT,
    HEIGHT_STATES,
    LEAST_ROOM,
    MultiModelLqg,
    is_pair,
)
from mjxball.control.network import Network
from mjxball.control.swing import LEAST_ENERGY, SHARPNESS, STATES
from mjxball.policy.single_network import SingleNetwork, SinglePdFollower, clipped, led_command

Array = Any


def single_follower(law: FollowerLaw, network: Network) -> SingleFollower | SinglePdFollower | None:
    """One follower of `law` that remembers something, None if only the law of arrays answers it."""
    if len(network.weights) < 2:
        return None
    if law.lqg is None:
        return SinglePdFollower(law, network)
    return SingleFollower(law, law.lqg, network) if isinstance(law.lqg, MultiModelLqg) else None


class SingleFollower:
    """Network, law and memory of one follower; names are those of `MultiModelLqg`."""

    def __init__(self, law: FollowerLaw, lqg: MultiModelLqg, network: Network):
        """Prepare `law`, with `lqg` in it, and its `network`."""
        self._filters, self._network = _Filters(lqg), SingleNetwork(law, network)
        self._swings, self._held_room = _Swings(lqg) if lqg.swings else None, float(lqg.held_room)
        self._height, self._height_gain = lqg.height.tolist(), lqg.height_gain.tolist()
        self._rise, self._limits, self._keep = lqg.rise.tolist(), lqg.limits.tolist(), float(lqg.keep[1])
        self._added_lift, self._pair_roll_room = float(lqg.added_lift), float(lqg.pair_roll_room)
        self._frame_of, self._of_size = lqg.frame, None if lqg.by_size is None else lqg.of_size
        self._reach, self._clip = law.action_scale, law.limits
        self._leader = law.gravity, *law.kp, *law.kd

    @property
    def memory(self) -> Array:
        """(m,) float64, laid out as that of `FollowerLaw`."""
        filters, rest = self._filters, [*self._slow, *self._context]
        swinging = self._swings.memory if self._swings else []
        parts = [self._network.history, filters.predicted.ravel(), self._rising, filters.scores.ravel(), swinging, rest]
        return np.concatenate(parts)

    @memory.setter
    def memory(self, memory: Array) -> None:
        filters, history = self._filters, self._network.history
        swinging = self._swings.memory.size if self._swings else 0
        sizes = (history.size, filters.predicted.size, HEIGHT_STATES, filters.scores.size, swinging, 2, CONTEXT)
        parts = np.split(memory, np.cumsum(sizes)[:-1])
        if self._swings:
            self._swings.memory = parts[4]
        history[:], filters.predicted[:], filters.scores[:] = (
            parts[0],
            parts[1].reshape(AXES, -1),
            parts[3].reshape(2, -1),
        )
        self._rising, self._slow, self._context = (part.tolist() for part in (parts[2], *parts[5:]))
        share, roll, pitch, room = self._context
        pair, lever = float(is_pair(np.float64(share))), math.hypot(roll, pitch)
        # Where the filters' axes are in the mount frame, and the context as seen from these.
        frame = self._frame_of(np.array(self._context))
        self._frame = (1.0, 0.0) if frame is None else (float(frame.cos), float(frame.sin))
        self._inside = tuple(self._context) if frame is None else (share, 0.0, lever, room)
        self._network.tell(*self._frame)
        self._told = self._added_lift * pair * lever
        factors = [1.0] * 4 if self._of_size is None else self._of_size(np.array(share)).tolist()
        self._small = factors[2], factors[2], factors[3]
        self._wider, self._held = 1.0 + (self._pair_roll_room - 1.0) * pair, self._held_room * (1.0 - pair)
        filters.tell(pair, factors[:2])

    def answer(self, observation: Array) -> tuple[list[float], list[float]] | None:
        """(action in [-1, 1] (3), command (3)) for `observation` (18,), which is remembered.

        None, and nothing is remembered, if numbers that are made of it are not finite or huge: Python's floats do not
        treat those as arrays do.
        """
        seen, rising = observation.tolist(), self._rising
        (cos, sin), (share, roll_per_lift, pitch_per_lift, room) = self._frame, self._inside
        roll, pitch, roll_rate, pitch_rate, x, y, z, vx, vy, vz = _turned(seen, cos, sin)
        # What is known.
        (
            (roll_mean, roll_rate_mean, *roll_load, roll_soft, roll_damping, r_error, r_velocity, r_angle, r_rate),
            (pitch_mean, pitch_rate_mean, *pitch_load, pitch_soft, pitch_damping, p_error, p_velocity, p_angle, p_rate),
        ) = self._filters.update(((roll, roll_rate), (pitch, pitch_rate)))
        left = -vz - rising[0]
        by_height, by_lift, by_error = self._height_gain
        height, lift, lift_error = rising[0] + by_height * left, rising[1] + by_lift * left, rising[2] + by_error * left
        roll_turn, pitch_turn = roll_per_lift * roll_soft, pitch_per_lift * pitch_soft
        roll_room, pitch_room = room * roll_soft, room * pitch_soft
        across = sin * sin * (pitch_soft - roll_soft)
        roll_mixed, pitch_mixed = roll_soft + across, pitch_soft - across
        features = [roll - roll_mean, pitch - pitch_mean, roll_rate - roll_rate_mean, pitch_rate - pitch_rate_mean]
        features += [-vz - height, *roll_load, *pitch_load, lift, lift_error]
        features += [-0.5 * math.log(roll_mixed), -0.5 * math.log(pitch_mixed)]
        features += [roll_turn, pitch_turn, room * roll_mixed, room * pitch_mixed, share]
        if not sum(map(abs, features)) < LARGEST:
            return None
        grown = self._swings.update((roll_load[0], pitch_load[0]), self._filters.ahead) if self._swings else ()
        roll_grown, pitch_grown = grown or (0.0, 0.0)
        action = self._network.act([*features, *grown], observation)
        # What the leader does.
        tilt_limit, vertical_limit = self._clip
        led_roll, led_pitch, led_vertical = led_command(self._leader, self._clip, x, y, z, vx, vy, vz)
        # What the law alone would command.
        error_limit, rise_limit, load_limit = self._limits
        rise = clipped(self._rise[0] * z + self._rise[1] * vz, rise_limit) - lift_error
        vertical = clipped(share * rise - (share - 1.0) * led_vertical, vertical_limit)
        lifted = vertical - led_vertical
        roll_far, pitch_far = -r_error * y - r_velocity * vy, p_error * x + p_velocity * vx
        far = _within(roll_far, pitch_far, error_limit)
        roll_held = roll_load[0] + roll_grown + roll_turn * lifted
        pitch_held = pitch_load[0] + pitch_grown + pitch_turn * lifted
        held = _within(roll_held, pitch_held, load_limit)
        roll_wanted = far * roll_far - r_angle * roll - r_rate * roll_rate - held * roll_held
        pitch_wanted = far * pitch_far - p_angle * pitch - p_rate * pitch_rate - held * pitch_held
        length = math.sqrt((held * roll_held) ** 2 + (held * pitch_held) ** 2 + 1e-12)
        least = max(self._held * share * length, LEAST_ROOM)
        roll_rest, roll_most = roll + roll_damping * roll_rate, max(roll_room, least) * self._wider
        pitch_rest, pitch_most = pitch + pitch_damping * pitch_rate, max(pitch_room, least)
        roll_own = share * roll_wanted - (share - 1.0) * led_roll - roll_rest
        pitch_own = share * pitch_wanted - (share - 1.0) * led_pitch - pitch_rest
        reached = _within(roll_own / roll_most, pitch_own / pitch_most, 1.0)
        roll_own, pitch_own = roll_rest + reached * roll_own, pitch_rest + reached * pitch_own
        tilt_reach, vertical_reach = self._reach
        counted = [a * (k + (1.0 - k) * abs(a)) for a, k in zip(action, self._small, strict=True)]
        command = [
            clipped(cos * roll_own - sin * pitch_own + tilt_reach * counted[0], tilt_limit),
            clipped(sin * roll_own + cos * pitch_own + tilt_reach * counted[1], tilt_limit),
            clipped(vertical + vertical_reach * counted[2], vertical_limit),
        ]
        if not math.isfinite(sum(command)):
            return None
        own, led = (roll_own, pitch_own, vertical), (led_roll, led_pitch, led_vertical)
        self._advance(own, led, command, (height, lift, lift_error))
        self._network.remember(action)
        return action, command

    def _advance(
        self, own: tuple[float, ...], led: tuple[float, ...], command: list[float], rising: tuple[float, ...]
    ) -> None:
        """Move the filters on: all drones command in the mean what the law does, `own`, and what is added quickly."""
        (cos, sin), (share, roll_per_lift, pitch_per_lift, _), keep = self._frame, self._inside, self._keep
        roll_own, pitch_own, vertical = own
        others, lifted = share - 1.0, vertical - led[2]
        roll_added = cos * command[0] + sin * command[1] - roll_own
        pitch_added = cos * command[1] - sin * command[0] - pitch_own
        roll_slow, pitch_slow = self._slow
        roll_slow = keep * roll_slow + (1.0 - keep) * roll_added
        pitch_slow = keep * pitch_slow + (1.0 - keep) * pitch_added
        roll_drive = (roll_own + roll_added - roll_slow + others * led[0]) / share
        pitch_drive = (pitch_own + pitch_added - pitch_slow + others * led[1]) / share
        (height, lift, lift_error), up = rising, (vertical + others * led[2]) / share
        turned = self._told * (command[2] - vertical)
        self._filters.advance(
            ((roll_drive, roll_per_lift * lifted), (pitch_drive, pitch_per_lift * lifted), (0.0, turned))
        )
        if self._swings:
            self._swings.advance()
        self._slow = [roll_slow, pitch_slow]
        self._rising = [a * height + b * lift + c * lift_error + d * up for a, b, c, d in self._height]


class _Filters:
    """Those of all models about roll and about pitch, and what the network's lift has turned about pitch."""

    def __init__(self, lqg: MultiModelLqg):
        models, stiffness = lqg.models, lqg.stiffness
        states = ANGLE_STATES * models
        gain, certainty, prior = (
            every if of_pair is None else of_pair
            for every, of_pair in (
                (lqg.axis_gain, lqg.pair_roll_gain),
                (lqg.certainty, lqg.pair_roll_certainty),
                (lqg.prior, lqg.pair_roll_prior),
            )
        )
        self._matrix = _known_of(lqg, lqg.axis_gain, lqg.certainty)
        more = _known_of(lqg, gain, certainty) - self._matrix
        self._of_pair: Array = more if more.any() else None  # what a pair's matrix about roll has more
        self._roll_matrix: Array = None  # another than `_matrix` for that axis
        self._state, self._seen = np.zeros((AXES, states + 2)), np.zeros((AXES, self._matrix.shape[1]))
        self._roll, self._roll_seen = self._state[0], self._seen[0]
        self.predicted, self._measured = self._state[:, :-2], self._state[:2, -2:]
        self._onward, tilts, self._left, self._certain = np.split(
            self._seen, np.cumsum([states, states, 2 * models]), axis=1
        )
        self._tilts = tilts[:2].reshape(2, models, ANGLE_STATES)
        self._pitch, self._turned = self._seen[1:, 2 * states :]
        # Scores, both parts of the distance, 1, share of a pair's prior -> scores.
        unit = np.eye(models)
        self._scoring = np.vstack([lqg.keep[0] * unit, unit, unit, lqg.prior, prior - lqg.prior])
        self._scored, self._next_scores = np.ones((2, 3 * models + 2)), np.zeros((2, models))
        self._scored[:, -1] = 0.0
        self.scores, self._distance = self._scored[:, :models], self._scored[:, models:-2]
        # What is averaged: tilts, 1 / stiffness, damping, gains on error, velocity, angle, rate, and 1; and of swings.
        ahead = np.zeros((models, 0, 2)) if lqg.swing_ahead is None else lqg.swing_ahead * [1.0, -1.0]
        known = np.column_stack([1.0 / stiffness, lqg.damping, lqg.tilt, np.ones(models), *ahead.T.swapaxes(1, 2)])
        self._means, self.ahead = ANGLE_STATES + 7, np.zeros((2, 1 + 2 * lqg.swings))
        self._known = np.concatenate([np.zeros((2, models, ANGLE_STATES)), np.stack([known] * 2)], axis=-1)
        self._firmness, self._gains = lqg.tilt[:, :2], self._known[..., ANGLE_STATES + 2 : ANGLE_STATES + 4]
        self._odds, self._found = np.zeros((2, 1, models)), self._known[..., :ANGLE_STATES]
        self._drives, self._driven = np.zeros((AXES, 2)), np.zeros((AXES, states))
        self._drive = np.stack([lqg.axis[..., -1], lqg.axis[..., -1] / stiffness[:, None]]).reshape(2, -1)

    def tell(self, pair: float, factors: list[float]) -> None:
        """Filter about roll as a pair does where `pair` is 1, as every team where it is 0.

        `factors` on the feedback of the error and of the velocity.
        """
        self._gains[:] = self._firmness * factors
        own = self._of_pair is not None and pair > 0
        self._roll_matrix = self._matrix + pair * self._of_pair if own else None
        self._scored[0, -1] = pair

    def update(self, measured: tuple[tuple[float, float], tuple[float, float]]) -> list[list[float]]:
        """Means (2, 11) over the models after (angle, rate) of both axes were `measured`."""
        self._measured[:] = measured
        np.dot(self._state, self._matrix, out=self._seen)
        if self._roll_matrix is not None:
            np.dot(self._roll, self._roll_matrix, out=self._roll_seen)
        np.add(self._pitch, self._turned, out=self._pitch)
        np.multiply(self._left[:2], self._certain[:2], out=self._distance)
        scores = np.dot(self._scored, self._scoring, out=self._next_scores)
        np.subtract(scores, np.maximum.reduce(scores, axis=1, keepdims=True), out=scores)
        np.exp(scores, out=self._odds[:, 0])
        self._found[:] = self._tilts
        sums = np.matmul(self._odds, self._known)[:, 0]
        self.ahead = sums[:, self._means - 1 :]
        return np.divide(sums[:, : self._means - 1], self.ahead[:, :1]).tolist()

    def advance(self, drives: tuple[tuple[float, float], ...]) -> None:
        """Predict the next states with `drives`: the mean command, and the angular acceleration of lifting apart.

        The third: of what the network lifts more.
        """
        self._drives[:] = drives
        np.dot(self._drives, self._drive, out=self._driven)
        np.add(self._onward, self._driven, out=self.predicted)
        self.scores[:] = self._next_scores


def _known_of(lqg: MultiModelLqg, gain: Array, certainty: Array) -> Array:
    """Matrix of the filters of all models about one axis with `gain` (M, 5, 2) and `certainty` (M, 3).

    Predicted states, angle and rate -> states a step on, found states as tilts, innovations, and what these are
    multiplied by for the scores.
    """
    models, states = lqg.models, ANGLE_STATES * lqg.models
    unit = np.eye(states + 2)
    predicted, measured = unit[:states].reshape(models, ANGLE_STATES, -1), unit[states:]
    left = measured - predicted[:, :2]
    found = predicted + gain @ left
    onward = lqg.axis[..., :ANGLE_STATES] @ found
    tilts = np.concatenate([found[:, :2], found[:, 2:] / lqg.stiffness[:, None, None]], axis=1)
    first, second, (c00, c01, c11) = left[:, 0], left[:, 1], certainty.T[..., None]
    rows = [onward, tilts, first, second, -0.5 * c00 * first - c01 * second, -0.5 * c11 * second]
    return np.concatenate([row.reshape(-1, states + 2) for row in rows]).T.copy()


class _Swings:
    """The swings of the load about roll and, behind them, about pitch: see `control.swing`."""

    def __init__(self, lqg: MultiModelLqg):
        swing, count = np.asarray(lqg.swing), lqg.swings
        self._count, self._keep = count, np.array(float(lqg.swing_keep))
        unit = np.eye(3 * count + 1)
        before, load = np.split(unit[:-1], 3), unit[-1]
        left = load - before[0] - before[1]
        states = [state + gain[:, None] * left for state, gain in zip(before, swing.T[2:], strict=True)]
        (constant, phase, across), cos, sin = states, swing[:, :1], swing[:, 1:2]
        onward = np.concatenate([constant, cos * phase - sin * across, sin * phase + cos * across])
        left = math.sqrt(1.0 - float(self._keep)) * np.concatenate([left, left])
        # Predicted states, then the load, of both axes -> states a step on, root of what the energy gets, swing; the
        # last two of in phase and of in quadrature.
        rows = [_of_both(part) for part in (onward, left, np.concatenate([phase, across]))]
        ends = np.cumsum([6 * count, 4 * count])
        self._matrix = np.concatenate(rows).T.copy()
        self._given, self._seen = np.zeros(6 * count + 2), np.zeros(len(self._matrix.T))
        self._states, self._load = self._given[:-2], self._given[-2:]
        self._onward, self._left, self._swing = np.split(self._seen, ends)
        self._energy, self._next_energy, self._raised = (np.zeros(4 * count) for _ in range(3))
        # Swings grown, times the odds, and the odds -> their sums about roll, about pitch.
        self._weighed = np.zeros(8 * count)
        self._grown, self._odds = np.split(self._weighed, 2)
        self._sums = np.kron(np.eye(4), np.ones((2 * count, 1)))

    @property
    def memory(self) -> Array:
        """(2 J 4,), see `swings_advanced`."""
        states, energy = self._states.reshape(2, -1), self._energy.reshape(2, 2, -1)[:, 0]
        return np.concatenate([states, energy], axis=1).ravel()

    @memory.setter
    def memory(self, memory: Array) -> None:
        parts = memory.reshape(2, STATES, self._count)
        self._states[:], self._energy[:] = parts[:, :3].ravel(), parts[:, [3, 3]].ravel()

    def update(self, load: tuple[float, float], ahead: Array) -> tuple[float, float]:
        """What the `load` will have grown by.

        `ahead` (2, 1 + 2 J): sum of the models' odds, and sums of `swing_ahead` times odds, in quadrature negative.
        """
        self._load[:] = load
        np.dot(self._given, self._matrix, out=self._seen)
        np.multiply(self._left, self._left, out=self._left)
        np.multiply(self._energy, self._keep, out=self._next_energy)
        np.add(self._next_energy, self._left, out=self._next_energy)
        np.add(self._next_energy, LEAST_ENERGY, out=self._raised)
        np.power(self._raised, -(2.0**SHARPNESS), out=self._odds)
        np.multiply(self._swing, ahead[:, 1:].ravel(), out=self._grown)
        np.multiply(self._grown, self._odds, out=self._grown)
        roll, pitch, roll_odds, pitch_odds = np.dot(self._weighed, self._sums).tolist()
        roll_sum, pitch_sum = ahead[:, 0].tolist()
        return 2.0 * roll / (roll_odds * roll_sum), 2.0 * pitch / (pitch_odds * pitch_sum)

    def advance(self) -> None:
        """Predict the next states."""
        self._states[:], self._energy[:] = self._onward, self._next_energy


def _of_both(rows: Array) -> Array:
    """`rows` (R, S + 1) of one axis for both: (2 R, 2 S + 2), the last columns, of the load, at the end."""
    every = np.kron(np.eye(2), rows[:, :-1])
    return np.concatenate([every, np.kron(np.eye(2), rows[:, -1:])], axis=1)


def _turned(seen: list[float], cos: float, sin: float) -> tuple[float, ...]:
    """Roll, pitch, their rates, error and error rate of an observation as `seen` from axes turned about z."""
    _, _, _, roll, pitch, _, _, _, _, p, q, _, x, y, z, vx, vy, vz = seen
    return (
        *(cos * roll + sin * pitch, cos * pitch - sin * roll, cos * p + sin * q, cos * q - sin * p),
        *(cos * x + sin * y, cos * y - sin * x, z, cos * vx + sin * vy, cos * vy - sin * vx, vz),
    )


def _within(x: float, y: float, limit: float) -> float:
    """What (x, y) is multiplied by in `team_lqg.within`."""
    return limit / max(math.sqrt(x * x + y * y + 1e-12), limit)
