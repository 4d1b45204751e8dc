"""Plant files: what is shipped, and what is refused in one sentence."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from tables import rows

from mjxball import config as configs
from mjxball.assembly import build_model
from mjxball.commands import evaluate, train
from mjxball.config import Attitude, Config, Plant
from mjxball.errors import InputError
from mjxball.plant import plant_parameters

RING = """
[plant]
cg_axis = "xy"
carrier_mass = 0.1
carrier_inertia = [1e-3, 1e-3, 2e-3]
object_size = [0.4, 0.4, 0.04]
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


def shipped(name: str) -> Config:
    """The configuration of the shipped plant `name`, on the preset that it belongs to."""
    return configs.with_plant(configs.preset(configs.read_plant(name).preset or "transport"), name)


@rows("name", configs.PLANTS)
def test_every_shipped_plant_is_sound_and_is_a_model(name: str) -> None:
    plant = shipped(name).plant
    model = build_model(plant)
    assert model.nu == 4 * plant.count
    weight = sum(drone.mass for drone in plant.drones) + plant.carrier_mass + plant.object_mass
    assert model.body_mass.sum() == pytest.approx(weight)


def test_shipped_files_are_the_plants_of_the_presets() -> None:
    assert shipped("pair").plant == Plant() == configs.preset("transport").plant == configs.preset("paper").plant
    assert shipped("stand") == configs.preset("stand")
    assert shipped("crazyflie") == configs.preset("flight")


@rows("count", [3, 4, 6])
def test_teams_stand_on_a_ring_with_neighbours_0_34_m_apart(count: int) -> None:
    config = shipped(f"team{count}")
    plant, radius = config.plant, 0.17 / math.sin(math.pi / count)
    places = np.array([drone.mount for drone in plant.drones])
    # 1e-6: the files hold micrometres
    np.testing.assert_allclose(np.linalg.norm(places, axis=-1), radius, atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(places - np.roll(places, 1, axis=0), axis=-1), 0.34, atol=2e-6)
    assert plant.of_drones("rotor_force_max") == (8.0,) * count
    np.testing.assert_allclose(plant.load_shares, 1 / count, atol=1e-5)
    assert plant.carrier_mass == pytest.approx(0.05 * count)
    assert config.scenario.object_mass == pytest.approx((0.1 * count, 0.1 * count))
    np.testing.assert_allclose(plant.carrier_inertia, 0.05 * count * radius**2 / np.array([4, 4, 2]), rtol=1e-3)
    # Each takes its part of the coupled inertia's gains: Kp = J wn^2 / N, Kd = 2 J zeta wn / N.
    parameters = plant_parameters(plant, config.attitude)
    inertia = np.diag(parameters.drone_inertia) + plant.object_mass * parameters.object_inertia_per_mass
    np.testing.assert_allclose(parameters.gains.kp, inertia * np.array([10, 10, 4]) ** 2 / count, rtol=1e-12)
    np.testing.assert_allclose(parameters.gains.kd, 2 * 0.9 * inertia * np.array([10, 10, 4]) / count, rtol=1e-12)


def test_plate_is_that_of_its_description() -> None:
    plant = shipped("plate4").plant
    corners = {tuple(drone.mount[:2]) for drone in plant.drones}
    assert corners == set(itertools.product((0.2, -0.2), repeat=2))
    assert (configs.ball_limit(plant), plant.carrier_mass, plant.object_mass) == (0.14, 0.2, 0.2)
    # A solid ball of 0.2 kg and 2 cm
    np.testing.assert_allclose(0.2 * plant_parameters(plant, Attitude()).ball_inertia_per_mass, 0.4 * 0.2 * 0.02**2)


def test_a_file_that_lists_drones_is_a_whole_plant_and_others_say_what_differs(tmp_path: Path) -> None:
    pair = configs.replace(configs.preset("paper"), "plant.arm", 0.2)
    whole = configs.with_plant(pair, written(tmp_path, RING)).plant
    assert (whole.count, whole.arm) == (3, Plant().arm)
    changed = configs.with_plant(pair, written(tmp_path, "[plant.drones.1]\nmass = 2", "changed.toml")).plant
    assert (changed.arm, changed.drones[1].mass) == (0.2, 2.0)
    assert changed.drones[0] == pair.plant.drones[0]
    based = configs.with_plant(pair, written(tmp_path, 'base = "team4"\n[plant]\narm = 0.1', "based.toml")).plant
    assert (based.count, based.arm) == (4, 0.1)
    as_json = written(tmp_path, '{"plant": {"drones": [{"mount": [0.2, 0, 0]}, {"mount": [-0.2, 0, 0]}]}}', "two.json")
    assert configs.with_plant(pair, as_json).plant.pair[0].mount == (0.2, 0.0, 0.0)


REFUSED = {
    "no TOML": ("drones = [", "is not TOML"),
    "nothing": ("", "must be one TOML object"),
    "no setting of a plant": ("[sac]\nalpha = 1", "may set"),
    "unknown base": ('base = "team5"', "base must be one of"),
    "unknown preset": ('preset = "nobody"\n' + RING, "is none of"),
    "unknown key": (
        RING.replace("carrier_mass", "carrier_weight"),
        "plant.carrier_weight is not a setting; `train.py --help all` lists them",
    ),
    "misspelt key": (RING.replace("carrier_mass", "carier_mass"), "setting (did you mean plant.carrier_mass?)"),
    "unknown table": ("[wings]\n" + RING, "not wings"),
    "mass beyond all floats": (RING + f"mass = 1{'0' * 400}", "a whole number has 401 digits"),
    "object_mass beyond all floats": (
        RING.replace("[plant]", f"[plant]\ngravity = 1{'0' * 400}", 1),
        "a whole number has 401 digits",
    ),
    "unknown key of a drone": (RING + "weight = 1.0", "unknown weight"),
    "drones in one place": (RING.replace("[-0.1, -0.17, 0.0]", "[-0.1, 0.17, 0.0]"), "the same place"),
    "one drone": ("[[plant.drones]]\nmass = 1.0", "2 to 16 drones"),
    "drones that are none": ("[plant]\ndrones = [1, 2]", "a list of tables"),
    "a mount out of reach": (RING.replace("[0.2, 0.0, 0.0]", "[20.0, 0.0, 0.0]"), "drones.0.mount lies beyond 10 m"),
    "a flat mount": (RING.replace("[0.2, 0.0, 0.0]", "[0.2, 0.0]"), "drones.0.mount takes 3 numbers"),
    "singular inertia": (RING + "inertia = [0.0, 1e-3, 1e-3]", "drones.2.inertia must be between"),
    "inertia of no body": (
        RING + "inertia = [1e-3, 1e-3, 5e-3]",
        "drones.2.inertia (0.001, 0.001, 0.005) is that of",
    ),
    "singular carrier": (RING.replace("[1e-3, 1e-3, 2e-3]", "[0.0, 0.0, 0.0]"), "is singular"),
    "negative mass": (RING + "mass = -1.0", "drones.2.mass must be between"),
    "mass is not a number": (RING + "mass = nan", "drones.2.mass must be between"),
    "mass is a word": (RING + 'mass = "heavy"', "drones.2.mass takes numbers"),
    "object_mass is a word": (RING.replace("[plant]", '[plant]\nobject_mass = "0.3"', 1), "object_mass takes numbers"),
    "ten thousand drones": (RING + "[[plant.drones]]\nmount = [0.1, 0.1, 0.0]\n" * 10_000, "is larger than 64 KiB"),
    "rim off the carrier": (RING.replace("[plant]", "[plant]\nball_stop = 0.3", 1), "lies off the object"),
    "load outside its carrier": (RING + "[scenario]\ncg_amplitude = [0.0, 0.3]", "leaves the object"),
    "the follower first": ('base = "pair"\n[plant]\nleader = 1\n', "must lie ahead"),
    "the leader second": (
        'base = "crazyflie"\nplant.leader = 1\nplant.drones.0.mount = [0.0, -0.15, 0.0]\n'
        "plant.drones.1.mount = [0.0, 0.15, 0.0]",
        "need the leader listed first",
    ),
    "a Crazyflie that is turned": ('base = "crazyflie"\n[plant.drones.1]\nyaw = 0.5', "no yaw"),
    "nobody leads": (RING.replace("[plant]", "[plant]\nleader = 3", 1), "none of the 3 drones"),
    "a mount that is no number": (RING.replace("[0.2, 0.0, 0.0]", "[nan, 0.0, 0.0]"), "drones.0.mount must be between"),
    "negative rotors": (RING + "rotor_force_max = -8.0", "drones.2.rotor_force_max must be between"),
}


@rows("mistake", REFUSED)
def test_mistakes_are_refused_in_one_sentence(mistake: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    text, said = REFUSED[mistake]
    out = tmp_path / "run"
    assert train.main(["--plant", str(written(tmp_path, text)), "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not out.exists()


@rows("name", ["team4", "plate4"])
def test_what_flies_two_drones_refuses_more(name: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    for main, more, said in (
        (evaluate.main, ["policies/balance.npz"], "made for a plant of 2 drones, not 4"),
        (train.main, [], "make it a multiple of 3"),
    ):
        out = tmp_path / "out"
        assert main([*more, "--plant", name, "--out", str(out)]) == 2
        error = capsys.readouterr().err
        assert said in error
        assert error.count("\n") == 1
        assert not out.exists()


def test_shares_hold_the_load_level() -> None:
    for name in ("team3", "plate4", "crazyflie"):
        plant = shipped(name).plant
        shares, places = np.array(plant.load_shares), np.array([drone.mount for drone in plant.drones])
        assert shares.sum() == pytest.approx(1)
        np.testing.assert_allclose(shares @ places, 0, atol=1e-6)
    crooked = configs.replace(Plant(), "drones.0.mount", (0.31, 0.0, 0.0))
    # The follower at -0.17 m carries more: the lever rule.
    np.testing.assert_allclose(crooked.load_shares, [0.17 / 0.48, 0.31 / 0.48], rtol=1e-12)
    with pytest.raises(InputError, match="nothing holds the load"):
        configs.validate(configs.replace(Config(), "plant.drones.0.mount", (-0.17, 0.3, 0.0)))


def test_no_number_of_a_plant_may_be_none_or_endless_or_below_its_bound() -> None:
    """Every leaf of a team's plant, its drones' own included."""
    team = configs.with_plant(configs.preset("paper"), "team3")
    tried = 0
    for path, value, item in configs.leaves(team.plant):
        if isinstance(value, (str, int)) and not isinstance(value, float):
            continue
        for wrong in (math.nan, math.inf, item.metadata["low"] - 1.0):
            changed = (wrong,) * len(value) if isinstance(value, tuple) else wrong
            with pytest.raises(InputError, match=path.rpartition(".")[2]):
                configs.validate(configs.replace(team, f"plant.{path}", changed))
            tried += 1
    assert tried > 60
