"""Evaluation cells: every follower on every scenario, flown in one batch."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mjxball.config import Config, Plant, ball_reach, cg_reach
from mjxball.control.followers import Follower
from mjxball.errors import InputError
from mjxball.evaluate.metrics import Metrics, measure_batch
from mjxball.policy import Policy
from mjxball.rollout import Trajectory, simulate_batch
from mjxball.scenario import Scenario, check_scenario

REFERENCE = Scenario()
# Copy without CG motion, then five speeds of the CG.
STANDARD = (
    dataclasses.replace(REFERENCE, amplitude=0.0),
    *(dataclasses.replace(REFERENCE, omega=omega) for omega in (0.31, 0.62, 1.0, 2.0, 3.1)),
)


# The metrics of a cell in JSON are fixed; the others are in the judge's scores.
CONTRACT = ("rmse", "settling_time", "overshoot", "x_peak", "y_peak", "z_peak", "max_tilt", "action_error", "failed")


@dataclass(frozen=True)
class Cell:
    """One follower on one scenario."""

    follower: str
    scenario: Scenario
    metrics: Metrics
    flight: Trajectory
    motion: str = "sine"  # how the CG moved: sine, waveform or rolling

    def record(self) -> dict[str, Any]:
        """The cell as `eval.py --json` writes it (keys: docs/metrics.md).

        Flights beyond that contract say so: another motion than a sine (omega and amplitude are then None) and
        mass changes have keys of their own.
        """
        s = self.scenario
        believed = s.mass if s.believed_mass is None else s.believed_mass
        sine = self.motion == "sine"
        keys: dict[str, Any] = {
            "omega": s.omega if sine else None,
            "amplitude": s.amplitude if sine else None,
            "mass": s.mass,
            "believed_mass": believed,
        }
        if not sine:
            keys["motion"] = self.motion
        if s.mass_changes:
            keys["mass_changes"] = [list(change) for change in s.mass_changes]
        return {"follower": self.follower, **keys, **{name: getattr(self.metrics, name) for name in CONTRACT}}


def cross(
    omegas: Sequence[float], amplitudes: Sequence[float], masses: Sequence[float], **common: Any
) -> tuple[Scenario, ...]:
    """Full cross product of the lists, in the given order."""
    cells = itertools.product(omegas, amplitudes, masses)
    return tuple(Scenario(omega=w, amplitude=a, mass=m, **common) for w, a, m in cells)


def standard_scenarios(settings: Config) -> tuple[Scenario, ...]:
    """The standard scenarios as far as the plant allows them, the reference one last; raise InputError if unsound.

    The object has the plant's mass, the CG keeps to the object and to what training draws, a stand's locked axes have
    goal 0, and the goal is drawn in to what training may draw. A waveform or a rolling ball makes one scenario.
    """
    plant = settings.plant
    reach = min(REFERENCE.goal[0], settings.scenario.goal_reach)
    free = {"free": (1, 1, 1), "pivot": (0, 0, 0), "heave": (0, 0, 1)}[plant.stand]
    common: dict[str, Any] = {"mass": plant.object_mass, "goal": tuple(reach * float(axis) for axis in free)}
    reference = dataclasses.replace(
        REFERENCE,
        amplitude=min(REFERENCE.amplitude, cg_reach(plant), settings.scenario.cg_amplitude[1]),
        ball_start=min(settings.scenario.ball_start, ball_reach(plant)),
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


def run_cells(config: Config, followers: Sequence[Follower], scenarios: Sequence[Scenario], physics: str) -> list[Cell]:
    """Fly every follower through every scenario; cells are ordered by scenario, then by follower."""
    flights = simulate_batch(config, [(follower, scenarios) for follower in followers], physics)
    measured = measure_batch(flights, config.scenario.termination_distance, config.plant.rotor_force_max)
    cells = []
    for (i, scenario), (j, follower) in itertools.product(enumerate(scenarios), enumerate(followers)):
        index = j * len(scenarios) + i
        cells.append(Cell(follower.name, scenario, measured[index], flights.world(index), config.motion.kind))
    return cells


def load_policy(path: Path, config: Config, compare_laws: bool = True) -> Policy:
    """Load a policy and refuse one that was made for another plant or rate, or for other control laws."""
    policy = Policy.load(path)
    period = config.timing.control_period
    if abs(policy.control_period - period) > 1e-9:
        raise InputError(f"{path} was made for a control period of {policy.control_period:g} s, not {period:g} s")
    expected = dataclasses.asdict(config.plant)
    made_for = {key: tuple(v) if isinstance(v, list) else v for key, v in policy.card["plant"].items()}
    for key, value in expected.items():
        if key != "object_mass" and made_for.setdefault(key, getattr(Plant(), key)) != value:
            raise InputError(f"{path} was made for another plant: {key} is {made_for[key]!r}, not {value!r}")
    if compare_laws:
        _refuse_other_laws(path, policy.card, config)
    return policy


def _refuse_other_laws(path: Path, card: dict[str, Any], config: Config) -> None:
    """Refuse a policy whose leader or attitude loop was another than the one that it would fly with."""
    trained = card.get("config")
    if not isinstance(trained, dict):
        return
    for section in ("leader", "attitude"):
        for key, value in dataclasses.asdict(getattr(config, section)).items():
            made_for = (trained.get(section) or {}).get(key, value)
            made_for = tuple(made_for) if isinstance(made_for, list) else made_for
            if made_for != value:
                raise InputError(f"{path} was trained with {section}.{key} {made_for!r}, not {value!r}")


def check_bounds(policy: Policy, metrics: Metrics) -> list[str]:
    """What of the card's bounds a policy misses on the reference scenario, one phrase each."""
    misses = ["the flight failed"] if metrics.failed else []
    for name, bound in sorted(policy.card["bounds"].items()):
        value = getattr(metrics, name, None)
        if value is None or value > bound:
            misses.append(f"{name} {'never' if value is None else f'{value:.4g}'} > {bound:g}")
    return misses
