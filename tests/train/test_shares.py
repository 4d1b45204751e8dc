"""A population in parts: what each trains, and which parts are refused when they are brought together."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import assert_refused

from mjxball.commands.train import main as train
from mjxball.errors import InputError
from mjxball.policy import save_file
from mjxball.train import shares
from mjxball.train.run_directory import read_rows, write_config, write_rows

WHOLE: dict[str, Any] = {
    "seed": 7,
    "seeds": 6,
    "physics": "newton-euler",
    "sweep": {"sac.discount": [0.9] * 3 + [0.99] * 3},
}
RETURNS = (-3.0, -1.0, -2.0, -9.0, float("nan"), -8.0)  # of seeds 7 .. 12 at the end


def test_the_parts_are_the_population() -> None:
    parts = []
    for index in range(3):
        origin = {**WHOLE, "start_from": [{"policy": str(k)} for k in range(6)]}
        shares.take(origin, index, 3)
        parts.append(origin)
    assert [part["seed"] for part in parts] == [7, 9, 11]
    assert {part["seeds"] for part in parts} == {2}
    assert [value for part in parts for value in part["sweep"]["sac.discount"]] == WHOLE["sweep"]["sac.discount"]
    assert [start["policy"] for part in parts for start in part["start_from"]] == list("012345")


def test_unequal_parts_and_indices_outside_are_refused(tmp_path: Path, capsys, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    cases = (("3/3", "6"), ("-1/3", "6"), ("/8", "6"), ("0/0", "6"), ("1/2/3", "6"), ("0/4", "6"), ("0/2", "1"))
    for share, seeds in cases:
        line = assert_refused(train, [f"--share={share}", "--num-seeds", seeds], tmp_path, capsys)
        assert "shares" in line if share in ("0/4", "0/2") else repr(share) in line


@pytest.fixture
def runs(trained, tmp_path: Path) -> list[Path]:
    """Three finished parts of two members each."""
    made = []
    for index in range(3):
        run, origin = tmp_path / f"run{index}", {**WHOLE, "source_hash": "s", "versions": {}}
        shares.take(origin, index, 3)
        (run / "members").mkdir(parents=True)
        (run / "eval").mkdir()
        write_config(run, trained.config, origin)
        seeds = range(origin["seed"], origin["seed"] + 2)
        rows = [{"steps": 100, "seed": seed, "eval_return": RETURNS[seed - 7]} for seed in seeds]
        rows = [{**row, "steps": 50, "eval_return": 0.0} for row in rows] + rows
        write_rows(run / "members.csv", list(rows[0]), rows)
        for seed in seeds:
            metadata = {**trained.contents.metadata, "seed": seed}
            save_file(run / "members" / f"seed{seed}.npz", dataclasses.replace(trained.contents, metadata=metadata))
        made.append(run)
    return made


def test_parts_in_any_order_are_brought_together(runs: list[Path], tmp_path: Path) -> None:
    _, origin = shares.gather(runs[::-1], tmp_path / "all")
    assert (origin["seed"], origin["seeds"]) == (7, 6)
    rows = read_rows(tmp_path / "all" / "members.csv")
    assert [int(row["seed"]) for row in rows] == [*range(7, 13)] * 2
    np.testing.assert_array_equal([float(row["eval_return"]) for row in rows[6:]], RETURNS)
    with np.load(tmp_path / "all" / "policy.npz") as best:
        assert json.loads(str(best["card"]))["seed"] == 8
    assert len(list((tmp_path / "all" / "members").iterdir())) == 6


def change(run: Path, **values: Any) -> None:
    path = run / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **values}))


def test_what_is_no_whole_population_is_refused(runs: list[Path], tmp_path: Path) -> None:
    def lacks_the_end(run: Path) -> None:
        (run / "eval").rmdir()

    def lacks_a_policy(run: Path) -> None:
        next((run / "members").iterdir()).unlink()

    def another_seed(run: Path) -> None:
        change(run, seed=8)

    def no_share(run: Path) -> None:
        change(run, share=None)

    def outside(run: Path) -> None:
        change(run, share=[3, 3])

    def another_number(run: Path) -> None:
        change(run, share=[1, 4])

    def fewer_seeds(run: Path) -> None:
        change(run, seeds=1, sweep=None)

    def another_source(run: Path) -> None:
        change(run, source_hash="t")

    def no_run(run: Path) -> None:
        (run / "config.json").unlink()

    cases = (
        (lacks_the_end, "run1 was not trained to its end"),
        (lacks_a_policy, "run1 must hold the policies of seeds 9 to 10"),
        (another_seed, "run1 is of another population than .*run0: they differ in first seed"),
        (no_share, "run1 is no part of a population"),
        (outside, "run1 is no part of a population"),
        (another_number, "differ in number of shares"),
        (fewer_seeds, "differ in seeds"),
        (another_source, "differ in source_hash"),
        (no_run, "run1 is not a run directory"),
        (shutil.rmtree, "run1 is not a run directory"),
    )
    kept = tmp_path / "kept"
    shutil.copytree(runs[1], kept)
    for damage, words in cases:
        damage(runs[1])
        with pytest.raises(InputError, match=words):
            shares.gather(runs, tmp_path / "all")
        shutil.rmtree(runs[1], ignore_errors=True)
        shutil.copytree(kept, runs[1])
        assert not (tmp_path / "all").exists(), damage
    with pytest.raises(InputError, match="of 3 shares these are missing: 0, 2"):
        shares.gather(runs[1:2], tmp_path / "all")
    with pytest.raises(InputError, match="are both share 1"):
        shares.gather([*runs, kept], tmp_path / "all")


def test_gathering_takes_no_settings_and_a_new_directory(runs: list[Path], tmp_path: Path, capsys) -> None:
    for more in ([], ["--out", runs[0]], ["--out", tmp_path / "new", "--seed", 3], ["--resume", runs[0]]):
        assert_refused(train, ["--gather", *runs, *more], tmp_path, capsys)
