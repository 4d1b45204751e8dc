"""Both roles' apps under everything at once, with address and undefined-behaviour sanitizers.

`python benchmarks/onboard_fuzz.py [--ticks 10000000] [--seed 1] [--json FILE]` flies
`onboard_fuzz.c`: states, parameters, packets, uploads, clock and the app's own memory, any of which may be wild, in any
order of calls. A run ends with exit code 1 at the first report of a sanitizer and at the first output outside the
limits. The ticks are divided among the policies of a role.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import onboard
from mjxball.export import in_team
from mjxball.fly.app.generate import CORE, EXACT, ROLES, files_of
from mjxball.fly.app.protocol import CAUSES, Phase
from mjxball.policy.file import load_file, shipped_policy

DRIVER = Path(__file__).with_suffix(".c")
WARNINGS = ("-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-pedantic", "-Werror")
SANITIZERS = ("-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all")
POLICIES = (  # name, weights of 8 bits
    *(("flight", False), ("flight", True), ("universal", False), ("stand", True), ("recurrent flight", True)),
)


def sources_of(name: str, int8: bool) -> dict[str, str]:
    """The app's C without the firmware's interface, by file name."""
    policy = onboard.recurrent() if name == "recurrent flight" else load_file(shipped_policy(name))
    files = files_of(in_team(policy, name, Path("crazyflie")) if name == "universal" else policy, name, int8)
    return {one: files[f"src/{one}"] for one in (*CORE, "policy.h", "rig.h")}


def fuzz(files: Mapping[str, str], role: int, ticks: int, seed: int) -> dict[str, Any]:
    """`ticks` of the app of `role` made of `files`: what was reached, or `report`, what the first fault was."""
    with tempfile.TemporaryDirectory() as place:
        for name, text in {**files, DRIVER.name: DRIVER.read_text(encoding="utf-8")}.items():
            (Path(place) / name).write_text(text, encoding="utf-8")
        flags = ["-std=c11", "-O1", "-g", *EXACT, *WARNINGS, *SANITIZERS, f"-DMJXBALL_FOLLOWER={role}"]
        subprocess.run(["gcc", *flags, DRIVER.name, "-o", "fuzz"], cwd=place, check=True)
        environment = {**os.environ, "ASAN_OPTIONS": "detect_leaks=0"}
        command = ["./fuzz", str(ticks), str(seed)]
        done = subprocess.run(command, cwd=place, capture_output=True, text=True, check=False, env=environment)
    if done.returncode:
        lines = [line for line in (done.stderr + done.stdout).splitlines() if line.strip()]
        return {
            "report": next((line for line in lines if "rror" in line), lines[-1] if lines else str(done.returncode))
        }
    found = json.loads(done.stdout)
    found["phases"] = dict(zip((phase.name.lower() for phase in Phase), found["phases"], strict=True))
    for kind in ("causes", "refusals"):
        found[kind] = {text: count for text, count in zip(CAUSES, found[kind], strict=True) if count}
    return found


def main() -> int:
    """Print the table; returns 1 if anything was reported."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--ticks", type=int, default=10_000_000, help="of each role")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    print(f"{'role':9}{'policy':20}{'weights':9}{'ticks':>9}{'flights':>9}{'flying':>9}{'uploads':>9}  report")
    rows: list[dict[str, Any]] = []
    for number, role in enumerate(ROLES):
        for place, (name, int8) in enumerate(POLICIES):
            found = fuzz(sources_of(name, int8), number, options.ticks // len(POLICIES), options.seed + place)
            row = {"role": role, "policy": name, "weights": "int8" if int8 else "float32"}
            rows.append({**row, "report": "", **found})
            flying = sum(found["phases"][phase] for phase in ("fly", "land", "descend")) if "phases" in found else 0
            print(
                f"{role:9}{name:20}{row['weights']:9}{found.get('ticks', 0):9}{found.get('flights', 0):9}"
                f"{flying:9}{found.get('accepted', 0):9}  {found.get('report', 'none')}",
                flush=True,
            )
    if options.json:
        command = "python benchmarks/onboard_fuzz.py " + " ".join(sys.argv[1:])
        options.json.write_text(json.dumps({"command": command, "runs": rows}, indent=1) + "\n", encoding="utf-8")
    return int(any(row["report"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
