"""Entries of the benchmark: results of one follower in a file that the leaderboard reads."""

from __future__ import annotations

import datetime
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from mjxball.bench import NAME, VERSION
from mjxball.bench.followers import FollowerFactory, checked
from mjxball.bench.references import bars
from mjxball.bench.success import successes, summary
from mjxball.bench.tracks import FLIGHTS, TRACKS, worlds_of
from mjxball.errors import InputError
from mjxball.evaluate.metrics import Metrics
from mjxball.files import read_text
from mjxball.reading import parse_json

CONDITIONS = ("undisturbed", "disturbed")
HEADS = ["track", "", "success %", "95 %", "failed %", "settle s", "90 % peak mm", "limit %", "change mrad"]
# Keys of an entry and their types, besides the benchmark and its version.
KINDS = {
    **{"draw": int, "follower": str, "date": str, "command": str, "commit": str},
    **{"versions": dict, "tracks": dict, "not_flown": dict},
}
MAX_VALUE = 1e9  # bound on any value
SHARES = ("met", "low", "high", "failed")  # required values of one condition
VALUES = {"flights", *SHARES, "settling_50", "peak_90", "rotors_at_limit", "command_change"}


def make_entry(
    name: str,
    make: FollowerFactory,
    tracks: Sequence[str],
    draw: int,
    progress: Callable[[str], None] = lambda text: None,
) -> dict[str, Any]:
    """The entry of a follower, without the keys on the machine that `mjxball.commands` adds.

    A track whose plants the follower refuses is left out, with the reason. Raises InputError if it refuses all tracks.
    """
    if draw < 0:
        raise InputError(f"--draw must not be negative, but is {draw}")
    results: dict[str, Any] = {}
    refused: dict[str, str] = {}
    for track in tracks:
        try:
            for world in worlds_of(track, draw):
                make(world.config)
        except InputError as error:
            refused[track] = str(error)
            continue
        results[track] = measure(track, draw, make, progress)
    if not results:
        raise InputError(f"{name} flies no track: {next(iter(refused.values()))}")
    date = datetime.datetime.now(datetime.UTC).date().isoformat()
    head = {"benchmark": NAME, "version": VERSION, "draw": draw, "follower": name, "date": date}
    return {**head, "tracks": results, "not_flown": refused}


def measure(track: str, draw: int, make: FollowerFactory, progress: Callable[[str], None]) -> dict[str, dict[str, Any]]:
    """Results of the follower on `track`, by condition: undisturbed and disturbed.

    Raises InputError if it refuses the track's plants or fails the checks of `mjxball.bench.followers`.
    """
    flown: list[Metrics] = []
    succeeded: list[bool] = []
    worlds = worlds_of(track, draw)
    # Check all followers before the first flight; on the first plant with as many calls as a flight has.
    steps = round(worlds[0].scenarios[0][0].seconds / worlds[0].config.timing.control_period)
    entrants = [checked(make, world.config, *[] if number else [steps]) for number, world in enumerate(worlds)]
    for number, (world, follower) in enumerate(zip(worlds, entrants, strict=True)):
        progress(f"{track}: {number + 1}/{len(worlds)}")
        (mine,) = world.fly([follower], [one for pair in world.scenarios for one in pair])
        flown, succeeded = [*flown, *mine], [*succeeded, *successes(mine, bars(track, draw, number))]
    return {name: summary(flown[row::2], succeeded[row::2]) for row, name in enumerate(CONDITIONS)}


def read_entry(path: Path) -> dict[str, Any]:
    """An entry that the leaderboard can show: of this version, with all published flights of each track, from a commit.

    Raises InputError with one sentence for anything else.
    """
    text = read_text(path, "entry")
    try:
        entry = parse_json(text)
    except (ValueError, RecursionError):
        raise InputError(f"entry {path} is no JSON") from None
    if not isinstance(entry, dict) or entry.get("benchmark") != NAME:
        raise InputError(f"{path} is no entry of {NAME}")
    other = entry.get("version")
    if other != VERSION or isinstance(other, bool):
        raise InputError(f"entry {path} is of version {other!r} of {NAME}, and this is version {VERSION}")
    _check_kinds(path, entry)
    if not re.fullmatch(r"[\w.:+-]+", entry["follower"]) or not _is_date(entry["date"]):
        raise InputError(f"entry {path} has no name of one word as follower, or no date as 2026-01-31")
    if not entry["tracks"] or set(entry["tracks"]) & set(entry["not_flown"]):
        raise InputError(f"entry {path} has no track, or one that was flown and not flown")
    for track, results in entry["tracks"].items():
        for condition in CONDITIONS:
            if track not in TRACKS or not isinstance(results, dict) or not _measured(results.get(condition)):
                raise InputError(f"entry {path} lacks valid results of track {track}, {condition}")
    flown = {results[condition]["flights"] for results in entry["tracks"].values() for condition in CONDITIONS}
    if flown != {FLIGHTS} or entry["draw"] != 0:
        counts = ", ".join(map(str, sorted(flown)))
        raise InputError(f"entry {path} is of {counts} flights of draw {entry['draw']}; ranked are {FLIGHTS} of draw 0")
    if not re.fullmatch(r"[0-9a-f]{7,40}", entry["commit"]):
        raise InputError(f"entry {path} is of commit {entry['commit']!r}; fly it from a clean checkout of one")
    return entry


def _check_kinds(path: Path, entry: dict[str, Any]) -> None:
    if missing := sorted(set(KINDS) - set(entry)):
        raise InputError(f"entry {path} is not whole: {', '.join(missing)} is missing")
    for name, kind in KINDS.items():
        if type(entry[name]) is not kind:
            raise InputError(f"entry {path} has {name} {entry[name]!r}, which is no {kind.__name__}")


def _measured(values: Any) -> bool:
    """Whether `values` are one condition's results, as `success.summary` returns them."""
    if not isinstance(values, dict) or set(values) != VALUES or type(values["flights"]) is not int:
        return False
    if not all(values[name] is None or type(values[name]) in (int, float) for name in VALUES):
        return False
    if any(values[name] is None for name in SHARES):
        return False
    low, met, high, failed = (values[name] for name in ("low", "met", "high", "failed"))
    limit = values["rotors_at_limit"] or 0
    return (
        0 <= low <= met <= high <= 1
        and failed >= 0
        and met + failed <= 1 + 1e-9
        and 0 <= limit <= 1
        and all(0 <= (values[name] or 0) < MAX_VALUE for name in VALUES)
    )


def _is_date(text: str) -> bool:
    """Whether `text` is a date such as 2026-01-31."""
    try:
        return datetime.date.fromisoformat(text).isoformat() == text
    except ValueError:
        return False


def table(entry: dict[str, Any]) -> str:
    """The entry as a text table, one line per track and condition."""
    rows: list[Sequence[str]] = [HEADS]
    for track, found in entry["tracks"].items():
        rows += [(TRACKS[track].title, condition, *cells(found[condition])) for condition in CONDITIONS]
    widths = [max(len(row[column]) for row in rows) for column in range(len(HEADS))]
    sides = [str.ljust, str.ljust, *[str.rjust] * (len(HEADS) - 2)]
    lines = ["  ".join(side(text, width) for side, text, width in zip(sides, row, widths, strict=True)) for row in rows]
    left_out = [f"{TRACKS[track].title}: not flown, {why}" for track, why in entry["not_flown"].items()]
    return "\n".join([*(line.rstrip() for line in lines), *left_out])


def cells(found: dict[str, Any]) -> tuple[str, ...]:
    """Results of one condition as text: success, its interval, failures, settling, peak, rotors at a limit, change."""

    def shown(name: str, factor: float, digits: int) -> str:
        return "-" if found[name] is None else f"{factor * found[name]:.{digits}f}"

    interval = f"{100 * found['low']:.0f} - {100 * found['high']:.0f}"
    return (
        *(shown("met", 100, 0), interval, shown("failed", 100, 0), shown("settling_50", 1, 2)),
        *(shown("peak_90", 1e3, 1), shown("rotors_at_limit", 100, 1), shown("command_change", 1e3, 1)),
    )
