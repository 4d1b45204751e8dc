"""A follower in a process of its own: what it may not know, what it may not do, and that its form does not matter."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import REPOSITORY
from tables import rows

from mjxball.baselines import make_controller
from mjxball.bench import evaluation, process
from mjxball.bench.draw import ENGINE
from mjxball.bench.evaluation import Result, evaluate, fresh_key, seed_of, with_seed
from mjxball.bench.followers import identity
from mjxball.bench.process import FollowerProcess
from mjxball.bench.tracks import FLIGHTS
from mjxball.config import preset
from mjxball.control.followers import Baseline
from mjxball.control.leader import clip_command
from mjxball.errors import InputError
from mjxball.evaluate.metrics import fly_and_measure
from mjxball.export import main as export

pytestmark = pytest.mark.slow
BALANCE, FLIGHT = (REPOSITORY / "policies" / f"{name}.npz" for name in ("balance", "flight"))
KEY = "0123456789abcdef" * 2
SOURCE = """
import os
import sys
import time

import numpy as np
from mjxball.baselines import Oracle
from mjxball.control.followers import Baseline, Copy, copy_gains
from mjxball.control.observation import copy_command
from mjxball.policy import Policy


class Sly:
    needs_privileged = False
    def __init__(self, config): pass
    def start(self, observation): return ()
    def step(self, state, observation, privileged):
        known = [privileged.believed_mass, privileged.moment, privileged.total_mass]
        return state, np.stack(known, axis=-1)

class Honest(Oracle):
    pass

class Good:
    def __init__(self, config): self.calls, self.config = 0, config
    def reset(self): self.calls = 0
    def __call__(self, observation): return np.zeros((*observation.shape[:-1], 3))

class Large(Good):
    def __call__(self, observation): return 1e3 + super().__call__(observation)

class Largest(Good):
    def __call__(self, observation):
        limits = self.config.command
        return super().__call__(observation) + [limits.tilt_limit, limits.tilt_limit, limits.vertical_limit]

class Curious(Good):
    def __call__(self, observation):
        if not self.calls:
            np.save("first.npy", observation)
        self.calls += 1
        return super().__call__(observation)

class Copies(Good):
    def __call__(self, observation): return copy_command(observation, *copy_gains(self.config))

def copies(config): return Baseline(Copy(config), config)

def flies(config): return Policy.load(POLICY)

def controller(config): return Policy.load(POLICY).controller

class Loops(Good):
    def __call__(self, observation):
        while True: pass

class LoopsLater(Good):
    def __call__(self, observation):
        self.calls += 1
        while self.calls > 125: pass
        return super().__call__(observation)

class Sleeps(Good):
    def __call__(self, observation): time.sleep(600)

class Naps(Good):
    def __call__(self, observation):
        time.sleep(0.03)
        return super().__call__(observation)

class Busy(Good):
    def __call__(self, observation):
        end = time.process_time() + 0.03
        while time.process_time() < end: pass
        return super().__call__(observation)

class Seldom(Good):
    share = 1.0
    def __call__(self, observation):
        self.calls += 1
        if self.calls in (5, 150):
            end = time.process_time() + self.share * (0.01 if self.calls == 150 else 0.1) * len(observation)
            while time.process_time() < end: pass
        return super().__call__(observation)

class TooSeldom(Seldom):
    share = 3.0

class Dies(Good):
    def __call__(self, observation):
        print("out of luck", file=sys.stderr)
        os._exit(3)

class Closes(Good):
    def __call__(self, observation):
        os.closerange(3, 100)
        time.sleep(600)

class Babbles(Good):
    def __call__(self, observation):
        os.write(int(sys.argv[2]), b"C" + bytes(3) + b"\\x05abcde")
        return super().__call__(observation)

class Shouts(Good):
    def __call__(self, observation):
        os.write(int(sys.argv[2]), b"Z" * 2000)
        return super().__call__(observation)

class Prints(Good):
    def __call__(self, observation):
        print("x" * 300_000)
        return super().__call__(observation)

class Forks(Good):
    def __init__(self, config):
        super().__init__(config)
        if not os.fork():
            time.sleep(60)
            os._exit(0)

class Leaves(Good):
    def __call__(self, observation): raise SystemExit(0)

class Nan(Good):
    def __call__(self, observation): return np.nan + super().__call__(observation)

class Shape(Good):
    def __call__(self, observation): return np.zeros(3)

class Raises(Good):
    def __call__(self, observation): raise KeyError("gone")
"""
REFUSED = {
    "own:Honest": "Honest is not ranked: it needs privileged information",
    "own:Loops": "Loops did not answer in time",
    "own:LoopsLater": "LoopsLater did not answer in time",
    "own:Sleeps": "Sleeps did not answer in time",
    "own:Busy": "ms of CPU time for a control step; at most 20 ms",
    "own:Dies": "Dies ended its process with code 3; it printed: out of luck",
    "own:Closes": "Closes closed its pipe",
    "own:Babbles": "no array was sent",
    "own:Shouts": "Shouts sent something that is no answer",
    "own:Forks": "Forks has started another process",
    "own:Leaves": "Leaves raised SystemExit",
    "own:Nan": "Nan answered a number that is not finite",
    "own:Shape": "Shape answered shape (3,) where (1, 3) was wanted",
    "own:Raises": "Raises raised KeyError: 'gone', in own.py line",
    "own:Gone": "own has no Gone",
    "loop.onnx": "loop did not answer in time",
}


@pytest.fixture
def own(short: Path) -> Path:
    """The directory of `own.py`, a module of followers."""
    (short / "own.py").write_text(SOURCE.replace("POLICY", repr(str(FLIGHT))))
    return short


def flown(text: str, track: str = "pair", key: str = KEY) -> list[Result]:
    """The short flights of a follower, checked as for an entry."""
    with FollowerProcess(identity(text)[0], text) as made:
        made.check_cpu_time(evaluation.groups_of(track, 0)[0].config)
        return evaluate(track, 0, key, made)


def values(found: list[Result]) -> np.ndarray:
    """What is measured of each flight."""
    names = ("late_error", "rotor_power", "smoothness", "max_tilt", "rotor_limit_share")
    return np.array([[getattr(one.metrics, name) for name in names] for one in found])


def endless_loop(path: str) -> None:
    """An ONNX model that takes observations and answers after a loop without end."""
    import onnx
    from onnx import TensorProto, helper

    def value(name: str, kind: int, shape: list[Any]) -> Any:
        return helper.make_tensor_value_info(name, kind, shape)

    body = helper.make_graph(
        [helper.make_node("Identity", ["go"], ["goes"]), helper.make_node("Identity", ["x"], ["y"])],
        "body",
        [value("i", TensorProto.INT64, []), value("go", TensorProto.BOOL, []), value("x", TensorProto.FLOAT, ["n", 3])],
        [value("goes", TensorProto.BOOL, []), value("y", TensorProto.FLOAT, ["n", 3])],
    )
    constants = [
        helper.make_tensor("weight", TensorProto.FLOAT, [18, 3], np.zeros(54).tolist()),
        helper.make_tensor("true", TensorProto.BOOL, [], [True]),
    ]
    nodes = [
        helper.make_node("MatMul", ["observation", "weight"], ["start"]),
        helper.make_node("Loop", ["", "true", "start"], ["command"], body=body),
    ]
    ends = [value(name, TensorProto.FLOAT, ["n", size]) for name, size in (("observation", 18), ("command", 3))]
    graph = helper.make_graph(nodes, "loop", ends[:1], ends[1:], constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)])
    model.ir_version = 8
    onnx.save(model, path)


@pytest.mark.parametrize("text", REFUSED)
def test_what_does_not_answer_as_it_should_is_refused(own: Path, monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    if text.endswith(".onnx"):
        pytest.importorskip("onnxruntime")
        endless_loop(text)
    if REFUSED[text].endswith("in time"):  # long enough to import everything on a busy machine; these take it whole
        monkeypatch.setattr(process, "PATIENCE", 8.0)
        monkeypatch.setattr(process, "PATIENCE_PER_STEP", 0.01)
    with pytest.raises(InputError) as refused:
        flown(text)
    assert REFUSED[text] in str(refused.value)
    assert "\n" not in str(refused.value)


def test_sleeping_is_no_cpu_time_and_printing_does_no_harm(own: Path) -> None:
    configured = evaluation.groups_of("pair", 0)[0].config
    for text in ("own:Naps", "own:Prints"):
        with FollowerProcess(text, text) as made:
            assert 0 < made.check_cpu_time(configured) < 0.015


@rows("name, slow", [("Seldom", False), ("TooSeldom", True)])
def test_one_slow_control_step_is_found(own: Path, name: str, slow: bool) -> None:
    """10 or 30 ms for each flight in step 150 alone; more in step 5, when programs may still compile."""
    found = flown(f"own:{name}")
    assert all(("slow" in one.failures) == slow for one in found if not one.metrics.failed)
    assert any(not one.metrics.failed for one in found)


def test_a_follower_that_hides_that_it_needs_the_true_cg_gets_zeros(own: Path) -> None:
    """It answers what it is given: the believed mass of each flight, a CG of 0, no mass of the assembly."""
    with FollowerProcess("sly", "own:Sly") as made:
        remote = made.follower(preset("paper"))
        remote.believed_mass = np.array([0.1, 0.2, 0.3, 0.4])
        remote.reset()
        answer = remote(np.zeros((4, 18)))
    np.testing.assert_array_equal(answer, np.stack([remote.believed_mass, np.zeros(4), np.zeros(4)], axis=-1))


def test_noise_and_order_come_from_the_key_alone(own: Path) -> None:
    """The same key gives the same bits, a fresh one other noise; no flight has the seed of its draw."""
    again, same, other = (flown("own:Copies", key=key) for key in (KEY, KEY, fresh_key()))
    np.testing.assert_array_equal(values(again), values(same))
    for condition in ("calm", "disturbed"):
        mine, others = (values([one for one in found if one.flight.condition == condition]) for found in (same, other))
        assert np.abs(mine - others).max() > 1e-6  # calm flights have constant errors of the key
    flights = [one.flight for one in same]
    seeds = {with_seed(one, key, 0).disturbance.seed for one in flights for key in (KEY, fresh_key())}
    assert len(seeds) == 2 * len(flights)
    assert not seeds & {one.scenario.disturbance.seed for one in flights}
    assert len({fresh_key() for _ in range(100)}) == 100
    # Of all flights of a track in two evaluations: seeds of 63 bits collide with a probability of 1e-14.
    assert len({seed_of(key, number) for key in (KEY, fresh_key()) for number in range(2 * FLIGHTS)}) == 4 * FLIGHTS


def test_conditions_are_mixed_and_no_flight_has_a_twin(own: Path) -> None:
    """By what a follower sees first of its flights, whose goals are far apart beside the noise of 3 mm."""
    found = flown("own:Curious")
    goals = {tuple(one.flight.scenario.goal): one.flight.condition for one in found}
    seen = np.load("first.npy")[:, 12:15]
    assert len(goals) == len(seen)
    places = np.array(list(goals))
    nearest = [int(np.linalg.norm(places - goal, axis=1).argmin()) for goal in seen]
    assert sorted(nearest) == list(range(len(seen)))
    assert nearest != sorted(nearest)


def test_commands_are_clipped_as_everybodys(own: Path) -> None:
    np.testing.assert_array_equal(values(flown("own:Large")), values(flown("own:Largest")))


def test_a_controller_has_one_score_in_every_form(own: Path) -> None:
    """Classes, baselines, by name."""
    first, *others = (values(flown(text, "crazyflie")) for text in ("copy", "own:Copies", "own:copies"))
    for other in others:
        np.testing.assert_array_equal(other, first)


def test_a_team_in_a_process_flies_as_in_a_simulation(own: Path) -> None:
    """With every flight's own mass, which the LQG reads.

    One thread may add up in another order than several, and calm flights do not amplify last bits.
    """
    (group,) = evaluation.groups_of("team", 0)
    found = [one for one in flown("lqg", "team") if one.flight.condition == "calm"]
    config = group.config
    scenarios = [with_seed(one.flight, f"{KEY}:team", 0) for one in found]
    assert len({one.mass for one in scenarios}) == len(scenarios)
    limits = config.command.tilt_limit, config.command.vertical_limit

    class Clipped(Baseline):
        def __call__(self, observation: np.ndarray) -> np.ndarray:
            return clip_command(super().__call__(observation), *limits)

    lqg = Clipped(make_controller("lqg", config), config)
    radii, deadlines = (np.array([getattr(one.flight, name) for one in found]) for name in ("radius", "deadline"))
    _, direct = fly_and_measure(config, [(lqg, scenarios)], ENGINE, radii, deadlines)
    again = [one._replace(metrics=metrics) for one, metrics in zip(found, direct, strict=True)]
    np.testing.assert_allclose(values(found), values(again), rtol=1e-6)


def test_a_policy_has_one_score_in_every_form(own: Path) -> None:
    """As a file and by a class to the bit; a controller's float64 and ONNX round otherwise.

    Where a measurement is between two multiples of its resolution, rounding decides: 2 % of a time at limits.
    """
    pytest.importorskip("onnxruntime")
    assert export([str(FLIGHT), "flight.onnx"]) == 0
    texts = (str(FLIGHT), "own:flies", "own:controller", "flight.onnx")
    file, by_class, controller, onnx = (flown(text, "crazyflie") for text in texts)
    np.testing.assert_array_equal(values(by_class), values(file))
    for other in (controller, onnx):
        np.testing.assert_allclose(values(other), values(file), rtol=0.02, atol=1e-6)
        assert [one.failures for one in other] == [one.failures for one in file]


def test_an_onnx_file_of_the_pairs_policy_comes_to_what_the_policy_does(own: Path) -> None:
    pytest.importorskip("onnxruntime")
    assert export([str(BALANCE), "balance.onnx"]) == 0
    file, onnx = flown(str(BALANCE)), flown("balance.onnx")
    np.testing.assert_allclose(values(onnx), values(file), rtol=1e-3)


def test_a_hash_is_of_the_file_and_no_module_is_run_for_it(own: Path) -> None:
    (own / "loud.py").write_text("raise SystemExit('imported')")
    before = identity("loud:Any")
    (own / "loud.py").write_text("changed = True")
    assert identity("loud:Any")[0] == before[0] == "Any"
    assert identity("loud:Any")[1] != before[1]
    assert identity(str(FLIGHT)) != identity(str(BALANCE))
