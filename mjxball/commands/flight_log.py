"""`eval.py --flight LOG`: a flight log in the figures of simulation, with the simulation of the same commands."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from mjxball import cli
from mjxball.control import rotations
from mjxball.evaluate import flight_log
from mjxball.evaluate.cells import Cell
from mjxball.evaluate.metrics import measure
from mjxball.fly.recording import Recording, fly_again, read_recording
from mjxball.fly.twin.conditions import Conditions
from mjxball.rollout import Trajectory
from mjxball.scenario import Scenario


def evaluate_log(path: Path, out: Path) -> int:
    """Draw the log `path` into the new directory `out`, print how far the simulation is from it; the exit code."""
    recording = read_recording(path)
    cli.output_directory(out)
    cells = [cell_of(recording, f"{recording.policy}, flown"), cell_of(fly_again(recording), "the same, simulated")]
    plant = recording.config.plant
    files = flight_log.draw(cells, plant.stand != "free", plant.leader_mount, out)
    print(flight_log.differences(*cells))  # noqa: T201
    print("figures: " + ", ".join(map(str, files)))  # noqa: T201
    return 0


def cell_of(recording: Recording, name: str) -> Cell:
    """A recording as the judge's figures take it; the scenario is what the simulation assumed."""
    config, flight = recording.config, trajectory_of(recording)
    met = Conditions.of(config)
    numbers = (met.cg_speed, met.cg_amplitude, met.object_mass)
    scenario = Scenario(*numbers, ball_start=met.ball, seconds=float(flight.time[-1]))
    metrics = measure(flight, config.scenario.termination_distance, config.plant.rotor_force_max)
    return Cell(name, scenario, metrics, flight, config.motion.kind)


def trajectory_of(recording: Recording) -> Trajectory:
    """A recording as a simulated flight is kept; what was not measured is NaN."""
    rows = len(recording.time)
    flying = [number for number, phase in enumerate(recording.phase) if phase == "fly"]
    unknown = np.full((rows, 2, 3), np.nan)
    return Trajectory(
        time=recording.time,
        position=recording.position,
        velocity=recording.velocity,
        euler=rotations.euler_from_matrix(rotations.matrix_from_quaternion(recording.quaternion)),
        rates=recording.rates,
        quaternion=recording.quaternion,
        rotor_force=recording.rotor_force,
        leader_command=recording.leader,
        follower_command=recording.follower,
        observation=recording.observation,
        cg_offset=recording.cg_offset,
        object_mass=np.full(rows, np.nan),
        contact_force=unknown,
        contact_torque=unknown,
        goal=recording.goal[flying[0] if flying else 0],
        target=recording.goal,
        diverged=np.array(False),
    )
