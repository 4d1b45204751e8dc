"""Rehearsals of the shipped policies over the real protocol: runner, cflib, twin, coupled model, log.

And what they say on a computer that is too slow for them.
"""

from __future__ import annotations

import collections
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from command_line import REPOSITORY, assert_one_line, environment
from conftest import TOO_SLOW, too_busy

from mjxball.policy import load_file
from mjxball.policy.file import shipped_policy
from mjxfly import policy_setup
from mjxfly.flight_log import read
from mjxfly.recording import read_recording, simulate_setpoints

pytest.importorskip("cflib")
pytestmark = pytest.mark.alone  # by the clock

# On a machine that keeps time states are 10 ms old, ticks 0.07 - 0.5 ms late at p99.
OLD, LATE = 25.0, 2.0  # [ms]
PLACE = re.compile(
    r"^twin: the object is at \((.+), (.+), (.+)\) m from where it stood, motors (on|off); ", re.MULTILINE
)
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


def started(name: str, log: Path, *flags: str) -> subprocess.Popen[str]:
    policy = str(shipped_policy(name))
    command = [sys.executable, "-m", "mjxfly", policy, "--rehearse", "--seconds", "3", "--log", str(log), *flags]
    pipes = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    child = {**environment(), "PYTHONPATH": str(REPOSITORY)}
    return subprocess.Popen(command, cwd=log.parent, env=child, text=True, **pipes)


def kept_up_with(flight: Ended) -> None:
    """Try again where the machine was too busy."""
    events = {event.split(":")[0] for record in read(flight.log) for event in record.get("events", [])}
    ages = [float(age) for age in re.findall(r"state age: (\d+) ms", flight.out)]
    late = [float(late) for late in re.findall(r"p99 ([\d.]+) ms", flight.out)]
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
    assert (code, err) == (0, ""), f"{err}{out}"  # pytest shortens err, which a busy machine is known by
    return log


def test_the_cards_gains_are_uploaded(name: str, flown: Path) -> None:
    config = policy_setup.config_of(load_file(shipped_policy(name)).metadata)
    written = {
        (record["drone"], record["name"]): record["value"] for record in read(flown) if record["kind"] == "parameter"
    }
    for drone, gains in zip(("leader", "follower"), policy_setup.gains_of(config), strict=True):
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
    apart = simulate_setpoints(recording).position[early] - recording.position[early]
    assert np.abs(apart).max() < 0.05


def test_the_last_line_tells_where_the_object_is(name: str, flown: Path, flights: dict[str, Ended]) -> None:
    """By the twin, not by what the runner believes."""
    told = PLACE.findall(flights[name].out.splitlines()[-1])
    assert len(told) == 1
    assert told[0][3] == "off"
    recording = read_recording(flown)
    moved = recording.position[-1] - recording.position[0]
    assert np.abs(np.array(told[0][:3], float) - moved).max() < 0.03  # the estimators' noise on a stand


@pytest.mark.release
@pytest.mark.parametrize("onboard", [(), ("--onboard",)])
def test_runner_watchdog_and_twin_share_a_slower_clock(onboard: tuple[str, ...], tmp_path: Path) -> None:
    if onboard and shutil.which("gcc") is None:
        pytest.skip("needs gcc")
    began = time.monotonic()
    process = started("flight", tmp_path / "slow.jsonl", "--slow", "3", *onboard)
    out, err = process.communicate(timeout=200)
    took = time.monotonic() - began
    assert (process.returncode, err) == (0, ""), f"{err}{out}"
    ticks = [record for record in read(tmp_path / "slow.jsonl") if record["kind"] == "tick"]
    flown = [record["t"] for record in ticks if record["state"] == "fly"]
    assert flown[-1] - flown[0] == pytest.approx(3.0, abs=0.1)  # as long as it was to be, by its own clock
    assert 3 * (ticks[-1]["t"] - ticks[0]["t"]) < took
    assert PLACE.search(out)


def descendants(pid: int) -> list[int]:
    """Ids of the processes that `pid` has started and that still are."""
    place = Path(f"/proc/{pid}/task/{pid}/children")
    return [int(number) for number in place.read_text().split()] if place.exists() else []


def flies(log: Path, process: subprocess.Popen[str]) -> bool:
    """Wait for the controllers to take over; false if the flight ends before."""
    while process.poll() is None:
        if log.exists() and '"after": "fly"' in log.read_text(encoding="utf-8"):
            return True
        time.sleep(0.05)
    return False


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="asks Linux for a process's children")
@pytest.mark.parametrize(
    ("who", "how", "code", "said"),
    [
        ("twin", signal.SIGSTOP, 2, f"{TOO_SLOW} in real time: .* --slow 2"),
        pytest.param(
            *("runner", signal.SIGSTOP, -signal.SIGKILL, f"{TOO_SLOW} in real time: .* --slow 2"),
            marks=pytest.mark.release,
        ),
        pytest.param(
            *("twin", signal.SIGKILL, 2, "the twin has ended: it was killed, or it crashed"),
            marks=pytest.mark.release,
        ),
    ],
)
def test_a_process_that_stands_still_is_a_computer_that_is_too_slow(
    who: str, how: signal.Signals, code: int, said: str, tmp_path: Path
) -> None:
    """Links, the watchdog and a hang were named; a twin that is gone is no slow computer."""
    process = started("flight", tmp_path / "stopped.jsonl")
    try:
        in_air = flies(tmp_path / "stopped.jsonl", process)
        children = descendants(process.pid)
        words = {child: Path(f"/proc/{child}/cmdline").read_text().split("\0") for child in children}
        twin = next((child for child in children if "mjxfly.twin" in words[child]), 0)
        if in_air:
            stopped = twin if who == "twin" else process.pid
            os.kill(stopped, how)
            time.sleep(1.0)
            if who == "twin" and how == signal.SIGSTOP:
                os.kill(stopped, signal.SIGCONT)
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
        process.communicate()
    if not in_air:
        too_busy(err)
    assert process.returncode == code
    assert_one_line(err)
    assert re.search(said, err)
    assert not re.search("leader|follower|watchdog|link|parameter", err)
    assert who == "runner" or "twin:" in out  # where the object is, or that nobody knows
    assert not re.search("stale|hold", out)
    end = time.monotonic() + 20
    while alive := [child for child in children if Path(f"/proc/{child}").exists()]:
        assert time.monotonic() < end, f"{alive} outlive the runner"
        time.sleep(0.1)


REHEARSALS, BUSY = 40, 6


@pytest.mark.release
def test_beside_a_busy_machine_rehearsals_land_or_say_that_it_is_too_slow(tmp_path: Path) -> None:
    """Of twelve one landed; errors named links and parameters that were fine."""
    spin = f"import time\nend = time.monotonic() + {60 * REHEARSALS}\nwhile time.monotonic() < end: sum(range(1000))"
    busy = [subprocess.Popen([sys.executable, "-c", spin]) for _ in range(BUSY)]
    ended: collections.Counter[str] = collections.Counter()
    try:
        for number in range(REHEARSALS):
            process = started("flight", tmp_path / f"{number}.jsonl")
            out, err = process.communicate(timeout=180)
            if (process.returncode, err) == (0, "") and "landed as planned" in out:
                ended["landed"] += 1
            elif process.returncode in (2, -signal.SIGKILL) and err.count("\n") == 1 and TOO_SLOW in err:
                ended["too slow"] += 1
            else:
                ended[f"{process.returncode}: {out[-500:]} {err}"] += 1
    finally:
        for one in busy:
            one.kill()
            one.wait()
    assert set(ended) <= {"landed", "too slow"}, ended
