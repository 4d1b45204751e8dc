"""What a recurrent follower of a team is told: where the drones are mounted."""

from __future__ import annotations

import dataclasses
import math

import jax
import numpy as np
import pytest
from tables import rows

from mjxball import config as configs
from mjxball.algorithms.base import PolicyNetwork
from mjxball.config import Config, preset
from mjxball.control.geometry import GEOMETRY, team_geometry
from mjxball.env import TransportEnv
from mjxball.errors import InputError
from mjxball.evaluate.policies import load_policy
from mjxball.plant.teams import ring_config
from mjxball.policy import Policy, PolicyFile
from mjxball.policy.container import PolicyFileError
from mjxball.policy.export import policy_file
from mjxball.policy.file import save_file
from mjxball.policy.inference import geometry_of
from mjxball.sim.follower import network_interface

TEAM = preset("team")
ENGINE = "newton-euler"


def ring(count: int) -> Config:
    return ring_config(TEAM, count)


@rows("count", [2, 3, 6])
def test_of_a_ring(count: int) -> None:
    """A pair's torque about pitch is N a m r^2 with a = 1, that of a ring of more drones with a = 1/2."""
    config = ring(count)
    told = np.atleast_2d(geometry_of(config.plant))
    assert told.shape == (count - 1, 4)
    radius, spread = math.hypot(*config.plant.drones[0].mount), 1.0 if count == 2 else 0.5
    np.testing.assert_allclose(told[:, 0], count / (count - 1))
    np.testing.assert_allclose(np.hypot(told[:, 1], told[:, 2]), 1.25 / (radius * count * spread), rtol=1e-9)
    np.testing.assert_allclose(told[:, 3], 1.75 * 2 * math.sin(math.pi / count) / (spread * radius), rtol=1e-9)
    if count % 2 == 0:  # the follower across from the leader has it straight ahead: lifting pitches, nose up to it
        np.testing.assert_allclose(told[count // 2 - 1, 1], 0.0, atol=1e-12)
        assert told[count // 2 - 1, 2] > 0


def test_turning_a_team_changes_nothing() -> None:
    plant = ring(4).plant
    mounts = np.array([drone.mount for drone in plant.drones])
    c, s = math.cos(0.7), math.sin(0.7)
    turned = mounts @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    told = [team_geometry(plant, places, np.float64(4)) for places in (mounts, turned)]
    np.testing.assert_allclose(told[1], told[0], rtol=1e-9, atol=1e-12)


def test_worlds_of_training_are_told_what_a_flight_is_told() -> None:
    env = TransportEnv(configs.replace(TEAM, "scenario.mount_scale", (1.0, 1.0)), ENGINE)
    world = jax.jit(env.reset)(jax.random.key(0), 1).pipeline_state  # of three drones
    np.testing.assert_allclose(world.memory[:2, -4:], geometry_of(ring(3).plant), rtol=1e-5, atol=1e-6)


def silent(config: Config) -> PolicyFile:
    """A network of zeros."""
    controller, units = network_interface(config), config.follower.recurrent_units
    size = controller.input_size
    shapes = {"hidden_0": (size + units, 8), "hidden_1": (8 + units, 6)}
    layers = {name: {"kernel": np.zeros(shape), "bias": np.zeros(shape[1])} for name, shape in shapes.items()}
    gates = 3 * units
    gru = {"kernel": np.zeros((size, gates)), "recurrent": np.zeros((units, gates)), "bias": np.zeros(gates)}
    learnt = PolicyNetwork({**layers, "gru": gru}, np.zeros(size), np.ones(size), np.ones(size))
    return policy_file(config, controller, learnt, steps=0)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory):
    path = tmp_path_factory.mktemp("team") / "silent.npz"
    save_file(path, silent(TEAM))
    return path


def test_what_a_policy_is_not_told_or_not_made_for_is_refused(file) -> None:
    with pytest.raises(InputError, match="must know its team"):
        Policy.load(file)(np.zeros((2, 18)))
    with pytest.raises(InputError, match="2 to 6 drones, not 8"):
        load_policy(file, ring_config(configs.replace(TEAM, "scenario.team_sizes", ()), 8))
    with pytest.raises(InputError, match="moves in the plane"):
        load_policy(file, preset("transport"))


@rows(
    "given, said",
    [
        ({"context": ["mass"]}, f"another context than this version's {', '.join(GEOMETRY)}"),
        ({"team": [2.0] * 4}, "team must hold drone, mount_angle and context"),
        ({"team": {"drone": 1, "mount_angle": "0", "context": [2.0] * 4}}, "team.drone and team.mount_angle must be"),
        ({"team": {"drone": 1, "mount_angle": 0.0, "context": [2.0] * 5}}, "team.context must be 4 finite numbers"),
        ({"team": {"drone": 1, "mount_angle": 0.0, "context": ["2.0"] * 4}}, "team.context must be 4 finite numbers"),
        ({"team": {"drone": 1, "mount_angle": 0.0, "context": [1.0] * 4}}, "must be above 1"),
        ({"team": {"drone": 1, "mount_angle": 0.0, "context": [2.0, 0.0, 0.0, 0.0]}}, "rotor_room positive"),
    ],
)
def test_unsound_files_are_refused(given: dict, said: str, tmp_path) -> None:
    contents = silent(TEAM)
    with pytest.raises(PolicyFileError, match=said):
        save_file(tmp_path / "unsound.npz", dataclasses.replace(contents, metadata=contents.metadata | given))
