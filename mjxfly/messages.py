"""Records of the flight log as ROS 2 messages: topics, types, and definitions as a bag stores them."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from mjxball.control import rotations
from mjxball.errors import InputError
from mjxfly.limits import NAMES
from mjxfly.log_schema import Record
from mjxfly.packets import DroneState
from mjxfly.telemetry import Rig, object_state

WORLD, OBJECT = "world", "object"  # frames, besides one for each drone
LATEST = 2**31  # [s] since 1970: least time that a message cannot hold
INFO, WARN, ERROR = 20, 30, 40  # levels of rcl_interfaces/msg/Log
TEXTS = {
    "console": INFO,
    "transition": INFO,
    "end": INFO,
    "warning": WARN,
    "gap": WARN,
    "refused": ERROR,
    "error": ERROR,
    "link": ERROR,
}

# ROS 2's own message types, by field. https://github.com/ros2/common_interfaces, rcl_interfaces and geometry2.
FIELDS = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "std_msgs/String": "string data",
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation",
    "geometry_msgs/PointStamped": "std_msgs/Header header\ngeometry_msgs/Point point",
    "geometry_msgs/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose",
    "geometry_msgs/TwistStamped": "std_msgs/Header header\ngeometry_msgs/Twist twist",
    "geometry_msgs/TransformStamped": "std_msgs/Header header\nstring child_frame_id\n"
    "geometry_msgs/Transform transform",
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "sensor_msgs/BatteryState": "std_msgs/Header header\nfloat32 voltage\nfloat32 temperature\nfloat32 current\n"
    "float32 charge\nfloat32 capacity\nfloat32 design_capacity\nfloat32 percentage\nuint8 power_supply_status\n"
    "uint8 power_supply_health\nuint8 power_supply_technology\nbool present\nfloat32[] cell_voltage\n"
    "float32[] cell_temperature\nstring location\nstring serial_number",
    "rcl_interfaces/Log": "builtin_interfaces/Time stamp\nuint8 level\nstring name\nstring msg\nstring file\n"
    "string function\nuint32 line",
    # Ours.
    "mjxball_msgs/Command": "std_msgs/Header header\nfloat64 roll  # [rad]\nfloat64 pitch  # [rad]\n"
    "float64 vertical_acceleration  # [m/s2]",
    "mjxball_msgs/Setpoint": "std_msgs/Header header\nfloat64 roll  # [deg], the wire's sign\nfloat64 pitch  # [deg]\n"
    "float64 yaw_rate  # [deg/s]\nfloat64 thrust  # 0 .. 65535",
    "mjxball_msgs/Health": "std_msgs/Header header\nfloat64[3] variance  # of the position [m2]\n"
    "float64[4] motors  # PWM 0 .. 65535\nfloat64 thrust  # of the setpoint in force, NaN: not reported",
    "mjxball_msgs/Follower": "std_msgs/Header header\nfloat64[] observation\nfloat64[] hidden  # state of the GRU",
}  # fmt: skip
TYPES = {  # by the last part of a topic
    "tf": "tf2_msgs/TFMessage",
    "pose": "geometry_msgs/PoseStamped",
    "measured_pose": "geometry_msgs/PoseStamped",
    "twist": "geometry_msgs/TwistStamped",
    "battery": "sensor_msgs/BatteryState",
    "health": "mjxball_msgs/Health",
    "setpoint": "mjxball_msgs/Setpoint",
    "command": "mjxball_msgs/Command",
    "network": "mjxball_msgs/Follower",
    "goal": "geometry_msgs/PointStamped",
    "phase": "std_msgs/String",
    "rosout": "rcl_interfaces/Log",
    "header": "std_msgs/String",
    "record": "std_msgs/String",
}
Message = tuple[str, Any]  # topic, fields by name


def definition(name: str) -> str:
    """Definition of the message type `name`, such as "std_msgs/Header", with all nested types, as in a ROS 2 bag."""
    found: list[str] = []

    def visit(one: str) -> None:
        for line in FIELDS[one].splitlines():
            inner = line.split()[0].split("[")[0]
            if inner in FIELDS and inner not in found:
                found.append(inner)
                visit(inner)

    visit(name)
    line = "=" * 80
    return "\n".join([FIELDS[name], *(f"{line}\nMSG: {inner}\n{FIELDS[inner]}" for inner in found)])


class Encoder:
    """Converts the records of a flight log to messages and writes them to a sink."""

    def __init__(self, sink: Any):
        """`sink` takes schemas, channels and messages as the writer of the package mcap does."""
        from mcap_ros2.writer import Writer

        self._writer = Writer(io.BytesIO())
        self._writer._writer = sink  # its constructor takes no sink
        self._schemas: dict[str, Any] = {}
        self._newest: dict[str, DroneState] = {}

    def take(self, record: Record) -> None:
        """Write the messages of one `record`, the header first. Raises InputError if its time cannot be stored."""
        if record["kind"] == "header":
            self._rig = Rig.of_plant(record["config"].plant)
            # Nanoseconds since 1970, or since the log's own clock began.
            self._shift = record["wall"] - record["t"] if "wall" in record else 0.0
        now = self.time(record)
        for topic, fields in messages(record, self._newest, self._rig, now):
            self.write(topic, fields, now)

    def time(self, record: Record) -> int:
        """Time of a record [ns]. Raises InputError if a message cannot hold it."""
        seconds = record["t"] + self._shift
        if not 0 <= seconds < LATEST:
            raise InputError(f"the flight log's wall clock, {seconds:g} s, is none that a bag can hold")
        return round(seconds * 1e9)

    def write(self, topic: str, fields: dict[str, Any], now: int) -> None:
        """Write one message at `now` [ns]."""
        name = TYPES[topic.rpartition("/")[2]]
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_msgdef(name.replace("/", "/msg/"), definition(name))
        self._writer.write_message(topic, self._schemas[name], fields, now)


def messages(record: Record, newest: dict[str, DroneState], rig: Rig, time: int) -> Iterator[Message]:
    """(topic, fields) of one record at `time` [ns]; a state also updates `newest`, the states by drone."""
    kind, drone = record["kind"], record.get("drone", "")
    if kind in KINDS:
        yield from KINDS[kind](record, drone, time)
    if kind in TEXTS:
        parts = [
            value for name, value in record.items() if name in ("text", "told", "before", "after", "events", "cause")
        ]
        text = "; ".join(", ".join(one) if isinstance(one, tuple) else one for one in parts if one)
        log = {"stamp": _time(time), "level": TEXTS[kind], "name": drone or "mjxfly", "msg": f"{kind}: {text}"}
        yield "/rosout", {**log, "file": "", "function": "", "line": 0}
    if kind != "state":
        return
    newest[drone] = record["raw"].state
    if len(newest) == len(NAMES):
        seen = object_state([newest[name] for name in NAMES], rig)
        yield from _moving(OBJECT, seen.position, seen.quaternion, seen.velocity, seen.rates, time)


def _of_state(record: Record, drone: str, time: int) -> Iterator[Message]:
    state: DroneState = record["raw"].state
    yield from _moving(drone, state.position, state.quaternion, state.velocity, state.rates, time)
    none = float("nan")
    battery = dict.fromkeys(("temperature", "current", "charge", "capacity", "design_capacity", "percentage"), none)
    unknown = dict.fromkeys(("power_supply_status", "power_supply_health", "power_supply_technology"), 0)
    cells = {"present": True, "cell_voltage": [], "cell_temperature": [], "location": drone, "serial_number": ""}
    yield f"/{drone}/battery", {"header": _header(drone, time), "voltage": state.battery, **battery, **unknown, **cells}


def _moving(frame: str, place: Any, turned: Any, velocity: Any, rates: Any, time: int) -> Iterator[Message]:
    """Pose and transform of `frame` in the world, and its twist in its own axes."""
    header, orientation = _header(WORLD, time), _quaternion(turned)
    yield f"/{frame}/pose", {"header": header, "pose": {"position": _vector(place), "orientation": orientation}}
    along = rotations.matrix_from_quaternion(turned).T @ velocity
    twist = {"linear": _vector(along), "angular": _vector(rates)}
    yield f"/{frame}/twist", {"header": _header(frame, time), "twist": twist}
    transform = {"translation": _vector(place), "rotation": orientation}
    yield "/tf", {"transforms": [{"header": header, "child_frame_id": frame, "transform": transform}]}


def _of_tick(record: Record, drone: None, time: int) -> Iterator[Message]:
    yield "/goal", {"header": _header(WORLD, time), "point": _vector(record["goal"])}
    yield "/phase", {"data": record["state"]}
    for name, sent in zip(NAMES, record["sent"], strict=True):
        header = _header(name, time)
        setpoint = dict(zip(("roll", "pitch", "yaw_rate", "thrust"), map(float, sent), strict=True))
        yield f"/{name}/setpoint", {"header": header, **setpoint}
        if name in record:
            command = dict(zip(("roll", "pitch", "vertical_acceleration"), map(float, record[name]), strict=True))
            yield f"/{name}/command", {"header": header, **command}
    if "observation" in record:
        hidden = record.get("hidden", np.zeros(0))
        own = {"observation": record["observation"].tolist(), "hidden": hidden.tolist()}
        yield "/follower/network", {"header": _header(NAMES[1], time), **own}


def _of_health(record: Record, drone: str, time: int) -> Iterator[Message]:
    health = {"variance": record["variance"].tolist(), "motors": record["motors"].tolist()}
    yield f"/{drone}/health", {"header": _header(drone, time), **health, "thrust": record["thrust"]}


def _of_pose(record: Record, drone: str, time: int) -> Iterator[Message]:
    pose = {"position": _vector(record["position"]), "orientation": _quaternion(record["quaternion"])}
    yield f"/{drone}/measured_pose", {"header": _header(WORLD, round(time - 1e9 * record["age"])), "pose": pose}


KINDS: dict[str, Callable[..., Iterator[Message]]] = {
    "state": _of_state,
    "tick": _of_tick,
    "health": _of_health,
    "pose": _of_pose,
}


def _time(time: int) -> dict[str, int]:
    return {"sec": time // 10**9, "nanosec": time % 10**9}


def _header(frame: str, time: int) -> dict[str, Any]:
    return {"stamp": _time(time), "frame_id": frame}


def _vector(components: Any) -> dict[str, float]:
    return dict(zip("xyz", map(float, components), strict=True))


def _quaternion(components: Any) -> dict[str, float]:
    return dict(zip("wxyz", map(float, components), strict=True))
