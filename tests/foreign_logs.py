"""Support: a flight log as Crazyswarm2 and cfclient would have recorded it, written by `rosbags` and the csv module.

Types, topics and signs are those of Crazyswarm2's server in C++ and of cfclient's `logdatawriter`.
"""

from __future__ import annotations

import csv
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjxfly.log_schema import Record

START = 1_700_000_000_000_000_000  # [ns]
NAMES = {"leader": "cf7", "follower": "cf231"}
GENERIC = "std_msgs/Header header\nuint32 timestamp\nfloat32[] values"
STATUS = "std_msgs/Header header\nuint16 supervisor_info\nfloat32 battery_voltage\nuint8 pm_state"


def write_bag(
    path: Path,
    records: Sequence[Record],
    *,
    sqlite: bool = False,
    odometry: bool = False,
    names: Mapping[str, str] = NAMES,
    pose: str = "PoseStamped",
    commands: bool = True,
    late: int = 0,
    rates: Callable[[int], int] = lambda number: 3,
    unstamped: Collection[int] = (),
    compression: str = "",
    spin: bool = False,
) -> Path:
    """The new folder `path` of a bag: poses or `odometry`, rates, battery and setpoints; received `late` [ns].

    Message `number` of `odometry`'s rates has `rates(number)` values; with `spin` the odometry has the rates. Records
    whose numbers are `unstamped` have stamps of 0. `compression` is that of each message or of the file.
    """
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    for text, name in ((GENERIC, "LogDataGeneric"), (STATUS, "Status")):
        store.register(get_types_from_msg(text, f"crazyflie_interfaces/msg/{name}"))

    def make(name: str, *fields: Any) -> Any:
        return store.types[name.replace("/", "/msg/")](*fields)

    channels: dict[str, Any] = {}
    whole = Writer(path, version=9, storage_plugin=StoragePlugin.SQLITE3 if sqlite else StoragePlugin.MCAP)
    if compression:
        whole.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    with whole as writer:

        def put(topic: str, time: int, message: Any) -> None:
            kind = message.__msgtype__
            if topic not in channels:
                channels[topic] = writer.add_connection(topic, kind, typestore=store)
            writer.write(channels[topic], time + late, store.serialize_cdr(message, kind))

        for number, record in enumerate(records):
            time = START + round(record["t"] * 1e9)
            stamp = make("builtin_interfaces/Time", *divmod(0 if number in unstamped else time, 10**9))
            header = make("std_msgs/Header", stamp, "world")
            if record["kind"] == "tick" and commands:
                for drone, (roll, pitch, yaw_rate, thrust) in zip(names.values(), record["sent"], strict=True):
                    linear = make("geometry_msgs/Vector3", -pitch, roll, thrust)
                    angular = make("geometry_msgs/Vector3", 0.0, 0.0, yaw_rate)
                    put(f"/{drone}/cmd_vel_legacy", time, make("geometry_msgs/Twist", linear, angular))
            if record["kind"] != "state":
                continue
            drone, state = names[record["drone"]], record["raw"].state
            w, *xyz = state.quaternion
            turned = make("geometry_msgs/Quaternion", *xyz, w)
            placed = make("geometry_msgs/Pose", make("geometry_msgs/Point", *state.position), turned)
            if odometry:
                turning = make("geometry_msgs/Vector3", *(state.rates if spin else np.zeros(3)))
                moving = make("geometry_msgs/Twist", make("geometry_msgs/Vector3", *state.velocity), turning)
                parts = (
                    make("geometry_msgs/PoseWithCovariance", placed, np.zeros(36)),
                    make("geometry_msgs/TwistWithCovariance", moving, np.zeros(36)),
                )
                put(f"/{drone}/odom", time, make("nav_msgs/Odometry", header, drone, *parts))
                if spin:
                    continue
                values = np.resize(np.degrees(state.rates), rates(number)).astype(np.float32)
                put(f"/{drone}/gyro", time, make("crazyflie_interfaces/LogDataGeneric", header, 0, values))
                put(f"/{drone}/status", time, make("crazyflie_interfaces/Status", header, 0, state.battery, 0))
            elif pose == "PoseStamped":
                put(f"/{drone}/pose", time, make("geometry_msgs/PoseStamped", header, placed))
            else:
                put(f"/{drone}/pose", time, placed)
    return path


def write_cfclient(path: Path, records: Sequence[Record], boots: Mapping[str, float]) -> Path:
    """The new folder `path` of both drones' log blocks; `boots` [s]: what the drones' clocks are ahead."""
    blocks = {
        "place": [f"stateEstimate.{name}" for name in ("x", "y", "z", "vx", "vy", "vz")],
        "turn": [f"stateEstimate.q{name}" for name in "xyzw"],
        "turning": ["gyro.x", "gyro.y", "gyro.z", "pm.vbat"],
    }
    heads = {**blocks, "target": ["ctrltarget.roll", "ctrltarget.pitch", "ctrltarget.yaw", "stabilizer.thrust"]}
    for number, (name, boot) in enumerate(boots.items()):
        folder = path / name
        folder.mkdir(parents=True)
        rows: dict[str, list[list[Any]]] = {block: [] for block in heads}
        for record in records:
            stamp = round(1000 * (record["t"] + boot))
            if record["kind"] == "tick":
                rows["target"].append([stamp, *record["sent"][number]])
            elif record["kind"] == "state" and record["drone"] == name:
                state = record["raw"].state
                w, *xyz = state.quaternion
                rows["place"].append([stamp, *state.position, *state.velocity])
                rows["turn"].append([stamp, *xyz, w])
                rows["turning"].append([stamp, *np.degrees(state.rates), state.battery])
        for block, variables in heads.items():
            with (folder / f"{block}-20260101T10-00-00.csv").open("w", newline="") as stream:
                writer = csv.writer(stream, lineterminator="\n")
                writer.writerow(["Timestamp", *variables])
                writer.writerows(rows[block])
    return path
