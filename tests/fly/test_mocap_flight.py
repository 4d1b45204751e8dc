"""Whole flights on motion capture by the clock: the program over cflib and the package's VRPN client, against twin and
server in this process."""

from __future__ import annotations

import functools
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from command_line import REPOSITORY, TRANSPORT, assert_one_line, environment
from conftest import too_busy
from vrpn_server import Poses, VrpnServer
from wire import unpack_pose

from mjxball.policy import load_file
from mjxball.policy.file import shipped_policy
from mjxfly import packets
from mjxfly.flight_log import read
from mjxfly.limits import NAMES
from mjxfly.process import urgent
from mjxfly.twin.conditions import QUIET, Surroundings
from mjxfly.twin.physics import make_pair
from mjxfly.twin.server import Twin

pytest.importorskip("cflib")
pytest.importorskip("motioncapture")
pytestmark = pytest.mark.alone
BODIES = ("lead", "follow")
NO_DECK = Surroundings(deck=False)


class Flown:
    """One flight of the command line on motion capture of the twin's truth, or refused without it."""

    def __init__(
        self,
        place: Path,
        follower_is_seen: Callable[[Twin], bool] = lambda twin: True,
        policy: Path = TRANSPORT,
        around: Surroundings = QUIET,
        captured: bool = True,
    ):
        self.heard: list[list[tuple[float, np.ndarray]]] = [[], []]
        self.errors: list[float] = []
        with urgent(), Twin(make_pair(load_file(policy).metadata, surroundings=around)) as twin:
            for number, drone in enumerate(twin.drones):
                drone.receive = functools.partial(self._hear, twin, number, drone.receive)  # type: ignore[method-assign]

            def poses() -> Poses:
                state = twin.truth.state
                seen = [[*(state.position[n] + np.random.normal(0, 1e-4, 3)), *state.quaternion[n]] for n in range(2)]
                return dict(zip(BODIES if follower_is_seen(twin) else BODIES[:1], seen, strict=False))

            with VrpnServer(poses, 200.0) as server:
                command = [sys.executable, "-m", "mjxfly", policy, "--seconds", "3", "--log", "log.jsonl"]
                command += ["--leader", twin.uris[0], "--follower", twin.uris[1]]
                if captured:
                    command += ["--mocap", "vrpn", "--mocap-host", server.host, "--bodies", *BODIES]
                    command += ["--mocap-std", "0.004", "0.03"]
                child = {**environment(), "PYTHONPATH": str(REPOSITORY)}
                self.done = subprocess.run(
                    [str(part) for part in command],
                    cwd=place,
                    env=child,
                    stdin=subprocess.DEVNULL,
                    capture_output=True,
                    text=True,
                    timeout=90,
                    check=False,
                )
            self.values = [drone.peer.values for drone in twin.drones]
            self.truth = twin.history
        self.records = list(read(place / "log.jsonl"))
        events = {event.split(":")[0] for record in self.records for event in record.get("events", [])}
        failed = {one["name"] for one in self.records if one["kind"] == "check" and not one["passed"]}
        late = failed and all(name.endswith(("states", "state age")) for name in failed)
        if events & {"DEADLINES", "STALE"} or late:
            too_busy(f"{sorted(events | failed)}")

    def _hear(self, twin: Twin, number: int, onward: Callable[..., None], datagram: bytes, now: float) -> None:
        if datagram[:1] and datagram[0] >> 4 == packets.POSE_PORT:
            position, _ = unpack_pose(datagram[1:])
            self.heard[number].append((time.monotonic(), position))
            self.errors.append(float(np.abs(position - twin.truth.state.position[number]).max()))
        onward(datagram, now)


def assert_forwarded(flown: Flown) -> None:
    """Both drones were told of the poses, and got them, newest and true; the log says so."""
    assert flown.done.stderr == ""
    for values in flown.values:
        assert values["stabilizer.estimator"] == 2
        assert values["locSrv.extPosStdDev"] == pytest.approx(0.004)
        assert values["locSrv.extQuatStdDev"] == pytest.approx(0.03)
    for heard in flown.heard:
        times = np.array([when for when, _ in heard])
        assert (len(times) - 1) / (times[-1] - times[0]) > 80  # of 100 Hz, on a machine that others may share
    assert np.quantile(flown.errors, 0.99) < 0.03  # 0.5 m/s for 30 ms, of which the client's polling is 10
    poses = [record for record in flown.records if record["kind"] == "pose"]
    assert {record["drone"] for record in poses} == {"leader", "follower"}
    checks = {record["name"]: record["passed"] for record in flown.records if record["kind"] == "check"}
    assert all(checks[name] for name in ("motion capture", "leader pose", "follower pose"))


def test_a_body_that_is_lost_in_flight_brings_the_pair_down(tmp_path: Path) -> None:
    flown = Flown(tmp_path, lambda twin: twin.truth.state.position[0][2] < 0.25)
    assert flown.done.returncode == 1, flown.done.stdout
    assert_forwarded(flown)
    assert "no good pose of the follower" in flown.done.stdout
    states = [record["after"] for record in flown.records if record["kind"] == "transition"]
    assert states == ["arm", "spin", "ramp", "fly", "descend", "stop", "done"]
    falling = min(one.state.velocity[:, 2].min() for one in flown.truth)
    assert falling > -0.9  # descend holds 0.4 m/s


def test_drones_without_a_deck_fly_on_the_poses_alone(tmp_path: Path) -> None:
    """Complementary estimators at power-on; what the Kalman filters then know of the place came over the link."""
    flown = Flown(tmp_path, policy=shipped_policy("flight"), around=NO_DECK)
    assert flown.done.returncode == 0, flown.done.stdout
    assert_forwarded(flown)
    heights = np.array([one.state.position[:, 2].mean() for one in flown.truth])
    assert 0.25 < heights.max() - heights[0] < 0.65  # the goal is 0.4 m; the climb may overshoot
    tilt = [np.linalg.norm(one.state.quaternion[0, 1:3]) for one in flown.truth]
    assert max(tilt) < np.sin(np.radians(15) / 2)
    states = [record for record in flown.records if record["kind"] == "state"]
    # The last state is of the pair on the ground: 0.3 mm is the filter's own error with poses of 0.1 mm of noise.
    for number, name in enumerate(NAMES):
        last = next(one for one in reversed(states) if one["drone"] == name)["raw"].state
        np.testing.assert_allclose(last.position, flown.truth[-1].state.position[number], atol=5e-3)


def test_drones_without_a_deck_are_refused_without_poses(tmp_path: Path) -> None:
    flown = Flown(tmp_path, policy=shipped_policy("flight"), around=NO_DECK, captured=False)
    assert flown.done.returncode == 2, flown.done.stdout
    assert_one_line(flown.done.stderr)
    assert "is not the Kalman filter" in flown.done.stderr
    assert [record["kind"] for record in flown.records].count("refused") == 1
    assert max(one.pwm.max() for one in flown.truth) == 0
    assert flown.heard == [[], []]
