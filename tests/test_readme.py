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
from command_line import REPOSITORY, TINY, environment
from packaging.requirements import Requirement

README = (REPOSITORY / "README.md").read_text()
ROWS = re.findall(r"^(?!task)(\S.*?) \| `(.+?)` \| `?(\w+)`?.*$", README, flags=re.MULTILINE)
# What a cell is given besides, so that it takes seconds.
TRAINING = shlex.join(str(part) for pair in TINY.items() for part in pair)
GRADIENT = "--gradient.impulse_response 0 --gradient.gradient_steps 2 --gradient.num_envs 8 --gradient.horizon 20"
SHORTER = {
    "train.py balance": GRADIENT,
    "train.py --distributed": TRAINING,
    "train.py --plant": TRAINING,
    "eval.py bench": "--tracks pair",
    "eval.py figures": "--only speeds --physics newton-euler",
    "eval.py policies/universal.npz": "--physics newton-euler",
    "--rehearse": "--seconds 5",
}


# What takes half a minute, and other tests run as well: before a release.
LONG = ("--algorithm gradient", "--plant team3", "--distributed", "eval.py bench", "--rehearse")


def shown(found: dict[str, Any], key: str, factor: float, digits: int) -> str:
    values = [found[condition][key] for condition in ("undisturbed", "disturbed")]
    return "/".join("never" if value is None else f"{factor * value:.{digits}f}" for value in values)


def tracks_of(name: str) -> dict[str, Any]:
    """Of a follower's entry."""
    return json.loads((REPOSITORY / "benchmarks" / "leaderboard" / f"{name}.json").read_text())["tracks"]


def test_the_table_of_followers_is_the_leaderboards() -> None:
    """Every row, from the entry that the page shows."""
    rows = re.findall(r"^\**`([\w-]+)`.*? \| (.+?) \| (.+?) \| (.+?) \| (.+?) \| (.+)$", README, flags=re.MULTILINE)
    assert {"copy", "adaptive", "pid", "observer", "lqg-offset-free", "mpc", "sac", "balance"} <= {
        row[0] for row in rows
    }
    for name, settling, peak, met, unknown, limit in rows:
        tracks = tracks_of(name)
        known = tracks["pair"]
        wanted = (shown(known, "settling_50", 1, 2), shown(known, "peak_90", 1e3, 0), shown(known, "met", 100, 0))
        assert (settling, peak, met) == wanted, name
        assert limit == shown(known, "rotors_at_limit", 100, 1), name
        assert unknown == shown(tracks["pair-unknown"], "met", 100, 0), name


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


def test_what_is_said_of_commands_is_the_leaderboards() -> None:
    """`balance` against the other rows that settle within 3 s, under noise."""
    words = r"commands change by\s+(\d+) mrad a step, those of the others that settle within 3 s by (\d+) to (\d+)"
    told = re.search(words, README)
    assert told is not None
    names = re.findall(r"^\**`([\w-]+)`.* \| ", README, flags=re.MULTILINE)
    found = {name: tracks_of(name)["pair"]["disturbed"] for name in names}
    quick = {name: 1e3 * one["command_change"] for name, one in found.items() if (one["settling_50"] or 99) <= 3}
    limits = {name: one["rotors_at_limit"] for name, one in found.items() if name in quick}
    assert min(limits, key=lambda name: limits[name]) == "mpc"
    own = quick.pop("balance")
    assert [round(one) for one in (own, min(quick.values()), max(quick.values()))] == [
        int(one) for one in told.groups()
    ]


def test_what_the_first_training_meets_is_the_leaderboards() -> None:
    share = tracks_of("transport-sac")["pair"]["undisturbed"]["met"]
    assert f"(`transport`; {100 * share:.0f} % met)" in README


def test_the_table_is_read() -> None:
    assert len(ROWS) >= 10
    assert {extra for _, _, extra in ROWS} >= {"none", "train", "fly", "gym", "onnx"}


@pytest.mark.slow
def test_the_snippet_prints_what_stands_below_it() -> None:
    snippet = re.search(r"```python\n(.*?)```", README, re.DOTALL)[1]
    done = subprocess.run([sys.executable, "-c", snippet], cwd=REPOSITORY, capture_output=True, text=True, check=True)
    assert f"# {done.stdout}" == snippet[snippet.rindex("#") :]


WORDS = {"README.md": 650, "docs/results.md": 1500, "docs/archive/*.md": 7500}


@pytest.mark.parametrize("pages", WORDS)
def test_pages_stay_short(pages: str) -> None:
    """By `wc -w`."""
    assert sum(len(path.read_text().split()) for path in REPOSITORY.glob(pages)) <= WORDS[pages]


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
