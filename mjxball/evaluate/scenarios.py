"""Scenarios of the evaluation: the reference, the standard list, cross products, and waveforms from files."""

from __future__ import annotations

import csv
import dataclasses
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mjxball.config import Config, ball_limit, cg_limit
from mjxball.errors import InputError
from mjxball.files import read_text
from mjxball.sim.scenario import CIRCLE, Scenario, check_scenario

REFERENCE = Scenario()
# Copy without CG motion, then five speeds of the CG.
STANDARD = (
    dataclasses.replace(REFERENCE, amplitude=0.0),
    *(dataclasses.replace(REFERENCE, omega=omega) for omega in (0.31, 0.62, 1.0, 2.0, 3.1)),
)
MOST_SAMPLES = 100_000


def cross(
    omegas: Sequence[float], amplitudes: Sequence[float], masses: Sequence[float], **common: Any
) -> tuple[Scenario, ...]:
    """Full cross product of the lists, in the given order."""
    cells = itertools.product(omegas, amplitudes, masses)
    return tuple(Scenario(omega=w, amplitude=a, mass=m, **common) for w, a, m in cells)


def standard_scenarios(settings: Config) -> tuple[Scenario, ...]:
    """The standard scenarios as far as the plant allows them, the reference one last; raise InputError if unsound.

    The object has the plant's mass, the CG keeps to the object and to what training draws, a stand's locked axes have
    goal 0, and the goal is drawn in to what training may draw. A waveform or a rolling ball makes one scenario. In the
    plane the CG goes round in a circle.
    """
    plant = settings.plant
    distance = min(REFERENCE.goal[0], settings.scenario.goal_range)
    free = {"free": (1, 1, 1), "pivot": (0, 0, 0), "heave": (0, 0, 1)}[plant.stand]
    common: dict[str, Any] = {"mass": plant.object_mass, "goal": tuple(distance * float(axis) for axis in free)}
    if len(plant.directions) == 2:
        common["path"] = CIRCLE
    reference = dataclasses.replace(
        REFERENCE,
        amplitude=min(REFERENCE.amplitude, cg_limit(plant), settings.scenario.cg_amplitude[1]),
        ball_start=min(settings.scenario.ball_start, ball_limit(plant)),
        **common,
    )
    others = [
        dataclasses.replace(reference, omega=s.omega, amplitude=min(s.amplitude, reference.amplitude))
        for s in STANDARD
        if s != REFERENCE and settings.motion.kind == "sine"
    ]
    scenarios = (*others, reference)
    for scenario in scenarios:
        check_scenario(settings, scenario)
    return scenarios


def read_waveform(path: Path) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Times [s] and offsets [m] from a CSV file with two columns; a header line is allowed.

    Raises InputError if the file cannot be read; order and range are checked with the configuration.
    """
    try:
        lines = [line for line in csv.reader(read_text(path, "waveform").splitlines()) if line]
    except csv.Error as error:
        raise InputError(f"waveform {path} cannot be read: {error}") from None
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
