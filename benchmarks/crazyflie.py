"""The Crazyflie pair: does the ball stay on the stick of the stand, and does the pair fly whatever the rig?

`python benchmarks/crazyflie.py [--stand POLICY.npz] [--flight POLICY.npz] [--starts N] [--rigs N] [--json FILE]`

- stand: flights of 60 s from random ball offsets, rolls and heights, undisturbed. The ball is kept if it never touches
  an end stop; shares over all starts, of copy, adaptive, LQG and the policy.
- flight: rigs drawn as the preset's training draws them (thrust of both and of each, motor lag, inertia, object mass,
  CG motion, noise, delay, gusts, battery, firmware): only rigs that can hover are drawn. 20 s each; a crash is |e_o|
  beyond d_term or a world that diverges. RMSE and tilt after 5 s, of the same
  followers in the same worlds. All see the same noise and delay; classical ones are told the nominal plant.
- route: up 0.4 m, along a square of 0.5 m whose sides take 15 s each, and down again, the ball swinging 30 mm
  at five speeds, noise at level 1, 20 ms of delay, nominal rig: how far O is from each corner when its 15 s are over.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjxball.baselines import make_baseline
from mjxball.cache import enable_compilation_cache
from mjxball.config import ball_limit, preset
from mjxball.control import rotations
from mjxball.control.followers import Follower
from mjxball.control.observation import OBSERVATION_SIZE
from mjxball.env import TransportEnv
from mjxball.evaluate.policies import load_policy
from mjxball.policy.file import shipped_policy
from mjxball.policy.policy import NetworkLaw, Policy
from mjxball.sim.disturbances import Disturbance
from mjxball.sim.rollout import make_privileged_info, simulate_batch
from mjxball.sim.scenario import Scenario

SECONDS, SETTLED = 20.0, 5.0
LEG = 15.0  # [s]
CLASSICAL = ("copy", "adaptive", "lqg")


def stand(path: Path, starts: int) -> list[dict[str, Any]]:
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
    for follower in (*(make_baseline(name, config) for name in CLASSICAL), load_policy(path, config)):
        flown = simulate_batch(config, [(follower, scenarios)], "newton-euler")
        ball = np.abs(flown.cg_offset) / config.plant.moving_fraction
        late = flown.time > 10
        rows.append(
            {
                "follower": follower.name,
                "starts": starts,
                "kept": float((ball.max(axis=0) < ball_limit(config.plant) - 1e-3).mean()),
                "ball rms": float(np.median(np.sqrt((ball[late] ** 2).mean(axis=0)))),
                "roll rms": float(np.median(np.sqrt((flown.euler[late, :, 0] ** 2).mean(axis=0)))),
                "height rms": float(np.median(np.sqrt((flown.error[late, :, 2] ** 2).mean(axis=0)))),
                "diverged": int(flown.diverged.sum()),
            }
        )
    return rows


def fly_rigs(env: TransportEnv, starts: Any, follower: Follower) -> tuple[np.ndarray, ...]:
    """e_o (T, n, 3) [m], tilt [rad] and divergence (T, n) of `follower` in the worlds that begin as `starts`."""
    privileged = jax.vmap(make_privileged_info(env.config))
    policy = isinstance(follower, Policy)
    law = NetworkLaw(follower) if policy else follower.law

    def step(carried: Any, _: Any) -> Any:
        state, memory = carried
        world, seen = state.pipeline_state, state.obs[:, :OBSERVATION_SIZE]
        if policy:
            state = jax.vmap(env.step)(state, law.scaled(world.history, seen))
        else:
            memory, command = law.step(memory, seen, privileged(world.plant, world.load))
            state = jax.vmap(env.step_with_command)(state, command)
        plant = state.pipeline_state.plant
        euler = rotations.euler_from_matrix(rotations.matrix_from_quaternion(plant.quaternion))
        tilt = jnp.sqrt((euler[:, :2] ** 2).sum(axis=-1))
        return (state, memory), (world.goal - plant.position, tilt, state.metrics["diverged"])

    def fly() -> Any:
        memory = () if policy else law.start(starts.obs[:, :OBSERVATION_SIZE])
        return jax.lax.scan(step, (starts, memory), None, length=round(SECONDS / env.dt))[1]

    return tuple(map(np.asarray, jax.jit(fly)()))


def flight(path: Path, rigs: int) -> list[dict[str, Any]]:
    """Crashes, RMSE and tilt over random rigs, of every follower in the same worlds."""
    config = preset("flight")
    env = TransportEnv(config, "newton-euler")
    starts = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(7), rigs))
    rows = []
    for follower in (*(make_baseline(name, config) for name in CLASSICAL), load_policy(path, config)):
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
                "rmse along the stick": float(np.median(np.sqrt((errors[late:, ~crashed, 1] ** 2).mean(axis=0)))),
                "rmse of height": float(np.median(np.sqrt((errors[late:, ~crashed, 2] ** 2).mean(axis=0)))),
                "tilt rms": float(np.median(np.sqrt((tilt[late:, ~crashed] ** 2).mean(axis=0)))),
                "largest tilt": float(np.median(tilt[:, ~crashed].max(axis=0))),
            }
        )
    return rows


def route(path: Path) -> list[dict[str, Any]]:
    """Distance from each waypoint at the end of its leg, RMSE and tilt on the way, over CG speeds."""
    config = preset("flight")
    places = [(0.0, 0.0, 0.4), (0.5, 0.0, 0.4), (0.5, 0.5, 0.4), (0.0, 0.5, 0.4), (0.0, 0.0, 0.4), (0.0, 0.0, 0.0)]
    later = tuple((LEG * (k + 1), place) for k, place in enumerate(places[1:]))
    scenarios = [
        Scenario(
            omega=omega,
            amplitude=0.03 * config.plant.moving_fraction,
            mass=config.plant.object_mass,
            goal=places[0],
            waypoints=later,
            seconds=LEG * len(places),
            disturbance=Disturbance(noise=1.0, delay=0.02, seed=number),
        )
        for number, omega in enumerate((0.3, 0.5, 0.7, 0.85, 1.0))
    ]
    rows = []
    for follower in (*(make_baseline(name, config) for name in CLASSICAL), load_policy(path, config)):
        flown = simulate_batch(config, [(follower, scenarios)], "newton-euler")
        ends = [round(LEG * (k + 1) / config.timing.control_period) - 1 for k in range(len(places))]
        missed = np.linalg.norm(flown.position[ends] - np.array(places)[:, None], axis=-1)  # (waypoints, flights)
        tilt = np.sqrt((flown.euler[..., :2] ** 2).sum(axis=-1))
        rows.append(
            {
                "follower": follower.name,
                "flights": len(scenarios),
                "diverged": int(flown.diverged.sum()),
                "beside a corner, median": float(np.median(missed)),
                "beside a corner, worst": float(missed.max()),
                "tilt rms": float(np.median(np.sqrt((tilt**2).mean(axis=0)))),
            }
        )
    return rows


def main() -> None:
    """Fly, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--stand", type=Path, default=shipped_policy("stand"), metavar="POLICY.npz")
    parser.add_argument("--flight", type=Path, default=shipped_policy("flight"), metavar="POLICY.npz")
    parser.add_argument("--starts", type=int, default=100)
    parser.add_argument("--rigs", type=int, default=1000)
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    enable_compilation_cache()
    found = {"stand": stand(options.stand, options.starts), "flight": flight(options.flight, options.rigs)}
    found["route"] = route(options.flight)
    for part, rows in found.items():
        for row in rows:
            shown = (
                f"{key} {value:.4g}" if isinstance(value, float) else f"{key} {value}" for key, value in row.items()
            )
            print(f"{part}: " + ", ".join(shown))
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
