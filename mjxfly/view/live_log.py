"""Incremental reader of a flight log that is being written: its new records as rows for the live view's page."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mjxball.control import rotations
from mjxball.view.flight import Mark
from mjxball.view.page import plant_of
from mjxfly import packets
from mjxfly.flight_log import Tail
from mjxfly.limits import NAMES
from mjxfly.log_schema import Record
from mjxfly.packets import DroneState
from mjxfly.policy_setup import variants
from mjxfly.recording import LONGEST, FirmwareSetup
from mjxfly.supervisor import FlightState
from mjxfly.telemetry import Rig, object_state
from mjxfly.view.marks import FlightStatus, placed

# Columns of a row in this order: name and number of values, in SI units.
COLUMNS = {
    "time": 1,  # from the first tick
    "position": 3,
    "euler": 3,
    "quaternion": 4,
    "leader_command": 3,
    "follower_command": 3,
    "target": 3,
    "thrust": 2,
    "battery": 2,
    "late": 1,
}
STEP = 0.04  # [s] shortest time between two rows: 25 frames a second are enough for a live view
NO_COMMAND = (0.0, 0.0, 0.0)  # in phases without a controller


class LiveLog:
    """A log that is being written. `update` reads new records into `rows` and `status`."""

    def __init__(self, path: Path, hear: Callable[[Record], None] = lambda _: None):
        """Follow the log `path`, which need not exist yet; `hear` is called for every record."""
        self.path = path
        self.rows: list[list[float]] = []
        self.plant: dict[str, Any] | None = None  # None: the log has not begun
        self.status = FlightStatus(f"waiting for {path.name}")
        self._tail, self._hear = Tail(path), hear
        self._newest: list[DroneState | None] = [None, None]
        self._start: float | None = None
        self._target: np.ndarray | None = None
        self._firmware: FirmwareSetup  # set by the header

    def update(self) -> bool:
        """Read new records, at most one chunk; return whether there were any. Raises InputError for no flight log."""
        records = self._tail.read()
        for record in records or ():
            self.status.take(record)
            self._take(record)
            self._hear(record)
        if self._tail.misplaced:
            self.status.fail(self._tail.misplaced)
        return records is not None

    @property
    def marks(self) -> tuple[Mark, ...]:
        """The status's marks on the time axis of `rows`."""
        if self._start is None or not self.rows:
            return ()
        return placed(self.status.marks, self._start, self.rows[-1][0])

    def close(self) -> None:
        """Close the log."""
        self._tail.close()

    def _take(self, record: Record) -> None:
        if record["kind"] == "header":
            self._begin(record)
        elif record["kind"] == "state":
            self._newest[NAMES.index(record["drone"])] = record["raw"].state
        elif record["kind"] == "tick":
            self._tick(record)
        elif record["kind"] == "thrust":
            self._firmware = self._firmware.after(record, self._config)
            self._curves = self._firmware.force_curves(self._config)

    def _begin(self, header: Record) -> None:
        self._config, self._firmware = header["config"], FirmwareSetup.of_header(header)
        self._curves = self._firmware.force_curves(self._config)
        plant = self._config.plant
        self._rig = Rig.of_plant(plant)
        # Over all curves: the one in use is known only when the motors turn, after the page has set its scale.
        known = [own.map.curve for one in variants(self._config) for own in one.values()]
        strongest = max(curve.force(packets.THRUST_CEILING) for curve in (*self._curves, *known))
        self.plant = {**plant_of(plant), "thrust": strongest}

    def _tick(self, record: Record) -> None:
        states = [state for state in self._newest if state is not None]
        if self._target is None or record["state"] != FlightState.LAND.value:  # see `Recording.target`
            self._target = record["goal"]
        now = record["t"]
        self._start = now if self._start is None else self._start
        time = now - self._start
        late_enough = time >= self.rows[-1][0] + STEP - 1e-3 if self.rows else time >= 0.0
        if len(states) < 2 or not late_enough or time > LONGEST:
            return
        pair = object_state(states, self._rig)
        thrust = [curve.force(sent[3]) for curve, sent in zip(self._curves, record["sent"], strict=True)]
        values = {
            "time": time,
            "position": pair.position,
            "euler": rotations.euler_from_matrix(pair.matrix),
            "quaternion": pair.quaternion,
            "leader_command": record.get("leader", NO_COMMAND),
            "follower_command": record.get("follower", NO_COMMAND),
            "target": self._target,
            "thrust": thrust,
            "battery": [state.battery for state in states],
            "late": record.get("late", 0.0),
        }
        self.rows.append([float(value) for name in COLUMNS for value in np.ravel(values[name])])


def columns(rows: list[list[float]]) -> dict[str, np.ndarray]:
    """Return `rows` as one flat float32 array for each column."""
    table = np.array(rows, np.float32).reshape(len(rows), sum(COLUMNS.values()))
    edges = np.cumsum([0, *COLUMNS.values()])
    return {name: table[:, low:high].ravel() for name, low, high in zip(COLUMNS, edges, edges[1:], strict=False)}
