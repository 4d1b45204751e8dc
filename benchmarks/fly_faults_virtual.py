"""Faults of the twin in virtual time: hover at 0.4 m, a fault at a random moment, at the leader and at the follower.

`python benchmarks/fly_faults_virtual.py [--policy FILE] [--trials 1] [--jobs 2] [--only FAULT ...] [--json FILE]`

Measured are the seconds until each drone's motors are off, speed at the first contact, largest tilt and drift between
the fault and then. The table in docs/flying.md is made from benchmarks/results/fly_faults_virtual.json.
`fly_faults.py` is the same by the clock, with sockets.
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import statistics
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjxball.fly.supervisor import State
from mjxball.fly.twin.conditions import FAULT_KINDS
from mjxball.fly.twin.virtual import Moment, VirtualTwin
from mjxball.policy.file import shipped_policy
from virtual_flight import Row, code_of, world_of

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


def laptop_killed(world: VirtualTwin, drone: int) -> None:
    """The laptop sends nothing any more; its watchdog process is not part of the virtual twin."""
    world.killed = True  # type: ignore[attr-defined]


ONBOARD: dict[str, Injection] = {"laptop killed": laptop_killed, "heartbeat lost": injected("peer")}  # with apps only
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
    "both batteries sag to 3.0 V": both("sag"),
    "battery loses 0.5 V/s": injected("fade"),
    "battery reads 1.2 V less": injected("battery"),
    "thrust 10 % weaker": injected("weak"),
    "drone crashed": injected("crash"),
    "drone reboots": injected("reboot"),
    "hostile datagrams": injected("garbage"),
    **ONBOARD,
    "Ctrl-C": asked(interrupts=1),
    "Ctrl-C twice": asked(interrupts=2),
}


SETTLED, HOVER = 3.0, 6.0  # [s] under both laws, until a fault may come and until the flight lands


def fault(path: Path, kind: str, drone: int, number: int, onboard: str = "") -> list[Row]:
    """One flight with one fault; `onboard` as for `world_of`."""
    world = hovering(path, number, onboard)
    world.fly_for(moment_of(kind, drone, number))
    return finish(world, path, kind, drone)


def moment_of(kind: str, drone: int, number: int) -> float:
    """When a fault comes, after `SETTLED` [s]: at random."""
    random = np.random.default_rng([list(FAULTS).index(kind), drone, number])
    return float(random.uniform(0.0, HOVER - SETTLED - 1.0))


def hovering(path: Path, number: int, onboard: str = "") -> VirtualTwin:
    """The pair `SETTLED` [s] under both laws."""
    world = world_of(path, HOVER, onboard=onboard, seed=number)
    world.killed = False  # type: ignore[attr-defined]
    world.later = (math.inf, None)  # type: ignore[attr-defined]
    world.fly_until(State.FLY)
    world.fly_for(SETTLED)
    return world


def finish(world: VirtualTwin, path: Path, kind: str, drone: int) -> list[Row]:
    """The rest of the flight, with the fault now."""
    at = world.now
    FAULTS[kind](world, drone)
    while world.now < at + 15.0:
        if world.now >= world.later[0]:  # type: ignore[attr-defined]
            world.later[1]()  # type: ignore[attr-defined]
            world.later = (math.inf, None)  # type: ignore[attr-defined]
        if world.killed:  # type: ignore[attr-defined]
            world.advance(0.02)
            world.track.append(world.moment())
        elif not world.tick():
            break
    for _ in range(125):  # whatever turns must stop by itself
        world.advance(0.02)
        world.track.append(world.moment())
    after = [moment for moment in world.track if moment.time >= at]
    return [{"policy": path.stem, "fault": kind, "drone": ("leader", "follower")[drone], **evaluated(world, after, at)}]


def all_of(options: argparse.Namespace) -> list[Row]:
    """Every fault at each drone, in processes that branch off one hover for each trial; written as far as it came."""
    context, rows = multiprocessing.get_context("fork"), []
    for number in range(options.trials):
        flown = sorted((moment_of(kind, drone, number), kind, drone) for kind in options.only for drone in range(2))
        world, passed = hovering(options.policy, number), 0.0
        running: list[Any] = []
        for moment, kind, drone in [*flown, (math.inf, "", 0)]:
            while running and (len(running) >= options.jobs or math.isinf(moment)):
                child, end = running.pop(0)
                rows += end.recv()
                child.join()
                print(f"\r{len(rows)} of {len(flown) * options.trials}", end="", file=sys.stderr, flush=True)
                write(options.json, sorted(rows, key=lambda row: list(FAULTS).index(row["fault"])))
            if math.isfinite(moment):
                world.fly_for(moment - passed)
                passed = moment
                ours, theirs = context.Pipe(duplex=False)
                child = context.Process(target=_send, args=(theirs, world, options.policy, kind, drone))
                child.start()
                theirs.close()
                running.append((child, ours))
    return rows


def _send(end: Any, *arguments: Any) -> None:
    end.send(finish(*arguments))


def write(path: Path | None, rows: Sequence[Row]) -> None:
    """Put `rows` into the file at `path`, if one is wanted."""
    if path is not None:
        command = f"python benchmarks/fly_faults_virtual.py {' '.join(sys.argv[1:])}"
        path.write_text(json.dumps({"command": command, "faults": rows}, indent=1) + "\n", encoding="utf-8")


def evaluated(world: VirtualTwin, after: Sequence[Moment], at: float) -> Row:
    """What became of a flight after its fault at `at` [s]."""
    running = np.array([moment.pwm.max(axis=1) > 0 for moment in after])
    off = [float(after[int(np.nonzero(one)[0][-1])].time - at) if one.any() else 0.0 for one in running.T]
    start = after[0].position
    down = next((i for i, moment in enumerate(after) if moment.position[2] < world.rest + 0.006), len(after) - 1)
    until = after[: down + 1]
    cause = world.flight.supervisor.cause
    found = {
        "height": float(start[2] - world.rest),
        "off": [round(one, 4) for one in off],
        "stopped": not running[-1].any(),
        "speed": float(max(0.0, *(-moment.velocity[2] for moment in after[max(down - 3, 0) : down + 1]))),
        "tilt": math.degrees(max(moment.tilt for moment in until)),
        "drift": float(np.linalg.norm(after[down].position[:2] - start[:2])),
        "cause": "" if cause is None else cause.event.name,
        "way": [one["after"] for one in world.log.records if one["kind"] == "transition" and one["t"] >= at],
        "told": world.flight.how_it_ended(),
        "code": code_of(world),
    }
    return {name: round(value, 4) if isinstance(value, float) else value for name, value in found.items()}


def table(rows: Sequence[Row]) -> None:
    """Print median and worst of each fault, of leader and follower."""
    print(f"{'fault':42} {'off L / F s':>12} {'speed m/s':>12} {'tilt deg':>12} {'drift m':>12}  median, worst")
    for name in dict.fromkeys((row["fault"], row["drone"]) for row in rows):
        own = [row for row in rows if (row["fault"], row["drone"]) == name]
        off = [statistics.median(row["off"][n] for row in own) for n in range(2)]
        parts = [
            f"{statistics.median(row[key] for row in own):5.2f} {max(row[key] for row in own):6.2f}"
            for key in ("speed", "tilt", "drift")
        ]
        bad = "" if all(row["stopped"] for row in own) else "  A MOTOR STILL TURNS"
        print(f"{' '.join((name[1], name[0])):32} {off[0]:6.2f} / {off[1]:5.2f} {parts[0]} {parts[1]} {parts[2]}{bad}")


def main() -> int:
    """Run the campaign; returns 1 if a motor still turned."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policy", type=Path, default=shipped_policy("flight"), metavar="FILE")
    parser.add_argument("--trials", type=int, default=1, help="flights of each fault at each drone")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", nargs="+", choices=FAULTS, default=[one for one in FAULTS if one not in ONBOARD])
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    rows = all_of(options)
    table(sorted(rows, key=lambda row: list(FAULTS).index(row["fault"])))
    return 0 if all(row["stopped"] for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
