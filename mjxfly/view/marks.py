"""Status of a flight from the records of its log: a text, a level, and marks on the time axis."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from mjxball.reading import parse_json
from mjxball.view.flight import Mark
from mjxfly.flight_log import LONGEST_LINE, read
from mjxfly.log_import import is_foreign
from mjxfly.log_schema import Record, decode
from mjxfly.supervisor import FAULTS, FlightState

GOOD = {FlightState.FLY.value, FlightState.LAND.value}  # both controllers are in command
BAD = {FlightState.HOLD.value, FlightState.DESCEND.value, FlightState.KILL.value}
OVER = {FlightState.STOP.value, FlightState.DONE.value}  # they keep the level of the state before
SEVERITY = {state.value: state.severity for state in FlightState}
FAULT_NAMES = {event.name for event in FAULTS}
STREAMS = (b'"kind": "state"', b'"kind": "health"', b'"kind": "pose"')  # most lines of a log; they make no marks


class FlightStatus:
    """Status of a flight by the records of its log: `text`, `level`, `ended`, and `marks` at times of the log.

    `level` is "busy", "good" (the controllers are in command, or the flight ended well) or "bad" (a fault).
    """

    def __init__(self, text: str):
        self.text, self.level, self.ended = text, "busy", False
        self.marks: list[Mark] = []
        self._why, self._begun = "", 0.0

    def take(self, record: Record) -> None:
        """Update the status by a record of any kind; states change nothing."""
        kind, now = record["kind"], record["t"]
        if kind == "header":
            self.text, self._begun = "connecting and checking", now
        elif kind == "tick":
            self._enter(record["state"])
        elif kind == "check":
            self.text = f"{'good' if record['passed'] else 'BAD'}: {record['name']}: {record['found']}"
        elif kind == "transition":
            self._transition(record)
        elif kind == "refused":
            self._end(now, "bad", f"refused: {record['text']}")
        elif kind == "end":
            why = f": {self._why}" if self._why else ""
            level = "bad" if record["code"] else "good"
            self._end(now, level, f"the flight has ended, exit code {record['code']}{why}")

    def fail(self, why: str) -> None:
        """Report that the log cannot be read because of `why`; an earlier fault keeps its text."""
        if self.level != "bad":
            self.level, self._why = "bad", why
            self.text = f"the log cannot be placed in time: {why}"

    def _enter(self, state: str) -> None:
        """Show the supervisor's `state`, and the reason once it descends."""
        if self.ended:
            return
        self.text = f"{state}: {self._why}" if self._why else state
        if self.level != "bad" and state not in OVER:
            self.level = "good" if state in GOOD else "busy"

    def _transition(self, record: Record) -> None:
        now, after, events = record["t"], record["after"], record["events"]
        if not self.marks:
            self._phase(self._begun, record["before"])
        severity = SEVERITY.get(after, 0)
        causes = [event for event in events if event.partition(":")[0] in FAULT_NAMES]
        if causes:
            self.level = "bad"
            self.marks.append(Mark(now, "fault", ", ".join(map(_words, causes)), "bad"))
        if causes or (severity > FlightState.FLY.severity and events):
            self._why = self._why or _words((causes or events)[0])
        self._phase(now, after)
        self._enter(after)

    def _phase(self, now: float, state: str) -> None:
        self.marks.append(Mark(now, "phase", state, "good" if state in GOOD else "bad" if state in BAD else ""))

    def _end(self, now: float, level: str, text: str) -> None:
        self.ended, self.level, self.text = True, level, text
        self.marks.append(Mark(now, "end", text, level))


def _words(event: str) -> str:
    return event.lower().replace("_", " ")


def placed(marks: Sequence[Mark], begin: float, last: float) -> tuple[Mark, ...]:
    """Return `marks` at times relative to `begin`, clipped to 0 .. `last` [s], without phases that ended before 0."""
    moved = [mark._replace(time=min(max(mark.time - begin, 0.0), last)) for mark in marks]
    phases = [mark for mark in moved if mark.kind == "phase"]
    ended = {id(one) for one, after in itertools.pairwise(phases) if after.time < 1e-6}
    return tuple(mark for mark in moved if id(mark) not in ended)


def marks_of_log(path: Path, last: float) -> tuple[Mark, ...]:
    """Return the marks of the complete log `path`, whose last tick is at `last` [s] of the recorded flight."""
    status, end = FlightStatus(""), 0.0
    for record in _relevant_records(path):
        status.take(record)
        if record["kind"] == "tick":
            end = max(end, record["t"])
    return placed(status.marks, end - last, last)


def _relevant_records(path: Path) -> Iterable[Record]:
    """Yield the log's records except `STREAMS`, and only the last tick. Lines that do not parse are skipped."""
    if is_foreign(path):
        yield from read(path)
        return
    tick = b""
    with path.open("rb") as stream:
        while line := stream.readline(LONGEST_LINE):
            if b'"kind": "tick"' in line:
                tick = line
            elif not any(kind in line for kind in STREAMS) and (record := _decoded(line)):
                yield record
    if record := _decoded(tick):
        yield record


def _decoded(line: bytes) -> Record | None:
    try:
        raw: Any = parse_json(line)
        return decode(raw)
    except (ValueError, KeyError, TypeError, RecursionError):
        return None
