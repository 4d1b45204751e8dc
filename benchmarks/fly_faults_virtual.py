"""Faults of the twin in virtual time: hover at 0.4 m, a fault at a random moment, at the leader and at the follower.

Without sockets or clock. Measured are the seconds until each drone's motors are off, speed at the first contact,
largest tilt and drift between the fault and then. The table in docs/flying.md is made from
benchmarks/results/fly_faults_virtual.json. `--onboard float32` (or `int8`) has the controllers on the drones, in the
apps' own C, compiled by gcc: a dead laptop and a lost heartbeat are faults as well then.

`--positioning` flies each positioning system of the twin instead, without a fault and with a pose lost: the error of O
in hover after `SETTLING` seconds. A flow deck, which the runner refuses, flies with its guards wide open. The table in
docs/hardware.md is made from benchmarks/results/fly_positioning.json.
"""

from __future__ import annotations

import argparse
import functools
import math
import multiprocessing
import statistics
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from harness import Row, arguments, table, write
from mjxball.policy import Policy, load_file
from mjxball.policy.file import policy_path, shipped_policy
from mjxball.running import run_command
from mjxfly.app.host import Library, compile_pair
from mjxfly.classical import ClassicalFollower
from mjxfly.controller import FlightController
from mjxfly.figures import SETTLING
from mjxfly.limits import FlightSettings
from mjxfly.policy_setup import goal_of, limits_of, load_follower, times_of
from mjxfly.supervisor import FlightState
from mjxfly.twin.conditions import FAULT_KINDS, POSITIONING, Surroundings, drone_kind
from virtual_twin import MemoryLog, TrueState, VirtualTwin

SETTLE = 1.0  # [s] that estimators get before a flight, as the check before a real one gives them
SETTLED, HOVER = 3.0, 6.0  # [s] under both controllers, until a fault may come and until the flight lands
AXES = ("x", "y", "z")
Injection = Callable[[VirtualTwin, int], None]


def injected(kind: str) -> Injection:
    """A fault of `FAULT_KINDS` in virtual time."""
    return lambda world, drone: world.drones[drone].inject(FAULT_KINDS[kind].what)


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
        world.later = (world.now + seconds, lambda: [world.fault_link(n, silent_down=False) for n in range(2)])

    return inject


def asked(**how: Any) -> Injection:
    """What a person does."""

    def inject(world: VirtualTwin, drone: int) -> None:
        for name, value in how.items():
            setattr(world.flight, name, value)

    return inject


def laptop_killed(world: VirtualTwin, drone: int) -> None:
    """The laptop sends nothing any more; its watchdog process is not part of the virtual twin."""
    world.killed = True


ONBOARD: dict[str, Injection] = {"laptop killed": laptop_killed, "peer": injected("peer")}  # with apps only
FAULTS: dict[str, Injection] = {
    "stopped": injected("stopped"),
    "power": injected("power"),
    "killed": injected("killed"),
    "imu": injected("imu"),
    "stabilizer": injected("stabilizer"),
    "silent": injected("silent"),
    "silent-up": injected("silent-up"),
    "silent-down": injected("silent-down"),
    "both links silent": both("silent"),
    "30 % of the packets lost": both("loss"),
    "95 % of the packets lost": link(loss=0.95),
    "50 ms late": link(delay=0.05),
    "300 ms late": link(delay=0.3),
    "jitter of 200 ms": link(jitter=0.2),
    "gap of 110 ms in the states": gap(0.11),
    "gap of 400 ms in the states": gap(0.4),
    "pose-frozen": injected("pose-frozen"),
    "pose-lost": injected("pose-lost"),
    "both poses frozen": both("pose-frozen"),
    "both poses lost": both("pose-lost"),
    "pose-jump": injected("pose-jump"),
    "jump": injected("jump"),
    "frozen": injected("frozen"),
    "clock": injected("clock"),
    "sag": injected("sag"),
    "both batteries sag to 3.0 V": both("sag"),
    "fade": injected("fade"),
    "battery": injected("battery"),
    "weak": injected("weak"),
    "crash": injected("crash"),
    "reboot": injected("reboot"),
    "garbage": injected("garbage"),
    **ONBOARD,
    "Ctrl-C": asked(interrupts=1),
    "Ctrl-C twice": asked(interrupts=2),
}


def settings_of(policy: Policy | ClassicalFollower, seconds: float) -> FlightSettings:
    """What the command line would make of `policy`'s metadata."""
    config = FlightController(policy).config
    goal, stand = goal_of(config), config.plant.stand != "free"
    return FlightSettings(seconds, goal, stand=stand, limits=limits_of(config, goal), times=times_of(config))


@functools.cache
def cores_of(path: Path, weights: str) -> tuple[Library, Library]:
    """The apps of the policy in `path`, `weights` float32 or int8."""
    return compile_pair(load_file(path), path.stem, weights == "int8")


def hover_on(path: Path, system: str, number: int, fault: str = "") -> Row:
    """A flight of 20 s under both controllers on positioning `system`; `fault` of the leader in its middle."""
    policy = load_follower(path)
    settings = settings_of(policy, 4 * SETTLING)
    if system == "flow":
        settings = replace(settings, limits=replace(settings.limits, variance=math.inf, noise=10.0, stick_error=10.0))
    world = VirtualTwin(policy, settings, surroundings=Surroundings(seed=number, positioning=system), settle=SETTLE)
    if system == "flow":  # its filters begin where the drones stand
        for link_, mount in zip(world.links, world.rig.mounts, strict=True):
            link_.write_parameters({"kalman.initialX": mount[0], "kalman.initialY": mount[1]})
        world.next_flight(0.0, SETTLE)
    start, now = world.state.position.mean(axis=0), 0.0
    if fault:
        world.fly_until(FlightState.FLY)
        world.fly_for(2 * SETTLING)
        now = world.now
        injected(fault)(world, 0)
    world.run()
    flown = [moment for moment in world.track if moment.state == FlightState.FLY.value]
    late = [moment for moment in flown if moment.time > flown[0].time + SETTLING]
    error = np.array([moment.position - start - world.settings.goal for moment in late])
    row = {"positioning": system, "fault": fault, "seed": number, "cause": cause_of(world)}
    row |= {name: 1000 * float(np.sqrt((error[:, axis] ** 2).mean())) for axis, name in enumerate(AXES)}
    row["rms"] = 1000 * float(np.sqrt((error**2).sum(axis=1).mean()))
    row["tilt"] = math.degrees(max(moment.tilt for moment in world.track))
    row["seen"] = flown[-1].time - now if fault and cause_of(world) else None
    return row | {"speed": world.touchdown_speed()}


def positionings(options: argparse.Namespace) -> list[Row]:
    """`hover_on` every system, `options.trials` times; the first flight of each with a pose lost as well."""
    runs = [(options.policy, system, number, "") for system in POSITIONING for number in range(options.trials)]
    runs += [(options.policy, system, 0, "pose-lost") for system in POSITIONING[:-1]]
    with multiprocessing.get_context("fork").Pool(options.jobs) as pool:
        return pool.starmap(hover_on, runs, chunksize=1)


def hovering(path: Path, number: int, onboard: str = "") -> VirtualTwin:
    """The pair `SETTLED` [s] under both controllers, which are `onboard` (float32, int8) or on the laptop."""
    policy = load_follower(path)
    world = VirtualTwin(
        policy,
        settings_of(policy, HOVER),
        kind=drone_kind(FlightController(policy).config.autopilot.drone.removesuffix("-legacy") or "2.1", "linear"),
        surroundings=Surroundings(seed=number),
        log=MemoryLog(True),
        settle=SETTLE,
        cores=cores_of(path, onboard) if onboard else None,
    )
    world.killed, world.later = False, (math.inf, None)
    world.fly_until(FlightState.FLY)
    world.fly_for(SETTLED)
    return world


def code_of(world: VirtualTwin) -> int:
    """The exit code that the runner's command would have."""
    flight = world.flight
    return 0 if flight.supervisor.cause is None and flight.lifted and flight.supervisor.state is FlightState.DONE else 1


def cause_of(world: VirtualTwin) -> str:
    """What ended the flight early, empty if nothing did."""
    cause = world.flight.supervisor.cause
    return "" if cause is None else f"{cause.event.name} {cause.detail}"


def moment_of(kind: str, drone: int, number: int) -> float:
    """When a fault comes, after `SETTLED` [s]: at random."""
    random = np.random.default_rng([list(FAULTS).index(kind), drone, number])
    return float(random.uniform(0.0, HOVER - SETTLED - 1.0))


def finish(world: VirtualTwin, path: Path, kind: str, drone: int) -> Row:
    """The rest of the flight, with the fault now."""
    at = world.now
    FAULTS[kind](world, drone)
    while world.now < at + 15.0:
        if world.now >= world.later[0]:
            world.later[1]()
            world.later = (math.inf, None)
        if world.killed:
            world.advance(0.02)
            world.track.append(world.moment())
        elif not world.tick():
            break
    for _ in range(125):  # whatever turns must stop by itself
        world.advance(0.02)
        world.track.append(world.moment())
    after = [moment for moment in world.track if moment.time >= at]
    return {"policy": path.stem, "fault": kind, "drone": ("leader", "follower")[drone], **evaluated(world, after, at)}


def all_of(options: argparse.Namespace) -> list[Row]:
    """Every fault at each drone, in processes that branch off one hover for each trial."""
    context, rows = multiprocessing.get_context("fork"), []
    for number in range(options.trials):
        flown = sorted((moment_of(kind, drone, number), kind, drone) for kind in options.only for drone in range(2))
        world, passed = hovering(options.policy, number, options.onboard), 0.0
        running: list[Any] = []
        for moment, kind, drone in [*flown, (math.inf, "", 0)]:
            while running and (len(running) >= options.jobs or math.isinf(moment)):
                child, end = running.pop(0)
                rows.append(end.recv())
                child.join()
                print(f"\r{len(rows)} of {len(flown) * options.trials}", end="", file=sys.stderr, flush=True)
            if math.isfinite(moment):
                world.fly_for(moment - passed)
                passed = moment
                ours, theirs = context.Pipe(duplex=False)
                child = context.Process(target=_send, args=(theirs, world, options.policy, kind, drone))
                child.start()
                theirs.close()
                running.append((child, ours))
    return sorted(rows, key=lambda row: list(FAULTS).index(row["fault"]))


def _send(end: Any, *arguments: Any) -> None:
    end.send(finish(*arguments))


def evaluated(world: VirtualTwin, after: Sequence[TrueState], at: float) -> Row:
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


def show(rows: Sequence[Row]) -> None:
    """Print medians and worst of each fault, of leader and follower."""
    shown = []
    for name, drone in dict.fromkeys((row["fault"], row["drone"]) for row in rows):
        own = [row for row in rows if (row["fault"], row["drone"]) == (name, drone)]
        line = {"fault": name, "of": drone}
        line |= {f"off {who} s": statistics.median(row["off"][n] for row in own) for n, who in enumerate("LF")}
        for key, unit in (("speed", "m/s"), ("tilt", "deg"), ("drift", "m")):
            line |= {
                f"{key} {unit}": statistics.median(row[key] for row in own),
                "worst " + key: max(r[key] for r in own),
            }
        shown.append(line | {"": "" if all(row["stopped"] for row in own) else "A MOTOR STILL TURNS"})
    table(shown, form=".2f")


def main(given: Sequence[str] | None = None) -> int:
    """Run the campaign; returns 1 if a motor still turned."""
    parser = arguments(__file__, __doc__)
    parser.add_argument("--policy", type=policy_path, default=shipped_policy("flight"), metavar="FOLLOWER")
    parser.add_argument("--trials", type=int, default=1, help="flights of each fault at each drone")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", nargs="+", choices=FAULTS, metavar="FAULT", help="these faults alone")
    parser.add_argument("--positioning", action="store_true", help="hover on each positioning system instead")
    parser.add_argument(
        "--onboard", choices=("float32", "int8"), default="", help="the controllers' weights on the drones"
    )
    options = parser.parse_args(given)
    options.only = options.only or [one for one in FAULTS if options.onboard or one not in ONBOARD]
    if options.positioning:
        rows = positionings(options)
        table(rows, form=".1f")
        write(options.json, {"flights": rows})
        return 0
    rows = all_of(options)
    show(rows)
    write(options.json, {"faults": rows})
    return 0 if all(row["stopped"] for row in rows) else 1


if __name__ == "__main__":
    sys.exit(run_command(main))
