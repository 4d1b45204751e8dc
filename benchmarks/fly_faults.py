"""Fault campaign: real runner processes, real cflib, a twin for each, one fault at a random moment in each flight.

`python benchmarks/fly_faults.py [--policy FILE] [--trials 200] [--jobs 2] [--seed 0] [--json FILE] [--only KIND ...]`

By the twin's true state: safe means that both drones' motors are off and stay off for two seconds, beyond the
firmware's own watchdog. The physics are the twin's (`mjxball/fly/twin/physics.py`); no radio is involved.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import json
import math
import multiprocessing
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mjxball.fly import flight_log, packets
from mjxball.fly.process import urgent
from mjxball.fly.twin.conditions import FAULT_KINDS, Injection, LinkFaults
from mjxball.fly.twin.physics import make_pair
from mjxball.fly.twin.server import Truth, Twin
from mjxball.policy import load_file

ROOT = Path(__file__).parents[1]
POLICY = ROOT / "policies" / "archive" / "transport.npz"
LATEST = 4.0  # [s] after the motors first turn: ramp, flight and landing are all hit
FLOWN = 2.0  # [s] under both laws
Runner = subprocess.Popen
Action = Callable[[Twin, Runner, int], None]  # twin, runner, drone


def link(**faults: float) -> Action:
    """A fault of one drone's link."""
    return lambda twin, runner, drone: twin.inject(Injection(LinkFaults(**faults), drone, 0.0))


def injected(kind: str) -> Action:
    """What `mjxball.fly --rehearse --fault` can bring about."""
    return lambda twin, runner, drone: twin.inject(Injection(FAULT_KINDS[kind], drone, 0.0))


def both(kind: str) -> Action:
    """The same fault of both drones."""

    def inject(twin: Twin, runner: Runner, number: int) -> None:
        for drone in range(2):
            twin.inject(Injection(FAULT_KINDS[kind], drone, 0.0))

    return inject


def host(*numbers: int) -> Action:
    """Signals to the runner, a tenth of a second apart."""

    def inject(twin: Twin, runner: Runner, number: int) -> None:
        for one in numbers:
            runner.send_signal(one)
            time.sleep(0.1)

    return inject


def watchdog_killed(twin: Twin, runner: Runner, number: int) -> None:
    """The watchdog process ends before the runner does."""
    with contextlib.suppress(OSError):
        for child in Path(f"/proc/{runner.pid}/task/{runner.pid}/children").read_text(encoding="ascii").split():
            os.kill(int(child), signal.SIGKILL)


KINDS: dict[str, Action] = {
    "link silent": injected("silent"),
    "link silent downward": injected("silent-down"),
    "link silent upward": injected("silent-up"),
    "link loses 30 %": link(loss=0.3),
    "link loses 95 %": link(loss=0.95),
    "link 50 ms late": link(delay=0.05),
    "link 300 ms late": link(delay=0.3),
    "link jitters 200 ms": link(jitter=0.2),
    "port closed": injected("port"),
    "drone without power": injected("power"),
    "drone crashed": injected("crash"),
    "drone reboots": injected("reboot"),
    "estimator frozen": injected("frozen"),
    "clock stopped": injected("clock"),
    "position jumps 0.4 m": injected("jump"),
    "battery empty": injected("battery"),
    "hostile datagrams": injected("garbage"),
    "firmware stopped": injected("stopped"),
    "firmware killed, outputs held": injected("killed"),
    "stabilizer task dead": injected("stabilizer"),
    "IMU dead": injected("imu"),
    "pose frozen": injected("pose-frozen"),
    "pose lost": injected("pose-lost"),
    "both poses lost": both("pose-lost"),
    "pose jumps 0.4 m": injected("pose-jump"),
    "battery sags to 3.0 V": both("sag"),
    "motors 10 % weaker": injected("weak"),
    "runner: Ctrl-C": host(signal.SIGINT),
    "runner: Ctrl-C twice": host(signal.SIGINT, signal.SIGINT),
    "runner: SIGTERM": host(signal.SIGTERM),
    "runner: kill -9": host(signal.SIGKILL),
    "runner: stopped": host(signal.SIGSTOP),
    "watchdog: kill -9": watchdog_killed,
}


def trial(job: tuple[int, str, int, Path]) -> dict[str, Any]:
    """Fly once with one fault of a kind; what became of it."""
    number, kind, seed, policy = job
    random = np.random.default_rng([seed, number])
    which, moment = int(random.integers(2)), float(random.uniform(0, LATEST))
    row: dict[str, Any] = {"kind": kind, "drone": which, "moment": moment}
    with tempfile.TemporaryDirectory() as place, urgent(), Twin(make_pair(load_file(policy).card)) as twin:
        log = Path(place) / "flight.jsonl"
        uris = ["--leader", twin.uris[0], "--follower", twin.uris[1]]
        command = [sys.executable, "-m", "mjxball.fly", str(policy), *uris, "--seconds", str(FLOWN), "--log", str(log)]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
        surroundings = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        with subprocess.Popen(command, env=surroundings, **quiet) as runner:
            try:
                if not running(twin, runner):
                    return {**row, "outcome": "not flown"}
                time.sleep(moment)
                injected_at = twin.truth.time
                KINDS[kind](twin, runner, which)
                evaluated = evaluate(twin, injected_at, expects_end=kind != "runner: stopped", runner=runner)
            finally:
                runner.kill()
                assert runner.stderr is not None
                errors = runner.stderr.read()
        return {**row, **evaluated, **told(log, kind), "stderr": errors.decode(errors="replace")[-300:]}


def running(twin: Twin, runner: Runner) -> bool:
    """Wait until a motor turns; false if the runner ends before."""
    while max(twin.truth.thrust) == 0:
        if runner.poll() is not None:
            return False
        time.sleep(0.005)
    return True


def evaluate(twin: Twin, injected_at: float, expects_end: bool, runner: Runner) -> dict[str, Any]:
    """Watch until the motors have been off for two seconds, for twenty at most, and say how it went."""
    off_since = None
    while twin.truth.time < injected_at + 20:
        truth = twin.truth
        off_since = (off_since or truth.time) if truth.pwm.max() == 0 else None
        if off_since is not None and truth.time - off_since > 2.0:
            break
        time.sleep(0.005)
    after = [truth for truth in twin.history if truth.time >= injected_at]
    if off_since is None:
        return {"outcome": "UNSAFE: a motor still turns", "safe": False}
    cut = next((truth for truth in after if truth.time >= off_since - 0.06), after[-1])
    flown = [truth for truth in after if truth.time <= off_since]
    height = float(cut.state.position[:, 2].mean())
    hung = False
    if expects_end:
        try:
            runner.wait(timeout=15)
        except subprocess.TimeoutExpired:
            hung = True
    return {
        "outcome": "down, level" if height < 0.06 and worst_tilt(flown) < 35 else "motors off",
        "safe": twin.failure is None and not hung,
        "hung": hung,
        "seconds": max(off_since - injected_at, 0.0),
        "cut_height": height,
        "worst_tilt": worst_tilt(flown),
        "highest_thrust": max((max(truth.thrust) for truth in after), default=0),
        "locked": sum(bool(info & packets.LOCKED) for info in twin.truth.info),
        "code": runner.poll(),
    }


def worst_tilt(truths: list[Truth]) -> float:
    """Largest angle between body z and up [degrees]."""
    shares = [packets.level_share(truth.state.quaternion[0]) for truth in truths] or [1.0]
    return math.degrees(math.acos(min(max(min(shares), -1.0), 1.0)))


def told(log: Path, kind: str) -> dict[str, Any]:
    """What the flight log says: the way through the states, the cause, and whether it is whole."""
    remarks: list[str] = []
    records = list(flight_log.read(log, remarks.append)) if log.exists() else []
    ends = [record for record in records if record["kind"] == "end"]
    cut_short = kind in ("runner: kill -9", "runner: stopped")
    states = [record["after"] for record in records if record["kind"] == "transition"]
    cause = ends[-1]["cause"].split(":")[0].split(".")[-1].strip(" <>'") if ends and ends[-1]["cause"] else ""
    whole = len(remarks) <= cut_short and (bool(ends) or cut_short)  # a killed writer may leave its last line torn
    return {"states": states, "cause": cause, "log_complete": whole}


def summary(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """One line per kind."""
    lines = []
    for kind in KINDS:
        own = [row for row in rows if row["kind"] == kind and "seconds" in row]
        if not own:
            continue
        seconds = [row["seconds"] for row in own]
        firsts = collections.Counter(first_abort(row) for row in own)
        lines.append(
            {
                "kind": kind,
                "trials": len(own),
                "safe": sum(row["safe"] for row in own),
                "landed": sum(row["outcome"] == "down, level" for row in own),
                "median": statistics.median(seconds),
                "largest": max(seconds),
                "cut_height": max(row["cut_height"] for row in own),
                "worst_tilt": max(row["worst_tilt"] for row in own),
                "logs": sum(row["log_complete"] for row in own),
                "way": ", ".join(f"{name} {count}" for name, count in firsts.most_common(3)),
            }
        )
    return lines


def first_abort(row: dict[str, Any]) -> str:
    """First state beyond normal flight, or what was flown to its end."""
    for state in row["states"]:
        if state in ("descend", "hold", "kill") or (state == "stop" and "land" not in row["states"]):
            return state
    return "land" if "land" in row["states"] else "watchdog"


def main() -> int:
    """Run the campaign; exit code 1 if any trial was not safe or any log not complete."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", type=Path, default=POLICY, metavar="FILE", help="its card names the twin's physics")
    parser.add_argument("--trials", type=int, default=207, help="flights in all, spread evenly over the kinds")
    parser.add_argument("--jobs", type=int, default=2, help="flights at the same time")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path, metavar="FILE")
    parser.add_argument("--only", nargs="+", choices=KINDS, default=list(KINDS), metavar="KIND")
    options = parser.parse_args()
    jobs = [(n, options.only[n % len(options.only)], options.seed, options.policy) for n in range(options.trials)]
    started, rows = time.monotonic(), []
    with multiprocessing.get_context("spawn").Pool(options.jobs, maxtasksperchild=20) as pool:
        for row in pool.imap_unordered(trial, jobs):
            rows.append(row)
            print(f"{len(rows):4d} {row['kind']:24} {row['outcome']:28} {row.get('seconds', 0):6.2f} s", flush=True)
    lines = summary(rows)
    heads = ("n", 4), ("safe", 6), ("level", 7), ("median s", 10), ("max s", 8), ("cut m", 7), ("tilt", 6), ("logs", 6)
    print(f"\n{'kind':24}" + "".join(f"{head:>{width}}" for head, width in heads) + "  way")
    for line in lines:
        numbers = f"{line['median']:10.2f}{line['largest']:8.2f}{line['cut_height']:7.2f}{line['worst_tilt']:6.0f}"
        counts = f"{line['trials']:4d}{line['safe']:6d}{line['landed']:7d}"
        print(f"{line['kind']:24}{counts}{numbers}{line['logs']:6d}  {line['way']}")
    flown = [row for row in rows if "seconds" in row or row["outcome"].startswith("UNSAFE")]
    bad = [row for row in flown if not (row.get("safe") and row.get("log_complete"))]
    refused = len(rows) - len(flown)
    print(f"{len(flown)} flown, {refused} refused on the ground, {len(bad)} not safe or without a whole log")
    if options.json:
        physics = type(make_pair(load_file(options.policy).card)).__name__
        whole = {"policy": options.policy.stem, "physics": physics, "seconds": time.monotonic() - started}
        options.json.write_text(
            json.dumps({**whole, "summary": lines, "trials": rows}, indent=1) + "\n", encoding="utf-8"
        )
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
