"""The pages on flying against the code: states, faults."""

from __future__ import annotations

import json

from command_line import REPOSITORY

from mjxball.fly.supervisor import State

DOCS = REPOSITORY / "docs"
SUPERVISOR, MEASURED = ((DOCS / name).read_text(encoding="utf-8") for name in ("supervisor.md", "archive/flying.md"))


def test_every_state_is_explained() -> None:
    assert [state.value for state in State if f"| {state.value} | " not in SUPERVISOR] == []


def test_faults_are_those_that_were_measured() -> None:
    """Of each fault the flight with the harder touchdown."""
    found = json.loads((REPOSITORY / "benchmarks" / "results" / "fly_firmware.json").read_text())["faults"]
    names = dict.fromkeys(one["fault"] for one in found)
    worst = {name: max((one for one in found if one["fault"] == name), key=lambda one: one["speed"]) for name in names}
    section = MEASURED.split("## Faults on the twin")[1].split("\n## ")[0]
    expected = {
        name: (", ".join(f"{off:.2f}" for off in one["off"]), f"{one['speed']:.2f}", f"{one['tilt']:.0f}°")
        for name, one in worst.items()
    }
    rows = [line.strip("| ").split(" | ") for line in section.splitlines() if line.startswith("| ")]
    assert {row[0]: (row[2], row[3], row[4]) for row in rows if row[0] in worst} == expected
