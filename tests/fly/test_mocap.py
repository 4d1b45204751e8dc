"""Motion capture, from a loopback server and the package's own client to the drones: refusals, forwarding, faults."""

from __future__ import annotations

import contextlib
import functools
import random
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import TRANSPORT, assert_one_line, call
from fly_virtual import VirtualTwin
from tables import rows
from vrpn_server import Poses, VrpnServer
from wire import unpack_pose

from mjxball.policy import load_file
from mjxfly import mocap as motion_capture
from mjxfly import packets, process
from mjxfly.limits import FlightSettings
from mjxfly.link import Link
from mjxfly.main import check_options, main, make_parser, mocap_settings
from mjxfly.mocap import Mocap, MocapError, MocapSettings, ready
from mjxfly.mocap_child import Decimation
from mjxfly.mocap_supervision import Frame, MocapLimits, Pose
from mjxfly.packets import Setpoint
from mjxfly.supervisor import Event, FlightState
from mjxfly.telemetry import Rig
from mjxfly.twin.conditions import Surroundings

pytest.importorskip("cflib")
pytest.importorskip("motioncapture")
LEVEL = (1.0, 0.0, 0.0, 0.0)
RIG = Rig.from_metadata(load_file(TRANSPORT).metadata)
BODIES = ("lead", "follow")
NO_DECK = Surroundings(deck=False)


def standing(swap: bool = False, one: bool = False, noise: float = 1e-4) -> Poses:
    """Both bodies of the policy's rig where they stand, with a camera's noise [m]."""
    places = [RIG.leader_mount, RIG.leader_mount if one else RIG.follower_mount]
    if swap:
        places.reverse()
    return {
        name: [*(part + random.gauss(0, noise) for part in place), *LEVEL]
        for name, place in zip(BODIES, places, strict=True)
    }


@pytest.fixture
def deaf() -> Iterator[tuple[list[str], list[socket.socket]]]:
    """Flags of two drones that never answer, and their sockets, which hear whatever was sent."""
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(2)]
        for one in sockets:
            one.bind(("127.0.0.1", 0))
            one.setblocking(False)
        uris = [f"udp://127.0.0.1:{one.getsockname()[1]}" for one in sockets]
        yield ["--leader", uris[0], "--follower", uris[1]], sockets


HERE = ["--mocap-host", "127.0.0.1", "--bodies", "lead", "follow"]
MOCK = ["--mocap", "mock", "--bodies", "lead", "follow"]
STILL = "lead({},{},{},1,0,0,0);follow({},{},{},1,0,0,0)".format(*RIG.leader_mount, *RIG.follower_mount)
REFUSALS = [
    (["--mocap-host", "h"], "--mocap-host needs --mocap KIND"),
    (["--bodies", "a", "b"], "--bodies needs --mocap KIND"),
    (["--mocap", "vicon", "--bodies", "a", "b"], "needs --mocap-host HOST"),
    (["--mocap", "vicon", "--mocap-host", "h"], "needs --bodies LEADER FOLLOWER"),
    (["--mocap", "vicon", "--mocap-host", "h", "--bodies", "a", "a"], "one body for both drones"),
    (["--mocap", "camera"], "invalid choice"),
    (["--rehearse", "--mocap", "vrpn", *HERE], "leave it out with --rehearse"),
    (["--mocap", "vrpn", *HERE, "--mocap-rate", "300"], "--mocap-rate must be 50 to 100"),
    (["--mocap", "vrpn", *HERE, "--mocap-std", "0", "0.1"], "--mocap-std must be"),
    (["--mocap", "vrpn", *HERE, "--mocap-std", "0", "0.1"], "--mocap-std must be"),
    (["--mocap", "vrpn", *HERE, "--mocap-option", "port"], "is no KEY=VALUE"),
    (["--mocap", "optitrack", "--mocap-host", "no such host", "--bodies", "a", "b"], "has no address"),
    # The package itself, without any network: its mock shows the bodies that it is given, and they never move.
    (MOCK, "(mock) does not answer"),
    (
        [*MOCK, "--mocap-option", "rigid_bodies=ball(0,0,0,1,0,0,0)"],
        "no body named lead, ",
    ),
    ([*MOCK, "--mocap-option", f"rigid_bodies={STILL.split(';')[0]}"], "no body named follow"),
    ([*MOCK, "--mocap-option", f"rigid_bodies={STILL}"], "its numbers stand still"),
    ([*MOCK, "--mocap-option", "rigid_bodies=lead(1,1,1,1,0,0,0);follow(1,1,1,1,0,0,0)"], "both bodies have one pose"),
    ([*MOCK, "--mocap-option", f"rigid_bodies={STILL}", "--mocap-option", "frequency=x"], "cannot be read"),
    # Its clients, where nobody answers: one waits for ever inside, one says so, one goes on without any body.
    (["--mocap", "optitrack", *HERE], "(optitrack at 127.0.0.1) does not answer"),
    (["--mocap", "vicon", *HERE], "(vicon at 127.0.0.1) does not answer"),
    (["--mocap", "qualisys", *HERE, "--mocap-option", "port=9"], "Error connecting QTM on address: 127.0.0.1:9"),
    (["--mocap", "nokov", *HERE], "cannot be read: Unknown motion capture type!"),
]


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """What is refused for want of an answer is so after a second; a reader that answers may take its time."""

    def expect(reason: str) -> None:
        if "does not answer" in reason:
            monkeypatch.setattr("mjxfly.main.ready", functools.partial(ready, limits=MocapLimits(answer=1.0)))

    return expect


@pytest.mark.parametrize(
    ("flags", "reason"),
    [  # whoever waits for an answer belongs to the second tier
        pytest.param(*row, id=f"{n} {row[1][:30]}", marks=pytest.mark.slow if "does not answer" in row[1] else ())
        for n, row in enumerate(REFUSALS)
    ],
)
def test_refusals(
    flags: list[str],
    reason: str,
    deaf: Any,
    impatient: Callable[[str], None],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    uris, sockets = deaf
    impatient(reason)
    log = tmp_path / "log.jsonl"
    assert call(main, [TRANSPORT, *uris, *flags, "--log", log]) == 2
    errors = capsys.readouterr().err
    assert reason in errors
    assert_one_line(errors)
    assert not log.exists()
    for one in sockets:
        with pytest.raises(BlockingIOError):
            one.recv(100)  # nobody even tried to connect


SERVED: list[tuple[str, Callable[[], Poses], dict[str, Any], str]] = [
    ("mute", standing, {"mute": True}, "does not answer"),
    ("unknown", lambda: {"ball": [0.0] * 3 + [*LEVEL]}, {}, "no body named lead, "),
    ("swapped", lambda: standing(swap=True), {}, "the two bodies are swapped"),
    ("one pose", lambda: standing(one=True), {}, "both bodies have one pose"),
    ("frozen", lambda: standing(noise=0.0), {}, "its numbers stand still"),
    ("slow", standing, {"rate": 20.0}, "45 are needed"),
    ("not numbers", lambda: {name: [float("nan")] * 7 for name in BODIES}, {}, "numbers for lead that are no pose"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("poses", "server", "reason"), [c[1:] for c in SERVED], ids=[c[0] for c in SERVED])
def test_what_a_server_sends_is_refused_in_a_sentence(
    poses: Callable[[], Poses],
    server: dict[str, Any],
    reason: str,
    deaf: Any,
    impatient: Callable[[str], None],
    capsys: pytest.CaptureFixture[str],
) -> None:
    impatient(reason)
    with VrpnServer(poses, **server) as running:
        flags = ["--mocap", "vrpn", "--mocap-host", running.host, "--bodies", *BODIES]
        assert call(main, [TRANSPORT, *deaf[0], *flags]) == 2
    errors = capsys.readouterr().err
    assert reason in errors
    assert_one_line(errors)


def test_without_the_package_it_says_how_to_install_it(
    deaf: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found = motion_capture.importlib.util.find_spec
    without = lambda name: None if name == "motioncapture" else found(name)  # noqa: E731
    monkeypatch.setattr(motion_capture.importlib.util, "find_spec", without)
    assert call(main, [TRANSPORT, *deaf[0], "--mocap", "vrpn", *HERE]) == 2
    errors = capsys.readouterr().err
    assert "pip install 'mjxball[mocap]'" in errors
    assert_one_line(errors)


@pytest.mark.slow
def test_a_reader_that_hangs_or_dies_hurts_nobody() -> None:
    span = RIG.span
    for kind in ("optitrack", "vicon"):  # they hold Python's lock while they wait
        settings = MocapSettings(kind, "127.0.0.1", BODIES)
        began = time.monotonic()
        with pytest.raises(MocapError, match="does not answer"), ready(settings, span, MocapLimits(answer=0.5)):
            pass
        assert time.monotonic() - began < 5
    with VrpnServer(standing) as server, ready(MocapSettings("vrpn", server.host, BODIES), span) as mocap:
        assert mocap.faults(time.monotonic()) == []
        assert mocap._source is not None
        mocap._source._process.kill()
        assert process.wait_until(lambda: bool(mocap.faults(time.monotonic())), 5.0)
        (one, other) = mocap.faults(time.monotonic())
        assert one.event is other.event is Event.POSE


@pytest.mark.slow
def test_the_reader_ends_with_the_runner() -> None:
    """Its standard input ends when the runner dies in any way, while it waits inside the package."""
    with VrpnServer(standing, mute=True) as server:
        source = motion_capture.Source(MocapSettings("vrpn", server.host, BODIES), lambda frame: None)
        assert source._process.stdin is not None
        assert source._process.poll() is None
        source._process.stdin.close()
        assert source._process.wait(timeout=10) == 0
        source.close()


def test_frames_are_thinned_to_the_rate_and_no_further() -> None:
    """A system at 100 Hz with 2 ms of jitter loses none; faster ones are thinned to the rate on the average."""
    noise = np.random.default_rng(1)
    for source, wanted, least, most in (
        (100, 100, 98, 100),
        (300, 100, 99, 102),
        (240, 100, 97, 102),
        (60, 100, 60, 60),
    ):
        thinned = Decimation(wanted)
        times = np.arange(20 * source) / source + noise.uniform(0, 2e-3, 20 * source)
        passed = [now for now in np.sort(times) if thinned.passes(now)]
        assert least <= len(passed) / 20 <= most, source
        assert np.diff(passed).max() < 2.1 / min(source, wanted)


@rows(
    ("follower", "rate"),
    [("radio://0/80/2M/E7E7E7E7E8", 50), ("radio://1/90/2M/E7E7E7E7E8", 100), ("udp://127.0.0.1:1", 100)],
)
def test_the_rate_is_halved_where_two_drones_share_a_dongle(follower: str, rate: float) -> None:
    pair = ["--leader", "radio://0/80/2M/E7E7E7E7E7", "--follower", follower]
    options = make_parser().parse_args(["flight", *pair, *MOCK])
    assert mocap_settings(options, check_options(options)).rate == rate


class Driver:
    """In the place of cflib's: keeps what it is given, and holds each packet until it is let go."""

    def __init__(self) -> None:
        self.ports: list[int] = []
        self.data: list[bytes] = []
        self.go = threading.Semaphore(0)

    def send_packet(self, wire: Any) -> None:
        self.ports.append(wire.port)
        self.data.append(bytes(wire.data))
        assert self.go.acquire(timeout=10)


def test_a_pose_goes_out_only_when_no_setpoint_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mjxfly.link.QUIET", 60.0)  # no pings in between
    link, driver = Link("udp://127.0.0.1:1", "leader", lambda kind, **fields: None), Driver()
    link._driver = driver
    link._sender.start()
    poses = [packets.pose_packet((float(n), 0, 0), LEVEL) for n in range(4)]
    setpoints = [packets.setpoint_packet(Setpoint(0, 0, 0, thrust)) for thrust in (11000, 12000, 13000)]
    sent = functools.partial(process.wait_until, seconds=5.0)
    link.pose(poses[0])
    assert sent(lambda: len(driver.ports) == 1)
    assert link.stuck_for(time.monotonic()) == 0
    for pose in poses[1:]:  # while the radio is busy with the first one
        link.pose(pose)
    assert link.stuck_for(time.monotonic()) == 0
    for setpoint in setpoints[:2]:
        link.send(setpoint)
    time.sleep(0.01)
    assert link.stuck_for(time.monotonic()) >= 0.01  # poses do not hide that setpoints wait
    driver.go.release()
    assert sent(lambda: len(driver.ports) == 2)
    link.send(setpoints[2])
    driver.go.release()
    assert sent(lambda: len(driver.ports) == 3)
    link.command(packets.EMERGENCY_STOP)
    driver.go.release(2)
    assert sent(lambda: len(driver.ports) == 5)
    driver.go.release()
    expected = [poses[0], setpoints[1], setpoints[2], packets.EMERGENCY_STOP, poses[3]]  # the newest pose, and last
    assert driver.data == [packet.data for packet in expected]
    assert (link.overwritten, link.sent) == (1, 3)
    link.close()


# A flight in virtual time: the world's truth seen by cameras, supervised and sent to the twin's drones.

Spoil = Callable[[float, Frame], Frame]


class Seen:
    """A world whose flight has motion capture at 100 Hz, with what reached each drone's link."""

    def __init__(self, spoil: Spoil = lambda elapsed, frame: frame):
        self.world = VirtualTwin(FlightSettings(seconds=2.0))
        self.mocap = Mocap(MocapSettings("mock", "", BODIES), self.world.rig.span)
        self.heard: list[list[tuple[np.ndarray, np.ndarray]]] = [[], []]
        self._noise, self._spoil, self._begin = np.random.default_rng(0), spoil, 0.0
        self.mocap.note = self.world.log.note
        for number, link in enumerate(self.world.links):
            link.pose = lambda packet, number=number: self.heard[number].append(unpack_pose(packet.data))
            self.mocap.feed(number, link)
        self.world.flight._mocap = self
        self.mocap.take(self._frame(), self.world.now)

    def _frame(self) -> Frame:
        state = self.world.state
        poses = [
            Pose(self.world.now, tuple(state.position[n] + self._noise.normal(0, 1e-4, 3)), tuple(state.quaternion[n]))
            for n in range(2)
        ]
        return poses[0], poses[1]

    def faults(self, now: float) -> list[Any]:
        self.mocap.take(self._spoil(now - self._begin, self._frame()), now)
        return self.mocap.faults(now)

    def fly(self) -> str:
        """Fly to the end; the cause of an abort, empty if there was none."""
        spoil, self._spoil = self._spoil, lambda elapsed, frame: frame
        self.mocap.guarding = True
        self.world.fly_until(FlightState.FLY)
        self.world.fly_for(1.0)
        self._spoil, self._begin = spoil, self.world.now
        self.world.fly_until(FlightState.DONE)
        cause = self.world.flight.supervisor.cause
        return "" if cause is None else f"{cause.event.name} {cause.detail}"


def moved(pose: Pose | None, far: float) -> Pose | None:
    return None if pose is None else pose._replace(position=(pose.position[0] + far, *pose.position[1:]))


def test_what_the_drones_get_is_where_they_are() -> None:
    seen = Seen()
    assert seen.fly() == ""
    assert seen.world.log.transitions() == ["arm", "spin", "ramp", "fly", "land", "stop", "done"]
    last = seen.world.state
    for number in range(2):
        position, quaternion = seen.heard[number][-1]
        # 0.1 mm of noise, and what the pair moves in the last period at rest.
        np.testing.assert_allclose(position, last.position[number], atol=1e-3)
        np.testing.assert_allclose(quaternion, last.quaternion[number], atol=1e-3)
        assert len(seen.heard[number]) > 95 * seen.world.now  # 100 Hz
    poses = [record for record in seen.world.log.records if record["kind"] == "pose"]
    assert {record["drone"] for record in poses} == {"leader", "follower"}
    assert len(poses) <= 2 * (50 * seen.world.now + 1)
    assert all(0 <= record["age"] < 0.02 for record in poses)


IN_FLIGHT: list[tuple[str, Spoil, str]] = [
    ("a glitch", lambda t, f: (moved(f[0], 0.4 if 0.1 < t < 0.115 else 0), f[1]), ""),
    ("a gap", lambda t, f: f if not 0.1 < t < 0.35 else (None, None), ""),
    ("the leader lost", lambda t, f: (None, f[1]), "POSE no good pose of the leader for"),
    ("both lost", lambda t, f: (None, None), "POSE no good pose of the leader for"),
    ("a jump that stays", lambda t, f: (f[0], moved(f[1], 0.4)), "POSE no good pose of the follower for"),
    ("swapped", lambda t, f: (f[1], f[0]), "POSE"),
    ("one pose", lambda t, f: (f[0], f[0]), "POSE no good pose of the follower"),
]
MARKS = {"a glitch": (), "a gap": (), "the leader lost": (), "swapped": pytest.mark.slow}


@pytest.mark.parametrize(
    ("spoil", "cause"),
    [pytest.param(*case[1:], id=case[0], marks=MARKS.get(case[0], pytest.mark.release)) for case in IN_FLIGHT],
)
def test_bad_poses_bring_both_down_gently_and_are_never_sent(spoil: Spoil, cause: str) -> None:
    seen = Seen(spoil)
    found = seen.fly()
    assert found.startswith(cause)
    assert bool(found) is bool(cause)
    states = seen.world.log.transitions()
    assert states[4:] == (["descend", "stop", "done"] if cause else ["land", "stop", "done"])
    assert seen.world.running() == [False, False]
    assert seen.world.state.position[:, 2].max() < 0.01
    for number, heard in enumerate(seen.heard):
        x = np.array([position[0] for position, _ in heard]) - seen.world.rig.span[0] * (number == 0)
        assert np.abs(np.diff(x)).max() < 0.05  # no wrong pose among them: 5 m/s at most
    gaps = [record for record in seen.world.log.records if record["kind"] == "gap"]
    assert bool(gaps) is (spoil is not IN_FLIGHT[0][1])


def test_a_frozen_system_brings_both_down() -> None:
    kept: list[Frame] = []

    def freeze(elapsed: float, frame: Frame) -> Frame:
        kept.append(frame)
        poses = [pose and pose._replace(time=now.time) for pose, now in zip(kept[0], frame, strict=True) if now]
        return poses[0], poses[1]

    assert "its numbers stand still" in Seen(freeze).fly()
