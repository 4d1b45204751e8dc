"""A flight from the first connection to the last line of the log: combines threads, clocks and printing."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import gc
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

from mjxball import __version__, terminal
from mjxball import config as configs
from mjxball.control.crazyflie import gains_to_json
from mjxball.errors import InputError
from mjxfly import clock, packets, positioning
from mjxfly.app_flight import OnboardApps, OnboardFlight, check_ready
from mjxfly.connection import LinkError
from mjxfly.controller import FlightController
from mjxfly.display import Display, listening
from mjxfly.figures import LEAST, SETTLING
from mjxfly.flight import Flight
from mjxfly.flight_log import Journal
from mjxfly.limits import NAMES, Check, FlightSettings
from mjxfly.link import Link
from mjxfly.mocap import Mocap
from mjxfly.preflight import Preflight, check, prepare
from mjxfly.process import Metronome, Timing, bounded, together, urgent
from mjxfly.rehearsal import Rehearsal, RehearsalError
from mjxfly.setpoints import CurveName, Variants
from mjxfly.supervisor import Event, Fault, FlightState, Supervisor
from mjxfly.telemetry import Rig
from mjxfly.twin.drone import only_kept
from mjxfly.warm_up import warm_up
from mjxfly.watchdog import NOTHING, Watchdog

SAVE_TIME = 0.2  # [s] to save the log of a program that failed in the air: the watchdog needs its radio
SWITCH_INTERVAL = 5e-4  # [s] between switches of Python threads; the default of 5 ms is half a tick


@dataclass(frozen=True)
class FlightSetup:
    """Controllers, drones and equipment of a flight."""

    controller: FlightController
    variants: Sequence[Variants]  # of leader and follower
    curve: CurveName  # assumed for both firmwares until their motors turn
    rig: Rig
    preflight: Preflight
    mocap: Mocap | None = None  # ready; the caller closes it
    apps: OnboardApps | None = None  # if the controllers run on board
    rehearsal: Rehearsal | None = None  # the twin; the caller closes it

    def rehearsal_error(self, cause: Fault | None = None) -> RehearsalError | None:
        """`Rehearsal.rehearsal_error` in a rehearsal, else None."""
        return None if self.rehearsal is None else self.rehearsal.rehearsal_error(cause)


def fly(
    uris: Sequence[str], setup: FlightSetup, settings: FlightSettings, log: Path | None, command: Sequence[str] = ()
) -> int:
    """Fly once; return 0 without faults, 1 after a fault. Raises InputError if the flight cannot begin.

    Prints the checks and the report at the end. `command`, the command line, goes into the log's header.
    """
    policy, gains = setup.controller.policy, [own[setup.curve].gains for own in setup.variants]
    header: dict[str, Any] = {"command": list(command), "version": __version__, "uris": list(uris)}
    header |= {
        "settings": dataclasses.asdict(settings),
        "policy": policy.name,
        "config_hash": policy.metadata["config_hash"],
    }
    header |= {"mocap": str(setup.mocap.settings)} if setup.mocap else {}
    header |= {"config": configs.to_dict(setup.controller.config), "gains": gains_to_json((gains[0], gains[1]))}
    header |= {"curve": setup.curve}
    if setup.rehearsal is not None and (kept := only_kept(name for own in gains for name in own)):
        _say(f"the twin does not act on {', '.join(kept)}: this rehearsal does not show what they do")
    before = sys.getswitchinterval()
    with Journal(log, **header) as journal:
        links = [
            Link(uri, name, journal.note, twin=setup.rehearsal is not None)
            for uri, name in zip(uris, NAMES, strict=True)
        ]
        try:
            sys.setswitchinterval(SWITCH_INTERVAL)
            # Apps land by themselves: no watchdog may take over from them.
            alone = setup.apps is not None
            guard = contextlib.nullcontext() if alone else Watchdog(uris, rehearses=setup.rehearsal is not None)
            with urgent() as priority, guard as watchdog:
                journal.note("priority", granted=priority)
                if setup.mocap is not None:
                    setup.mocap.note = journal.note
                check_app = None if setup.apps is None else functools.partial(setup.apps.check, say=_say)
                curves = prepare(links, setup.variants, setup.preflight, _say, setup.mocap, check_app)
                if setup.mocap is None:
                    system = positioning.common(links)
                    if setup.apps is not None and system.noise:
                        raise LinkError(f"apps on board descend at the variance of {system.name}: leave --onboard out")
                    settings = dataclasses.replace(settings, limits=system.widen(settings.limits))
                pair = (links, setup.controller, setup.variants, curves, setup.rig)
                kind = Flight if setup.apps is None else OnboardFlight
                flight = kind(*pair, settings, journal.note, watchdog, setup.mocap)
                flight.rehearsal_error = setup.rehearsal_error
                warm_up(kind, *pair, settings, clock.now())
                flight.ready = _checked(links, setup, settings, journal)
                flight.refusal = "" if flight.ready else "see the checks"
                timing = run(flight, journal.close)
                return _ended(flight, timing, journal, setup)
        except KeyboardInterrupt:  # before take-off; `run` handles Ctrl-C afterwards
            journal.note("refused", text="interrupted")
            _say("interrupted before take-off")
            return 1
        except (InputError, OSError) as error:
            reason = setup.rehearsal_error() or error
            journal.note("refused", text=str(reason))
            if setup.rehearsal is not None and isinstance(reason, RehearsalError):
                _say(setup.rehearsal.end())
            raise reason from None
        finally:
            together([link.close for link in links])
            sys.setswitchinterval(before)
            gc.unfreeze()


def run(flight: Flight, save: Callable[[], None] = lambda: None) -> Timing:
    """Run the control loop until the flight is done, with Ctrl-C, SIGTERM and keys. Raises RehearsalError only.

    A program error in the air ends the process after `save`, see `_leave`; on the ground it stops the motors.
    """
    metronome = Metronome(flight.settings.period)

    def land() -> None:
        flight.interrupts = max(flight.interrupts, 1)

    def interrupt() -> None:
        flight.interrupts += 1

    def kill() -> None:
        flight.kill = True

    with contextlib.ExitStack() as terminal_in_use:
        terminal_in_use.enter_context(listening(land, interrupt, kill))
        terminal_in_use.enter_context(Display(lambda: flight.view, flight.settings.limits))
        try:
            metronome.start()
            flight.begin(clock.now())
            going = True
            while going:
                now = metronome.wait()
                going = flight.tick(now, metronome.lateness, metronome.missed_lately(now), metronome.gap)
        except RehearsalError:
            raise
        except BaseException as error:  # no error may leave the motors on, or stop them in flight
            with contextlib.suppress(Exception):
                flight.note("error", text=f"{type(error).__name__}: {error}")
            if flight.flying:
                _leave(flight, error, save, terminal_in_use.close)
            _emergency(flight)
    return metronome.timing()


def _leave(flight: Flight, error: BaseException, save: Callable[[], None], restore: Callable[[], None]) -> NoReturn:
    """End the process without sending anything to the drones: zero setpoints would turn the motors off in the air.

    The watchdog, or the apps on board, bring both drones down. The log is saved and the terminal restored meanwhile.
    """
    try:
        others = "the apps on board land both drones"
        if flight.watchdog is not None:
            flight.watchdog.leave()
            others = "the watchdog brings both drones down"
        bounded(save, SAVE_TIME)
        restore()
        terminal.warn(f"error: the flight program failed in the air, {others}: {type(error).__name__}: {error}")
    finally:
        os._exit(1)


def _emergency(flight: Flight) -> None:
    """After a program error on the ground: stop both drones without `Flight.tick`."""
    flight.kill = True
    for _ in range(50):
        if flight.watchdog is not None:
            flight.watchdog.beat(False, NOTHING)  # so that it does not take over
        for link in flight.links:
            link.command(packets.EMERGENCY_STOP)
            link.send(packets.setpoint_packet(packets.ZERO))
        clock.sleep(0.01)
    flight.supervisor = Supervisor(FlightState.DONE, clock.now(), Fault(Event.BAD_STATE, "the runner itself failed"))


def _checked(links: Sequence[Link], setup: FlightSetup, settings: FlightSettings, journal: Journal) -> bool:
    checks = check(links, setup.rig, settings.limits, setup.preflight)
    if setup.mocap is None:
        checks += [one for one in map(positioning.check, links) if one is not None]
    else:
        checks += setup.mocap.checks()
        setup.mocap.guarding = True
    checks += [] if setup.apps is None else map(check_ready, links)
    checks += [Check("log", False, f"{journal.failure}: choose another --log")] if journal.failure else []
    for one in checks:
        journal.note("check", name=one.name, passed=one.passed, found=one.found)
        _say(f"{'good' if one.passed else 'BAD '}  {one.name}: {one.found}")
    return all(one.passed for one in checks)


def _ended(flight: Flight, timing: Timing, journal: Journal, setup: FlightSetup) -> int:
    supervisor = flight.supervisor
    cause = supervisor.cause
    stayed = not (flight.settings.dry_run or flight.interrupts or flight.lifted)
    code = 0 if cause is None and not stayed else 1
    sent = [getattr(link, "overwritten", 0) for link in flight.links]
    figures = flight.flown.figures
    why, sentences = str(cause) if cause else "", flight.how_it_ended()
    journal.note(
        "end",
        code=code,
        cause=why,
        told=sentences,
        timing=timing,
        overwritten=sent,
        flown=None if figures is None else dataclasses.asdict(figures),
    )
    if stayed and cause is None and (reason := setup.rehearsal_error()):
        raise reason
    for text in sentences:
        _say(text)
    if cause is None and stayed:
        _say("it did not lift: is it heavier than its plant, or does a propeller give less?")
    if flight.settings.dry_run and flight.highest:
        text = ", ".join(f"{units} ({name})" for name, units in zip(NAMES, flight.highest, strict=True))
        _say(f"dry run: zeros were sent; to a pair that does not lift it would have sent up to {text} thrust units")
    if flight.settings.dry_run and setup.mocap is not None:
        _say(
            f"axes: not shown yet: {flight.carry}" if flight.carry else "axes: every turn and way agrees with the IMUs"
        )
    late = f"median {1e3 * timing.median:.2f} ms, p99 {1e3 * timing.p99:.2f} ms, largest {1e3 * timing.largest:.2f} ms"
    _say(f"loop: {timing.ticks} ticks of {1e3 * flight.settings.period:g} ms, {timing.missed} missed; late {late}")
    if supervisor.cause is None and not (figures or flight.settings.dry_run):
        _say(f"hover error not measured: --seconds must allow {SETTLING:g} s to settle and {LEAST:g} s more")
    if figures is not None:
        _say(str(figures))
    if journal.failure:
        _say(f"the log is not complete: {journal.failure}")
    if setup.rehearsal is not None:
        _say(setup.rehearsal.end())
    return code


def _say(text: str) -> None:
    with contextlib.suppress(OSError, ValueError):  # a closed terminal must not end a flight
        terminal.say(text)
