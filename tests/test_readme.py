"""README's table of tasks: every cell runs where nothing but its extra is installed."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import pytest
from bench.entries import known, reasons, results
from command_line import REPOSITORY, TINY, environment
from packaging.requirements import Requirement

sys.path.append(str(REPOSITORY / "docs"))
import readme
from readme import BLOCK, block

import leaderboard
from mjxball.bench import CONDITIONS
from mjxball.bench.tracks import TRACKS

README = (REPOSITORY / "README.md").read_text()
ROWS = re.findall(r"^(?!task)(\S.*?) \| `(.+?)` \| `?(\w+)`?.*$", README, flags=re.MULTILINE)
# What a cell is given besides, so that it takes seconds.
TRAINING = shlex.join(str(part) for pair in TINY.items() for part in pair)
GRADIENT = "--gradient.impulse_response 0 --gradient.gradient_steps 2 --gradient.num_envs 8 --gradient.horizon 20"
SHORTER = {
    "train.py balance": GRADIENT,
    "train.py --plant": TRAINING,
    "eval.py policies/universal.npz": "--physics newton-euler",
    "--rehearse": "--seconds 5",
}


# What takes half a minute, and other tests run as well: before a release.
LONG = (
    "train.py balance",
    "--plant team3",
    "--rehearse",
)


def test_the_block_of_the_leaderboard_is_what_its_script_writes() -> None:
    assert BLOCK.search(README)[0] == block()


@pytest.fixture
def entered(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Lets the block be made of these entries, by the follower's name."""

    def enter(**tracks: dict[str, Any]) -> str:
        for name, flown in tracks.items():
            (tmp_path / f"{name}.json").write_text(json.dumps(known(follower=name, tracks=flown)))
        leaderboard.entries.cache_clear()
        return block()

    monkeypatch.setattr(leaderboard, "ENTRIES", tmp_path)
    yield enter
    leaderboard.entries.cache_clear()


def test_the_block_has_a_row_for_every_task_and_names_the_best(entered: Any) -> None:
    usual = {"calm": results(), "disturbed": results(late_error_90=0.018)}
    better = {**usual, "disturbed": {**reasons(rotors=9), "succeeded": 101, "late_error_90": 0.018}}
    empty = entered()
    text = entered(copy={"pair": usual}, lqg={"pair": better, "pair-unknown": usual}, balance={"pair": usual})
    rows = [line.split(" | ") for line in text.splitlines() if line.count(" | ")]
    assert [row[0] for row in rows] == ["task", *(TRACKS[one].title for one in readme.ROWS)]
    assert rows[1][1:] == ["`copy`, `lqg` 83, `balance` 83", "`lqg` 84, `balance` 83"]  # within the intervals
    assert rows[2][1:] == ["-", "-"]  # a track that was not flown
    assert len(text.splitlines()) == len(empty.splitlines())
    rows = [line.strip("| ").split(" | ") for line in leaderboard.bests().splitlines()[2:]]
    assert [row[:5] for row in rows] == [
        ["pair, mass known", "calm", "learned", "`balance`", "83"],
        *(["pair, mass known", "calm", "classical", name, "83"] for name in ("`copy`", "`lqg`")),
        ["pair, mass known", "disturbed", "learned", "`balance`", "83"],
        ["pair, mass known", "disturbed", "classical", "`lqg`", "84"],
        *(["pair, mass unknown", one, "classical", "`lqg`", "83"] for one in ("calm", "disturbed")),
    ]
    assert rows[0][5:] == ["8.0", "2.0", "1.020", "10.0"]
    worse = {**usual, "calm": {**reasons(late=44), "succeeded": 60, "late_error_90": 0.5}}
    apart = entered(lqg={"pair": usual}, balance={"pair": worse}).splitlines()
    assert apart[3].split(" | ")[1] == "**`copy`, `lqg` 83**, `balance` 50"


def test_the_chart_shows_the_best_of_the_leaderboard() -> None:
    """Its picture is that of today's entries."""
    chart = (REPOSITORY / "docs" / "best.svg").read_text()
    shown = re.findall(r"<text [^>]*>([\w-]+(?:, [\w-]+)* \d+|not flown)</text>", chart)
    expected = []
    for condition in CONDITIONS:
        for names in leaderboard.KINDS.values():
            for track in TRACKS:
                share, found = leaderboard.best(names, track, condition)
                who = ", ".join(entry["follower"] for entry in found)
                expected.append(f"{who} {share:.0f}" if found else "not flown")
    assert shown == expected


def test_the_block_says_what_the_first_training_is_worth(
    entered: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = {
        "median": {"policy": 99.6, "calm": 0.625, "disturbed": 0.4},
        "rows": [{"seed": 0}, {"seed": 1}, {"seed": 0}],
    }
    (tmp_path / "first.txt").write_text(json.dumps(record))
    sentence = next(iter(readme.FIRST.values()))
    monkeypatch.setattr(readme, "FIRST", {tmp_path / "first.txt": sentence})
    assert "\n`python train.py` trains a follower for a pair in 100 s on two cores: 62/40 % (medians).\n" in entered()


def needed(extra: str) -> set[str]:
    """Names of the distributions that `pip install mjxball[extra]` would bring, of those installed here."""
    found: set[str] = set()
    open_ones = [("mjxball", extra)]
    seen: set[tuple[str, str]] = set()
    while open_ones:
        name, own = open_ones.pop()
        if (name, own) in seen:
            continue
        seen.add((name, own))
        try:
            requires = metadata.requires(name) or []
        except metadata.PackageNotFoundError:
            continue  # of another platform
        if name != "mjxball":
            found.add(name)
        for text in requires:
            one = Requirement(text)
            if one.marker is None or one.marker.evaluate({"extra": own}):
                open_ones += [(one.name.lower(), wanted) for wanted in ("", *one.extras)]
    return found


def site_of(extra: str, place: Path) -> Path:
    """A directory of links to these distributions and nothing else."""
    place.mkdir()
    for name in needed(extra):
        files = metadata.distribution(name)
        root = Path(str(files.locate_file("")))
        for top in {file.parts[0] for file in files.files or ()} - {"..", "__pycache__"}:
            if not (place / top).exists():
                (place / top).symlink_to(root / top)
    return place


@pytest.fixture
def here(tmp_path: Path) -> Path:
    """A directory that looks like a checkout."""
    for name in ("policies", "mjxball", "mjxfly", "train.py", "eval.py"):
        (tmp_path / name).symlink_to(REPOSITORY / name)
    return tmp_path


def run(words: Sequence[str], here: Path, site: Path) -> None:
    child = {**environment(), "PYTHONPATH": f"{site}{os.pathsep}{here}", "MPLBACKEND": "agg", "BROWSER": "true"}
    command = [sys.executable, "-S", *words[1:]]
    done = subprocess.run(command, cwd=here, env=child, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr[-2000:]


def test_the_table_is_read() -> None:
    assert len(ROWS) >= 6
    assert {extra for _, _, extra in ROWS} >= {"none", "train", "fly", "onnx"}


WORDS = {"README.md": 500, "docs/results.md": 1300, "docs/archive/*.md": 6600}


@pytest.mark.parametrize("pages", WORDS)
def test_pages_stay_short(pages: str) -> None:
    """By `wc -w`, without comments; a value from the code is one word."""
    texts = [re.sub(r"<!--.*?-->|(?<={)\{.*?\}(?=})", "", path.read_text()) for path in REPOSITORY.glob(pages)]
    assert sum(len(text.split()) for text in texts) <= WORDS[pages]


def test_an_extra_brings_what_it_names() -> None:
    assert "numpy" in needed("none")
    assert not {"jax", "cflib", "onnx", "gymnasium"} & needed("none")
    assert "jax" in needed("train")
    assert "cflib" in needed("fly") - needed("train")


def cells() -> list[Any]:
    """Every row, its mark that of the tier which runs it."""
    marks = {cell: "release" if any(part in cell for part in LONG) else "slow" for _, cell, _ in ROWS}
    return [pytest.param(*row, id=row[1][:40], marks=getattr(pytest.mark, marks[row[1]])) for row in ROWS]


@pytest.mark.parametrize(("task", "cell", "extra"), cells())
def test_a_cell_runs_with_its_extra_alone(task: str, cell: str, extra: str, here: Path) -> None:
    site = site_of("train" if extra == "gpu" else extra, here / "site")
    if "--resume" in cell:
        run(shlex.split(f"python train.py --out runs/mine {TRAINING}"), here, site)
    more = next((flags for part, flags in SHORTER.items() if part in cell), "")
    run(shlex.split(f"{cell} {more}"), here, site)
