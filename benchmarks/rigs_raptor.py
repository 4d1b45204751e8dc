"""Two policies of RAPTOR, each of which flies one drone of a pair, on the random pairs of `benchmarks/rigs.py`.

    pip install foundation-policy
    python benchmarks/rigs_raptor.py policies/universal.npz policies/balance.npz --json rigs_raptor.json

RAPTOR (Eschmann, Albani and Loianno, 2025) flies any single quadrotor to a point: a recurrent network that answers to
position, attitude, velocities and its own last command with four rotor commands, at 100 Hz. Here one flies the leader
and one the follower, each to its own place on the rig at the goal. Flights, loads and thrusts are those of `rigs.py`;
but both policies are given the true state without noise and delay, and rotors stand between the body axes, as RAPTOR
expects them. A command u in [-1, 1] is a rotor force F_max ((u + 1) / 2)^p with p = 1 or 2; errors of position enter at
full length, or no longer than 0.5 m. All four are flown. `alone`: the same rotors under a drone by itself, without a
load, as a check that this is how RAPTOR is meant to be used.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

import rigs as judge
from mjxball import cli
from mjxball.config import Config, preset, replace
from mjxball.control import rotations
from mjxball.env import TransportEnv
from mjxball.errors import InputError
from mjxball.evaluate.rigs import SECONDS, Flown, fly
from mjxball.physics import newton_euler
from mjxball.physics.engine import Load, PlantState
from mjxball.physics.step import make_control_step
from mjxball.sim.rigs import HELD_OUT_RIGS, RigTable, held_out, rig_config, whole

Array = Any
PERIOD, STEPS = 0.01, 2  # [s] between two commands; physics steps in it
VARIANTS = [(power, near) for power in (1, 2) for near in (np.inf, 0.5)]


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly, print, write."""
    parser = cli.make_parser("python benchmarks/rigs_raptor.py", __doc__.split("\n\n")[0])
    parser.add_argument("policies", nargs="*", type=Path, metavar="POLICY.npz", help="beside them")
    parser.add_argument("--rigs", type=int, default=HELD_OUT_RIGS, metavar="N", help="how many pairs (default 200)")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args(arguments)
    try:
        import foundation_policy
    except ImportError:
        raise InputError("RAPTOR is not installed; pip install foundation-policy") from None
    config = replace(preset("universal"), "rigs.mass_step", 0.0)
    rigs, rows = held_out(config, 2, options.rigs), []
    flown: dict[str, Flown] = {}
    for name, make in judge.followers(options.policies):
        if name not in judge.WORST:
            flown[name] = fly(config, rigs, make(config, rigs), judge.FLIGHTS)
            rows.append({"follower": name, **judge.row_of(flown, name, rigs, config.timing.control_period)})
            print(json.dumps(rows[-1]), flush=True)
    for power, near in VARIANTS:
        for pair in (False, True):
            error = fly_raptor(config, rigs, foundation_policy.Raptor, power, near, pair)
            far = np.isnan(error).any(axis=-1) | (error > config.scenario.termination_distance).any(axis=-1)
            found = Flown(np.where(far[..., None], np.inf, error), far)
            row = judge.row_of({**flown, "raptor": found} if pair else {"raptor": found}, "raptor", rigs, 2 * PERIOD)
            name = "raptor, two on the rig" if pair else "raptor alone"
            rows.append({"follower": name, "power": power, "near": min(near, 1e9), **row})
            print(json.dumps(rows[-1]), flush=True)
    if options.json:
        options.json.write_text(json.dumps({"rows": rows}, indent=1) + "\n")
    return 0


def fly_raptor(config: Config, rigs: RigTable, make: Any, power: int, near: float, pair: bool) -> np.ndarray:
    """Distance of O from its goal [m] (R, K, T) every 0.02 s, each drone flown by a policy of its own.

    With `pair` False the leader flies alone, without carrier and load.
    """
    start, load, goal = worlds(config, rigs)
    flights = len(goal)
    numbers = jax.tree.map(lambda part: np.repeat(part, judge.FLIGHTS, axis=0), rigs.numbers)
    own = rig_config(config, rigs, 0)
    plant = dataclasses.replace(own.plant, layout="x")
    timing = dataclasses.replace(config.timing, control_period=PERIOD, physics_steps=STEPS)
    own = dataclasses.replace(own, plant=plant, timing=timing)
    if not pair:  # one drone at O; the other lifts and weighs nothing
        one = np.array([1.0, 0.0])
        numbers = numbers._replace(
            mounts=0.0 * numbers.mounts,
            carrier_mass=0.0 * numbers.carrier_mass,
            carrier_inertia=0.0 * numbers.carrier_inertia,
            drone_mass=numbers.drone_mass * one,
            own_inertia=numbers.own_inertia * one[:, None],
            rotor_force_max=numbers.rotor_force_max * one,
        )
        load = load._replace(object_mass=0.0 * load.object_mass, mass_change=0.0 * load.mass_change)
    numbers = whole(numbers, config.plant.gravity)
    engine = newton_euler.make_engine(plant, own.attitude, numbers)
    step = make_control_step(own, engine, parameters=numbers, autopilot=lambda state, asked, _: (state.loops, asked))
    most, policies = numbers.rotor_force_max[..., None], make()  # one network, a memory for each drone
    policies.reset()
    share = np.clip(start.rotor_force / np.maximum(most, 1e-12), 0.0, 1.0)
    command, state, errors = 2 * share ** (1 / power) - 1, start, []
    for number in range(round(SECONDS / PERIOD) + 1):
        if number % 2 == 0:
            errors.append(np.linalg.norm(goal - state.position, axis=-1))
        seen = observe(state, numbers.mounts, goal, command, near)
        command = np.clip(policies.evaluate_step(seen.reshape(-1, seen.shape[-1])), -1.0, 1.0).reshape(flights, -1, 4)
        state = step(state, most * ((command + 1) / 2) ** power, load)
    return np.stack(errors, axis=-1).reshape(rigs.total, judge.FLIGHTS, -1)


def observe(state: PlantState, mounts: Array, goal: Array, command: Array, near: float) -> Array:
    """What RAPTOR is told of each drone (..., N, 22): place less its goal, attitude, velocities, last command."""
    matrix = np.asarray(rotations.matrix_from_quaternion(state.quaternion))
    rates = np.broadcast_to(state.rates[:, None], mounts.shape)
    off = (state.position - goal)[:, None] + np.einsum("fij,fnj->fni", matrix, mounts) - mounts
    off = off * np.minimum(1.0, near / np.maximum(np.linalg.norm(off, axis=-1, keepdims=True), 1e-9))
    velocity = state.velocity[:, None] + np.einsum("fij,fnj->fni", matrix, np.cross(rates, mounts))
    flat = np.broadcast_to(matrix.reshape(len(goal), 1, 9), (*mounts.shape[:2], 9))
    return np.concatenate([off, flat, velocity, rates, command], axis=-1)


def worlds(config: Config, rigs: RigTable) -> tuple[PlantState, Load, Array]:
    """(state at the start, load, goal) of the same flights as those of `evaluate.rigs.fly`, (R K, ...) in float64."""
    one_rig = dataclasses.replace(config.rigs, number=1)
    own = dataclasses.replace(rig_config(config, rigs, 0), attitude=config.attitude, rigs=one_rig)
    env = TransportEnv(own, "newton-euler")
    keys = jax.random.split(jax.random.key(0), (rigs.total, judge.FLIGHTS))

    def flights(rig: RigTable, keys: Array) -> Any:
        return jax.vmap(lambda key: env.reset(key, 1.0, None, rig).pipeline_state)(keys)

    single = jax.tree.map(lambda part: np.asarray(part, np.float32), rigs)
    found = jax.jit(jax.vmap(flights))(single, keys)
    world = (found.loop.plant, found.load, found.goal)
    return jax.tree.map(lambda part: np.asarray(part, np.float64).reshape(-1, *part.shape[2:]), world)


if __name__ == "__main__":
    sys.exit(cli.run_command(main))
