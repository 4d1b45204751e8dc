"""Rehearsed over the real protocol against pure simulation: are the figures the same within 20 %?

`python benchmarks/rehearsal.py [--seconds 30] [--flights 3] [--json FILE]`

The runner flies `policies/flight.npz` and `policies/stand.npz` with cflib against the twin, in real time. The pure
simulation (`mjxball.sim.rollout.simulate`, closed form, no protocol, no estimator, no contact) begins where each flight
came under both laws: its place, velocity, roll, CG phase or place of the ball, the same goal. It is flown twice, the
follower reading exact numbers, and numbers in the steps in which a drone's state comes over the wire. Compared are
figures from 5 s on; attitude and ball are the twin's truth, positions the flight's log. Medians over the flights.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from mjxball.config import Config
from mjxball.control import rotations
from mjxball.fly.card import config_of
from mjxball.fly.recording import Recording, read_recording
from mjxball.fly.twin.conditions import Conditions
from mjxball.fly.twin.coupled import CoupledPair
from mjxball.fly.twin.server import Twin
from mjxball.policy import Policy, shipped_policy
from mjxball.sim.rollout import simulate
from mjxball.sim.scenario import Scenario

ROOT = Path(__file__).parents[1]
NAMES = ("flight", "stand")
SETTLED = 5.0  # [s] under both laws, from which on figures count
TRUTH_EVERY = 0.02  # [s]
TRIES = 4
# Steps of the 18 observed numbers: millimetres, a compressed quaternion's, and half a millimetre for the place of O.
STEPS = np.array([*[1e-3] * 3, *[2 / (511 * math.sqrt(2))] * 3, *[1e-3] * 6, *[5e-4] * 6])


class TooBusyError(Exception):
    """The control loop came late: neither drones nor policy ended the flight."""


class Coarse:
    """A follower that reads its policy's observation in `STEPS`."""

    def __init__(self, policy: Policy):
        self._policy, self.name = policy, policy.name
        self.reset = policy.reset

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """See `Follower.__call__`."""
        return self._policy(STEPS * np.round(observation / STEPS))


def rehearse(path: Path, seconds: float) -> tuple[Recording, np.ndarray]:
    """A flight's recording and, of the twin, (time since the motors turned [s], CG offset [m], tilts [rad]) as rows."""
    config = config_of(Policy.load(path).card)
    pair = CoupledPair(config)
    with tempfile.TemporaryDirectory() as place, Twin(pair) as twin:
        log = Path(place) / "flight.jsonl"
        command = [sys.executable, "-m", "mjxball.fly", str(path), "--seconds", str(seconds), "--log", str(log)]
        command += ["--leader", twin.uris[0], "--follower", twin.uris[1]]
        running = subprocess.Popen(
            command, env={**os.environ, "PYTHONPATH": str(ROOT)}, stdout=subprocess.PIPE, stderr=subprocess.STDOUT
        )
        rows = []
        while running.poll() is None:
            turned = rotations.euler_from_matrix(rotations.matrix_from_quaternion(twin.truth.state.quaternion[1]))
            rows.append((pair._flown, pair.cg_offset, *turned))
            time.sleep(TRUTH_EVERY)
        said = running.stdout.read().decode()
        if "too busy" in said:
            raise TooBusyError
        if running.returncode != 0:
            raise SystemExit(f"the rehearsal of {path.stem} ended with {running.returncode}: {said}")
        return read_recording(log), np.array(rows)


def simulated(recording: Recording, truth: np.ndarray, follower: Any, seconds: float) -> Any:
    """The pure simulation from where `recording` came under both laws."""
    config = recording.config
    begin = recording.phase.index("fly")
    conditions, moved = Conditions.of(config), float(recording.time[begin])
    euler = rotations.euler_from_matrix(rotations.matrix_from_quaternion(recording.quaternion[begin]))
    ball = float(np.interp(moved, *truth[:, :2].T)) / config.plant.moving_fraction
    stands = config.plant.stand != "free"
    place, climb = recording.position[begin], recording.velocity[begin]
    upright = np.array([0.0, 0.0, 1.0]) if stands else np.ones(3)
    scenario = Scenario(
        mass=conditions.object_mass,
        amplitude=conditions.cg_amplitude,
        omega=conditions.cg_speed,
        phase=conditions.cg_speed * moved,
        ball_start=ball if config.motion.kind == "rolling" else 0.0,
        goal=tuple(recording.goal[begin] * upright),
        start_position=tuple(place * upright),
        start_velocity=tuple(climb * upright),
        start_tilt=(float(euler[0]), 0.0 if stands else float(euler[1])),
        seconds=seconds,
    )
    return simulate(config, follower, scenario, "newton-euler")


def figures(config: Config, error: np.ndarray, euler: np.ndarray, offset: np.ndarray) -> dict[str, float]:
    """Of rows that are settled: rms of errors [mm] and tilt [mrad]; on the stand roll and where the ball went [mm]."""
    rms = lambda values: float(np.sqrt((values**2).mean()))  # noqa: E731
    if config.plant.stand == "free":
        return {
            "rmse": 1e3 * rms(np.linalg.norm(error, axis=1)),
            "along the stick": 1e3 * rms(error[:, 1]),
            "height": 1e3 * rms(error[:, 2]),
            "tilt": 1e3 * rms(np.linalg.norm(euler[:, :2], axis=1)),
        }
    ball = 1e3 * offset / config.plant.moving_fraction
    return {
        "roll": 1e3 * rms(euler[:, 0]),
        "height": 1e3 * rms(error[:, 2]),
        "ball, rms": rms(ball),
        "ball, farthest": float(np.abs(ball).max()),
    }


def rehearse_undisturbed(path: Path, seconds: float) -> tuple[Recording, np.ndarray]:
    """`rehearse`, again where this computer was too busy to fly; each such try is printed."""
    for _ in range(TRIES):
        try:
            return rehearse(path, seconds)
        except TooBusyError:
            print(f"{path.stem}: flown again, this computer was too busy", flush=True)
    raise SystemExit(f"this computer is too busy: {path.stem} could not be flown in {TRIES} tries")


def compare(path: Path, seconds: float) -> dict[str, tuple[float, ...]]:
    """Figure -> (rehearsed, simulated, simulated with coarse readings) of one flight."""
    policy = Policy.load(path)
    recording, truth = rehearse_undisturbed(path, seconds)
    begin = recording.time[recording.phase.index("fly")]
    late = (np.array(recording.phase) == "fly") & (recording.time >= begin + SETTLED)
    moments = recording.time[late]
    euler = np.stack([np.interp(moments, truth[:, 0], truth[:, 2 + axis]) for axis in range(3)], axis=-1)
    errors = recording.goal[late] - recording.position[late]
    sides = [figures(recording.config, errors, euler, np.interp(moments, *truth[:, :2].T))]
    for follower in (policy, Coarse(policy)):
        pure = simulated(recording, truth, follower, seconds)
        settled = pure.time >= SETTLED
        sides.append(figures(recording.config, pure.error[settled], pure.euler[settled], pure.cg_offset[settled]))
    return {name: tuple(side[name] for side in sides) for name in sides[0]}


def main() -> None:
    """Fly, simulate, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--flights", type=int, default=3)
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    found = []
    for name in NAMES:
        flights = [compare(shipped_policy(name), options.seconds) for _ in range(options.flights)]
        for figure in flights[0]:
            flown, alone, coarse = (statistics.median(one[figure][side] for one in flights) for side in range(3))
            row = {"rehearsed": flown, "simulated": alone, "simulated, coarse readings": coarse}
            found.append({"policy": name, "figure": figure, **row})
            print(f"{name:7s} {figure:16s}" + "".join(f"  {key} {value:7.2f}" for key, value in row.items()))
    if options.json:
        options.json.write_text(json.dumps(found, indent=1, allow_nan=False) + "\n")


if __name__ == "__main__":
    main()
