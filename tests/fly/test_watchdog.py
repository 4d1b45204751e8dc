"""The watchdog process: the runner is killed or stopped in the air, and both drones come down all the same."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from command_line import REPOSITORY, TRANSPORT, environment
from conftest import too_busy
from tables import rows

from mjxball.fly import flight_log, packets, watchdog
from mjxball.fly.process import urgent
from mjxball.fly.setpoints import LastKnownState, blind_shares
from mjxball.fly.twin.physics import make_pair
from mjxball.fly.twin.server import Twin
from mjxball.fly.watchdog import FLYING, GOODBYE, IDLE, NOTHING, packed
from mjxball.policy import load_file

pytest.importorskip("cflib")
SEEN = LastKnownState((45000, 46000), 0.5, 0.25, -1.0)  # numbers that float32 holds exactly


def watched(frames: list[bytes], close: bool = True) -> tuple[LastKnownState, float] | None:
    """What the watchdog concludes from `frames`, written in pieces; the runner is a process that only sleeps."""
    reading, writing = os.pipe()
    with subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"]) as runner:
        try:
            for frame in frames:
                os.write(writing, frame[:4])
                os.write(writing, frame[4:])
            if close:
                os.close(writing)
            return watchdog.watch(reading, runner.pid)
        finally:
            if not close:
                assert runner.wait(timeout=5) == -signal.SIGKILL  # it hung: its radio must be freed
                os.close(writing)
            runner.kill()
            os.close(reading)


@pytest.mark.clock
def test_a_closed_pipe_in_the_air_is_a_death() -> None:
    frames = [packed(IDLE, NOTHING), packed(FLYING, SEEN)]
    assert watched(frames) == (SEEN, 0.0)


@pytest.mark.clock
def test_silence_in_the_air_is_a_hang_and_the_runner_is_killed() -> None:
    assert watched([packed(FLYING, SEEN)], close=False) == (SEEN, watchdog.SILENCE)


@pytest.mark.parametrize("last", [IDLE, GOODBYE])
def test_on_the_ground_nothing_is_taken_over(last: int) -> None:
    assert watched([packed(FLYING, SEEN), packed(last, NOTHING)]) is None


@rows("climb", [-2.0, 0.0, 1.5, float("nan")])
@rows("height", [-0.1, 0.0, 0.5, 40.0, float("inf")])
@rows("trim", [0, 12000, 46000, 65535])
def test_the_way_down_ends_in_stops_and_never_lifts(trim: int, height: float, climb: float) -> None:
    seen = LastKnownState((trim, trim // 2), height, climb, 0.0)
    plans = [watchdog.way_down(number, seen, 0.3) for number in range(2)]
    assert len(plans[0]) == len(plans[1])
    for plan, own in zip(plans, seen.trims, strict=True):
        sent = [packets.unpack_setpoint(packet.data) for packet in plan if packet.port == 3]
        assert all(value.thrust <= min(own, packets.THRUST_CEILING) for value in sent)
        assert all(value.roll == value.pitch == value.yaw_rate == 0 for value in sent)
        assert sent[-1].thrust == 0
        # A firmware that counts as flying, until 2 s after its last thrust, must not fall silent for as long.
        ending = plan[-round(2.6 / watchdog.PERIOD) :]
        assert watchdog.STOPPING + watchdog.ZEROS > 2.5
        assert set(ending) == {packets.STOP, packets.setpoint_packet(packets.ZERO)}
        assert len(plan) * watchdog.PERIOD <= 2.5 + watchdog.STOPPING + watchdog.ZEROS + 0.2


@rows("height", [0.1, 0.4, 0.9])
@rows("climb", [-0.5, 0.0, 0.8])
@rows("error", [0.97, 1.0])
def test_a_blind_descent_ends_on_the_ground(height: float, climb: float, error: float) -> None:
    """Point mass, shares times `error` as its lift; what is left at the end falls from less than 40 cm."""
    period, place, speed = 0.02, height, climb
    for share in blind_shares(LastKnownState((0, 0), height, climb, 0.0), 0.0, period):
        speed += (share * error - 1) * 9.81 * period
        place += speed * period
        if place <= 0:
            break
    assert place < 0.4
    assert abs(speed) < 1.5


def lost_in_the_air(number: signal.Signals, log: Path) -> Twin | None:
    """Fly, send the runner `number` in the air, wait until the twin's motors are off; None if it never took off."""
    with urgent(), Twin(make_pair(load_file(TRANSPORT).card)) as twin:
        uris = ["--leader", twin.uris[0], "--follower", twin.uris[1]]
        command = [sys.executable, "-m", "mjxball.fly", str(TRANSPORT), *uris, "--seconds", "60", "--log", str(log)]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        with subprocess.Popen(command, cwd=REPOSITORY, env=environment(), **quiet) as runner:
            try:
                while twin.truth.state.position[:, 2].min() < 0.25:
                    if runner.poll() is not None:
                        return None
                    time.sleep(0.01)
                runner.send_signal(number)
                end = time.monotonic() + 10
                while twin.truth.thrust != (0, 0) or twin.truth.last_wire_thrust != (0, 0):
                    assert time.monotonic() < end, f"still {twin.truth.thrust} 10 s after {number.name}"
                    time.sleep(0.01)
                time.sleep(0.7)  # to fall what is left, and for whatever might turn a motor on again
                assert runner.wait(timeout=5) == -signal.SIGKILL
            finally:
                runner.kill()
    return twin


@pytest.mark.alone
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "hung"])
def test_a_runner_lost_in_the_air_is_brought_down(number: signal.Signals, tmp_path: Path) -> None:
    for attempt in range(3):
        log = tmp_path / f"{attempt}.jsonl"
        twin = lost_in_the_air(number, log)
        if twin is not None:
            break
    else:
        too_busy("the runner's own checks ended every flight on the ground")
    assert twin.failure is None
    assert twin.truth.thrust == (0, 0)
    # Not by the firmware's own watchdog, which locks a drone that hears nothing for 2 s.
    assert not any(info & packets.LOCKED for info in twin.truth.info)
    assert twin.truth.state.position[:, 2].max() < 0.02
    tilts = [packets.level_share(truth.state.quaternion[0]) for truth in twin.history]
    assert min(tilts) > np.cos(np.radians(35))
    # The log is whole but for its last moments: every line that was written parses, and the flight is in it.
    assert any(record["kind"] == "tick" and record["state"] == "fly" for record in flight_log.read(log))
