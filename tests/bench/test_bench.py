"""mjxball-bench: the frozen flights, when a flight is met, followers of any origin, and what is refused."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.util
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import REPOSITORY, call

from mjxball.baselines import make_baseline
from mjxball.bench import followers, score
from mjxball.bench.entry import read_entry, run
from mjxball.bench.tracks import MARGIN, TRACKS, World
from mjxball.commands.evaluate import main
from mjxball.evaluate.metrics import measure
from mjxball.export import main as export
from mjxball.plant.trim import largest_margin
from mjxball.sim.rollout import simulate

BALANCE = REPOSITORY / "policies" / "balance.npz"
# The scenarios and plants of draw 0, as text. Another hash is another version of the benchmark.
FROZEN = {
    "pair": "edadcedf3bb0494b",
    "pair-unknown": "b617b9ccfec753bc",
    "team": "2b1d9ab0c706c442",
    "rigs": "a1bafedbc81cfc2e",
    "crazyflie": "3f598e64b92cc0f9",
}
SOURCE = """
import numpy as np

class Good:
    def __init__(self, config): self.calls = 0
    def reset(self): self.calls = 0
    def __call__(self, observation): return np.zeros((*observation.shape[:-1], 3))
class Law:
    needs_privileged = False
    def __init__(self, config): pass
    def start(self, observation): return ()
    def step(self, state, observation, privileged): return state, np.zeros((*observation.shape[:-1], 3))
class Raises(Good):
    def __call__(self, observation): raise KeyError("gone")
class Nan(Good):
    def __call__(self, observation): return np.full((*observation.shape[:-1], 3), np.nan)
class Late(Good):
    def __call__(self, observation):
        self.calls += 1
        return np.full((*observation.shape[:-1], 3), 0.0 if self.calls < 60 else np.nan)
class Shape(Good):
    def __call__(self, observation): return np.zeros(3)
class Words(Good):
    def __call__(self, observation): return "level"
class Slow(Good):
    def __call__(self, observation):
        import time
        time.sleep(0.03)
        return super().__call__(observation)
class Nothing:
    def __init__(self, config): pass
"""
REFUSED = {
    "bad:Raises": "Raises raised KeyError: 'gone'",
    "bad:Nan": "Nan answered a number that is not finite",
    "bad:Late": "Late answered a number that is not finite",
    "bad:Shape": "Shape answered shape (3,) where (1, 3) was wanted",
    "bad:Words": "Words answered str, no array of numbers",
    "bad:Slow": "ms a call; at most 20 ms",
    "bad:Nothing": "neither start and step",
    "bad:Gone": "bad has no Gone",
    "nowhere:Gone": "no module nowhere",
    "gone.npz": "does not exist",
    "gone.onnx": "no file gone.onnx",
    "text.onnx": "is no ONNX model",
    "lqgg": "--benchmark takes a file",
}


@pytest.fixture
def short(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A directory with followers of one's own, where the pair's track is of two flights of 3 s."""
    (tmp_path / "bad.py").write_text(SOURCE)
    (tmp_path / "text.onnx").write_text("no model")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    whole = TRACKS["pair"].worlds

    def cut(draw: int) -> list[World]:
        (world,) = whole(draw)
        few = [tuple(dataclasses.replace(one, seconds=3.0) for one in pair) for pair in world.scenarios[:2]]
        return [dataclasses.replace(world, scenarios=tuple(few))]

    monkeypatch.setitem(TRACKS, "pair", dataclasses.replace(TRACKS["pair"], worlds=cut))
    for cached in (score.worlds_of, score.bars):
        cached.cache_clear()
    yield tmp_path
    for cached in (score.worlds_of, score.bars):
        cached.cache_clear()


class Text(str):
    """A text that stands in a `repr` as it is."""

    def __repr__(self) -> str:
        return str(self)


def in_full(value: Any) -> Text:
    """What a dataclass's own `repr` says."""
    fields = ", ".join(f"{field.name}={getattr(value, field.name)!r}" for field in dataclasses.fields(value))
    return Text(f"{type(value).__qualname__}({fields})")


def fingerprint(worlds: list[World]) -> str:
    """Of all plants, laws and flights."""
    parts = []
    for world in worlds:
        named = ("plant", "attitude", "autopilot", "leader", "command", "timing")
        own = [in_full(getattr(world.config, name)) for name in named]
        parts.append(
            (own, world.config.scenario.termination_distance, world.scenarios, world.reference_scenarios, world.length)
        )
    # Six digits: a linear program bounds some amplitudes, and its last bits are its own.
    text = re.sub(r"-?\d+\.\d+(e-?\d+)?", lambda number: f"{float(number[0]):.6g}", repr(parts))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def refused(capsys: pytest.CaptureFixture[str], arguments: list[str], said: str) -> None:
    """Exit code 2, and `said` in the last line on stderr, behind what may tell of progress."""
    assert call(main, arguments) == 2
    captured = capsys.readouterr()
    *_, last = captured.err.splitlines()
    assert last.startswith("error: ")
    assert said in last
    assert not captured.out


@pytest.mark.parametrize("track", TRACKS)
def test_flights_are_frozen_and_another_draw_is_others(track: str):
    worlds = TRACKS[track].worlds
    first = worlds(0)
    assert fingerprint(first) == FROZEN[track]
    assert fingerprint(worlds(1)) != FROZEN[track]
    assert sum(len(world.scenarios) for world in first) == 120


def test_every_load_of_the_pair_can_be_trimmed():
    (world,) = TRACKS["pair"].worlds(3)
    for calm, _ in world.scenarios[:30]:
        sides = [largest_margin(world.config.plant, calm.mass, side * calm.amplitude).margin for side in (-1, 1)]
        assert min(sides) >= MARGIN - 1e-6


def test_references_know_the_mass_that_the_entrant_does_not():
    (world,) = TRACKS["pair-unknown"].worlds(0)
    assert all(one.believed_mass is None for one in world.reference_scenarios)
    assert [one.mass for one in world.reference_scenarios] == [one.mass for pair in world.scenarios for one in pair]
    assert all(one.believed_mass == 0.2 for pair in world.scenarios for one in pair)


def test_a_flight_is_met_that_is_as_good_as_the_best_reference(monkeypatch: pytest.MonkeyPatch):
    """By each reference's own flights, alone and measured apart."""
    (whole,) = TRACKS["pair"].worlds(0)
    pair = tuple(dataclasses.replace(one, seconds=22.0) for one in whole.scenarios[0])
    world = dataclasses.replace(whole, scenarios=(pair,))
    monkeypatch.setitem(TRACKS, "pair", dataclasses.replace(TRACKS["pair"], worlds=lambda draw: [world]))
    names, config = ("lqg", "lqg-slow", "lqg-offset-free"), world.config
    found = {}
    for name in names:
        flown = [simulate(config, make_baseline(name, config), one, "newton-euler") for one in pair]
        found[name] = [measure(one, config.scenario.termination_distance) for one in flown]
    for cached in (score.worlds_of, score.bars):
        cached.cache_clear()
    bars = score.bars("pair", 0, 0)
    for row in (0, 1):
        peak, settling = (
            min(one) for one in zip(*(score.numbers(found[name][row])[:2] for name in names), strict=True)
        )
        np.testing.assert_allclose(bars[row, :2], (peak + 0.003, max(1.1 * settling, settling + 0.1)))
        overshoot = min(found[name][row].overshoot for name in names)
        np.testing.assert_allclose(bars[row, 2], overshoot + 0.01)
    assert np.isfinite(bars[0]).all()
    copy = simulate(config, make_baseline("copy", config), pair[0], "newton-euler")
    found["copy"] = [measure(copy, config.scenario.termination_distance)]
    for name, flights in found.items():
        entry = run(name, lambda config, name=name: make_baseline(name, config), ["pair"], 0)
        good = all(own <= bar for own, bar in zip(score.numbers(flights[0]), bars[0], strict=True))
        assert entry["tracks"]["pair"]["undisturbed"]["met"] == good
    assert not good  # copy
    for cached in (score.worlds_of, score.bars):
        cached.cache_clear()


def test_an_onnx_file_of_a_policy_comes_to_what_the_policy_does(short: Path):
    assert export([str(BALANCE), "balance.onnx"]) == 0
    both = [run(*followers.entrant(text), ["pair"], 0)["tracks"] for text in (str(BALANCE), "balance.onnx")]
    for condition in score.CONDITIONS:
        ours, theirs = (one["pair"][condition] for one in both)
        assert ours["met"] == theirs["met"]
        np.testing.assert_allclose(ours["command_change"], theirs["command_change"], rtol=1e-3)


@pytest.mark.parametrize("name", ["bad:Good", "bad:Law"])
def test_a_follower_from_outside_gets_an_entry(short: Path, name: str):
    assert main(["--benchmark", name, "--tracks", "pair", "--draw", "2", "--out", "entry.json"]) == 0
    entry = read_entry(short / "entry.json")
    assert (entry["draw"], entry["follower"], list(entry["tracks"])) == (2, name.partition(":")[2], ["pair"])
    assert entry["command"].startswith("python eval.py --benchmark")


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_follower_is_refused_and_nothing_written(short: Path, capsys: pytest.CaptureFixture[str], name: str):
    refused(capsys, ["--benchmark", name, "--tracks", "pair", "--out", "entry.json"], REFUSED[name])
    assert not (short / "entry.json").exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--benchmark", "copy"], "--out FILE.json"),
        (["--benchmark", "copy", "--out", "report"], "--out FILE.json"),
        (["--benchmark", "copy", "--out", "e.json", "--tracks", "moon"], "unknown track 'moon'"),
        (["--benchmark", "copy", "--out", "e.json", "--draw", "-1"], "--draw must not be negative"),
        (["--benchmark", "copy", "--out", "e.json", "--omega", "1"], "drop --omega"),
        (["--draw", "1"], "belong to --benchmark"),
    ],
)
def test_arguments_that_do_not_fit(short: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], said: str):
    refused(capsys, arguments, said)


def test_an_onnx_file_with_other_inputs_is_refused(short: Path, capsys: pytest.CaptureFixture[str]):
    import onnx
    from onnx import TensorProto, helper

    value = [helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", 3]) for name in ("x", "y")]
    graph = helper.make_graph([helper.make_node("Identity", ["x"], ["y"])], "other", value[:1], value[1:])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    onnx.save(model, "other.onnx")
    arguments = ["--benchmark", "other.onnx", "--tracks", "pair", "--out", "entry.json"]
    refused(capsys, arguments, "other.onnx has inputs x and outputs y")


@pytest.mark.parametrize(
    ("change", "said"),
    [({"version": 2}, "of version 2"), ({"benchmark": "other"}, "is no entry"), ({"tracks": 3}, "is not whole")],
)
def test_an_entry_of_another_benchmark_is_refused(tmp_path: Path, change: dict[str, Any], said: str):
    known = json.loads(next((REPOSITORY / "benchmarks" / "leaderboard").glob("*.json")).read_text())
    path = tmp_path / "entry.json"
    path.write_text(json.dumps({**known, **change}))
    with pytest.raises(followers.InputError, match=said):
        read_entry(path)


def test_the_page_is_that_of_the_entries(tmp_path: Path):
    spec = importlib.util.spec_from_file_location("leaderboard", REPOSITORY / "docs" / "leaderboard.py")
    page = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(page)
    entries = [read_entry(path) for path in sorted(page.ENTRIES.glob("*.json"))]
    assert page.page(entries) == page.PAGE.read_text()
