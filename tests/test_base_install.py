"""A policy flies with the base install alone: NumPy, no JAX, no MuJoCo."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import venv
from pathlib import Path

import numpy as np
import pytest
from command_line import REPOSITORY, TRANSPORT

from mjxball.policy import Policy

PARTS = ("mjxball", "mjxfly", "pyproject.toml", "README.md", "LICENSE")
HEAVY = ("jax", "jaxlib", "flax", "brax", "mujoco", "matplotlib")
SCRIPT = f"""
import importlib.util, json, sys
import numpy as np
import mjxball.policy
policy = mjxball.policy.Policy.load(sys.argv[1])
commands = [policy(np.array(row)).tolist() for row in json.loads(sys.argv[2])]
found = [name for name in {HEAVY!r} if importlib.util.find_spec(name) or name in sys.modules]
print(json.dumps({{"commands": commands, "heavy": found, "where": mjxball.__file__}}))
"""


@pytest.fixture(scope="module")
def base_python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Python of a fresh virtual environment with the project's base dependencies, installed from a copy."""
    place = tmp_path_factory.mktemp("base")
    tree = place / "tree"
    tree.mkdir()
    for part in PARTS:
        source = REPOSITORY / part
        if source.is_dir():
            shutil.copytree(source, tree / part, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(source, tree / part)
    venv.create(place / "venv", with_pip=True)
    python = place / "venv" / ("Scripts" if os.name == "nt" else "bin") / "python"
    constraints = ["-c", REPOSITORY / "constraints.txt"]
    subprocess.run([python, "-m", "pip", "install", "-q", *constraints, tree], check=True, timeout=300, cwd=place)
    return python


@pytest.mark.release  # with the packages of this environment, test_readme.py
def test_policy_needs_numpy_alone(base_python: Path, tmp_path: Path) -> None:
    draw = np.random.default_rng(0)
    observations = draw.normal(scale=0.5, size=(20, 18))
    done = subprocess.run(
        [base_python, "-I", "-c", SCRIPT, TRANSPORT, json.dumps(observations.tolist())],
        capture_output=True,
        text=True,
        check=True,
        timeout=60,
        cwd=tmp_path,
    )
    answer = json.loads(done.stdout)
    assert answer["heavy"] == []
    assert not Path(answer["where"]).is_relative_to(REPOSITORY)
    here = Policy.load(TRANSPORT)
    expected = np.array([here(row) for row in observations])
    # float32 on the same NumPy; another BLAS build may round the last bits of the hidden layers differently.
    np.testing.assert_allclose(answer["commands"], expected, rtol=0, atol=1e-6)
