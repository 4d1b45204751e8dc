"""Metrics of flights that are still flown: sums and extremes, a control step at a time."""

from __future__ import annotations

import math
from typing import NamedTuple

from mjxball.arrays import Array
from mjxball.rewards import paper_reward
from mjxball.sim.trajectory import Trajectory

RMSE_UNTIL = 20.0  # [s]
PAPER_STEPS = 1000  # of an episode, over which the paper's reward is summed
STEADY_AFTER = 20.0  # [s]
WAYPOINT_SECONDS = 10.0  # [s] after the last waypoint became the goal, before which nothing is steady
SETTLED = 0.02  # of the error at the start of the last leg
SATURATED_WITHIN = 1e-6  # of the largest rotor force
# Likewise: a lagging rotor comes this near within 0.14 s, and to the exact limit only if it is asked for much longer.
AT_LIMIT_WITHIN = 0.01
TINY = 1e-9  # [s] of a time in float64


class RunningMetrics(NamedTuple):
    """Sums and extremes of n flights so far, NumPy or JAX arrays (n,) unless said otherwise."""

    steps: Array  # () or (n,)
    time: Array  # () or (n,), of the last step [s]
    early: Array  # () or (n,), steps within the first 20 s
    sums: Array  # (n, 9) over the steps of what `_taken` says
    excess: Array  # (n, 9) what rounding has added to them: it may always round the same way
    failed: Array
    initial: Array  # |e_o| at the start of the leg [m]
    leg: Array  # when the last waypoint became the goal [s]
    steady_from: Array  # [s]
    steady: Array  # steps in steady state
    outside: Array  # last time |e_o| was beyond `SETTLED`, -inf: never [s]
    peaks: Array  # (n, 4) x, y, z and the plane, NaN before the first
    furthest: Array  # (n, 3) along each axis towards the goal [m]
    tilt: Array
    hover: Array  # (n, F, 4) the followers' rotor forces at the start [N]
    hover_power: Array  # of all rotors there [N^1.5]
    tilts: Array  # (n, F, 2) their last roll and pitch commands
    target: Array  # (n, 3)
    limited: Array  # (n, N, 4) steps in which a rotor is at a limit
    radius: Array  # about the goal, NaN: none [m]
    deadline: Array  # after which `late_error` counts, NaN: none [s]
    reached: Array  # [s], inf: never
    beyond: Array  # last time |e_o| was beyond `radius`, -inf: never [s]
    late_error: Array  # [m], NaN before the first


def begin(
    position: Array,
    target: Array,
    rotor_force: Array,
    leader: int = 0,
    radius: Array | float = math.nan,
    deadline: Array | float = math.nan,
) -> RunningMetrics:
    """Before the first step, at `position` (n, 3) with `target` (n, 3) and `rotor_force` (n, N, 4).

    `radius` [m] about the goal and `deadline` [s], one number or (n,), are those of `Metrics.arrival` and `late_error`.
    A goal that changes does not begin either anew.
    """
    xp = position.__array_namespace__()
    hover = _of_followers(rotor_force, leader)
    zero, none = xp.zeros_like(position[:, 0]), xp.full_like(position, xp.nan)
    no_peaks = xp.concat([none, none[:, :1]], axis=-1)
    scalar = xp.sum(zero[:0])
    return RunningMetrics(
        *(scalar, scalar, scalar),
        *(xp.stack([zero] * 9, axis=-1),) * 2,  # sums, excess
        zero > 1,
        initial=_norm(target - position),
        leg=zero,
        steady_from=zero + STEADY_AFTER,
        steady=zero,
        outside=zero - xp.inf,
        peaks=no_peaks,
        furthest=none,
        tilt=zero,
        hover=hover,
        hover_power=power_of(rotor_force),
        tilts=xp.zeros_like(hover[..., :2]),
        target=target,
        limited=xp.zeros_like(rotor_force),
        radius=zero + radius,
        deadline=zero + deadline,
        reached=zero + xp.inf,
        beyond=zero - xp.inf,
        late_error=zero + xp.nan,
    )


def update(
    running: RunningMetrics,
    row: Trajectory,
    termination_distance: float,
    rotor_force_max: Array | float,
    leader: int = 0,
) -> RunningMetrics:
    """Take one control step of all flights into account; `leader` is the number of the drone that leads.

    `rotor_force_max` [N] is one number, or (N,) or (n, N), see `rotor_limits`.
    """
    xp = row.position.__array_namespace__()
    error = row.target - row.position
    distance = _norm(error)
    # Where the goal has changed, settling and peaks start again.
    new = xp.any(row.target != running.target, axis=-1)
    initial = xp.where(new, distance, running.initial)
    steady_from = xp.where(new, row.time + WAYPOINT_SECONDS, running.steady_from)
    steady_from = xp.where(steady_from > STEADY_AFTER, steady_from, STEADY_AFTER)
    outside = xp.where(new, -xp.inf, running.outside)
    peaks = xp.where(new[:, None], xp.nan, running.peaks)
    steady = row.time >= steady_from - TINY
    errors = xp.concat([xp.abs(error), xp.hypot(error[:, :1], error[:, 1:2])], axis=-1)
    most = xp.asarray(rotor_force_max, dtype=row.rotor_force.dtype)
    most = xp.broadcast_to(most, row.rotor_force.shape[:-1])[..., None]
    limited = near_limit(AT_LIMIT_WITHIN, row.rotor_force, most)
    sums, excess = compensated_sum(running.sums, running.excess, _taken(running, row, most, limited, leader))
    near, time = distance <= running.radius, running.leg * 0 + row.time
    return RunningMetrics(
        steps=running.steps + 1,
        time=running.time * 0 + row.time,
        early=running.early + xp.where(row.time <= RMSE_UNTIL + TINY, 1.0, 0.0),
        sums=sums,
        excess=excess,
        failed=running.failed | row.diverged | ~(distance <= termination_distance),
        initial=initial,
        leg=xp.where(new, row.time, running.leg),
        steady_from=steady_from,
        steady=xp.where(new, 0.0, running.steady) + xp.where(steady, 1.0, 0.0),
        outside=xp.where(distance <= SETTLED * initial, outside, row.time),
        peaks=xp.where(steady[:, None], xp.fmax(peaks, errors), peaks),
        furthest=xp.fmax(running.furthest, row.position * xp.sign(row.target)),
        tilt=xp.fmax(running.tilt, xp.hypot(row.euler[:, 0], row.euler[:, 1])),
        hover=running.hover,
        hover_power=running.hover_power,
        tilts=xp.reshape(row.follower_command, (*running.hover.shape[:2], 3))[..., :2],
        target=row.target,
        limited=running.limited + limited,
        radius=running.radius,
        deadline=running.deadline,
        reached=xp.where(near, xp.minimum(running.reached, time), running.reached),
        beyond=xp.where(near, running.beyond, time),
        late_error=xp.where(time > running.deadline, xp.fmax(running.late_error, distance), running.late_error),
    )


def _taken(running: RunningMetrics, row: Trajectory, most: Array, limited: Array, leader: int) -> Array:
    """Contribution of one control step to `RunningMetrics.sums` (n, 9).

    `most` (n, N, 1) is the largest force of each drone's rotors [N], `limited` (n, N, 4) 1 where a rotor is at a limit.
    """
    xp = row.position.__array_namespace__()
    rotors = _of_followers(row.rotor_force, leader)
    led, followed = row.leader_command[:, None], xp.reshape(row.follower_command, (*rotors.shape[:2], 3))
    tilts = followed[..., :2]
    saturated = _of_followers(near_limit(SATURATED_WITHIN, row.rotor_force, most), leader)
    change = xp.mean((tilts - running.tilts) ** 2, axis=(-2, -1))
    apart = tilts - xp.mean(tilts, axis=-2, keepdims=True)
    taken = (
        xp.where(row.time <= RMSE_UNTIL + TINY, _norm(row.target - row.position) ** 2, 0.0),
        xp.mean((followed - led) ** 2, axis=(-2, -1)),
        xp.where(running.steps < PAPER_STEPS, xp.mean(paper_reward(led, followed), axis=-1), 0.0),
        xp.mean((rotors - running.hover) ** 2, axis=(-2, -1)),
        xp.where(running.steps > 0, change, 0.0),
        xp.mean(saturated, axis=(-2, -1)),
        xp.max(limited, axis=(-2, -1)),
        power_of(row.rotor_force),
        xp.mean(apart**2, axis=(-2, -1)),
    )
    return xp.stack(taken, axis=-1)


def compensated_sum(total: Array, excess: Array, value: Array) -> tuple[Array, Array]:
    """(`total` + `value`, what rounding has added to it so far), given `excess`, the latter before (Kahan 1965)."""
    lacking = value - excess
    summed = total + lacking
    return summed, (summed - total) - lacking


def _of_followers(rotor_force: Array, leader: int) -> Array:
    """(n, F, 4) of (n, N, 4)."""
    if leader == 0:
        return rotor_force[:, 1:]
    xp = rotor_force.__array_namespace__()
    return xp.concat([rotor_force[:, :leader], rotor_force[:, leader + 1 :]], axis=1)


def near_limit(share: float, force: Array, most: Array) -> Array:
    """1 where a rotor's force is within `share` of `most` of 0 or `most`, else 0; NaN of a force that nobody knows."""
    xp = force.__array_namespace__()
    found = (force <= share * most) | (force >= (1 - share) * most)
    return xp.where(xp.isnan(force), xp.nan, xp.astype(found, force.dtype))


def power_of(rotor_force: Array) -> Array:
    """(...,) of (..., N, 4): what air takes from rotors that hover, but for a factor of their size [N^1.5]."""
    xp = rotor_force.__array_namespace__()
    return xp.sum(xp.maximum(rotor_force, xp.zeros_like(rotor_force)) ** 1.5, axis=(-2, -1))


def _norm(vector: Array) -> Array:
    return vector.__array_namespace__().sqrt((vector * vector).sum(axis=-1))
