"""Entries of the benchmark: results of one follower in a file that the leaderboard reads."""

from __future__ import annotations

import csv
import datetime
import io
from collections.abc import Callable, Sequence
from typing import Any

from mjxball.bench import CONDITIONS, NAME, VERSION
from mjxball.bench.draw import groups_of
from mjxball.bench.evaluation import Result, check_key, evaluate, fresh_key
from mjxball.bench.followers import identity
from mjxball.bench.process import FollowerProcess, RefusalError
from mjxball.bench.success import REASONS, interval, summary
from mjxball.bench.tracks import TRACKS
from mjxball.errors import InputError

HEADS = [
    "success %",
    "95 %",
    *(f"{name} %" for name in REASONS),
    "arrival",
    "error mm",
    "power",
    "limit %",
    "change mrad",
]
# Values of a condition that `success.summary` gives beside counts, with the factor and digits of their column.
VALUES = {
    **{"arrival_ratio": (1.0, 2), "late_error_90": (1e3, 1), "rotor_power": (1.0, 3)},
    **{"rotor_limit_share": (100.0, 1), "command_change": (1e3, 1)},
}
FLIGHT_COLUMNS = (
    *("track", "plant", "condition", "candidate", "goal_x", "goal_y", "goal_z", "mass", "radius", "oracle_arrival"),
    *("deadline", "reached", "arrival", "late_error", "rotor_limit_share", "rotor_power", "reasons"),
)
Results = dict[str, list[Result]]  # of tracks


def make_entry(
    text: str,
    tracks: Sequence[str],
    draw: int,
    key: str | None = None,
    progress: Callable[[str], None] = lambda text: None,
) -> tuple[dict[str, Any], Results]:
    """The entry of the follower that `text` names, without the keys that `mjxball.commands` adds, and all flights.

    `key` repeats an evaluation. A track whose plants the follower refuses is left out, with the reason. Raises
    InputError if it refuses all tracks, or on no track answers as it should.
    """
    if draw < 0:
        raise InputError(f"--draw must not be negative, but is {draw}")
    key = fresh_key() if key is None else check_key(key)
    name, digest = identity(text)
    found: Results = {}
    refused: dict[str, str] = {}
    times = []
    with FollowerProcess(name, text) as process:
        for track in tracks:
            try:
                for group in groups_of(track, draw):
                    process.follower(group.config)
            except RefusalError as error:
                refused[track] = str(error)
                continue
            times.append(process.check_cpu_time(groups_of(track, draw)[0].config))
            found[track] = evaluate(track, draw, key, process, progress)
    if not found:
        raise InputError(f"{name} flies no track: {next(iter(refused.values()))}")
    date = datetime.datetime.now(datetime.UTC).date().isoformat()
    head = {"benchmark": NAME, "version": VERSION, "draw": draw, "key": key, "follower": name, "sha256": digest}
    results = {track: by_condition(flown) for track, flown in found.items()}
    return {**head, "date": date, "cpu_time": max(times), "tracks": results, "not_flown": refused}, found


def by_condition(flown: Sequence[Result]) -> dict[str, dict[str, Any]]:
    """`success.summary` of a track's flights in each condition."""
    parts = {name: [one for one in flown if one.flight.condition == name] for name in CONDITIONS}
    return {
        name: summary(
            [one.metrics for one in part], [one.failures for one in part], [one.flight.oracle_arrival for one in part]
        )
        for name, part in parts.items()
    }


def flight_table(found: Results) -> str:
    """A CSV table of all flights, a row each: s, m, kg; empty where a flight has no such value."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(FLIGHT_COLUMNS)
    for track, flown in found.items():
        for plant, flight, metrics, failures in flown:
            scenario = flight.scenario
            place = (track, plant, flight.condition, flight.candidate, *scenario.goal, scenario.mass)
            wanted = (flight.radius, flight.oracle_arrival, flight.deadline)
            own = (metrics.reached, metrics.arrival, metrics.late_error, metrics.rotor_limit_share, metrics.rotor_power)
            writer.writerow([*place, *wanted, *own, " ".join(failures)])
    return stream.getvalue()


def table(entry: dict[str, Any]) -> str:
    """The entry as a text table, one line per track and condition."""
    rows: list[Sequence[str]] = [["track", "", *HEADS]]
    for track, found in entry["tracks"].items():
        rows += [(TRACKS[track].title, condition, *cells(found[condition])) for condition in CONDITIONS]
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    sides = [str.ljust, str.ljust, *[str.rjust] * len(HEADS)]
    lines = ["  ".join(side(text, width) for side, text, width in zip(sides, row, widths, strict=True)) for row in rows]
    left_out = [f"{TRACKS[track].title}: not flown, {why}" for track, why in entry["not_flown"].items()]
    return "\n".join([*(line.rstrip() for line in lines), *left_out])


def cells(found: dict[str, Any]) -> tuple[str, ...]:
    """Results of one condition as text, in the order of `HEADS`; a dash: never, or nothing to measure."""
    flights = found["flights"]
    low, high = interval(found["succeeded"], flights)
    counts = [f"{100 * found['reasons'][name] / flights:.0f}" for name in REASONS]
    values = [
        "-" if found[name] is None else f"{factor * found[name]:.{digits}f}"
        for name, (factor, digits) in VALUES.items()
    ]
    share = f"{100 * found['succeeded'] / flights:.0f}"
    return (share, f"{100 * low:.0f} - {100 * high:.0f}", *counts, *values)
