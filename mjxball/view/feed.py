"""A flight log while it is written: what was added since it was last looked at, as rows that the page can show."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from mjxball import config as configs
from mjxball.control import rotations
from mjxball.errors import InputError
from mjxball.fly import packets
from mjxball.fly.card import command_maps
from mjxball.fly.limits import NAMES
from mjxball.fly.packets import DroneState, PacketError
from mjxball.fly.pair import Rig, object_state
from mjxball.fly.recording import LONGEST, STAMP
from mjxball.fly.supervisor import FAULTS, Event, State
from mjxball.view.page import plant_of

# A row, in this order: name and number of values, in SI units.
COLUMNS = {
    "time": 1,  # from the first tick
    "position": 3,
    "euler": 3,
    "quaternion": 4,
    "leader_command": 3,
    "follower_command": 3,
    "target": 3,
    "error": 3,
    "thrust": 2,
    "battery": 2,
    "late": 1,
}
STEP = 0.04  # [s] between two rows at least: nobody sees more while it happens
CHUNK = 2**20  # bytes read at once
LONGEST_LINE = 2**20  # bytes
NO_LAW = (0.0, 0.0, 0.0)


class Feed:
    """See the module. `update` reads on; `rows`, `text`, `mood` and `ended` say what is known."""

    def __init__(self, path: Path):
        """Follow the log `path`, which need not exist yet."""
        self.path = path
        self.rows: list[list[float]] = []
        self.plant: dict[str, Any] | None = None  # None: the log has not begun
        self.text = f"waiting for {path.name}"
        self.mood = "busy"  # good: the laws are in command; bad: a fault
        self.ended = False
        self._stream: BinaryIO | None = None
        self._rest = b""
        self._newest: list[DroneState | None] = [None, None]
        self._start: float | None = None
        self._why = ""

    def update(self) -> bool:
        """Read what was added, a chunk at most; true if there was something. Raises InputError: no flight log."""
        try:
            added = self._read()
        except OSError as error:
            raise InputError(f"flight log {self.path} cannot be read: {error.strerror or error}") from None
        *lines, self._rest = (self._rest + added).split(b"\n")
        for line in lines:
            self._take(line)
        if len(self._rest) > LONGEST_LINE:
            raise InputError(f"{self.path} is not a flight log: it holds a line of more than {LONGEST_LINE >> 20} MiB")
        return bool(added)

    def close(self) -> None:
        """Close the log."""
        if self._stream:
            self._stream.close()

    def _read(self) -> bytes:
        if self._stream is None:
            if not self.path.exists():
                return b""
            if not self.path.is_file():  # a pipe or a device would be waited for
                raise InputError(f"{self.path} is not a flight log: it is no file")
            self._stream = self.path.open("rb")
        return self._stream.read(CHUNK)

    def _take(self, line: bytes) -> None:
        try:
            record = json.loads(line)
            kind = record["kind"]
        except (ValueError, TypeError, KeyError, RecursionError):
            record, kind = {}, ""
        if self.plant is None:
            self._begin(record if kind == "header" else {})
            return
        try:  # one damaged record must not end the view of a flight
            if kind == "state":
                drone = NAMES.index(record["drone"])
                self._newest[drone] = packets.unpack_state(bytes.fromhex(record["raw"])[STAMP:])
            elif kind == "tick":
                self._tick(record)
            else:
                self._tell(kind, record)
        except (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError, PacketError):
            pass

    def _begin(self, header: Mapping[str, Any]) -> None:
        try:
            self._config = configs.validate(configs.from_record(header["config"]))
            self._maps = command_maps(self._config)
        except (InputError, KeyError, TypeError, ValueError, AttributeError):
            raise InputError(
                f"{self.path} is not a flight log of this version: it does not begin with a header"
            ) from None
        plant = self._config.plant
        self._rig = Rig(plant.leader_mount, plant.follower_mount)
        strongest = max(one.curve.force(packets.THRUST_CEILING) for one in self._maps)
        self.plant = {**plant_of(plant), "thrust": strongest}
        self.text = "connecting and checking"

    def _tick(self, record: Mapping[str, Any]) -> None:
        self._state(str(record["state"]))
        seen = [state for state in self._newest if state is not None]
        now = float(record["t"])
        self._start = now if self._start is None else self._start
        time = now - self._start
        late_enough = time >= self.rows[-1][0] + STEP - 1e-3 if self.rows else time >= 0.0
        if len(seen) < 2 or not late_enough or time > LONGEST:
            return
        pair = object_state(seen, self._rig)
        thrust = [one.curve.force(sent[3]) for one, sent in zip(self._maps, record["sent"], strict=True)]
        values = {
            "time": time,
            "position": pair.position,
            "euler": rotations.euler_from_matrix(pair.matrix),
            "quaternion": pair.quaternion,
            "leader_command": record.get("leader", NO_LAW),
            "follower_command": record.get("follower", NO_LAW),
            "target": record["goal"],
            "error": np.array(record["goal"], float) - pair.position,
            "thrust": thrust,
            "battery": [state.battery for state in seen],
            "late": record["late"],
        }
        row = [float(value) for name in COLUMNS for value in np.ravel(values[name])]
        if len(row) == sum(COLUMNS.values()) and all(map(math.isfinite, row)):
            self.rows.append(row)

    def _state(self, name: str) -> None:
        """What the supervisor does, and why once it is on the way down."""
        if self.ended:
            return
        self.text = f"{name}: {self._why}" if self._why else name
        if self.mood != "bad":
            self.mood = "good" if name in (State.FLY.value, State.LAND.value) else "busy"

    def _tell(self, kind: str, record: Mapping[str, Any]) -> None:
        """Note anything but states and ticks."""
        if kind == "check":
            self.text = f"{'good' if record['passed'] else 'BAD'}: {record['name']}: {record['found']}"
        elif kind == "transition":
            self._turn(str(record["after"]), [str(event) for event in record["events"]])
        elif kind == "refused":
            self.ended, self.mood, self.text = True, "bad", f"refused: {record['text']}"
        elif kind == "end":
            why = f": {self._why}" if self._why else ""
            self.ended, self.text = True, f"the flight has ended, exit code {int(record['code'])}{why}"
            self.mood = "bad" if record["code"] else "busy"

    def _turn(self, after: str, events: list[str]) -> None:
        severity = State(after).severity
        causes = [event for event in events if Event[event.partition(":")[0]] in FAULTS]
        if causes:
            self.mood = "bad"
        if causes or (severity > State.FLY.severity and not self._why):
            self._why = self._why or (causes or events)[0].lower().replace("_", " ")
        self._state(after)


def columns(rows: list[list[float]]) -> dict[str, np.ndarray]:
    """Rows as one array for each column, flat."""
    table = np.array(rows, np.float32).reshape(len(rows), sum(COLUMNS.values()))
    edges = np.cumsum([0, *COLUMNS.values()])
    return {name: table[:, low:high].ravel() for name, low, high in zip(COLUMNS, edges, edges[1:], strict=False)}
