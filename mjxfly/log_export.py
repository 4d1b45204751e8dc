"""A flight log for other programs: MCAP with ROS 2 messages (Foxglove, PlotJuggler, `ros2 bag`), CSV and Parquet.

MCAP holds every line of the log, and what streams as messages of ROS (`messages.TYPES`), stamped with the wall clock
of the header if it has one. CSV and Parquet hold the flight as `recording.read_recording` reads it, a row per tick, SI
units. As a program this module is what a `flight_log.Journal` writes an MCAP file with.
"""

from __future__ import annotations

import csv
import io
import json
import math
import os
import select
import sys
import time
from pathlib import Path
from typing import Any, BinaryIO

from mjxball import __version__, cli
from mjxball.config import to_dict
from mjxball.errors import InputError
from mjxball.files import write_whole
from mjxfly import flight_log
from mjxfly.limits import NAMES
from mjxfly.log_import import is_foreign
from mjxfly.log_schema import Record
from mjxfly.log_sources import HEADER, RECORD
from mjxfly.messages import Encoder
from mjxfly.recording import read_recording

ABOUT = ("policy", "version", "config_hash", "mocap", "curve", "command")  # fields of the header, as metadata
CHUNK_PERIOD = 0.25  # [s] between two chunks of an MCAP file that is recorded


class _Whole:
    """A file of which what was written after the last `flush` is written anew by the next `commit`.

    A commit is one write, so that the file is as one of them left it, whenever the process is killed.
    """

    def __init__(self, stream: BinaryIO):
        self._stream, self._rest, self._written, self._kept = stream, bytearray(), 0, 0

    def tell(self) -> int:
        return self._written + len(self._rest)

    def write(self, data: bytes) -> int:
        self._rest += data
        return len(data)

    def flush(self) -> None:
        self._kept = len(self._rest)

    def commit(self) -> None:
        self._stream.seek(self._written)
        self._stream.write(self._rest)
        self._stream.flush()
        self._written += self._kept
        self._rest.clear()


class Recorder(Encoder):
    """Writes the records of a flight log as an MCAP file, chunk by chunk."""

    def __init__(self, stream: BinaryIO):
        """Write to `stream`, which can seek. Raises InputError without mcap-ros2-support."""
        self._file = _Whole(stream)
        super().__init__(self._begun())

    def _begun(self) -> Any:
        from mcap.writer import Writer

        self._bag = Writer(self._file, use_summary_offsets=False)  # type: ignore[arg-type]
        self._bag.start(profile="ros2", library=f"mjxball {__version__}")
        return self._bag

    def take_line(self, line: bytes, record: Record) -> None:
        """Write one `record`, the header first, and the `line` that holds it. Raises InputError: its clock is none."""
        self.take(record)
        if record["kind"] == "header":
            about = {name: str(record[name]) for name in ABOUT if name in record}
            self._bag.add_metadata("mjxball", {**about, "config": json.dumps(to_dict(record["config"]))})
        name = HEADER if record["kind"] == "header" else RECORD
        self.write(f"/{name}", {"data": line.decode()}, self.time(record))

    def flush(self) -> None:
        """End the chunk and write the index after it, where the next chunk will be: the file is whole."""
        self._bag.flush()
        self._bag.finish()
        self._file.commit()


def write_mcap(path: Path, log: Path) -> list[str]:
    """Write the flight log `log` as the MCAP file `path`; returns what a reader should know. Raises InputError."""
    if is_foreign(log):
        raise InputError(f"{log} is not converted to .mcap; expected a flight log of JSON lines, .jsonl")
    remarks: list[str] = []
    stream = io.BytesIO()
    recorder = Recorder(stream)
    for line, record in flight_log.read_lines(log, remarks.append):
        recorder.take_line(line, record)
    recorder.flush()
    write_whole(path, stream.getvalue())
    return remarks


def record_lines(source: BinaryIO, target: BinaryIO) -> int:
    """Write the lines of a flight log that come in the pipe `source` as an MCAP file until it ends.

    Chunks are `CHUNK_PERIOD` apart, and the disk is synced as a `flight_log.Journal` does. Returns the exit code.
    Raises InputError: these are no lines of a flight log.
    """
    recorder, tail = Recorder(target), flight_log.Tail(Path("standard input"), source)
    written = synced = time.monotonic()
    waiting, going = False, True
    while going:
        if select.select([source], [], [], CHUNK_PERIOD)[0]:
            records = tail.read()
            going, waiting = records is not None, waiting or bool(records)
            for line, record in zip(tail.lines, records or (), strict=True):
                recorder.take_line(line, record)
        if waiting and time.monotonic() - written >= CHUNK_PERIOD:
            recorder.flush()
            written, waiting = time.monotonic(), False
            if written - synced > flight_log.SYNC_PERIOD:
                os.fsync(target.fileno())
                synced = written
    recorder.flush()
    return 0


COLUMNS = {  # of CSV and Parquet, by the array of a `Recording`
    "goal": ("goal_x", "goal_y", "goal_z"),
    "position": ("x", "y", "z"),
    "velocity": ("vx", "vy", "vz"),
    "quaternion": ("qw", "qx", "qy", "qz"),
    "rates": ("roll_rate", "pitch_rate", "yaw_rate"),
    "leader": ("leader_roll", "leader_pitch", "leader_vertical_acceleration"),
    "follower": ("follower_roll", "follower_pitch", "follower_vertical_acceleration"),
}


def table(log: Path) -> tuple[dict[str, Any], list[str]]:
    """The flight in `log`, {column: (T,)}, and what a reader should know. Raises InputError."""
    flight = read_recording(log)
    columns: dict[str, Any] = {"time": flight.time, "phase": list(flight.phase)}
    for name, heads in COLUMNS.items():
        columns |= dict(zip(heads, getattr(flight, name).T, strict=True))
    for number, drone in enumerate(NAMES):
        sent = (f"{drone}_sent_{part}" for part in ("roll_deg", "pitch_deg", "yaw_rate_deg", "thrust"))
        columns |= dict(zip(sent, flight.sent[:, number].T, strict=True))
    columns |= {f"observation_{number}": one for number, one in enumerate(flight.observation.T)}
    columns |= {f"hidden_{number}": one for number, one in enumerate(flight.hidden.T)}
    return columns, list(flight.remarks)


def write_csv(path: Path, log: Path) -> list[str]:
    """Write the flight in `log` as CSV with a head; numbers that are not there are empty. Raises InputError."""
    columns, remarks = table(log)
    stream = io.StringIO(newline="")
    writer = csv.writer(stream)
    writer.writerow(columns)
    for row in zip(*columns.values(), strict=True):
        writer.writerow("" if isinstance(one, float) and math.isnan(one) else one for one in row)
    write_whole(path, stream.getvalue().encode())
    return remarks


def write_parquet(path: Path, log: Path) -> list[str]:
    """Write the flight in `log` as Parquet; numbers that are not there are NaN. Raises InputError."""
    import pyarrow
    import pyarrow.parquet

    columns, remarks = table(log)
    stream = io.BytesIO()
    pyarrow.parquet.write_table(pyarrow.table(columns), stream)
    write_whole(path, stream.getvalue())
    return remarks


WRITERS = {".mcap": write_mcap, ".csv": write_csv, ".parquet": write_parquet}


def main() -> int:
    """Record what comes on standard input in the file that is standard output; the exit code."""
    return cli.run_command(_record)


def _record() -> int:
    with open(0, "rb", buffering=0) as source, open(1, "wb") as target:
        return record_lines(source, target)


if __name__ == "__main__":
    sys.exit(main())
