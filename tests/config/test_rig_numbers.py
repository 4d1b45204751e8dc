"""A rig's numbers have one home: load and goal follow from the plant, and numbers in another unit are refused."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import jax
import numpy as np
import pytest
from tables import rows

from mjxball import cli
from mjxball import config as configs
from mjxball.baselines import make_baseline
from mjxball.commands import evaluate, train
from mjxball.config import Config, Drone, Plant, preset, validate, with_plant
from mjxball.env import TransportEnv
from mjxball.errors import InputError
from mjxball.evaluate.policies import group_by_plant
from mjxball.evaluate.scenarios import REFERENCE, rig_summary, standard_scenarios
from mjxball.plant.trim import heaviest_object, largest_margin
from mjxball.policy.file import load_file, save_file, shipped_policy
from mjxball.sim.rollout import simulate
from mjxball.sim.scenario import Scenario, of_plant
from mjxball.view.flight import flight_from

PAIR = "[[plant.drones]]\nmount = [0.17, 0.0, 0.0]\n[[plant.drones]]\nmount = [-0.17, 0.0, 0.0]\n"
HEAVY = "[plant]\nobject_mass = 0.35\n" + PAIR
RING = """
[plant]
cg_axis = "xy"
object_mass = 0.3
object_size = [0.4, 0.4, 0.04]
rotor_force_max = 8.0
[[plant.drones]]
mount = [0.2, 0.0, 0.0]
[[plant.drones]]
mount = [-0.1, 0.17, 0.0]
[[plant.drones]]
mount = [-0.1, -0.17, 0.0]
"""


def written(place: Path, text: str, name: str = "rig.toml") -> Path:
    path = place / name
    path.write_text(text)
    return path


def test_draws_keep_their_proportion_to_the_object_unless_the_file_says_otherwise(tmp_path: Path) -> None:
    rig = with_plant(preset("transport"), written(tmp_path, HEAVY))
    assert rig.scenario.object_mass == pytest.approx((0.175, 0.525))  # 0.1 to 0.3 kg about 0.2
    assert rig.attitude.design_object_mass == pytest.approx(0.35)
    assert rig.scenario.cg_amplitude == (0.0, 0.10)  # the object is as long
    small = with_plant(preset("transport"), written(tmp_path, "[plant]\nobject_size = [0.1, 0.1, 0.05]\n" + PAIR))
    assert small.scenario.cg_amplitude == (0.0, 0.05)  # half its length
    assert small.scenario.object_mass == (0.1, 0.3)
    said = with_plant(preset("transport"), written(tmp_path, HEAVY + "[scenario]\nobject_mass = [0.3, 0.4]\n"))
    assert said.scenario.object_mass == (0.3, 0.4)
    changing = configs.replace(preset("transport"), "scenario.mass_change", (-0.05, 0.06))
    assert with_plant(changing, written(tmp_path, HEAVY)).scenario.mass_change == pytest.approx((-0.0875, 0.105))
    drawn = TransportEnv(rig, "newton-euler").reset(jax.random.key(0)).pipeline_state.load.object_mass
    assert 0.175 <= float(drawn) <= 0.525


def test_every_command_flies_the_object_of_the_plant(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, out = written(tmp_path, HEAVY), tmp_path / "cells.json"
    rig = with_plant(preset("paper"), path)
    short = Scenario(seconds=0.1)
    flown = simulate(rig, make_baseline("copy", rig), short, "newton-euler")
    np.testing.assert_array_equal(flown.object_mass, 0.35)
    bare = simulate(rig.plant, make_baseline("copy", rig), short, "newton-euler")
    np.testing.assert_array_equal(bare.object_mass, 0.35)
    np.testing.assert_array_equal(flight_from("copy", {"seconds": 0.1}, "newton-euler", path)["object_mass"], 0.35)
    asked = ["--plant", str(path), "--followers", "copy", "--physics", "newton-euler", "--seconds", "0.1"]
    assert evaluate.main([*asked, "--json", str(out)]) == 0
    assert [cell["mass"] for cell in json.loads(out.read_text())["cells"]] == [0.35]
    first = capsys.readouterr().out.splitlines()[0]
    assert first == rig_summary(rig)
    held = heaviest_object(rig, 0.05)
    assert f"can hover objects of up to {held:.3g} kg, 0.05 m off" in first
    assert largest_margin(rig, held, 0.05).margin == pytest.approx(rig.scenario.trim_margin, abs=5e-3)
    # 8 rotors of 5.5 N, two drones of 1 kg
    assert "2.35 kg with an object of 0.35 kg" in first
    assert f"thrust over weight {44 / (2.35 * 9.81):.3g}," in first
    out.unlink()
    assert evaluate.main([*asked, "--mass", "0.25", "--json", str(out)]) == 0  # the user says otherwise
    assert [cell["mass"] for cell in json.loads(out.read_text())["cells"]] == [0.25]


def test_what_a_file_says_of_its_scenario_is_flown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "cells.json"
    path = written(tmp_path, "[scenario]\nobject_mass = [0.35, 0.4]\ncg_speed = [2.0, 3.0]\n")
    asked = ["--plant", str(path), "--followers", "copy", "--physics", "newton-euler", "--seconds", "0.1"]
    assert evaluate.main([*asked, "--json", str(out)]) == 0
    (cell,) = json.loads(out.read_text())["cells"]
    assert (cell["mass"], cell["omega"]) == (0.35, 2.0)
    assert "2.35 kg with an object of 0.35 kg" in capsys.readouterr().out
    out.unlink()
    assert evaluate.main([*asked, "--mass", "0.1", "0.5", "--json", str(out)]) == 0
    assert "an object of 0.5 kg" in capsys.readouterr().out  # the heaviest that is flown


def test_what_nobody_can_lift_is_not_flown(capsys: pytest.CaptureFixture[str]) -> None:
    assert evaluate.main(["--followers", "copy", "--mass", "35", "--seconds", "0.1"]) == 2
    error = capsys.readouterr().err
    assert "35 g would be 0.035 kg" in error
    assert error.count("\n") == 1


def test_the_paper_flies_as_before() -> None:
    assert (REFERENCE.mass, REFERENCE.amplitude, REFERENCE.goal) == (0.2, 0.05, (1.0, 1.0, 1.0))
    for name in ("paper", "transport", "balance"):
        assert standard_scenarios(preset(name))[0] == REFERENCE


@rows(
    "name, mass, amplitude, goal",
    [
        ("flight", 0.0175, 0.02, (0.5, 0.5, 0.5)),  # drawn loads go to 2 cm and goals to 0.5 m
        ("stand", 0.0175, 0.0, (0.0, 0.0, 0.0)),
        ("team", 0.6, 0.05, (1.0, 1.0, 1.0)),
    ],
)
def test_a_scenario_without_numbers_is_of_the_plant(name: str, mass: float, amplitude: float, goal: tuple) -> None:
    found = of_plant(preset(name), Scenario())
    assert (found.mass, found.amplitude, found.goal) == (mass, amplitude, goal)
    given = Scenario(mass=0.1, amplitude=0.01, goal=(0.0, 0.0, 0.3))
    assert of_plant(preset(name), given) == given


def test_a_policy_of_a_rig_of_its_own_flies_that_rig(tmp_path: Path) -> None:
    path = tmp_path / "mine.npz"
    contents = load_file(shipped_policy("balance"))
    rig = with_plant(preset("balance"), written(tmp_path, HEAVY))
    settings = configs.to_dict(rig)
    save_file(
        path,
        dataclasses.replace(contents, metadata={**contents.metadata, "plant": settings["plant"], "config": settings}),
    )
    paper, ((own, files),) = group_by_plant([path, shipped_policy("balance")])
    assert (own.plant.object_mass, files, paper) == (0.35, [path], [shipped_policy("balance")])
    assert standard_scenarios(own)[0].mass == 0.35


def test_flags_and_plant_file_are_refused_or_taken_together(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    ring = str(written(tmp_path, RING))

    def settings(*more: str) -> Config:
        options = train.parser().parse_args(["team", "--plant", ring, *more])
        return cli.apply_config_flags(preset("team"), options)

    assert settings("--scenario.team_sizes", "3").scenario.team_sizes == (3,)
    assert settings("--scenario.team_sizes", "").scenario.team_sizes == ()
    assert settings("--scenario.team_sizes", "3").scenario.object_mass == pytest.approx((0.15, 0.45))
    chosen = settings("--scenario.team_sizes", "3", "--scenario.object_mass", "0.2,0.3")
    assert chosen.scenario.object_mass == (0.2, 0.3)
    assert train.main(["team", "--plant", ring, "--out", str(tmp_path / "run")]) == 2
    assert "set scenario.team_sizes to 3 or less" in capsys.readouterr().err
    assert train.main(["team", "--plant", str(written(tmp_path, RING.replace('cg_axis = "xy"', ""), "line.toml"))]) == 2
    assert "set plant.cg_axis to xy" in capsys.readouterr().err


@rows("name", ["team", "universal"])
def test_a_file_for_a_preset_of_many_teams_is_flown_as_its_own(name: str, tmp_path: Path) -> None:
    setup = cli.plant_setup(written(tmp_path, f'preset = "{name}"\n{RING}'))
    assert (setup.preset, setup.plant.count, setup.scenario.team_sizes) == (name, 3, ())


@rows(
    "changes, said",
    [
        ({"plant.object_mass": 35.0}, "35 g would be 0.035 kg"),
        ({"plant.drones.0.mass": 1000.0, "plant.drones.1.mass": 1000.0}, "1000 g would be 1 kg"),
        ({"plant.carrier_mass": 50.0, "plant.carrier_inertia": (1e-3, 1e-3, 2e-3)}, "50 g would be 0.05 kg"),
        ({"plant.arm": 46.0}, "46 mm would be 0.046 m"),
        ({"plant.drones.1.arm": 46.0}, "plant.drones.1.arm 46 m"),
        ({"plant.object_size": (340.0, 100.0, 50.0)}, "340 mm would be 0.34 m"),
        ({"plant.drones.0.mount": (170.0, 0.0, 0.0)}, "170 mm would be 0.17 m"),
        ({"plant.rotor_lag": 30.0}, "30 ms would be 0.03 s"),
        ({"plant.rotor_force_max": 5500.0}, "5500 mN would be 5.5 N"),
        ({"plant.rotor_force_max": 550.0}, "550 gf would be 5.4 N"),
        ({"plant.rotor_force_max": 0.0055}, "0.0055 kN would be 5.5 N"),
        ({"plant.rotor_force_max": 0.0055}, "thrust over weight is 0.002"),
        (
            {"plant.yaw_per_thrust": 16.0},
            "plant.yaw_per_thrust 16 m is more than 10 times the arm of 0.12 m; 16 mm would be 0.016 m",
        ),
        ({"plant.carrier_mass": 0.2, "plant.carrier_inertia": (6.7, 6.7, 6.7)}, "6.7 g m2 would be 0.0067 kg m2"),
        ({"plant.gravity": 981.0}, "981 cm/s2 would be 9.81 m/s2"),
        ({"scenario.object_mass": (0.1, 3.0)}, "thrust over weight is 0.9"),  # the heaviest drawn cannot be lifted
        ({"plant.drones.0.inertia": (2300.0, 2300.0, 4000.0)}, "kg mm2 would be 0.004 kg m2"),
        ({"plant.drones.0.inertia": (2.3, 2.3, 4.0)}, "4 g m2 would be 0.004 kg m2"),
        ({"plant.rotor_lag": 0.2}, "must be below 9 rad/s"),  # 2 zeta / lag
        ({"attitude.natural_frequency": (2000.0, 10.0, 4.0)}, "at most 100"),
        ({"attitude.natural_frequency": (0.5, 10.0, 4.0)}, "slower than the leader's"),
    ],
)
def test_numbers_in_another_unit_are_refused_with_the_one_that_was_meant(changes: dict, said: str) -> None:
    config = preset("transport")
    for path, value in changes.items():
        config = configs.replace(config, path, value)
    with pytest.raises(InputError) as refused:
        validate(config)
    assert said in str(refused.value)


def test_rigs_of_any_size_in_sound_proportion_are_taken() -> None:
    """From a Crazyflie's tenth to ten times the paper's drones: masses by s^3, inertia by s^5, forces by s^3."""
    for scale in (0.05, 0.3, 1.0, 5.0):
        drones = tuple(
            Drone(
                mass=scale**3,
                inertia=(2.3e-3 * scale**5, 2.3e-3 * scale**5, 4.0e-3 * scale**5),
                mount=(side * 0.17 * scale, 0.0, 0.0),
            )
            for side in (1, -1)
        )
        size = (0.34 * scale, 0.10 * scale, 0.05 * scale)
        plant = Plant(
            drones=drones,
            object_mass=0.2 * scale**3,
            object_size=size,
            ball_radius=0.02 * scale,
            arm=0.12 * scale,
            rotor_force_max=5.5 * scale**3,
        )
        settings = {"object_mass": (0.1 * scale**3, 0.3 * scale**3), "cg_amplitude": (0.0, 0.1 * scale)}
        config = configs.replace(preset("transport"), "plant", plant)
        for name, value in settings.items():
            config = configs.replace(config, f"scenario.{name}", value)
        assert configs.thrust_over_weight(validate(config).plant) == pytest.approx(44 / (2.2 * 9.81))
