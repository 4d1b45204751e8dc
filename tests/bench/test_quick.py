"""A few flights of the benchmark in this process, and what a training says of them."""

from __future__ import annotations

import json
import threading
from pathlib import Path
from typing import Any

import pytest

from mjxball.baselines import make_baseline
from mjxball.bench import quick
from mjxball.bench.draw import QUICK_FLIGHTS, QUICK_TRACKS, groups_of, quick_group
from mjxball.bench.quick import KNOWN, fly_known, known_success, quick_success, quick_track
from mjxball.commands import watch
from mjxball.commands.watch import Watch, write
from mjxball.config import preset
from mjxball.policy.file import shipped_policy


def test_the_few_flights_are_not_those_that_are_ranked() -> None:
    for track in QUICK_TRACKS:
        few, (ranked,) = quick_group(track), groups_of(track, 0)
        assert few.config == ranked.config
        assert [one.condition for one in few.flights] == ["calm"] * QUICK_FLIGHTS + ["disturbed"] * QUICK_FLIGHTS
        goals = {one.scenario.goal for one in ranked.flights}
        assert not goals.intersection(one.scenario.goal for one in few.flights)


def test_presets_know_their_track() -> None:
    known = {"transport": "pair", "balance": "pair", "flight": "crazyflie", "team": None, "universal": None}
    assert {name: quick_track(preset(name)) for name in known} == known


@pytest.mark.slow
def test_followers_flown_together_succeed_as_each_alone() -> None:
    config = quick_group("pair").config
    names = ("copy", "lqg-calm", "lqg")
    together = quick_success("pair", [make_baseline(name, config) for name in names])
    assert together[0] == {"calm": 0.0, "disturbed": 0.0}
    assert quick_success("pair", [make_baseline("lqg", config)]) == together[2:]
    assert together[2]["calm"] > 0.85  # 95 % of the flights that are ranked
    assert together[2]["disturbed"] < 0.5


def test_known_followers_are_stored_and_flown_only_if_they_changed(monkeypatch: pytest.MonkeyPatch) -> None:
    """`python -m mjxball.bench.store pair crazyflie` stores them anew."""
    monkeypatch.setattr(quick, "fly_known", lambda track: {"flown": {"calm": 1.0}})
    for track in QUICK_TRACKS:
        assert list(known_success(track)) == list(KNOWN[track])
    for others in (("lqg", "balance-sac"), ("lqg-disturbed", "balance")):
        monkeypatch.setitem(KNOWN, "pair", others)
        assert known_success("pair") == {"flown": {"calm": 1.0}}


@pytest.mark.slow
def test_known_followers_succeed_as_stored() -> None:
    for track in QUICK_TRACKS:
        stored, flown = known_success(track), fly_known(track)
        assert flown.keys() == stored.keys()
        for name, success in flown.items():  # other processors round otherwise, which decides some flights
            assert success == pytest.approx(stored[name], abs=2.5 / QUICK_FLIGHTS)


def test_a_watch_says_the_newest_and_writes_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begun, go, flown = threading.Event(), threading.Event(), list[list[str]]()
    known = {"lqg": {"calm": 0.5, "disturbed": 0.25}, "balance": {"calm": 0.6, "disturbed": 0.25}}

    def known_of(track: str) -> dict[str, dict[str, float]]:
        begun.set()
        assert go.wait(20)
        return known

    def success(track: str, followers: Any) -> list[dict[str, float]]:
        flown.append([one.name for one in followers])
        return [{"calm": 0.5, "disturbed": 0.25}]

    monkeypatch.setattr(watch, "known_success", known_of)
    monkeypatch.setattr(watch, "quick_success", success)
    said = list[str]()
    watched = Watch("pair", 0.0, said.append)
    watched.start()
    assert begun.wait(20)
    for name in ("balance-sac", "paper", "balance"):  # while it is busy; only the last is still of interest
        watched(shipped_policy(name))
    go.set()
    watched.end()
    assert flown == [["balance"]]
    (line,) = said
    assert "50/25 % calm/disturbed (lqg 50/25; balance 60/25)" in line
    table = write(watched, tmp_path / "eval").splitlines()
    assert [row.split() for row in table[1:]] == [
        ["this", "policy", "50", "25"],
        ["lqg", "50", "25"],
        ["balance", "60", "25"],
    ]
    record = json.loads((tmp_path / "eval" / "success.json").read_text())
    assert [sorted(one) for one in record["points"]] == [["calm", "disturbed", "seconds"]]
    assert (tmp_path / "eval" / "success.png").stat().st_size > 5000
