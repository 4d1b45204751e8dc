"""A load that is put on in flight: the twin's physics with it, and what is refused."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest
from command_line import TRANSPORT, assert_one_line, call

from mjxball import config as configs
from mjxball.policy import shipped_policy
from mjxfly.main import main
from mjxfly.twin.conditions import AddedLoad, Surroundings
from mjxfly.twin.coupled import CoupledPair
from mjxfly.twin.grounded import attach_load, grounded_model

REFUSALS = [
    (TRANSPORT, "0.004 0.05 5", "trained on Crazyflies"),
    (shipped_policy("flight"), "0.5 0.05 5", "KG must be 0 to 0.1"),
    (shipped_policy("flight"), "0.004 0.3 5", "M must be -0.15 to 0.15"),
]


def test_refusals(capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("cflib")
    for policy, load, reason in REFUSALS:
        assert call(main, [policy, "--rehearse", "--twin-load", *load.split()]) == 2, load
        errors = capsys.readouterr().err
        assert reason in errors
        assert_one_line(errors)


def inertia_about_o(model: mujoco.MjModel) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass, first moment (3,) and inertia (3, 3) about O at rest, the root's origin."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    origin, total, moment, inertia = data.qpos[:3], 0.0, np.zeros(3), np.zeros((3, 3))
    for body in range(1, model.nbody):
        mass, place = model.body_mass[body], data.xipos[body] - origin
        turned = data.ximat[body].reshape(3, 3)
        own = turned @ np.diag(model.body_inertia[body]) @ turned.T
        inertia += own + mass * (place @ place * np.eye(3) - np.outer(place, place))
        total, moment = total + mass, moment + mass * place
    return total, moment, inertia


def test_the_twin_carries_the_load_where_it_was_put() -> None:
    settings = configs.preset("flight")
    model = grounded_model(settings, settings.plant.object_mass)
    before = inertia_about_o(model)
    attach_load(model, settings.plant, 0.006, -0.05)
    mass, moment, inertia = (new - old for new, old in zip(inertia_about_o(model), before, strict=True))
    assert mass == pytest.approx(0.006, rel=1e-9)
    np.testing.assert_allclose(moment, [0.0, -0.006 * 0.05, 0.0], atol=1e-12)
    np.testing.assert_allclose(inertia, np.diag([1.0, 0.0, 1.0]) * 0.006 * 0.05**2, atol=1e-12)


def test_a_load_moves_nothing_when_it_comes_and_goes_with_a_new_start() -> None:
    """Position and velocity carry over; the motors then lift too little for it."""
    settings = configs.preset("flight")
    around = Surroundings(exact=True, load=AddedLoad(0.006, 0.05, 0.05))
    pairs = [CoupledPair(settings, surroundings=one) for one in (around, dataclasses.replace(around, load=None))]
    hover = np.array([[0.0, 0.0, 0.0, 52000.0]] * 2)
    for _ in range(50):
        states = [pair.advance(hover, 0.001) for pair in pairs]
    np.testing.assert_allclose(states[0].velocity, states[1].velocity, atol=1e-4)
    for _ in range(100):
        states = [pair.advance(hover, 0.001) for pair in pairs]
    loaded, free = (state.velocity[:, 2].mean() for state in states)
    assert loaded <= free
    assert pairs[0].model.body_mass.sum() == pytest.approx(pairs[1].model.body_mass.sum() + 0.006)
    pairs[0].start()
    assert pairs[0].model.body_mass.sum() == pytest.approx(pairs[1].model.body_mass.sum())
