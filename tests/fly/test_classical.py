"""Classical followers that fly Crazyflies by name: as in simulation, on the twin, and what is refused."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from mjxball.baselines import make_baseline
from mjxball.cli import plant_setup
from mjxball.config import preset
from mjxball.errors import InputError
from mjxball.export import in_team
from mjxball.policy import load_file, shipped_policy
from mjxfly import main as flying
from mjxfly.classical import NAMES, ClassicalFollower, classical, is_classical
from mjxfly.controller import FlightController
from mjxfly.limits import FlightSettings
from mjxfly.policy_setup import goal_of, load_follower
from virtual_twin import VirtualTwin

PLANTS = ("crazyflie", "crazyflie-thrust-upgrade", "crazyflie-brushless")


@pytest.mark.parametrize("name", NAMES)
def test_it_commands_what_the_baseline_does_in_simulation(name: str) -> None:
    """No integral of the runner is added to it."""
    follower, config = load_follower(Path(name)), preset("flight")
    alone, controller = make_baseline(name, config), FlightController(follower)
    assert follower.control_period == config.timing.control_period
    random, goal = np.random.default_rng(2), np.array([0.1, -0.2, 0.4])
    for number in range(40):
        state = type("State", (), {})()
        state.position, state.velocity, state.rates = random.normal(scale=0.05, size=(3, 3))
        state.quaternion = np.array([1.0, *random.normal(scale=0.02, size=3)])
        commands = controller.step(state, goal)
        np.testing.assert_allclose(commands.follower, alone(commands.observation), atol=1e-12)
        if number == 20:
            controller.reset(), alone.reset()
    assert np.abs(commands.follower).max() > 1e-3
    assert commands.hidden is None


@pytest.mark.parametrize("plant", PLANTS)
def test_its_metadata_are_those_of_a_policy_for_the_plant(plant: str) -> None:
    """Apart from the network's own, and the integrals that are not added."""
    found = classical("lqg", Path(plant)).metadata
    policy = in_team(load_file(shipped_policy("flight")), "flight", Path(plant)).metadata
    for field in ("command_limits", "leader_kp", "leader_kd", "gravity", "control_period", "preset"):
        assert found[field] == policy[field]
    assert json.dumps(found["plant"]["drones"]) == json.dumps(policy["plant"]["drones"])


def test_lqg_hovers_on_the_twin() -> None:
    follower = load_follower(Path("lqg"))
    goal = goal_of(FlightController(follower).config)
    world = VirtualTwin(follower, FlightSettings(seconds=8.0, goal=goal))
    assert world.run() == "done"
    late = np.array([moment.position for moment in world.track if moment.state == "fly"])[500:]
    errors = np.linalg.norm(late - np.array(goal) - [0.0, 0.0, world.rest], axis=1)
    assert errors.max() < 0.01
    assert world.touchdown_speed() < 0.4
    # It goes down where it hovered, since it knows the rate of the goal.
    down = np.array([moment.position for moment in world.track if moment.state == "land"])
    assert np.abs(down[:, :2] - np.array(goal)[:2]).max() < 0.03


def test_a_file_of_that_name_is_a_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert is_classical(Path("lqg"))
    Path("lqg").write_bytes(b"no policy")
    assert not is_classical(Path("lqg"))


@pytest.mark.parametrize(
    ("line", "words"),
    [
        (["lqg", "--rehearse", "--plant", "pair"], "--plant pair is no pair of Crazyflies"),
        (["lqg", "--rehearse", "--plant", "nowhere.toml"], "nowhere.toml"),
        (["lqg", "--rehearse", "--onboard"], "--onboard runs a network in C, and lqg is none"),
        (["flight", "--rehearse", "--plant", "crazyflie"], "--plant is for lqg, lqg-calm, lqg-disturbed"),
    ],
)
def test_what_is_refused(line: list[str], words: str, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("cflib")
    assert flying.main(line) == 2
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1


def test_without_scipy_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mjxball.baselines", None)
    config = plant_setup(Path("crazyflie"))
    with pytest.raises(InputError, match=r"pip install 'mjxball\[fly\]'"):
        ClassicalFollower("lqg", config)


def test_a_policy_is_loaded_without_scipy() -> None:
    """The runner imports it for classical followers alone."""
    load = "from mjxfly.policy_setup import load_follower; load_follower(shipped_policy('flight'))"
    line = (
        f"from mjxball.policy import shipped_policy; {load}; import mjxfly.main, sys; sys.exit('scipy' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", line], check=False).returncode == 0
