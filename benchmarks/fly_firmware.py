"""The runner on the twin in virtual time: landings in a row, hover under bad conditions, the stand, faults.

`python benchmarks/fly_firmware.py [--parts flights hover stand faults] [--flight FILE] [--stand FILE] [--jobs N]
[--starts 100] [--trials 4] [--json FILE]`

The runner's own flight (supervisor, laws, watches) flies the twin of a pair of Crazyflie 2.1 as delivered, without
sockets or clock. Numbers are of the twin's true state.

- flights: 20 in a row of the same two drones without reboot; landed below 0.5 m/s, exit code 0.
- hover: 20 s at 0.4 m, errors from 5 s on, for link delay, force curve, sensor noise, pose rate and thrust gains; the
  steady command is the mean of what a drone is sent less what the pair flies, the larger of roll and pitch.
- stand: 60 s from random balls, rolls and heights (ranges of the preset `stand`); kept if the ball touches no stop.
- faults: hover at 0.4 m, a fault at a random moment of the flight or the landing; seconds until each drone's motors are
  off, speed at the first contact, largest tilt and drift between the fault and then.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import statistics
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from mjxball.config import preset
from mjxball.fly.card import Controller, goal_of, times_of
from mjxball.fly.limits import FlightSettings, Limits
from mjxball.fly.supervisor import State
from mjxball.fly.twin.conditions import (
    FAULT_KINDS,
    Conditions,
    Surroundings,
    drone_kind,
)
from mjxball.fly.twin.virtual import MemoryLog, Moment, VirtualTwin
from mjxball.physics.step import start_state
from mjxball.policy import Policy
from mjxball.policy.file import shipped_policy

SETTLED, HOVER = 5.0, 20.0  # [s]
SETTLE = 1.0  # [s] that estimators get before a flight, as the check before a real one gives them
Row = dict[str, Any]


def settings_of(policy: Policy, seconds: float) -> FlightSettings:
    """What the command line would make of `policy`'s card."""
    config = Controller(policy).config
    goal, stand = goal_of(config), config.plant.stand != "free"
    bounds = Limits().on_stand(goal[2]) if stand else Limits()
    return FlightSettings(seconds, goal, stand=stand, limits=bounds, times=times_of(config))


def world_of(path: Path, seconds: float, curve: str = "linear", record: bool = True, **around: Any) -> VirtualTwin:
    """A flight of the policy in `path` that is about to begin."""
    policy = Policy.load(path)
    drone = drone_kind("2.1", curve)
    surroundings = Surroundings(**around)
    return VirtualTwin(
        policy,
        settings_of(policy, seconds),
        kind=drone,
        surroundings=surroundings,
        log=MemoryLog(record),
        settle=SETTLE,
    )


def code_of(world: VirtualTwin) -> int:
    """The exit code that the runner's command would have."""
    flight = world.flight
    return 0 if flight.supervisor.cause is None and flight.lifted and flight.supervisor.state is State.DONE else 1


# Parts: each yields jobs (function, arguments), each of which returns a row.


def flights_in_a_row(path: Path, count: int) -> list[Row]:
    """Take off, fly 5 s, land, `count` times with the same drones."""
    world, rows = world_of(path, 5.0), []
    for number in range(count):
        if number:
            world.track.clear()
            world.next_flight()
        world.run(60.0)
        cause = world.flight.supervisor.cause
        rows.append(
            {
                "policy": path.stem,
                "flight": number + 1,
                "code": code_of(world),
                "cause": "" if cause is None else f"{cause.event.name} {cause.detail}",
                "touchdown": world.touchdown_speed(),
                "locked": any(drone.firmware.info & 0x40 for drone in world.drones),
            }
        )
    return rows


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
        cause = world.flight.supervisor.cause
        return [{**row, "cause": str(cause), "rmse": math.inf, "tilt": 180.0, "steady": 180.0}]
    late = [moment for moment in flown if moment.time - flown[0].time >= SETTLED]
    goal = world.flight._origin + np.array(world.settings.goal)
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
    cause = world.flight.supervisor.cause
    return [
        {
            **row,
            "kept": bool(farthest < stop and seconds > 59.0),
            "ball_rms": _rms([moment.ball / share for moment in late]),
            "roll_rms": _rms([moment.roll for moment in late]),
            "cause": "" if cause is None else f"{cause.event.name} {cause.detail}",
            "touchdown": world.touchdown_speed(),
            "code": code_of(world),
        }
    ]


Injection = Callable[[VirtualTwin, int], None]


def injected(kind: str) -> Injection:
    """A fault of `FAULT_KINDS` in virtual time."""
    return lambda world, drone: world.drones[drone].inject(FAULT_KINDS[kind])


def both(kind: str) -> Injection:
    """The same fault of both drones at once."""

    def inject(world: VirtualTwin, drone: int) -> None:
        for number in range(2):
            injected(kind)(world, number)

    return inject


def link(**faults: float) -> Injection:
    """A fault of one drone's link."""
    return lambda world, drone: world.fault_link(drone, **faults)


def gap(seconds: float) -> Injection:
    """States of both drones break off for a while."""

    def inject(world: VirtualTwin, drone: int) -> None:
        for number in range(2):
            world.fault_link(number, silent_down=True)
        world.flight.note("gap", world.now)
        world.later = (world.now + seconds, lambda: [world.fault_link(n, silent_down=False) for n in range(2)])  # type: ignore[attr-defined]

    return inject


def asked(**how: Any) -> Injection:
    """What a person does."""

    def inject(world: VirtualTwin, drone: int) -> None:
        for name, value in how.items():
            setattr(world.flight, name, value)

    return inject


FAULTS: dict[str, Injection] = {
    "firmware stopped": injected("stopped"),
    "drone without power": injected("power"),
    "killed, outputs held": injected("killed"),
    "IMU dead": injected("imu"),
    "stabilizer dead": injected("stabilizer"),
    "link silent": injected("silent"),
    "uplink silent": injected("silent-up"),
    "downlink silent": injected("silent-down"),
    "both links silent": both("silent"),
    "30 % of the packets lost": both("loss"),
    "95 % of the packets lost": link(loss=0.95),
    "50 ms late": link(delay=0.05),
    "300 ms late": link(delay=0.3),
    "jitter of 200 ms": link(jitter=0.2),
    "gap of 110 ms in the states": gap(0.11),
    "gap of 400 ms in the states": gap(0.4),
    "pose frozen": injected("pose-frozen"),
    "pose lost": injected("pose-lost"),
    "both poses frozen": both("pose-frozen"),
    "both poses lost": both("pose-lost"),
    "pose jumps 0.4 m": injected("pose-jump"),
    "reported position jumps 0.4 m": injected("jump"),
    "reported state frozen": injected("frozen"),
    "clock stopped": injected("clock"),
    "battery sags to 3.0 V": injected("sag"),
    "battery reads 1.2 V less": injected("battery"),
    "thrust 10 % weaker": injected("weak"),
    "drone crashed": injected("crash"),
    "drone reboots": injected("reboot"),
    "hostile datagrams": injected("garbage"),
    "Ctrl-C": asked(interrupts=1),
    "Ctrl-C twice": asked(interrupts=2),
}


def fault(path: Path, kind: str, drone: int, number: int) -> list[Row]:
    """One flight with one fault."""
    random = np.random.default_rng([list(FAULTS).index(kind), drone, number])
    world = world_of(path, 6.0, seed=number)
    world.later = (math.inf, None)  # type: ignore[attr-defined]
    world.fly_until(State.FLY)
    world.fly_for(float(random.uniform(3.0, 7.0)))
    at = world.now
    FAULTS[kind](world, drone)
    while world.now < at + 25.0:
        if world.now >= world.later[0]:  # type: ignore[attr-defined]
            world.later[1]()  # type: ignore[attr-defined]
            world.later = (math.inf, None)  # type: ignore[attr-defined]
        if not world.tick():
            break
    for _ in range(250):  # whatever turns must stop by itself
        world.advance(0.02)
        world.track.append(world.moment())
    after = [moment for moment in world.track if moment.time >= at]
    return [{"policy": path.stem, "fault": kind, "drone": ("leader", "follower")[drone], **evaluated(world, after, at)}]


def evaluated(world: VirtualTwin, after: Sequence[Moment], at: float) -> Row:
    """What became of a flight after its fault at `at` [s]."""
    running = np.array([moment.pwm.max(axis=1) > 0 for moment in after])
    off = [float(after[int(np.nonzero(one)[0][-1])].time - at) if one.any() else 0.0 for one in running.T]
    start = after[0].position
    down = next((i for i, moment in enumerate(after) if moment.position[2] < world.rest + 0.006), len(after) - 1)
    until = after[: down + 1]
    cause = world.flight.supervisor.cause
    return {
        "height": float(start[2] - world.rest),
        "off": off,
        "stopped": not running[-1].any(),
        "speed": float(max(0.0, *(-moment.velocity[2] for moment in after[max(down - 3, 0) : down + 1]))),
        "tilt": math.degrees(max(moment.tilt for moment in until)),
        "drift": float(np.linalg.norm(after[down].position[:2] - start[:2])),
        "cause": "" if cause is None else cause.event.name,
        "code": code_of(world),
    }


def _rms(values: Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else math.nan


def jobs_of(options: argparse.Namespace) -> Iterator[tuple[str, Callable[..., list[Row]], tuple[Any, ...]]]:
    """(part, function, arguments) of everything that is asked for, the longest first."""
    if "flights" in options.parts:
        yield from (("flights", flights_in_a_row, (path, 20)) for path in (options.stand, options.flight))
    if "stand" in options.parts:
        yield from (
            ("stand", stand_start, (options.stand, number))
            for number in range(options.first, options.first + options.starts)
        )
    if "hover" in options.parts:
        yield from (
            ("hover", hover, (options.flight, name, around, seed))
            for name, around in HOVERS
            for seed in range(options.seeds)
        )
    if "faults" in options.parts:
        yield from (
            ("faults", fault, (options.flight, kind, drone, number))
            for kind in FAULTS
            for drone in range(2)
            for number in range(options.trials)
        )


def _run(job: tuple[str, Callable[..., list[Row]], tuple[Any, ...]]) -> tuple[str, list[Row]]:
    part, function, arguments = job
    return part, function(*arguments)


def table(part: str, rows: Sequence[Row]) -> None:
    """Print a part's rows, put together."""
    print(f"\n{part}")
    if part == "flights":
        for name in dict.fromkeys(row["policy"] for row in rows):
            own = [row for row in rows if row["policy"] == name]
            fastest = max(row["touchdown"] for row in own)
            good = sum(row["code"] == 0 for row in own)
            print(f"{name:10} {good} of {len(own)} with exit code 0, hardest touchdown {fastest:.2f} m/s")
    elif part == "hover":
        print(f"{'case':34} {'RMSE mm':>8} {'along':>6} {'height':>6} {'tilt':>6} {'steady':>7}  worst of the seeds")
        for name in dict.fromkeys(row["case"] for row in rows):
            own = [row for row in rows if row["case"] == name]
            worst = {
                key: max(row.get(key, math.inf) for row in own) for key in ("rmse", "along", "height", "tilt", "steady")
            }
            print(f"{name:34} " + "{rmse:8.1f} {along:6.1f} {height:6.1f} {tilt:6.1f} {steady:7.1f}".format(**worst))
    elif part == "stand":
        kept = sum(row["kept"] for row in rows)
        rms = statistics.median(row["ball_rms"] for row in rows if row["kept"]) if kept else math.nan
        print(f"ball kept in {kept} of {len(rows)}; ball {1e3 * rms:.1f} mm rms (median of those)")
        landed = [row["touchdown"] for row in rows if math.isfinite(row["touchdown"])]
        good = sum(row["code"] == 0 for row in rows)
        print(f"exit code 0 in {good}, hardest touchdown {max(landed, default=math.nan):.2f} m/s")
    else:
        print(f"{'fault':42} {'off L / F s':>12} {'speed m/s':>12} {'tilt deg':>12} {'drift m':>12}  median, worst")
        for name in dict.fromkeys((row["fault"], row["drone"]) for row in rows):
            own = [row for row in rows if (row["fault"], row["drone"]) == name]
            off = [statistics.median(row["off"][n] for row in own) for n in range(2)]
            parts = [
                f"{statistics.median(row[key] for row in own):5.2f} {max(row[key] for row in own):6.2f}"
                for key in ("speed", "tilt", "drift")
            ]
            bad = "" if all(row["stopped"] for row in own) else "  A MOTOR STILL TURNS"
            print(
                f"{' '.join((name[1], name[0])):32} {off[0]:6.2f} / {off[1]:5.2f} {parts[0]} {parts[1]} {parts[2]}{bad}"
            )


def main() -> int:
    """Run what is asked for; returns 1 if a motor still turned."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--parts", nargs="+", default=["flights", "hover", "stand", "faults"])
    parser.add_argument("--flight", type=Path, default=shipped_policy("flight"))
    parser.add_argument("--stand", type=Path, default=shipped_policy("stand"))
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--starts", type=int, default=100)
    parser.add_argument("--first", type=int, default=0, help="number of the stand's first random start")
    parser.add_argument("--seeds", type=int, default=3, help="of every hover")
    parser.add_argument("--trials", type=int, default=4)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    found: dict[str, list[Row]] = {part: [] for part in options.parts}
    jobs = list(jobs_of(options))
    with multiprocessing.get_context("spawn").Pool(options.jobs) as pool:
        for number, (part, rows) in enumerate(pool.imap_unordered(_run, jobs), 1):
            found[part] += rows
            print(f"\r{number} of {len(jobs)}", end="", file=sys.stderr, flush=True)
    for part, rows in found.items():
        table(part, rows)
    if options.json:
        command = "python benchmarks/fly_firmware.py " + " ".join(sys.argv[1:])
        options.json.write_text(json.dumps({"command": command, **found}, indent=1) + "\n", encoding="utf-8")
    return 0 if all(row["stopped"] for row in found.get("faults", [])) else 1


if __name__ == "__main__":
    sys.exit(main())
