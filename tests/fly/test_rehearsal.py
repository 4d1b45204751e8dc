"""Rehearsals of the shipped policies over the real protocol: runner, cflib, twin, coupled model, log."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from command_line import REPOSITORY, environment
from conftest import too_busy

from mjxball.fly import card
from mjxball.fly.flight_log import read
from mjxball.fly.recording import fly_again, read_recording
from mjxball.policy import load_file
from mjxball.policy.file import shipped_policy

pytest.importorskip("cflib")
pytestmark = pytest.mark.alone  # by the clock

# On a machine that keeps time states are 10 ms old, ticks 0.07 - 0.5 ms late at p99.
OLD, LATE = 25.0, 2.0  # [ms]
HEIGHTS = {"flight": (0.3, 0.6), "stand": (0.04, 0.15)}  # least and most of the highest place [m]


class Ended(NamedTuple):
    """How a rehearsal ended."""

    code: int
    out: str
    err: str
    log: Path


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Ended]:
    """Both policies at once, each for 3 s with nothing but its file."""
    place, ended = tmp_path_factory.mktemp("rehearsal"), {}
    running = {name: started(name, place / f"{name}.jsonl") for name in HEIGHTS}
    try:
        for name, process in running.items():
            out, err = process.communicate(timeout=90)
            ended[name] = Ended(process.returncode, out, err, place / f"{name}.jsonl")
            kept_up_with(ended[name])
    finally:
        for process in running.values():
            process.kill()
            process.communicate()
    return ended


def started(name: str, log: Path) -> subprocess.Popen[str]:
    policy = str(shipped_policy(name))
    command = [sys.executable, "-m", "mjxball.fly", policy, "--rehearse", "--seconds", "3", "--log", str(log)]
    pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    child = {**environment(), "PYTHONPATH": str(REPOSITORY)}
    return subprocess.Popen(command, cwd=log.parent, env=child, text=True, **pipes)


def kept_up_with(flight: Ended) -> None:
    """Try again where the machine was too busy."""
    events = {event.split(":")[0] for record in read(flight.log) for event in record.get("events", [])}
    ages = [float(age) for age in re.findall(r"state age: (\d+) ms", flight.out)]
    late = [float(late) for late in re.findall(r"p99 ([\d.]+) ms", flight.out)]
    if flight.code == -signal.SIGKILL:
        too_busy("the watchdog took over from a runner that stood still")
    if events & {"DEADLINES", "STALE", "REFUSED"} or max(ages, default=0) > OLD or max(late, default=0) > LATE:
        too_busy(f"{sorted(events)}, states {ages} ms old, ticks {late} ms late")


@pytest.fixture(params=sorted(HEIGHTS))
def name(request: pytest.FixtureRequest) -> str:
    """A shipped policy for Crazyflies."""
    return request.param


@pytest.fixture
def flown(name: str, flights: dict[str, Ended]) -> Path:
    """The log of the rehearsal."""
    code, out, err, log = flights[name]
    assert (code, err) == (0, ""), out
    return log


def test_the_cards_gains_are_uploaded(name: str, flown: Path) -> None:
    config = card.config_of(load_file(shipped_policy(name)).card)
    written = {
        (record["drone"], record["name"]): record["value"] for record in read(flown) if record["kind"] == "parameter"
    }
    for drone, gains in zip(("leader", "follower"), card.gains_of(config), strict=True):
        for parameter, value in gains.items():
            assert written[drone, parameter] == pytest.approx(value, rel=1e-6)  # a float on the wire
    assert written["leader", "pid_rate.roll_ki"] > 0
    assert written["follower", "pid_rate.roll_ki"] == 0


def test_it_flies_and_its_commands_simulated_begin_the_same(name: str, flown: Path) -> None:
    recording = read_recording(flown)
    assert recording.remarks == ()  # every record is of the schema, and no drone was unheard
    heights = recording.position[np.array(recording.phase) == "fly", 2]
    least, most = HEIGHTS[name]
    assert least < heights.max() < most
    assert abs(recording.position[-1, 2]) < 0.01
    # Open loop: setpoints took effect up to a tick or two later than they were noted, which grows with the flight's
    # time (tests/fly/test_recording.py compares a whole flight, in virtual time). So: until one second in the air.
    begun = recording.time[recording.phase.index("fly")]
    early = recording.time < begun + 1.0
    apart = fly_again(recording).position[early] - recording.position[early]
    assert np.abs(apart).max() < 0.05
