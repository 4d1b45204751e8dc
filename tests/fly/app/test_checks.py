"""Followers on board: numbers that cannot be, in whatever can change in flight, and what leaves for the commander."""

from __future__ import annotations

import functools
import math
import struct
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from onboard_bench import AT_REST, Bench, compilers, cores_by, cores_of, needs_gcc, policy_of
from tables import rows

from mjxball.policy.file import interface_of
from mjxfly.app.host import App
from mjxfly.app.protocol import CAUSES, AppPhase
from mjxfly.policy_setup import config_of, variants
from mjxfly.telemetry import Rig

WILD = (math.nan, math.inf, -3e38)
AFTER = {"mount": "the mount is not set, or no length below 1 m", "goal": "the goal is beyond the fence or not finite"}
IN_FLIGHT = "refused: weights, mount and curve change on the ground only"
OLD = "the state is old or not finite"
HIGH = AT_REST._replace(position=np.array([0.0, 0.0, 0.4]))  # where the goal is
LIMIT, LEAST, MOST = 15.001, 10001, 60000  # [deg], [thrust units] of what is sent in the air


@functools.cache
def taken_off(name: str = "flight") -> Bench:
    """A pair in the first period of its controllers."""
    bench = Bench(cores_of(name), Rig.from_metadata(policy_of(name).metadata))
    bench.take_off()
    assert bench.phases == [AppPhase.FLY] * 2
    return bench


def flying(name: str = "flight") -> Bench:
    """Another one in the same state."""
    bench, before = Bench(cores_of(name), taken_off(name).rig), taken_off(name)
    bench.now = before.now
    for app, old in zip(bench.apps, before.apps, strict=True):
        app._core.raw = old._core.raw
    return bench


def numbers(sent: list[Any]) -> list[tuple[float, float, float]]:
    return [(one.roll, one.pitch, one.thrust) for one in sent]


def assert_within_limits(sent: list[Any]) -> None:
    for roll, pitch, thrust in numbers(sent):
        assert abs(roll) <= LIMIT
        assert abs(pitch) <= LIMIT
        assert LEAST <= thrust <= MOST


def refusal(app: App) -> str:
    return CAUSES[int(app.logged()["refusal"])]


@needs_gcc
@rows("phase", [AppPhase.FLY, AppPhase.DESCEND])
def test_parameters_that_cannot_be_leave_the_last_ones_in_use(phase: AppPhase):
    """Every period of a pair with one wild parameter is that of a pair without, in both roles."""
    spoilt: list[tuple[str, float, str]] = [
        (f"{what}{axis}", value, text) for what, text in AFTER.items() for axis in "XYZ" for value in WILD
    ]
    spoilt += [("battery", value, "the limit of the battery is not between 0 and 10 V") for value in (*WILD, 0.0, -1.0)]
    spoilt += [("curve", value, "the policy does not fly with this force curve") for value in (2, 255)]
    spoilt += [("mountX", 0.1, IN_FLIGHT), ("mountY", -0.1, IN_FLIGHT)]  # sound, but another one
    for role in range(2):
        calm = flying()
        wanted = [numbers(calm.tick(phase)) for _ in range(12)]
        for name, value, text in spoilt:
            bench = flying()
            bench.apps[role].set(name, value)
            found = [numbers(bench.tick(phase)) for _ in range(12)]
            assert found == wanted, (role, name, value)
            assert refusal(bench.apps[role]) == text
            assert bench.phases == calm.phases


@needs_gcc
def test_the_curve_that_spinning_motors_show_is_flown():
    """It comes in SPIN; every later period is that of a pair that had it before, up to the trim of a descent."""
    known, found = (Bench(cores_of(), taken_off().rig) for _ in range(2))
    for bench, before in ((known, True), (found, False)):
        for phase, periods in ((AppPhase.IDLE, 3), (AppPhase.SPIN, 5)):
            for _ in range(periods):
                bench.tick(phase)
            for app in bench.apps if before is (phase is AppPhase.IDLE) else ():
                app.set("curve", 1)
        assert bench.phases == [AppPhase.SPIN] * 2
    sent = [[numbers(bench.tick(AppPhase.RAMP)) for _ in range(150)] for bench in (known, found)]
    hovers = [own["older"].map.hover_thrust for own in variants(config_of(policy_of("flight").metadata))]
    ramped = [10_001 + 0.8 * (hover - 10_001) for hover in hovers]  # 1.2 of 1.5 s
    np.testing.assert_allclose([thrust for _, _, thrust in sent[1][120]], ramped, rtol=0.01)
    assert sent[1] == sent[0]
    assert [numbers(found.tick(AppPhase.DESCEND)) for _ in range(5)] == [
        numbers(known.tick(AppPhase.DESCEND)) for _ in range(5)
    ]
    assert [refusal(app) for app in found.apps] == [CAUSES[0]] * 2
    late = flying()
    late.apps[0].set("curve", 1)
    late.tick(AppPhase.FLY)
    assert refusal(late.apps[0]) == IN_FLIGHT


@needs_gcc
def test_a_goal_can_change_in_flight():
    bench, calm = flying(), flying()
    for app in bench.apps:
        app.set("goalZ", 0.2)
    assert numbers(bench.tick(AppPhase.FLY)) != numbers(calm.tick(AppPhase.FLY))
    assert bench.phases == [AppPhase.FLY] * 2


@needs_gcc
def test_states_that_cannot_be_end_in_a_descent():
    """Also finite ones; nothing of them is left for the descent itself."""
    for name, size in (("position", 3), ("velocity", 3), ("rates", 3), ("quaternion", 4)):
        for value in (*WILD, 1e4):
            for slot in range(size):
                bench = flying()
                wrong = [0.01] * size if name != "quaternion" else [1.0, 0.0, 0.0, 0.0]
                wrong[slot] = value
                sent = [bench.tick(AppPhase.FLY, **{name: wrong}) for _ in range(12)]
                for one in sent:
                    assert_within_limits(one)
                assert bench.phases == [AppPhase.DESCEND] * 2, (name, value)
                assert bench.cause(0) == OLD
    for value in WILD:  # of a battery's voltage: as good as none
        bench = flying()
        for _ in range(520):
            bench.tick(AppPhase.FLY, HIGH, voltage=value)
        assert bench.cause(0) == "the battery is low", value


@needs_gcc
def test_a_state_from_the_future_is_none():
    bench = flying()
    state = bench.state(AT_REST, bench.rig.mounts[0])
    state.time = bench.now + 1
    bench.apps[0].tick(state, bench.now)
    assert bench.cause(0) == OLD


# Of a heartbeat: bytes 0 to 3 M, role, phase, trusted; key; velocity (3) and result of the take-off as floats.
BEATS: tuple[tuple[str, Callable[[bytearray], None]], ...] = (
    *((f"velocity {k}", lambda beat, k=k: struct.pack_into("<f", beat, 8 + 4 * k, -60.0)) for k in range(3)),
    *(
        (f"{value} at {at}", lambda beat, at=at, value=value: struct.pack_into("<f", beat, at, value))
        for at in range(8, 24, 4)
        for value in WILD
    ),
    ("phase", lambda beat: beat.__setitem__(2, 7)),
    ("trusted", lambda beat: beat.__setitem__(3, 2)),
    ("role", lambda beat: beat.__setitem__(1, 2)),
    ("letter", lambda beat: beat.__setitem__(0, 0)),
    ("size", lambda beat: beat.pop()),
)


@needs_gcc
def test_heartbeats_that_cannot_be_are_not_heard():
    """Their sender counts as silent: both land after 0.3 s. One is not enough for that."""
    for what, spoil in BEATS:
        bench = flying()
        for number in range(40):
            if number == 25:
                assert bench.phases == [AppPhase.FLY] * 2, what
            beats = [bytearray(app.send()) for app in bench.apps[::-1]]
            spoil(beats[1])
            bench.now += bench.apps[0].period
            for app, beat, mount in zip(bench.apps, beats, bench.rig.mounts, strict=True):
                app.hear(bytes(beat), bench.now)
                app.laptop(bytes([1, AppPhase.FLY]), bench.now)
                assert_within_limits([app.tick(bench.state(AT_REST, mount), bench.now)])
        assert bench.cause(1) == "the other drone is not heard", what
        assert bench.phases == [AppPhase.LAND] * 2


@needs_gcc
def test_what_an_app_computes_is_checked_before_it_leaves():
    """Its own numbers are spoilt, which no input can do: level at once, sinking, and the other one is told."""
    level = flying()
    for _ in range(2):
        calm = level.tick(AppPhase.FLY)
    for value in (math.nan, math.inf):
        for slot in range(3):
            bench = flying()
            leader = bench.apps[0]
            bench.tick(AppPhase.FLY)
            leader._c.integral(leader._core)[slot] = value
            sent = bench.tick(AppPhase.FLY)
            assert_within_limits(sent)
            assert leader.phase is AppPhase.DESCEND
            assert bench.cause(0) == "the command is not finite"
            assert (sent[0].roll, sent[0].pitch) == (0.0, 0.0)
            assert 0.7 * calm[0].thrust < sent[0].thrust < calm[0].thrust
            assert_within_limits(bench.tick(AppPhase.FLY))
            assert bench.phases == [AppPhase.DESCEND] * 2


@needs_gcc
@rows("name", ["recurrent flight", "universal"])
def test_a_state_of_the_network_that_is_not_finite_lands_the_pair(name: str):
    """The controller of `copy` flies on from the same period; what cannot be is forgotten."""
    size = interface_of(policy_of(name).metadata).size
    for value in (math.nan, math.inf, -math.inf):
        bench = flying(name)
        app = bench.apps[1]
        memory = app._c.memory(app._core)
        assert np.isfinite(memory[:size]).all()
        memory[3 + 7] = value  # behind the last action
        assert_within_limits(bench.tick(AppPhase.FLY))
        assert app.phase is AppPhase.LAND
        assert app.logged()["copying"] == 1
        assert bench.cause(1) == "the command is not finite"
        for _ in range(10):
            assert_within_limits(bench.tick(AppPhase.FLY, HIGH))
        assert bench.phases == [AppPhase.LAND] * 2


@needs_gcc
def test_the_leaders_integral_is_bounded():
    """Held off its goal for hours it still says what the follower believes."""
    bench = flying()
    leader = bench.apps[0]
    for slot in range(3):
        leader._c.integral(leader._core)[slot] = 1000.0
    for _ in range(5):
        bench.tick(AppPhase.FLY)
    assert max(leader.integral[:3]) <= 1000.0
    assert bench.phases == [AppPhase.FLY] * 2


@needs_gcc
def test_compilers_that_are_told_of_finite_numbers_only_remove_no_check(monkeypatch: pytest.MonkeyPatch):
    """All of this file that is about wild numbers, for -Ofast and the like."""
    checks = (
        test_parameters_that_cannot_be_leave_the_last_ones_in_use,
        test_states_that_cannot_be_end_in_a_descent,
        test_heartbeats_that_cannot_be_are_not_heard,
        test_what_an_app_computes_is_checked_before_it_leaves,
        test_a_state_of_the_network_that_is_not_finite_lands_the_pair,
    )
    for compiler in compilers():
        monkeypatch.setitem(globals(), "cores_of", functools.cache(functools.partial(cores_by, compiler)))
        taken_off.cache_clear()
        for check in checks:
            try:
                check()
            except BaseException as error:
                error.add_note(f"{check.__name__}, {' '.join(compiler)}")
                raise
    taken_off.cache_clear()
