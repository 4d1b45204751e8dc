"""The wheel and the sdist hold what they must, and what is installed from the wheel finds its policies."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from importlib import metadata
from pathlib import Path

import pytest
from command_line import REPOSITORY

from mjxball import __version__
from mjxball.commands.evaluate import main as evaluate
from mjxball.commands.train import parser as train_parser
from mjxball.export import main as export
from mjxball.policy import Policy, policy_path, shipped_policies, shipped_policy
from mjxball.policy.file import load_file
from mjxball.view.main import main as view
from mjxfly.main import make_parser as fly_parser

PARTS = ("mjxball", "mjxfly", "policies", "docs", "tests", "benchmarks")
FILES = ("*.toml", "*.md", "*.py", "*.cff", "LICENSE", "MANIFEST.in", "constraints.txt")
KINDS = {
    *(".c", ".css", ".csv", ".gif", ".h", ".ipynb", ".json"),
    *(".md", ".npz", ".png", ".py", ".svg", ".toml", ".txt"),
}
BUILD = "import sys; from setuptools import build_meta; getattr(build_meta, f'build_{sys.argv.pop()}')(sys.argv.pop())"


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Directory with the wheel and the sdist, built offline from a copy of the tree by pyproject.toml's backend."""
    if int(metadata.version("setuptools").split(".")[0]) < 77:
        pytest.skip("setuptools 77 or later builds this project; the dev extra has it")
    place = tmp_path_factory.mktemp("packaging")
    tree = place / "tree"
    tree.mkdir()
    for part in PARTS:
        shutil.copytree(REPOSITORY / part, tree / part, ignore=shutil.ignore_patterns("__pycache__"))
    for pattern in FILES:
        for path in REPOSITORY.glob(pattern):
            shutil.copy2(path, tree)
    out = place / "dist"
    out.mkdir()
    for kind in ("wheel", "sdist"):
        command = [sys.executable, "-c", BUILD, str(out), kind]
        subprocess.run(command, check=True, cwd=tree, capture_output=True, timeout=120)
    return out


def parts() -> set[str]:
    """What pages are made of, the plants that have a name, and the C of the apps on board."""
    places = (REPOSITORY / "mjxball" / name for name in ("view/parts", "evaluate/templates", "config/plants"))
    paths = [path for place in places for path in place.iterdir()]
    paths += (path for path in (REPOSITORY / "mjxfly").rglob("*.[chj]*") if path.suffix in (".c", ".h", ".js"))
    return {str(path.relative_to(REPOSITORY)) for path in paths}


@pytest.fixture(scope="module")
def wheel(built: Path) -> Path:
    (path,) = built.glob("*.whl")
    return path


@pytest.mark.slow
def test_the_wheel_holds_every_module_and_policy_and_nothing_else(wheel: Path) -> None:
    held = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    modules = {str(path.relative_to(REPOSITORY)) for house in PARTS[:2] for path in (REPOSITORY / house).rglob("*.py")}
    policies = {f"mjxball/{path.relative_to(REPOSITORY)}" for path in (REPOSITORY / "policies").rglob("*.npz")}
    draws = {f"mjxball/bench/draws/{path.name}" for path in (REPOSITORY / "mjxball" / "bench" / "draws").iterdir()}
    assert len(policies) >= 3
    assert held == modules | policies | draws | parts() | {"mjxball/py.typed", "mjxfly/twin/names.csv"}


@pytest.mark.slow
def test_the_wheel_says_what_it_is(wheel: Path) -> None:
    assert wheel.name == f"mjxball-{__version__}-py3-none-any.whl"
    archive = zipfile.ZipFile(wheel)
    told = archive.read(f"mjxball-{__version__}.dist-info/METADATA").decode()
    assert "License-Expression: Apache-2.0\n" in told
    assert "Requires-Python: >=3.11\n" in told
    needed = [line for line in told.splitlines() if line.startswith("Requires-Dist:") and "extra ==" not in line]
    assert needed == ["Requires-Dist: numpy<3,>=2.1"]  # the base install is NumPy alone
    commands = archive.read(f"mjxball-{__version__}.dist-info/entry_points.txt").decode()
    declared = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]["scripts"]
    assert set(commands.split("\n")) >= {f"{name} = {place}" for name, place in declared.items()}


@pytest.mark.slow
def test_the_unpacked_wheel_finds_its_own_policies(wheel: Path, tmp_path: Path) -> None:
    zipfile.ZipFile(wheel).extractall(tmp_path)
    script = (
        "from mjxball.policy import Policy, shipped_policies, shipped_policy\n"
        "assert all(Policy.load(path) for path in shipped_policies())\n"
        "print(shipped_policy('transport-large'), len(shipped_policies()))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, cwd=tmp_path, timeout=60
    )
    expected = tmp_path / "mjxball" / "policies" / "archive" / "transport-large.npz"
    assert done.stdout.split() == [str(expected), str(len(shipped_policies()))]


FLIGHT = "python -m mjxfly flight --rehearse --seconds 5 --log flight.jsonl"  # of the twin
# extra -> what it is for, typed one after the other in an empty directory.
WORKS = {
    "": [
        "python -c 'from mjxball.policy import Policy, shipped_policy; Policy.load(shipped_policy(\"balance\"))'",
        "python -m mjxball.export balance follower.h",
        "python -m mjxfly.app flight apps",
    ],
    "train": [
        "mjxball-train --help",
        "mjxball-eval balance",
        "mjxball-eval universal --plant team3 --seconds 1",
        "mjxball-eval bench balance --tracks pair --out entry.json",
        "mjxball-eval --followers mpc --seconds 1",
        "python -m mjxball.view balance --seconds 2 --out flight.html",
    ],
    "fly": [FLIGHT, *(f"python -m mjxfly.log flight.jsonl flight.{kind}" for kind in ("mcap", "parquet"))],
    "mocap": ["python -c 'import motioncapture'", FLIGHT],
    "gym": [
        "python -c 'import gymnasium, mjxball.gym; gymnasium.make(\"mjxball/Flight-v0\").reset(seed=0)'",
        "python -c 'from mjxball.gym.parallel import FollowersParallelEnv; FollowersParallelEnv().reset(seed=0)'",
    ],
    "jaxmarl": [
        "python -c 'import jax, jaxmarl.wrappers.baselines as jaxmarl; "
        "from mjxball.gym.jaxmarl import FollowersMultiAgentEnv; "
        "jaxmarl.LogWrapper(FollowersMultiAgentEnv()).reset(jax.random.key(0))'"
    ],
    "onnx": ["python -m mjxball.export flight flight.onnx"],
    "view": ["python -m mjxball.view flight --seconds 2 --out flight.html"],
    "video": ["python -m mjxball.view flight --seconds 1 --video flight.mp4"],
    "docs": ["python -c 'import furo, myst_parser, nbclient, sphinx'"],
}


@pytest.mark.release
@pytest.mark.parametrize("extra", WORKS)
def test_each_extra_works_in_a_clean_environment(extra: str, wheel: Path, tmp_path: Path) -> None:
    venv.create(tmp_path / "venv", with_pip=True)
    programs, empty = tmp_path / "venv" / "bin", tmp_path / "empty"
    empty.mkdir()
    wanted = f"{wheel}[{extra}]" if extra else str(wheel)
    constraints = ["-c", REPOSITORY / "constraints.txt"]
    subprocess.run([programs / "python", "-m", "pip", "install", "-q", *constraints, wanted], check=True, timeout=600)
    ours = ("PYTHONPATH", "XLA_FLAGS")  # another XLA may end a process that is given our flags
    plain = {name: value for name, value in os.environ.items() if name not in ours} | {"BROWSER": "true"}
    for line in WORKS[extra]:
        name, *words = shlex.split(line)
        done = subprocess.run(
            [programs / name, *words], cwd=empty, env=plain, capture_output=True, text=True, timeout=300, check=False
        )
        assert done.returncode == 0, f"{line}\n{done.stderr}"


def contents(wheel: Path) -> dict[str, bytes]:
    """File -> what is in it; the list of hashes aside."""
    archive = zipfile.ZipFile(wheel)
    return {name: archive.read(name) for name in archive.namelist() if not name.endswith("/RECORD")}


@pytest.mark.slow
def test_the_sdist_builds_the_same_wheel(built: Path, wheel: Path, tmp_path: Path) -> None:
    (path,) = built.glob("*.tar.gz")
    with tarfile.open(path) as archive:
        archive.extractall(tmp_path, filter="data")
    (tree,) = tmp_path.iterdir()
    command = [sys.executable, "-c", BUILD, str(tmp_path), "wheel"]
    subprocess.run(command, check=True, cwd=tree, capture_output=True, timeout=120)
    assert contents(tmp_path / wheel.name) == contents(wheel)
    assert {"CHANGELOG.md", "CITATION.cff", "constraints.txt"} <= {path.name for path in tree.iterdir()}
    # What the pages and tests of it read: nothing of a kind that the repository keeps is left out.
    for part in ("docs", "tests", "benchmarks", "policies"):
        there = {path.relative_to(REPOSITORY) for path in (REPOSITORY / part).rglob("*.*") if path.suffix in KINDS}
        assert there <= {path.relative_to(tree) for path in (tree / part).rglob("*")}


def test_a_source_tree_finds_the_policies_beside_it() -> None:
    assert {path.parent for path in shipped_policies()} == {REPOSITORY / "policies"}
    assert Policy(load_file(shipped_policy("transport-large")), "transport-large").name == "transport-large"


def test_an_unknown_policy_is_refused_with_the_names_of_those_there_are() -> None:
    with pytest.raises(ValueError, match=r"'nobody'.*balance.*paper.*robust"):
        shipped_policy("nobody")


def test_commands_take_a_shipped_policy_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    assert evaluate(["balance", "--physics", "newton-euler", "--seconds", "1", "--json", "cells.json"]) == 0
    assert {cell["follower"] for cell in json.loads(Path("cells.json").read_text())["cells"]} == {"balance"}
    assert view(["balance", "--seconds", "1", "--out", "flight.html"]) == 0
    assert export(["flight", "flight.h"]) == 0
    assert fly_parser().parse_args(["flight"]).policy == shipped_policy("flight")
    assert train_parser().parse_args(["--start-from", "universal"]).start_from == shipped_policy("universal")
    Path("balance").write_text("of the user's own")
    assert policy_path("balance") == Path("balance")
    capsys.readouterr()
    assert evaluate(["balanced"]) == 2
    assert "balanced does not exist (did you mean balance?); by name there are balance" in capsys.readouterr().err
