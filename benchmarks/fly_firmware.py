"""The runner on the twin in virtual time: landings in a row, take-offs, hover under bad conditions, the stand.

`python benchmarks/fly_firmware.py [--parts flights ground hover stand] [--flight FILE] [--stand FILE]
[--universal FILE] [--jobs N] [--starts 100] [--trials 4] [--json FILE]`

The runner's own flight (supervisor, laws, watches) flies the twin of a pair of Crazyflie 2.1 as delivered, without
sockets or clock. Numbers are of the twin's true state.

- flights: 30 in a row of the same two drones, one of which reboots before ten; landed below 0.5 m/s, exit code 0.
- ground: 8 s from legs on the ground, with random noise, delay and load: `--stand` with the ball at rest
  anywhere within 6 cm; `--flight` and `--universal`. How far O goes sideways, and above its goal.
- hover: 20 s at 0.4 m, errors from 5 s on, for link delay, force curve, sensor noise, pose rate and thrust gains; the
  steady command is the mean of what a drone is sent less what the pair flies, the larger of roll and pitch.
- stand: 60 s from random balls, rolls and heights (ranges of the preset `stand`); kept if the ball touches no stop.

Faults: see `fly_faults_virtual.py`.
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mjxball.config import preset
from mjxball.fly.card import Controller, load_policy
from mjxball.fly.twin.conditions import Conditions, Surroundings
from mjxball.fly.twin.virtual import MemoryLog, VirtualTwin
from mjxball.physics.step import start_state
from mjxball.policy import Policy
from mjxball.policy.file import shipped_policy
from virtual_flight import SETTLE, Job, Row, campaign, cause_of, code_of, settings_of, world_of

SETTLED, HOVER = 5.0, 20.0  # [s]


# Parts: each yields jobs (function, arguments), each of which returns a row.


FLIGHTS, EVERY = 30, 3  # flights in a row; before each third one a drone reboots


def flights_in_a_row(path: Path, count: int, drone: int) -> list[Row]:
    """Take off, fly 5 s, land, `count` times with the same drones; `drone` reboots at times, 0.1 to 3 s before."""
    world, rows = world_of(path, 5.0), []
    random = np.random.default_rng(drone)
    for number in range(count):
        reboots = number % EVERY == EVERY - 1
        if number or reboots:
            world.track.clear()
            before = float(random.uniform(0.0, 2.9)) if reboots else 0.0
            world.advance(before)
            if reboots:
                world.drones[drone].reboot()
            world.next_flight(pause=3.0 - before)
        world.run(60.0)
        rows.append(
            {
                "policy": path.stem,
                "flight": number + 1,
                "reboots": ("leader", "follower")[drone] if reboots else "",
                "code": code_of(world),
                "cause": cause_of(world),
                "touchdown": world.touchdown_speed(),
                "locked": any(drone.firmware.info & 0x40 for drone in world.drones),
            }
        )
    return rows


BALL_ON_GROUND = 0.06  # [m] from the middle


def ground_start(path: Path, number: int) -> list[Row]:
    """8 s from legs on the ground, with what an owner cannot choose at random."""
    policy, random = Policy(load_policy(path), path.stem), np.random.default_rng([2, number])
    config = Controller(policy).config
    conditions = Conditions.of(config)
    ball = random.uniform(-1, 1) * BALL_ON_GROUND if config.motion.kind == "rolling" else 0.0
    conditions = replace(conditions, ball=ball, cg_amplitude=random.uniform(0, 1) * conditions.cg_amplitude)
    noise, delay = random.uniform(0, 2), round(random.uniform(0, 4)) * 0.005
    world = VirtualTwin(
        policy,
        settings_of(policy, 8.0),
        conditions=conditions,
        surroundings=Surroundings(seed=number, noise=noise, delay=delay),
        log=MemoryLog(False),
        settle=SETTLE,
    )
    begin = world.state.position.mean(axis=0)
    world.run(60.0)
    up = [moment for moment in world.track if moment.state in ("ramp", "fly")]
    flown = [moment for moment in up if moment.state == "fly"]
    gone = np.array([moment.position for moment in up]) - begin
    farthest = max(abs(moment.ball) for moment in up) / config.plant.moving_fraction
    seconds = flown[-1].time - flown[0].time if flown else 0.0
    row = {"policy": path.stem, "start": number, "ball": ball, "noise": noise, "delay": delay, "seconds": seconds}
    return [
        {
            **row,
            "lifted": world.flight.lifted,
            "farthest": farthest,
            "kept": bool(seconds > 7.0 and (not config.plant.ball_stop or farthest < config.plant.ball_stop)),
            "aside": float(np.hypot(gone[:, 0], gone[:, 1]).max()),
            "over": float(gone[:, 2].max() - world.settings.goal[2]),
            "tilt": math.degrees(max(moment.tilt for moment in up)),
            "cause": cause_of(world),
            "code": code_of(world),
        }
    ]


HOVERS: list[tuple[str, dict[str, Any]]] = [
    ("as delivered", {}),
    ("5 ms each way", {"delay": 0.005}),
    ("10 ms each way", {"delay": 0.010}),
    ("20 ms each way", {"delay": 0.020}),
    ("older curve", {"curve": "older"}),
    ("older curve, 10 ms each way", {"curve": "older", "delay": 0.010}),
    ("no compensation, true motors", {"curve": "cubic"}),
    ("noise x 3", {"noise": 3.0}),
    ("pose at 20 Hz", {"pose_hz": 20.0}),
    ("gains -5 / +5 %", {"gains": (0.95, 1.05)}),
    ("gains +5 / -5 %", {"gains": (1.05, 0.95)}),
    ("gains -5 / -5 %", {"gains": (0.95, 0.95)}),
    ("older, gains -5 / +5 %", {"curve": "older", "gains": (0.95, 1.05)}),
    ("noise x 3, pose at 20 Hz, 10 ms", {"noise": 3.0, "pose_hz": 20.0, "delay": 0.010}),
]


def hover(path: Path, name: str, around: dict[str, Any], seed: int) -> list[Row]:
    """One hover; errors [mm], tilt and steady commands [degrees]."""
    world = world_of(path, HOVER, seed=seed, **around)
    world.run(90.0)
    flown = [moment for moment in world.track if moment.state == "fly"]
    row: Row = {"policy": path.stem, "case": name, "seed": seed, "code": code_of(world), "seconds": 0.0}
    if len(flown) < 100 or flown[-1].time - flown[0].time < HOVER - 1:
        return [{**row, "cause": cause_of(world), "rmse": math.inf, "tilt": 180.0, "steady": 180.0}]
    late = [moment for moment in flown if moment.time - flown[0].time >= SETTLED]
    goal = world.flight.goal(world.now)  # the landing is over, so that of the flight
    error = np.array([moment.position for moment in late]) - goal
    ticks = [r for r in world.log.records if r["kind"] == "tick" and r["state"] == "fly"]
    sent = np.array([[one[:2] for one in record["sent"]] for record in ticks if record["t"] >= late[0].time])
    attitude = np.degrees([moment.roll for moment in late]).mean()
    steady = np.abs(sent.mean(axis=0) - np.array([attitude, 0.0]))
    return [
        {
            **row,
            "rmse": 1e3 * float(np.sqrt((error**2).sum(axis=1).mean())),
            "along": 1e3 * float(np.sqrt((error[:, 1] ** 2).mean())),
            "height": 1e3 * float(np.sqrt((error[:, 2] ** 2).mean())),
            "tilt": math.degrees(max(moment.tilt for moment in flown)),
            "steady": float(steady.max()),
            "touchdown": world.touchdown_speed(),
        }
    ]


def stand_start(path: Path, number: int) -> list[Row]:
    """60 s on the stand from a random start, placed there at the moment when the laws take over."""
    config = preset("stand")
    random = np.random.default_rng([1, number])
    ball, roll, height = (
        random.uniform(-1, 1) * size
        for size in (config.scenario.ball_start, config.scenario.start_tilt, config.scenario.start_position)
    )
    policy = Policy.load(path)
    conditions = replace(Conditions.of(Controller(policy).config), ball=ball)
    world = VirtualTwin(
        policy,
        settings_of(policy, 60.0),
        conditions=conditions,
        surroundings=Surroundings(seed=number),
        log=MemoryLog(False),
        settle=SETTLE,
    )
    place = [np.array(part) for part in ([0.0, 0.0, world.settings.goal[2] + height], [0.0] * 3, [roll, 0.0, 0.0])]
    world.start_in_air(start_state(config, *place, np.float64(conditions.object_mass), np.float64(ball)))
    world.run(120.0)
    stop, share = config.plant.ball_stop, config.plant.moving_fraction
    flown = [moment for moment in world.track if moment.state == "fly"]
    farthest = max(abs(moment.ball) for moment in flown) / share
    seconds = flown[-1].time - flown[0].time
    row = {"start": number, "ball": ball, "roll": roll, "height": height, "seconds": seconds, "farthest": farthest}
    late = [moment for moment in flown if moment.time - flown[0].time > 10]
    return [
        {
            **row,
            "kept": bool(farthest < stop and seconds > 59.0),
            "ball_rms": _rms([moment.ball / share for moment in late]),
            "roll_rms": _rms([moment.roll for moment in late]),
            "cause": cause_of(world),
            "touchdown": world.touchdown_speed(),
            "code": code_of(world),
        }
    ]


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else math.nan


def jobs_of(options: argparse.Namespace) -> Iterator[Job]:
    """(part, function, arguments) of everything that is asked for, the longest first."""
    if "flights" in options.parts:
        pairs = ((options.stand, 0), (options.flight, 1))
        yield from (("flights", flights_in_a_row, (path, FLIGHTS, drone)) for path, drone in pairs)
    if "stand" in options.parts:
        yield from (
            ("stand", stand_start, (options.stand, number))
            for number in range(options.first, options.first + options.starts)
        )
    if "ground" in options.parts:
        yield from (
            ("ground", ground_start, (path, number))
            for path in (options.stand, options.flight, options.universal)
            for number in range(options.first, options.first + options.starts)
        )
    if "hover" in options.parts:
        yield from (
            ("hover", hover, (options.flight, name, around, seed))
            for name, around in HOVERS
            for seed in range(options.seeds)
        )


def table(part: str, rows: Sequence[Row]) -> None:
    """Print a part's rows, put together."""
    print(f"\n{part}")
    if part == "flights":
        for name in dict.fromkeys(row["policy"] for row in rows):
            own = [row for row in rows if row["policy"] == name]
            fastest = max(row["touchdown"] for row in own)
            good = sum(row["code"] == 0 for row in own)
            reboots = sum(bool(row["reboots"]) for row in own)
            text = f"{good} of {len(own)} with exit code 0, {reboots} after a reboot"
            print(f"{name:10} {text}, hardest touchdown {fastest:.2f} m/s")
    elif part == "ground":
        for name in dict.fromkeys(row["policy"] for row in rows):
            own = [row for row in rows if row["policy"] == name]
            lifted, kept = (sum(row[key] for row in own) for key in ("lifted", "kept"))
            aside, over = (100 * max(row[key] for row in own) for key in ("aside", "over"))
            farthest = 1e3 * max(row["farthest"] for row in own)
            print(
                f"{name:10} lifted {lifted}, kept {kept} of {len(own)}; farthest ball {farthest:.0f} mm; "
                f"{aside:.1f} cm sideways, {over:.1f} cm above the goal"
            )
    elif part == "hover":
        print(f"{'case':34} {'RMSE mm':>8} {'along':>6} {'height':>6} {'tilt':>6} {'steady':>7}  worst of the seeds")
        for name in dict.fromkeys(row["case"] for row in rows):
            own = [row for row in rows if row["case"] == name]
            worst = {
                key: max(row.get(key, math.inf) for row in own) for key in ("rmse", "along", "height", "tilt", "steady")
            }
            print(f"{name:34} " + "{rmse:8.1f} {along:6.1f} {height:6.1f} {tilt:6.1f} {steady:7.1f}".format(**worst))
    else:
        kept = sum(row["kept"] for row in rows)
        rms = statistics.median(row["ball_rms"] for row in rows if row["kept"]) if kept else math.nan
        print(f"ball kept in {kept} of {len(rows)}; ball {1e3 * rms:.1f} mm rms (median of those)")
        landed = [row["touchdown"] for row in rows if math.isfinite(row["touchdown"])]
        good = sum(row["code"] == 0 for row in rows)
        print(f"exit code 0 in {good}, hardest touchdown {max(landed, default=math.nan):.2f} m/s")


def main() -> int:
    """Run what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", nargs="+", default=["flights", "ground", "hover", "stand"])
    parser.add_argument("--flight", type=Path, default=shipped_policy("flight"))
    parser.add_argument("--stand", type=Path, default=shipped_policy("stand"))
    parser.add_argument("--universal", type=Path, default=shipped_policy("universal"))
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--starts", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="number of the stand's first random start")
    parser.add_argument("--seeds", type=int, default=3, help="of every hover")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    return campaign("fly_firmware", options, jobs_of(options), table)


if __name__ == "__main__":
    sys.exit(main())
