"""A flight whose laws run on the drones: the laptop arms, says which phase it wants, watches, logs and lands.

The supervisor's states are the same. In the air the apps decide (`mjxfly.app`): they land by themselves if they do
not hear the laptop or each other, so that nothing is held here for a link that breaks off.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mjxball.control import rotations
from mjxball.errors import InputError
from mjxfly.app.protocol import CANNOT_FLY, GROUP, AppSample, Phase, order, reason, upload
from mjxfly.connection import LinkError
from mjxfly.flight import Flight
from mjxfly.limits import NAMES, Check, FlightSettings
from mjxfly.link import Link
from mjxfly.monitor import UplinkWatch
from mjxfly.packets import ZERO, Setpoint
from mjxfly.setpoints import CURVE_NAMES, CurveName, Mapped, Variant, Variants
from mjxfly.supervisor import AIRBORNE, GUIDED, TRANSITIONS, Event, Fault, State
from mjxfly.takeoff import STUCK
from mjxfly.telemetry import DroneLink, Rig, object_state

STATE_AGE = 0.5  # [s]: from here on the laptop lands, as the apps do when they have not heard it for as long
PERIOD = 2  # ticks between two orders


@dataclass(frozen=True)
class Apps:
    """What is expected on board."""

    name: str  # of the policy
    idents: Sequence[int]  # of its weights, in float32 and in 8 bits
    period: int  # of its law [ms]
    upload: tuple[bytes, int] | None = None  # weights and key, to be put into the follower

    def check(self, number: int, link: Link, say: Callable[[str], None]) -> None:
        """See that drone `number` carries its app of this policy; upload weights if wanted. Raises InputError."""
        found = self._read(link, ("role", "period"))
        if int(found["role"]) != number:
            raise InputError(f"the {link.name} carries the app of the {NAMES[1 - number]}; exchange the URIs")
        if int(found["period"]) != self.period:
            own = f"the app of the {link.name} has a period of {found['period']:.0f} ms"
            raise InputError(f"{own}, and {self.name} one of {self.period} ms: flash its own")
        if number == 0:
            return
        if self.upload is not None:
            send_weights(link, *self.upload, say)
        ident = int(self._read(link, ("ident",))["ident"])
        if ident not in self.idents:
            raise InputError(
                f"the follower carries another policy than {self.name}: export it with --crazyflie and flash it"
            )
        kind = "8 bit" if ident == self.idents[1] else "float32"
        say(f"on board: {self.name}, {kind} weights")

    def _read(self, link: Link, names: Sequence[str]) -> dict[str, float]:
        try:
            found = link.parameters.read([f"{GROUP}.{name}" for name in names])
        except LinkError as error:
            if "no parameter" not in str(error):
                raise
            raise InputError(f"the {link.name} has no app on board: see docs/onboard.md") from None
        return {name.removeprefix(f"{GROUP}."): value for name, value in found.items()}


def check_ready(link: Link) -> Check:
    """Whether the app would begin a flight; that the firmware cannot fly yet is the firmware's check."""
    app = link.telemetry.app
    refusal = None if app is None else reason(app.refusal)
    ready = refusal in (reason(0), CANNOT_FLY)
    return Check(f"{link.name} app", ready, "ready" if ready else refusal or "it logs nothing")


def send_weights(link: Link, weights: bytes, key: int, say: Callable[[str], None]) -> None:
    """Put `weights` into the follower at `link`, on the ground. Raises InputError if its app refuses them."""
    for packet in upload(weights, key):
        reply = link.ask_app(packet)
        if reply.status:
            raise InputError(f"the {link.name}: {reason(reply.status)}")
    say(f"uploaded {len(weights)} bytes of weights")


ORDERS = {
    State.SPIN: Phase.SPIN,
    State.RAMP: Phase.RAMP,
    State.FLY: Phase.FLY,
    State.LAND: Phase.LAND,
    State.DESCEND: Phase.DESCEND,
    State.HOLD: Phase.LAND,
    State.STOP: Phase.STOP,
    State.KILL: Phase.STOP,
}
# What an app's phase says to a laptop that is in command of the laws, or has them land.
NEWS = {
    Phase.LAND: Event.APP_LANDS,
    Phase.DESCEND: Event.APP_DESCENDS,
    Phase.STOP: Event.APP_STOPS,
    Phase.IDLE: Event.APP_STOPS,
}
LANDED = (reason(1), reason(2), reason(18))  # of a stop that was asked for, or follows from standing on the ground
# What the apps see to, or what has no meaning without setpoints of the laptop's.
THEIRS = (Event.UNHEARD, Event.DEADLINES, Event.SATURATED, Event.GAPS)


def settings_of(settings: FlightSettings) -> FlightSettings:
    """`settings` for a flight on board."""
    return replace(settings, limits=replace(settings.limits, state_age=STATE_AGE))


def variants_of(variants: Sequence[Variants], rig: Rig, settings: FlightSettings) -> list[Variants]:
    """`variants` whose gains hold the apps' parameters as well: mount, goal of O from the start, battery, curve."""
    found: list[Variants] = []
    for own, mount in zip(variants, rig.mounts, strict=True):
        places = {"goal": settings.goal, "mount": mount}
        told = {
            f"{GROUP}.{what}{axis}": float(place[i]) for what, place in places.items() for i, axis in enumerate("XYZ")
        }
        told[f"{GROUP}.battery"] = settings.limits.battery
        curves: dict[CurveName, Variant] = {}
        for name, variant in own.items():
            gains = {**variant.gains, **told, f"{GROUP}.curve": float(CURVE_NAMES.index(name))}
            curves[name] = variant._replace(gains=gains)
        found.append(curves)
    return found


class OnboardFlight(Flight):
    """See the module."""

    def begin(self, now: float) -> None:
        """See `Flight.begin`."""
        self._noted: dict[str, tuple[object, ...]] = {}
        self._of_apps: list[Fault] = []  # of this tick
        super().begin(now)

    def _command(self) -> tuple[list[Mapped] | None, list[Fault]]:
        """No setpoints: only what the figures of the flight need."""
        if self.supervisor.state in GUIDED:
            seen = object_state(self._states, self.rig)
            self._highest_place = max(self._highest_place, self._height(seen))
            if self.supervisor.state is State.FLY:
                distance = float(np.linalg.norm(self.goal(self._now) - seen.position))
                self.flown.update(self._now, self.elapsed, distance, rotations.tilt_of_quaternion(seen.quaternion))
        return None, []

    def _is_off(self) -> bool:
        """True once an app says that its law flies."""
        return self.settings.dry_run or any(app is not None and app.phase >= Phase.FLY for app in self._apps())

    def _stuck(self) -> str:
        return f"{STUCK}: is it heavier, or does a propeller give less?"

    def _wanted(self, mapped: list[Mapped] | None) -> list[Setpoint]:
        return [ZERO, ZERO]

    def _send(self, link: DroneLink, watch: UplinkWatch, value: Setpoint) -> None:
        wanted = None if self.settings.dry_run else ORDERS.get(self.supervisor.state)
        if wanted is None:
            super()._send(link, watch, value)
        elif self._count % PERIOD == 0 or self.supervisor.since == self._now:
            link.send(order(wanted))

    def _advance(self, faults: list[Fault]) -> None:
        self._of_apps = self._from_apps()
        super()._advance([one for fault in faults if (one := self._translated(fault))] + self._of_apps)

    def _note_ending(self, faults: list[Fault], gap: float) -> None:
        """What the apps say; nothing that they see to."""
        super()._note_ending([fault for fault in faults if fault.event not in THEIRS] + self._of_apps, gap)

    def _translated(self, fault: Fault) -> Fault | None:
        """What a fault is to a flight on board."""
        if self.supervisor.state not in AIRBORNE:
            return self._spun(fault)
        if fault.event in THEIRS:
            return None
        # Whoever is still heard lands, and takes the other one along.
        lost = fault.event in (Event.STALE, Event.LINK_LOST, Event.FROZEN)
        return Fault(Event.APP_LANDS, fault.detail) if lost else fault

    def _spun(self, fault: Fault) -> Fault | None:
        """Motors may turn on before both apps are ready; then it is too early for more thrust."""
        early = fault.event is Event.CURVE_KNOWN and not self.settings.dry_run
        return None if early and any(app is None or app.phase is not Phase.SPIN for app in self._apps()) else fault

    def _apps(self) -> list[AppSample | None]:
        """What the apps logged, None where nothing is known of late."""
        samples = [link.telemetry.app for link in self.links]
        return [app if app is not None and self._now - app.arrival <= STATE_AGE else None for app in samples]

    def _from_apps(self) -> list[Fault]:
        state, found = self.supervisor.state, []
        for name, app in zip(NAMES, self._apps(), strict=True):
            if app is None:
                continue
            self._note_app(name, app)
            if state is State.SPIN and self.elapsed > STATE_AGE and app.phase <= Phase.SPIN and app.refusal:
                found.append(Fault(Event.APP_REFUSES, f"{name}: {reason(app.refusal)}"))
            elif state in AIRBORNE and app.phase in NEWS and self.elapsed > STATE_AGE / 2:
                ended = app.phase in (Phase.STOP, Phase.IDLE) and state in (State.LAND, State.DESCEND)
                event = Event.TOUCHED_DOWN if ended and reason(app.cause) in LANDED else NEWS[app.phase]
                found.append(Fault(event, f"{name}: {reason(app.cause)}"))
        if self.settings.dry_run:
            return []
        return [fault for fault in found if (state, fault.event) in TRANSITIONS]

    def _note_app(self, name: str, app: AppSample) -> None:
        """Into the log, once."""
        if self._noted.get(name) == app[:-1]:
            return
        self._noted[name] = app[:-1]
        self.note(
            "app",
            self._now,
            drone=name,
            phase=app.phase.name.lower(),
            cause=reason(app.cause),
            refusal=reason(app.refusal),
            copying=app.copying,
        )
