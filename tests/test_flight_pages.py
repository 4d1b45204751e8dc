"""The pages on flying against the code: states, faults."""

from __future__ import annotations

import ast
import json
import re
import sys

import pytest
from command_line import REPOSITORY

from mjxfly.supervisor import FlightState
from mjxfly.twin.conditions import POSITIONING

DOCS = REPOSITORY / "docs"
SUPERVISOR = (DOCS / "flying.md").read_text(encoding="utf-8")
sys.path.append(str(DOCS / "_site"))
import flight_tables  # noqa: E402


def test_every_state_is_explained() -> None:
    assert [state.value for state in FlightState if f"| {state.value} | " not in SUPERVISOR] == []


def test_positioning_is_that_which_was_measured() -> None:
    """A line for each system of the twin; the median flight is between the best and the worst."""
    found = json.loads(flight_tables.POSITIONING.read_text(encoding="utf-8"))["flights"]
    lines = flight_tables.positioning().splitlines()[2:]
    assert [line.split(" | ")[0].strip("| ") for line in lines] == list(POSITIONING)
    for line, system in zip(lines, POSITIONING, strict=True):
        flown = [row["rms"] for row in found if row["positioning"] == system and not row["fault"]]
        assert not [row["cause"] for row in found if row["positioning"] == system and not row["fault"] and row["cause"]]
        median, worst = (float(part) for part in re.findall(r"[0-9]+", line.split(" | ")[1]))
        assert min(flown) - 0.5 <= median <= worst
        assert worst == pytest.approx(max(flown), abs=0.51)


def test_faults_are_those_that_were_measured() -> None:
    """The page's table has a row for each fault of the benchmark, with the harder touchdown of its flights."""
    found = json.loads(flight_tables.FAULTS.read_text(encoding="utf-8"))["faults"]
    listed = ast.parse((REPOSITORY / "benchmarks" / "fly_faults_virtual.py").read_text(encoding="utf-8"))
    tables = {node.target.id: node.value for node in listed.body if isinstance(node, ast.AnnAssign)}
    names = {key.value for key in tables["FAULTS"].keys if key is not None}
    assert {row["fault"] for row in found} == names
    assert all(row["stopped"] for row in found)
    measured = set()
    for line in flight_tables.faults().splitlines()[2:]:
        kind, about, _, _, speed, *_ = [cell.strip(" `") for cell in line.split("|")[1:-1]]
        name = kind or about.rpartition(" (")[0]
        if speed:
            own = [row["speed"] for row in found if row["fault"] == name]
            assert float(speed.removesuffix(" m/s")) == pytest.approx(max(own), abs=0.005)
            measured.add(name)
    assert measured == names
