"""The linear model of an assembly is the engine's, to first order."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from mjxball.baselines.assembly_model import ideal_model
from mjxball.baselines.hover_model import STATES, HoverModel, LoadModel, drift_of, hover_model
from mjxball.config import Config, preset, with_plant
from mjxball.control import mixer, rotations
from mjxball.control.leader import pid_command
from mjxball.physics import newton_euler
from mjxball.physics.engine import Load, PlantState, total_wrench
from mjxball.physics.step import make_plant_step, start_state
from mjxball.plant import plant_parameters
from mjxball.plant.teams import ring_config
from mjxball.sim.rigs import rig_config, sample_rigs, unpadded

PAPER, UNIVERSAL = preset("paper"), preset("universal")
PLANTS = {
    "pair": PAPER,
    "ring of 3": ring_config(with_plant(PAPER, "team6"), 3),
    "ring of 4": ring_config(with_plant(PAPER, "team6"), 4),
    "random rig": rig_config(UNIVERSAL, unpadded(sample_rigs(UNIVERSAL, 4, 1, 77).rigs, 4), 0),
}
MOVING = 13  # states that are not disturbances
SMALL = 1e-5  # of each state and command, in its unit


class Engine:
    """One control period of the closed-form engine with the leader in the loop, in the model's coordinates."""

    def __init__(self, config: Config, model: HoverModel):
        self.config, self.model, plant = config, model, config.plant
        self.params = plant_parameters(plant, config.attitude)
        self.step = make_plant_step(config, newton_euler.make_engine(plant, config.attitude))
        mass, zero = np.array([plant.object_mass]), np.zeros(1)
        self.load = Load(mass, mass, zero, zero, zero, np.zeros((1, 0)), np.zeros((1, 0)))
        still = np.zeros((1, 3))
        ball = np.zeros((1, 2)) if len(plant.directions) == 2 else zero
        self.hover = start_state(config, still, still, still, mass, ball)

    def state(self, x: np.ndarray) -> PlantState:
        """That of the model's `x` (22,) without disturbances; all drones share torques, and lift as their masses."""
        model, params = self.model, self.params
        carried = params.known_mass + params.load_share * self.config.plant.object_mass
        drones = np.zeros((len(carried), 4))
        drones[:, 0] = model.mass * x[12] * carried / carried.sum()
        drones[:, 1:3] = model.inertia @ x[10:12] / len(carried)
        drones = mixer.turned(drones, -params.yaw)
        forces = mixer.rotors_from_wrench(drones, params.arm, params.yaw_per_thrust, self.config.plant.layout)
        return self.hover._replace(
            position=-(model.error @ x)[None],
            velocity=-(model.error_rate @ x)[None],
            quaternion=rotations.quaternion_from_euler(np.append(x[6:8], 0.0)[None]),
            rates=np.append(x[8:10], 0.0)[None],
            rotor_force=self.hover.rotor_force + forces,
        )

    def after(self, x: np.ndarray, command: np.ndarray) -> np.ndarray:
        """(13,) error of O, its rate, tilt, its rate, torques over J, lift over M after a period from `x` (22,)."""
        plant, model, leader = self.config.plant, self.model, self.config.leader
        state, commands = self.state(x), np.tile(command, (1, plant.count, 1))
        gains = leader.kp, leader.kd, 0.0
        still = np.zeros((1, 3))
        led = pid_command(-state.position, -state.velocity, still, gains, plant.gravity, np.inf, np.inf)
        commands[:, plant.leader] = led
        moved = self.step(state, commands, self.load)
        wrench = total_wrench(plant, self.params, moved.rotor_force)
        about_cg = wrench.torque - np.cross(np.append(model.moment, 0.0) / model.mass, wrench.force)
        tilt = rotations.euler_from_matrix(rotations.matrix_from_quaternion(moved.quaternion))[0, :2]
        turn = np.linalg.solve(model.inertia, about_cg[0, :2])
        lift = wrench.force[0, 2] / model.mass - plant.gravity
        return np.concatenate([-moved.position[0], -moved.velocity[0], tilt, moved.rates[0, :2], turn, [lift]])


def slope(function: Any, count: int) -> np.ndarray:
    """(m, count) central differences at 0 of `function` of (count,)."""
    steps = SMALL * np.eye(count)
    return np.stack([(function(step) - function(-step)) / (2 * SMALL) for step in steps], axis=1)


@pytest.mark.parametrize("name", PLANTS)
def test_it_is_the_engines_jacobian(name: str) -> None:
    """Within 1e-7 of the largest entry: differences over 2e-5 round to 1e-11, and their third order is as small."""
    config = PLANTS[name]
    assembly = ideal_model(config, "test")
    model = hover_model(config, assembly, LoadModel())
    engine = Engine(config, model)
    seen = np.vstack([model.error, model.error_rate, np.eye(STATES)[6:MOVING]])
    expected = seen @ model.with_leader
    found = slope(lambda z: engine.after(np.append(z, np.zeros(STATES - MOVING)), np.zeros(3)), MOVING)
    np.testing.assert_allclose(expected[:, :MOVING], found, atol=1e-7 * np.abs(found).max())

    carried = assembly.carried(np.array(config.plant.object_mass))
    place = model.moment / model.mass
    asked = np.zeros((3, 3))  # by all followers for the same command
    for number in config.plant.followers:
        x, y = carried[number] * (assembly.mounts[number] - place)
        asked[:2] += np.linalg.solve(model.inertia, np.array([[assembly.kp[0], 0.0, y], [0.0, assembly.kp[1], -x]]))
        asked[2, 2] += carried[number] / carried.sum()
    found = slope(lambda command: engine.after(np.zeros(STATES), command), 3)
    np.testing.assert_allclose(seen @ model.drive @ asked, found, atol=1e-7 * np.abs(found).max())


@pytest.mark.parametrize("name", ["pair", "ring of 3"])
def test_o_recoils_from_the_cg(name: str) -> None:
    """With rotors that ask for nothing else, O has moved by -m (c(T) - c(0)) / M after a period in which c moves.

    The load's torque has tilted the assembly by less than 1e-4 rad by then, which moves O by less than 1e-7 m.
    """
    config = PLANTS[name]
    model = hover_model(config, ideal_model(config, "test"), LoadModel())
    engine, period = Engine(config, model), config.timing.control_period
    mass, amplitude, speed = config.plant.object_mass, 1e-3, 3.0
    load = engine.load._replace(cg_amplitude=np.array([amplitude]), cg_speed=np.array([speed]))
    moment = mass * amplitude * np.array([0.0, speed])  # m c and its rate at time 0, along x
    torque = config.plant.gravity / model.inertia[1, 1]
    x = np.zeros(STATES)
    x[[14, 16]] = torque * moment
    x[3] = -model.error_rate[0] @ x  # O begins at rest
    start = engine.state(x)
    assert np.abs(start.velocity).max() < 1e-12
    moved = engine.step(start, np.zeros((1, config.plant.count, 3)), load)
    predicted = drift_of(LoadModel(frequency=speed, damping=0.0), period) @ x
    recoil = -mass * amplitude * np.sin(speed * period) / model.mass
    assert moved.position[0, 0] == pytest.approx(recoil + speed * mass * amplitude / model.mass * period, abs=1e-7)
    assert -(model.error @ predicted)[0] == pytest.approx(moved.position[0, 0], abs=1e-7)


def test_disturbances_oscillate_and_decay_as_assumed() -> None:
    """d' swings at w, d keeps its mean, and each decays with its time constant: closed forms."""
    load, seconds = LoadModel(frequency=2.0, damping=0.0, wind_time=3.0, lift_time=5.0), 0.7
    drift, x = drift_of(load, seconds), np.zeros(STATES)
    x[13], x[15], x[19], x[21] = 1.0, 0.4, 1.0, 1.0
    moved = drift @ x
    assert moved[13] == pytest.approx(1.0 + 0.4 * np.sin(2 * seconds) / 2, rel=1e-12)
    assert moved[15] == pytest.approx(0.4 * np.cos(2 * seconds), rel=1e-12)
    assert (moved[19], moved[21]) == pytest.approx((np.exp(-seconds / 3), np.exp(-seconds / 5)), rel=1e-12)
    forgets = drift_of(LoadModel(load_time=2.0), seconds) @ x * (x > 0.9)
    assert forgets[13] < 1.0 + 0.4 * seconds
