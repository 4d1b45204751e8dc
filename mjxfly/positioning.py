"""Which positioning deck a drone flies on, and whether it is ready, by the firmware's parameters and log variables.

Names and meanings follow bitcraze/crazyflie-firmware 2026.08: lighthouse_core.c, lighthouse_position_est.c, locodeck.c,
lpsTdoa2Tag.c, lpsTdoa3Tag.c, tdoaEngineInstance.c, flowdeck_v1v2.c. In TDoA 3 ranging.state stays 0, and
tdoaEngine.stEst is the rate of measurements.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

from mjxfly import clock
from mjxfly.connection import LinkError, Parameters
from mjxfly.limits import Check, Limits


class DeckLink(Protocol):
    """The part of `link.Link` that is used here."""

    name: str
    parameters: Parameters

    def read_logs(self, names: Sequence[str]) -> dict[str, float]:
        """Values of the log variables `names`, without those that the firmware does not list."""
        ...


Verdict = tuple[bool, str]  # whether the system is ready, and the finding in words
VELOCITY = tuple(f"kalman.varP{axis}" for axis in "XYZ")  # variances [m2/s2]
SLOW = 0.3  # [m/s] standard deviation of the velocity of a filter that has converged
ANCHORS, RATE = 4, 50.0  # of Loco: least number of anchors heard, least rate of TDoA measurements [Hz]
TWR, TDOA2, TDOA3 = 1, 2, 3  # of loco.mode


def stations(bits: float) -> str:
    """The set bits of a bit field of base stations, counted from 1 as Lighthouse channels are: "1, 2"."""
    return ", ".join(str(number + 1) for number in range(16) if int(bits) >> number & 1)


def lighthouse_verdict(logs: Mapping[str, float]) -> Verdict:
    """Ready if a base station is received with geometry and calibration, and is used."""
    seen, used, shape, calibration, confirmed = (
        int(logs.get(f"lighthouse.bs{name}", 0)) for name in ("Receive", "Active", "GeoVal", "CalVal", "CalCon")
    )
    if not seen:
        return False, "no base station is received: are they on, and in sight?"
    text = f"base stations {stations(seen)} received"
    for what, known, remedy in (
        ("geometry", shape, "estimate it with cfclient and write it to this drone"),
        ("calibration", calibration, "wait with the drone at rest in their sight until it has come"),
    ):
        if not seen & known:
            return False, f"{text}, none with {what}: {remedy}"
    if not used:
        return False, f"{text}, none used: is lighthouse.systemType, V1 or V2, that of the base stations?"
    text += f", {stations(used)} used"
    missing = [(name, seen & ~known) for name, known in (("geometry", shape), ("calibration", calibration))]
    text += "".join(f"; no {name} of {stations(bits)}" for name, bits in missing if bits)
    waiting = used & ~confirmed
    return True, text + (f"; calibration of {stations(waiting)} is from memory, not confirmed yet" if waiting else "")


def loco_verdict(logs: Mapping[str, float]) -> Verdict:
    """Ready in TDoA mode with enough anchors or measurements."""
    mode, heard, rate = int(logs.get("loco.mode", 0)), int(logs.get("ranging.state", 0)), logs.get("tdoaEngine.stEst")
    if mode == TWR:
        return False, "TWR ranges with one drone alone: set the anchors to TDoA 3"
    if mode == TDOA2:
        good, text = heard.bit_count() >= ANCHORS, f"TDoA 2, {heard.bit_count()} anchors heard, {ANCHORS} needed"
    elif mode == TDOA3:
        known = rate is not None and math.isfinite(rate)
        good = not known or (rate or 0.0) >= RATE
        text = f"TDoA 3, {rate:.0f} measurements a second, {RATE:.0f} needed" if known else "TDoA 3"
    else:
        return False, "no anchors heard: are they on, and in one mode?"
    return good, text if good else f"{text}: are the anchors on, and have they their positions?"


def flow_verdict(logs: Mapping[str, float]) -> Verdict:
    """Never ready: positions of a Flow deck are relative, and the two drones need a common frame."""
    return False, (
        "a Flow deck alone counts from where its filter was reset, and two drones on one stick need one frame: "
        "fly with Lighthouse, Loco or --mocap"
    )


@dataclass(frozen=True)
class System:
    """A positioning system with a deck that the firmware detects."""

    name: str
    decks: tuple[str, ...] = ()  # parameters that are not 0 if the deck is present
    switch: tuple[str, float] = ("", 0.0)  # parameter, and its value that keeps measurements from the estimator
    logs: tuple[str, ...] = ()  # log variables for `verdict`
    verdict: Callable[[Mapping[str, float]], Verdict] = lambda logs: (True, "not reported by the firmware")
    noise: float = 0.0  # of the positions beyond that of motion capture, standard deviation [m]
    variance: float = Limits.variance  # of a position estimate that is trusted in flight [m2]

    def widen(self, limits: Limits) -> Limits:
        """`limits` with noise and variance raised to those of this system."""
        return replace(limits, noise=max(limits.noise, self.noise), variance=max(limits.variance, self.variance))


LIGHTHOUSE = System(
    "Lighthouse",
    ("deck.bcLighthouse4",),
    ("lighthouse.fwdToEstimator", 0.0),
    tuple(f"lighthouse.bs{name}" for name in ("Receive", "Active", "GeoVal", "CalVal", "CalCon")),
    lighthouse_verdict,
)
LOCO = System(
    "Loco",
    ("deck.bcLoco", "deck.bcDWM1000"),
    ("loco.fwdToEstimator", 0.0),
    ("loco.mode", "ranging.state", "tdoaEngine.stEst"),
    loco_verdict,
    noise=0.02,
    variance=2e-3,
)
FLOW = System("Flow", ("deck.bcFlow2", "deck.bcFlow"), ("motion.disable", 1.0), (), flow_verdict)
SYSTEMS = (LIGHTHOUSE, LOCO, FLOW)  # the first one present is the drone's system, the others supplement it
UNKNOWN = System("unknown")  # no known deck: motion capture, or firmware without these parameters


def system_of(values: Mapping[str, float]) -> System:
    """The system by the values of deck parameters; `UNKNOWN` if no known deck is present."""
    return next((one for one in SYSTEMS if any(values.get(name) for name in one.decks)), UNKNOWN)


def found(link: DeckLink) -> System:
    """The system of a drone, by its deck parameters. Raises LinkError."""
    return system_of(link.parameters.read(link.parameters.listed(name for one in SYSTEMS for name in one.decks)))


def common(links: Sequence[DeckLink]) -> System:
    """The system of both drones. Raises LinkError if they differ, since their frames would differ too."""
    one, other = (found(link) for link in links)
    if one is not other:
        both = " and ".join(f"{system.name} ({link.name})" for system, link in zip((one, other), links, strict=True))
        raise LinkError(f"both drones need one positioning system, not {both}: fit one kind to both")
    return one


def check(link: DeckLink) -> Check | None:
    """Whether the system of a drone is ready; None if no known deck is present. Raises LinkError."""
    system = found(link)
    if system is UNKNOWN:
        return None
    name, off = system.switch
    name_of = f"{link.name} {system.name}"
    if name in (read := link.parameters.read(link.parameters.listed([name]))) and read[name] == off:
        return Check(name_of, False, f"its measurements do not reach the estimator: {name} is {off:g}")
    logs = link.read_logs([*system.logs, *VELOCITY])
    good, text = system.verdict(logs)
    spread = math.sqrt(max([*(logs.get(name, 0.0) for name in VELOCITY), 0.0]))
    if good and spread > SLOW:
        return Check(name_of, False, f"{text}; velocity uncertain by {spread:.1f} m/s, {SLOW:g} allowed")
    return Check(name_of, good, text)


def wait(link: DeckLink, seconds: float) -> None:
    """Wait until the system is ready. Raises LinkError with what is missing after `seconds`."""
    began = clock.now()
    while (state := check(link)) is not None and not state.passed:
        if found(link) is FLOW or clock.now() - began > seconds:
            raise LinkError(f"positioning of the {state.name}: {state.found}")
        clock.sleep(0.2)
