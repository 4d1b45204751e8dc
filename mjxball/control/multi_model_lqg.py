"""Offset-free LQG of one follower of a team whose attitude loops nobody knows: multiple-model adaptive estimation.

One Kalman filter for each of M pairs of loop frequency and rotor lag runs about roll and about pitch; their weights are
those of Magill (1965), by how well each predicts what is measured, forgotten over some seconds. Feedback gains and
estimates are weighted means. To the filters what the network lifts is part of the load; of a pair the weights know
better: a third set of states holds what that lift has turned about pitch. About roll a pair's inertia is small, so that
it has filters of its own there, for larger loads, and more room. A rig's loops about roll and pitch differ; seen from a
follower that stands askew to them each of its axes would turn as both do, so that all of this is about the rig's axes,
of which the first points to the leader. What of the load swings is held against ahead of time, see `control.swing`.
Everything else is as in `control.team_lqg`.
What a follower must be told is its team's geometry: `ring_context`. Needs NumPy alone; `baselines.multi_model_lqg`
makes the numbers, which stand in the policy file.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

from mjxball.config import Plant
from mjxball.control import rotations
from mjxball.control.observation import ERROR, ERROR_RATE, copy_command, mount_frames
from mjxball.control.swing import STATES, Swinging, swings_advanced, swings_grown, swings_seen
from mjxball.control.team_lqg import measured, within
from mjxball.plant.parts import clipped, joined

Array = Any
AXES, ANGLE_STATES, HEIGHT_STATES, CONTEXT, FEATURES = 3, 5, 3, 4, 20
# Medians of random rigs (`sim.rigs`), with tilt torques of a ring of N drones N a m r^2, a = 1 for a pair and 1/2 else:
# what lifting 1 m/s2 more than the leader turns, times N a r [1]; what rotors hold as a tilt of the loops [m/s2].
LEVER, ROOM = 1.25, 1.75
LEAST_ROOM = 0.15  # [rad] that the rotors of a rig can follow at least
NO_LEVER = 1e-30  # [1/m]: who is told of no lever has the axes of its mount frame
ADDED_TIME = 1.0  # [s] over which the slow part of what the network adds is found


class MultiModelLqg(NamedTuple):
    """Numbers of the law (ours); M models, states and commands as of `TeamLqg`."""

    axis: Array  # (M, 5, 6): A B of each model
    axis_gain: Array  # (M, 5, 2): K
    certainty: Array  # (M, 3) inverse covariance of the innovation (angle, rate): its elements 00, 01, 11
    prior: Array  # (M,) log of the root of its determinant, less the largest
    tilt: Array  # (M, 4) feedback on (error, velocity, angle, rate) of pitch; that of roll mirrors it
    stiffness: Array  # (M,) natural frequency of the closed attitude loops, squared [1/s2]
    damping: Array  # (M,) Kd over Kp of the attitude loops [s]
    height: Array  # (A B) (3, 4)
    height_gain: Array  # K (3,)
    rise: Array  # (2,) feedback on the vertical (error, velocity)
    limits: Array  # (3,) of the error's part in a tilt [rad], of that in the height [m/s2], against the load [rad]
    keep: Array  # (2,) share that a step leaves of the models' scores, and of the slow part of what was added
    added_lift: Array | float = 0.0  # () share of the lift that the network adds whose torque a pair's scores are told
    # The same about roll of a pair; None: as of every team.
    pair_roll_gain: Array | None = None  # (M, 5, 2)
    pair_roll_certainty: Array | None = None  # (M, 3)
    pair_roll_prior: Array | None = None  # (M,)
    pair_roll_room: Array | float = 1.0  # () factor on what rotors hold as a tilt
    rig_axes: Array | float = 0.0  # () 1: states are about the rig's axes; 0: about those of the mount frame
    # Of J swings, see `control.swing`; None: loads are held as estimated.
    swing: Array | None = None  # (J, 5)
    swing_ahead: Array | None = None  # (M, J, 2)
    swing_keep: Array | float = 0.0  # () share that a step leaves of the energies
    held_room: Array | float = 0.0  # () what rotors of more than two hold as a tilt, at least, over what is held now
    # Of two, three, ... drones, and of more the last: factors on the feedback of error and of velocity, and by how much
    # small actions of the network count, tilts and lift, of which one of 1 counts in full; None: 1.
    by_size: Array | None = None  # (S, 4)

    @property
    def models(self) -> int:
        """M."""
        return len(self.stiffness)

    @property
    def swings(self) -> int:
        """J."""
        return 0 if self.swing is None else len(self.swing)

    @property
    def size(self) -> int:
        """Numbers in the memory: filters as predicted, height, scores, swings, slow part of added tilts, context."""
        swinging = 2 * self.swings * STATES
        return self.models * (AXES * ANGLE_STATES + 2) + HEIGHT_STATES + swinging + 2 + CONTEXT

    @property
    def shown(self) -> int:
        """How many numbers `features` has."""
        return FEATURES + (2 if self.swings else 0)

    def start(self, observation: Array, context: Array) -> Array:
        """Memory (..., m) before the first `observation` (..., 18) of followers with `context` (..., 4)."""
        xp = observation.__array_namespace__()
        known = xp.broadcast_to(xp.asarray(context, dtype=observation.dtype), (*observation.shape[:-1], CONTEXT))
        roll, pitch, roll_rate, pitch_rate, climb = measured(_turned(observation, self.frame(known)))
        zero = xp.zeros_like(roll)
        turning = [
            joined([angle, rate, zero, zero, zero])
            for angle, rate in ((roll, roll_rate), (pitch, pitch_rate), (zero, zero))
            for _ in range(self.models)
        ]
        zeros = HEIGHT_STATES - 1 + 2 * (self.models + self.swings * STATES) + 2
        rest = joined([climb, *[zero] * zeros])
        return xp.concat([*turning, rest, known], axis=-1)

    def known(self, memory: Array, observation: Array, leader: tuple[Any, ...] | None) -> Known:
        """What a follower with that `memory` (..., m) makes of `observation` (..., 18): common to what follows.

        `leader`: the arguments of `copy_command` after the observation; None: without the law's own command.
        """
        context, frame = self._told(memory)
        observation = _turned(observation, frame)
        seen = self._estimate(memory, context, observation)
        load, grown, swings = self._swinging(memory, seen)
        own = None if leader is None else self._plan(context, observation, seen, load + grown, leader)
        return Known(context, frame, observation, seen, grown, swings, own)

    def features(self, memory: Array, observation: Array, known: Known | None = None) -> Array:
        """(..., 20), of a law with swings (..., 22), for a network, in the mount frame.

        The measured less its estimate (5), of both axes the load, its rate and the rotors' part as tilts [rad] (6), the
        other estimates of the height (2), log frequencies (2), what lifting turns and what rotors hold as tilts (4),
        N / (N - 1), what the load will have grown by as a tilt (2).
        """
        context, frame, observation, seen, grown, _, _ = known or self.known(memory, observation, None)
        xp = observation.__array_namespace__()
        turning, soft = seen.turning[..., :2, :, :], self._each(seen.weights, 1.0 / self.stiffness)
        middle = (seen.weights[..., None] * turning[..., :2]).sum(axis=-2)
        inverse = (seen.weights / self._like(self.stiffness, observation))[..., None]
        loads = (inverse * turning[..., 2:]).sum(axis=-2)
        expected = [middle[..., 0, 0], middle[..., 1, 0], middle[..., 0, 1], middle[..., 1, 1], seen.rising[..., 0]]
        left = [a - b for a, b in zip(measured(observation), expected, strict=True)]
        states = range(ANGLE_STATES - 2)
        pairs: list[Sequence[Array]] = [left[:2], left[2:4], *([loads[..., 0, k], loads[..., 1, k]] for k in states)]
        levers = context[..., 1:3] * soft
        pairs += [[levers[..., 0], levers[..., 1]]]
        angles, rates, *every, lever = (_turned_back(pair, frame) for pair in pairs)
        soft = _mixed(soft, frame)
        speed = -0.5 * xp.log(soft)
        parts = [joined([*angles, *rates, left[4]]), *(joined([load[axis] for load in every]) for axis in (0, 1))]
        parts += [seen.rising[..., 1:], speed, joined(lever), context[..., 3:] * soft, context[..., :1]]
        if self.swings:
            parts += [joined(_turned_back([grown[..., 0], grown[..., 1]], frame))]
        return xp.concat(parts, axis=-1)

    def command(
        self, added: Array, memory: Array, observation: Array, leader: tuple[Any, ...], known: Known | None = None
    ) -> Array:
        """The law's command (..., 3), not yet clipped, with `added` (..., 3) to it; `leader` as for `known`."""
        _, frame, _, _, _, _, own = known or self.known(memory, observation, leader)
        if frame is None:
            return own + added
        return joined([*_turned_back([own[..., 0], own[..., 1]], frame), own[..., 2]]) + added

    def next(
        self, memory: Array, observation: Array, command: Array, leader: tuple[Any, ...], known: Known | None = None
    ) -> Array:
        """Memory of the next step, after `observation` was answered by `command`.

        The drones are taken to be commanded what the law itself says and the fast part of what the network adds: of
        its slow part each follower would expect another mean, and the difference would drift unseen. What its network
        lifts more turns a pair about pitch; of more drones others lift too, which a follower does not know.
        """
        context, frame, observation, seen, _, swings, own = known or self.known(memory, observation, leader)
        xp, command = observation.__array_namespace__(), _turned(command, frame)
        led = copy_command(observation, *leader)
        slow, share = memory[..., -CONTEXT - 2 : -CONTEXT], context[..., :1]
        added = command[..., :2] - own[..., :2]
        slow = self.keep[1] * slow + (1.0 - self.keep[1]) * added
        tilts = own[..., :2] + added - slow
        mean = (xp.concat([tilts, own[..., 2:]], axis=-1) + (share - 1.0) * led) / share
        lifted = context[..., 1:3] * (own - led)[..., 2:]
        roll, pitch = context[..., 1:2], context[..., 2:3]
        lever = xp.sqrt(roll * roll + pitch * pitch)  # the follower's own, as long as that of the leader
        turned = float(self.added_lift) * is_pair(share) * lever * (command - own)[..., 2:]
        turns = xp.concat([lifted, turned], axis=-1)[..., None] / self._like(self.stiffness, observation)
        drive = xp.concat([mean[..., :2], 0.0 * turned], axis=-1)[..., None] + turns
        axis, height = self._like(self.axis, observation), self._like(self.height, observation)
        turning = axis[..., 0] * seen.turning[..., :1]
        for state in range(1, ANGLE_STATES):
            turning = turning + axis[..., state] * seen.turning[..., state : state + 1]
        turning = turning + axis[..., ANGLE_STATES] * drive[..., None]
        climbing = xp.concat([seen.rising, mean[..., 2:]], axis=-1) @ height.T
        parts = [_flat(turning, 3), climbing, _flat(seen.scores, 2)]
        parts += [] if swings is None else [swings_advanced(self.swing, swings)]
        return xp.concat([*parts, slow, memory[..., -CONTEXT:]], axis=-1)

    def _like(self, numbers: Array, observation: Array) -> Array:
        return observation.__array_namespace__().asarray(numbers, dtype=observation.dtype)

    def of_size(self, share: Array) -> Array:
        """Row (..., 4) of `by_size` for a team with N / (N - 1) = `share` (...), between two rows a mean of both."""
        xp, count = share.__array_namespace__(), len(self.by_size)  # type: ignore[arg-type]
        factors, rows = self._like(self.by_size, share), self._like(list(range(count)), share)
        above = clipped(share / (share - 1.0) - 2.0, 0.0, count - 1.0)[..., None] - rows
        return clipped(1.0 - xp.maximum(above, -above), 0.0, 1.0) @ factors

    def counted(self, scaled: Array, memory: Array) -> Array:
        """What of a network's action `scaled` in [-1, 1] (..., 3) counts in a team of the size that `memory` has.

        a (k + (1 - k) |a|) with k of `by_size`: the smaller a team, the less small actions should do, but those that
        hold what the law cannot must do all they can.
        """
        if self.by_size is None:
            return scaled
        factors = self.of_size(memory[..., -CONTEXT])
        small = joined([factors[..., 2], factors[..., 2], factors[..., 3]])
        return scaled * (small + (1.0 - small) * scaled.__array_namespace__().maximum(scaled, -scaled))

    def frame(self, context: Array) -> Frame | None:
        """Where the filters' axes are for a follower with `context` (..., 4); None: as those of its mount frame."""
        if not float(self.rig_axes):
            return None
        roll, pitch = context[..., 1], context[..., 2]
        lever = context.__array_namespace__().sqrt(roll * roll + pitch * pitch)
        return Frame((pitch + NO_LEVER) / (lever + NO_LEVER), -roll / (lever + NO_LEVER))

    def _told(self, memory: Array) -> tuple[Array, Frame | None]:
        """(context as seen from the filters' axes, where these are)."""
        context = memory[..., -CONTEXT:]
        frame = self.frame(context)
        if frame is None:
            return context, None
        lever = context[..., 2] * frame.cos - context[..., 1] * frame.sin
        zero = memory.__array_namespace__().zeros_like(lever)
        return joined([context[..., 0], zero, lever, context[..., 3]]), frame

    def _about_axes(self, numbers: Array, of_pair: Array | None, pair: Array, axes: int = 2) -> Array:
        """`numbers` (M, ...) of each model about roll and `axes` - 1 others (..., axes or 1, M, ...).

        `of_pair`: those about roll where `pair` (...) is 1.
        """
        every = self._like(numbers, pair)
        if of_pair is None:
            return every[None]
        roll = pair.__array_namespace__().asarray([1.0, 0.0, 0.0][:axes], dtype=pair.dtype)
        share = (pair[..., None] * roll)[(..., *(None,) * every.ndim)]
        return every + share * (self._like(of_pair, pair) - every)

    def _each(self, weights: Array, numbers: Array) -> Array:
        """Weighted mean (..., 2) of a number (M,) of each model."""
        return (weights * self._like(numbers, weights)).sum(axis=-1)

    def _estimate(self, memory: Array, context: Array, observation: Array) -> Estimate:
        """What is known at `observation`."""
        xp, models = observation.__array_namespace__(), self.models
        pair = is_pair(context[..., 0])
        ends = AXES * models * ANGLE_STATES
        predicted = xp.reshape(memory[..., :ends], (*memory.shape[:-1], AXES, models, ANGLE_STATES))
        rising, found = memory[..., ends : ends + HEIGHT_STATES], measured(observation)
        zero = xp.zeros_like(found[0])
        angle, rate = (joined([found[k], found[k + 1], zero])[..., None] for k in (0, 2))
        angle, rate = angle - predicted[..., 0], rate - predicted[..., 1]  # (..., 3, M)
        gain = self._about_axes(self.axis_gain, self.pair_roll_gain, pair, AXES)
        certainty = self._about_axes(self.certainty, self.pair_roll_certainty, pair)
        prior = self._about_axes(self.prior, self.pair_roll_prior, pair)
        turning = predicted + (gain[..., 0] * angle[..., None] + gain[..., 1] * rate[..., None])
        first, second = (
            joined([left[..., 0, :], left[..., 1, :] + left[..., 2, :]], axis=-2) for left in (angle, rate)
        )
        own, mixed, other = certainty[..., 0], certainty[..., 1], certainty[..., 2]
        distance = own * first * first + 2.0 * mixed * first * second + other * second * second
        begin = ends + HEIGHT_STATES
        scores = xp.reshape(memory[..., begin : begin + 2 * models], (*memory.shape[:-1], 2, models))
        scores = self.keep[0] * scores + prior - 0.5 * distance
        scores = scores - xp.max(scores, axis=-1, keepdims=True)
        odds = xp.exp(scores)
        weights = odds / odds.sum(axis=-1, keepdims=True)
        climbed = (found[4] - rising[..., 0])[..., None] * self._like(self.height_gain, observation)
        return Estimate(turning, scores, weights, rising + climbed)

    def _swinging(self, memory: Array, seen: Estimate) -> tuple[Array, Array, Swinging | None]:
        """(load as a tilt (..., 2), what it will have grown by when the rotors act (..., 2), its swings)."""
        load = (seen.weights * seen.turning[..., :2, :, 2] / self._like(self.stiffness, memory)).sum(axis=-1)
        if self.swing is None:
            return load, 0.0 * load, None
        end = CONTEXT + 2
        before = memory[..., -end - 2 * self.swings * STATES : -end]
        found = swings_seen(self.swing, self.swing_keep, before, load)
        return load, swings_grown(self.swing_ahead, found, seen.weights), found

    def _plan(self, context: Array, observation: Array, seen: Estimate, load: Array, leader: tuple[Any, ...]) -> Array:
        """The law's own command (..., 3), only its vertical part clipped, against `load` (..., 2) [rad]."""
        xp, weights, share = observation.__array_namespace__(), seen.weights, context[..., 0]
        led, error, rate = copy_command(observation, *leader), observation[..., ERROR], observation[..., ERROR_RATE]
        tilt_limit, rise_limit, load_limit = (float(limit) for limit in self.limits)
        k_error, k_velocity = (float(gain) for gain in self.rise)
        rise = clipped(k_error * error[..., 2] + k_velocity * rate[..., 2], -rise_limit, rise_limit)
        rise = rise - seen.rising[..., 2]
        vertical = clipped(share * rise - (share - 1.0) * led[..., 2], -leader[-1], leader[-1])
        gains = weights @ self._like(self.tilt, observation)
        if self.by_size is not None:
            factors = self.of_size(share)
            gains = xp.concat([gains[..., :2] * factors[..., None, :2], gains[..., 2:]], axis=-1)
        soft, damping = self._each(weights, 1.0 / self.stiffness), self._each(weights, self.damping)
        far = gains[..., 0] * _crossed(xp, error) + gains[..., 1] * _crossed(xp, rate)
        angles, rates = observation[..., 3:5], observation[..., 9:11]
        wanted = within(xp, far, tilt_limit) - gains[..., 2] * angles - gains[..., 3] * rates
        load = load + context[..., 1:3] * soft * (vertical - led[..., 2])[..., None]
        load = within(xp, load, load_limit)
        wanted = wanted - load
        own = share[..., None] * wanted - (share - 1.0)[..., None] * led[..., :2]
        rest, most = angles + damping * rates, xp.maximum(context[..., 3:] * soft, LEAST_ROOM)
        if float(self.held_room):
            held = xp.sqrt((load * load).sum(axis=-1) + 1e-12)
            most = xp.maximum(most, (float(self.held_room) * (1.0 - is_pair(share)) * share * held)[..., None])
        wider = 1.0 + (float(self.pair_roll_room) - 1.0) * is_pair(share)
        most = most * joined([wider, xp.ones_like(wider)])
        own = rest + most * within(xp, (own - rest) / most, 1.0)
        return xp.concat([own, vertical[..., None]], axis=-1)


class Frame(NamedTuple):
    """Direction of a rig's leader in the mount frame of a follower."""

    cos: Array  # (...)
    sin: Array


class Estimate(NamedTuple):
    """What filters know at an observation."""

    turning: Array  # (..., 3, M, 5) about roll and pitch, and what the network's lift has turned about pitch
    scores: Array  # (..., 2, M) log odds of the models
    weights: Array  # (..., 2, M) that sum to 1
    rising: Array  # (..., 3) of the height


class Known(NamedTuple):
    """What a follower makes of an observation, all about the filters' axes."""

    context: Array  # (..., 4)
    frame: Frame | None  # where the axes are
    observation: Array  # (..., 18)
    seen: Estimate
    grown: Array  # (..., 2) by when the rotors act, of the load as a tilt [rad]
    swings: Swinging | None
    own: Any  # (..., 3) the law's own command, only its vertical part clipped


def team_geometry(plant: Plant, mounts: Array, count: Array) -> Array:
    """`ring_context` of every follower of `count` () drones like those of `plant` at `mounts` (N, 3) [m].

    (F, 4), or (4,) of one follower; drones from `count` on only pad.
    """
    xp = mounts.__array_namespace__()
    angles, lead = mount_frames(plant, mounts), mounts[plant.leader]
    place = xp.broadcast_to(lead, (*angles.shape, 3))
    seen = rotations.turned_about_z(place, -angles)
    return ring_context(xp.astype(xp.broadcast_to(count, angles.shape), mounts.dtype), seen[..., :2])


def ring_context(count: Array, leader: Array) -> Array:
    """What a follower knows of a team of `count` (...) drones whose leader stands at `leader` (..., 2) [m] (..., 4).

    In its mount frame, from O. N / (N - 1); angular accelerations about roll and pitch that lifting 1 m/s2 more than
    the leader gives [1/m]; torque of the rotors over the inertia [1/s2], the last two as of a middling rig on a ring.
    """
    xp = leader.__array_namespace__()
    x, y = leader[..., 0], leader[..., 1]
    spread = xp.where(count < 2.5, 1.0, 0.5)
    lever = LEVER / ((x * x + y * y) * count * spread)
    room = ROOM * 2.0 * xp.sin(math.pi / count) / (spread * xp.sqrt(x * x + y * y))
    return joined([count / (count - 1.0), -y * lever, x * lever, room])


def _flat(array: Array, axes: int) -> Array:
    """`array` with its last `axes` axes as one."""
    return array.__array_namespace__().reshape(array, (*array.shape[:-axes], -1))


def is_pair(share: Array) -> Array:
    """1 for a pair's N / (N - 1) = 2, 0 for that of more drones."""
    return clipped(2.0 * share - 3.0, 0.0, 1.0)


def _turned(vectors: Array, frame: Frame | None) -> Array:
    """Every three numbers of `vectors` (..., 3 k) in a mount frame as a vector in `frame`."""
    if frame is None:
        return vectors
    parts: list[Array] = []
    for k in range(0, vectors.shape[-1], 3):
        x, y = vectors[..., k], vectors[..., k + 1]
        parts += [frame.cos * x + frame.sin * y, frame.cos * y - frame.sin * x, vectors[..., k + 2]]
    return joined(parts)


def _turned_back(pair: Sequence[Array], frame: Frame | None) -> Sequence[Array]:
    """A vector (x, y) in `frame` in the mount frame."""
    if frame is None:
        return pair
    x, y = pair
    return frame.cos * x - frame.sin * y, frame.sin * x + frame.cos * y


def _mixed(soft: Array, frame: Frame | None) -> Array:
    """What commands turn about the axes of the mount frame by what they turn about those of `frame` (..., 2)."""
    if frame is None:
        return soft
    along, across, roll, pitch = frame.cos * frame.cos, frame.sin * frame.sin, soft[..., 0], soft[..., 1]
    return joined([along * roll + across * pitch, across * roll + along * pitch])


def _crossed(xp: Any, vector: Array) -> Array:
    """(-y, x): which roll and pitch push towards `vector` (..., 3)."""
    return joined([-vector[..., 1], vector[..., 0]])
