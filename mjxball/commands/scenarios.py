"""Plant and scenarios from the flags of `eval.py fly`."""

from __future__ import annotations

import argparse
import dataclasses
from collections.abc import Sequence
from typing import Any

from mjxball import cli, config
from mjxball.errors import InputError
from mjxball.evaluate.scenarios import STANDARD, cross, read_waveform, standard_scenarios
from mjxball.sim.scenario import Scenario, check_scenario

SCENARIO_FLAGS = (
    "omega",
    "amplitude",
    "mass",
    "believed_mass",
    "goal",
    "seconds",
    "waveform",
    "mass_change",
    "rolling",
)


def setup_of(options: argparse.Namespace) -> config.Config:
    """Configuration of the paper, or of `--plant`, with the attitude loops and the CG motion of the flags."""
    setup = cli.plant_setup(options.plant)
    if options.wn_pitch is not None:
        roll, _, yaw = setup.attitude.natural_frequency
        setup = config.replace(setup, "attitude.natural_frequency", (roll, options.wn_pitch, yaw))
    _refuse_two_motions(options)
    if options.waveform:
        times, offsets = read_waveform(options.waveform)
        setup = dataclasses.replace(setup, motion=config.Motion(kind="waveform", times=times, offsets=offsets))
    if options.rolling is not None:
        setup = dataclasses.replace(setup, motion=config.Motion(kind="rolling"))
    return config.validate(setup)


def _refuse_two_motions(options: argparse.Namespace) -> None:
    """Raise InputError if flags of two CG motions are given: waveform, rolling ball, sine."""
    ways = {"waveform": "waveform", "rolling": "rolling", "omega": "sine", "amplitude": "sine"}
    given = {name: way for name, way in ways.items() if getattr(options, name) is not None}
    if len(set(given.values())) > 1:
        first, *others = given
        second = next(name for name in others if given[name] != given[first])
        raise InputError(f"--{first} and --{second} exclude each other: the CG moves in one way")


def scenarios_of(options: argparse.Namespace, setup: config.Config) -> Sequence[Scenario]:
    """Scenarios on the paper's plant, or on that of `--plant`: standard ones unless flags or followers are given."""
    given = _given(options)
    if options.plant and not given:
        return standard_scenarios(setup)
    if not (given or options.policies or options.followers):
        return STANDARD
    reference = standard_scenarios(setup)[0]
    ball = reference.ball_start if options.rolling is None else options.rolling
    return _asked(options, setup, reference, ball_start=ball, path=reference.path)


def native_scenarios(options: argparse.Namespace, setup: config.Config) -> Sequence[Scenario]:
    """Scenarios on a plant of Crazyflies: standard ones, or the first one changed by the flags."""
    standard = standard_scenarios(setup)
    if not _given(options):
        return standard[:1] if options.policies or options.followers else standard
    if options.waveform or options.rolling is not None:
        raise InputError("--waveform and --rolling are for the paper's plant; a rig's motion stands in its metadata")
    return _asked(options, setup, standard[0], ball_start=standard[0].ball_start)


def _given(options: argparse.Namespace) -> bool:
    return any(getattr(options, name) is not None for name in SCENARIO_FLAGS)


def _asked(options: argparse.Namespace, setup: config.Config, reference: Scenario, **common: Any) -> Sequence[Scenario]:
    """Cross product of the flags' lists, with the values of `reference` where no flag is given."""
    scenarios = cross(
        options.omega or [reference.omega],
        options.amplitude or [reference.amplitude],
        options.mass or [reference.mass],
        believed_mass=options.believed_mass,
        goal=tuple(options.goal or reference.goal),
        seconds=reference.seconds if options.seconds is None else options.seconds,
        mass_changes=tuple(map(_mass_change, options.mass_change or [])),
        **common,
    )
    for mass in options.mass or []:
        config.check_lift(setup, mass)
    return tuple(check_scenario(setup, scenario) for scenario in scenarios)


def _mass_change(text: str) -> tuple[float, float]:
    """(time [s], added mass [kg]) from `TIME:KG`."""
    try:
        time, mass = map(float, text.split(":"))
    except ValueError:
        raise InputError(f"--mass-change takes TIME:KG, for example 10:0.2, not {text!r}") from None
    return time, mass
