"""What a flight asks a drone for and what it writes: the twin has it, and acts on what it says that it acts on."""

from __future__ import annotations

import pickle
from types import SimpleNamespace
from typing import Any

import pytest
from onboard_bench import cores_of, needs_gcc
from twin_peer import written

import virtual_twin as virtual
from fly_faults_virtual import SETTLE, settings_of
from mjxball import config as configs
from mjxball.errors import InputError
from mjxball.policy import Policy
from mjxball.policy.file import shipped_policy
from mjxfly import session
from mjxfly.app.protocol import CAUSES, CONTROLLER, GROUP, LOGGED
from mjxfly.app_flight import check_ready
from mjxfly.connection import LinkError
from mjxfly.link import Link
from mjxfly.main import main as fly
from mjxfly.mocap import Mocap, MocapSettings
from mjxfly.twin.conditions import (
    DELIVERED,
    DRONES,
    FAULT_KINDS,
    POSITIONING,
    BodyFault,
    Conditions,
    LinkFaults,
    Surroundings,
)
from mjxfly.twin.coupled import CoupledPair
from mjxfly.twin.drone import ACTED, TwinDrone, only_kept
from mjxfly.twin.firmware import Motors
from mjxfly.twin.logs import GROUPS, LOG_VARIABLES
from mjxfly.twin.parameters import OF_APP, PARAMETERS
from virtual_twin import VirtualTwin


def drone_with(kind: Any = DELIVERED, **around: Any) -> TwinDrone:
    config = configs.preset("flight")
    return TwinDrone(CoupledPair(config, Conditions(config.plant.object_mass), kind, Surroundings(**around)), 0)


def test_the_twin_acts_on_what_it_says_and_keeps_all_else() -> None:
    """Each parameter is written to three values; what differs then in supervisor, filters, loops?"""
    acted = set()
    for positioning_system in POSITIONING:
        drone = drone_with(DRONES["brushless"], positioning=positioning_system)
        supervisor, onboard = drone.firmware.supervisor, drone._pair.onboard  # type: ignore[attr-defined]
        for one in PARAMETERS:
            if one.read_only:
                continue
            before = pickle.dumps((supervisor, onboard, drone.controller))
            for value in (2, 0, 1):
                written(drone.peer, one.name, value, 1.0)
                if pickle.dumps((supervisor, onboard, drone.controller)) != before:
                    acted.add(one.name)
    assert acted == ACTED - {one.name for one in OF_APP}
    assert only_kept(["kalman.mNBaro", "pid_rate.roll_kp", "no.such"]) == ["kalman.mNBaro"]


def test_what_is_no_fault_is_refused() -> None:
    drone = drone_with()
    for what in ("frozen", FAULT_KINDS["frozen"], BodyFault("frozn", 1.0), None):  # a kind's name, a kind
        with pytest.raises(InputError, match=r"is no fault; expected FAULT_KINDS"):
            drone.inject(what)  # type: ignore[arg-type]
    for kind in FAULT_KINDS.values():
        drone.inject(kind.what)
    assert drone.faults == FAULT_KINDS["killed"].what
    drone.inject(LinkFaults(loss=0.1, delay=0.01))  # as `--loss` and `--delay` ask for


def test_a_controller_that_the_twin_lacks_keeps_its_motors_still() -> None:
    """The firmware of no app knows five; of those only the PID is here."""
    for number, motors in ((1, Motors.RUN), (2, Motors.OFF), (5, Motors.OFF), (6, Motors.RUN), (7, Motors.RUN)):
        drone = drone_with()
        assert written(drone.peer, CONTROLLER, number, 1.0) == (number if number < 6 else 1)
        assert drone.step(drone._pair.start(), 0.01).motors is motors, number


class Recorder(Link):
    """A link that keeps the names that a flight asks for, there or not."""

    asked: set[str]

    def _find(self, table: Any, name: str) -> Any:
        self.asked.add(name)
        return super()._find(table, name)

    def _log_block(self, title: str, variables: Any, period_ms: int) -> Any:
        listed = list(variables)
        self.asked |= {name for name, _ in listed}
        return super()._log_block(title, listed, period_ms)


@needs_gcc
@pytest.mark.clock
def test_the_twin_has_all_that_a_flight_asks_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """The names are those that flights ask for, on board, with each positioning system, and with cameras."""
    asked = Recorder.asked = set[str]()
    monkeypatch.setattr(session, "Link", Recorder)
    flags = [["--onboard"], ["--twin-positioning", "lighthouse"], ["--twin-positioning", "loco"]]
    for more in flags:
        assert fly([str(shipped_policy("flight")), "--rehearse", "--dry-run", "--seconds", "0.2", *more]) < 2, more
    asked |= Mocap.parameters(SimpleNamespace(settings=MocapSettings("mock"))).keys()  # type: ignore[arg-type]
    listed = {one.name for one in (*PARAMETERS, *OF_APP)} | {name for name, _ in LOG_VARIABLES}
    listed |= {f"{GROUP}.{name}" for name, _ in LOGGED}
    assert asked <= listed
    assert {CONTROLLER, "stabilizer.estimator", "kalman.resetEstimation", "deck.bcDWM1000", "pm.vbatMV"} <= asked
    assert {"mjxb.goalX", "lighthouse.bsReceive", "tdoaEngine.stEst", "motor.m1", "acc.x"} <= asked
    assert len(asked) > 80
    drones = [drone_with(positioning=system) for system in POSITIONING]
    for name in asked.intersection(name for name, _ in LOG_VARIABLES):  # and none that it lists is only a 0
        group, _, own = name.partition(".")
        known = [drone._snapshot(drone._pair.start()) for drone in drones]
        assert any(name in one.deck or own in GROUPS.get(group, lambda _: {})(one) for one in known), name


def test_a_name_that_the_twin_lacks_ends_a_rehearsal() -> None:
    """A real firmware may list what another one does not; of the twin that would be a rehearsal of something else."""
    toc = SimpleNamespace(toc=SimpleNamespace(get_element_by_complete_name=lambda name: None))
    for twin in (True, False):
        link = Link("udp://127.0.0.1:1", "leader", lambda kind, **fields: None, twin=twin)
        link._crazyflie = SimpleNamespace(param=toc, log=toc)
        asking: Any
        for asking in ((link.parameters.listed, ["new.name"]), (link._listed, [("new.name", None)])):
            ask, names = asking
            if twin:
                with pytest.raises(LinkError, match=r"the twin has no new\.name"):
                    ask(names)
            else:
                assert ask(names) == []


@needs_gcc
def test_laws_on_board_need_the_apps_own_controller(monkeypatch: pytest.MonkeyPatch) -> None:
    """The PID was written for them as well: on the real firmware 0 of 5 flights began, on the twin all did."""
    policy = Policy.load(shipped_policy("flight"))
    for number, found in ((6, "ready"), (1, CAUSES[9])):
        monkeypatch.setattr(virtual, "parameters_of", lambda gains, _: {**gains, CONTROLLER: number})  # noqa: B023
        twin = VirtualTwin(policy, settings_of(policy, 1.0), settle=SETTLE, cores=cores_of())
        twin.advance(0.5)
        checks = [check_ready(link) for link in twin.links]  # type: ignore[arg-type]
        assert [(one.passed, one.found) for one in checks] == [(number == 6, found)] * 2  # all that a dry run shows
    assert twin.run() == "done"
    assert str(twin.flight.supervisor.cause).startswith(f"app refuses: leader: {CAUSES[9]}")


@needs_gcc
def test_the_controller_that_another_flight_left_is_replaced() -> None:
    """Laws on the laptop need the PID; controllers on board, later and without a reboot, the app's controller again."""
    policy = Policy.load(shipped_policy("flight"))
    for cores, wanted in ((None, 1), (cores_of(), 6)):
        twin = VirtualTwin(policy, settings_of(policy, 1.0), settle=SETTLE, cores=cores)
        for link in twin.links:
            link.write_parameters({CONTROLLER: 2})
        twin.next_flight(pause=0.1, settle=0.2)
        assert [drone.controller for drone in twin.drones] == [wanted, wanted]
