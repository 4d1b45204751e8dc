"""Followers on board: exported apps and weights, and what the laptop says to them before a flight."""

from __future__ import annotations

import dataclasses
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import assert_one_line, call
from onboard_bench import Bench, needs_gcc, policy_of

import onboard as benchmark
from mjxball.errors import InputError
from mjxball.export import main as export
from mjxball.policy import load_file
from mjxball.policy.file import shipped_policy
from mjxball.policy.formats.c_header import weight_bytes
from mjxball.policy.quantize import balanced, quantized
from mjxfly.app import generate, protocol
from mjxfly.app.host import App, compile_pair
from mjxfly.app.main import main as make_app
from mjxfly.app.protocol import CAUSES, AppPhase
from mjxfly.app_flight import OnboardApps, send_weights
from mjxfly.connection import LinkError
from mjxfly.limits import NAMES
from mjxfly.main import main as fly
from mjxfly.packets import Packet
from mjxfly.telemetry import Rig


def test_int8_weights_are_near(tmp_path: Path, capsys: pytest.CaptureFixture):
    policy = balanced(policy_of("balance"))
    assert call(export, [shipped_policy("balance"), tmp_path / "rounded.npz", "--int8"]) == 0
    saved = load_file(tmp_path / "rounded.npz").weights
    for exact, rounded, written in zip(policy.weights, quantized(policy).weights, saved, strict=True):
        np.testing.assert_array_equal(rounded, written)
        step = np.abs(exact).max(axis=0) / 127
        assert (np.abs(exact - rounded) <= step / 2 + 1e-7).all()
        assert np.abs(exact - rounded).max() > 0


def test_export_refuses_what_cannot_fly_on_board(tmp_path: Path, capsys: pytest.CaptureFixture):
    universal, place = shipped_policy("universal"), tmp_path / "app"
    for main, arguments, text in (
        (make_app, [shipped_policy("balance"), place], "another plant than a pair of Crazyflies"),
        (make_app, [universal, place, "--plant", "team4"], "for pairs of Crazyflies, and team4 has 4 drones"),
        (make_app, [universal, place, "--plant", "pair"], "is for another plant than a pair of Crazyflies"),
        (make_app, [shipped_policy("flight"), tmp_path], "exists"),
        (make_app, [shipped_policy("flight"), tmp_path / "a" / "b"], "does not exist"),
        (export, ["saved.npz", tmp_path / "x.onnx", "--int8"], "--int8 is for"),
    ):
        assert call(main, arguments) == 2, text
        error = capsys.readouterr().err
        assert_one_line(error)
        assert text in error
    slow = policy_of("flight")
    with pytest.raises(InputError, match="control period of 40 ms"):
        generate.files_of(dataclasses.replace(slow, metadata={**slow.metadata, "control_period": 0.04}), "slow", False)
    assert not list(tmp_path.iterdir())


@needs_gcc
@pytest.mark.parametrize("name", ["flight", "recurrent flight"])
def test_weights_are_uploaded_on_the_ground_only(name: str):
    policy = policy_of(name)
    other = dataclasses.replace(policy, biases=tuple(bias + np.float32(0.01) for bias in policy.biases))
    bench = Bench(compile_pair(policy, name, int8=True), Rig.from_metadata(policy.metadata))
    follower, key, data = bench.apps[1], generate.key_of(policy), weight_bytes(other)
    assert key == generate.key_of(other)
    assert follower.ident == zlib.crc32(weight_bytes(policy)) == generate.weights_crc(policy, True)

    def upload(packets: Any) -> int:
        replies = [protocol.reply_of(follower.laptop(packet.data, bench.now)) for packet in packets]
        return next((reply.status for reply in replies if reply is not None and reply.status), 0)

    bad = CAUSES.index("weights refused: wrong rate, plant, layers, size or CRC")
    packets = list(protocol.upload(data, key))
    assert upload(protocol.upload(data, key + 1)) == bad  # another rate or plant
    assert upload(protocol.upload(data[:-8], key)) == bad
    assert upload([*packets[:7], *packets[8:]]) == bad  # a chunk is lost
    broken = [*packets[:7], packets[7]._replace(data=packets[7].data[:-1] + b"\x55"), *packets[8:]]
    assert upload(broken) == bad
    assert follower.ident == generate.weights_crc(policy, True)
    for at, value in ((0, np.nan), (4, np.inf), (400, -3e38), (0, 2e6)):  # whole, and no numbers of a policy file
        wild = bytearray(data)
        wild[at : at + 4] = np.float32(value).tobytes()
        assert upload(protocol.upload(bytes(wild), key)) == bad
    assert follower.ident == generate.weights_crc(policy, True)
    assert upload([*packets[:5], *packets[3:]]) == 0  # repeated ones do no harm
    assert follower.ident == generate.weights_crc(other, True)
    bench.take_off()
    flown = [bench.tick(AppPhase.FLY)[1] for _ in range(3)]
    new = Bench(compile_pair(other, name, int8=True), bench.rig)
    new.take_off()
    assert [one.thrust for one in flown] == [new.tick(AppPhase.FLY)[1].thrust for _ in range(3)]
    assert upload(protocol.upload(data, key)) == CAUSES.index(
        "refused: weights, mount and curve change on the ground only"
    )


class AppLink:
    """A drone that runs `app`."""

    name = "follower"

    def __init__(self, app: App):
        self.app = app

    def ask_app(self, packet: Packet) -> protocol.Reply | None:
        return protocol.reply_of(self.app.laptop(packet.data, 0))


@needs_gcc
def test_a_recurrent_policy_of_another_size_is_refused():
    """Of more units, of fewer, and of none; the one that is on board stays."""
    policy = policy_of("recurrent flight")
    follower = App(compile_pair(policy, "small", int8=True)[1], 1)
    refusal = r"^the follower: weights refused: wrong rate, plant, layers, size or CRC$"
    for other in (benchmark.recurrent(47), benchmark.recurrent(64), policy_of("flight")):
        with pytest.raises(InputError, match=refusal):
            send_weights(AppLink(follower), weight_bytes(other), generate.key_of(other), print)  # type: ignore[arg-type]
        assert follower.ident == generate.weights_crc(policy, True)


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
    apps, said = OnboardApps("flight", (11, 12), 10), list[str]()
    good = ({"role": 0, "period": 10}, {"role": 1, "period": 10, "ident": 12})

    def check(*values: dict[str, float]) -> None:
        for number, name in enumerate(NAMES):
            apps.check(number, FakeLink(name, **values[number]), said.append)  # type: ignore[arg-type]

    check(*good)
    assert said == ["on board: flight, 8 bit weights"]
    for leader, follower, text in (
        ({}, good[1], "the leader has no app on board"),
        ({**good[0], "role": 1}, good[1], "exchange the URIs"),
        (good[0], {**good[1], "period": 20}, "the app of the follower has a period of 20 ms, and flight one of 10 ms"),
        (good[0], {**good[1], "ident": 13}, "the follower carries another policy than flight"),
    ):
        with pytest.raises(InputError, match=text):
            check(leader, follower)


def test_flags_that_contradict_onboard_are_refused(capsys: pytest.CaptureFixture):
    flight = shipped_policy("flight")
    pair = ["--leader", "udp://127.0.0.1:9", "--follower", "udp://127.0.0.1:10"]
    for flags, text in (
        ([flight, "--rehearse", "--upload"], "--upload takes weights of 8 bits"),
        ([flight, *pair, "--onboard", "--mocap", "vicon"], "the axes of --mocap"),
        ([flight, "--rehearse", "--onboard", "--mass", "0.07"], "leave --thrust, --hover and --mass out"),
        ([flight, "--rehearse", "--onboard", "--goal", "0", "0", "9"], "beyond the fence"),
        ([shipped_policy("balance"), "--rehearse", "--onboard"], "another plant than a pair of Crazyflies"),
    ):
        assert call(fly, flags) == 2, text
        error = capsys.readouterr().err
        assert_one_line(error)
        assert text in error
