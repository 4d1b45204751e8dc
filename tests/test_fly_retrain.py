"""Retraining in flight: refusals, and a process that is dead, late or talks nonsense leaves the flight as it is."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import REPOSITORY, TRANSPORT, assert_one_line, call, environment, run
from fly_virtual import VirtualTwin

from mjxball.errors import InputError
from mjxball.fly import retrain
from mjxball.fly.limits import FlightSettings
from mjxball.fly.main import main
from mjxball.fly.retrain import Retrainer
from mjxball.policy import Policy, PolicyFile, save_file
from mjxball.policy.file import shipped_policy

FLIGHT, STAND = shipped_policy("flight"), shipped_policy("stand")
REFUSALS = [
    ([FLIGHT, "--retrain", "--leader", "udp://127.0.0.1:1", "--follower", "udp://127.0.0.1:2"], "--rehearse only"),
    ([FLIGHT, "--retrain", "--rehearse", "--dry-run"], "leave --dry-run out"),
    ([STAND, "--retrain", "--rehearse"], "free flight"),
    ([TRANSPORT, "--retrain", "--rehearse"], "trained on Crazyflies"),
    ([TRANSPORT, "--rehearse", "--twin-load", "0.004", "0.05", "5"], "trained on Crazyflies"),
    ([FLIGHT, "--rehearse", "--twin-load", "0.5", "0.05", "5"], "KG must be 0 to 0.1"),
    ([FLIGHT, "--rehearse", "--twin-load", "0.004", "0.3", "5"], "M must be -0.15 to 0.15"),
]


def test_refusals(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("cflib")
    for arguments, reason in REFUSALS:
        assert call(main, arguments) == 2, arguments
        errors = capsys.readouterr().err
        assert reason in errors
        assert_one_line(errors)


READY = 'say(what="ready")\n'
IDENTIFIED = 'say(what="identified", text="a load")\n'
FINE_TUNED = 'say(what="fine-tuned", policy=sys.argv[1])\n'
WAIT = "sys.stdin.read()\n"
HEAD = """
import json, os, sys, time
def say(**message): print(json.dumps(message), flush=True)
"""


@pytest.fixture
def started(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Retrainer]]:
    """A retrainer whose process runs the given lines of Python; its argument is a policy file."""
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{REPOSITORY}")
    running: list[Retrainer] = []

    def start(lines: str, offered: Path = FLIGHT, flown: Path = FLIGHT) -> Retrainer:
        (tmp_path / "pretended.py").write_text(HEAD + lines)
        one = Retrainer([str(offered)], Policy.load(flown), "pretended")
        running.append(one)
        return one

    yield start
    for one in running:
        one.__exit__()


def heard(one: Retrainer, count: int) -> list[str]:
    """What it said, once that are `count` messages."""
    end = time.monotonic() + 20
    while len(one.said) < count and time.monotonic() < end:
        time.sleep(0.01)
    return [message["what"] for message in one.said]


def test_progress_is_shown_until_it_is_ready(started: Callable[..., Retrainer]) -> None:
    one = started('say(text="1 of 2")\nsay(text="2 of 2")\n' + READY + IDENTIFIED + FINE_TUNED + WAIT)
    shown: list[str] = []
    one.wait(shown.append)
    assert shown == ["1 of 2", "2 of 2"]
    assert heard(one, 2) == ["identified", "fine-tuned"]
    end = time.monotonic() + 20
    policy = one.take()
    while policy is None and time.monotonic() < end:
        policy = one.take()
    assert policy is not None
    assert policy.name == "flight"
    assert one.take() is None  # once


@pytest.mark.parametrize(
    ("lines", "reason"),
    [
        ("sys.exit(1)\n", "ended"),
        ('say(error="jax is not installed")\n', "jax is not installed"),
        (WAIT, "not ready within 1 s"),
        ('print("nonsense", flush=True)\nos.close(1)\n', "ended"),
    ],
)
def test_without_it_no_flight_begins(started: Callable[..., Retrainer], lines: str, reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        started(lines).wait(lambda text: None, limit=1.0 if lines == WAIT else 20.0)


GARBAGE = r"""
os.write(1, b"\xff\xfe{]\n")
os.write(1, b"x" * 200000 + b"\n")
say(what="fine-tuned", policy=5)
say(what="fine-tuned")
say(what=["fine-tuned"], policy=None)
say(what="fine-tuned", policy="/no/such/policy.npz")
print("[1, 2", flush=True)
"""
# What the process does once it is ready, what it hands over, and what the runner makes of it in the end.
WRONG: dict[str, tuple[str, str, str]] = {
    "dead": ("", "sound", "ended"),
    "dead after it identified": (IDENTIFIED, "sound", "ended"),
    "killed": (IDENTIFIED + "os.kill(os.getpid(), 9)\n", "sound", "ended"),
    "garbage": (GARBAGE, "sound", "ended"),
    "nothing was identified": (FINE_TUNED + WAIT, "sound", "too late"),
    "of another rig": (IDENTIFIED + FINE_TUNED + WAIT, "other", "another"),
    "cut short": (IDENTIFIED + FINE_TUNED + WAIT, "cut", "damaged"),
    "not finite": (IDENTIFIED + FINE_TUNED + WAIT, "nan", "not finite"),
}


def offered(kind: str, place: Path) -> Path:
    """A policy file that is of `kind`."""
    path = place / "offered.npz"
    data = FLIGHT.read_bytes()
    if kind == "other":
        return STAND
    if kind == "nan":
        with np.load(FLIGHT) as arrays:
            changed = {name: arrays[name] for name in arrays.files}
        changed["bias_1"] = np.full_like(changed["bias_1"], np.nan)
        np.savez(path, **changed)
        return path
    path.write_bytes(data[: len(data) // 2] if kind == "cut" else data)
    return path


def test_what_is_wrong_is_never_offered(started: Callable[..., Retrainer], tmp_path: Path) -> None:
    for name, (lines, kind, reason) in WRONG.items():
        one = started(READY + lines, offered(kind, tmp_path))
        one.wait(lambda text: None)
        end = time.monotonic() + 20
        while not any(message["what"] == "failed" and reason in message["text"] for message in one.said):
            assert time.monotonic() < end, (name, one.said)
            time.sleep(0.01)
        assert one.take() is None, name


def test_a_policy_that_comes_late_is_not_taken(
    started: Callable[..., Retrainer], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(retrain, "LATE", 0.2)
    one = started(READY + IDENTIFIED + "time.sleep(0.5)\n" + FINE_TUNED + WAIT)
    one.wait(lambda text: None)
    assert heard(one, 3) == ["identified", "fine-tuned", "failed"]
    assert one.take() is None


def test_the_flight_is_the_same_whatever_becomes_of_it(
    started: Callable[..., Retrainer], trained: Any, tmp_path: Path
) -> None:
    """Setpoints of whole flights in virtual time, bit by bit."""
    flown = tmp_path / "flown.npz"
    save_file(flown, trained.contents)

    def sent(one: Retrainer | None) -> list[Any]:
        world = VirtualTwin(FlightSettings(seconds=1.0), contents=trained.contents)
        world.flight.succession._successor = None if one is None else one.take
        world.run()
        return [record["sent"] for record in world.log.records if record["kind"] == "tick"]

    alone = sent(None)
    for name in ("dead", "garbage", "cut short"):
        lines, kind, _ = WRONG[name]
        one = started(READY + lines, offered(kind, tmp_path), flown)
        one.wait(lambda text: None)
        assert sent(one) == alone, name


def test_without_jax_one_sentence(tmp_path: Path) -> None:
    """The process itself says what to install."""
    (tmp_path / "jax.py").write_text("raise ModuleNotFoundError(\"No module named 'jax'\", name='jax')\n")
    surroundings = {**environment(), "PYTHONPATH": f"{tmp_path}:{REPOSITORY}"}
    command = [sys.executable, "-m", "mjxball.commands.retrain", str(FLIGHT), "log.jsonl", "out.npz"]
    with subprocess.Popen(command, cwd=tmp_path, env=surroundings, stdin=-1, stdout=-1) as running:
        assert running.stdout is not None  # it ends with its standard input, which stays open
        lines = running.stdout.read().splitlines()
    assert running.returncode == 2
    assert json.loads(lines[-1]) == {"error": "jax is not installed; pip install 'mjxball[train]'"}


def test_the_runner_loads_no_jax() -> None:
    script = "import sys, mjxball.fly.main, mjxball.fly.retrain, mjxball.rig.load, mjxball.commands.retrain\n"
    done = run(["-c", script + "print('jax' in sys.modules, 'scipy' in sys.modules)"], REPOSITORY)
    assert done.stdout.split() == ["False", "False"], done


def test_a_card_says_what_it_was_retrained_for(tmp_path: Path) -> None:
    from mjxball.commands.retrain import with_origin
    from mjxball.policy import load_file
    from mjxball.rig.load import IdentifiedLoad

    load = IdentifiedLoad(1.0, 0.004, 0.0002, 1e-4, 1e-5, 0.0, 0.0, 0.5, 0.0, 3.8)
    contents: PolicyFile = with_origin(load_file(FLIGHT), load, {"steps": 3})
    save_file(tmp_path / "new.npz", contents)
    assert load_file(tmp_path / "new.npz").card["retrained"] == {"mass": 0.004, "offset": 0.05, "steps": 3}


def test_without_standard_input_it_says_so(tmp_path: Path) -> None:
    """Whose end ends it: closed, or ended before it began."""
    for closed in ("<&-", "</dev/null"):
        command = f'exec "$@" {closed}'
        words = [sys.executable, "-m", "mjxball.commands.retrain", str(FLIGHT), "log.jsonl", str(tmp_path / "out.npz")]
        done = subprocess.run(
            ["bash", "-c", command, "_", *words],
            cwd=REPOSITORY,
            env=environment(),
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
        )
        assert done.returncode == 2, closed
        assert done.stderr.count("\n") == 1
        assert "standard input" in done.stderr
