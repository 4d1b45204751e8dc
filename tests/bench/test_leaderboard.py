"""Tables of the leaderboard."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path
from typing import Any

import pytest
from command_line import REPOSITORY

from bench.entries import known, reasons, results
from mjxball.bench.entry import HEADS, cells
from mjxball.bench.tracks import TRACKS
from mjxball.running import run_command


@pytest.fixture
def made(tmp_path: Path) -> Any:
    """The module that makes the tables, of the entries in a directory of its own."""
    spec = importlib.util.spec_from_file_location("leaderboard", REPOSITORY / "docs" / "leaderboard.py")
    assert spec is not None
    assert spec.loader is not None
    found = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(found)
    found.ENTRIES = tmp_path
    return found


def test_rows_are_entries_and_the_most_successful_in_the_world_stands_first(tmp_path: Path, made: Any) -> None:
    tracks = known()["tracks"]
    better = {"pair": {**tracks["pair"], "disturbed": {**reasons(rotors=9), "succeeded": 101, "late_error_90": 0.018}}}
    (tmp_path / "a.json").write_text(json.dumps(known(follower="worse")))
    (tmp_path / "b.json").write_text(json.dumps(known(follower="better", tracks=better)))
    head, line, *lines = made.pair().splitlines()
    assert head.count("|") == line.count("|") == lines[0].count("|") == len(HEADS) + 4
    assert [row.split("|")[1].strip() for row in lines] == ["`better`", "", "`worse`", ""]
    assert [row.split("|")[2].strip() for row in lines] == ["calm", "disturbed"] * 2
    assert len(made.team().splitlines()) == 2
    assert all(callable(getattr(made, track.replace("-", "_"))) for track in TRACKS)


def test_cells_show_shares_with_their_interval_and_a_dash_for_never() -> None:
    shown = dict(zip(HEADS, cells(results(arrival_ratio=None)), strict=True))
    assert (shown["success %"], shown["95 %"]) == ("83", "76 - 89")
    assert (shown["crashed %"], shown["late %"], shown["rotors %"]) == ("2", "3", "8")
    assert (shown["arrival"], shown["error mm"], shown["power"]) == ("-", "8.0", "1.020")


def test_an_entry_that_is_refused_and_two_of_one_follower_end_it(
    tmp_path: Path, made: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "one.json").write_text(json.dumps(known()))
    for change, said in (
        ({"version": 1}, "two.json is of version 1 of mjxball"),
        ({}, "two entries are of mine"),
    ):
        (tmp_path / "two.json").write_text(json.dumps(known(**change)))
        made.entries.cache_clear()
        assert run_command(made.main) == 2
        assert said in capsys.readouterr().err
