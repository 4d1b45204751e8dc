"""Lost uplinks, batteries that give way, reboots: the coupled pair in virtual time, by its true state."""

from __future__ import annotations

import functools
import math
from pathlib import Path

import numpy as np
import pytest
from fly_virtual import VirtualTwin as StandInTwin
from tables import rows, weekly

from mjxball.control import motors
from mjxball.control.motors import MOTORS
from mjxball.policy import Policy, load_file
from mjxball.policy.file import shipped_policy
from mjxfly.lift import ALL, BRAKING, LiftWatch
from mjxfly.limits import FlightSettings
from mjxfly.policy_setup import command_maps, config_of, load_follower
from mjxfly.setpoints import CommandMap
from mjxfly.supervisor import Event, FlightState
from mjxfly.telemetry import ObjectState, Rig
from mjxfly.twin.conditions import FAULT_KINDS, Surroundings
from virtual_twin import MemoryLog, TrueState, VirtualTwin

FLIGHT = shipped_policy("flight")
HEIGHT = 0.4  # [m] of the hover
G = 9.81


def hovering(seconds: float = 20.0, height: float = HEIGHT, flown: float = 3.0) -> VirtualTwin:
    """The pair of `lqg`, `flown` seconds under both controllers."""
    pytest.importorskip("mujoco")
    settings = FlightSettings(seconds, (0.0, 0.0, height))
    world = VirtualTwin(load_follower(Path("lqg")), settings, log=MemoryLog(False), settle=1.0)
    world.fly_until(FlightState.FLY)
    world.fly_for(flown)
    return world


def after(world: VirtualTwin, kind: str, *drones: int) -> list[TrueState]:
    """What came of a fault `kind` of some drones, until all is off."""
    for drone in drones:
        world.drones[drone].inject(FAULT_KINDS[kind].what)
    begin = len(world.track)
    world.run(15.0)
    assert not any(world.running())
    return world.track[begin:]


def cut(track: list[TrueState]) -> TrueState:
    """The first moment at which no motor turns."""
    return next(moment for moment in track if moment.pwm.max() == 0)


@pytest.mark.slow
@pytest.mark.parametrize("drone", [1, *weekly(0)])
def test_both_stand_before_the_firmware_cuts_a_drone_that_hears_nothing(drone: int) -> None:
    """It was found after 0.5 s, the plan thought that both sink, and the follower was cut at 0.2 m: 1.9 m/s."""
    world = hovering()
    began = world.now
    track = after(world, "silent-up", drone)
    held = next(moment for moment in track if moment.state == "hold")
    assert held.time - began < 0.3  # four health packets, 50 ms apart, and the one before them
    assert world.flight.supervisor.cause.event is Event.UNHEARD
    assert cut(track).time - began == pytest.approx(2.0, abs=0.06)
    assert cut(track).position[2] - world.rest < 0.02  # the lighter end of the stick may be up by twice as much
    assert world.touchdown_speed() < 0.6
    assert max(moment.tilt for moment in track) < math.radians(10)


@pytest.mark.slow
@pytest.mark.parametrize("first", [0, *weekly(1)])
def test_uplinks_lost_one_soon_after_the_other_leave_the_stick_level(first: int) -> None:
    """0.3 s apart: the first loss was noticed after the second, both hovered, and 0.3 s between the firmwares' cuts
    turned the stick over. Noticed before, the second keeps a thrust by which both are down first.
    """
    world = hovering()
    world.drones[first].inject(FAULT_KINDS["silent-up"].what)
    world.fly_for(0.3)
    track = after(world, "silent-up", 1 - first)
    assert max(moment.tilt for moment in track) < math.radians(30)
    assert world.touchdown_speed() < 0.8


@pytest.mark.slow
def test_poses_that_freeze_one_after_the_other_leave_no_thrust_on_the_ground() -> None:
    """The second one was not watched in a descent: it went on by an estimate that stood still, 0.81 m/s at the ground,
    and motors at 0.9 of hover for 3 s on it.
    """
    world = hovering()
    began = world.now
    world.drones[0].inject(FAULT_KINDS["pose-frozen"].what)
    world.fly_for(0.03)
    track = after(world, "pose-frozen", 1)
    assert world.touchdown_speed() < 0.7
    assert cut(track).time - began < 2.5
    assert "no estimator is believed" in world.flight.how_it_ended()[-1]


@pytest.mark.slow
def test_an_estimate_that_fails_later_still_leads_down() -> None:
    """The blind way down began in its middle: motors cut in the air, 3.5 m/s, or 3.1 s of thrust on the ground."""
    for height, flown, first, later, second in (
        (1.2, 0.8, "pose-frozen", 0.3, "pose-frozen"),
        (0.4, 1.94, "pose-jump", 0.33, "pose-lost"),
    ):
        world = hovering(height=height, flown=flown)
        world.drones[0].inject(FAULT_KINDS[first].what)
        world.fly_for(later)
        track = after(world, second, 1)
        assert world.touchdown_speed() < 0.6, first
        assert cut(track).position[2] - world.rest < 0.02, first
        stood = next(moment.time for moment in track if moment.position[2] - world.rest < 0.01)
        assert cut(track).time - stood < 1.7, first


@pytest.mark.slow
def test_a_hold_is_not_flown_by_what_was_measured_a_moment_ago() -> None:
    """One estimate stands still, the other one's clock does: motors were cut 9 cm above the ground."""
    pytest.importorskip("mujoco")
    settings, around = FlightSettings(3.0, (0.0, 0.0, 0.15)), Surroundings(seed=884, delay=0.03)
    world = VirtualTwin(load_follower(Path("lqg")), settings, surroundings=around, log=MemoryLog(False), settle=0.3)
    world.fly_until(FlightState.FLY)
    world.fly_for(0.48)
    world.drones[0].inject(FAULT_KINDS["frozen"].what)
    world.fly_for(0.59)
    assert cut(after(world, "clock", 1)).position[2] - world.rest < 0.02


def test_a_descent_has_the_time_that_its_height_asks() -> None:
    """4 s were left for it, whatever the height: from 1.6 m the motors were cut in the air."""
    for height, seconds in ((0.0, 4.0), (0.4, 4.0), (1.6, 8.0)):
        assert FlightSettings().times.descent_limit(height) == pytest.approx(seconds, abs=0.05)


@pytest.mark.slow
def test_a_dead_imu_is_told_as_one() -> None:
    """It was "unheard": the log goes on with fresh stamps, and nothing in it moves."""
    world = hovering()
    after(world, "imu", 0)
    cause = world.flight.supervisor.cause
    assert cause.event is Event.FROZEN
    assert "leader" in cause.detail
    told = world.flight.how_it_ended()
    assert "turned over" in told[-1]
    assert "m/s" not in told[-1]


@pytest.mark.slow
def test_an_uplink_that_comes_back_is_flown_through() -> None:
    world = StandInTwin(FlightSettings(seconds=6.0))
    world.fly_until(FlightState.FLY)
    world.fly_for(2.0)
    for silent in (True, False):
        world.fault_link(1, silent_up=silent)
        world.fly_for(0.35)
    world.fly_until(FlightState.DONE)
    assert world.log.transitions() == ["arm", "spin", "ramp", "fly", "hold", "fly", "land", "stop", "done"]
    assert world.flight.supervisor.cause is None


@functools.cache
def carried() -> CommandMap:
    """What a drone of `flight` lifts."""
    return command_maps(config_of(load_file(FLIGHT).metadata))[0]


def lift(voltage: float) -> float:
    """Share of its weight that a drone of `flight` lifts at full power and `voltage` [V]."""
    own = carried()
    full = 4 * motors.force(MOTORS["2.1"], np.float64(motors.FULL), np.float64(voltage))
    return float(full) / (own.carried_mass * own.gravity)


@pytest.mark.slow
def test_a_battery_that_fades_is_noticed_before_lift_is_lost() -> None:
    """0.5 V/s: from 3.85 V in hover there are two seconds until full power does not carry."""
    world = hovering()
    track = after(world, "fade", 1)
    assert world.flight.supervisor.cause.event is Event.LIFT
    flown = [moment for moment in track if moment.position[2] > world.rest + 0.01]
    assert min(lift(moment.battery) for moment in flown) > 1.0
    assert world.touchdown_speed() < 0.6
    assert max(moment.tilt for moment in track) < math.radians(5)


@pytest.mark.slow
@pytest.mark.parametrize("drones", [(0, 1), *weekly((1,))])
def test_a_battery_that_gives_way_at_once_lets_the_pair_fall_level(drones: tuple[int, ...]) -> None:
    """Thrust for 0.85 of the weight is left, and nothing cushions that; one drone alone turned the stick over."""
    world = hovering()
    began = world.now
    track = after(world, "sag", *drones)
    assert world.flight.supervisor.cause.event is Event.LIFT
    assert next(moment for moment in track if moment.state == "descend").time - began < 0.1
    left = min(lift(moment.battery) for moment in track)
    assert 0.75 < left < 0.95
    # A fall under what is left; a weak drone alone spends a tenth of its thrust on its attitude.
    left -= 0.1 if len(drones) == 1 else 0.02
    assert world.touchdown_speed() < 1.1 * math.sqrt(2 * G * (1 - left) * HEIGHT)
    assert max(moment.tilt for moment in track) < math.radians(10)


@pytest.mark.slow
@pytest.mark.parametrize("drones", [(0, 1), *weekly((1,))])
def test_voltages_that_read_wrongly_low_do_not_make_a_descent_climb(drones: tuple[int, ...]) -> None:
    """Both were given all power, and rose to 17 m."""
    world = hovering()
    track = after(world, "battery", *drones)
    assert world.flight.supervisor.cause.event is Event.LIFT
    assert max(moment.position[2] for moment in track) - world.rest < HEIGHT + 0.1
    assert world.touchdown_speed() < 0.6
    assert max(moment.tilt for moment in track) < math.radians(12)


# Voltage of one battery at a time [s]; where lift is lost, how long before or after that it is said at least [s].
BEFORE, AFTER = 1.0, -0.05  # a battery that fades, one that gives way at once
BATTERIES = [
    (lambda t: 3.85, None),
    (lambda t: 3.15, None),  # low, which is not the same
    (lambda t: 3.6 + 0.03 * math.sin(60 * t), None),  # noise, a propeller
    (lambda t: 3.5 - (0.12 if t > 1 else 0.0), None),  # a step of the load
    (lambda t: 3.3 - 0.01 * t, None),
    (lambda t: 3.85 - 0.5 * max(t - 0.5, 0.0), BEFORE),
    (lambda t: 3.2 - 0.25 * max(t - 0.5, 0.0), BEFORE),
    (lambda t: 3.85 if t < 1.0 else 2.6, AFTER),
    (lambda t: 2.85, BEFORE),  # it carries as long as it keeps that, and no longer
]


@rows("voltage, spare", BATTERIES)
def test_lift_is_in_danger_where_the_voltage_says_so(voltage, spare: float | None) -> None:
    maps = command_maps(config_of(load_file(FLIGHT).metadata))
    watch, found = LiftWatch(MOTORS["2.1"]), []
    for number in range(200):
        now = 0.01 * number
        faults = watch.update([3.8, voltage(now)], maps, HEIGHT, 0.4, now)
        found += [(now, fault) for fault in faults]
    assert bool(found) is (spare is not None)
    if spare is not None:
        assert {fault.event for _, fault in found} == {Event.LIFT}
        assert all(fault.detail.startswith("follower") for _, fault in found)
        assert watch.share == pytest.approx(lift(voltage(1.97)), rel=0.01)
        gone = next((0.01 * n for n in range(1000) if lift(voltage(0.01 * n)) < 1), math.inf)
        assert gone - found[0][0] >= spare


def test_a_pair_without_lift_that_climbs_has_lift() -> None:
    watch = LiftWatch(MOTORS["2.1"])
    rig = Rig((0.0, 0.15, 0.0), (0.0, -0.15, 0.0))
    maps = command_maps(config_of(load_file(FLIGHT).metadata))
    for number in range(5):
        watch.update([2.6, 2.6], maps, HEIGHT, 0.4, 0.01 * number)
    seen = ObjectState(np.zeros(3), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3))
    assert watch.shared(0.98, seen, rig) == [ALL, ALL]
    for speed, shares in ((0.2, [ALL, ALL]), (0.3, [0.98, 0.98]), (-0.4, [0.98, 0.98])):
        rising = seen._replace(velocity=np.array([0.0, 0.0, speed]))
        assert watch.shared(0.98, rising, rig) == shares


def test_without_lift_the_stick_leans_against_its_motion() -> None:
    """The end behind gives less, so that the pair leans back; across the stick the drones brake by themselves."""
    watch = LiftWatch(MOTORS["2.1"])
    rig = Rig((0.0, 0.15, 0.0), (0.0, -0.15, 0.0))
    for number in range(5):
        watch.update([2.6, 2.6], command_maps(config_of(load_file(FLIGHT).metadata)), HEIGHT, 0.4, 0.01 * number)
    turned = np.array([math.cos(0.25 * math.pi), 0.0, 0.0, math.sin(0.25 * math.pi)])  # the stick along -x
    for quaternion, toward in ((np.array([1.0, 0.0, 0.0, 0.0]), (0.0, 1.0, 0.0)), (turned, (-1.0, 0.0, 0.0))):
        seen = ObjectState(np.zeros(3), np.zeros(3), quaternion, np.zeros(3))
        leader, follower = watch.shared(0.98, seen._replace(velocity=np.array(toward)), rig)
        assert (leader, follower) == (ALL, pytest.approx(ALL - BRAKING))
        leader, follower = watch.shared(0.98, seen._replace(velocity=-np.array(toward)), rig)
        assert (leader, follower) == (pytest.approx(ALL - BRAKING), ALL)
        across = np.array(toward)[[1, 0, 2]]
        assert watch.shared(0.98, seen._replace(velocity=across), rig) == pytest.approx([ALL, ALL])


@pytest.mark.parametrize(
    ("shares", "wanted", "given"),
    [
        ((1.03, 1.5), 0.9, [0.9, 0.9]),  # it can give that
        ((1.03, 1.5), 1.02, [ALL, 1.02]),
        ((1.03, 1.5), 1.1, [ALL, 1.03]),
        ((0.85, 1.08), 1.1, [ALL, 0.85]),  # no more than the weak one, or the stick turns over
        ((0.85, 0.9), 1.1, [ALL, ALL]),
    ],
)
def test_a_weak_drone_gets_full_thrust_where_it_cannot_give_what_is_wanted(shares, wanted: float, given: list) -> None:
    watch = LiftWatch(MOTORS["2.1"])
    watch.shares = list(shares)
    assert watch.shared(wanted, None, Rig((0.0, 0.15, 0.0), (0.0, -0.15, 0.0))) == given


@pytest.mark.slow
@pytest.mark.parametrize("drone", [0, 1])
def test_a_battery_that_gives_way_leaves_the_pair_where_it_is(drone: int) -> None:
    """It leaned by 8 degrees and was 7 to 11 m away when it touched down; later it hardly sank while lift was left."""
    world = hovering()
    before, began = world.state.position.mean(axis=0), world.now
    world.drones[drone].inject(FAULT_KINDS["battery"].what)
    world.run(20.0)
    assert world.flight.supervisor.cause.event is Event.LIFT
    assert float(np.linalg.norm((world.state.position.mean(axis=0) - before)[:2])) < 2.0
    assert world.touchdown_speed() < 0.6
    down = next(moment.time for moment in world.track if moment.time > began and moment.state == "stop")
    assert down - began < 2.5


@pytest.mark.slow
def test_a_slow_landing_is_not_over_before_the_pair_rests() -> None:
    """Below 4 cm it sank no faster than what counts as standing, and fell from there at 0.7 m/s."""
    policy = Policy.load(shipped_policy("stand"))
    world = VirtualTwin(policy, FlightSettings(4.0, (0.0, 0.0, 0.08), stand=True), log=MemoryLog(False), settle=1.0)
    for number in range(2):
        if number:
            world.track.clear()
            world.next_flight(pause=1.5)
        world.run(40.0)
        assert world.flight.supervisor.cause is None
        assert world.touchdown_speed() < 0.25


@pytest.mark.slow
def test_flights_in_a_row_with_reboots_between_them() -> None:
    """Four, a drone reboots before every other one."""
    world = hovering(1.0)
    for number in range(4):
        if number:
            world.track.clear()
            if number % 2:
                world.drones[1].reboot()
            world.next_flight(pause=1.5)
        world.run(60.0)
        assert world.flight.supervisor.cause is None, number
        assert world.flight.lifted
        assert world.touchdown_speed() < 0.5


@pytest.mark.slow
def test_a_landing_that_begins_in_the_climb_does_not_tilt_the_pair() -> None:
    """The goal jumped from 0.4 m to where the pair was: `lqg` tilted by 26 degrees and slid half a metre."""
    world = hovering(1.0, flown=0.0)
    world.run(60.0)
    assert world.flight.supervisor.cause is None
    flown = [moment for moment in world.track if moment.state in ("fly", "land")]
    assert max(moment.tilt for moment in flown) < math.radians(5)
    assert max(np.hypot(*moment.position[:2]) for moment in flown) < 0.1
