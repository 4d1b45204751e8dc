"""Read a waveform of the CG from a text file."""

from __future__ import annotations

import csv
from pathlib import Path

from mjxball.errors import InputError

MOST_SAMPLES = 100_000


def read_waveform(path: Path) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Times [s] and offsets [m] from a CSV file with two columns; a header line is allowed.

    Raises InputError if the file cannot be read; order and range are checked with the configuration.
    """
    try:
        with path.open(newline="") as stream:
            lines = [line for line in csv.reader(stream) if line]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"waveform {path} cannot be read: {getattr(error, 'strerror', None) or error}") from None
    if len(lines) > MOST_SAMPLES:
        raise InputError(f"waveform {path} has more than {MOST_SAMPLES:,} lines")
    samples = []
    for number, line in enumerate(lines, start=1):
        try:
            time, offset = map(float, line)
        except ValueError:
            if number == 1 and not any(field.strip()[:1] in set("+-.0123456789") for field in line):
                continue  # a header: none of its fields begins like a number
            raise InputError(f"waveform {path}, line {number}: expected two numbers, time and offset") from None
        samples.append((time, offset))
    if not samples:
        raise InputError(f"waveform {path} has no samples")
    times, offsets = zip(*samples, strict=True)
    return times, offsets
