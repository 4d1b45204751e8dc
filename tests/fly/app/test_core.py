"""Followers on board: the apps' C against the laptop's controllers, and what it refuses or ends."""

from __future__ import annotations

import dataclasses
import re
from typing import Any

import numpy as np
import pytest
from onboard_bench import AT_REST, Bench, cores_of, needs_gcc, policy_of

from mjxball.control import rotations
from mjxball.policy import Policy
from mjxball.sim.controllers import Controllers
from mjxfly.app import generate, protocol
from mjxfly.app.host import App
from mjxfly.app.protocol import CAUSES, AppPhase
from mjxfly.controller import FlightController
from mjxfly.flight import landing_goal
from mjxfly.telemetry import ObjectState, Rig


@needs_gcc
@pytest.mark.parametrize("name", ["flight", "stand", "recurrent flight", "universal"])
def test_the_apps_command_what_the_laptop_would(name: str):
    """Leader and follower over 5 s of motion, then a landing: float32 on board, float64 controllers on the laptop."""
    policy = policy_of(name)
    bench = Bench(cores_of(name), Rig.from_metadata(policy.metadata))
    controller = FlightController(Policy(policy, name))
    free = controller.config.plant.stand == "free"
    goal = np.array([0.0, 0.0, 0.4 if free else 0.08])
    random, euler = np.random.default_rng(0), np.zeros(3)
    position, velocity, rates = np.zeros(3), np.zeros(3), np.zeros(3)
    bench.take_off()  # the last period was one of the controllers', at rest
    controller.step(AT_REST, goal)
    worst, spread = np.zeros(6), np.zeros(6)
    begin, periods = 0.0, {AppPhase.FLY: 0, AppPhase.LAND: 0}
    for number in range(600):
        velocity = 0.95 * velocity + random.normal(scale=0.01, size=3)
        position, rates = 0.99 * position + 0.01 * velocity, 0.9 * rates + random.normal(scale=0.02, size=3)
        euler = 0.97 * euler + 0.01 * rates
        moving = [position + 0.75 * goal, *(np.array(one) for one in (velocity, euler, rates))]
        if not free:
            moving[0][:2] = moving[1][:2] = moving[2][1:] = moving[3][1:] = 0.0
        pair = ObjectState(moving[0], moving[1], rotations.quaternion_from_euler(moving[2]), moving[3])
        phase = AppPhase.FLY if number < 500 else AppPhase.LAND
        if number == 500:
            begin = float(moving[0][2])
        height, sinks = (
            (goal[2], 0.0) if number < 500 else landing_goal((number - 500) * controller.period, 0.25, begin, goal[2])
        )
        bench.tick(phase, pair)
        wanted = controller.step(pair, np.array([0.0, 0.0, height]), np.array([0.0, 0.0, sinks]))
        both = np.concatenate([wanted.leader, wanted.follower])
        found = np.concatenate([app.command for app in bench.apps])
        if bench.phases != [phase] * 2:
            break
        periods[phase] += 1
        worst, spread = np.maximum(worst, abs(found - both)), np.maximum(spread, abs(both))
    assert periods[AppPhase.FLY] > 50
    assert periods[AppPhase.LAND] >= (100 if free else 30)  # one on the stand is down then
    # Float rounding, fed back through the follower's memory; m/s2 beside rad.
    assert worst.max() < 1e-4
    assert spread[5] > 0.05
    assert spread[2] > 0.05


def test_the_laptop_turns_into_mount_frames_as_teams_do():
    """A pair along y, whose follower's frame is turned by a right angle, beside the same rig as a team."""
    policy = policy_of("universal")
    controller, random = FlightController(Policy(policy, "universal")), np.random.default_rng(1)
    config = controller.config
    controllers = Controllers(dataclasses.replace(config, plant=dataclasses.replace(config.plant, cg_axis="xy")))
    alone, goal = Policy(policy, "universal"), np.array([0.0, 0.0, 0.4])
    for _ in range(5):
        place, velocity, rates, euler = random.normal(scale=0.02, size=(4, 3))
        pair = ObjectState(place, velocity, rotations.quaternion_from_euler(euler), rates)
        wanted = controllers.in_body_axes(np.asarray(alone(controllers.observe(pair, goal)), float))
        np.testing.assert_allclose(controller.step(pair, goal).follower, wanted, rtol=0, atol=1e-6)


@needs_gcc
@pytest.mark.parametrize("name", ["recurrent flight", "universal"])
def test_a_flight_begins_with_an_empty_state(name: str):
    """A second one without a reboot, after motion that the first one remembers, is the first one again."""
    bench = Bench(cores_of(name), Rig.from_metadata(policy_of(name).metadata))
    flights: list[list[Any]] = []
    for _ in range(2):
        bench.take_off()
        flights.append([(one.roll, one.pitch, one.thrust) for _ in range(30) for one in bench.tick(AppPhase.FLY)])
        for _ in range(40):
            bench.tick(AppPhase.FLY, AT_REST._replace(velocity=np.array([0.3, -0.2, 0.1])))
        while bench.phases != [AppPhase.IDLE] * 2:
            bench.tick(AppPhase.STOP if bench.apps[0].phase is not AppPhase.STOP else AppPhase.IDLE)
        for app in bench.apps:
            app.laptop(protocol.order(AppPhase.IDLE).data, bench.now)
    assert flights[1] == flights[0]
    assert len(set(flights[0])) > 30


REFUSED: tuple[tuple[str, Any], ...] = (
    ("the mount is not set, or no length below 1 m", lambda bench: bench.apps[0].set("mountY", 0.0)),
    ("the goal is beyond the fence or not finite", lambda bench: bench.apps[0].set("goalZ", 9.0)),
    ("the goal is beyond the fence or not finite", lambda bench: bench.apps[0].set("goalX", float("nan"))),
    ("the policy does not fly with this force curve", lambda bench: bench.apps[0].set("curve", 2)),
    ("the limit of the battery is not between 0 and 10 V", lambda bench: bench.apps[0].set("battery", float("nan"))),
)


@needs_gcc
def test_an_app_refuses_to_start():
    rig = Rig.from_metadata(policy_of("flight").metadata)
    for text, spoil in REFUSED:
        bench = Bench(cores_of(), rig)
        bench.tick(AppPhase.IDLE)
        spoil(bench)
        for _ in range(5):
            sent = bench.tick(AppPhase.SPIN)
        assert bench.apps[0].phase is AppPhase.IDLE, text
        assert CAUSES[int(bench.apps[0].logged()["refusal"])] == text
        assert not sent[0].active
    bench = Bench(cores_of(), rig)
    for wrong, text in (
        ({"can_fly": False}, "the firmware cannot fly"),
        ({"voltage": 3.1}, "the battery is low"),
        ({"position": [float("nan")] * 3}, "the state is old or not finite"),
        ({"variance": [1.0] * 3}, "the estimator's position cannot be trusted"),
        ({"variance": [0.0] * 3}, "the estimator's position cannot be trusted"),  # it does not run
    ):
        for _ in range(3):
            bench.tick(AppPhase.SPIN, **wrong)
        assert CAUSES[int(bench.apps[0].logged()["refusal"])] == text
    alone = App(cores_of()[1], 1)
    alone.set("mountY", -0.15)
    alone.laptop(protocol.order(AppPhase.SPIN).data, 1000)
    alone.tick(bench.state(AT_REST, np.zeros(3)), bench.now)
    assert alone.phase is AppPhase.IDLE


@needs_gcc
def test_one_abort_lands_both():
    """Whatever the leader finds moves the follower within two periods, and the other way round for silence."""
    rig = Rig.from_metadata(policy_of("flight").metadata)
    for wrong, phase, text in (
        ({"position": [5.0, 0.15, 0.0]}, AppPhase.DESCEND, "beyond the fence"),
        ({"position": [float("inf"), 0.0, 0.0]}, AppPhase.DESCEND, "the state is old or not finite"),
        ({"variance": [1.0, 0.0, 0.0]}, AppPhase.DESCEND, "the estimator's position cannot be trusted"),
        ({"quaternion": [0.9, 0.4359, 0.0, 0.0]}, AppPhase.STOP, "tilted beyond the limit"),
        ({"can_fly": False}, AppPhase.STOP, "the firmware cannot fly"),
    ):
        bench = Bench(cores_of(), rig)
        bench.take_off()
        assert bench.phases == [AppPhase.FLY] * 2
        bench.tick(AppPhase.FLY, **wrong)
        sent = bench.tick(AppPhase.FLY, **wrong)
        assert bench.phases == [phase] * 2, text
        assert (bench.cause(0), bench.cause(1)) == (text, "the other drone does")
        assert all(np.isfinite([one.roll, one.pitch, one.thrust]).all() for one in sent)
        assert all((one.thrust == 0) == (phase is AppPhase.STOP) for one in sent)
    bench = Bench(cores_of(), rig)
    bench.take_off()
    high = AT_REST._replace(position=np.array([0.0, 0.0, 0.3]))
    for _ in range(40):
        bench.tick(AppPhase.LAND, high)
    bench.tick(AppPhase.LAND, high, variance=[1.0] * 3)  # nothing is known of the ground
    assert bench.phases[0] is AppPhase.DESCEND
    bench = Bench(cores_of(), rig)
    bench.take_off()
    for _ in range(52):
        bench.tick(None)
    assert bench.phases == [AppPhase.LAND] * 2
    assert "the laptop is not heard" in (bench.cause(0), bench.cause(1))


@needs_gcc
def test_nobody_lands_who_has_not_flown():
    """An order to land stops motors that spin; on a ramp it ends in the descent, which needs no controller."""
    for periods, phase in ((3, AppPhase.STOP), (50, AppPhase.DESCEND)):
        bench = Bench(cores_of(), Rig.from_metadata(policy_of("flight").metadata))
        for number in range(periods):
            bench.tick(AppPhase.IDLE if number == 0 else AppPhase.SPIN if number < 3 else AppPhase.RAMP)
        bench.tick(AppPhase.LAND)
        assert bench.phases == [phase] * 2


@needs_gcc
def test_another_pair_on_the_channel_is_not_obeyed():
    """In flight a leader of another policy is not heard; on the ground it is a reason not to start."""
    rig = Rig.from_metadata(policy_of("flight").metadata)

    def heard(bench: Bench, phase: AppPhase, order: AppPhase, ours: bool) -> App:
        """The follower after a beat of the leader's in this phase."""
        beat, follower = bytearray(bench.apps[0].send()), bench.apps[1]
        beat[2] = phase
        beat[4] ^= 0 if ours else 1  # of the key
        follower.hear(bytes(beat), bench.now)
        follower.laptop(protocol.order(order).data, bench.now)
        follower.tick(bench.state(AT_REST, rig.mounts[1]), bench.now)
        return follower

    for ours, phase in ((False, AppPhase.FLY), (True, AppPhase.DESCEND)):
        bench = Bench(cores_of(), rig)
        bench.take_off()
        assert heard(bench, AppPhase.DESCEND, AppPhase.FLY, ours).phase is phase
    for ours, refusal in ((False, "the other drone flies another policy"), (True, "good")):
        bench = Bench(cores_of(), rig)
        bench.tick(AppPhase.IDLE)
        follower = heard(bench, AppPhase.IDLE, AppPhase.SPIN, ours)
        assert CAUSES[int(follower.logged()["refusal"])] == refusal
        assert follower.phase is (AppPhase.SPIN if ours else AppPhase.IDLE)


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
