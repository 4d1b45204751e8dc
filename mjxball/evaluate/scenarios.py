"""Scenarios of the evaluation: the reference, the standard list, cross products, waveforms from files."""

from __future__ import annotations

import csv
import dataclasses
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mjxball.config import Config, ball_limit, cg_limit, preset, thrust_over_weight, total_mass
from mjxball.errors import InputError
from mjxball.files import read_text
from mjxball.plant.trim import heaviest_object, largest_amplitude
from mjxball.reading import check_times
from mjxball.sim.scenario import CIRCLE, Scenario, check_scenario, of_plant
from mjxball.terminal import warn

REFERENCE = of_plant(preset("paper"), Scenario())
STANDARD = (
    REFERENCE,
    dataclasses.replace(REFERENCE, amplitude=0.0),
    *(dataclasses.replace(REFERENCE, omega=omega) for omega in (0.62, 1.0, 2.0, 3.1)),
)
MOST_SAMPLES = 100_000
LONGEST_STEP = 60.0  # longest usual time between two samples of a waveform [s]


def cross(
    omegas: Sequence[float], amplitudes: Sequence[float], masses: Sequence[float], **common: Any
) -> tuple[Scenario, ...]:
    """All combinations of CG speeds [rad/s], amplitudes [m] and masses [kg], in the given order."""
    cells = itertools.product(omegas, amplitudes, masses)
    return tuple(Scenario(omega=w, amplitude=a, mass=m, **common) for w, a, m in cells)


def standard_scenarios(settings: Config) -> tuple[Scenario, ...]:
    """The standard scenarios, adapted to the plant, with the reference first; raises InputError if one is invalid.

    Load and goal are the plant's (`of_plant`); the reference's CG speed is clipped to the training range. A waveform or
    a rolling ball gives one scenario. In the plane the CG moves in a circle.
    """
    plant, path = settings.plant, CIRCLE if len(settings.plant.directions) == 2 else REFERENCE.path
    start = min(settings.scenario.ball_start, ball_limit(plant))
    slowest, fastest = settings.scenario.cg_speed
    omega = min(max(REFERENCE.omega, slowest), fastest)
    reference = of_plant(settings, Scenario(omega=omega, path=path, ball_start=start))
    others = [
        dataclasses.replace(reference, omega=s.omega, amplitude=min(s.amplitude, reference.amplitude))
        for s in STANDARD
        if s != REFERENCE and settings.motion.kind == "sine"
    ]
    return tuple(check_scenario(settings, scenario) for scenario in (reference, *others))


def rig_summary(settings: Config, mass: float | None = None) -> str:
    """Summary of a rig for the user, with an object of `mass` [kg]; None: the reference's mass."""
    plant, margin = settings.plant, settings.scenario.trim_margin
    reference = of_plant(settings, Scenario())
    mass = reference.mass if mass is None else mass
    offset = min(largest_amplitude(settings, mass, margin), cg_limit(plant))
    heaviest = heaviest_object(settings, reference.amplitude)
    trimmed = f"CG trimmed up to {offset:.3g} m" if offset >= 0 else "CG not trimmed even at O"
    return (
        f"rig: {plant.count} drones, {total_mass(plant, mass):.4g} kg with an object of {mass:g} kg, "
        f"thrust over weight {thrust_over_weight(plant, mass):.3g}, {trimmed} keeping {margin:.0%} of what "
        f"hovering leaves; so it can hover objects of up to {heaviest:.3g} kg, "
        f"{reference.amplitude:g} m off"
    )


def read_waveform(path: Path) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Times [s] and offsets [m] from a CSV file with two columns; a header line is allowed.

    Raises InputError if the file cannot be read or its times do not increase; offsets are checked with the
    configuration. Gaps between samples, where the motion is interpolated, are reported on stderr.
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
    if len(times) > 1:
        try:
            for remark in check_times(times, longest=LONGEST_STEP):
                warn(f"waveform {path}: {remark}; the CG moves on a spline there")
        except ValueError as error:
            raise InputError(f"waveform {path}: {error}, a header not counted") from None
    return times, offsets
