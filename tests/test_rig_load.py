"""A load that is put on in flight: the twin's physics with it, and how well the log tells of it."""

from __future__ import annotations

import dataclasses
from typing import Any

import mujoco
import numpy as np
import pytest

from mjxball import config as configs
from mjxball.commands.retrain import FlightReplay
from mjxball.fly.limits import FlightSettings
from mjxball.fly.log_schema import decode
from mjxball.fly.supervisor import State
from mjxball.fly.twin.conditions import AddedLoad, Surroundings, drone_kind
from mjxball.fly.twin.coupled import CoupledPair, grounded_model, put_on
from mjxball.fly.twin.virtual import VirtualTwin
from mjxball.policy import Policy, shipped_policy
from mjxball.rig.load import LONGEST, IdentifiedLoad, LoadWatch

LATE = 13.5  # [s] after the motors first turn
TURNED = 0.4  # [s] after which they do
POLICY = Policy.load(shipped_policy("flight"))
# Mass [kg], place from O [m], and what else differs; then how far off mass [kg] and moment [kg m] may be. One standard
# deviation by the fit's own account is 0.1 g and 2e-5 kg m; motors that differ by 3 % shift the moment of all by 4e-5.
LOADS: list[tuple[float, float, dict[str, Any], float, float]] = [
    (0.003, 0.12, {"kind": "older"}, 3e-4, 6e-5),
    (0.005, 0.05, {"gains": (0.98, 1.01)}, 4e-4, 1e-4),
    (0.004, 0.04, {"noise": 2.0, "delay": 0.01}, 5e-4, 1.2e-4),
]


def found(mass: float, offset: float, late: float = LATE, **more: Any) -> IdentifiedLoad | None:
    """What the records of a flight of the shipped policy tell of a load that comes after `late` seconds.

    It is looked for twice a second, as long as the flight is under both laws, or until it is found.
    """
    kind = drone_kind("2.1", more.pop("kind", "linear"))
    around = Surroundings(load=AddedLoad(mass, offset, late) if mass else None, **more)
    world = VirtualTwin(POLICY, FlightSettings(seconds=late + LONGEST), kind=kind, surroundings=around)
    watch, looked, read, load = LoadWatch(world.config), 0.0, 0, None
    while load is None and world.flight.supervisor.state is not State.LAND and world.tick():
        for raw in world.log.records[read:]:
            watch.take(decode(raw) if raw["kind"] == "state" else raw)
        read = len(world.log.records)
        if watch.now - looked >= 0.5:
            looked, load = watch.now, watch.find()
    return load


def assert_found(mass: float, offset: float, more: dict[str, Any], mass_off: float, moment_off: float) -> None:
    load = found(mass, offset, **more)
    assert load is not None
    assert load.mass == pytest.approx(mass, abs=mass_off)
    assert load.moment == pytest.approx(mass * offset, abs=moment_off)


def test_a_load_is_found() -> None:
    load = found(0.004, -0.06)
    assert load is not None
    assert load.mass == pytest.approx(0.004, abs=3e-4)
    assert load.moment == pytest.approx(-0.004 * 0.06, abs=6e-5)
    assert load.time == pytest.approx(LATE + TURNED, abs=0.3)
    # The twin's CG swings by 1 cm of 17.5 g at 0.7 rad/s.
    assert load.swing == pytest.approx(0.0175 * 0.01, rel=0.15)
    assert load.speed == pytest.approx(0.7, rel=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("load", LOADS)
def test_loads_are_found_on_other_firmware_with_uneven_motors_and_noise(load: Any) -> None:
    assert_found(*load)


@pytest.mark.slow
def test_without_a_load_none_is_found() -> None:
    """With noise, for as long as the flights with a load last: what is found then is the one that comes after that."""
    load = found(0.008, 0.0, late=LATE + LONGEST, noise=2.0, seed=3)
    assert load is not None
    assert load.time == pytest.approx(LATE + LONGEST + TURNED, abs=0.3)
    assert load.mass == pytest.approx(0.008, abs=4e-4)
    assert load.moment == pytest.approx(0.0, abs=6e-5)


def test_the_laws_remember_the_same_when_the_log_is_flown_again() -> None:
    world = VirtualTwin(Policy.load(shipped_policy("flight")), FlightSettings(seconds=20.0))
    world.fly_until(State.FLY)
    world.fly_for(3.0)
    replay = FlightReplay(Policy.load(shipped_policy("flight")))
    for raw in world.log.records:
        replay.take(decode(raw) if raw["kind"] == "state" else raw)
    assert replay.place is not None
    controller = world.flight.controller
    np.testing.assert_allclose(replay.place.integral, controller.integral, atol=1e-6)
    # Averages of observations that went through 32 bits in another order.
    np.testing.assert_allclose(replay.place.history, controller.policy.memory, atol=1e-4)


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
    put_on(model, settings.plant, 0.006, -0.05)
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
