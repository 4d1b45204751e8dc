"""Offset-free LQG: its estimates against what the load does, and the network that stands on it."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from command_line import assert_refused, write_arrays
from conftest import Trained

from mjxball.baselines import make_baseline
from mjxball.baselines.assembly_model import ideal_model
from mjxball.baselines.offset_free import offset_free_lqg
from mjxball.commands.train import main
from mjxball.config import preset
from mjxball.errors import InputError
from mjxball.policy import Policy, PolicyFile, load_file
from mjxball.policy.container import PolicyFileError
from mjxball.sim.follower import follower_law
from mjxball.sim.rollout import simulate
from mjxball.sim.scenario import Scenario

CONFIG = preset("balance")


def estimates(mass: float, believed: float, offset: float) -> np.ndarray:
    """The filter's state (8,) after 12 s with a load at rest at `offset` [m]."""
    follower = make_baseline("lqg-offset-free", preset("paper"))
    scenario = Scenario(
        omega=0.0,
        phase=np.copysign(np.pi / 2, offset),
        amplitude=abs(offset),
        mass=mass,
        believed_mass=believed,
        seconds=12,
    )
    flown = simulate(preset("paper"), follower, scenario, "newton-euler")
    assert np.abs(flown.error[-1]).max() < 2e-4
    return follower.law._law.estimate(follower._state, flown.observation[-1])[0]


@pytest.mark.parametrize(("mass", "offset"), [(0.2, 0.05), (0.4, -0.1)])
def test_it_finds_the_loads_torque(mass: float, offset: float):
    """d = m g c at rest, less by what the filter takes the thrusts for: they carry the nominal 0.2 kg."""
    found = estimates(mass, mass, offset)
    assert found[2] == pytest.approx(mass * 9.81 * offset, rel=2e-3)
    assert abs(found[7]) < 1e-3


def test_it_finds_what_a_mass_that_nobody_knows_pulls():
    """The follower lifts it alone, commanding (m - m^) g over the 1.1 kg it believes to lift; half is both's mean."""
    found = estimates(0.3, 0.2, 0.0)
    assert found[7] == pytest.approx(-0.5 * 0.1 * 9.81 / 1.1, rel=1e-3)


def test_the_filter_predicts_a_pair_that_turns_and_climbs():
    """One period of a constant drive from rest, by the equations of motion integrated in small steps."""
    pair, law = ideal_model(preset("paper"), "test"), offset_free_lqg(preset("paper"))
    state, steps = np.array([0.02, -0.1, 0.03, 0.2, 0.01, 0.3, 0.1, -0.2]), 20000
    drive, h = np.array([0.05, 0.4]), preset("paper").timing.control_period / 20000
    moved = state.copy()
    for _ in range(steps):
        angle, rate, torque, growth, rotors, _climb, lift, error = moved
        asked = drive[0] - 2 * pair.kp[1] * angle - 2 * pair.kd[1] * rate
        slope = (rate, (torque + rotors) / pair.inertia[1], growth, 0.0, (asked - rotors) / pair.lag)
        moved = moved + h * np.array([*slope, lift + error, (drive[1] - lift) / pair.lag, 0.0])
    np.testing.assert_allclose(law.transition @ np.append(state, drive), moved, atol=2e-6)


def test_a_network_of_zeros_flies_the_law(estimating: Trained):
    """To float64's rounding, memory included."""
    silent = [np.zeros_like(weight) for weight in estimating.contents.weights]
    biases = [np.zeros_like(bias) for bias in estimating.contents.biases]
    contents = dataclasses.replace(estimating.contents, weights=tuple(silent), biases=tuple(biases))
    scenario = Scenario(amplitude=0.1, omega=1.0, seconds=6)
    plain = make_baseline("lqg-offset-free", preset("paper"))
    flown, expected = (
        simulate(preset("paper"), follower, scenario, "newton-euler")
        for follower in (Policy(contents, "silent", np.float64), plain)
    )
    np.testing.assert_allclose(flown.position, expected.position, rtol=0, atol=1e-9)


def test_other_plants_are_refused(tmp_path, capsys: pytest.CaptureFixture):
    flight = preset("flight")
    with pytest.raises(InputError, match="free pair along x"):
        follower_law(dataclasses.replace(flight, follower=dataclasses.replace(flight.follower, base="lqg")))
    said = assert_refused(main, ["flight", "--follower.base", "lqg", "--out", tmp_path / "run"], tmp_path, capsys)
    assert "lqg" in said


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"format_version": 1}, "lqg"),
        ({"format_version": 3}, "format 3"),
        ({"lqg": None}, "lqg"),
        ({"lqg.gain": [[0.0]]}, "gain"),
        ({"lqg.height": [0.0, float("nan")]}, "height"),
        ({"lqg.stiffness": 0.0}, "stiffness"),
        ({"lqg.odd": 1.0}, "lqg"),
        ({"action_mode": "direct"}, "lqg"),
    ],
)
def test_unsound_numbers_are_named(estimating: Trained, tmp_path, change: dict, named: str):
    path = tmp_path / "follower.npz"
    card = json.loads(json.dumps(estimating.contents.card))
    for field, value in change.items():
        place, _, inner = field.partition(".")
        if inner:
            card[place][inner] = value
        else:
            card[place] = value
    write_arrays(path, arrays_of(estimating.contents), card)
    with pytest.raises(PolicyFileError, match=named):
        load_file(path)


def arrays_of(contents: PolicyFile) -> dict:
    """As they stand in the file."""
    arrays = {name: getattr(contents, name) for name in ("observation_mean", "observation_scale", "action_scale")}
    for number, (weight, bias) in enumerate(zip(contents.weights, contents.biases, strict=True)):
        arrays |= {f"weight_{number}": weight, f"bias_{number}": bias}
    return arrays
