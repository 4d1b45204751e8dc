"""Export of a flight log: MCAP with ROS 2 messages (Foxglove, PlotJuggler, `ros2 bag`), CSV and Parquet.

MCAP holds every line of the log, and its data as ROS messages (`messages.TYPES`), stamped with the wall clock of the
header if it has one. CSV and Parquet hold the flight as `recording.read_recording` reads it, a row per tick, SI units.
`flight_log.Journal` runs this module as a process to write MCAP files.
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

from mjxball import __version__, running
from mjxball.config import to_dict
from mjxball.errors import InputError
from mjxball.files import write_atomically
from mjxfly import flight_log
from mjxfly.limits import NAMES
from mjxfly.log_import import is_foreign
from mjxfly.log_schema import Record
from mjxfly.log_sources import HEADER, RECORD
from mjxfly.messages import Encoder
from mjxfly.recording import read_recording

ABOUT = ("policy", "version", "config_hash", "mocap", "curve", "command")  # fields of the header, as MCAP metadata
CHUNK_PERIOD = 0.25  # [s] between two chunks of an MCAP file while it is recorded


class _CommittedFile:
    """A file whose tail after the last `flush` is overwritten by the next `commit`.

    A commit is a single write, so that a killed process leaves a complete file.
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
        self._file = _CommittedFile(stream)
        super().__init__(self._begun())

    def _begun(self) -> Any:
        from mcap.writer import Writer

        self._bag = Writer(self._file, use_summary_offsets=False)  # type: ignore[arg-type]
        self._bag.start(profile="ros2", library=f"mjxball {__version__}")
        return self._bag

    def take_line(self, line: bytes, record: Record) -> None:
        """Write one `record`, the header first, and its `line`. Raises InputError if its time cannot be stored."""
        self.take(record)
        if record["kind"] == "header":
            about = {name: str(record[name]) for name in ABOUT if name in record}
            self._bag.add_metadata("mjxball", {**about, "config": json.dumps(to_dict(record["config"]))})
        name = HEADER if record["kind"] == "header" else RECORD
        self.write(f"/{name}", {"data": line.decode()}, self.time(record))

    def flush(self) -> None:
        """End the chunk and write an index, which the next chunk overwrites: the file is complete."""
        self._bag.flush()
        self._bag.finish()
        self._file.commit()


def write_mcap(path: Path, log: Path) -> list[str]:
    """Write the flight log `log` as the MCAP file `path`; return remarks on skipped lines. Raises InputError."""
    if is_foreign(log):
        raise InputError(f"{log} is not converted to .mcap; expected a flight log of JSON lines, .jsonl")
    remarks: list[str] = []
    stream = io.BytesIO()
    recorder = Recorder(stream)
    for line, record in flight_log.read_lines(log, remarks.append):
        recorder.take_line(line, record)
    recorder.flush()
    write_atomically(path, stream.getvalue())
    return remarks


def record_lines(source: BinaryIO, target: BinaryIO) -> int:
    """Write the lines of a flight log from the pipe `source` as an MCAP file to `target` until the pipe is closed.

    Chunks are `CHUNK_PERIOD` apart, and the file is synced as by `flight_log.Journal`. Returns the exit code. Raises
    InputError if these are no lines of a flight log.
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


COLUMNS = {  # of CSV and Parquet, by field of `Recording`
    "goal": ("goal_x", "goal_y", "goal_z"),
    "position": ("x", "y", "z"),
    "velocity": ("vx", "vy", "vz"),
    "quaternion": ("qw", "qx", "qy", "qz"),
    "rates": ("roll_rate", "pitch_rate", "yaw_rate"),
    "leader": ("leader_roll", "leader_pitch", "leader_vertical_acceleration"),
    "follower": ("follower_roll", "follower_pitch", "follower_vertical_acceleration"),
}


def table(log: Path) -> tuple[dict[str, Any], list[str]]:
    """The flight in `log` as {column: (T,)}, and remarks on its data. Raises InputError."""
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
    """Write the flight in `log` as CSV with a header row; missing values are empty. Raises InputError."""
    columns, remarks = table(log)
    stream = io.StringIO(newline="")
    writer = csv.writer(stream)
    writer.writerow(columns)
    for row in zip(*columns.values(), strict=True):
        writer.writerow("" if isinstance(one, float) and math.isnan(one) else one for one in row)
    write_atomically(path, stream.getvalue().encode())
    return remarks


def write_parquet(path: Path, log: Path) -> list[str]:
    """Write the flight in `log` as Parquet; missing values are NaN. Raises InputError."""
    import pyarrow
    import pyarrow.parquet

    columns, remarks = table(log)
    stream = io.BytesIO()
    pyarrow.parquet.write_table(pyarrow.table(columns), stream)
    write_atomically(path, stream.getvalue())
    return remarks


WRITERS = {".mcap": write_mcap, ".csv": write_csv, ".parquet": write_parquet}


def main() -> int:
    """Record log lines from standard input as MCAP to the file on standard output; return the exit code."""
    return running.run_command(_record)


def _record() -> int:
    with open(0, "rb", buffering=0) as source, open(1, "wb") as target:
        return record_lines(source, target)


if __name__ == "__main__":
    sys.exit(main())
