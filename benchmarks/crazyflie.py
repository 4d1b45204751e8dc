"""The Crazyflie pair: does the ball stay on the stick of the stand, and does the pair fly whatever the rig?

- stand: flights of 60 s from random ball offsets, rolls and heights, undisturbed. The ball is kept if it never touches
  an end stop; shares over all starts.
- flight: rigs sampled as in the training of the preset but for `FAR` (motor lag, inertia, thrust of both and of each,
  firmware, sensors, air): only rigs that can hover are sampled. 20 s each; a crash is |e_o| beyond d_term or a world
  that diverges. RMSE and tilt after 5 s, of the same followers in the same worlds. All see the same noise and delay;
  classical ones know the nominal plant.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from harness import Row, arguments, table, write
from mjxball.baselines import make_baseline
from mjxball.config import Config, apply_overrides, ball_limit, preset
from mjxball.control import rotations
from mjxball.control.followers import Follower
from mjxball.control.observation import OBSERVATION_SIZE
from mjxball.env import TransportEnv
from mjxball.evaluate.policies import load_policy
from mjxball.policy.file import shipped_policy
from mjxball.running import run_command
from mjxball.sim.rollout import make_privileged_info, simulate_batch
from mjxball.sim.scenario import Scenario
from mjxball.xla import enable_compilation_cache

SECONDS, SETTLED = 20.0, 5.0
FAR = {
    "scenario.cg_speed": (0.2, 1.2),
    "scenario.rotor_lag_scale": (0.6, 2.0),
    "scenario.inertia_scale": (0.6, 1.4),
    "scenario.thrust_scale": (0.9, 1.1),
    "scenario.thrust_scale_common": (0.95, 1.05),
    "scenario.uncompensated_probability": 0.5,
    "scenario.noise": (0.0, 0.5),
    "scenario.delay": (0.0, 0.05),
    "scenario.estimator_drift": (0.0, 3.0),
    **dict.fromkeys(("scenario.offset", "scenario.pose_lag", "scenario.gap_rate", "scenario.jitter"), (0.0, 0.0)),
    **dict.fromkeys(("scenario.rotor_drag", "scenario.wind", "scenario.floor_clearance"), (0.0, 0.0)),
    **dict.fromkeys(("scenario.download", "scenario.thrust_fade"), (0.0, 0.0)),
    "scenario.calm_probability": 0.0,
}  # ranges of random rigs, farther from the plant than those of training
CLASSICAL = ("copy", "adaptive", "lqg", "lqg-calm", "lqg-disturbed")


def followers(path: Path, config: Config) -> list[Follower]:
    """The classical ones and the policy."""
    return [*(make_baseline(name, config) for name in CLASSICAL), load_policy(path, config)]


def rms(values: np.ndarray) -> float:
    """Median over the flights of the rms over time (T, n)."""
    return float(np.median(np.sqrt((values**2).mean(axis=0))))


def stand(path: Path, starts: int) -> list[Row]:
    """Shares of flights that keep the ball, of the classical followers and of the policy."""
    config, random = preset("stand"), np.random.default_rng(0)
    scenarios = [
        Scenario(
            amplitude=0.0,
            mass=config.plant.object_mass,
            goal=(0.0, 0.0, 0.0),
            seconds=60.0,
            ball_start=random.uniform(-1, 1) * config.scenario.ball_start,
            start_tilt=(random.uniform(-1, 1) * config.scenario.start_tilt, 0.0),
            start_position=(0.0, 0.0, random.uniform(-1, 1) * config.scenario.start_position),
        )
        for _ in range(starts)
    ]
    rows = []
    for follower in followers(path, config):
        flown = simulate_batch(config, [(follower, scenarios)], "newton-euler")
        ball = np.abs(flown.cg_offset) / config.plant.moving_fraction
        late = flown.time > 10
        rows.append(
            {
                "follower": follower.name,
                "starts": starts,
                "kept": float((ball.max(axis=0) < ball_limit(config.plant) - 1e-3).mean()),
                "ball rms": rms(ball[late]),
                "roll rms": rms(flown.euler[late, :, 0]),
                "height rms": rms(flown.error[late, :, 2]),
                "diverged": int(flown.diverged[-1].sum()),
            }
        )
    return rows


def fly_rigs(env: TransportEnv, starts: Any, follower: Follower) -> tuple[np.ndarray, ...]:
    """e_o (T, n, 3) [m], tilt [rad] and divergence (T, n) of `follower` in the worlds that begin as `starts`."""
    privileged = jax.vmap(make_privileged_info(env.config))
    controller = follower.controller

    def step(carried: Any, _: Any) -> Any:
        state, memory = carried
        world, seen = state.pipeline_state, state.obs[:, :OBSERVATION_SIZE]
        memory, command = controller.step(memory, seen, privileged(world.plant, world.load))
        state = jax.vmap(env.step_with_command)(state, command)
        plant = state.pipeline_state.plant
        euler = rotations.euler_from_matrix(rotations.matrix_from_quaternion(plant.quaternion))
        tilt = jnp.sqrt((euler[:, :2] ** 2).sum(axis=-1))
        return (state, memory), (world.goal - plant.position, tilt, state.metrics["diverged"])

    def fly() -> Any:
        memory = controller.start(starts.obs[:, :OBSERVATION_SIZE])
        return jax.lax.scan(step, (starts, memory), None, length=round(SECONDS / env.dt))[1]

    return tuple(map(np.asarray, jax.jit(fly)()))


def flight(path: Path, rigs: int) -> list[Row]:
    """Crashes, RMSE and tilt over random rigs, of every follower in the same worlds."""
    config = apply_overrides(preset("flight"), FAR)
    env = TransportEnv(config, "newton-euler")
    starts = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(7), rigs))
    rows = []
    for follower in followers(path, config):
        errors, tilt, diverged = fly_rigs(env, starts, follower)
        error = np.linalg.norm(errors, axis=-1)
        crashed = (error > config.scenario.termination_distance).any(axis=0) | (diverged > 0).any(axis=0)
        late = round(SETTLED / env.dt)
        rmse = np.sqrt((error[late:, ~crashed] ** 2).mean(axis=0))
        rows.append(
            {
                "follower": follower.name,
                "rigs": len(crashed),
                "crashes": int(crashed.sum()),
                "rmse": float(np.median(rmse)),
                "rmse, worst of 99 %": float(np.percentile(rmse, 99)),
                "rmse along the stick": rms(errors[late:, ~crashed, 1]),
                "rmse of height": rms(errors[late:, ~crashed, 2]),
                "tilt rms": rms(tilt[late:, ~crashed]),
                "largest tilt": float(np.median(tilt[:, ~crashed].max(axis=0))),
            }
        )
    return rows


def main(given: Sequence[str] | None = None) -> int:
    """Fly, print, write."""
    parser = arguments(__file__, __doc__)
    parser.add_argument("--stand", type=Path, default=shipped_policy("stand"), metavar="POLICY.npz")
    parser.add_argument("--flight", type=Path, default=shipped_policy("flight"), metavar="POLICY.npz")
    parser.add_argument("--starts", type=int, default=100)
    parser.add_argument("--rigs", type=int, default=1000)
    options = parser.parse_args(given)
    enable_compilation_cache()
    found = {"stand": stand(options.stand, options.starts), "flight": flight(options.flight, options.rigs)}
    for rows in found.values():
        table(rows)
    write(options.json, found)
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
