"""Nothing here touches the network: not training, not judging, not export. (The drones' links and the processes of
`--distributed` are the exceptions, and neither runs here.)

Python's audit hooks see every connection and every look-up of a name that Python code makes, in the children as well.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import REPOSITORY, environment, tiny

# Loaded by every Python process that finds it: notes what it sees, one line each.
HOOK = """
import os, sys
EVENTS = {f"socket.{name}" for name in ("connect", "getaddrinfo", "gethostbyname", "sendto", "bind")}
def note(event, arguments):
    if event in EVENTS and getattr(arguments[0], "family", None) != 1:  # 1: a socket that is a file
        with open(os.environ["NETWORK_LOG"], "a") as log:
            log.write(f"{event} {arguments[1:] or arguments!r}\\n")
sys.addaudithook(note)
"""
WORK = f"""
import short_train
from mjxball import export
from mjxball.commands import evaluate, train
train.standard_scenarios = short_train.one_second
codes = [
    train.main({tiny(out="run")}),
    export.main(["run", "out.npz"]),
    evaluate.main("run/policy.npz --followers copy --seconds 1 --physics mujoco --out report".split()),
]
print(codes)
"""
CONTROL = """
import socket, subprocess, sys
if len(sys.argv) == 1:
    subprocess.run([sys.executable, __file__, "child"], check=True)
for port in (9,):
    with socket.socket() as plug:
        try:
            plug.connect(("127.0.0.1", port))
        except OSError:
            pass
"""


@pytest.fixture
def watched(tmp_path: Path) -> dict[str, str]:
    """Environment of a process that is watched, with its children."""
    (tmp_path / "hook").mkdir()
    (tmp_path / "hook" / "sitecustomize.py").write_text(HOOK)
    return {
        **environment(),
        "PYTHONPATH": f"{tmp_path / 'hook'}:{REPOSITORY}:{REPOSITORY / 'tests'}",
        "NETWORK_LOG": str(tmp_path / "network.log"),
    }


def run(text: str, place: Path, env: dict[str, str]) -> str:
    (place / "work.py").write_text(text)
    done = subprocess.run(
        [sys.executable, "work.py"], cwd=place, env=env, capture_output=True, text=True, timeout=200, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_training_export_and_judging_stay_off_the_network(tmp_path: Path, watched: dict[str, str]) -> None:
    said = run(WORK, tmp_path, watched)
    assert json.loads(said.splitlines()[-1]) == [0, 0, 0]
    assert (tmp_path / "report" / "report.html").is_file()
    log = tmp_path / "network.log"
    assert not log.exists(), log.read_text()


@pytest.mark.slow
def test_the_watch_sees_a_connection_of_a_child(tmp_path: Path, watched: dict[str, str]) -> None:
    run(CONTROL, tmp_path, watched)
    lines = (tmp_path / "network.log").read_text().splitlines()
    assert len([line for line in lines if line.startswith("socket.connect")]) == 2
