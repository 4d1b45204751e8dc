"""Which positioning deck a drone flies on, and whether it is ready, by the firmware's parameters and log variables.

Names and meanings are of bitcraze/crazyflie-firmware 2026.08: lighthouse_core.c, lighthouse_position_est.c, locodeck.c,
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
    """What is asked of a link."""

    name: str
    parameters: Parameters

    def read_logs(self, names: Sequence[str]) -> dict[str, float]:
        """Values of those of the log variables `names` that the firmware lists."""
        ...


Verdict = tuple[bool, str]  # whether it is ready, what was found
VELOCITY = tuple(f"kalman.varP{axis}" for axis in "XYZ")  # variances [m2/s2]
SLOW = 0.3  # [m/s] standard deviation of the velocity of a filter that has converged
ANCHORS, RATE = 4, 50.0  # of Loco: anchors that are heard, TDoA measurements a second; at least
TWR, TDOA2, TDOA3 = 1, 2, 3  # of loco.mode


def stations(bits: float) -> str:
    """Base stations or anchors of a bit field, as Lighthouse channels are counted: "1, 2"."""
    return ", ".join(str(number + 1) for number in range(16) if int(bits) >> number & 1)


def lighthouse_verdict(logs: Mapping[str, float]) -> Verdict:
    """By what is received, and what is known of it."""
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
    """By the mode, and by how much is heard."""
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
    """Never good for two drones that hold one object."""
    return False, (
        "a Flow deck alone counts from where its filter was reset, and two drones on one stick need one frame: "
        "fly with Lighthouse, Loco or --mocap"
    )


@dataclass(frozen=True)
class System:
    """A positioning system whose decks the firmware knows."""

    name: str
    decks: tuple[str, ...] = ()  # parameters that are not 0 where it is there
    switch: tuple[str, float] = ("", 0.0)  # parameter, and its value at which nothing reaches the estimator
    logs: tuple[str, ...] = ()
    verdict: Callable[[Mapping[str, float]], Verdict] = lambda logs: (True, "not told by the firmware")
    noise: float = 0.0  # of a position beyond motion capture's, standard deviation [m]
    variance: float = Limits.variance  # of the estimated position that is believed in flight [m2]

    def widen(self, limits: Limits) -> Limits:
        """`limits` as wide as positions of this system need."""
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
SYSTEMS = (LIGHTHOUSE, LOCO, FLOW)  # the first that is there counts: the others add to it
UNKNOWN = System("unknown")  # no deck that is known: motion capture, or a firmware that lists none


def system_of(values: Mapping[str, float]) -> System:
    """The system by values of parameters; `UNKNOWN` if none of its decks is there."""
    return next((one for one in SYSTEMS if any(values.get(name) for name in one.decks)), UNKNOWN)


def found(link: DeckLink) -> System:
    """The system of a drone. Raises LinkError."""
    return system_of(link.parameters.read(link.parameters.listed(name for one in SYSTEMS for name in one.decks)))


def common(links: Sequence[DeckLink]) -> System:
    """The system of both drones. Raises LinkError if they differ: their frames would."""
    one, other = (found(link) for link in links)
    if one is not other:
        told = " and ".join(f"{system.name} ({link.name})" for system, link in zip((one, other), links, strict=True))
        raise LinkError(f"both drones need one positioning system, not {told}: fit one kind to both")
    return one


def check(link: DeckLink) -> Check | None:
    """Whether the system of a drone is ready; None if its firmware tells of none. Raises LinkError."""
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
    """Give the system `seconds` to be ready. Raises LinkError with what is missing."""
    began = clock.now()
    while (state := check(link)) is not None and not state.passed:
        if found(link) is FLOW or clock.now() - began > seconds:
            raise LinkError(f"positioning of the {state.name}: {state.found}")
        clock.sleep(0.2)
