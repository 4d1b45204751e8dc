"""Followers on board: the apps' C against the laptop's laws, compiled, on a Cortex-M4F, and flown by the twin."""

from __future__ import annotations

import dataclasses
import itertools
import re
import shutil
import subprocess
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import assert_one_line, call

import cortex
import onboard as benchmark
from mjxball.control import rotations
from mjxball.errors import InputError
from mjxball.export import main as export
from mjxball.fly.app import generate, protocol
from mjxball.fly.app.host import App, Library, State, compile_pair
from mjxball.fly.app.protocol import CAUSES, Phase
from mjxball.fly.card import Controller
from mjxball.fly.connection import LinkError
from mjxball.fly.main import main as fly
from mjxball.fly.onboard import Apps
from mjxball.fly.supervisor import State as Laptop
from mjxball.fly.telemetry import ObjectState, Rig
from mjxball.fly.twin.conditions import Surroundings
from mjxball.fly.twin.virtual import VirtualTwin
from mjxball.policy import Policy, PolicyFile, load_file
from mjxball.policy.file import shipped_policy
from mjxball.policy.formats.c_header import weight_bytes
from mjxball.policy.quantize import quantized
from virtual_flight import SETTLE, code_of, settings_of

needs_gcc = pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc is installed")
needs_arm = pytest.mark.skipif(bool(cortex.missing()), reason=f"not installed: {cortex.missing()}")
Cores = tuple[Library, Library]


def policy_of(name: str) -> PolicyFile:
    return load_file(shipped_policy(name))


@pytest.fixture(scope="module")
def cores() -> Cores:
    """Those of `flight`."""
    return compile_pair(policy_of("flight"), "flight")


class Bench:
    """Two apps on a rig that is held in the hand."""

    def __init__(self, cores: Cores, rig: Rig):
        self.apps = [App(core, number) for number, core in enumerate(cores)]
        self.rig, self.now = rig, 1000
        for app, mount in zip(self.apps, rig.mounts, strict=True):
            for axis, value in zip("XYZ", mount, strict=True):
                app.set(f"mount{axis}", value)

    def state(self, pair: ObjectState, mount: np.ndarray) -> State:
        """What the drone at `mount` estimates."""
        seen, matrix = State(), pair.matrix
        seen.position[:] = pair.position + matrix @ mount
        seen.velocity[:] = pair.velocity + matrix @ np.cross(pair.rates, mount)
        seen.quaternion[:], seen.rates[:] = pair.quaternion, pair.rates
        seen.variance[:], seen.time, seen.can_fly = [1e-5] * 3, self.now, True
        return seen

    def tick(self, order: Phase | None, pair: ObjectState | None = None, **wrong: Any) -> list[Any]:
        """A period of both; `wrong` values of the leader's state. Returns both setpoints."""
        rest = ObjectState(np.zeros(3), np.zeros(3), np.array([1.0, 0, 0, 0]), np.zeros(3))
        beats = [app.send() for app in self.apps]
        self.now += self.apps[0].period
        sent = []
        for app, beat, mount in zip(self.apps, beats[::-1], self.rig.mounts, strict=True):
            app.hear(beat, self.now)
            if order is not None:
                app.laptop(protocol.order(order).data, self.now)
            state = self.state(pair or rest, mount)
            for name, value in wrong.items() if app is self.apps[0] else ():
                if isinstance(value, bool):
                    setattr(state, name, value)
                else:
                    getattr(state, name)[:] = value
            sent.append(app.tick(state, self.now))
        return sent

    def take_off(self) -> None:
        """To the first period under the laws."""
        for phase, periods in ((Phase.IDLE, 3), (Phase.SPIN, 5), (Phase.RAMP, 160)):
            for _ in range(periods):
                self.tick(phase)
                if self.apps[0].phase is Phase.FLY:
                    return

    @property
    def phases(self) -> list[Phase]:
        return [app.phase for app in self.apps]

    def cause(self, number: int = 0) -> str:
        return CAUSES[int(self.apps[number].logged()["cause"])]


@needs_gcc
@pytest.mark.parametrize("name", ["flight", "stand"])
def test_the_apps_command_what_the_laptop_would(name: str):
    """Leader and follower over 5 s of motion: float32 on board, float64 laws on the laptop."""
    policy = policy_of(name)
    bench = Bench(compile_pair(policy, name), Rig.of_card(policy.card))
    controller = Controller(Policy(policy, name))
    free = controller.config.plant.stand == "free"
    goal = np.array([0.0, 0.0, 0.4 if free else 0.08])
    random, euler = np.random.default_rng(0), np.zeros(3)
    position, velocity, rates = np.zeros(3), np.zeros(3), np.zeros(3)
    bench.take_off()  # the last period was one of the laws', at rest
    controller.step(ObjectState(np.zeros(3), np.zeros(3), np.array([1.0, 0, 0, 0]), np.zeros(3)), goal)
    worst, spread = np.zeros(6), np.zeros(6)
    for number in range(500):  # noqa: B007
        velocity = 0.95 * velocity + random.normal(scale=0.01, size=3)
        position, rates = 0.99 * position + 0.01 * velocity, 0.9 * rates + random.normal(scale=0.02, size=3)
        euler = 0.97 * euler + 0.01 * rates
        moving = [np.array(one) for one in (position, velocity, euler, rates)]
        if not free:
            moving[0][:2] = moving[1][:2] = moving[2][1:] = moving[3][1:] = 0.0
        pair = ObjectState(moving[0], moving[1], rotations.quaternion_from_euler(moving[2]), moving[3])
        bench.tick(Phase.FLY, pair)
        wanted = controller.step(pair, goal)
        both = np.concatenate([wanted.leader, wanted.follower])
        found = np.concatenate([app.command for app in bench.apps])
        if bench.phases != [Phase.FLY] * 2:
            break
        worst, spread = np.maximum(worst, abs(found - both)), np.maximum(spread, abs(both))
    assert number > 50
    # Float rounding, fed back through the follower's memory; m/s2 beside rad.
    assert worst.max() < 1e-4
    assert spread[5] > 0.05
    assert spread[2] > 0.05


REFUSED: tuple[tuple[str, Any], ...] = (
    ("the mount is not set", lambda bench: bench.apps[0].set("mountY", 0.0)),
    ("the goal is beyond the fence or not finite", lambda bench: bench.apps[0].set("goalZ", 9.0)),
    ("the goal is beyond the fence or not finite", lambda bench: bench.apps[0].set("goalX", float("nan"))),
    ("the policy does not fly with this force curve", lambda bench: bench.apps[0].set("curve", 2)),
)


@needs_gcc
def test_an_app_refuses_to_start(cores: Cores):
    rig = Rig.of_card(policy_of("flight").card)
    for text, spoil in REFUSED:
        bench = Bench(cores, rig)
        bench.tick(Phase.IDLE)
        spoil(bench)
        for _ in range(5):
            sent = bench.tick(Phase.SPIN)
        assert bench.apps[0].phase is Phase.IDLE, text
        assert CAUSES[int(bench.apps[0].logged()["refusal"])] == text
        assert not sent[0].active
    bench = Bench(cores, rig)
    for wrong, text in (
        ({"can_fly": False}, "the firmware cannot fly"),
        ({"position": [float("nan")] * 3}, "the state is old or not finite"),
        ({"variance": [1.0] * 3}, "the estimator's position cannot be trusted"),
    ):
        for _ in range(3):
            bench.tick(Phase.SPIN, **wrong)
        assert CAUSES[int(bench.apps[0].logged()["refusal"])] == text
    alone = App(cores[1], 1)
    alone.set("mountY", -0.15)
    alone.laptop(protocol.order(Phase.SPIN).data, 1000)
    alone.tick(
        bench.state(ObjectState(*[np.zeros(3)] * 2, np.array([1.0, 0, 0, 0]), np.zeros(3)), np.zeros(3)), bench.now
    )
    assert alone.phase is Phase.IDLE


@needs_gcc
def test_one_abort_lands_both(cores: Cores):
    """Whatever the leader finds moves the follower within two periods, and the other way round for silence."""
    rig = Rig.of_card(policy_of("flight").card)
    for wrong, phase, text in (
        ({"position": [5.0, 0.15, 0.0]}, Phase.DESCEND, "beyond the fence"),
        ({"position": [float("inf"), 0.0, 0.0]}, Phase.DESCEND, "the state is old or not finite"),
        ({"variance": [1.0, 0.0, 0.0]}, Phase.DESCEND, "the estimator's position cannot be trusted"),
        ({"quaternion": [0.9, 0.4359, 0.0, 0.0]}, Phase.STOP, "tilted beyond the limit"),
        ({"can_fly": False}, Phase.STOP, "the firmware cannot fly"),
    ):
        bench = Bench(cores, rig)
        bench.take_off()
        assert bench.phases == [Phase.FLY] * 2
        bench.tick(Phase.FLY, **wrong)
        sent = bench.tick(Phase.FLY, **wrong)
        assert bench.phases == [phase] * 2, text
        assert (bench.cause(0), bench.cause(1)) == (text, "the other drone does")
        assert all(np.isfinite([one.roll, one.pitch, one.thrust]).all() for one in sent)
        assert all((one.thrust == 0) == (phase is Phase.STOP) for one in sent)
    bench = Bench(cores, rig)
    bench.take_off()
    high = ObjectState(np.array([0.0, 0.0, 0.3]), np.zeros(3), np.array([1.0, 0, 0, 0]), np.zeros(3))
    for _ in range(40):
        bench.tick(Phase.LAND, high)
    bench.tick(Phase.LAND, high, variance=[1.0] * 3)  # nothing is known of the ground
    assert bench.phases[0] is Phase.DESCEND
    bench = Bench(cores, rig)
    bench.take_off()
    for _ in range(52):
        bench.tick(None)
    assert bench.phases == [Phase.LAND] * 2
    assert "the laptop is not heard" in (bench.cause(0), bench.cause(1))


@needs_gcc
def test_weights_are_uploaded_on_the_ground_only():
    policy = policy_of("flight")
    other = dataclasses.replace(policy, biases=tuple(bias + np.float32(0.01) for bias in policy.biases))
    bench = Bench(compile_pair(policy, "flight", int8=True), Rig.of_card(policy.card))
    follower, key, data = bench.apps[1], generate.key_of(policy), weight_bytes(other)
    assert key == generate.key_of(other)
    assert follower.ident == zlib.crc32(weight_bytes(policy)) == generate.ident_of(policy, True)

    def upload(packets: Any) -> int:
        replies = [protocol.reply_of(follower.laptop(packet.data, bench.now)) for packet in packets]
        return next((reply.status for reply in replies if reply is not None and reply.status), 0)

    bad = CAUSES.index("weights refused: wrong rate, plant, format, size or CRC")
    packets = list(protocol.upload(data, key))
    assert upload(protocol.upload(data, key + 1)) == bad  # another rate or plant
    assert upload(protocol.upload(data[:-8], key)) == bad
    assert upload([*packets[:7], *packets[8:]]) == bad  # a chunk is lost
    broken = [*packets[:7], packets[7]._replace(data=packets[7].data[:-1] + b"\x55"), *packets[8:]]
    assert upload(broken) == bad
    assert follower.ident == generate.ident_of(policy, True)
    assert upload([*packets[:5], *packets[3:]]) == 0  # repeated ones do no harm
    assert follower.ident == generate.ident_of(other, True)
    bench.take_off()
    flown = [bench.tick(Phase.FLY)[1] for _ in range(3)]
    new = Bench(compile_pair(other, "flight", int8=True), bench.rig)
    new.take_off()
    assert [one.thrust for one in flown] == [new.tick(Phase.FLY)[1].thrust for _ in range(3)]
    assert upload(protocol.upload(data, key)) == CAUSES.index("weights refused: not on the ground")


def test_names_are_those_of_the_c_files():
    header, glue = ((generate.sources() / name).read_text() for name in ("core.h", "glue.c"))
    causes = re.search(r"\{([^{}]*) +MJXBALL_CAUSES,\s*\} mjxball_cause;", header)
    assert causes is not None
    assert len(re.findall(r"MJXBALL_\w+,", causes[1])) == len(CAUSES)
    parameters = re.findall(r"PARAM_ADD\((PARAM_\w+)( \| PARAM_RONLY)?, (\w+),", glue)
    kinds = {"PARAM_FLOAT": "float", "PARAM_UINT8": "uint8_t", "PARAM_UINT32": "uint32_t"}
    assert [(name, kinds[kind], bool(fixed)) for kind, fixed, name in parameters] == list(protocol.PARAMETERS)
    logged = re.findall(r"LOG_ADD\(LOG_(\w+), (\w+),", glue)
    kinds = {"FLOAT": "float", "UINT8": "uint8_t", "UINT32": "uint32_t"}
    assert [(name, kinds[kind]) for kind, name in logged] == list(protocol.LOGGED)


class FakeLink:
    """A drone whose app has these parameters."""

    def __init__(self, name: str, **values: float):
        self.name, self.values = name, {f"mjxb.{one}": value for one, value in values.items()}
        self.parameters = self

    def read(self, names: list[str]) -> dict[str, float]:
        if missing := [name for name in names if name not in self.values]:
            raise LinkError(f"the firmware of the {self.name} has no parameter {missing[0]}; update it")
        return {name: self.values[name] for name in names}


def test_the_laptop_refuses_other_apps():
    apps, said = Apps("flight", (11, 12), 10), list[str]()
    good = ({"role": 0, "period": 10}, {"role": 1, "period": 10, "ident": 12})
    apps.check([FakeLink("leader", **good[0]), FakeLink("follower", **good[1])], said.append)  # type: ignore[list-item]
    assert said == ["on board: flight, 8 bit weights"]
    for leader, follower, text in (
        ({}, good[1], "the leader has no app on board"),
        ({**good[0], "role": 1}, good[1], "exchange the URIs"),
        (good[0], {**good[1], "period": 20}, "the app of the follower has a period of 20 ms, and flight one of 10 ms"),
        (good[0], {**good[1], "ident": 13}, "the follower carries another policy than flight"),
    ):
        with pytest.raises(InputError, match=text):
            apps.check([FakeLink("leader", **leader), FakeLink("follower", **follower)], said.append)  # type: ignore[list-item]


def test_flags_that_contradict_onboard_are_refused(capsys: pytest.CaptureFixture):
    flight = shipped_policy("flight")
    for flags, text in (
        ([flight, "--rehearse", "--upload"], "--upload takes weights of 8 bits"),
        ([flight, "--rehearse", "--onboard", "--mass", "0.07"], "leave --thrust, --hover and --mass out"),
        ([flight, "--rehearse", "--onboard", "--goal", "0", "0", "9"], "beyond the fence"),
        ([shipped_policy("balance"), "--rehearse", "--onboard"], "another plant than a pair of Crazyflies"),
    ):
        assert call(fly, flags) == 2, text
        error = capsys.readouterr().err
        assert_one_line(error)
        assert text in error


INTERFACE = Path(__file__).parent / "firmware" / "interface.h"


@pytest.mark.slow
@needs_gcc
@pytest.mark.parametrize("name", ["flight", "flight --int8", "stand"])
def test_the_app_compiles_against_the_interface(name: str, tmp_path: Path, capsys: pytest.CaptureFixture):
    policy, *flags = name.split()
    assert call(export, [shipped_policy(policy), tmp_path / "app", "--crazyflie", *flags]) == 0
    glue = (tmp_path / "app/src/glue.c").read_text()
    (tmp_path / "include").mkdir()
    for header in set(re.findall(r'#include "(\w+\.h)"', glue)) - {"core.h"}:
        (tmp_path / "include" / header).write_text(f'#include "{INTERFACE}"\n')
    strict = ["-std=c11", "-Wall", "-Wextra", "-Werror", "-Wdouble-promotion", "-I", str(tmp_path / "include"), "-c"]
    compilers = [["gcc"], *([[*cortex.ARM]] if not cortex.missing() else [])]
    for compiler, (number, role) in itertools.product(compilers, enumerate(generate.ROLES)):
        for source in ("core", "glue"):
            options = [*compiler, *strict, f"-DMJXBALL_FOLLOWER={number}", f"src/{source}.c", "-o", "out.o"]
            done = subprocess.run(options, cwd=tmp_path / "app" / role, capture_output=True, text=True, check=False)
            assert done.returncode == 0, done.stderr
    words = int(re.search(r"STACKSIZE=(\d+)", (tmp_path / "app/follower/app-config").read_text())[1])
    assert 500 < words < 2000


@pytest.mark.slow
@needs_arm
@pytest.mark.parametrize("int8", [False, True])
def test_a_cortex_m4_computes_the_same_bits(int8: bool, tmp_path: Path):
    for name in ("balance", "flight"):
        found = benchmark.compare(policy_of(name), tmp_path, int8, 500)
        assert found["identical"], name
        if not int8:
            assert found["error"] <= 1e-5


# Each record: state, heartbeat of the other drone, time, order -> setpoint, command, integral, heartbeat.
REPLAY = r"""
#include "core.c"
int file_open(const char *name, int write);
int file_read(int file, void *to, unsigned size);
int file_write(int file, const void *from, unsigned size);

int main(void) {
    static mjxball_app app;
    static struct { mjxball_state state; uint8_t beat[MJXBALL_BEAT_SIZE]; uint32_t now, order; } in;
    static struct { float setpoint[3], command[3], integral[7]; uint8_t beat[MJXBALL_BEAT_SIZE]; } out;
    int from = file_open("in.bin", 0), to = file_open("out.bin", 1);
    mjxball_parameters set;
    mjxball_defaults(&set);
    set.mount[1] = MJXBALL_FOLLOWER ? -0.15f : 0.15f;
    mjxball_start(&app, 0);
    while (file_read(from, &in, sizeof in)) {
        const uint8_t order[2] = {1, (uint8_t)in.order};
        mjxball_setpoint wanted;
        mjxball_hear(&app, in.beat, sizeof in.beat, in.now);
        mjxball_laptop(&app, order, 2, in.now, 0, out.beat);
        mjxball_tick(&app, &set, &in.state, in.now, &wanted);
        mjxball_send(&app, out.beat);
        out.setpoint[0] = wanted.roll, out.setpoint[1] = wanted.pitch, out.setpoint[2] = wanted.thrust;
        for (int i = 0; i < 3; i++) out.command[i] = app.command[i];
        for (int i = 0; i < 7; i++) out.integral[i] = app.integral[i];
        file_write(to, &out, sizeof out);
    }
    return 0;
}
"""


@pytest.mark.slow
@needs_arm
def test_a_cortex_m4_flies_the_same_bits(cores: Cores, tmp_path: Path):
    """Both apps over take-off, motion of the pair, landing and a fence that is left, whose inputs were recorded."""
    policy = policy_of("flight")
    bench, random = Bench(cores, Rig.of_card(policy.card)), np.random.default_rng(5)
    records: list[list[bytes]] = [[], []]
    place, euler, seen = np.zeros(3), np.zeros(3), set()
    for step in range(900):
        order = (Phase.IDLE, Phase.SPIN, Phase.RAMP, Phase.FLY)[min(step // 20, 3)] if step < 700 else Phase.LAND
        place = place + random.normal(scale=0.002, size=3) if step > 200 else place
        euler = 0.98 * euler + random.normal(scale=0.004, size=3)
        far = np.array([0.0, 0.0, 0.0 if step < 60 else 0.4 if step < 800 else 2.0])  # at its goal, then outside
        moving = ObjectState(place + far, euler[::-1], rotations.quaternion_from_euler(euler), 4 * euler)
        beats = [app.send() for app in bench.apps][::-1]
        bench.tick(order, moving)
        for number, mount in enumerate(bench.rig.mounts):
            state = bytes(bench.state(moving, mount))
            records[number].append(state + beats[number] + np.array([bench.now, order], np.uint32).tobytes())
        seen |= set(bench.phases)
    assert seen >= {Phase.SPIN, Phase.RAMP, Phase.FLY, Phase.LAND, Phase.DESCEND}
    for path, text in generate.files_of(policy, "flight", False).items():
        if path in ("src/core.c", "src/core.h", "src/policy.h", "src/rig.h"):
            (tmp_path / Path(path).name).write_text(text)
    for number in range(2):
        cortex.build(tmp_path, REPLAY, [f"-DMJXBALL_FOLLOWER={number}"])
        host, arm = cortex.on_both(tmp_path, b"".join(records[number]))
        assert len(host) == 900 * (13 * 4 + protocol.BEAT_SIZE)
        assert host == arm


def test_int8_weights_are_near(tmp_path: Path, capsys: pytest.CaptureFixture):
    policy = policy_of("balance")
    assert call(export, [shipped_policy("balance"), tmp_path / "rounded.npz", "--int8"]) == 0
    saved = load_file(tmp_path / "rounded.npz").weights
    for exact, rounded, written in zip(policy.weights, quantized(policy).weights, saved, strict=True):
        np.testing.assert_array_equal(rounded, written)
        step = np.abs(exact).max(axis=0) / 127
        assert (np.abs(exact - rounded) <= step / 2 + 1e-7).all()
        assert np.abs(exact - rounded).max() > 0


def test_export_refuses_what_cannot_fly_on_board(tmp_path: Path, capsys: pytest.CaptureFixture):
    for arguments, text in (
        ([shipped_policy("balance"), tmp_path / "app", "--crazyflie"], "another plant than a pair of Crazyflies"),
        ([shipped_policy("flight"), tmp_path, "--crazyflie"], "exists"),
        ([shipped_policy("flight"), tmp_path / "a" / "b", "--crazyflie"], "does not exist"),
        (["saved.npz", tmp_path / "x.onnx", "--int8"], "--int8 is for"),
    ):
        assert call(export, arguments) == 2, text
        error = capsys.readouterr().err
        assert_one_line(error)
        assert text in error
    slow = policy_of("flight")
    with pytest.raises(InputError, match="control period of 40 ms"):
        generate.files_of(dataclasses.replace(slow, card={**slow.card, "control_period": 0.04}), "slow", False)
    assert not list(tmp_path.iterdir())


def world(cores: Cores, seconds: float = 6.0, **around: Any) -> VirtualTwin:
    policy = Policy.load(shipped_policy("flight"))
    settings = settings_of(policy, seconds)
    return VirtualTwin(policy, settings, surroundings=Surroundings(**around), settle=SETTLE, cores=cores)


@needs_gcc
def test_radio_delay_does_not_matter_on_board(cores: Cores):
    errors = []
    for delay in (0.0, 0.04):
        twin = world(cores, delay=delay)
        twin.run()
        assert code_of(twin) == 0
        flown = [moment for moment in twin.track if moment.state == "fly"][300:]
        off = np.array([moment.position for moment in flown]) - twin.flight.goal(twin.now)
        errors.append(float(np.sqrt((off**2).sum(axis=1).mean())))
    assert max(errors) < 0.03
    assert abs(errors[1] - errors[0]) < 0.005  # other phases of the noise


@needs_gcc
def test_the_apps_land_without_a_laptop(cores: Cores):
    twin = world(cores)
    twin.fly_until(Laptop.FLY)
    twin.fly_for(3.0)
    height = twin.moment().position[2] - twin.rest
    assert height > 0.2
    for _ in range(400):  # no tick of the flight any more
        twin.advance(0.02)
        twin.track.append(twin.moment())
    assert twin.running() == [False, False]
    assert twin.touchdown_speed() < 0.4
    assert [drone.app.phase for drone in twin.drones if drone.app] == [Phase.IDLE] * 2
    assert not any(drone.firmware.locked for drone in twin.drones)
