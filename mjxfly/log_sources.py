"""Topics and log variables that are read from recordings of other programs, with units and signs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

HEADER, RECORD = "header", "record"  # last parts of the topics with the lines of our own flight log
RADIAN = math.pi / 180  # [rad] per degree

Samples = tuple[np.ndarray, np.ndarray]  # (n,) [s], (n, k)
Series = dict[str, dict[str, Samples]]  # by drone and quantity
Part = tuple[str, Any, dict[str, Any]]  # drone, "" for that in the topic's name; header or None; values by quantity
WIDTHS = {"position": 3, "quaternion": 4, "velocity": 3, "along": 3, "rates": 3, "sent": 4, "battery": 1}


class Topic(NamedTuple):
    """Readers of topics by the last part of their name, as in `/cf1/pose`; the part before it is the drone."""

    type: str
    text: str
    take: Callable[[Any], Iterator[Part]]


class Variable(NamedTuple):
    """A log variable of the firmware: times `factor` it is component `place` of a quantity."""

    quantity: str
    place: int
    factor: float


def _place(position: Any, turned: Any) -> dict[str, Any]:
    return {"position": _xyz(position), "quaternion": (turned.w, *_xyz(turned))}


def _xyz(vector: Any) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z


def _pose(one: Any) -> Iterator[Part]:
    yield "", one.header, _place(one.pose.position, one.pose.orientation)


def _odometry(one: Any) -> Iterator[Part]:
    pose, moving = one.pose.pose, one.twist.twist
    moves = {"velocity": _xyz(moving.linear), "rates": _xyz(moving.angular)}
    yield "", one.header, {**_place(pose.position, pose.orientation), **moves}


def _transforms(one: Any) -> Iterator[Part]:
    for each in one.transforms:
        yield each.child_frame_id, each.header, _place(each.transform.translation, each.transform.rotation)


def _twist(one: Any) -> Iterator[Part]:
    yield "", one.header, {"along": _xyz(one.twist.linear), "rates": _xyz(one.twist.angular)}


def _gyroscope(one: Any) -> Iterator[Part]:
    yield "", one.header, {"rates": tuple(RADIAN * float(value) for value in one.values)}


def _legacy(one: Any) -> Iterator[Part]:
    thrust = min(max(one.linear.z, 0.0), 60000.0)
    yield "", None, {"sent": (one.linear.y, -one.linear.x, one.angular.z, thrust)}


def _setpoint(one: Any) -> Iterator[Part]:
    yield "", one.header, {"sent": (one.roll, one.pitch, one.yaw_rate, one.thrust)}


def _status(one: Any) -> Iterator[Part]:
    yield "", one.header, {"battery": (one.battery_voltage,)}


def _battery(one: Any) -> Iterator[Part]:
    yield "", one.header, {"battery": (one.voltage,)}


def _line(one: Any) -> Iterator[Part]:
    yield "", None, {RECORD: one.data.encode()}


TOPICS = {
    HEADER: Topic("std_msgs/String", "the first line of our own flight log; nothing but the next is then read", _line),
    RECORD: Topic("std_msgs/String", "its other lines", _line),
    "odom": Topic("nav_msgs/Odometry", "position, attitude; velocity, rates, in the axes that these tell", _odometry),
    "pose": Topic("geometry_msgs/PoseStamped", "position and attitude", _pose),
    "tf": Topic("tf2_msgs/TFMessage", "position and attitude of the child frame, which is the drone", _transforms),
    "twist": Topic("geometry_msgs/TwistStamped", "velocity and rates, in the axes that the poses tell", _twist),
    "gyro": Topic(
        "crazyflie_interfaces/LogDataGeneric",
        "rates: a custom topic called `gyro` of `gyro.x`, `gyro.y`, `gyro.z` [deg/s]",
        _gyroscope,
    ),
    "status": Topic("crazyflie_interfaces/Status", "battery", _status),
    "battery": Topic("sensor_msgs/BatteryState", "battery", _battery),
    "cmd_vel_legacy": Topic(
        "geometry_msgs/Twist",
        "setpoint: roll `linear.y`, pitch -`linear.x` [deg], yaw rate `angular.z` [deg/s], thrust `linear.z`",
        _legacy,
    ),
    "setpoint": Topic("mjxball_msgs/Setpoint", "setpoint as sent", _setpoint),
}
VARIABLES = {
    **{f"stateEstimate.{axis}": Variable("position", number, 1.0) for number, axis in enumerate("xyz")},
    **{f"stateEstimate.v{axis}": Variable("velocity", number, 1.0) for number, axis in enumerate("xyz")},
    **{f"stateEstimate.q{axis}": Variable("quaternion", number, 1.0) for number, axis in enumerate("wxyz")},
    **{f"stateEstimateZ.{axis}": Variable("position", number, 1e-3) for number, axis in enumerate("xyz")},
    **{f"stateEstimateZ.v{axis}": Variable("velocity", number, 1e-3) for number, axis in enumerate("xyz")},
    "stateEstimateZ.rateRoll": Variable("rates", 0, 1e-3),
    "stateEstimateZ.ratePitch": Variable("rates", 1, -1e-3),
    "stateEstimateZ.rateYaw": Variable("rates", 2, 1e-3),
    **{f"gyro.{axis}": Variable("rates", number, RADIAN) for number, axis in enumerate("xyz")},
    "ctrltarget.roll": Variable("sent", 0, 1.0),
    "ctrltarget.pitch": Variable("sent", 1, 1.0),
    "ctrltarget.yaw": Variable("sent", 2, 1.0),
    "stabilizer.thrust": Variable("sent", 3, 1.0),
    "controller.cmd_thrust": Variable("sent", 3, 1.0),
    "pm.vbat": Variable("battery", 0, 1.0),
}
