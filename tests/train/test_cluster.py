"""Training under SLURM and Open MPI, as Debian has them, on loopback, with the scripts of `docs/howto/cluster.md`."""

from __future__ import annotations

import csv
import json
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import slurm
from command_line import REPOSITORY, STEPS, environment, tiny
from slurm import Cluster, wait_until

from mjxball.commands.train import main as train
from mjxball.train.lock import LOCK
from train.test_distributed import finish, launch

LIMIT = 400.0  # [s] on a machine that others keep busy
TRAIN = shlex.join([sys.executable, "tests/short_train.py"])
FIRST_EVALUATION = 2 * STEPS  # after which the run would save by itself
MEMBERS = [*tiny(sac__total_steps=2 * FIRST_EVALUATION, sac__num_evaluations=2), "--num-seeds", "2"]

pytestmark = [pytest.mark.slow, pytest.mark.release]


@pytest.fixture(scope="module")
def cluster() -> Iterator[Cluster]:
    if missing := slurm.missing():
        pytest.skip(f"not installed: {', '.join(missing)}")
    with slurm.cluster() as made:
        yield made


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two processes that nothing interrupts."""
    run = tmp_path_factory.mktemp("runs") / "whole"
    children = launch([*MEMBERS, "--out", str(run)], tmp_path_factory.getbasetemp() / "cache")
    outputs = finish(children)
    assert [child.returncode for child in children] == [0, 0], outputs
    return run


def scripts() -> list[str]:
    """The batch scripts of the page, that of both machines and that of a job array, calling what tests train with.

    Without the lines of hardware that these nodes lack.
    """
    page = (REPOSITORY / "docs" / "howto" / "cluster.md").read_text()
    found = re.findall(r"```bash\n(#!/bin/bash\n.*?)```", page, re.DOTALL)
    return [re.sub(r"#SBATCH --[cg]pus.*\n", "", text).replace("python train.py", TRAIN) for text in found]


def replaced(text: str, words: dict[str, Any]) -> str:
    """`text` with other words in place of some, all of which it must have."""
    for old, new in words.items():
        assert old in text
        text = text.replace(old, str(new))
    return text


def steps(run: Path) -> int:
    """Environment steps of the newest row of a run's metrics; 0 before the first."""
    try:
        rows = list(csv.DictReader((run / "metrics.csv").read_text().splitlines()))
    except FileNotFoundError:
        return 0
    return int(rows[-1]["steps"]) if rows else 0


def assert_same_policies(first: Path, second: Path) -> None:
    for seed in (0, 1):
        one, other = (np.load(run / "members" / f"seed{seed}.npz") for run in (first, second))
        arrays = [name for name in one.files if name != "card"]
        assert len(arrays) > 4
        assert all(one[name].tobytes() == other[name].tobytes() for name in arrays)


def test_preempted_and_requeued_job_resumes_to_the_same_bits(cluster: Cluster, whole: Path, tmp_path: Path) -> None:
    """A job of higher priority puts it off; then SIGTERM reaches its step, as at the end of its time."""
    run = tmp_path / "run"
    settings = {"balance --algorithm sac --num-seeds 8 --physics newton-euler": shlex.join(MEMBERS), "runs/many": run}
    job = cluster.submit(replaced(scripts()[0], settings), "--nodes=2", "--ntasks-per-node=1")
    wait_until(lambda: steps(run) > 0, LIMIT)
    assert cluster.call("srun", "--partition=high", "--nodes=2", "true").returncode == 0
    kept = steps(run)
    assert 0 < kept < FIRST_EVALUATION, cluster.output(job)  # what saved was the signal
    wait_until(lambda: steps(run) > kept, LIMIT)
    assert cluster.call("scancel", "--signal=TERM", job).returncode == 0
    cluster.wait_for(job, LIMIT)
    output = cluster.output(job)
    continued = [int(n.replace(",", "")) for n in re.findall(rf"continuing {run} after ([\d,]+) of", output)]
    assert len(continued) == 2, output
    assert continued[0] == kept
    assert_same_policies(run, whole)


def test_job_array_trains_a_population_in_parts(cluster: Cluster, tmp_path: Path) -> None:
    """Brought together its members are those of one run, to the last bit."""
    sweep = tmp_path / "sweep.json"
    sweep.write_text('{"sac.discount": [0.9, 0.99]}')
    settings = f"{shlex.join(tiny())} --num-seeds 2 --sweep {sweep}"
    words = {"--num-seeds 64 --sweep sweep.json": settings, "_ID/8": "_ID/2", "runs/seeds": tmp_path}
    script = replaced(scripts()[1], words)
    job = cluster.submit(script, "--array=0-1", "--ntasks=1")
    cluster.wait_for(job, LIMIT)
    whole, parts = tmp_path / "whole", [str(tmp_path / name) for name in "01"]
    done = cluster.call("srun", "--ntasks=1", *shlex.split(f"{TRAIN} {settings}"), "--out", whole)
    assert done.returncode == 0, done.stderr
    gathered = tmp_path / "all"
    assert train(["--gather", *parts, "--out", str(gathered)]) == 0
    assert (gathered / "members.csv").read_bytes() == (whole / "members.csv").read_bytes()
    assert_same_policies(gathered, whole)


def test_mpirun_trains_and_resumes_to_the_same_bits(whole: Path, tmp_path: Path) -> None:
    """SIGTERM reaches process 0, whose number is in the lock."""
    if shutil.which("mpirun") is None:
        pytest.skip("not installed: mpirun")
    run = tmp_path / "run"
    child = {
        **environment(),
        **{"PYTHONPATH": str(REPOSITORY), "OMPI_MCA_oob_tcp_if_include": "lo"},
        **{"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"},
    }

    def start(*arguments: object) -> subprocess.Popen[str]:
        command = ["mpirun", "-n", "2", *shlex.split(TRAIN), *map(str, arguments), "--distributed"]
        pipe = subprocess.PIPE
        return subprocess.Popen(command, cwd=REPOSITORY, env=child, stdout=pipe, stderr=subprocess.STDOUT, text=True)

    first = start(*MEMBERS, "--out", run)
    try:
        wait_until(lambda: steps(run) > 0 or first.poll() is not None, LIMIT)
        os.kill(json.loads((run / LOCK).read_text())["pid"], signal.SIGTERM)
        output = first.communicate(timeout=LIMIT)[0]
    finally:
        first.kill()
    kept = steps(run)
    assert 0 < kept < FIRST_EVALUATION, output
    second = start("--resume", run)
    output = second.communicate(timeout=LIMIT)[0]
    assert second.returncode == 0, output
    assert f"continuing {run} after {kept:,} of" in output
    assert_same_policies(run, whole)
