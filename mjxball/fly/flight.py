"""One flight, tick by tick: states in, faults to the supervisor, setpoints out to both drones. No clock, no thread."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from mjxball.fly import command, limits, packets
from mjxball.fly.card import Commands, Controller
from mjxball.fly.command import SPIN_THRUST, CommandMap, CurveName, LastKnownState, Mapped, Variants
from mjxball.fly.limits import NAMES, EstimatorWatch, FlightSettings, Sustained, UplinkWatch
from mjxball.fly.mocap import Mocap
from mjxball.fly.packets import ZERO, DroneState, Health, PacketError, Setpoint
from mjxball.fly.spin import SpinCheck
from mjxball.fly.supervisor import AIRBORNE, GUIDED, ON_GROUND, Event, Fault, State, Supervisor
from mjxball.fly.telemetry import DroneLink, Note, ObjectState, Rig, Sample, object_state, yaw_of
from mjxball.fly.watchdog import Watchdog

LIFTED = 0.05  # [m], or half of the goal's height if that is less, from which on a pair counts as having flown


class View(NamedTuple):
    """What a display may show; replaced as a whole at every tick."""

    time: float  # [s] since the start
    supervisor: Supervisor
    states: list[DroneState]
    ages: list[float]
    goal: np.ndarray
    wanted: tuple[Setpoint, Setpoint]
    late: float  # [s]
    missed: int


class Flight:
    """See the module. `tick` is called once per period until it returns false."""

    def __init__(
        self,
        links: Sequence[DroneLink],
        controller: Controller,
        variants: Sequence[Variants],
        assumed: Sequence[CurveName],
        rig: Rig,
        settings: FlightSettings,
        note: Note,
        watchdog: Watchdog | None = None,
        mocap: Mocap | None = None,
    ):
        """`variants` of leader and follower by force curve; `assumed` are the curves whose gains were uploaded."""
        self.links, self.controller, self.rig = links, controller, rig
        self.settings, self.note, self.watchdog = settings, note, watchdog
        self._mocap = mocap
        self.supervisor = Supervisor()
        self.interrupts = 0
        self.kill = False
        self.ready: bool | None = None  # checks before flight: not known yet, passed, failed
        self.refusal = ""
        self.view: View | None = None
        self.spin = SpinCheck(links, variants, assumed, settings.motor)
        self._sent: list[Setpoint] = [ZERO, ZERO]
        self._trims = [0.0, 0.0]  # thrust that hovers [units]: a running average of what was sent
        self._commands: Commands | None = None
        self._every = max(round(controller.period / settings.period), 1)
        self._count = 0
        self._origin = np.zeros(3)
        self._start = 0.0
        self._estimators = EstimatorWatch(rig, sideways=not settings.stand)
        self._uplinks = [UplinkWatch(name) for name in NAMES]
        self._low = [Sustained(settings.limits.battery_time) for _ in links]
        self._saturated = Sustained(settings.limits.saturation_time)
        self._back = Sustained(settings.limits.fresh)
        self._holds = 0
        self._hold_for = settings.times.drone_watchdog
        self._shares = [1.0]  # of the trims, tick by tick, where the height is not measured
        bounds = settings.limits
        self._hold_limits = dataclasses.replace(bounds, tilt=min(bounds.hold_tilt, bounds.tilt))
        self._land_height = 0.0
        self._highest_place = 0.0  # of O above where it stood, under the laws [m]
        self._last: ObjectState | None = None
        self.worst_age = 0.0
        self.highest = [0, 0]  # thrust of each drone that was wanted [units]

    @property
    def maps(self) -> tuple[CommandMap, CommandMap]:
        """Command maps of leader and follower for their firmwares' force curves."""
        leader, follower = self.spin.chosen()
        return leader.map, follower.map

    @property
    def lifted(self) -> bool:
        """True if the pair left the ground, or was not to."""
        return self._highest_place >= min(LIFTED, self.settings.goal[2] / 2)

    def begin(self, now: float) -> None:
        """Where the pair stands now is where it starts; both links must have a state."""
        self._start = now
        self._origin = object_state(self._states(), self.rig).position
        self.supervisor = Supervisor(State.CHECK, now)

    def tick(self, now: float, late: float = 0.0, missed: int = 0, gap: float = 0.0) -> bool:
        """Everything that happens in one period; false once the flight is done.

        `late` [s] is this tick's, `missed` the deadlines missed within the last second, `gap` [s] the time since the
        tick before.
        """
        states, ages = self._states(), [link.telemetry.age(now) for link in self.links]
        fresh = [age <= self.settings.limits.state_age for age in ages]
        self.worst_age = max(ages)
        faults = self._outside(now, ages, missed, gap)
        faults += self._from_watches(fresh, now) + self._from_states(states, fresh, now)
        mapped, broken = self._guided(states, now)
        faults += broken + self._progress(states, fresh, now)
        self._advance(faults, now, ages)
        wanted = self._wanted(mapped, now)
        self._transmit(wanted, now)
        self._record(now, states, ages, wanted, late, missed)
        self._count += 1
        return self.supervisor.state is not State.DONE

    # What is wrong.

    def _samples(self) -> list[Sample]:
        return [link.telemetry.newest for link in self.links if link.telemetry.newest is not None]

    def _states(self) -> list[DroneState]:
        return [sample.state for sample in self._samples()]

    def _healths(self) -> list[Health | None]:
        samples = [link.telemetry.health for link in self.links]
        return [None if sample is None else sample.health for sample in samples]

    def _outside(self, now: float, ages: list[float], missed: int, gap: float) -> list[Fault]:
        bounds, faults = self.settings.limits, []
        if self.kill or self.interrupts > 1:
            faults.append(Fault(Event.KEY_KILL, "asked for on the laptop"))
        elif self.interrupts:
            faults.append(Fault(Event.INTERRUPT, "asked for on the laptop"))
        for name, link in zip(NAMES, self.links, strict=True):
            if link.lost:
                faults.append(Fault(Event.LINK_LOST, f"{name}: {link.lost}"))
            elif link.stuck_for(now) > bounds.state_age:
                faults.append(Fault(Event.LINK_LOST, f"{name}: nothing can be sent"))
        faults += limits.age_faults(ages, bounds)
        if self._holds > bounds.gaps:
            faults.append(Fault(Event.GAPS, f"{self._holds} times"))
        if missed > bounds.missed_deadlines or gap > bounds.longest_gap:
            faults.append(Fault(Event.DEADLINES, f"{missed} missed in a second, longest gap {1000 * gap:.0f} ms"))
        if self._mocap is not None:
            faults += self._mocap.faults(now)
        if not self._beat():
            faults.append(Fault(Event.WATCHDOG))
        return faults

    def _beat(self) -> bool:
        """Tell the watchdog what it would take over; false if there is none any more."""
        if self.watchdog is None:
            return True
        return self.watchdog.beat(
            self.supervisor.state in AIRBORNE and not self.settings.dry_run, self._last_known_state()
        )

    def _last_known_state(self) -> LastKnownState:
        """What is known of how the pair moves."""
        seen = self._last or object_state(self._states(), self.rig)
        trim = sum(self._trims)
        lift = command.GRAVITY * (sum(sent.thrust for sent in self._sent) / trim - 1) if trim else 0.0
        trims = (round(self._trims[0]), round(self._trims[1]))
        return LastKnownState(trims, float(seen.position[2] - self._origin[2]), float(seen.velocity[2]), lift)

    def _from_states(self, states: list[DroneState], fresh: list[bool], now: float) -> list[Fault]:
        armed = self.supervisor.state not in ON_GROUND and not self.settings.dry_run
        bounds = self._hold_limits if self.supervisor.state is State.HOLD else self.settings.limits
        faults = limits.state_faults(states, self._origin, self.rig.span, bounds, armed, fresh)
        for name, state, low in zip(NAMES, states, self._low, strict=True):
            if low.update(state.battery < self.settings.limits.battery, now):
                faults.append(Fault(Event.BATTERY, f"{name} at {state.battery:.2f} V"))
        return faults

    def _from_watches(self, fresh: list[bool], now: float) -> list[Fault]:
        """What the estimators and the drones' echoes say; from the air on, and a dry run is never echoed."""
        samples, faults = self._samples(), []
        if self.supervisor.state in AIRBORNE and all(fresh):
            faults += self._estimators.update(samples, self._healths(), now)
        if self.supervisor.state in AIRBORNE and not self.settings.dry_run:
            for link, watch in zip(self.links, self._uplinks, strict=True):
                if link.telemetry.health is not None:
                    faults += watch.update(*link.telemetry.health)
        self._last = self._estimators.object(samples, fresh) or self._last
        return faults

    # What the laws want.

    def _guided(self, states: list[DroneState], now: float) -> tuple[list[Mapped] | None, list[Fault]]:
        """Setpoints of both laws while they are in command, and what is wrong with them."""
        if self.supervisor.state not in GUIDED:
            return None, []
        try:
            seen = object_state(states, self.rig)
            if self._commands is None or self._count % self._every == 0:
                self._commands = self.controller.step(seen, self.goal(now))
            laws = (self._commands.leader, self._commands.follower)
            mapped = [
                command.to_setpoint(law, yaw_of(state), constants)
                for law, state, constants in zip(laws, states, self.maps, strict=True)
            ]
        except (PacketError, ValueError, FloatingPointError) as error:
            return None, [Fault(Event.BAD_STATE, str(error))]
        self._highest_place = max(self._highest_place, float(seen.position[2] - self._origin[2]))
        # A dry run never lifts: the laws ask for more and more.
        saturated = any(one.saturated for one in mapped) and not self.settings.dry_run
        if self._saturated.update(saturated, now):
            return mapped, [Fault(Event.SATURATED, f"for {self.settings.limits.saturation_time:g} s")]
        return mapped, []

    def goal(self, now: float) -> np.ndarray:
        """Goal of O (3,) at `now` [m]; while landing it sinks, far below the ground, since the laws lag behind it."""
        goal = self._origin + np.array(self.settings.goal)
        if self.supervisor.state is State.LAND:
            sunk = self.settings.times.land_speed * (now - self.supervisor.since)
            goal[2] = max(self._origin[2] + self._land_height - sunk, self._origin[2] - 1.0)
        return goal

    # What comes next.

    def _progress(self, states: list[DroneState], fresh: list[bool], now: float) -> list[Fault]:
        """Events of time and place."""
        state, elapsed, times = self.supervisor.state, now - self.supervisor.since, self.settings.times
        events = []
        if state is State.CHECK and self.ready is not None:
            events.append(Fault(Event.READY if self.ready else Event.REFUSED, self.refusal))
        if state is State.ARM and elapsed >= times.arm and self._armed(states):
            events.append(Fault(Event.ARMED))
        if state is State.SPIN and elapsed >= times.spin:
            known = [Fault(Event.CURVE_KNOWN, "dry run")] if self.settings.dry_run else None
            events += known or self.spin.update(self.supervisor.since + times.spin / 2, now, self.note)
        if state is State.RAMP and elapsed >= times.ramp:
            events.append(Fault(Event.HOVERING))
        if state is State.FLY and elapsed >= self.settings.seconds:
            events.append(Fault(Event.TIME_UP))
        if state in (State.LAND, State.DESCEND) and elapsed >= times.settled and self._stands():
            events.append(Fault(Event.TOUCHED_DOWN))
        if state is State.HOLD and self._back.update(all(fresh) and self._hears_again(), now):
            events.append(Fault(Event.RESUMED))
        flying = any(one.info & packets.FLYING for one in states) or not all(fresh)
        if state is State.STOP and elapsed >= times.stop and not flying:
            events.append(Fault(Event.GROUNDED))
        if elapsed >= self._limit(state):
            events.append(Fault(Event.TIMEOUT, f"{state.value} lasted {elapsed:.1f} s"))
        return events

    def _armed(self, states: list[DroneState]) -> bool:
        needed = packets.ARMED | packets.CAN_FLY
        return self.settings.dry_run or all(state.info & needed == needed for state in states)

    def _hears_again(self) -> bool:
        """True if a gap in the states began the hold, the laws were in command, and there were not too many gaps."""
        cause, held = self.supervisor.cause, self.supervisor.held
        guided = held is not None and held[0] in GUIDED and self._holds <= self.settings.limits.gaps + 1
        return guided and cause is not None and cause.event is Event.STALE and not any(link.lost for link in self.links)

    def _stands(self) -> bool:
        seen, times = self._last, self.settings.times
        if seen is None or not any(self._estimators.trusted):
            return False
        return seen.position[2] - self._origin[2] < times.near_ground and abs(seen.velocity[2]) < times.still

    def _limit(self, state: State) -> float:
        """How long a state may last [s]."""
        times = self.settings.times
        landing = (self._land_height + 0.3) / times.land_speed + times.land_spare
        known = {
            State.ARM: times.arm_limit,
            State.SPIN: times.spin_limit,
            State.RAMP: times.ramp + 1.0,
            State.FLY: self.settings.seconds + 1.0,
            State.LAND: landing,
            State.DESCEND: times.descend_limit,
            State.HOLD: self._hold_for,
            State.STOP: times.stop_limit,
            State.KILL: times.stop,
        }
        return known.get(state, math.inf)

    def _advance(self, faults: list[Fault], now: float, ages: list[float]) -> None:
        before = self.supervisor
        self.supervisor = before.after(faults, now)
        if self.supervisor.state is before.state:
            return
        entered = self.supervisor.state
        names = [f"{fault.event.name}: {fault.detail}" if fault.detail else fault.event.name for fault in faults]
        self.note("transition", now, before=before.state.value, after=entered.value, events=names)
        if entered is State.FLY and before.state is State.RAMP:
            self.controller.reset()
            self._commands = None
        if entered is State.LAND and before.state is not State.HOLD:
            seen = self._last or object_state(self._states(), self.rig)
            self._land_height = float(seen.position[2] - self._origin[2])
        if entered is State.DESCEND:
            self._shares = command.blind_shares(self._last_known_state(), 0.0, self.settings.period)
        if entered is State.HOLD:
            self._holds += 1
            self._back = Sustained(self.settings.limits.fresh)
            self._hold(faults, ages, now)

    def _hold(self, faults: list[Fault], ages: list[float], now: float) -> None:
        """Plan the time until a drone that may not hear is stopped by its own firmware."""
        age = max((value for value in ages if math.isfinite(value)), default=0.0)
        if any(fault.event is Event.UNHEARD for fault in faults):
            age = now - min(watch.heard for watch in self._uplinks if math.isfinite(watch.heard))
        self._hold_for = max(self.settings.times.drone_watchdog - age, 0.0)
        # Gently: a drone that does not hear keeps its thrust, and the other must not sink away from it.
        self._shares = command.blind_shares(self._last_known_state(), age, self.settings.period, command.GENTLE)

    # What is sent.

    def _wanted(self, mapped: list[Mapped] | None, now: float) -> list[Setpoint]:
        state, elapsed = self.supervisor.state, now - self.supervisor.since
        if state in GUIDED:
            return [one.setpoint for one in mapped] if mapped else list(self._sent)
        if state is State.SPIN:
            return [command.level(SPIN_THRUST)] * 2
        if state is State.RAMP:
            return [command.ramp(elapsed, self.settings.times, constants) for constants in self.maps]
        if state in (State.DESCEND, State.HOLD):
            return self._sinking(elapsed)
        return [ZERO, ZERO]

    def _sinking(self, elapsed: float) -> list[Setpoint]:
        """Both drones alike: braking sideways by what is measured; sinking by it in DESCEND, else by the clock."""
        seen, descends = self._last, self.supervisor.state is State.DESCEND
        known = seen is not None and any(self._estimators.trusted)
        tilt = (0.0, 0.0)
        if seen is not None and known and not (self.settings.stand or self._estimators.contradiction):
            tilt = command.brake(seen.velocity)
        if seen is not None and known and descends:
            share = command.sink(1.0, float(seen.velocity[2]), elapsed, self.settings.times)
        else:
            share = self._shares[min(int(elapsed / self.settings.period), len(self._shares) - 1)]
        return [command.level(share * trim, tilt) for trim in self._trims]

    def _transmit(self, wanted: list[Setpoint], now: float) -> None:
        state, elapsed, dry = self.supervisor.state, now - self.supervisor.since, self.settings.dry_run
        if state is State.RAMP:
            self._trims = [float(value.thrust) for value in wanted]
        elif state in GUIDED:
            parts = zip(self._trims, wanted, self.maps, strict=True)
            period = self.settings.period
            self._trims = [command.smoothed(trim, s.thrust, period, c.hover_thrust) for trim, s, c in parts]
        self._sent = wanted
        self.highest = [max(most, value.thrust) for most, value in zip(self.highest, wanted, strict=True)]
        sometimes = self._count % 10 == 0 and not dry
        for link, watch, value, own in zip(self.links, self._uplinks, wanted, self._states(), strict=True):
            if state is State.STOP and elapsed < self.settings.times.stop:
                link.command(packets.STOP)
            elif state is State.KILL and not dry:
                link.command(packets.EMERGENCY_STOP)
            if state in (State.STOP, State.DONE) and sometimes and not own.info & packets.AUTO_ARMED:
                link.command(packets.DISARM)  # its motors idle until then; one that arms itself would arm again
            elif state is State.ARM and sometimes:
                link.command(packets.ARM)
            link.send(packets.setpoint_packet(ZERO if dry else value))
            watch.sent(value.thrust, now)

    def _record(
        self, now: float, states: list[DroneState], ages: list[float], sent: list[Setpoint], late: float, missed: int
    ) -> None:
        goal = self.goal(now)
        laws = self._commands if self.supervisor.state in GUIDED else None
        fields = {} if laws is None else laws._asdict()
        self.note("tick", now, state=self.supervisor.state.value, goal=goal, sent=sent, ages=ages, late=late, **fields)
        self.view = View(now - self._start, self.supervisor, states, ages, goal, (sent[0], sent[1]), late, missed)
