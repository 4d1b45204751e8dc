"""What the firmware tells of its positioning decks, and what is made of it, on firmwares in memory."""

from __future__ import annotations

import struct
from collections.abc import Sequence

import pytest
from tables import rows

from mjxfly.connection import READ, Element, LinkError, Parameters
from mjxfly.limits import Limits
from mjxfly.packets import Packet
from mjxfly.positioning import LOCO, UNKNOWN, check, common, found, wait
from mjxfly.twin.positioning import DECKS


class Drone:
    """In the place of a `Link`: parameters by the real protocol, log variables from a table."""

    def __init__(self, name: str, parameters: dict[str, float], logs: dict[str, float] | None = None):
        self.name, self._values, self._logs = name, parameters, logs or {}
        self.parameters = Parameters(name, self._find, self._answer, wait=0.5)

    def _find(self, name: str) -> Element | None:
        return Element(list(self._values).index(name), "<B", True) if name in self._values else None

    def _answer(self, request: Packet) -> None:
        (ident,) = struct.unpack("<H", request.data[:2])
        value = bytes([int(list(self._values.values())[ident])])
        self.parameters.received(Packet(request.port, READ, request.data + b"\0" + value))

    def read_logs(self, names: Sequence[str]) -> dict[str, float]:
        return {name: self._logs[name] for name in names if name in self._logs}


NONE = {"deck.bcLighthouse4": 0.0, "deck.bcLoco": 0.0, "deck.bcFlow2": 0.0}
LIGHTHOUSE, LOCO_DECK, FLOW = ({**NONE, name: 1.0} for name in NONE)
SEEN = {f"lighthouse.bs{name}": 3.0 for name in ("Receive", "Active", "GeoVal", "CalVal", "CalCon")}
CALM = {f"kalman.varP{axis}": 1e-4 for axis in "XYZ"}


@rows(
    "parameters, name",
    [
        ({}, "unknown"),
        (NONE, "unknown"),
        (LIGHTHOUSE, "Lighthouse"),
        (LOCO_DECK, "Loco"),
        ({"deck.bcDWM1000": 1.0}, "Loco"),  # before 2023.08
        (FLOW, "Flow"),
        ({**LIGHTHOUSE, "deck.bcFlow2": 1.0}, "Lighthouse"),  # an absolute system counts
    ],
)
def test_the_deck_is_found_by_its_parameter(parameters: dict[str, float], name: str) -> None:
    assert found(Drone("leader", parameters)).name == name


@rows(
    "changes, good, text",
    [
        ({}, True, "1, 2 used"),
        ({"lighthouse.bsReceive": 0.0}, False, "no base station is received"),
        ({"lighthouse.bsGeoVal": 0.0}, False, "none with geometry"),
        ({"lighthouse.bsCalVal": 0b100}, False, "none with calibration"),
        ({"lighthouse.bsActive": 0.0}, False, "lighthouse.systemType"),
        ({"lighthouse.bsGeoVal": 1.0, "lighthouse.bsActive": 1.0}, True, "no geometry of 2"),
        ({"lighthouse.bsCalCon": 1.0}, True, "calibration of 2 is from memory"),
        ({"kalman.varPX": 1.0}, False, "velocity uncertain by 1.0 m/s"),
    ],
)
def test_lighthouse(changes: dict[str, float], good: bool, text: str) -> None:
    told = check(Drone("leader", LIGHTHOUSE, {**SEEN, **CALM, **changes}))
    assert told is not None
    assert (told.name, told.passed) == ("leader Lighthouse", good)
    assert text in told.found


@rows(
    "logs, good, text",
    [
        ({"loco.mode": 3.0, "ranging.state": 0.0, "tdoaEngine.stEst": 340.0}, True, "340 measurements"),
        ({"loco.mode": 3.0, "ranging.state": 0.0, "tdoaEngine.stEst": 3.0}, False, "50 needed"),
        ({"loco.mode": 2.0, "ranging.state": 255.0}, True, "8 anchors heard"),
        ({"loco.mode": 2.0, "ranging.state": 7.0}, False, "3 anchors heard, 4 needed"),
        ({"loco.mode": 1.0, "ranging.state": 63.0}, False, "one drone alone"),
        ({"loco.mode": 0.0}, False, "no anchors heard"),
    ],
)
def test_loco(logs: dict[str, float], good: bool, text: str) -> None:
    told = check(Drone("follower", LOCO_DECK, {**CALM, **logs}))
    assert told is not None
    assert told.passed is good
    assert text in told.found


def test_a_deck_that_is_switched_off_says_so() -> None:
    told = check(Drone("leader", {**LIGHTHOUSE, "lighthouse.fwdToEstimator": 0.0}, {**SEEN, **CALM}))
    assert told is not None
    assert not told.passed
    assert "lighthouse.fwdToEstimator is 0" in told.found


def test_what_is_missing_is_waited_for_and_then_told() -> None:
    with pytest.raises(LinkError, match="positioning of the leader Lighthouse: no base station is received"):
        wait(Drone("leader", LIGHTHOUSE, CALM), 0.0)
    wait(Drone("leader", LIGHTHOUSE, {**SEEN, **CALM}), 0.0)
    wait(Drone("leader", NONE), 0.0)  # nothing is told: nothing is asked
    with pytest.raises(LinkError, match="one frame"):
        wait(Drone("leader", FLOW), 1e9)


def test_both_drones_need_one_system() -> None:
    assert common([Drone("leader", LOCO_DECK), Drone("follower", LOCO_DECK)]) is LOCO
    assert common([Drone("leader", {}), Drone("follower", NONE)]) is UNKNOWN
    with pytest.raises(LinkError, match=r"not Loco \(leader\) and Lighthouse \(follower\)"):
        common([Drone("leader", LOCO_DECK), Drone("follower", LIGHTHOUSE)])


def test_bounds_are_as_wide_as_the_system_needs_and_no_narrower_than_asked() -> None:
    assert UNKNOWN.widen(Limits()) == Limits()
    wide = LOCO.widen(Limits())
    assert wide.variance > Limits().variance
    assert wide.noise > 0
    assert UNKNOWN.widen(wide) == wide


def test_the_twins_decks_are_found_and_ready() -> None:
    """Names that the twin lists are those that are asked for."""
    for kind, deck in DECKS.items():
        drone = Drone("leader", {**NONE, **deck.parameters}, {**deck.logged, **CALM})
        assert found(drone).name.lower() == kind
        told = check(drone)
        assert told is not None
        assert told.passed is (kind != "flow")
