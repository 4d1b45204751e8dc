"""Gains of the coupled pair: their margins against an independent count, the presets that use them, the command."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
from attitude_trials import Trial, pair, simulate

from mjxball.cli import read_plant
from mjxball.config import Autopilot, apply_overrides, preset, with_plant
from mjxball.control.axes import axes
from mjxball.errors import InputError
from mjxfly.gain_design import design
from mjxfly.margins import (
    REQUIREMENTS,
    Gains,
    delivered_gains,
    gains_of,
    is_stable,
    margins,
    worst_margins,
)
from mjxfly.preflight import read_gains
from mjxfly.rig import gains as command

PAIR = preset("flight")
ROLL, PITCH, YAW = axes(PAIR)
INTERIM = dataclasses.replace(
    PAIR.autopilot,
    roll=(3.0, 0.3, 0.0),
    roll_rate=(700.0, 350.0, 20.0),
    yaw=(2.0, 0.2, 0.0),
    yaw_rate=(2000.0, 300.0, 0.0),
)


@pytest.fixture(scope="module")
def designs():
    return design(PAIR)


class TestAxes:
    def test_a_unit_of_roll_turns_the_pair_as_in_the_cascade(self) -> None:
        """Half a unit on each of eight motors, 46 / sqrt 2 mm from the axis."""
        slope = 0.12 / 65535
        torque = 8 * 0.5 * slope * 0.046 / math.sqrt(2)
        assert math.radians(ROLL.gain) * ROLL.inertia == pytest.approx(torque, rel=1e-3)

    def test_the_stick_makes_roll_and_yaw_heavy_and_leaves_pitch(self) -> None:
        assert ROLL.inertia_ratio == pytest.approx(2 * 0.029 * 0.15**2 / (2 * 1.66e-5) + 3, rel=0.1)
        assert YAW.inertia_ratio > 20
        assert PITCH.inertia_ratio == pytest.approx(1, abs=0.05)

    def test_trim_holds_the_ball_at_its_stop(self) -> None:
        assert ROLL.trim * math.radians(ROLL.gain) * ROLL.inertia == pytest.approx(0.0075 * 9.81 * 0.08)


class TestMargins:
    def test_closed_form(self) -> None:
        """Rate P on gain / s (lag s + 1): crossover, phase and delay margin by hand; no gain makes it unstable."""
        rate = (10.0, 0, 0)
        assert not is_stable(Gains((0, 0, 0), rate), 2.0, 0.05, 0.0)  # nothing holds the angle
        assert not is_stable(Gains((0, 0, 0), (0, 0, 0)), 2.0, 0.05, 0.0)
        found = margins(Gains((1e-3, 0, 0), rate), 2.0, 0.05, 0.0)
        # |20 / (w (0.05 j w + 1))| = 1 at w^2 = (sqrt(1 + 4 0.05^2 20^2) - 1) / (2 0.05^2)
        crossover = math.sqrt((math.sqrt(1 + 4 * 0.0025 * 400) - 1) / 0.005)
        phase = 90 - math.degrees(math.atan(0.05 * crossover))
        assert found.crossover == pytest.approx(crossover, rel=0.01)
        assert found.phase == pytest.approx(phase, abs=0.5)
        assert found.delay == pytest.approx(math.radians(phase) / crossover, rel=0.02)
        assert found.gain_up == math.inf

    @pytest.mark.parametrize("which", ["roll", "yaw"])
    def test_the_loop_is_lost_where_they_say(self, designs, which: str) -> None:
        """Poles just inside and just outside each margin: Nyquist's count against the characteristic polynomial."""
        one = next(one for one in designs if one.axis.name == which)
        found, lag = one.nominal, PAIR.plant.rotor_lag
        for factor in (found.gain_up, 1 / found.gain_down):
            inside, outside = (one.axis.gain * factor**power for power in (0.95, 1.05))
            assert is_stable(one.gains, inside, lag, REQUIREMENTS.delay)
            assert not is_stable(one.gains, outside, lag, REQUIREMENTS.delay)
        assert is_stable(one.gains, one.axis.gain, lag, REQUIREMENTS.delay + 0.95 * found.delay)
        assert not is_stable(one.gains, one.axis.gain, lag, REQUIREMENTS.delay + 1.05 * found.delay)

    def test_delivered_gains_have_none_left(self) -> None:
        assert margins(delivered_gains(ROLL), ROLL.gain, 0.05, 0.01).phase < 3
        assert worst_margins(delivered_gains(ROLL), ROLL).phase == 0
        assert worst_margins(delivered_gains(YAW), YAW).phase == 0


class TestDesign:
    def test_margins_are_kept(self, designs) -> None:
        for one in designs:
            if one.axis.name == "pitch":
                assert one.gains == delivered_gains(one.axis)
                continue
            assert one.nominal.phase >= REQUIREMENTS.phase
            assert min(one.nominal.gain_up, one.nominal.gain_down) >= REQUIREMENTS.gain
            assert one.worst.phase >= REQUIREMENTS.worst_phase
            assert min(one.worst.gain_up, one.worst.gain_down) >= REQUIREMENTS.worst_gain

    @pytest.mark.parametrize("drone", ["older", "thrust-upgrade", "brushless"])
    def test_presets_fly_them(self, drone: str) -> None:
        config = with_plant(preset("flight"), f"crazyflie-{drone}")
        for one in design(config):
            assert gains_of(config.autopilot, one.axis) == one.gains, one.axis.name

    def test_stand_flies_the_same(self) -> None:
        stand = preset("stand").autopilot
        assert (stand.roll, stand.roll_rate) == (PAIR.autopilot.roll, PAIR.autopilot.roll_rate)


class TestResponse:
    """The real cascade, 10 ms of delay, motor lags of 30 to 150 ms and inertias of 0.6 to 1.4."""

    CORNERS = tuple((lag, inertia) for lag in (0.03, 0.05, 0.15) for inertia in (0.6, 1.0, 1.4))

    def test_delivered_gains_diverge_and_these_do_not(self) -> None:
        trials = [Trial((8, 0, 0), lag=lag, inertia=inertia, delay=0.01) for lag, inertia in self.CORNERS]
        stocked, designed = (
            simulate(pair(PAIR), controller, trials)[..., 0]
            for controller in (Autopilot(kind="crazyflie", motor_curve=PAIR.autopilot.motor_curve), PAIR.autopilot)
        )
        nominal = self.CORNERS.index((0.05, 1.0))
        assert stocked[:, nominal].max() > 1.7 * 8  # and swings on: below
        assert np.ptp(stocked[-500:, nominal]) > 8
        assert np.abs(stocked[:, -3:]).max() > 60
        assert designed.max() < 1.25 * 8
        assert designed[:, nominal].max() < 1.02 * 8
        assert np.abs(designed[-250:] - 8).max() < 0.8

    @pytest.mark.slow
    def test_better_than_before_in_every_corner(self) -> None:
        """Against the gains by hand that the presets had first: overshoot and the deflection by the ball's moment."""
        moment = (0.5 * 0.0075 * 9.81 * 0.08, 0.0, 0.0)
        steps = [Trial((8, 0, 0), lag=lag, inertia=inertia, delay=0.01) for lag, inertia in self.CORNERS]
        loads = [Trial(torque=moment, lag=lag, inertia=inertia, delay=0.01) for lag, inertia in self.CORNERS]
        before, now = (
            simulate(pair(PAIR), controller, steps + loads)[..., 0] for controller in (INTERIM, PAIR.autopilot)
        )
        count = len(self.CORNERS)
        assert (now[:, :count].max(axis=0) <= before[:, :count].max(axis=0) + 0.01).all()
        assert (now[:, count:].max(axis=0) < 0.75 * before[:, count:].max(axis=0)).all()


class TestCommand:
    @pytest.mark.slow
    def test_writes_what_the_runner_reads(self, tmp_path: Path, designs, capsys) -> None:
        out = tmp_path / "gains.json"
        assert command.main(["--out", str(out)]) == 0
        leader, follower = read_gains(out)
        assert leader["pid_rate.roll_kp"] == follower["pid_rate.roll_kp"] == designs[0].gains.rate[0]
        assert leader["pid_rate.roll_ki"] == designs[0].gains.rate[1] > 0
        assert {value for name, value in follower.items() if name.endswith("_ki")} == {0.0}
        assert len(leader) == len(follower) == 18
        text = capsys.readouterr().out
        assert "unstable" in text
        assert f"{designs[0].nominal.phase:.0f} deg" in text

    def test_another_plant_gets_other_gains(self, tmp_path: Path, capsys) -> None:
        plant, out = tmp_path / "plant.json", tmp_path / "gains.json"
        plant.write_text(json.dumps({"plant.rotor_lag": 0.08}))
        assert command.main(["--plant", str(plant), "--out", str(out)]) == 0
        slow = design(apply_overrides(PAIR, {"plant.rotor_lag": 0.08}))
        assert read_gains(out)[0]["pid_rate.roll_kp"] == slow[0].gains.rate[0]

    @pytest.mark.parametrize(
        ("text", "said"),
        [
            ("nothing", "is not JSON"),
            ("[]", "one JSON object"),
            ('{"sac.total_steps": 3}', "may set"),
            ('{"plant.mass": 3}', "not a setting"),
            ('{"plant.rotor_lag": "slow"}', "takes numbers"),
            ('{"plant.rotor_lag": -1}', "between 1e-09 and"),
        ],
    )
    def test_plant_files_are_refused_in_a_sentence(self, tmp_path: Path, capsys, text: str, said: str) -> None:
        plant = tmp_path / "plant.json"
        plant.write_text(text)
        assert command.main(["--plant", str(plant)]) == 2
        assert said in capsys.readouterr().err

    def test_missing_plant_file(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match="does not exist"):
            read_plant(tmp_path / "none.json")
