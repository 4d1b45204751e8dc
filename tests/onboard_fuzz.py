"""Both roles' apps under everything at once, with address and undefined-behaviour sanitizers.

`fuzz` flies `onboard_fuzz.c`: states, parameters, packets, uploads, clock and the app's own memory, any of which may be
wild, in any order of calls. A run ends at the first report of a sanitizer and at the first output outside the limits.
"""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from onboard_bench import policy_of

from mjxball.export import in_team
from mjxball.policy.file import load_file, shipped_policy
from mjxfly.app.generate import CORE, EXACT, files_of
from mjxfly.app.protocol import CAUSES, AppPhase

DRIVER = Path(__file__).with_suffix(".c")
WARNINGS = ("-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-pedantic", "-Werror")
SANITIZERS = ("-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all")
POLICIES = (  # name, weights of 8 bits
    *(("flight", False), ("flight", True), ("universal", False), ("stand", True), ("recurrent flight", True)),
)


def sources_of(name: str, int8: bool) -> dict[str, str]:
    """The app's C without the firmware's interface, by file name."""
    policy = policy_of(name) if name == "recurrent flight" else load_file(shipped_policy(name))
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
    found["phases"] = dict(zip((phase.name.lower() for phase in AppPhase), found["phases"], strict=True))
    for kind in ("causes", "refusals"):
        found[kind] = {text: count for text, count in zip(CAUSES, found[kind], strict=True) if count}
    return found
