"""One flight, tick by tick: states in, faults to the supervisor, setpoints out to both drones. No clock, no thread."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

from mjxball.fly import command, limits, maneuver, packets, pair
from mjxball.fly.command import CommandMap, Mapped
from mjxball.fly.contract import DroneLink, FlightSettings, Guard, Notes, View
from mjxball.fly.limits import Sustained
from mjxball.fly.maneuver import Glimpse
from mjxball.fly.packets import ZERO, DroneState, PacketError, Setpoint
from mjxball.fly.pilot import Commands, Pilot
from mjxball.fly.supervisor import AIRBORNE, BEFORE_MOTORS, GUIDED, Event, Fault, State, Supervisor


class Flight:
    """See the module. `tick` is called once per period until it returns false."""

    def __init__(
        self,
        links: Sequence[DroneLink],
        pilot: Pilot,
        maps: Sequence[CommandMap],
        rig: pair.Rig,
        settings: FlightSettings,
        notes: Notes,
        guard: Guard | None = None,
    ):
        self.links, self.pilot, self.maps, self.rig = links, pilot, maps, rig
        self.settings, self.notes, self.guard = settings, notes, guard
        self.supervisor = Supervisor()
        self.interrupts = 0
        self.kill = False
        self.ready: bool | None = None  # checks before flight: not known yet, passed, failed
        self.refusal = ""
        self.view: View | None = None
        self._sent: list[Setpoint] = [ZERO, ZERO]
        self._trims = [0.0 for _ in maps]  # thrust that hovers [units]: a running average of what was sent
        self._commands: Commands | None = None
        self._every = max(round(pilot.period / settings.period), 1)
        self._count = 0
        self._origin = np.zeros(3)
        self._start = 0.0
        self._low = [Sustained(settings.limits.battery_time) for _ in links]
        self._saturated = Sustained(settings.limits.saturation_time)
        self._hold_for = settings.times.drone_watchdog
        self._shares = [1.0]  # of the trims, tick by tick, in State.HOLD
        bounds = settings.limits
        self._hold_limits = dataclasses.replace(bounds, tilt=min(bounds.hold_tilt, bounds.tilt))
        self._land_height = 0.0
        self.worst_age = 0.0
        self.highest = [0, 0]  # thrust of each drone that was wanted [units]

    def begin(self, now: float) -> None:
        """Where the pair stands now is where it starts; both links must have a state."""
        self._start = now
        self._origin = pair.object_state(self._states(), self.rig).position
        self.supervisor = Supervisor(State.CHECK, now)

    def tick(self, now: float, late: float = 0.0, missed: int = 0, gap: float = 0.0) -> bool:
        """Everything that happens in one period; false once the flight is done.

        `late` [s] is this tick's, `missed` the deadlines missed within the last second, `gap` [s] the time since the
        tick before.
        """
        states, ages = self._states(), [link.telemetry.age(now) for link in self.links]
        self.worst_age = max(ages)
        faults = self._outside(now, ages, missed, gap)
        faults += self._from_states(states, [age <= self.settings.limits.state_age for age in ages], now)
        mapped, broken = self._guided(states, now)
        faults += broken + self._progress(states, now)
        self._advance(faults, now, ages, states)
        wanted = self._wanted(mapped, states, now)
        self._transmit(wanted)
        self._record(now, states, ages, wanted, late, missed)
        self._count += 1
        return self.supervisor.state is not State.DONE

    # What is wrong.

    def _states(self) -> list[DroneState]:
        samples = [link.telemetry.newest for link in self.links]
        return [sample.state for sample in samples if sample is not None]

    def _outside(self, now: float, ages: list[float], missed: int, gap: float) -> list[Fault]:
        bounds, faults = self.settings.limits, []
        if self.kill or self.interrupts > 1:
            faults.append(Fault(Event.KEY_KILL, "asked for on the laptop"))
        elif self.interrupts:
            faults.append(Fault(Event.INTERRUPT, "asked for on the laptop"))
        for name, link in zip(limits.NAMES, self.links, strict=True):
            if link.lost:
                faults.append(Fault(Event.LINK_LOST, f"{name}: {link.lost}"))
            elif link.stuck_for(now) > bounds.state_age:
                faults.append(Fault(Event.LINK_LOST, f"{name}: nothing can be sent"))
        faults += limits.age_faults(ages, bounds)
        if missed > bounds.missed_deadlines or gap > bounds.longest_gap:
            faults.append(Fault(Event.DEADLINES, f"{missed} missed in a second, longest gap {1000 * gap:.0f} ms"))
        if not self._beat():
            faults.append(Fault(Event.WATCHDOG))
        return faults

    def _beat(self) -> bool:
        """Tell the watchdog what it would take over; false if there is none any more."""
        if self.guard is None:
            return True
        return self.guard.beat(self.supervisor.state in AIRBORNE and not self.settings.dry_run, self._glimpse())

    def _glimpse(self) -> Glimpse:
        """What is known now of how the pair moves."""
        now = pair.object_state(self._states(), self.rig)
        trim = sum(self._trims)
        lift = maneuver.GRAVITY * (sum(sent.thrust for sent in self._sent) / trim - 1) if trim else 0.0
        trims = (round(self._trims[0]), round(self._trims[1]))
        return Glimpse(trims, float(now.position[2] - self._origin[2]), float(now.velocity[2]), lift)

    def _from_states(self, states: list[DroneState], fresh: list[bool], now: float) -> list[Fault]:
        armed = self.supervisor.state not in BEFORE_MOTORS and not self.settings.dry_run
        bounds = self._hold_limits if self.supervisor.state is State.HOLD else self.settings.limits
        faults = limits.state_faults(states, self._origin, self.rig.span, bounds, armed, fresh)
        for name, state, low in zip(limits.NAMES, states, self._low, strict=True):
            if low.update(state.battery < self.settings.limits.battery, now):
                faults.append(Fault(Event.BATTERY, f"{name} at {state.battery:.2f} V"))
        return faults

    # What the laws want.

    def _guided(self, states: list[DroneState], now: float) -> tuple[list[Mapped] | None, list[Fault]]:
        """Setpoints of both laws while they are in command, and what is wrong with them."""
        if self.supervisor.state not in GUIDED:
            return None, []
        try:
            if self._commands is None or self._count % self._every == 0:
                self._commands = self.pilot.step(pair.object_state(states, self.rig), self.goal(now))
            laws = (self._commands.leader, self._commands.follower)
            mapped = [
                command.to_setpoint(law, pair.yaw_of(state), last, self.settings.period, constants)
                for law, state, last, constants in zip(laws, states, self._sent, self.maps, strict=True)
            ]
        except (PacketError, ValueError, FloatingPointError) as error:
            return None, [Fault(Event.BAD_STATE, str(error))]
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

    def _progress(self, states: list[DroneState], now: float) -> list[Fault]:
        """Events of time and place."""
        state, elapsed, times = self.supervisor.state, now - self.supervisor.since, self.settings.times
        events = []
        if state is State.CHECK and self.ready is not None:
            events.append(Fault(Event.READY if self.ready else Event.REFUSED, self.refusal))
        if state is State.ARM and elapsed >= times.arm and self._armed(states):
            events.append(Fault(Event.ARMED))
        if state is State.RAMP and elapsed >= times.ramp:
            events.append(Fault(Event.HOVERING))
        if state is State.FLY and elapsed >= self.settings.seconds:
            events.append(Fault(Event.TIME_UP))
        if state in (State.LAND, State.DESCEND) and elapsed >= times.settled and self._stands(states):
            events.append(Fault(Event.TOUCHED_DOWN))
        if elapsed >= self._limit(state):
            events.append(Fault(Event.TIMEOUT, f"{state.value} lasted {elapsed:.1f} s"))
        return events

    def _armed(self, states: list[DroneState]) -> bool:
        needed = packets.ARMED | packets.CAN_FLY
        return self.settings.dry_run or all(state.info & needed == needed for state in states)

    def _stands(self, states: list[DroneState]) -> bool:
        now = pair.object_state(states, self.rig)
        times = self.settings.times
        return now.position[2] - self._origin[2] < times.near_ground and abs(now.velocity[2]) < times.still

    def _limit(self, state: State) -> float:
        """How long a state may last [s]."""
        times = self.settings.times
        landing = (self._land_height + 0.3) / times.land_speed + times.land_spare
        known = {
            State.ARM: times.arm_limit,
            State.RAMP: times.ramp + 1.0,
            State.FLY: self.settings.seconds + 1.0,
            State.LAND: landing,
            State.DESCEND: times.descend_limit,
            State.HOLD: self._hold_for,
            State.STOP: times.stop,
            State.KILL: times.stop,
        }
        return known.get(state, math.inf)

    def _advance(self, faults: list[Fault], now: float, ages: list[float], states: list[DroneState]) -> None:
        before = self.supervisor
        self.supervisor = before.after(faults, now)
        if self.supervisor.state is before.state:
            return
        entered = self.supervisor.state
        names = [f"{fault.event.name}: {fault.detail}" if fault.detail else fault.event.name for fault in faults]
        self.notes.note("transition", now, before=before.state.value, after=entered.value, events=names)
        if entered is State.FLY:
            self.pilot.reset()
            self._commands = None
        if entered is State.LAND:
            self._land_height = float(pair.object_state(states, self.rig).position[2] - self._origin[2])
        if entered is State.HOLD:
            age = max((value for value in ages if math.isfinite(value)), default=0.0)
            self._hold_for = max(self.settings.times.drone_watchdog - age, 0.0)
            # Gently: a drone that does not hear keeps its thrust, and the other must not sink away from it.
            self._shares = maneuver.blind_shares(self._glimpse(), age, self.settings.period, maneuver.GENTLE)

    # What is sent.

    def _wanted(self, mapped: list[Mapped] | None, states: list[DroneState], now: float) -> list[Setpoint]:
        state, elapsed = self.supervisor.state, now - self.supervisor.since
        if state in GUIDED:
            return [one.setpoint for one in mapped] if mapped else list(self._sent)
        if state is State.RAMP:
            return [maneuver.ramp(elapsed, self.settings.times, *part) for part in self._parts()]
        if state in (State.DESCEND, State.HOLD):
            return [self._sinking(number, states, elapsed) for number in range(2)]
        return [ZERO, ZERO]

    def _parts(self) -> list[tuple[CommandMap, Setpoint, float]]:
        return [(constants, sent, self.settings.period) for constants, sent in zip(self.maps, self._sent, strict=True)]

    def _sinking(self, number: int, states: list[DroneState], elapsed: float) -> Setpoint:
        thrust = self._trims[number]
        if self.supervisor.state is State.DESCEND:
            climb = float(pair.object_state(states, self.rig).velocity[2])
            thrust = maneuver.sink(thrust, climb, elapsed, self.settings.times)
        else:
            thrust *= self._shares[min(int(elapsed / self.settings.period), len(self._shares) - 1)]
        return maneuver.level(thrust, self._sent[number], self.settings.period, self.maps[number])

    def _transmit(self, wanted: list[Setpoint]) -> None:
        state, period = self.supervisor.state, self.settings.period
        if state is State.RAMP:
            self._trims = [float(value.thrust) for value in wanted]
        elif state in GUIDED:
            parts = zip(self._trims, wanted, self.maps, strict=True)
            self._trims = [maneuver.smoothed(trim, s.thrust, period, c.hover_thrust) for trim, s, c in parts]
        self._sent = wanted
        self.highest = [max(most, value.thrust) for most, value in zip(self.highest, wanted, strict=True)]
        for link, value in zip(self.links, wanted, strict=True):
            if state is State.STOP:
                link.command(packets.STOP)
            elif state is State.KILL and not self.settings.dry_run:
                link.command(packets.EMERGENCY_STOP)
            elif state is State.DONE and not self.settings.dry_run:
                link.command(packets.DISARM)
            elif state is State.ARM and not self.settings.dry_run and self._count % 10 == 0:
                link.command(packets.ARM)
            link.send(packets.setpoint_packet(ZERO if self.settings.dry_run else value))

    def _record(
        self, now: float, states: list[DroneState], ages: list[float], sent: list[Setpoint], late: float, missed: int
    ) -> None:
        goal = self.goal(now)
        laws = self._commands if self.supervisor.state in GUIDED else None
        fields = {} if laws is None else laws._asdict()
        self.notes.note(
            "tick", now, state=self.supervisor.state.value, goal=goal, sent=sent, ages=ages, late=late, **fields
        )
        self.view = View(now - self._start, self.supervisor, states, ages, goal, (sent[0], sent[1]), late, missed)
