"""What policies are good for by their metadata, and flights longer than anybody looked at before."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from command_line import REPOSITORY, call
from tables import rows, weekly

from batch import fly_compiled
from mjxball.baselines import make_baseline
from mjxball.cli import plant_setup
from mjxball.commands import evaluate
from mjxball.config import preset
from mjxball.evaluate.policies import beyond_training, load_policy
from mjxball.policy import Policy
from mjxball.policy.file import load_file, save_file, shipped_policies, shipped_policy
from mjxball.sim.scenario import Scenario
from mjxball.view import main as view

METADATA = {"flown": {"drones": [2, 3], "seconds": 60}}
UNIVERSAL, FLIGHT = shipped_policy("universal"), shipped_policy("flight")
MEASURED = REPOSITORY / "benchmarks" / "results" / "horizon.json"


@rows(
    "metadata, drones, seconds, words",
    [
        (METADATA, 2, 60.0, ()),
        (METADATA, 3, 45.0, ()),
        (METADATA, 4, 45.0, (("2, 3", "are 4"),)),
        (METADATA, 2, 61.0, (("60 s", "61 s"),)),
        (METADATA, 6, 300.0, (("2, 3", "are 6"), ("60 s", "300 s"))),
        ({}, 6, 3600.0, ()),
    ],
)
def test_more_drones_or_a_longer_flight_are_beyond_a_card(
    metadata: dict[str, Any], drones: int, seconds: float, words: tuple[tuple[str, str], ...]
) -> None:
    found = beyond_training(metadata, drones, seconds)
    assert len(found) == len(words)
    assert all(one in text and other in text for text, (one, other) in zip(found, words, strict=True))


def test_the_evaluation_and_the_viewer_warn_of_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    policy, contents = tmp_path / "policy.npz", load_file(UNIVERSAL)
    save_file(policy, dataclasses.replace(contents, metadata={**contents.metadata, **METADATA}))
    short = ["--seconds", 0.1, "--physics", "newton-euler", "--plant"]
    for plant, expected in (("team4", 1), ("team3", 0)):
        assert call(evaluate.main, [policy, *short, plant]) == 0
        assert call(view.main, [policy, *short, plant, "--out", tmp_path / f"{plant}.html"]) == 0
        warnings = [line for line in capsys.readouterr().err.splitlines() if "by its metadata" in line]
        assert len(warnings) == 2 * expected
        assert all(line.startswith("warning: ") and "2, 3 drones" in line for line in warnings)
    load_policy(policy, plant_setup(Path("team3")), seconds=61.0)
    assert "61 s" in capsys.readouterr().err


def test_cards_say_what_was_measured() -> None:
    """Of the lengths up to the metadata's, its numbers of drones are those all of whose flights were steady."""
    measured = json.loads(MEASURED.read_text())["rows"]
    for path in shipped_policies():
        flown, mine = Policy.load(path).metadata["flown"], [row for row in measured if row["policy"] == path.stem]
        within = [row for row in mine if row["seconds"] <= flown["seconds"]]
        unsteady = {row["drones"] for row in within if not row["steady"]}
        assert max(row["seconds"] for row in within) == flown["seconds"], path
        assert {row["drones"] for row in within} - unsteady == set(flown["drones"]), path


@pytest.fixture(scope="module")
def horizon() -> ModuleType:
    """benchmarks/horizon.py, which is a script."""
    spec = importlib.util.spec_from_file_location("horizon", REPOSITORY / "benchmarks" / "horizon.py")
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules["horizon"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.slow
@pytest.mark.parametrize(
    "path", [FLIGHT, *weekly(*sorted({*shipped_policies()} - {FLIGHT}))], ids=lambda path: path.stem
)
def test_ten_minutes_of_every_policy(path: Path, horizon: ModuleType) -> None:
    """Load at rest, moving slowly and quickly: nothing is lost; what its metadata is good for stays steady."""
    flown = Policy.load(path).metadata["flown"]
    plants = [setup for _, setup in horizon.own_plants(path) if setup.plant.count in flown["drones"]]
    setup = max(plants, key=lambda one: one.plant.count)
    policy, lengths = load_policy(path, setup), (horizon.MINUTE, horizon.TEN)
    early, late = (fly_compiled(setup, policy, horizon.own_scenarios(setup, seconds)) for seconds in lengths)
    good = late if flown["seconds"] >= horizon.TEN else early
    for first, last, held in zip(early, late, good, strict=True):
        assert not last.failed
        assert horizon.is_steady(held, first), (first, held)


def test_a_flight_that_grows_or_saturates_is_not_steady(horizon: ModuleType) -> None:
    config = preset("paper")
    found = fly_compiled(config, make_baseline("lqg", config), [Scenario(seconds=22.0)])[0]
    assert horizon.is_steady(found, found)
    for change in ({"z_peak": 0.02}, {"rotors_at_limit": 0.3}, {"failed": True}, {"x_peak": None}):
        assert not horizon.is_steady(dataclasses.replace(found, **change), found)
