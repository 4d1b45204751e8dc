"""The pair beyond the tracks of mjxball-bench: fast loads, goals that move, ten minutes with offsets, other loops.

Every follower flies the same: the reference load (0.2 kg, CG by 5 cm) unless said. A row has the largest |e_o| of its
flights over the seconds named, the mean power over that of hover, and the longest time of one rotor at a limit. It is
flown once with exact sensors, or with the constant errors of the condition calm in several samples (`offsets`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from harness import Row, arguments, follower_of, say, write
from mjxball import running
from mjxball.config import preset
from mjxball.control.followers import Follower
from mjxball.evaluate.metrics import measure_batch
from mjxball.sim.disturbances import Disturbance
from mjxball.sim.goals import GoalMotion
from mjxball.sim.rollout import simulate_batch
from mjxball.sim.scenario import Scenario

CONFIG = preset("paper")
SPEEDS = (1.0, 3.1, 5.0, 6.0)  # of the CG [rad/s]
LOOPS = (6.0, 12.0, 20.0, 30.0, 40.0)  # natural frequency of roll [rad/s]
SAMPLES = 8  # of the constant errors
SETTLED, MOVING = 20.0, 3.0  # from which on errors count: goals that rest, that move [s]
MINUTE, TEN = 60.0, 600.0  # [s]
REFERENCE = Scenario(omega=1.0, amplitude=0.05, mass=0.2, seconds=45.0)
STILL = replace(REFERENCE, goal=(0.0, 0.0, 0.0))


def cases() -> Iterator[tuple[str, list[Scenario], float]]:
    """(name, flights, from which second on errors count)."""
    for speed in SPEEDS:
        yield f"CG at {speed:g} rad/s", [replace(REFERENCE, omega=speed)], SETTLED
    yield "goal at 0.25 m/s", [replace(STILL, goal_motion=GoalMotion((0.25, 0.0, 0.0)))], MOVING
    yield "circle of 1 m at 0.5 rad/s", [replace(STILL, goal_motion=GoalMotion(radius=1.0, speed=0.5))], MOVING
    for loops in LOOPS:
        scale = loops / CONFIG.attitude.natural_frequency[0]
        yield f"loops of {loops:g} rad/s", [replace(REFERENCE, loop_scale=scale)], SETTLED
    flights = [replace(REFERENCE, seconds=TEN, disturbance=Disturbance(offset=1.0, seed=k)) for k in range(SAMPLES)]
    yield "offsets, first minute", [replace(one, seconds=MINUTE) for one in flights], SETTLED
    yield "offsets, tenth minute", flights, TEN - MINUTE


def main(given: Sequence[str] | None = None) -> int:
    """Fly, print, write."""
    parser = arguments(__file__, __doc__)
    parser.add_argument("followers", nargs="+", metavar="FOLLOWER", help="a policy file or a baseline")
    options = parser.parse_args(given)
    rows: list[Row] = []
    for name in options.followers:
        for case, flights, begins in cases():
            rows.append({"follower": name.rpartition("/")[2].removesuffix(".npz"), "case": case})
            rows[-1] |= flown(follower_of(name, CONFIG), flights, begins)
            say(rows[-1])
    write(options.json, {"rows": rows})
    return 0


def flown(follower: Follower, flights: Sequence[Scenario], begins: float) -> Row:
    """Largest error [m] from `begins` [s] on (None: a flight failed), power over hover, time at a limit."""
    record = simulate_batch(CONFIG, [(follower, flights)], "newton-euler")
    plant = CONFIG.plant
    metrics = measure_batch(record, CONFIG.scenario.termination_distance, plant.rotor_force_max, plant.leader)
    error = np.linalg.norm(record.target - record.position, axis=-1)[record.time >= begins].max()
    return {
        "error": None if any(one.failed for one in metrics) else float(error),
        "power": float(np.mean([one.rotor_power for one in metrics])),
        "rotor_limit_share": max(one.rotor_limit_share for one in metrics),
    }


if __name__ == "__main__":
    raise SystemExit(running.run_command(main))
