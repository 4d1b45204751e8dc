"""Rewards of one control step, on NumPy or JAX arrays of any batch shape."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from mjxball.config import Reward

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

    from mjxball.arrays import Array
    from mjxball.physics.engine import Scalar, Vector


class RewardInputs(NamedTuple):
    """Inputs of a reward: the true state after one control step, and the commands during it.

    With several followers `action`, `last_action`, `action_average`, `follower_command`, `tilt_disagreement` and
    `spread` have a followers' axis, and so has the reward.
    """

    error: Vector  # e_o, goal minus position of O [m]
    velocity: Vector  # of O [m/s]
    euler: Vector  # roll, pitch, yaw [rad]
    rates: Vector  # about the body axes [rad/s]
    action: Vector  # of the network in [-1, 1]
    last_action: Vector  # action of the previous step
    command_change: Vector  # change of the follower's command since the previous step [rad, m/s2]
    action_average: Vector | None  # over the longest of `follower.observation_averages`, None without any
    leader_command: Vector  # roll, pitch [rad], vertical acceleration [m/s2]
    follower_command: Vector  # the same for the follower
    tilt_disagreement: Scalar  # follower's minus leader's command about the axis without CG torque [rad]
    spread: Vector | None  # what of a follower's command moves nothing [rad, m/s2], None with one follower
    ball: Float[Array, "... directions"]  # offset of a rolling ball along the load's directions, over the end stop's
    rotors: Float[Array, "... rotors"] | None  # forces of all rotors over their largest, None if no weight needs them
    terminated: Bool[Array, "..."]  # whether the episode ended by leaving the termination distance or by diverging


NEAR_LIMIT = 0.1  # share of a rotor's largest force within which it counts as near a limit


def paper_reward(leader_command: Vector, follower_command: Vector) -> Scalar:
    """The paper's reward, -10 (|az_l - az_f| + |phi_l - phi_f| + |theta_l - theta_f|), of two commands (..., 3)."""
    xp = leader_command.__array_namespace__()
    return -10.0 * xp.abs(leader_command - follower_command).sum(axis=-1)


def task_reward(weights: Reward, step: RewardInputs) -> Scalar:
    """Task reward (ours): minus a weighted sum of costs, without the cost of a termination.

    The cost of the error is a pseudo-Huber loss: |e| / scale far away, (e / scale)^2 / 2 near the goal.
    """
    xp = step.error.__array_namespace__()

    def square(vector: Float[Array, "... k"]) -> Scalar:
        return (vector * vector).sum(axis=-1)

    distance = xp.sqrt(1.0 + square(step.error) / weights.error_scale**2) - 1.0
    total = -(
        weights.error * distance
        + weights.velocity * square(step.velocity)
        + weights.tilt * square(step.euler[..., :2])
        + weights.rates * square(step.rates)
        + weights.effort * square(step.action)
        + weights.smoothness * square(step.action - step.last_action)
    )

    def of_command(difference: Vector) -> Scalar:
        return square(difference[..., :2]) + 0.01 * difference[..., 2] ** 2

    if used(weights.command_change):
        total = total - weights.command_change * of_command(step.command_change)
    if used(weights.spread) and step.spread is not None:
        total = total - weights.spread * of_command(step.spread)
    if used(weights.tilt_disagreement):
        total = total - weights.tilt_disagreement * step.tilt_disagreement**2
    if used(weights.ball):
        total = total - weights.ball * square(step.ball)
    if step.rotors is not None:
        near = xp.maximum(xp.abs(step.rotors - 0.5) - (0.5 - NEAR_LIMIT), xp.zeros_like(step.rotors))
        total = total - weights.rotor_limits * square(near)
    if used(weights.steady_action) and step.action_average is not None:
        total = total - weights.steady_action * square(step.action_average)
    return total


def used(weight: Scalar | float) -> bool:
    """Whether a `weight` is not 0. In a sweep the weight is traced and its value unknown."""
    return not isinstance(weight, (int, float)) or weight != 0


def reward(weights: Reward, step: RewardInputs) -> Scalar:
    """The reward of `weights.kind`, minus the cost of a termination."""
    xp = step.error.__array_namespace__()
    paper = weights.kind == "paper"
    running = paper_reward(step.leader_command, step.follower_command) if paper else task_reward(weights, step)
    return running - xp.where(step.terminated, weights.termination, 0.0)
