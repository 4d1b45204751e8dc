"""Retraining in flight from end to end, by the clock."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from command_line import REPOSITORY, environment
from conftest import too_busy

from mjxball.fly.flight_log import read
from mjxball.policy.file import shipped_policy


@pytest.mark.alone
def test_a_rehearsal_finds_its_load_and_fine_tunes(tmp_path: Path) -> None:
    """From end to end by the clock: runner, twin, and the process with JAX that reads the growing log."""
    pytest.importorskip("cflib")
    log = tmp_path / "flight.jsonl"
    command = [
        "-m",
        "mjxball.fly",
        shipped_policy("flight"),
        "--rehearse",
        "--retrain",
        "--twin-load",
        "0.006",
        "-0.04",
        "8.5",
    ]
    done = subprocess.run(
        [sys.executable, *map(str, command), "--seconds", "20.5", "--log", str(log)],
        cwd=tmp_path,
        env={**environment(), "PYTHONPATH": str(REPOSITORY)},
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=500,
        check=False,
    )
    assert done.returncode in (0, 1), done.stderr
    records = list(read(log))
    said = {record["what"]: record for record in records if record["kind"] == "retrain"}
    events = {event.split(":")[0] for record in records for event in record.get("events", [])}
    if events & {"DEADLINES", "STALE"} or "failed" in said:
        too_busy(f"{sorted(events)}, {said.get('failed')}")
    assert done.returncode == 0, done.stdout
    assert "retraining: 3 of 3 programs compiled" in done.stdout
    found = said["identified"]["numbers"]
    assert found["mass"] == pytest.approx(0.006, abs=5e-4)
    assert found["moment"] == pytest.approx(-0.006 * 0.04, abs=1e-4)
    assert said.keys() & {"kept", "fine-tuned"}
    assert ("taken" in said) == ("fine-tuned" in said)
    end = next(record for record in records if record["kind"] == "end")
    assert end["flown"].keys() == {"first policy", *["second policy"] * ("taken" in said)}
    assert all(figures["error_rms"] < 0.1 for figures in end["flown"].values())
