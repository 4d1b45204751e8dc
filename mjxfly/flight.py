"""Control loop of one flight: states in, faults to the supervisor, setpoints to both drones. No clock, no thread."""

from __future__ import annotations

import collections
import math
import operator
from collections.abc import Callable, Sequence

import numpy as np

from mjxball.control import rotations
from mjxfly import packets, probe, setpoints
from mjxfly.controller import FlightController, PairCommands
from mjxfly.display import View
from mjxfly.ending import Ending
from mjxfly.figures import Flown
from mjxfly.lift import LiftWatch
from mjxfly.limits import FlightSettings
from mjxfly.mocap import Mocap
from mjxfly.monitor import Monitor, Sustained, UplinkWatch, link_faults
from mjxfly.packets import ZERO, PacketError, Setpoint
from mjxfly.preflight import SpinCheck
from mjxfly.setpoints import SPIN_THRUST, BoundedSetpoint, CommandMap, CurveName, LastKnownState, Variants
from mjxfly.supervisor import AIRBORNE, GUIDED, ON_GROUND, Event, Fault, FlightState, Supervisor
from mjxfly.takeoff import TakeOff
from mjxfly.telemetry import DroneLink, Note, ObjectState, Rig, object_state
from mjxfly.watchdog import Watchdog

HIDDEN_DECIMALS = 4  # of a GRU's state in the log, which holds it 50 times a second
# Within which the goal takes up its speed when landing begins, and leaves where it was before for where the pair is
# [s]. At 30 ms of delay a jump of the speed tilts `lqg` by 13 degrees, one of 0.17 m while it climbs by 26.
EASE = 0.8
LIFTED = 0.05  # [m] height of O, or half of the goal's if that is less, from which the pair counts as airborne


def landing_goal(elapsed: float, speed: float, start: float, before: float) -> tuple[float, float]:
    """Height of a landing's goal [m] and its rate [m/s], `elapsed` [s] after landing began.

    It sinks from `start`, where the pair was then, with a speed that grows evenly to `speed` within `EASE`. In that
    time it also comes from `before`, the height of the goal until then.
    """
    eased, above = min(elapsed, EASE), before - start
    share = eased / EASE
    sunk, left = speed * (elapsed - eased + eased * share / 2), above * (1 - share) ** 2 * (1 + 2 * share)
    return start - sunk + left, -speed * share - above * 6 * share * (1 - share) / EASE


class Flight:
    """State and control loop of a flight. Call `begin`, then `tick` once per period until it returns false."""

    def __init__(
        self,
        links: Sequence[DroneLink],
        controller: FlightController,
        variants: Sequence[Variants],
        assumed: Sequence[CurveName],
        rig: Rig,
        settings: FlightSettings,
        note: Note,
        watchdog: Watchdog | None = None,
        mocap: Mocap | None = None,
    ):
        """`variants` of leader and follower by force curve; `assumed` are the curves whose gains were uploaded."""
        self.links, self.controller, self.rig, self.settings = links, controller, rig, settings
        self.note, self.watchdog, self._mocap = note, watchdog, mocap
        self.flown = Flown()
        self.supervisor = Supervisor()
        self.interrupts, self.kill = 0, False
        self.ready: bool | None = None  # preflight checks: None not known yet, else whether they passed
        self.refusal = ""
        self.rehearsal_error: Callable[[Fault], Exception | None] = lambda cause: (
            None
        )  # error if a slow computer is to blame
        self.view: View | None = None
        self.spin = SpinCheck(links, variants, assumed, settings.motor)
        self.highest = [0, 0]  # largest thrust of each drone so far, sent or withheld in a dry run [units]
        self._sent: list[Setpoint] = [ZERO, ZERO]
        self._hover_scale = (1.0, 1.0)  # hover force of leader and follower over nominal, found at take-off
        self._trims = [0.0, 0.0]  # hover thrust [units]: a running average of the sent thrust
        self._commands: PairCommands | None = None
        self._every = max(round(controller.period / settings.period), 1)  # ticks per command
        self._count = 0
        self._monitor = Monitor(rig, settings)
        self._lift = LiftWatch(settings.motor)
        self.ending = Ending(settings, self._lifts_at)
        self._saturated = Sustained(settings.limits.saturation_time)
        self._recovered = Sustained(settings.limits.fresh)
        self._holds = 0
        self._hold_for = settings.times.drone_watchdog
        self._descend_for = settings.times.descent_limit(settings.goal[2])
        self._plan = [1.0]  # planned thrust over trim for each tick without a measured height
        self._land_height, self._goal_before = 0.0, 0.0
        self._heights = collections.deque([math.inf], round(settings.times.rest / settings.period) + 1)  # of O [m]
        self._highest_place = 0.0  # largest height of O above its start while the controllers are in command [m]
        self._take_off = TakeOff(rig, settings.times, settings.period, self._lifts_at, settings.stand)

    @property
    def maps(self) -> tuple[CommandMap, CommandMap]:
        """Command maps of leader and follower: their firmwares' force curves, scaled by `TakeOff.needed`."""
        leader, follower = (own.map.scaled(s) for own, s in zip(self.spin.chosen(), self._hover_scale, strict=True))
        return leader, follower

    @property
    def lifted(self) -> bool:
        """True if the pair has left the ground under its controllers, or if the goal is on the ground."""
        return self._highest_place >= self._lifts_at

    @property
    def flying(self) -> bool:
        """True while the pair may be in the air."""
        return self.supervisor.state in AIRBORNE and not self.settings.dry_run

    @property
    def _lifts_at(self) -> float:
        highest = LIFTED if self._mocap is None else probe.LIFTED
        return min(highest, self.settings.goal[2] / 2)

    @property
    def elapsed(self) -> float:
        """Time since the supervisor entered its state [s]."""
        return self._now - self.supervisor.since

    def begin(self, now: float) -> None:
        """Start the flight at `now` [s] from the pair's present position; both links must have a state."""
        self._read(now)
        self._start, self._monitor.origin = now, object_state(self._states, self.rig).position
        self.supervisor = Supervisor(FlightState.CHECK, now)

    def tick(self, now: float, late: float = 0.0, missed: int = 0, gap: float = 0.0) -> bool:
        """Do one period: read states, find faults, advance the supervisor, send, log. False once the flight is done.

        `late` [s] is the lateness of this tick, `missed` the number of deadlines missed in the last second, `gap` [s]
        the time since the previous tick.
        """
        self._read(now)
        faults = self._external_faults(missed, gap)
        faults += self._monitor.update(self.supervisor.state, self.links, self._ages, now)
        if self._mocap is not None and any(fault.event is Event.FRAME for fault in faults):
            self._mocap.halt()
        self._heights.append(self._height(self._object()))
        mapped, broken = self._command()
        self._advance(faults + broken + self._progress())
        self._note_ending(faults + broken, gap)
        wanted = self._setpoints(mapped)
        self._transmit(wanted)
        self._record(wanted, late, missed)
        self._count += 1
        return self.supervisor.state is not FlightState.DONE

    def _note_ending(self, faults: list[Fault], gap: float) -> None:
        self.ending.update(faults, self.supervisor, self._now, gap)
        if any(self._fresh) and self.supervisor.state not in ON_GROUND:
            seen = self._object()
            place, climb = seen.position - self._monitor.origin, float(seen.velocity[2])
            self.ending.touchdown.update(place, climb, self._now, self._distrust())

    def _distrust(self) -> str:
        """Why the pair's estimated state cannot be trusted, empty if it can."""
        fresh = [state for state, known in zip(self._states, self._fresh, strict=True) if known]
        if not all(rotations.tilt_of_quaternion(state.quaternion) <= self.settings.limits.tilt for state in fresh):
            return "it turned over"
        estimators = self._monitor.estimators
        believed = any(estimators.trusted) and not estimators.contradiction
        return "" if believed else "no estimator is believed"

    def how_it_ended(self) -> list[str]:
        """Sentences on why the flight ended and how the pair came down."""
        return self.ending.sentences(self.supervisor, self._start, asked=self.interrupts > 0)

    def _read(self, now: float) -> None:
        self._now = now
        self._states = [link.telemetry.newest.state for link in self.links if link.telemetry.newest is not None]
        self._ages = [link.telemetry.age(now) for link in self.links]
        self._fresh = [age <= self.settings.limits.state_age for age in self._ages]

    # Faults and events.

    def _external_faults(self, missed: int, gap: float) -> list[Fault]:
        """Faults and requests of user, links, control loop, motion capture, batteries and watchdog."""
        bounds, faults = self.settings.limits, []
        if self.kill or self.interrupts > 1:
            faults.append(Fault(Event.KEY_KILL, "asked for on the laptop"))
        elif self.interrupts:
            faults.append(Fault(Event.INTERRUPT, "asked for on the laptop"))
        # While this computer stalled it could not hear the links: do not count that time against them.
        idle = max(gap - self.settings.period, 0.0)
        faults += link_faults(self.links, [age - idle for age in self._ages], bounds, self._now - idle)
        if self._holds > bounds.gaps:
            faults.append(Fault(Event.GAPS, f"{self._holds} times"))
        if missed > bounds.missed_deadlines or gap > bounds.longest_gap:
            faults.append(Fault(Event.DEADLINES, f"{missed} missed in a second, longest gap {1000 * gap:.0f} ms"))
        if self._mocap is not None:
            faults += self._mocap.faults(self._now)
        if self.flying and all(self._fresh):
            volts, sinking = [state.battery for state in self._states], self.settings.times.descend_speed
            faults += self._lift.update(volts, self.maps, self._height(self._object()), sinking, self._now)
        # Also on the ground once motors turn: the loop may hang in the tick that begins the ramp.
        guarded = self.flying or (self.supervisor.state is FlightState.SPIN and not self.settings.dry_run)
        if self.watchdog is not None and not self.watchdog.beat(guarded, self._last_known_state()):
            faults.append(Fault(Event.WATCHDOG))
        return faults

    # Estimates.

    def _object(self) -> ObjectState:
        return self._monitor.object or object_state(self._states, self.rig)

    def _height(self, seen: ObjectState) -> float:
        """Height of O above where it stood [m]."""
        return float(seen.position[2] - self._monitor.origin[2])

    def _last_known_state(self) -> LastKnownState:
        seen, trim = self._object(), sum(self._trims)
        lift = setpoints.GRAVITY * (sum(sent.thrust for sent in self._sent) / trim - 1) if trim else 0.0
        trims = (round(self._trims[0]), round(self._trims[1]))
        return LastKnownState(trims, self._height(seen), float(seen.velocity[2]), lift)

    def _trusted(self) -> ObjectState | None:
        return self._monitor.object if any(self._monitor.estimators.trusted) else None

    def _landed(self) -> bool:
        """True if the pair is near the ground and has stopped sinking; without an estimate by the time of the plan."""
        seen, times = self._trusted(), self.settings.times
        if seen is None:  # no trusted estimate: assume it once the planned blind descent and a margin have passed
            return self.elapsed >= len(self._plan) * self.settings.period + times.settled
        low = self._height(seen) < times.near_ground and abs(seen.velocity[2]) < times.still
        return low and self._heights[0] - self._heights[-1] < times.rest_sunk

    def _is_airborne(self) -> bool:
        """True once the pair is off the ground, so that the controllers may take over."""
        seen = self._trusted()
        return self.settings.dry_run or (seen is not None and self._height(seen) >= self._lifts_at)

    # Control.

    def _command(self) -> tuple[list[BoundedSetpoint] | None, list[Fault]]:
        """Setpoints of both controllers, None while they are not in command; faults of these setpoints."""
        if self.supervisor.state not in GUIDED:
            return None, []
        try:
            seen = object_state(self._states, self.rig)
            if self.supervisor.state is FlightState.FLY:
                distance = float(np.linalg.norm(self.goal(self._now) - seen.position))
                nominal = [own.map.hover_thrust for own in self.spin.chosen()]
                one, other = (sent.thrust / hover for sent, hover in zip(self._sent, nominal, strict=True))
                tilt = rotations.tilt_of_quaternion(seen.quaternion)
                self.flown.update(self._now, self.elapsed, distance, tilt, (one, other))
            if self._commands is None or self._count % self._every == 0:
                goal = self.goal(self._now)
                if self.supervisor.state is FlightState.FLY:
                    self._goal_before = goal[2] - self._monitor.origin[2]
                self._commands = self.controller.step(seen, goal, self._goal_rate)
            commands = [own + self._probe() for own in (self._commands.leader, self._commands.follower)]
            mapped = [setpoints.to_setpoint(own, constants) for own, constants in zip(commands, self.maps, strict=True)]
        except (PacketError, ValueError, FloatingPointError) as error:
            return None, [Fault(Event.BAD_STATE, str(error))]
        self._highest_place = max(self._highest_place, self._height(seen))
        # A dry run never lifts, so the commanded thrust keeps rising.
        saturated = any(one.saturated for one in mapped) and not self.settings.dry_run
        if self._saturated.update(saturated, self._now):
            return mapped, [Fault(Event.SATURATED, f"for {self.settings.limits.saturation_time:g} s")]
        return mapped, []

    def goal(self, now: float) -> np.ndarray:
        """Goal of O (3,) at `now` [m]. While landing it sinks, to below the ground."""
        goal = self._monitor.origin + np.array(self.settings.goal)
        if self._probes:
            goal[2] = self._monitor.origin[2] + min(self.settings.goal[2], probe.HEIGHT)
        if self.supervisor.state is FlightState.LAND:
            goal[2] = self._monitor.origin[2] + max(self._landing(now)[0], -1.0)
        return goal

    @property
    def _goal_rate(self) -> np.ndarray | None:
        """Rate (3,) of the goal while it sinks [m/s]; an LQG that does not know it takes the lag for a load."""
        return np.array([0.0, 0.0, self._landing(self._now)[1]]) if self.supervisor.state is FlightState.LAND else None

    def _landing(self, now: float) -> tuple[float, float]:
        speed = self.settings.times.land_speed
        return landing_goal(now - self.supervisor.since, speed, self._land_height, self._goal_before)

    @property
    def carry(self) -> str:
        """In a dry run on motion capture: how to move the pair by hand, so that the IMUs can verify the axes."""
        return self._monitor.unverified_axes() if self._mocap is not None and self.settings.dry_run else ""

    @property
    def _probes(self) -> bool:
        """True at the beginning of FLY on motion capture: the measured axes are not verified yet."""
        return self._mocap is not None and self.supervisor.state is FlightState.FLY and self.elapsed < probe.TIME

    def _probe(self) -> np.ndarray:
        return probe.command(self.elapsed, self.rig.span) if self._probes else np.zeros(3)

    # State changes.

    def _progress(self) -> list[Fault]:
        """Planned events and timeouts of the supervisor's state."""
        state, elapsed, times, dry = self.supervisor.state, self.elapsed, self.settings.times, self.settings.dry_run
        can_fly, infos = packets.ARMED | packets.CAN_FLY, [one.info for one in self._states]
        armed = dry or all(info & can_fly == can_fly for info in infos)
        flying = any(info & packets.FLYING for info in infos) or not all(self._fresh)
        hindered = self._holds > self.settings.limits.gaps + 1 or any(link.lost for link in self.links)
        heard = all(self._fresh) and all(watch.hears for watch in self._monitor.uplinks)
        resumes = heard and self.supervisor.may_resume and not (hindered or self._landed())
        reached = {
            Event.ARMED: state is FlightState.ARM and elapsed >= times.arm and armed,
            Event.HOVERING: state is FlightState.RAMP and elapsed >= times.ramp and self._is_airborne(),
            Event.TIME_UP: state is FlightState.FLY and elapsed >= self.settings.seconds,
            Event.TOUCHED_DOWN: state in (FlightState.LAND, FlightState.DESCEND)
            and elapsed >= times.settled
            and self._landed(),
            Event.RESUMED: state is FlightState.HOLD and self._recovered.update(resumes, self._now),
            Event.GROUNDED: state is FlightState.STOP and elapsed >= times.stop and not flying,
        }
        events = [Fault(event) for event, is_reached in reached.items() if is_reached]
        if state is FlightState.CHECK and self.ready is not None:
            events.append(Fault(Event.READY if self.ready else Event.REFUSED, self.refusal))
        if state is FlightState.SPIN and elapsed >= times.spin:
            known = [Fault(Event.CURVE_KNOWN, "dry run")] if dry else None
            events += known or self.spin.update(self.supervisor.since + times.spin / 2, self._now, self.note)
        if elapsed >= self._limit(state):
            stuck = state is FlightState.RAMP and not self._is_airborne()
            text = self._stuck_message() if stuck else f"{state.value} lasted {elapsed:.1f} s"
            events.append(Fault(Event.TIMEOUT, text))
        return events

    def _stuck_message(self) -> str:
        return self._take_off.stuck(self.maps)

    def _limit(self, state: FlightState) -> float:
        """Longest duration of a state [s]."""
        times = self.settings.times
        landing = EASE + (self._land_height + 0.3) / times.land_speed + times.land_spare
        own = {FlightState.FLY: self.settings.seconds + 1.0, FlightState.LAND: landing}
        own |= {FlightState.HOLD: self._hold_for, FlightState.DESCEND: self._descend_for}
        return own.get(state, times.limits.get(state, math.inf))

    def _advance(self, faults: list[Fault]) -> None:
        before = self.supervisor
        self.supervisor = before.after(faults, self._now)
        if (
            self.supervisor.cause
            and not before.cause
            and (rehearsal_error := self.rehearsal_error(self.supervisor.cause))
        ):
            raise rehearsal_error
        entered = self.supervisor.state
        if entered is before.state:
            return
        names = [f"{fault.event.name}: {fault.detail}" if fault.detail else fault.event.name for fault in faults]
        self.note("transition", self._now, before=before.state.value, after=entered.value, events=names)
        if entered is FlightState.FLY and before.state is FlightState.RAMP:
            self.controller.reset()
            self._commands, self._hover_scale = None, self._take_off.needed([one.quaternion for one in self._states])
        if entered is FlightState.LAND:
            if before.state is not FlightState.HOLD:
                self._land_height = self._height(self._object())
            if before.state not in (FlightState.FLY, FlightState.HOLD):  # a hold goes on where it was
                self._goal_before = self._land_height
        if entered is FlightState.DESCEND:
            highest = max(filter(math.isfinite, self._heights), default=0.0)  # the newest height may be the fault
            self._descend_for = self.settings.times.descent_limit(highest)
            self._plan = setpoints.blind_shares(self._last_known_state(), 0.0, self.settings.period)
        if entered is FlightState.HOLD:
            self._hold(faults)

    def _hold(self, faults: list[Fault]) -> None:
        """Plan the thrust until the firmware of a drone that may not hear stops it."""
        self._holds += 1
        self._recovered = Sustained(self.settings.limits.fresh)
        age = max((value for value in self._ages if math.isfinite(value)), default=0.0)
        if any(fault.event in (Event.UNHEARD, Event.FROZEN) for fault in faults):
            heard = [watch.heard for watch in self._monitor.uplinks if math.isfinite(watch.heard)]
            age = self._now - min(heard, default=self._now)
        self._hold_for = max(self.settings.times.drone_watchdog - age, 0.0)
        # Gently: a drone that does not hear keeps its thrust, and the other must not descend much faster.
        self._plan = setpoints.blind_shares(self._last_known_state(), age, self.settings.period, setpoints.GENTLE)

    # Output.

    def _setpoints(self, mapped: list[BoundedSetpoint] | None) -> list[Setpoint]:
        """Setpoints of leader and follower in the supervisor's state; `mapped` are those of the controllers."""
        state = self.supervisor.state
        if state in GUIDED:
            return [one.setpoint for one in mapped] if mapped else list(self._sent)
        if state is FlightState.SPIN:
            return [setpoints.level(SPIN_THRUST)] * 2
        if state is FlightState.RAMP:
            rising = self._object()
            return self._take_off.wanted(self.elapsed, rising, self._height(rising), self.maps)
        if state not in (FlightState.DESCEND, FlightState.HOLD):
            return [ZERO, ZERO]
        # The same for both drones: brake sideways and sink by the measured velocity, by the plan if there is none.
        seen, tilt = self._trusted(), (0.0, 0.0)
        if state is FlightState.HOLD and not any(map(operator.and_, self._monitor.estimators.trusted, self._fresh)):
            seen = None  # no trusted estimate is fresh
        if seen is not None and not (self.settings.stand or self._monitor.estimators.contradiction):
            tilt = setpoints.brake(seen.velocity)
        if seen is not None and state is FlightState.DESCEND:
            share = setpoints.sinking_share(float(seen.velocity[2]), self.settings.times)
        elif seen is not None:
            share = setpoints.timed_share(self._height(seen), float(seen.velocity[2]), self._hold_for - self.elapsed)
        else:
            share = self._plan[min(int(self.elapsed / self.settings.period), len(self._plan) - 1)]
        shares = self._lift.shared(share, seen, self.rig) if state is FlightState.DESCEND else [share] * 2
        return [setpoints.level(one * trim, tilt) for one, trim in zip(shares, self._trims, strict=True)]

    def _transmit(self, wanted: list[Setpoint]) -> None:
        """Update the hover thrusts, and send setpoints and the commands of the supervisor's state."""
        state, dry = self.supervisor.state, self.settings.dry_run
        if state is FlightState.RAMP:
            rises = zip(wanted, self.maps, strict=True)
            self._trims = [min(float(s.thrust), setpoints.MOST_TRIM * c.hover_thrust) for s, c in rises]
        elif state in GUIDED:
            parts = zip(self._trims, wanted, self.maps, strict=True)
            period = self.settings.period
            self._trims = [setpoints.smoothed(trim, s.thrust, period, c.hover_thrust) for trim, s, c in parts]
        self._sent = wanted
        self.highest = [max(most, value.thrust) for most, value in zip(self.highest, wanted, strict=True)]
        sometimes = self._count % 10 == 0 and not dry
        for link, watch, value, own in zip(self.links, self._monitor.uplinks, wanted, self._states, strict=True):
            if state is FlightState.STOP and self.elapsed < self.settings.times.stop:
                link.command(packets.STOP)
            elif state is FlightState.KILL and not dry:
                link.command(packets.EMERGENCY_STOP)
            if state in (FlightState.STOP, FlightState.DONE) and sometimes and not own.info & packets.AUTO_ARMED:
                link.command(packets.DISARM)  # motors idle until disarmed; one that arms itself would arm again
            elif state is FlightState.ARM and sometimes:
                link.command(packets.ARM)
            self._send(link, watch, ZERO if dry else value)

    def _send(self, link: DroneLink, watch: UplinkWatch, value: Setpoint) -> None:
        watch.sent(value.thrust, self._now)
        link.send(packets.setpoint_packet(value))

    def _record(self, sent: list[Setpoint], late: float, missed: int) -> None:
        goal, state = self.goal(self._now), self.supervisor.state
        control = self._commands._asdict() if self._commands is not None and state in GUIDED else {}
        hidden = control.pop("hidden", None)
        if hidden is not None:
            control["hidden"] = np.round(hidden, HIDDEN_DECIMALS)
        self.note("tick", self._now, state=state.value, goal=goal, sent=sent, ages=self._ages, late=late, **control)
        shown = self._states, self._ages, (sent[0], sent[1]), late, missed
        self.view = View(self._now - self._start, self.supervisor, *shown, self.carry)
