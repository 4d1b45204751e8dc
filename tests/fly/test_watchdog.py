"""The watchdog process: the runner is killed or stopped in the air, and both drones come down all the same."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from command_line import REPOSITORY, TRANSPORT, assert_one_line, environment
from conftest import too_busy
from tables import rows, weekly

from mjxball.control import rotations
from mjxball.policy import load_file
from mjxfly import flight_log, packets, watchdog
from mjxfly.process import urgent
from mjxfly.setpoints import SPIN_THRUST, LastKnownState, blind_shares
from mjxfly.twin.drone import TwinDrone
from mjxfly.twin.physics import make_pair
from mjxfly.twin.server import Twin
from mjxfly.watchdog import FLYING, GOODBYE, IDLE, NOTHING, packed

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
    left = watched([packed(IDLE, NOTHING), packed(FLYING, SEEN)])
    assert left is not None
    assert left[0] == SEEN
    assert 0 <= left[1] < watchdog.SILENCE


@pytest.mark.clock
def test_silence_in_the_air_is_a_hang_and_the_runner_is_killed() -> None:
    left = watched([packed(FLYING, SEEN)], close=False)
    assert left is not None
    assert left[0] == SEEN
    assert left[1] >= watchdog.SILENCE


@pytest.mark.slow
def test_silence_counts_from_when_a_frame_was_written(monkeypatch: pytest.MonkeyPatch) -> None:
    """A watchdog that woke late read one that was 0.28 s old, and waited for another 0.3 s."""
    waited: list[float | None] = []
    select = watchdog.select.select

    def told(*given):
        waited.append(given[3])
        return select(*given[:3], 0)

    frame = packed(FLYING, SEEN)
    written = watchdog.FRAME.unpack(frame)[1]
    monkeypatch.setattr(watchdog.select, "select", told)
    monkeypatch.setattr(watchdog.clock, "now", lambda: written + 0.28)
    left = watched([frame], close=False)
    assert waited == [None, pytest.approx(watchdog.SILENCE - 0.28)]
    assert left == (SEEN, pytest.approx(0.28))


@pytest.mark.slow
@pytest.mark.parametrize("last", [IDLE, GOODBYE])
def test_on_the_ground_nothing_is_taken_over(last: int) -> None:
    assert watched([packed(FLYING, SEEN), packed(last, NOTHING)]) is None


@rows("climb", [-2.0, 0.0, 1.5, float("nan")])
@rows("height", [-0.1, 0.0, 0.5, 40.0, float("inf")])
@rows("trim", [0, 12000, 46000, 65535])
def test_the_way_down_ends_in_stops_and_never_lifts(trim: int, height: float, climb: float) -> None:
    seen = LastKnownState((trim, trim // 2), height, climb, 0.0)
    plans = [watchdog.descent_packets(number, seen, 0.3) for number in range(2)]
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


class Flown(NamedTuple):
    """A flight of a runner that was lost in the air."""

    twin: Twin
    code: int
    told: str  # on stderr
    gaps: list[float]  # the longest time between two setpoints, of either drone [s]
    log: Path


def flown(place: Path, lose: Callable[[subprocess.Popen, Twin], None] | None, program: Sequence[str]) -> Flown | None:
    """Fly `program`, the runner or what spoils it, on a twin; `lose` it in the air, if need be.

    Returns once the twin's motors are off; None if it never took off.
    """
    with urgent(), Twin(make_pair(load_file(TRANSPORT).metadata)) as twin:
        sent = tuple(setpoint_times(drone) for drone in twin.drones)
        uris = ["--leader", twin.uris[0], "--follower", twin.uris[1]]
        log = place / f"{len(list(place.iterdir()))}.jsonl"
        command = [sys.executable, *program, str(TRANSPORT), *uris, "--log", str(log)]
        pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
        with subprocess.Popen(command, cwd=REPOSITORY, env=environment(), text=True, **pipes) as runner:
            try:
                while max(twin.truth.thrust) < SPIN_THRUST:
                    if runner.poll() is not None:
                        return None
                    time.sleep(0.01)
                if lose is not None:
                    lose(runner, twin)
                told = runner.communicate(timeout=60)[1]
                end = time.monotonic() + 10
                while twin.truth.thrust != (0, 0) or twin.truth.last_wire_thrust != (0, 0):
                    assert time.monotonic() < end, f"still {twin.truth.thrust} 10 s after the runner's end"
                    time.sleep(0.01)
                time.sleep(0.7)  # to fall what is left, and for whatever might turn a motor on again
            finally:
                runner.kill()
    return Flown(twin, runner.returncode, told, [max(np.diff(times)) for times in sent], log)


def setpoint_times(drone: TwinDrone) -> list[float]:
    """When `drone` was sent setpoints [s], from now on."""
    times: list[float] = []
    receive = drone.receive

    def noted(datagram: bytes, now: float) -> None:
        if datagram[0] >> 4 == packets.setpoint_packet(packets.ZERO).port:
            times.append(now)
        receive(datagram, now)

    drone.receive = noted  # type: ignore[method-assign]
    return times


def brought_down(flight: Flown | None) -> Flown:
    """It must have come down level, without the firmware's own watchdog."""
    if flight is None:
        too_busy("the runner's own checks ended the flight on the ground")
    twin = flight.twin
    if twin.failure is not None:
        too_busy(str(twin.failure))
    assert twin.truth.thrust == (0, 0)
    # Not by the firmware's own watchdog, which locks a drone that hears nothing for 2 s.
    assert not any(info & packets.LOCKED for info in twin.truth.info)
    assert twin.truth.state.position[:, 2].max() < 0.02
    tilts = [rotations.tilt_of_quaternion(truth.state.quaternion[0]) for truth in twin.history]
    assert max(tilts) < np.radians(35)
    return flight


@pytest.mark.alone
@pytest.mark.parametrize("number", [signal.SIGKILL, *weekly(signal.SIGSTOP)], ids=["killed", "hung"])
def test_a_runner_lost_in_the_air_is_brought_down(number: signal.Signals, tmp_path: Path) -> None:
    def lose(runner: subprocess.Popen, twin: Twin) -> None:
        while twin.truth.state.position[:, 2].min() < 0.25 and runner.poll() is None:
            time.sleep(0.01)
        runner.send_signal(number)

    flight = brought_down(flown(tmp_path, lose, ["-m", "mjxfly", "--seconds", "60"]))
    assert flight.code == -signal.SIGKILL
    # The log is whole but for its last moments: every line that was written parses, and the flight is in it.
    assert any(record["kind"] == "tick" and record["state"] == "fly" for record in flight_log.read(flight.log))


# At the change to the phase of its first argument the main thread alone stands still, or the program fails.
SPOILED = """
import sys, time
from mjxfly import flight
from mjxfly.main import main
from mjxfly.supervisor import Event, Fault, FlightState

phase, how, advance = FlightState(sys.argv[1]), sys.argv[2], flight.Flight._advance
led = {FlightState.DESCEND: Event.STICK, FlightState.HOLD: Event.UNHEARD}

def spoiled(self, faults):
    before = self.supervisor.state
    if before is FlightState.FLY and self.elapsed > 0.5 and phase in led:
        faults = [*faults, Fault(led[phase])]
    advance(self, faults)
    if self.supervisor.state is phase is not before and self.watchdog is not None:
        if how == "fails":
            raise RuntimeError("a bug")
        time.sleep(5.0)

flight.Flight._advance = spoiled
sys.exit(main(sys.argv[3:]))
"""
TAKEN_OVER = 0.4  # [s] after the last setpoint


@pytest.mark.alone
@pytest.mark.parametrize(
    "phase",
    ["fly", *weekly("ramp", "hold", "land", "descend", "stop")],
)
def test_a_main_thread_that_stands_still_at_a_change_of_phase_is_found(phase: str, tmp_path: Path) -> None:
    """Its other threads go on: states come, the display writes, pings go out."""
    flight = brought_down(flown(tmp_path, None, ["-c", SPOILED, phase, "stands", "--seconds", "1"]))
    assert flight.code == -signal.SIGKILL
    assert max(flight.gaps) < TAKEN_OVER


@pytest.mark.alone
def test_a_runner_that_fails_in_the_air_is_brought_down_like_a_killed_one(tmp_path: Path) -> None:
    flight = brought_down(flown(tmp_path, None, ["-c", SPOILED, "land", "fails", "--seconds", "1"]))
    assert flight.code == 1
    assert_one_line(flight.told)
    assert "RuntimeError: a bug" in flight.told
    assert max(flight.gaps) < TAKEN_OVER
    assert any(record["kind"] == "error" for record in flight_log.read(flight.log))
