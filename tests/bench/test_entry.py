"""Entries of the benchmark: written by its command, and what is refused because no flights can give it."""

from __future__ import annotations

import csv
import json
import re
from pathlib import Path
from typing import Any

import pytest
from command_line import call
from tables import rows

from bench.entries import known, reasons, results, without
from mjxball.bench import CONDITIONS
from mjxball.bench.checks import read_entry
from mjxball.bench.entry import FLIGHT_COLUMNS
from mjxball.bench.success import REASONS
from mjxball.commands.evaluate import main
from mjxball.errors import InputError

SOURCE = """
import numpy as np
class Good:
    def __init__(self, config): pass
    def reset(self): pass
    def __call__(self, observation): return np.zeros((*observation.shape[:-1], 3))
class PairOnly(Good):
    def __init__(self, config):
        from mjxball.errors import InputError
        if config.plant.object_mass < 0.1:
            raise InputError("PairOnly is for heavy objects")
"""


HEADS: list[tuple[str, dict[str, Any]]] = [
    ("is of version 1 of", {"version": 1}),
    ("is of version True of", {"version": True}),
    ("is of version 2.5 of", {"version": 2.5}),
    ("is no entry of", {"benchmark": "other"}),
    ("has 'score', which no entry has", {"score": 1.0}),
    ("tracks 3, which is no dict", {"tracks": 3}),
    ("draw True, which is no int", {"draw": True}),
    ("cpu_time '1 ms', which is no float", {"cpu_time": "1 ms"}),
    ("has cpu_time 0.03 s", {"cpu_time": 0.03}),
    ("has cpu_time nan s", {"cpu_time": float("nan")}),
    ("has cpu_time -1 s", {"cpu_time": -1.0}),
    ("commit None, which is no str", {"commit": None}),
    ("not of a clean checkout", {"commit": "93771579971e-dirty"}),
    ("not of 64 hexadecimal digits", {"sha256": "unknown"}),
    ("not of 32 hexadecimal digits", {"key": "0" * 31}),
    ("not of one word", {"follower": "a | b"}),
    ("not of one line", {"command": "python\nrm"}),
    ("has no date as", {"date": "yesterday"}),
    ("has no date as", {"date": "20261231"}),
    ("has no date as", {"date": "9999-99-99"}),
    ("in the future or before", {"date": "2999-01-01"}),
    ("in the future or before", {"date": "2020-01-01"}),
    ("is of draw 9; ranked are flights of draw 0", {"draw": 9}),
    ("values in versions that are no text", {"versions": {"python": 3}}),
    ("values in not_flown that are no text", {"not_flown": {"team": None}}),
    ("was flown and not flown", {"not_flown": {"pair": "but it was"}}),
    ("has no track", {"tracks": {}}),
    ("has a track 'moon'", {"tracks": {**known()["tracks"], "moon": {}}}),
    ("lacks results of track pair in calm and disturbed", {"tracks": {"pair": {"calm": results()}}}),
    ("lacks results of track pair", {"tracks": {"pair": [results(), results()]}}),
]
RESULTS: list[tuple[str, Any]] = [
    ("other keys", results(score=1.0)),
    ("other keys", without("rotor_power", results())),
    ("other keys", [100, 120]),
    ("other reasons", results(reasons={"crashed": 20})),
    ("other reasons", results(reasons=20)),
    ("flights is 120.0", results(flights=120.0)),
    ("they are of 100 flights, and there are 120", results(flights=100)),
    ("succeeded is True", results(succeeded=True)),
    ("succeeded is 0.83", results(succeeded=0.83)),
    ("succeeded is 121", results(succeeded=121)),
    ("succeeded is -1", results(succeeded=-1)),
    ("crashed is 2.0", reasons(crashed=2.0)),
    ("do not add up", results(succeeded=115)),  # and ten with a rotor at its limit
    ("do not add up", results(succeeded=50)),  # more fail than there are reasons
    ("do not add up", reasons(late=19, leaves=0)),  # one that crashes has no other reason
    ("do not add up", reasons(late=10, leaves=10)),  # late and leaves exclude each other
    ("arrival_ratio is nan", results(arrival_ratio=float("nan"))),
    ("arrival_ratio is inf", results(arrival_ratio=float("inf"))),
    ("arrival_ratio is '1.1'", results(arrival_ratio="1.1")),
    ("arrival_ratio is True", results(arrival_ratio=True)),
    ("arrival_ratio is -1", results(arrival_ratio=-1.0)),
    ("sooner than any follower", results(arrival_ratio=0.05)),
    ("later than a flight ends", results(arrival_ratio=50.0)),
    ("does not fit those that are late", results(arrival_ratio=1.3)),
    ("arrival_ratio is None", results(arrival_ratio=None)),
    ("late_error_90 is None, with 2 flights", results(late_error_90=None)),
    ("does not fit those that are late", results(late_error_90=0.02)),
    ("late_error_90 is inf", results(late_error_90=10**400)),
    ("rotor_power is None", results(rotor_power=None)),
    ("power or change", results(rotor_power=0.5)),
    ("power or change", results(rotor_power=20.0)),
    ("power or change", results(command_change=1.3)),
    ("rotor_limit_share is 0.001, with 10 of 118", results(rotor_limit_share=0.001)),
    ("rotor_limit_share is 0.3, with 10 of 118", results(rotor_limit_share=0.3)),
    ("rotor_limit_share is 5", results(rotor_limit_share=5)),
]


def refuse(path: Path, text: str, said: str) -> None:
    """The entry `text` is refused with one sentence that has `said`."""
    path.write_text(text)
    with pytest.raises(InputError, match=re.escape(said)) as refused:
        read_entry(path)
    assert "\n" not in str(refused.value)


def test_entries_that_flights_can_give_are_read(tmp_path: Path) -> None:
    path = tmp_path / "entry.json"
    all_crash = results(
        succeeded=0,
        reasons={**dict.fromkeys(REASONS, 0), "crashed": 120},
        **dict.fromkeys(("arrival_ratio", "late_error_90", "rotor_power", "rotor_limit_share", "command_change")),
    )
    most_leave = results(
        succeeded=20,
        reasons={**dict.fromkeys(REASONS, 0), "leaves": 100, "rotors": 30},
        **{"arrival_ratio": 1.9, "late_error_90": 0.3, "rotor_limit_share": 0.2, "command_change": None},
    )
    for calm in (results(), all_crash, most_leave):
        path.write_text(json.dumps(known(calm)))
        assert read_entry(path)["tracks"]["pair"]["calm"] == calm


@rows("said, changed", HEADS)
def test_an_entry_that_is_not_whole_is_refused(tmp_path: Path, said: str, changed: dict[str, Any]) -> None:
    refuse(tmp_path / "entry.json", json.dumps(known(**changed)), said)


@rows("said, calm", RESULTS)
def test_results_that_no_flights_can_give_are_refused(tmp_path: Path, said: str, calm: Any) -> None:
    refuse(tmp_path / "entry.json", json.dumps(known(calm)), said)


def test_every_key_of_an_entry_is_needed_and_stands_once(tmp_path: Path) -> None:
    path = tmp_path / "entry.json"
    for name in set(known()) - {"benchmark", "version"}:
        refuse(path, json.dumps(without(name, known())), f"is not whole: {name} is missing")
    refuse(path, json.dumps(known())[:-1] + ', "draw": 0}', "the key 'draw' stands twice")
    refuse(path, "[" * 100_000, "is no JSON")
    refuse(path, "[]", "is no entry of")


def refused(capsys: pytest.CaptureFixture[str], arguments: list[str], said: str) -> None:
    """Exit code 2, and `said` in the last line on stderr, behind what may tell of progress."""
    assert call(main, arguments) == 2
    captured = capsys.readouterr()
    *_, last = captured.err.splitlines()
    assert last.startswith(("error: ", "eval.py "))
    assert said in last
    assert not captured.out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["bench", "copy"], "required: --out"),
        (["bench", "copy", "--out", "report"], "must end in .json"),
        (["bench", "copy", "--out", "e.json", "--flights", "f.json"], "must end in .csv"),
        (["bench", "copy", "--out", "e.json", "--tracks", "moon"], "invalid choice: 'moon'"),
        (["bench", "copy", "--out", "e.json", "--draw", "-1"], "--draw must not be negative"),
        (["bench", "copy", "--out", "e.json", "--key", "12"], "--key must be 32 digits"),
        (["bench", "lqgg", "--out", "e.json"], "the benchmark flies a file"),
        (["bench", "oracle", "--out", "e.json"], "oracle is not ranked"),
        (["bench", "gone.npz", "--out", "e.json"], "gone.npz does not exist"),
        (["bench", "gone.onnx", "--out", "e.json"], "gone.onnx does not exist"),
        (["bench", "nowhere:Gone", "--out", "e.json"], "there is no module nowhere"),
    ],
)
def test_arguments_that_do_not_fit(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    said: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    refused(capsys, arguments, said)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_the_command_writes_an_entry_and_the_reason_of_every_flight(short: Path) -> None:
    (short / "own.py").write_text(SOURCE)
    wanted = ["bench", "own:Good", "--tracks", "pair", "--draw", "2", "--key", "0123456789abcdef" * 2]
    assert main([*wanted, "--out", "entry.json", "--flights", "flights.csv"]) == 0
    entry = json.loads((short / "entry.json").read_text())
    assert (entry["draw"], entry["follower"], entry["key"]) == (2, "Good", "0123456789abcdef" * 2)
    assert entry["command"].startswith("python eval.py bench")
    with (short / "flights.csv").open() as stream:
        flown = list(csv.DictReader(stream))
    assert tuple(flown[0]) == FLIGHT_COLUMNS
    for condition in CONDITIONS:
        found, mine = entry["tracks"]["pair"][condition], [one for one in flown if one["condition"] == condition]
        assert found["flights"] == len(mine)
        assert found["succeeded"] == sum(not one["reasons"] for one in mine)
        for reason, count in found["reasons"].items():
            assert count == sum(reason in one["reasons"].split() for one in mine)
    # Level commands do not bring the object to its goal; wind may carry it away.
    assert all({"late", "crashed"} & set(one["reasons"].split()) for one in flown)


@pytest.mark.slow
def test_a_track_whose_plant_is_refused_is_left_out(short: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (short / "own.py").write_text(SOURCE)
    wanted = ["bench", "own:PairOnly", "--out", "entry.json", "--tracks"]
    assert main([*wanted, "pair", "crazyflie"]) == 0
    entry = json.loads((short / "entry.json").read_text())
    assert (list(entry["tracks"]), entry["not_flown"]) == (["pair"], {"crazyflie": "PairOnly is for heavy objects"})
    (short / "entry.json").unlink()
    capsys.readouterr()
    refused(capsys, [*wanted, "crazyflie"], "PairOnly flies no track: PairOnly is for heavy objects")
    assert not (short / "entry.json").exists()
