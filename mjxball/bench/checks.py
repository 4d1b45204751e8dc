"""Checks of an entry: one that no flights can give is refused."""

from __future__ import annotations

import datetime
import math
import re
from pathlib import Path
from typing import Any

from mjxball.bench import CONDITIONS, NAME, VERSION
from mjxball.bench.draw import STORED_DRAW, read_stored
from mjxball.bench.entry import VALUES
from mjxball.bench.evaluation import KEY
from mjxball.bench.success import LATER, MAX_CPU_TIME, MAX_ROTOR_SHARE, REASONS, SOONEST
from mjxball.bench.tracks import TRACKS
from mjxball.config import Command
from mjxball.errors import InputError
from mjxball.files import read_text
from mjxball.reading import parse_json, shown

# Keys of an entry and their types.
KINDS: dict[str, type] = {
    **{"benchmark": str, "version": int, "draw": int, "key": str, "follower": str, "sha256": str, "date": str},
    **{"cpu_time": float, "tracks": dict, "not_flown": dict, "command": str, "commit": str, "versions": dict},
}
FORMS = {
    "key": (KEY, "of 32 hexadecimal digits"),
    "sha256": (re.compile(r"[0-9a-f]{64}"), "of 64 hexadecimal digits"),
    "follower": (re.compile(r"[\w.:+-]{1,80}"), "of one word"),
    "commit": (re.compile(r"[0-9a-f]{7,40}"), "of a clean checkout, 7 to 40 hexadecimal digits"),
    "command": (re.compile(r"[ -~]{1,1000}"), "of one line"),
}
FIRST_DATE = datetime.date(2026, 11, 29)  # of this version
ROUNDING = 1e-7  # of a ratio or a mean, relative
QUICKEST = 0.1  # arrival over the oracle's that no follower is below in the median
# Median power over that of hover. A load may be lighter than believed, and the ground may carry; no rotor gives four
# times what hovers.
POWER = (0.7, 8.0)
MAX_CHANGE = 2 * Command().tilt_limit  # of a command from step to step [rad]
MAX_ERROR = 10.0  # of a flight that does not crash [m]


def read_entry(path: Path) -> dict[str, Any]:
    """An entry that the leaderboard can show: of this version, with all stored flights of each track, from a commit.

    Raises InputError with one sentence for anything else.
    """
    text = read_text(path, "entry")
    try:
        entry = parse_json(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"entry {path} is no JSON: {str(error)[:80]}") from None
    if not isinstance(entry, dict) or entry.get("benchmark") != NAME:
        raise InputError(f"{path} is no entry of {NAME}")
    other = entry.get("version")
    if other != VERSION or isinstance(other, bool):
        raise InputError(f"entry {path} is of version {shown(other)} of {NAME}, and this is version {VERSION}")
    if fault := _head_fault(entry) or _tracks_fault(entry):
        raise InputError(f"entry {path} {fault}")
    return entry


def _head_fault(entry: dict[str, Any]) -> str | None:
    """A phrase on what is wrong outside the results; None if nothing is."""
    if missing := sorted(set(KINDS) - set(entry)):
        return f"is not whole: {', '.join(missing)} is missing"
    if unknown := sorted(set(entry) - set(KINDS)):
        return f"has {shown(unknown[0])}, which no entry has"
    for name, kind in KINDS.items():
        if type(entry[name]) is not kind:
            return f"has {name} {shown(entry[name])}, which is no {kind.__name__}"
    for name, (form, wanted) in FORMS.items():
        if not form.fullmatch(entry[name]):
            return f"has {name} {shown(entry[name])}, which is not {wanted}"
    if not 0 < entry["cpu_time"] <= MAX_CPU_TIME:
        return f"has cpu_time {entry['cpu_time']:g} s, which is not between 0 and {MAX_CPU_TIME:g} s"
    if entry["draw"] != STORED_DRAW:
        return f"is of draw {entry['draw']}; ranked are flights of draw {STORED_DRAW}"
    for name in ("not_flown", "versions"):
        if not all(isinstance(value, str) for value in entry[name].values()):
            return f"has values in {name} that are no text"
    return _date_fault(entry["date"])


def _date_fault(text: str) -> str | None:
    try:
        date = datetime.date.fromisoformat(text)
    except ValueError:
        date = None
    if date is None or date.isoformat() != text:
        return f"has no date as 2026-12-31, but {shown(text)}"
    if not FIRST_DATE <= date <= datetime.datetime.now(datetime.UTC).date():
        return f"has the date {text}, which is in the future or before this version"
    return None


def _tracks_fault(entry: dict[str, Any]) -> str | None:
    """A phrase on the first impossible results; None if there are none."""
    flown, left_out = entry["tracks"], entry["not_flown"]
    if not flown or set(flown) & set(left_out):
        return "has no track, or one that was flown and not flown"
    if unknown := sorted((set(flown) | set(left_out)) - set(TRACKS)):
        return f"has a track {shown(unknown[0])}, which there is not"
    for track, results in flown.items():
        if not isinstance(results, dict) or set(results) != set(CONDITIONS):
            return f"lacks results of track {track} in {' and '.join(CONDITIONS)}"
        for condition in CONDITIONS:
            if fault := _count_fault(track, condition, results[condition]) or _value_fault(
                track, condition, results[condition]
            ):
                return f"has impossible results of track {track}, {condition}: {fault}"
    return None


def _count_fault(track: str, condition: str, found: Any) -> str | None:
    """A phrase if counts of flights contradict each other."""
    if not isinstance(found, dict) or set(found) != {"flights", "succeeded", "reasons", *VALUES}:
        return "other keys than results have"
    if not isinstance(found["reasons"], dict) or set(found["reasons"]) != set(REASONS):
        return "other reasons than there are"
    counts = {"flights": found["flights"], "succeeded": found["succeeded"], **found["reasons"]}
    flights = sum(len(plant[condition]) for plant in read_stored(track)["plants"])
    for name, count in counts.items():
        if type(count) is not int or not 0 <= count <= flights:
            return f"{name} is {shown(count)}, which is no number of {flights} flights"
    if counts["flights"] != flights:
        return f"they are of {counts['flights']} flights, and there are {flights}"
    others = flights - counts["succeeded"] - counts["crashed"]  # that failed and did not crash
    reasons = {name: counts[name] for name in REASONS if name != "crashed"}
    if max(*reasons.values(), reasons["late"] + reasons["leaves"]) > others or sum(reasons.values()) < others:
        return "successes and reasons do not add up to all flights"
    return None


def _value_fault(track: str, condition: str, found: dict[str, Any]) -> str | None:
    """A phrase if a value is none that flights with these counts can give."""
    flights, reasons = found["flights"], found["reasons"]
    for name in VALUES:
        value = found[name]
        if value is not None and (type(value) not in (int, float) or not math.isfinite(value) or value < 0):
            return f"{name} is {shown(value)}"
    sound = flights - reasons["crashed"]
    for name in ("rotor_power", "rotor_limit_share"):
        if (found[name] is None) != (sound == 0):
            return f"{name} is {shown(found[name])} of {sound} flights that did not crash"
    change = found["command_change"] or 0.0  # None of a follower that commands no attitude
    if sound and not (POWER[0] <= found["rotor_power"] <= POWER[1] and change <= MAX_CHANGE):
        return "power or change of commands are none that rotors and limits allow"
    return (
        _limit_fault(found, sound) or _arrival_fault(track, condition, found) or _error_fault(track, condition, found)
    )


def _limit_fault(found: dict[str, Any], sound: int) -> str | None:
    """A phrase unless the mean share at a limit is between what the flights with too much of it leave."""
    if not sound:
        return None
    limited = found["reasons"]["rotors"]
    low = MAX_ROTOR_SHARE * limited / sound
    high = (limited + MAX_ROTOR_SHARE * (sound - limited)) / sound
    share = found["rotor_limit_share"]
    if low * (1 - ROUNDING) <= share <= high * (1 + ROUNDING) and (share > 0 or not limited):
        return None
    return f"rotor_limit_share is {share:g}, with {limited} of {sound} flights beyond {MAX_ROTOR_SHARE:g}"


def _arrival_fault(track: str, condition: str, found: dict[str, Any]) -> str | None:
    """A phrase unless the median arrival over the oracle's is one of flights with these counts."""
    ratio, plants = found["arrival_ratio"], read_stored(track)["plants"]
    if ratio is None:
        return "arrival_ratio is None, and most arrive in time" if _is_inside(found, 0.5) else None
    longest = max(plant["seconds"] for plant in plants)
    soonest = max(SOONEST, min(arrival for plant in plants for _, arrival in plant[condition]))
    fault = f"arrival_ratio is {ratio:g}"
    if ratio > longest / soonest:
        return f"{fault}, later than a flight ends"
    if any(plant["moving"] for plant in plants):
        return None
    if ratio < QUICKEST:
        return f"{fault}, sooner than any follower arrives"
    if (ratio <= LATER + ROUNDING) != _is_inside(found, 0.5):
        return f"{fault}, which does not fit those that are late, leave and crash"
    return None


def _error_fault(track: str, condition: str, found: dict[str, Any]) -> str | None:
    """A phrase unless the 90 % quantile of errors after the deadline is one of flights with these counts."""
    error, radii = found["late_error_90"], [plant["radius"][condition] for plant in read_stored(track)["plants"]]
    crashed_too_often = found["flights"] - found["reasons"]["crashed"] < math.ceil(0.9 * found["flights"])
    if (error is None) != crashed_too_often:
        return f"late_error_90 is {shown(error)}, with {found['reasons']['crashed']} flights that crash"
    if error is None:
        return None
    within = error <= max(radii) if _is_inside(found, 0.9) else min(radii) < error <= MAX_ERROR
    return None if within else f"late_error_90 is {error:g} m, which does not fit those that are late, leave and crash"


def _is_inside(found: dict[str, Any], share: float) -> bool:
    """Whether at least `share` of the flights are within the radius from the deadline on."""
    outside = sum(found["reasons"][name] for name in ("crashed", "late", "leaves"))
    return found["flights"] - outside >= math.ceil(share * found["flights"])
