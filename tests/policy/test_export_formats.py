"""Policies as ONNX and as a C99 header: the numbers of NumPy inference, and refusals."""

from __future__ import annotations

import dataclasses
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
import pytest
from command_line import assert_one_line, call, listing, load_arrays, run, write_arrays
from conftest import Trained
from onboard_bench import needs_gcc
from tables import weekly

from mjxball import __version__
from mjxball.cli import apply_plant, plant_setup
from mjxball.config import preset
from mjxball.export import in_team, main
from mjxball.policy import Policy, PolicyFile, load_file
from mjxball.policy.file import interface_of, shipped_policy
from mjxball.policy.formats.c_header import c_header, footprint
from mjxball.policy.formats.onnx_model import onnx_model
from mjxball.policy.quantize import balanced, rows_of
from mjxfly.policy_setup import config_of
from onboard import recurrent as recurrent_flight

STEPS = 60
# Of one step's action in [-1, 1] by C, against NumPy in the same dtype: what docs/policy-file.md promises of float32.
# The steepest policies, whose inputs are scaled by up to 370, were seen at 7e-6.
TOLERANCE = 1e-5
INT8_TOLERANCE = 5e-4  # steps of 16 bits that rounding takes to the next one; weights of 8 bits differ by 0.02
ONNX_TOLERANCE = 2e-5  # float32 beside NumPy, which answers one follower in float64
HARNESS = """
#include <stdio.h>
#include "follower.h"

/* Each record: start (int), memory, observation -> action, command, memory, in MJXBALL_REAL. */
int main(void) {
    mjxball_follower_follower follower = {0};
    mjxball_follower_real seen[18], action[3], command[3];
    int start;
    fprintf(stderr, "%d", (int)sizeof follower);
    mjxball_follower_reset(&follower);
    while (fread(&start, sizeof start, 1, stdin) == 1) {
        if (start) mjxball_follower_reset(&follower);
#if MJXBALL_FOLLOWER_MEMORY_SIZE > 0
        mjxball_follower_real memory[MJXBALL_FOLLOWER_MEMORY_SIZE];
        if (fread(memory, sizeof memory, 1, stdin) != 1) return 1;
        if (!start) mjxball_follower_copy(follower.memory, memory, MJXBALL_FOLLOWER_MEMORY_SIZE);
#endif
        if (fread(seen, sizeof seen, 1, stdin) != 1) return 1;
        if (mjxball_follower_follow(&follower, seen, action, command)) return 1;
        fwrite(action, sizeof action, 1, stdout);
        fwrite(command, sizeof command, 1, stdout);
#if MJXBALL_FOLLOWER_MEMORY_SIZE > 0
        fwrite(follower.memory, sizeof follower.memory, 1, stdout);
#endif
    }
    return 0;
}
"""


@pytest.fixture(scope="module")
def direct(trained: Trained) -> PolicyFile:
    """A follower that commands directly, with other gains and limits."""
    metadata = {**trained.contents.metadata, "action_mode": "direct", "command_limits": [0.1, 1.5]}
    return dataclasses.replace(trained.contents, metadata=metadata)


@pytest.fixture(scope="module")
def limited(remembering: Trained) -> PolicyFile:
    """A follower with all that it can remember, whose PD controller differs on every axis and meets its limits."""
    metadata = {**remembering.contents.metadata, "leader_kp": [0.5, 0.7, 0.9], "leader_kd": [1.0, 1.2, 1.4]}
    return dataclasses.replace(remembering.contents, metadata={**metadata, "command_limits": [0.05, 0.6]})


@pytest.fixture(
    params=[
        *("trained", "direct", "remembering", "limited", "recurrent"),
        *("balance", "transport-large", "robust", "flight", "stand", "paper"),
        *("universal pair", "universal team3"),
    ]
)
def contents(request: pytest.FixtureRequest) -> PolicyFile:
    name, _, plant = request.param.partition(" ")
    if plant:
        return in_team(load_file(shipped_policy(name)), name, Path(plant), None if plant == "pair" else 2)
    if name in ("balance", "transport-large", "robust", "flight", "stand", "paper"):
        return load_file(shipped_policy(name))
    made = request.getfixturevalue(request.param)
    return made if isinstance(made, PolicyFile) else made.contents


@dataclasses.dataclass(frozen=True)
class Flight:
    """What NumPy inference in one dtype does, step by step; two flights, the second starts half way."""

    start: np.ndarray  # (T,) bool
    memory: np.ndarray  # (T, m) before each step
    observation: np.ndarray  # (T, 18) float32
    action: np.ndarray  # (T, 3) in [-1, 1]
    command: np.ndarray  # (T, 3)
    next_memory: np.ndarray  # (T, m)


def flown(contents: PolicyFile, dtype: Any, policy: Policy | None = None) -> Flight:
    """NumPy inference, by `policy` or `contents`, on observations that change as smoothly as a flight's."""
    policy, random = policy or Policy(contents, "follower", dtype), np.random.default_rng(3)
    walk = np.cumsum(random.normal(scale=0.03, size=(STEPS, 18)), axis=0) + random.normal(scale=0.3, size=18)
    size = interface_of(contents.metadata).size
    rows: dict[str, list[Any]] = {field.name: [] for field in dataclasses.fields(Flight)}
    for number, seen in enumerate(walk.astype(np.float32)):
        start = number % (STEPS // 2) == 0
        if start:
            policy.reset()
        rows["start"].append(start)
        rows["memory"].append(np.zeros(size) if policy.memory is None else policy.memory)
        rows["observation"].append(seen)
        memory = policy.memory
        rows["action"].append(policy.action(seen))
        after = policy.memory
        policy.memory = memory
        rows["command"].append(policy(seen))
        rows["next_memory"].append(np.zeros(0) if after is None else after)
    return Flight(**{name: np.array(values) for name, values in rows.items()})


def assert_remembered(found: np.ndarray, flight: Flight, tolerance: float) -> None:
    """Memories agree: observations, actions, states of a GRU, what is told of a team."""
    np.testing.assert_allclose(found, flight.next_memory, rtol=1e-5, atol=1e-6 + tolerance)


def test_onnx_computes_what_numpy_computes(contents: PolicyFile):
    session = onnxruntime.InferenceSession(onnx_model(contents, "follower").SerializeToString())
    flight = flown(contents, np.float32)
    feed: dict[str, np.ndarray] = {"observation": flight.observation}
    if flight.memory.shape[1]:
        feed |= {"memory": flight.memory.astype(np.float32), "start": flight.start[:, None]}
    assert {item.name for item in session.get_inputs()} == set(feed)
    names = [item.name for item in session.get_outputs()]
    answer = dict(zip(names, session.run(None, feed), strict=True))  # all steps as one batch
    np.testing.assert_allclose(answer["action"], flight.action, rtol=0, atol=ONNX_TOLERANCE)
    scale = float(contents.action_scale.max())
    np.testing.assert_allclose(answer["command"], flight.command, rtol=0, atol=1e-6 + scale * ONNX_TOLERANCE)
    if flight.memory.shape[1]:
        assert_remembered(answer["next_memory"], flight, ONNX_TOLERANCE)
    assert np.abs(flight.action).max() > 0.05


def test_onnx_flies_by_itself(limited: PolicyFile):
    """Fed its own memory, whose first value it must not read."""
    session = onnxruntime.InferenceSession(onnx_model(limited, "follower").SerializeToString())
    flight = flown(limited, np.float32)
    memory = np.full((1, flight.memory.shape[1]), 7.0, np.float32)
    for number, seen in enumerate(flight.observation):
        feed = {"observation": seen[None], "memory": memory, "start": flight.start[None, number : number + 1]}
        action, memory = session.run(["action", "next_memory"], feed)
        np.testing.assert_allclose(action[0], flight.action[number], rtol=0, atol=5e-6)  # 30 steps of rounding


def compiled(contents: PolicyFile, place: Path, real: str, int8: bool = False) -> Path:
    """The harness around the header of `contents`, compiled as strictly as gcc can."""
    if shutil.which("gcc") is None:
        pytest.skip("no gcc is installed")
    (place / "follower.h").write_text(c_header(contents, "follower", int8))
    (place / "main.c").write_text(HARNESS)
    strict = ["-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wshadow", "-Wconversion", "-Werror", "-O2"]
    command = ["gcc", *strict, f"-DMJXBALL_REAL={real}", "main.c", "-o", "harness", "-lm"]
    done = subprocess.run(command, cwd=place, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr
    return place / "harness"


def answered(harness: Path, flight: Flight, dtype: Any) -> tuple[np.ndarray, int]:
    """(action, command, memory of the next step) (T, 6 + m) of `harness` for each step, and what its state takes."""
    records = b"".join(
        np.int32(start).tobytes() + memory.astype(dtype).tobytes() + seen.astype(dtype).tobytes()
        for start, memory, seen in zip(flight.start, flight.memory, flight.observation, strict=True)
    )
    done = subprocess.run([harness], input=records, capture_output=True, check=True)
    return np.frombuffer(done.stdout, dtype).reshape(STEPS, -1), int(done.stderr)


class Whole:
    """A matrix of weights of 8 bits, whose products with a vector of 16 bits are whole numbers."""

    __array_ufunc__ = None  # a product with it is `__rmatmul__`

    def __init__(self, weight: np.ndarray):
        self.rows = rows_of(weight)

    def __rmatmul__(self, seen: np.ndarray) -> np.ndarray:
        largest, most = np.abs(seen).max(), np.float32(32767)
        whole = (seen * (most / largest) + np.float32(32768.5)).astype(np.int64) - 32768
        return (self.rows.weight @ whole).astype(np.float32) * (largest / most * self.rows.step)


@needs_gcc
@pytest.mark.parametrize("name", ["balance", "flight", "universal", "recurrent flight"])
def test_c_with_weights_of_8_bits_computes_with_whole_numbers(name: str, tmp_path: Path):
    """Also beside the weights in float32, so that the whole numbers are those of the policy."""
    contents = recurrent_flight() if name == "recurrent flight" else load_file(shipped_policy(name))
    contents = in_team(contents, name, Path("pair")) if name == "universal" else contents
    policy = Policy(balanced(contents), "follower")
    network = policy._network
    gru = None if network.gru is None else (*map(Whole, network.gru[:2]), network.gru[2])
    policy._network = network._replace(weights=[Whole(weight) for weight in network.weights], gru=gru)
    flight, exact = flown(contents, np.float32, policy), flown(contents, np.float32)
    answer, _ = answered(compiled(contents, tmp_path, "float", int8=True), flight, np.float32)
    np.testing.assert_allclose(answer[:, :3], flight.action, rtol=0, atol=INT8_TOLERANCE)
    assert_remembered(answer[:, 6:], flight, INT8_TOLERANCE)
    assert 1e-3 < np.sqrt(np.mean((flight.action - exact.action) ** 2)) < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("real", ["float", *weekly("double")])
def test_c_computes_what_numpy_computes(contents: PolicyFile, real: str, tmp_path: Path):
    dtype = np.float32 if real == "float" else np.float64
    flight = flown(contents, dtype)
    answer, state = answered(compiled(contents, tmp_path, real), flight, dtype)
    np.testing.assert_allclose(answer[:, :3], flight.action, rtol=0, atol=TOLERANCE)
    scale = float(contents.action_scale.max())
    np.testing.assert_allclose(answer[:, 3:6], flight.command, rtol=0, atol=1e-6 + scale * TOLERANCE)
    assert_remembered(answer[:, 6:], flight, TOLERANCE)
    if real == "float":
        assert state == footprint(contents).state


def test_the_header_states_what_it_costs(contents: PolicyFile):
    text = c_header(contents, "follower")
    arrays = [int(size) for size in re.findall(r"static const float \w+\[(\d+)\]", text)]
    cost = footprint(contents)
    assert 4 * sum(arrays) == cost.flash
    assert f"Flash: {cost.flash} bytes" in text
    assert f"RAM: {cost.state} bytes" in text
    size, widest = map(int, re.search(r"mjxball_follower_real input\[(\d+)\], hidden\[2\]\[(\d+)\];", text).groups())
    gates = re.search(r"given\[(\d+)\], kept\[(\d+)\], next\[(\d+)\], joined\[(\d+)\];", text)
    assert (gates is None) == (interface_of(contents.metadata).units == 0)
    own = sum(map(int, gates.groups())) if gates else 0
    assert 4 * (size + 2 * widest + own) == cost.stack
    assert f"{cost.stack} bytes of arrays on the stack" in text
    assert not re.search(r"\b(malloc|calloc|free|static (?!const float|inline))", text)
    versions = re.search(r"trained by mjxball (\S+) .* exported by mjxball (\S+)\.\n", text).groups()
    assert versions == (contents.metadata["package_version"], __version__)


@pytest.mark.slow
def test_a_card_cannot_leave_the_comment(trained: Trained, tmp_path: Path):
    evil = '*/ #error "out" /* \\\n'
    metadata = {**trained.contents.metadata, "preset": evil, "package_version": evil}
    compiled(dataclasses.replace(trained.contents, metadata=metadata), tmp_path, "float")


@pytest.mark.parametrize("name", ["follower.onnx", "follower.h", "again.npz"])
def test_command_line_exports_a_policy_file(name: str, saved: Path, tmp_path: Path, capsys: pytest.CaptureFixture):
    out = tmp_path / name
    assert call(main, [saved, out]) == 0
    assert capsys.readouterr().out == f"{out}\n"
    if name.endswith(".onnx"):
        model = onnx_model(load_file(saved), "follower")
        assert out.read_bytes() == model.SerializeToString()
    elif name.endswith(".h"):
        assert out.read_text() == c_header(load_file(saved), "follower")
    else:
        np.testing.assert_array_equal(load_file(out).weights[0], load_file(saved).weights[0])


@pytest.mark.parametrize("plant", ["crazyflie-thrust-upgrade", "crazyflie-brushless"])
def test_a_policy_of_two_crazyflies_flies_others(plant: str, tmp_path: Path):
    """Its weights and controllers stay; plant, gains and force curve are those of the other drones."""
    out, before = tmp_path / "other.npz", load_file(shipped_policy("flight"))
    assert main(["flight", str(out), "--plant", plant]) == 0
    after, wanted = load_file(out), apply_plant(preset("flight"), Path(plant))
    for one, other in zip(after.weights, before.weights, strict=True):
        np.testing.assert_array_equal(one, other)
    flown = config_of(after.metadata)
    assert (flown.plant, flown.autopilot) == (wanted.plant, wanted.autopilot)
    trained = config_of(before.metadata)
    assert (flown.leader, flown.command, flown.follower) == (trained.leader, trained.command, trained.follower)
    assert after.metadata["firmware"]["drone"] == plant.removeprefix("crazyflie-")
    assert after.metadata["command"] == before.metadata["command"]


@pytest.mark.parametrize(
    ("source", "out", "message"),
    [
        ("follower.npz", "follower.txt", "must end in .npz, .onnx, .h"),
        ("follower.npz", "follower", "must end in .npz, .onnx, .h"),
        ("follower.npz", "taken.h", "taken.h exists"),
        ("follower.npz", "nowhere/follower.h", "nowhere does not exist"),
        ("none.npz", "follower.h", "none.npz does not exist"),
        ("broken.npz", "follower.onnx", "broken.npz: metadata field history is missing"),
        ("no-run", "follower.onnx", "no-run"),
        ("follower.npz", "a.h --plant team4", "is for the plant that it was trained on"),
        ("flight", "a.npz --plant stand", "is for the plant that it was trained on"),
        ("flight", "a.npz --plant crazyflie --drone 1", "is for the plant that it was trained on"),
        ("balance", "a.npz --plant crazyflie", "is for the plant that it was trained on"),
        ("universal.npz", "a.h", "must know its team: --plant NAME"),
        ("universal.npz", "a.onnx --plant team4", "--drone must be a follower of --plant: 1, 2, 3"),
        ("universal.npz", "a.onnx --plant team4 --drone 0", "--drone must be a follower of --plant: 1, 2, 3"),
        ("universal.npz", "a.onnx --drone 1", "must know its team: --plant NAME"),
        ("older.npz", "a.h --plant team4 --drone 1", "has policy format 3, a network on top of an LQG"),
        ("universal.npz", "a.npz --plant nothing", "plant file nothing does not exist"),
    ],
)
def test_refusals(source: str, out: str, message: str, saved: Path, monkeypatch, capsys):
    shutil.copy(shipped_policy("universal"), saved.parent)
    (saved.parent / "taken.h").write_text("mine")
    arrays, metadata = load_arrays(saved)
    write_arrays(saved.parent / "older.npz", arrays, {**metadata, "format_version": 3})
    del metadata["history"]
    write_arrays(saved.parent / "broken.npz", arrays, metadata)
    before = listing(saved.parent)
    monkeypatch.chdir(saved.parent)
    assert call(main, [source, *out.split()]) == 2
    errors = capsys.readouterr().err
    assert_one_line(errors)
    assert message in errors
    assert listing(saved.parent) == before


def test_a_policy_that_was_told_its_team_flies_as_one_that_joined(tmp_path: Path):
    out = tmp_path / "third.npz"
    assert call(main, [shipped_policy("universal"), out, "--plant", "team4", "--drone", "3"]) == 0
    config, joined, told = plant_setup(Path("team4")), Policy.load(shipped_policy("universal")), Policy.load(out)
    joined.join(config.plant)
    for seen in np.random.default_rng(0).normal(scale=0.2, size=(5, 18)):
        np.testing.assert_allclose(told(seen), joined(np.stack([seen] * 3))[2], rtol=0, atol=1e-5)
    assert call(main, [out, tmp_path / "third.onnx"]) == 0  # it need not be told again
    mount = config.plant.drones[3].mount
    assert told.metadata["team"]["mount_angle"] == pytest.approx(np.arctan2(-mount[1], -mount[0]))


@pytest.mark.slow
def test_a_missing_package_is_named_with_its_extra(saved: Path):
    script = "import sys; sys.modules['onnx'] = None; from mjxball.export import main; sys.exit(main(sys.argv[1:]))"
    done = run(["-c", script, saved, "out.onnx"], Path(__file__).parents[2])
    assert done.returncode == 2
    assert "mjxball[onnx]" in done.stderr
    assert done.stderr.count("\n") == 1
