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
from mjxball.bench import followers, references, success
from mjxball.bench.entry import CONDITIONS, make_entry, read_entry
from mjxball.bench.tracks import MARGIN, TRACKS, World, worlds_of
from mjxball.commands.evaluate import main
from mjxball.evaluate.metrics import measure
from mjxball.export import main as export
from mjxball.plant.trim import largest_margin
from mjxball.running import run_command
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
class Controller:
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
    after = 0
    def __call__(self, observation):
        import time
        self.calls += 1
        time.sleep(0.03 if self.calls > self.after else 0.0)
        return super().__call__(observation)
class SlowLater(Slow):
    after = 40
class Complex(Good):
    def __call__(self, observation): return 1j * super().__call__(observation)
class Huge(Good):
    def __call__(self, observation): return 1e200 + super().__call__(observation)
class Text(Good):
    def __call__(self, observation): return [["1", "2", "3"]]
class Masked(Good):
    def __call__(self, observation): return np.ma.masked_less(super().__call__(observation), 1.0)
class Truths(Good):
    def __call__(self, observation): return super().__call__(observation) == 0
class Untraced(Good):
    def __call__(self, observation): return np.linalg.inv(np.zeros((2, 2)))
class Property(Good):
    @property
    def start(self): raise KeyError("gone")
class Arguments(Good):
    def __init__(self, gain, limit): pass
class Nothing:
    def __init__(self, config): pass
"""
REFUSED = {
    "bad:Raises": "Raises raised KeyError: 'gone'",
    "bad:Nan": "Nan answered a number that is not finite",
    "bad:Late": "Late answered a number that is not finite",
    "bad:Shape": "Shape answered shape (3,) where (1, 3) was wanted",
    "bad:Words": "the answer of follower Words must be real numbers, not <U5",
    "bad:Complex": "the answer of follower Complex must be real numbers, not complex128",
    "bad:Huge": "Huge answered a number that is not finite, or larger than 1e+09",
    "bad:Text": "the answer of follower Text must be real numbers, not <U1",
    "bad:Masked": "the answer of follower Masked must be real numbers, and some are masked",
    "bad:Truths": "the answer of follower Truths must be real numbers, not bool",
    "bad:Untraced": "Singular matrix, in bad.py line",
    "bad:Property": "Property raised KeyError: 'gone', in bad.py line",
    "bad:Arguments": "Arguments(config) raised TypeError",
    "bad:Slow": "ms a call; at most 20 ms",
    "bad:SlowLater": "ms a call; at most 20 ms",
    "bad:Nothing": "neither start and step",
    "bad:Gone": "bad has no Gone",
    "nowhere:Gone": "no module nowhere",
    "gone.npz": "does not exist",
    "gone.onnx": "no file gone.onnx",
    "text.onnx": "is no ONNX model",
    "lqgg": "the benchmark flies a file",
    "oracle": "oracle is not ranked",
    "random": "random is not ranked",
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
    for cached in (worlds_of, references.bars):
        cached.cache_clear()
    yield tmp_path
    for cached in (worlds_of, references.bars):
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
    """Of all plants, controllers and flights."""
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
    assert last.startswith(("error: ", "eval.py "))
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
    for cached in (worlds_of, references.bars):
        cached.cache_clear()
    bars = references.bars("pair", 0, 0)
    for row in (0, 1):
        peak, settling = (
            min(one) for one in zip(*(success.numbers(found[name][row])[:2] for name in names), strict=True)
        )
        np.testing.assert_allclose(bars[row, :2], (peak + 0.003, max(1.1 * settling, settling + 0.1)))
        overshoot = min(found[name][row].overshoot for name in names)
        np.testing.assert_allclose(bars[row, 2], overshoot + 0.01)
    assert np.isfinite(bars[0]).all()
    copy = simulate(config, make_baseline("copy", config), pair[0], "newton-euler")
    found["copy"] = [measure(copy, config.scenario.termination_distance)]
    for name, flights in found.items():
        entry = make_entry(name, lambda config, name=name: make_baseline(name, config), ["pair"], 0)
        good = all(own <= bar for own, bar in zip(success.numbers(flights[0]), bars[0], strict=True))
        assert entry["tracks"]["pair"]["undisturbed"]["met"] == good
    assert not good  # copy
    for cached in (worlds_of, references.bars):
        cached.cache_clear()


def test_an_onnx_file_of_a_policy_comes_to_what_the_policy_does(short: Path):
    assert export([str(BALANCE), "balance.onnx"]) == 0
    both = [make_entry(*followers.entrant(text), ["pair"], 0)["tracks"] for text in (str(BALANCE), "balance.onnx")]
    for condition in CONDITIONS:
        ours, theirs = (one["pair"][condition] for one in both)
        assert ours["met"] == theirs["met"]
        np.testing.assert_allclose(ours["command_change"], theirs["command_change"], rtol=1e-3)


@pytest.mark.parametrize("name", ["bad:Good", "bad:Controller"])
def test_a_follower_from_outside_gets_an_entry(short: Path, name: str):
    assert main(["bench", name, "--tracks", "pair", "--draw", "2", "--out", "entry.json"]) == 0
    entry = json.loads((short / "entry.json").read_text())
    assert (entry["draw"], entry["follower"], list(entry["tracks"])) == (2, name.partition(":")[2], ["pair"])
    assert entry["command"].startswith("python eval.py bench")


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_follower_is_refused_and_nothing_written(short: Path, capsys: pytest.CaptureFixture[str], name: str):
    refused(capsys, ["bench", name, "--tracks", "pair", "--out", "entry.json"], REFUSED[name])
    assert not (short / "entry.json").exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["bench", "copy"], "required: --out"),
        (["bench", "copy", "--out", "report"], "must end in .json"),
        (["bench", "copy", "--out", "e.json", "--tracks", "moon"], "invalid choice: 'moon'"),
        (["bench", "copy", "--out", "e.json", "--draw", "-1"], "--draw must not be negative"),
        (["bench", "copy", "--out", "e.json", "--omega", "1"], "unrecognized arguments: --omega"),
        (["--draw", "1"], "unrecognized arguments: --draw"),
    ],
)
def test_arguments_that_do_not_fit(short: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], said: str):
    refused(capsys, arguments, said)


def linear(path: str, observation: tuple[int, list[Any]], command: list[Any], names: tuple[str, str]) -> None:
    """An ONNX file of zeros: `observation` is (type, shape) of its input, `command` the shape of its output."""
    import onnx
    from onnx import helper

    kind, shape = observation
    weight = helper.make_tensor("weight", kind, [shape[-1], command[-1]], np.zeros(shape[-1] * command[-1]).tolist())
    node = helper.make_node("MatMul", [names[0], "weight"], [names[1]])
    inputs, outputs = (
        [helper.make_tensor_value_info(name, kind, one)] for name, one in zip(names, (shape, command), strict=True)
    )
    graph = helper.make_graph([node], "linear", inputs, outputs, [weight])
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    onnx.save(model, path)


OWN = ("observation", "command")


@pytest.mark.parametrize(
    ("model", "said"),
    [
        ((1, ["n", 18], ["n", 3], ("x", "y")), "has inputs x and outputs y"),
        ((1, ["n", 12], ["n", 3], OWN), "shape ['n', 12]; wanted is tensor(float) of shape ['flights', 18]"),
        ((11, ["n", 18], ["n", 3], OWN), "takes observation as tensor(double)"),
        ((1, [1, "n", 18], [1, "n", 3], OWN), "of shape [1, 'n', 18]"),
        ((1, [1, 18], [1, 3], OWN), "of shape [1, 18]"),
        ((1, ["n", 18], ["n", 4], OWN), "answered shape (1, 4) where (1, 3) was wanted"),
    ],
)
def test_an_onnx_file_with_other_inputs_is_refused(
    short: Path, capsys: pytest.CaptureFixture[str], model: tuple[int, list[Any], list[Any], tuple[str, str]], said: str
):
    kind, observation, command, names = model
    linear("other.onnx", (kind, observation), command, names)
    refused(capsys, ["bench", "other.onnx", "--tracks", "pair", "--out", "entry.json"], said)
    assert not (short / "entry.json").exists()


def known_entry() -> dict[str, Any]:
    return json.loads((REPOSITORY / "benchmarks" / "leaderboard" / "copy.json").read_text())


def with_numbers(**changed: Any) -> dict[str, Any]:
    """Tracks of an entry, one of them with other numbers."""
    tracks = known_entry()["tracks"]
    tracks["pair"]["disturbed"] |= changed
    return tracks


OTHERS = {
    "of version 2": {"version": 2},
    "of version True": {"version": True},
    "is no entry": {"benchmark": "other"},
    "tracks 3, which is no dict": {"tracks": 3},
    "commit None, which is no str": {"commit": None},
    "date 20261128, which is no str": {"date": 20261128},
    "no date as 2026-01-31": {"date": "yesterday"},
    "no name of one word": {"follower": "a | b"},
    "of track moon, undisturbed": {"tracks": {"moon": {}}},
    "of track pair, disturbed": {"tracks": with_numbers(met="all")},
    "of track pair, undisturbed": {"tracks": {"pair": {"disturbed": 3}}},
    "was flown and not flown": {"tracks": {}},
    "of 120 flights of draw 9; ranked": {"draw": 9},
    "of 5, 120 flights of draw 0; ranked": {"tracks": with_numbers(flights=5)},
    "from a clean checkout": {"commit": "93771579971e-dirty"},
}


@pytest.mark.parametrize("said", OTHERS)
def test_an_entry_of_another_benchmark_is_refused(tmp_path: Path, said: str):
    path = tmp_path / "entry.json"
    path.write_text(json.dumps({**known_entry(), **OTHERS[said]}))
    with pytest.raises(followers.InputError, match=re.escape(said)):
        read_entry(path)


def test_a_share_that_is_none_is_refused(tmp_path: Path):
    path = tmp_path / "entry.json"
    impossible = [{"met": met} for met in (50, float("nan"), -0.1, True, 0.5)]
    impossible += [{"failed": 1.5}, {"rotors_at_limit": 5}, {"settling_50": 10**400}, {"low": 0.5}]
    for changed in impossible:
        path.write_text(json.dumps({**known_entry(), "tracks": with_numbers(**changed)}))
        with pytest.raises(followers.InputError):
            read_entry(path)
    for date in ("9999-99-99", "2026-1-1", "20260101"):
        path.write_text(json.dumps({**known_entry(), "date": date}))
        with pytest.raises(followers.InputError, match="no date as 2026-01-31"):
            read_entry(path)
    path.write_text("[" * 100_000)
    with pytest.raises(followers.InputError, match="no JSON"):
        read_entry(path)


def test_another_entry_is_refused_where_tables_are_made(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "one.json").write_text(json.dumps(known_entry()))
    for name, change, said in (
        ("two", {"version": 2}, "two.json is of version 2 of mjxball-bench, and this is version 1"),
        ("two", {}, "two entries are of copy"),
    ):
        made = leaderboard()
        made.ENTRIES = tmp_path
        (tmp_path / f"{name}.json").write_text(json.dumps({**known_entry(), **change}))
        assert run_command(made.main) == 2
        assert capsys.readouterr().err.splitlines()[0].endswith(said)


def leaderboard() -> Any:
    """The module that makes the tables."""
    spec = importlib.util.spec_from_file_location("leaderboard", REPOSITORY / "docs" / "leaderboard.py")
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


def test_every_entry_stands_in_the_tables_of_its_tracks():
    made = leaderboard()
    page = (REPOSITORY / "docs" / "leaderboard.md").read_text()
    for track in TRACKS:
        name = f"docs.leaderboard:{track.replace('-', '_')}"
        assert f"```{{generated}} {name}\n" in page
        lines = getattr(made, name.partition(":")[2])().splitlines()
        flown = [entry for entry in made.entries() if track in entry["tracks"]]
        assert len(lines) == 2 + 2 * len(flown)
        assert all(sum(line.startswith(f"| `{entry['follower']}` |") for line in lines) == 1 for entry in flown)


TIERS = {track: pytest.mark.slow if track == "pair" else pytest.mark.release for track in TRACKS}


@pytest.mark.parametrize("track", [pytest.param(track, marks=mark) for track, mark in TIERS.items()])
def test_references_come_to_what_their_entries_say(track: str):
    """Flights, references, what is met and what is measured: whatever of them changes is another version."""
    name = "lqg" if track == "crazyflie" else "lqg-slow"
    entry = json.loads((REPOSITORY / "benchmarks" / "leaderboard" / f"{name}.json").read_text())
    found = make_entry(name, lambda config: make_baseline(name, config), [track], 0)["tracks"][track]
    for condition in CONDITIONS:
        wanted = entry["tracks"][track][condition]
        assert found[condition]["met"] == wanted["met"]
        for name, value in wanted.items():
            assert found[condition][name] == (value if value is None else pytest.approx(value, rel=1e-3)), name
