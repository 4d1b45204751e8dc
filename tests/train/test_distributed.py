"""Two CPU processes on loopback train together; a lost one ends the other, and the run goes on from its checkpoint."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import assert_one_line, environment

from mjxball.algorithms import ALGORITHMS
from mjxball.commands.train import main as train
from mjxball.errors import InputError
from mjxball.policy import Policy
from mjxball.train.checkpoint import CHECKPOINTS
from mjxball.train.population import grid
from mjxball.train.processes import Rendezvous, join
from mjxball.train.program import TrainingProgram

REPOSITORY = Path(__file__).parents[2]
SMALL = [
    *("--physics", "newton-euler", "--sac.num_envs", "8", "--sac.replay_size", "800", "--sac.batch_size", "16"),
    *("--sac.warmup_steps", "100", "--sac.updates_per_step", "1", "--timing.episode_steps", "60"),
    *("--sac.policy_layers", "8", "--sac.critic_layers", "8"),
]
LIMIT = 240  # [s] for a pair of processes


def launch(arguments: list[str], cache: Path) -> list[subprocess.Popen[str]]:
    """Two processes that meet on a free port of loopback."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    meeting = ["--distributed", "--coordinator", f"127.0.0.1:{port}", "--processes", "2", "--process"]
    child = {**environment(), "MJXBALL_CACHE": str(cache), "PYTHONPATH": str(REPOSITORY)}
    return [
        subprocess.Popen(
            [sys.executable, "tests/short_train.py", *arguments, *meeting, str(process)],
            cwd=REPOSITORY,
            env=child,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for process in range(2)
    ]


def finish(children: list[subprocess.Popen[str]]) -> list[str]:
    """Outputs of both, which must end within the limit."""
    try:
        return [child.communicate(timeout=LIMIT)[0] for child in children]
    finally:
        for child in children:
            child.kill()


def checkpoints(run: Path) -> list[int]:
    place = run / CHECKPOINTS
    return sorted(int(path.name) for path in place.iterdir() if path.name.isdigit()) if place.is_dir() else []


@pytest.mark.release
def test_lost_process_ends_the_other_and_the_run_resumes(tmp_path: Path) -> None:
    """Two members, one on each process; long after every checkpoint that the test waits for, the run goes on."""
    run, cache = tmp_path / "run", tmp_path / "cache"
    long = ["--sac.total_steps", "400000", "--sac.num_evaluations", "40"]
    children = launch([*SMALL, "--seeds", "2", *long, "--out", str(run)], cache)
    try:
        deadline = time.monotonic() + LIMIT
        while not checkpoints(run) and children[0].poll() is None and time.monotonic() < deadline:
            time.sleep(0.05)
        assert checkpoints(run), "no checkpoint came before the limit"
        children[1].send_signal(signal.SIGKILL)
        output = children[0].communicate(timeout=60)[0]
    finally:
        for child in children:
            child.kill()
            child.wait()
    assert children[0].returncode != 0, output
    assert f"Start all of them again with --resume {run}" in output
    kept = checkpoints(run)[-1]
    assert kept < 400_000

    # What is left to do is cut short, so that the test is: the first chunk after the checkpoint, then Ctrl-C for all.
    children = launch(["--resume", str(run)], cache)
    deadline = time.monotonic() + LIMIT
    while checkpoints(run)[-1] == kept and children[0].poll() is None and time.monotonic() < deadline:
        time.sleep(0.05)
    for child in children:
        child.send_signal(signal.SIGINT)
    outputs = finish(children)
    assert [child.returncode for child in children] == [130, 130], outputs
    assert f"continuing {run} after" in outputs[0]
    assert checkpoints(run)[-1] > kept
    for seed in (0, 1):
        assert Policy.load(run / "members" / f"seed{seed}.npz").metadata["training_steps"] >= kept


@pytest.mark.slow
def test_worlds_of_one_follower_are_split_over_the_processes(tmp_path: Path) -> None:
    run = tmp_path / "run"
    point = ["--env", "toys:DoubleIntegrator", "--algorithm", ALGORITHMS["sac"], "--sac.total_steps", "2400"]
    children = launch([*SMALL, *point, "--out", str(run)], tmp_path / "cache")
    outputs = finish(children)
    assert [child.returncode for child in children] == [0, 0], outputs
    with np.load(run / "policy.npz") as policy:
        assert json.loads(str(policy["card"]))["training_steps"] == 2400
    assert "policy:" not in outputs[1]  # one process writes and prints
    assert (run / "eval" / "training.png").stat().st_size > 10_000
    assert train(["--resume", str(run)]) == 2  # one process cannot take over halves of a replay


@pytest.mark.parametrize(
    ("members", "devices", "together", "expected"),
    [
        (1, 4, False, (1, 1)),
        (8, 4, False, (4, 1)),
        (3, 4, False, (1, 1)),
        (1, 4, True, (1, 4)),
        (8, 4, True, (4, 1)),
        (6, 4, True, (2, 2)),
    ],
)
def test_devices_are_arranged_by_members_first(members, devices, together, expected) -> None:
    assert grid(members, devices, split=together) == expected


TRACE = """
import sys, jax
from mjxball.config import preset
jax.distributed.initialize(sys.argv[1], 2, int(sys.argv[2]))
from mjxball.env import TransportEnv
env = TransportEnv(preset("transport"), "mjx")
state = jax.eval_shape(env.reset, jax.random.PRNGKey(0))
jax.jit(env.step).lower(state, jax.ShapeDtypeStruct((3,), "float32"))
print("traced by", jax.process_index())
"""


@pytest.mark.slow
def test_every_process_can_trace_mjx() -> None:
    """MJX's own choice of a device is the first of all processes, whose arrays no other process may use."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        place = f"127.0.0.1:{free.getsockname()[1]}"
    children = [
        subprocess.Popen(
            [sys.executable, "-c", TRACE, place, str(process)],
            cwd=REPOSITORY,
            env=environment(),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for process in range(2)
    ]
    for process, output in enumerate(finish(children)):
        assert f"traced by {process}" in output, output


@pytest.mark.parametrize(
    ("meeting", "word"),
    [
        (("127.0.0.1:1234", 2, None), "belong together"),
        (("127.0.0.1", 2, 0), "HOST:PORT"),
        (("127.0.0.1:99999", 2, 0), "HOST:PORT"),
        (("127.0.0.1:\N{SUPERSCRIPT TWO}", 2, 0), "HOST:PORT"),
        (("127.0.0.1:1234", 2, 2), "0 .. 1"),
        (("127.0.0.1:1234", 0, 0), "--processes must be 1 .. 4096, not 0"),
        (("127.0.0.1:1234", 10**9, 0), "--processes must be 1 .. 4096, not 1000000000"),
        ((":1234", 2, 0), "HOST:PORT"),
    ],
)
def test_unsound_meetings_are_refused(meeting, word) -> None:
    with pytest.raises(InputError, match=word):
        Rendezvous(*meeting)


def refusal(code: str, **variables: str) -> str:
    """What a process that runs `code` prints before it ends with exit code 2, one line."""
    clean = {name: value for name, value in environment().items() if not name.startswith(("SLURM", "OMPI", "KUBE"))}
    child = {**clean, "PYTHONPATH": str(REPOSITORY), **variables}
    done = subprocess.run([sys.executable, "-c", code], env=child, capture_output=True, text=True, check=False)
    assert done.returncode == 2, done.stderr
    assert_one_line(done.stderr)
    return done.stderr


ALONE = "import sys; from mjxball.commands.train import main; sys.exit(main(['--distributed']))"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("variables", "words"),
    [
        ({}, "found none of SLURM, Open MPI, Kubernetes"),
        ({"SLURM_JOB_ID": "1"}, "found SLURM, but not where the processes meet: start the processes with srun"),
        ({"OMPI_COMM_WORLD_SIZE": "2"}, "found Open MPI"),
        ({"KUBERNETES_SERVICE_HOST": "127.0.0.1"}, "found Kubernetes"),
    ],
)
def test_without_a_coordinator_it_says_what_it_found(variables, words, tmp_path: Path) -> None:
    assert words in refusal(f"import os; os.chdir({str(tmp_path)!r}); {ALONE}", **variables)
    assert list(tmp_path.iterdir()) == []


MEET = """
import sys
from mjxball import running
from mjxball.train import processes
running.quit_on_interrupt()
processes.PATIENCE = {patience}
sys.exit(running.run_command(lambda: processes.join(processes.Rendezvous({place!r}, 2, {process}))))
"""


@pytest.mark.slow
@pytest.mark.parametrize("process", [0, 1])
def test_a_process_that_meets_nobody_says_so(process: int) -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        place = f"127.0.0.1:{free.getsockname()[1]}"
    assert f"did not come together at {place} within 2 s" in refusal(
        MEET.format(place=place, process=process, patience=2)
    )


def listeners(port: int) -> set[str]:
    """Addresses as the kernel writes them, at which somebody of this machine listens on `port`."""
    lines = [line.split() for name in ("tcp", "tcp6") for line in Path(f"/proc/net/{name}").read_text().splitlines()]
    places = [place.rpartition(":") for _, place, _, state, *_ in lines if state == "0A"]
    return {address for address, _, own in places if own == f"{port:04X}"}


@pytest.mark.slow
def test_who_waits_for_the_others_listens_where_it_was_told_and_hears_signals() -> None:
    waiting = []
    for host, told in (("localhost", signal.SIGINT), ("127.0.0.1", signal.SIGTERM)):
        with socket.create_server(("127.0.0.1", 0)) as free:
            port = free.getsockname()[1]
        code = MEET.format(place=f"{host}:{port}", process=0, patience=LIMIT)
        waiting.append((port, told, subprocess.Popen([sys.executable, "-c", code], env=environment())))
    try:
        for port, told, child in waiting:
            deadline = time.monotonic() + LIMIT
            while not (found := listeners(port)) and child.poll() is None and time.monotonic() < deadline:
                time.sleep(0.05)
            assert found <= {"0100007F", "0000000000000000FFFF00000100007F", "00000000000000000000000001000000"}, found
            assert found
            child.send_signal(told)
            assert child.wait(timeout=LIMIT / 4) == (130 if told == signal.SIGINT else -told)
    finally:
        for _, _, child in waiting:
            child.kill()


ELSEWHERE = """
import signal, time, jax
def initialize(*_, **named):
    time.sleep(1.0)
    signal.raise_signal(signal.SIGINT)
    time.sleep(1e4)
jax.distributed.initialize = initialize
"""


@pytest.mark.slow
def test_who_waits_hears_a_signal_that_came_to_another_thread() -> None:
    """The main thread's wait is not interrupted by it, nor by one that comes just before the wait."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        place = f"127.0.0.1:{free.getsockname()[1]}"
    code = ELSEWHERE + MEET.format(place=place, process=0, patience=LIMIT)
    assert subprocess.call([sys.executable, "-c", code], env=environment(), timeout=LIMIT / 4) == 130


def test_where_process_0_listens(monkeypatch: pytest.MonkeyPatch) -> None:
    """At the address that it is given, if it is one of this machine's: `192.0.2.1` is nobody's (RFC 5737)."""
    given: list[Any] = []
    monkeypatch.setattr(
        "jax.distributed.initialize", lambda *_, **named: given.append(named["coordinator_bind_address"])
    )
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    for place, process, expected in (
        (f"127.0.0.1:{port}", 0, f"127.0.0.1:{port}"),
        (f"192.0.2.1:{port}", 0, None),
        (f"127.0.0.1:{port}", 1, None),
    ):
        join(Rendezvous(place, 2, process))
        assert given[-1] == expected, place


def test_a_taken_port_is_refused() -> None:
    with socket.create_server(("", 0)) as taken:
        place = f"127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(InputError, match="has that port"):
            join(Rendezvous(place, 2, 0))


def test_the_only_gpu_that_a_process_sees_is_its_first(monkeypatch: pytest.MonkeyPatch) -> None:
    """`srun --gpus-per-task=1` shows each its own, and JAX would ask the second process of a node for a second one."""
    given: list[Any] = []
    monkeypatch.setattr("jax.distributed.initialize", lambda *positional, **named: given.append(positional[3]))
    for visible, expected in ((None, None), ("", None), ("0,1", None), ("3", [0]), ("GPU-0a1b", [0])):
        with monkeypatch.context() as patch:
            patch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
            if visible is not None:
                patch.setenv("CUDA_VISIBLE_DEVICES", visible)
            join(Rendezvous())
        assert given[-1] == expected, visible


def test_sizes_that_cannot_be_split_are_refused(transport) -> None:
    TrainingProgram(transport, "newton-euler").algorithm.check_parts(4)
    with pytest.raises(InputError, match=r"sac\.num_envs = 512"):
        TrainingProgram(transport, "newton-euler").algorithm.check_parts(3)


def test_meeting_flags_need_distributed(capsys: pytest.CaptureFixture) -> None:
    assert train(["--coordinator", "127.0.0.1:1234", "--processes", "2", "--process", "0"]) == 2
    assert "--distributed" in capsys.readouterr().err
