"""What `python -m mjxfly.rig.design` says of a rig, and the picture."""

from __future__ import annotations

import math
import re
from pathlib import Path
from xml.etree import ElementTree

import models
import numpy as np
import pytest

from mjxball.cli import plant_setup
from mjxball.config import cg_limit, replace
from mjxball.plant.trim import heaviest_object, largest_margin
from mjxfly.rig import design


def test_a_model_is_judged_and_drawn(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    path, out = models.written(tmp_path, models.DRONE, "drones = 3"), tmp_path / "plan.svg"
    assert design.main(["--plant", str(path), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "the rig can fly and balances its object of 0.36 kg" in said
    settings = plant_setup(path)
    picture = ElementTree.fromstring(out.read_text())
    shapes = [shape.tag.rpartition("}")[2] for shape in picture]
    assert (shapes.count("circle"), shapes.count("ellipse")) == (3, 1)
    (ring,) = (shape for shape in picture if shape.tag.endswith("ellipse"))
    assert ring.get("rx") == ring.get("ry")  # in the plane it is a circle
    held = design.balanced(settings)
    assert 0 < held <= cg_limit(settings.plant)
    for angle in np.linspace(0, 2 * math.pi, 12, endpoint=False):
        place = (held * math.cos(angle), held * math.sin(angle))
        assert largest_margin(settings, 0.36, place).margin > settings.scenario.trim_margin - 1e-9
    assert design.main(["--plant", str(path), "--out", str(out)]) == 2  # nothing is overwritten


def test_the_heaviest_object_is_the_last_that_keeps_the_margin() -> None:
    settings = plant_setup(Path("team4"))
    for amplitude in (0.05, 0.2):
        heaviest = heaviest_object(settings, amplitude)
        for change, keeps in ((-0.01, True), (0.01, False)):  # 12 halvings of 13 kg are 3 g
            sides = ((amplitude, 0.0), (-amplitude, 0.0))
            margin = min(largest_margin(settings, heaviest + change, side).margin for side in sides)
            assert (margin >= settings.scenario.trim_margin) == keeps


def test_a_rig_whose_loops_do_not_close_cannot_fly(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """ "The rig can fly" was said of each."""
    for number, (base, flaw) in enumerate(
        (
            ("pair", "attitude.damping = 70"),
            ("pair", "leader.kp = [0, 0, 0]\nleader.kd = [0, 0, 0]"),
            ("pair", "leader.kd = [0, 0, 0]"),
            ("pair", "leader.ki = [9, 9, 9]"),
            ("stand", "leader.kp = [0, 0, 0]\nleader.kd = [0, 0, 0]\nleader.ki = [0, 0, 0]"),
            ("crazyflie", "autopilot.roll = [0, 0, 0]"),
            ("crazyflie", "autopilot.roll_rate = [0, 0, 0]"),
            ("crazyflie", "autopilot.pitch_rate = [2500, 0, 0]"),
        )
    ):
        rig = tmp_path / f"{number}.toml"
        rig.write_text(f'base = "{base}"\n{flaw}')
        assert design.main(["--plant", str(rig)]) == 2, flaw
        assert "can fly" not in capsys.readouterr().out
    for name in ("pair", "crazyflie", "stand", "team4"):
        assert design.main(["--plant", name]) == 0, name


def test_a_rig_that_does_not_balance_its_own_object_is_told_so(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """A follower that is too weak to lift its share beside a strong leader."""
    rig = tmp_path / "rig.toml"
    rig.write_text('base = "pair"\n[plant.drones.0]\nrotor_force_max = 9.0\n[plant.drones.1]\nrotor_force_max = 2.0')
    assert design.main(["--plant", str(rig)]) == 1
    said = capsys.readouterr().out
    assert "the rig cannot balance its object of 0.2 kg even at 0 m from O" in said
    held = design.balanced(replace(plant_setup(None), "plant.drones.1.rotor_force_max", 2.0))
    assert held == -math.inf
    assert re.search(r"0 kg at [\d.]+ m$", said.strip())
