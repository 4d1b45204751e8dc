"""What is watched in flight: estimators against each other, echoes of setpoints, the force curve of a firmware."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mjxball.control import motors, rotations
from mjxball.control.motors import MOTORS
from mjxfly import preflight, setpoints
from mjxfly.limits import Limits
from mjxfly.monitor import JUMP, EstimatorWatch, UplinkWatch, stick_faults
from mjxfly.packets import MOTORS as MOTOR_VARIABLES
from mjxfly.packets import VARIANCES, DroneState, Health, health_of
from mjxfly.supervisor import Event
from mjxfly.telemetry import Rig, Sample, object_of_one, object_state

RIG = Rig((0.0, 0.15, 0.0), (0.0, -0.15, 0.0))
WELL = Health((1e-5, 1e-5, 1e-5), (40000,) * 4, 40000.0)


def sample(number: int, time: float, position=(0.0, 0.0, 0.4), velocity=(0.0, 0.0, 0.0), roll=0.0, rates=(0, 0, 0)):
    """What an exact estimator of drone `number` reports of a stick with O at `position`."""
    quaternion = rotations.quaternion_from_euler(np.array([roll, 0.0, 0.0]))
    matrix, mount = rotations.matrix_from_quaternion(quaternion), RIG.mounts[number]
    turning = np.array(rates, float)
    place = np.array(position) + matrix @ mount
    speed = np.array(velocity) + matrix @ np.cross(turning, mount)
    return Sample(DroneState(place, speed, quaternion, turning, 0, 3.9), time, time)


def spoiled(one: Sample, offset) -> Sample:
    return one._replace(state=one.state._replace(position=one.state.position + np.array(offset)))


def test_one_drone_gives_the_object_as_both_do() -> None:
    given = {"position": (0.1, -0.2, 0.5), "velocity": (0.3, 0.1, -0.2), "roll": 0.2, "rates": (0.5, -0.3, 0.1)}
    states = [sample(number, 0.0, **given).state for number in range(2)]
    for state, mount in zip(states, RIG.mounts, strict=True):
        for alone, both in zip(object_of_one(state, mount), object_state(states, RIG), strict=True):
            np.testing.assert_allclose(alone, both, atol=1e-12)


def test_a_pair_that_flies_wildly_but_measures_well_is_believed() -> None:
    """Swings of 0.5 rad at 2 rad/s with 1 m/s, heights 1 cm off: nothing to say."""
    watch = EstimatorWatch(RIG)
    for step in range(400):
        time = 0.01 * step
        roll, rate = 0.5 * math.sin(2 * time), math.cos(2 * time)
        place, speed = (0.0, math.sin(time), 0.4), (0.0, math.cos(time), 0.0)
        seen = [sample(n, time, place, speed, roll, (rate, 0.0, 0.0)) for n in range(2)]
        seen[0] = spoiled(seen[0], (0.0, 0.0, 0.01))
        assert watch.update(seen, [WELL, WELL], time) == []
    assert watch.trusted == [True, True]


def test_a_jump_is_found_at_once_and_the_other_drone_is_flown_by() -> None:
    watch = EstimatorWatch(RIG)
    before = [sample(n, 0.0) for n in range(2)]
    assert watch.update(before, [WELL, WELL], 0.0) == []
    after = [spoiled(sample(0, 0.01), (0.0, 0.0, 0.4)), sample(1, 0.01)]
    faults = watch.update(after, [WELL, WELL], 0.01)
    assert [fault.event for fault in faults] == [Event.ESTIMATOR]
    assert "leader" in faults[0].detail
    np.testing.assert_allclose(watch.object(after, [True, True]).position, [0.0, 0.0, 0.4], atol=1e-12)
    assert watch.object(after, [True, False]) is None  # the one that is heard is not believed


def test_motion_at_the_reported_velocity_is_no_jump() -> None:
    """1.2 m/s over a gap of 80 ms: 96 mm, more than a jump; but not for an estimate that claims the other way."""
    assert JUMP < 1.2 * 0.08
    for velocity, trusted in ((1.2, True), (-1.2, False)):
        watch = EstimatorWatch(RIG)
        for time in (0.0, 0.08):
            seen = [sample(n, time, (1.2 * time, 0.0, 0.4), (velocity, 0.0, 0.0)) for n in range(2)]
            watch.update(seen, [WELL, WELL], time)
        assert watch.trusted == [trusted, trusted]


def test_two_drones_are_as_far_apart_as_their_stick_is_long() -> None:
    """A stick of 0.3 m; 0.1 m and 30 degrees are allowed."""
    for along, up, wrong in (
        (0.30, 0.0, ""),
        (0.21, 0.0, ""),
        (0.39, 0.0, ""),
        (0.19, 0.0, "0.19 m apart"),
        (0.41, 0.0, "0.41 m apart"),
        (0.25, 0.16, "tilts 32 degrees"),
        (0.25, -0.16, "tilts 32 degrees"),
    ):
        states = [sample(number, 0.0).state for number in range(2)]
        leader = states[1].position + np.array([0.0, along, up])
        faults = stick_faults([states[0]._replace(position=leader), states[1]], RIG.span, Limits())
        assert [fault.event for fault in faults] == ([Event.STICK] if wrong else []), (along, up)
        assert all(wrong in fault.detail for fault in faults)


def test_a_variance_that_grows_is_found() -> None:
    watch = EstimatorWatch(RIG)
    seen = [sample(n, 0.0) for n in range(2)]
    blind = WELL._replace(variance=(1e-5, 1e-5, 1.1 * Limits().variance))
    assert [fault.event for fault in watch.update(seen, [WELL, blind], 0.0)] == [Event.ESTIMATOR]
    assert watch.trusted == [True, False]
    sideways = WELL._replace(variance=(1.0, 1.0, 1e-5))
    assert EstimatorWatch(RIG, sideways=False).update(seen, [sideways, sideways], 0.0) == []


def test_a_frozen_height_is_found_when_the_pair_moves_and_the_lower_one_counts() -> None:
    watch, found = EstimatorWatch(RIG), []
    frozen = sample(0, 0.0).state
    for step in range(200):
        time = 0.01 * step
        seen = [sample(n, time, (0.0, 0.0, 0.4 - 0.2 * time), (0.0, 0.0, -0.2)) for n in range(2)]
        seen[0] = seen[0]._replace(state=frozen)
        found += [(time, fault) for fault in watch.update(seen, [WELL, WELL], time)]
        if found:
            break
    # 5 cm at 0.2 m/s take 0.25 s, and must last as long.
    assert found[0][0] == pytest.approx(0.5, abs=0.05)
    seen_now = watch.object(seen, [True, True])
    assert seen_now.position[2] == pytest.approx(seen[1].state.position[2])
    assert seen_now.velocity[2] == pytest.approx(-0.2)


def flown(echo, seconds: float = 3.0, jitter: float = 0.0) -> list[float]:
    """Times at which a drone counts as not hearing; `echo(time, sent)` is the thrust that it reports."""
    watch, sent, found = UplinkWatch("leader"), {}, []
    for step in range(round(seconds * 100)):
        time = 0.01 * step
        sent[step] = 40000 + round(300 * math.sin(3 * time)) + step % 7
        watch.sent(sent[step], time)
        if step % 5 == 4:
            late = step - 3 - round(10 * jitter * (step % 3))
            health = WELL._replace(thrust=float(echo(time, sent.get(late, 40000))))
            found += [time] * bool(watch.update(health, time))
    return found


def test_a_drone_that_acts_on_what_it_was_sent_is_heard() -> None:
    assert flown(lambda time, sent: sent) == []
    assert flown(lambda time, sent: sent, jitter=1.0) == []
    assert flown(lambda time, sent: math.nan) == []  # a firmware that does not report it


def test_a_drone_that_stopped_listening_is_found_within_the_firmwares_half_second() -> None:
    held = {}

    def deaf(time: float, sent: float) -> float:
        return sent if time < 1.0 else held.setdefault("thrust", sent)

    # The echo is too old after 0.3 s, and four packets of 50 ms must miss it.
    assert 1.2 < flown(deaf)[0] < 1.6


def heard(sent, echo) -> tuple[bool, bool]:
    """Whether a drone counted as hearing for 3 s, and at their end; `sent` and `echo` by the number of the tick."""
    watch, lost = UplinkWatch("leader"), False
    for step in range(300):
        watch.sent(sent(step), 0.01 * step)
        if step % 5 == 4:
            lost = bool(watch.update(WELL._replace(thrust=float(echo(step))), 0.01 * step)) or lost
    return not lost, watch.hears


def test_a_thrust_that_stands_still_is_heard_where_it_is_what_was_sent() -> None:
    """At its bound, with a dip now and then that no echo shows, a drone that hears was "not sent lately"."""

    def dips(step: int) -> int:
        return 60000 - 500 * (step % 5 == 0)

    assert heard(dips, lambda step: 60000) == (True, True)
    assert heard(dips, lambda step: 52000) == (False, False)
    # Sent once more by chance, a moment ago; what is sent now stands still as well.
    assert heard(lambda step: 45000 if step < 285 else 40000, lambda step: 45000) == (True, False)


@pytest.mark.parametrize("name", ["2.1", "thrust-upgrade", "brushless"])
@pytest.mark.parametrize("battery", [3.3, 3.7, 4.2])
def test_both_firmwares_are_told_apart_by_their_pwm(name: str, battery: float) -> None:
    motor, sent = MOTORS[name], float(setpoints.SPIN_THRUST)
    pwm = float(motors.compensated(motor, np.float64(sent), np.float64(battery)))
    turned = np.array([1.0, -1.0, 1.0, -1.0]) * 800  # yaw and roll at work do not matter
    compensates = Health((0, 0, 0), tuple((pwm + turned).astype(int)), sent)
    plain = Health((0, 0, 0), tuple((sent + turned).astype(int)), sent)
    assert preflight.recognise(compensates, battery, motor) == "linear"
    assert preflight.recognise(plain, battery, motor) == "older"
    # A voltmeter that is 3 % off changes nothing.
    assert preflight.recognise(compensates, 1.03 * battery, motor) == "linear"
    assert preflight.recognise(Health((0, 0, 0), (0, 0, 0, 0), sent), battery, motor) is None


def test_health_is_read_from_whichever_variables_there_are() -> None:
    variance = {name: 0.1 for name, _ in VARIANCES}
    for names in MOTOR_VARIABLES:
        values = variance | {name: 7.0 for name, _ in names} | {"controller.cmd_thrust": 9.0}
        assert health_of(values) == Health((0.1, 0.1, 0.1), (7, 7, 7, 7), 9.0)
    bare = health_of(variance)
    assert bare.motors == (0, 0, 0, 0)
    assert math.isnan(bare.thrust)
