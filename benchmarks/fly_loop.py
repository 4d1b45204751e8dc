"""Jitter of the control loop in rehearsals through cflib, idle and under load, and microseconds per policy call.

`python benchmarks/fly_loop.py [--policy FILE] [--seconds 20] [--hogs 0 2] [--json FILE]`

A hog is a process that computes without pause. Lateness is how long after its deadline a tick began.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from mjxball.control.observation import OBSERVATION_SIZE
from mjxball.fly import flight_log
from mjxball.policy import Policy

ROOT = Path(__file__).parents[1]
POLICY = ROOT / "policies" / "archive" / "transport.npz"


def hog(stop: Any) -> None:
    """Compute until told to stop."""
    while not stop.is_set():
        sum(range(10_000))


def rehearse(policy: Path, seconds: float) -> dict[str, Any]:
    """One rehearsal: what its log says of the loop."""
    with tempfile.TemporaryDirectory() as place:
        log = Path(place) / "flight.jsonl"
        command = [sys.executable, "-m", "mjxball.fly", str(policy), "--rehearse", "--seconds", str(seconds)]
        surroundings = {**os.environ, "PYTHONPATH": str(ROOT)}
        more = {"env": surroundings, "capture_output": True, "timeout": seconds + 90, "check": False}
        done = subprocess.run([*command, "--log", str(log)], **more)  # noqa: PLW1510
        records = list(flight_log.read(log))
    late = 1e3 * np.array([record["late"] for record in records if record["kind"] == "tick"])
    ages = 1e3 * np.array([max(record["ages"]) for record in records if record["kind"] == "tick"])
    granted = [record["granted"] for record in records if record["kind"] == "priority"]
    if not len(late):
        return {"code": done.returncode, "ticks": 0}
    share = dict(zip(("median", "p99", "p999"), np.percentile(late, [50, 99, 99.9]).tolist(), strict=True))
    return {
        "code": done.returncode,
        "priority": granted[-1] if granted else "nothing",
        "ticks": len(late),
        "missed": int((late // 10).sum()),
        **share,
        "largest": float(late.max()),
        "state_age_p99": float(np.percentile(ages, 99)),
    }


def microseconds(path: Path, calls: int = 3000) -> float:
    """Median time of one policy call [us]."""
    policy, draw = Policy.load(path), np.random.default_rng(0)
    policy.reset()
    times = []
    for seen in draw.normal(scale=0.3, size=(calls, OBSERVATION_SIZE)):
        began = time.perf_counter()
        policy(seen)
        times.append(time.perf_counter() - began)
    return 1e6 * float(np.median(times))


def main() -> None:
    """Measure, print, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", type=Path, default=POLICY, metavar="FILE", help="its card names the twin's physics")
    parser.add_argument("--seconds", type=float, default=20.0, help="of flight in each rehearsal")
    parser.add_argument("--hogs", type=int, nargs="+", default=[0, os.cpu_count() or 1])
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args()
    rows, context = [], multiprocessing.get_context("spawn")
    for count in options.hogs:
        stop = context.Event()
        hogs = [context.Process(target=hog, args=(stop,), daemon=True) for _ in range(count)]
        for one in hogs:
            one.start()
        load = os.getloadavg()[0]
        rows.append({"hogs": count, "load_before": load, **rehearse(options.policy, options.seconds)})
        stop.set()
        for one in hogs:
            one.join(timeout=10)
    call = microseconds(options.policy)
    heads = ("load", 7), ("ticks", 8), ("missed", 8), ("median", 9), ("p99", 9), ("p99.9", 9), ("largest", 9)
    print(" hogs" + "".join(f"{head:>{width}}" for head, width in heads) + "  ms late, code")
    for row in rows:
        late = "".join(f"{row.get(name, float('nan')):9.3f}" for name in ("median", "p99", "p999", "largest"))
        begun = f"{row['hogs']:5d}{row['load_before']:7.2f}{row['ticks']:8d}{row.get('missed', 0):8d}"
        print(f"{begun}{late}  {row.get('priority', '')}, {row['code']}")
    print(f"policy: {call:.0f} us a call")
    if options.json:
        options.json.write_text(json.dumps({"cores": os.cpu_count(), "rows": rows, "policy_us": call}, indent=1) + "\n")


if __name__ == "__main__":
    main()
