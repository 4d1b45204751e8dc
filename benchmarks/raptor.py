"""Two RAPTOR policies, one a drone, on the pair's flights of mjxball-bench -> an entry of the leaderboard.

`pip install foundation-policy && python benchmarks/raptor.py benchmarks/leaderboard/raptor.json`

RAPTOR (Eschmann, Albani and Loianno 2025, arXiv 2509.11481) flies any single quadrotor to a point: a recurrent network
that answers to position, attitude, velocities and its own last command with four rotor commands, at 100 Hz. Here one
flies each drone to its own place on the rig at the goal; `eval.py bench` has no place for that, as its followers
command an attitude and its leader is a PID. The follower measures what every follower measures, with the same noise and
delay; the leader, like every leader, knows the truth. Rotors stand between the body axes, as RAPTOR expects. A command
u in [-1, 1] is the rotor force F_max (u + 1) / 2, and an error of position enters no longer than 0.5 m: of squared or
proportional forces and of both kinds of errors this failed least on draw 1 (none of 480 flights; one in eight with
neither).
"""

from __future__ import annotations

import dataclasses
import datetime
import hashlib
import json
import shlex
import sys
import time as clock
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from mjxball import cli, running
from mjxball.bench import NAME, VERSION
from mjxball.bench.draw import Group, groups_of
from mjxball.bench.entry import by_condition, table
from mjxball.bench.evaluation import Result, fresh_key, with_seed
from mjxball.bench.success import reasons
from mjxball.bench.tracks import TRACKS
from mjxball.config import Config
from mjxball.control import observation, rotations
from mjxball.errors import InputError
from mjxball.evaluate.metrics import results, rotor_limits
from mjxball.evaluate.running_metrics import begin, update
from mjxball.files import write_atomically
from mjxball.physics import newton_euler
from mjxball.physics.engine import Load, PlantState, has_diverged
from mjxball.physics.step import PlantStep, make_plant_step
from mjxball.plant import plant_parameters
from mjxball.sim.closed_loop import TeamCommands
from mjxball.sim.rollout import scenario_arrays
from mjxball.sim.trajectory import Trajectory
from mjxball.train.run_directory import commit, versions

PAIRS = ("pair", "pair-unknown")
PERIOD, STEPS = 0.01, 2  # [s] between two commands; physics steps in it
NEAR = 0.5  # [m] of an error of position, at most
BESIDE = "two policies that command rotors are flown on the pair alone"


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly both tracks of the pair and write the entry."""
    parser = cli.make_parser("python benchmarks/raptor.py", __doc__.split("\n\n", maxsplit=1)[0])
    parser.add_argument("out", type=Path, metavar="OUT.json")
    parser.add_argument("--draw", type=int, default=0, metavar="N", help="flights sampled anew (default 0)")
    options = parser.parse_args(arguments)
    cli.output_file(options.out, ".json")
    try:
        import foundation_policy
    except ImportError:
        raise InputError("RAPTOR is not installed: pip install foundation-policy") from None
    found: dict[str, Any] = {}
    key, times = fresh_key(), []
    for track in PAIRS:
        (group,) = groups_of(track, options.draw)
        begun = clock.process_time()
        flown = by_condition(fly_group(group, track, key, foundation_policy.Raptor()))
        times.append((clock.process_time() - begun) * PERIOD / sum(one.scenario.seconds for one in group.flights))
        # There is no attitude command whose change could be measured.
        found[track] = {name: {**values, "command_change": None} for name, values in flown.items()}
    digest = hashlib.sha256(Path(foundation_policy.__file__).read_bytes()).hexdigest()
    entry = {
        **{"benchmark": NAME, "version": VERSION, "draw": options.draw, "key": key, "follower": "raptor"},
        **{"sha256": digest, "date": datetime.datetime.now(datetime.UTC).date().isoformat(), "cpu_time": max(times)},
        "tracks": found,
        "not_flown": {name: BESIDE for name in TRACKS if name not in PAIRS},
        "command": shlex.join(["python", "benchmarks/raptor.py", *(arguments or sys.argv[1:])]),
        **{"commit": commit(), "versions": versions()},
    }
    write_atomically(options.out, json.dumps(entry, indent=1, allow_nan=False) + "\n")
    print(table(entry))
    return 0


def fly_group(group: Group, track: str, key: str, raptor: Any) -> list[Result]:
    """Every flight of a track; `raptor` keeps a memory for each drone of each."""
    scenarios = [with_seed(one, f"{key}:{track}", 0) for one in group.flights]
    plant = dataclasses.replace(group.config.plant, layout="x")
    timing = dataclasses.replace(group.config.timing, control_period=PERIOD, physics_steps=STEPS)
    config = dataclasses.replace(group.config, plant=plant, timing=timing)
    step, most = _rotor_step(config), np.array(plant.of_drones("rotor_force_max"))[:, None]
    flown = scenario_arrays(config, scenarios)
    state, inputs, goal = flown.start, flown.inputs, flown.inputs.goal[0]
    mounts = np.array(plant_parameters(plant, config.attitude).mounts, float)

    def truth(state: PlantState, drone: int) -> np.ndarray:
        matrix = rotations.matrix_from_quaternion(state.quaternion)
        return observation.observe(state.position, matrix, state.velocity, state.rates, goal, mounts[drone])

    raptor.reset()
    follower, nothing = plant.followers[0], np.zeros((len(goal), 3))
    sensed, measured = flown.sensors.start(truth(state, follower), flown.first, flown.delays)
    radii, deadlines = (np.array([getattr(one, name) for one in group.flights]) for name in ("radius", "deadline"))
    running = begin(state.position, goal, state.rotor_force, plant.leader, radii, deadlines)
    limits = rotor_limits(plant, scenarios)
    command = 2 * np.clip(state.rotor_force / most, 0.0, 1.0) - 1
    for number, time in enumerate(inputs.time):
        if number % 2 == 0:  # the 50 Hz of every other follower's flights
            row = Trajectory.of(state, time, goal, TeamCommands(nothing, nothing), diverged=has_diverged(state))
            running = update(running, row, config.scenario.termination_distance, limits, plant.leader)
        seen = [truth(state, plant.leader), measured] if plant.leader < follower else [measured, truth(state, 1)]
        given = np.stack([see(own, mount, goal) for own, mount in zip(seen, mounts, strict=True)], axis=1)
        given = np.concatenate([given, command], axis=-1)
        answer = raptor.evaluate_step(given.reshape(-1, given.shape[-1]))
        command = np.clip(answer, -1.0, 1.0).reshape(command.shape)
        state = step(state, most * ((command + 1) / 2), flown.load)
        sensed, measured = flown.sensors.step(sensed, truth(state, follower), inputs.sample.at(number))
    return [
        Result(0, flight, one, reasons(one, flight.deadline))
        for flight, one in zip(group.flights, results(running), strict=True)
    ]


def see(own: np.ndarray, mount: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """RAPTOR's input (n, 18) without its last command, of a drone's observation (n, 18): its place minus its goal."""
    matrix = np.asarray(rotations.matrix_from_quaternion(rotations.quaternion_from_euler(own[:, 3:6])))
    off = own[:, :3] - goal - mount
    off = off * np.minimum(1.0, NEAR / np.maximum(np.linalg.norm(off, axis=1, keepdims=True), 1e-9))
    return np.concatenate([off, matrix.reshape(-1, 9), own[:, 6:9], own[:, 9:12]], axis=1)


def _rotor_step(config: Config) -> PlantStep:
    """A control step whose commands are rotor forces (n, N, 4) [N]."""
    engine = newton_euler.make_engine(config.plant, config.attitude)
    step = make_plant_step(config, engine, autopilot=lambda state, asked, _: (state.loops, asked))
    with jax.enable_x64(True):
        compiled = jax.jit(step)

    def run(state: PlantState, forces: np.ndarray, load: Load) -> PlantState:
        with jax.enable_x64(True):
            return PlantState(*compiled(state, forces, load)).each(np.asarray)

    return run


if __name__ == "__main__":
    sys.exit(running.run_command(main))
