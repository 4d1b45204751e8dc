"""The pages on flying against the code: states, faults."""

from __future__ import annotations

import ast
import json
import sys

import pytest
from command_line import REPOSITORY

from mjxball.fly.supervisor import State

DOCS = REPOSITORY / "docs"
SUPERVISOR = (DOCS / "supervisor.md").read_text(encoding="utf-8")
sys.path.append(str(DOCS / "_site"))
import flight_tables  # noqa: E402


def test_every_state_is_explained() -> None:
    assert [state.value for state in State if f"| {state.value} | " not in SUPERVISOR] == []


def test_faults_are_those_that_were_measured() -> None:
    """The page's table has a row for each fault of the benchmark, with the harder touchdown of its flights."""
    found = json.loads(flight_tables.FAULTS.read_text(encoding="utf-8"))["faults"]
    listed = ast.parse((REPOSITORY / "benchmarks" / "fly_faults_virtual.py").read_text(encoding="utf-8"))
    tables = {node.target.id: node.value for node in listed.body if isinstance(node, ast.AnnAssign)}
    names = {key.value for key in tables["FAULTS"].keys if key is not None}
    assert {row["fault"] for row in found} == names
    assert all(row["stopped"] for row in found)
    lines = flight_tables.faults().splitlines()[2:]
    assert len(lines) == len(names)
    for line in lines:
        cells = line.strip("| ").split(" | ")
        own = [row for row in found if cells[0].startswith(f"{row['fault']} (")]
        assert float(cells[3].removesuffix(" m/s")) == pytest.approx(max(row["speed"] for row in own), abs=0.005)
