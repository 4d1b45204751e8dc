"""A flight whose controllers run on the drones. The laptop arms, requests phases, monitors, logs and lands.

The supervisor has the same states. In the air the apps (`mjxfly.app`) decide: they land by themselves if they do not
hear the laptop or each other, so the laptop does not enter HOLD when a link breaks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mjxball.control import rotations
from mjxball.errors import InputError
from mjxfly.app.protocol import CANNOT_FLY, GROUP, AppPhase, AppSample, order, reason, upload
from mjxfly.connection import LinkError
from mjxfly.flight import Flight
from mjxfly.limits import NAMES, Check, FlightSettings
from mjxfly.link import Link
from mjxfly.monitor import UplinkWatch
from mjxfly.packets import ZERO, Setpoint
from mjxfly.setpoints import CURVE_NAMES, BoundedSetpoint, CurveName, Variant, Variants
from mjxfly.supervisor import AIRBORNE, GUIDED, TRANSITIONS, Event, Fault, FlightState
from mjxfly.takeoff import STUCK
from mjxfly.telemetry import DroneLink, Rig, object_state

STATE_AGE = 0.5  # [s] age of a state at which the laptop lands; the apps land after the same silence
PERIOD = 2  # ticks between two orders


@dataclass(frozen=True)
class OnboardApps:
    """The apps that the drones are expected to carry."""

    name: str  # of the policy
    idents: Sequence[int]  # identifiers of its weights in float32 and in int8
    period: int  # control period [ms]
    upload: tuple[bytes, int] | None = None  # weights and key to upload to the follower

    def check(self, number: int, link: Link, say: Callable[[str], None]) -> None:
        """Check that drone `number` carries its app of this policy; upload weights if given. Raises InputError."""
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
                f"the follower carries another policy than {self.name}: export it by python -m mjxfly.app and flash it"
            )
        kind = "8 bit" if ident == self.idents[1] else "float32"
        say(f"on board: {self.name}, {kind} weights")

    def _read(self, link: Link, names: Sequence[str]) -> dict[str, float]:
        try:
            found = link.parameters.read([f"{GROUP}.{name}" for name in names])
        except LinkError as error:
            if "no parameter" not in str(error):
                raise
            raise InputError(f"the {link.name} has no app on board: see docs/hardware.md") from None
        return {name.removeprefix(f"{GROUP}."): value for name, value in found.items()}


def check_ready(link: Link) -> Check:
    """Whether the app would start a flight. `CANNOT_FLY` passes: the check of the firmware covers it."""
    app = link.telemetry.app
    refusal = None if app is None else reason(app.refusal)
    ready = refusal in (reason(0), CANNOT_FLY)
    return Check(f"{link.name} app", ready, "ready" if ready else refusal or "it logs nothing")


def send_weights(link: Link, weights: bytes, key: int, say: Callable[[str], None]) -> None:
    """Upload `weights` to the follower at `link`, on the ground. Raises InputError if its app refuses them."""
    for packet in upload(weights, key):
        reply = link.ask_app(packet)
        if reply.status:
            raise InputError(f"the {link.name}: {reason(reply.status)}")
    say(f"uploaded {len(weights)} bytes of weights")


ORDERS = {
    FlightState.SPIN: AppPhase.SPIN,
    FlightState.RAMP: AppPhase.RAMP,
    FlightState.FLY: AppPhase.FLY,
    FlightState.LAND: AppPhase.LAND,
    FlightState.DESCEND: AppPhase.DESCEND,
    FlightState.HOLD: AppPhase.LAND,
    FlightState.STOP: AppPhase.STOP,
    FlightState.KILL: AppPhase.STOP,
}
# Event for a phase that an app enters by itself, while the laptop flies or lands.
PHASE_EVENTS = {
    AppPhase.LAND: Event.APP_LANDS,
    AppPhase.DESCEND: Event.APP_DESCENDS,
    AppPhase.STOP: Event.APP_STOPS,
    AppPhase.IDLE: Event.APP_STOPS,
}
LANDED = (reason(1), reason(2), reason(18))  # causes of a stop that was requested, or that follows a touchdown
# Events that the apps handle, or that only apply to setpoints sent by the laptop.
HANDLED_BY_APPS = (Event.UNHEARD, Event.DEADLINES, Event.SATURATED, Event.GAPS)


def settings_of(settings: FlightSettings) -> FlightSettings:
    """`settings` of a flight on board: states may be up to `STATE_AGE` old."""
    return replace(settings, limits=replace(settings.limits, state_age=STATE_AGE))


def variants_of(variants: Sequence[Variants], rig: Rig, settings: FlightSettings) -> list[Variants]:
    """`variants` whose gains include the apps' parameters: mount, goal of O from the start [m], battery [V], curve."""
    found: list[Variants] = []
    for own, mount in zip(variants, rig.mounts, strict=True):
        places = {"goal": settings.goal, "mount": mount}
        shared = {
            f"{GROUP}.{what}{axis}": float(place[i]) for what, place in places.items() for i, axis in enumerate("XYZ")
        }
        shared[f"{GROUP}.battery"] = settings.limits.battery
        curves: dict[CurveName, Variant] = {}
        for name, variant in own.items():
            gains = {**variant.gains, **shared, f"{GROUP}.curve": float(CURVE_NAMES.index(name))}
            curves[name] = variant._replace(gains=gains)
        found.append(curves)
    return found


class OnboardFlight(Flight):
    """A `Flight` that sends orders to the apps instead of setpoints."""

    def begin(self, now: float) -> None:
        """See `Flight.begin`."""
        self._noted: dict[str, tuple[object, ...]] = {}
        self._app_faults: list[Fault] = []  # of this tick
        super().begin(now)

    def _command(self) -> tuple[list[BoundedSetpoint] | None, list[Fault]]:
        """(None, []): the laptop computes no setpoints. Updates the flight statistics."""
        if self.supervisor.state in GUIDED:
            seen = object_state(self._states, self.rig)
            self._highest_place = max(self._highest_place, self._height(seen))
            if self.supervisor.state is FlightState.FLY:
                distance = float(np.linalg.norm(self.goal(self._now) - seen.position))
                self.flown.update(self._now, self.elapsed, distance, rotations.tilt_of_quaternion(seen.quaternion))
        return None, []

    def _is_airborne(self) -> bool:
        """True once an app reports that its controller flies."""
        return self.settings.dry_run or any(app is not None and app.phase >= AppPhase.FLY for app in self._apps())

    def _stuck_message(self) -> str:
        return f"{STUCK}: is it heavier, or does a propeller give less?"

    def _setpoints(self, mapped: list[BoundedSetpoint] | None) -> list[Setpoint]:
        return [ZERO, ZERO]

    def _send(self, link: DroneLink, watch: UplinkWatch, value: Setpoint) -> None:
        wanted = None if self.settings.dry_run else ORDERS.get(self.supervisor.state)
        if wanted is None:
            super()._send(link, watch, value)
        elif self._count % PERIOD == 0 or self.supervisor.since == self._now:
            link.send(order(wanted))

    def _advance(self, faults: list[Fault]) -> None:
        self._app_faults = self._from_apps()
        super()._advance([one for fault in faults if (one := self._translated(fault))] + self._app_faults)

    def _note_ending(self, faults: list[Fault], gap: float) -> None:
        """Record the faults of the apps, and those of the laptop that the apps do not handle."""
        super()._note_ending([fault for fault in faults if fault.event not in HANDLED_BY_APPS] + self._app_faults, gap)

    def _translated(self, fault: Fault) -> Fault | None:
        """The fault as it applies to a flight on board; None if the apps handle it."""
        if self.supervisor.state not in AIRBORNE:
            return self._before_lift(fault)
        if fault.event in HANDLED_BY_APPS:
            return None
        # The drone that is still connected lands, and the app of the other one follows it.
        lost = fault.event in (Event.STALE, Event.LINK_LOST, Event.FROZEN)
        return Fault(Event.APP_LANDS, fault.detail) if lost else fault

    def _before_lift(self, fault: Fault) -> Fault | None:
        """`fault`, or None for CURVE_KNOWN until both apps have reached SPIN: thrust must not rise before."""
        early = fault.event is Event.CURVE_KNOWN and not self.settings.dry_run
        return None if early and any(app is None or app.phase is not AppPhase.SPIN for app in self._apps()) else fault

    def _apps(self) -> list[AppSample | None]:
        """Newest log sample of each app, None if there is none younger than `STATE_AGE`."""
        samples = [link.telemetry.app for link in self.links]
        return [app if app is not None and self._now - app.arrival <= STATE_AGE else None for app in samples]

    def _from_apps(self) -> list[Fault]:
        """Events that the apps report and that change the supervisor's state; none in a dry run."""
        state, found = self.supervisor.state, []
        for name, app in zip(NAMES, self._apps(), strict=True):
            if app is None:
                continue
            self._note_app(name, app)
            if state is FlightState.SPIN and self.elapsed > STATE_AGE and app.phase <= AppPhase.SPIN and app.refusal:
                found.append(Fault(Event.APP_REFUSES, f"{name}: {reason(app.refusal)}"))
            elif state in AIRBORNE and app.phase in PHASE_EVENTS and self.elapsed > STATE_AGE / 2:
                ended = app.phase in (AppPhase.STOP, AppPhase.IDLE) and state in (FlightState.LAND, FlightState.DESCEND)
                event = Event.TOUCHED_DOWN if ended and reason(app.cause) in LANDED else PHASE_EVENTS[app.phase]
                found.append(Fault(event, f"{name}: {reason(app.cause)}"))
        if self.settings.dry_run:
            return []
        return [fault for fault in found if (state, fault.event) in TRANSITIONS]

    def _note_app(self, name: str, app: AppSample) -> None:
        """Log the app's phase when it has changed."""
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
