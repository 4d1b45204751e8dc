"""Identification from simulated arrays whose truth is known, and what becomes of the plant file."""

from __future__ import annotations

import contextlib
import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from mjxball import cli
from mjxball.commands import evaluate, new_run, train
from mjxball.commands.scenarios import scenarios_of, setup_of
from mjxball.config import Config, preset, validate
from mjxball.control import crazyflie, rotations
from mjxball.control.axes import inertia_about_o
from mjxball.errors import InputError
from mjxball.physics.engine import Load
from mjxball.physics.step import make_numpy_plant_step, start_state
from mjxball.plant import plant_parameters
from mjxfly.preflight import read_gains
from mjxfly.rig import identify as command
from mjxfly.rig.fit import Estimate, identify
from mjxfly.rig.gains import parameter_file
from mjxfly.rig.log import make_log, read_log

PAIR = preset("flight")
PERIOD = PAIR.timing.control_period
COMPUTED = float(inertia_about_o(PAIR)[0])


class Rig:
    """A rig that is not as it was thought: the truth of a log."""

    def __init__(self, thrust: float, added: float, lag: float, late: int):
        self.thrust, self.added, self.lag, self.late = thrust, added, lag, late


RIGS = {"weak and slow": Rig(0.9, 4e-4, 1.4, 2)}  # stronger and quicker ones: tests/fly/rig/test_rehearsal.py


def record(config: Config, rig: Rig, seconds: float, noise: float = 1.0) -> dict[str, np.ndarray]:
    """A flight with random steps of all commands, a moving ball, and the noise of a small drone's sensors."""
    random, one, mass = np.random.default_rng(5), np.ones(1), config.plant.object_mass
    sine = (0.02 * one, 0.6 * one, 0 * one, np.zeros((1, 0)), np.zeros((1, 0)))
    load = Load(
        mass * one,
        mass * one,
        *sine,
        rotor_lag_scale=rig.lag * one,
        thrust_scale=rig.thrust * np.ones((1, 2)),
        added_inertia=np.array([[rig.added, 0, 0]]),
    )
    step, zero = make_numpy_plant_step(config, "newton-euler"), np.zeros((1, 3))
    state = start_state(config, zero, zero, zero, mass * one, np.zeros(1))
    constants = plant_parameters(config.plant, config.attitude)
    commands: list[np.ndarray] = []
    log: dict[str, list[np.ndarray]] = {"setpoints": [], "states": []}
    for number in range(round(seconds / PERIOD)):
        if number % 40 == 0:
            steps = random.uniform(-1, 1, (2, 3)) * np.array([0.09, 0.05, 1.0])
            steps[1, :2] = steps[0, :2]
        place, speed = state.position[0], state.velocity[0]
        euler = rotations.euler_from_matrix(rotations.matrix_from_quaternion(state.quaternion))[0]
        held = steps + np.array([0.1 * speed[1], -0.1 * speed[0], (1 - rig.thrust) * 9.81 - 1.5 * speed[2] - place[2]])
        commands.append(held)
        sent = crazyflie.setpoints(config.autopilot, held, constants.drone_mass + constants.load_share * mass, 9.81)
        log["setpoints"].append(sent)
        rows = []
        for _ in range(2):
            jitter = noise * random.normal(size=(4, 3)) * np.array([[0.003], [0.02], [0.005], [0.02]])
            seen = rotations.quaternion_from_euler(euler + jitter[2])
            rows.append(np.concatenate([place + jitter[0], speed + jitter[1], seen, state.rates[0] + jitter[3]]))
        log["states"].append(np.stack(rows))
        state = step(state, commands[max(0, number - rig.late)][None], load)
    time = np.arange(len(commands)) * PERIOD
    return {"time": time, **{name: np.stack(rows) for name, rows in log.items()}}


@pytest.fixture(scope="module")
def logs() -> dict[str, dict[str, np.ndarray]]:
    return {name: record(PAIR, rig, 20.0) for name, rig in RIGS.items()}


@pytest.fixture(scope="module")
def brief() -> dict[str, np.ndarray]:
    """A log for tests that find nothing in it."""
    return record(PAIR, RIGS["weak and slow"], 6.0)


@pytest.fixture(scope="module")
def found(logs) -> dict[str, Estimate]:
    return {
        name: identify(
            PAIR, make_log(log["time"], log["setpoints"], log["time"], [log["states"][:, 0], log["states"][:, 1]])
        )
        for name, log in logs.items()
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", RIGS)
def test_truth_is_found(found, name: str) -> None:
    """The errors that docs/archive/crazyflie.md states: 20 s of noisy flight."""
    truth, one = RIGS[name], found[name]
    assert one.thrust == pytest.approx(truth.thrust, rel=0.005)
    assert one.inertia == pytest.approx(COMPUTED + truth.added, rel=0.04)
    assert one.lag == pytest.approx(0.05 * truth.lag, rel=0.12)
    assert one.delay == pytest.approx(PERIOD * truth.late, abs=0.005)
    assert one.misfit < 1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"states": np.zeros((9, 2, 12))}, "shapes"),
        ({"time": np.zeros(9)}, "row 2: a time stands twice"),
        ({"time": np.array([0, 1, 2, 3, 2.5, 4, 5, 6, 7]) * 0.01}, "row 5: the time goes back by 0.005 s"),
        ({"time": np.arange(9) * 10.0}, "10 ms would be 0.01 s"),
        ({"setpoints": np.full((9, 2, 4), np.nan)}, "not finite"),
    ],
)
def test_damaged_logs_are_refused(tmp_path: Path, change: dict[str, np.ndarray], said: str) -> None:
    states = np.zeros((9, 2, 13))
    states[..., 6] = 1
    np.savez(
        tmp_path / "a.npz", **{"time": np.arange(9) * 0.01, "setpoints": np.zeros((9, 2, 4)), "states": states} | change
    )
    with pytest.raises(InputError, match=said):
        read_log(tmp_path / "a.npz")


def test_clocks_that_differ_are_refused(brief) -> None:
    """By what the drones' states are late, and how much faster their clocks are."""
    time = brief["time"]
    for late, faster, said in (
        ((0, 0), (1, 1), None),
        ((0, -0.02), (1, 1), None),
        ((0, -0.05), (1, 1), "by their rates the follower's states are 0.05. s early against the leader's"),
        ((0, -0.15), (1, 1), "by their rates the follower's states are 0.15. s early against the leader's"),
        ((-0.15, 0), (1, 1), r"by their rates the follower's states are 0.1(49|5.) s late against the leader's"),
        ((-0.15, -0.15), (1, 1), "the pair follows what was sent after -0.06. s at first"),
        ((0.3, 0.3), (1, 1), "the pair follows what was sent after 0.38. s at first"),
        ((0, 0), (1, 1.01), "the follower's states are 0.00. s late at first and 0.05. s late at last"),
        ((0, 0), (1, 1.3), "the follower's positions change by 0.77 of its velocities, and its attitudes by 0.7"),
        ((0, 0), (1.3, 1.3), "the leader's positions change by 0.77 of its velocities, and its attitudes by 0.7"),
    ):
        seen = [time * factor + shift for factor, shift in zip(faster, late, strict=True)]
        states = [brief["states"][:, 0], brief["states"][:, 1]]
        with pytest.raises(ValueError, match=said) if said else contextlib.nullcontext():
            assert make_log(time, brief["setpoints"], seen, states).usable.sum() > 5 / 0.002


def test_rows_that_hold_nothing_are_missing(brief, tmp_path: Path) -> None:
    """40 rows of the follower's states in an .npz, and 3 times of its rows."""
    states, time = brief["states"].copy(), brief["time"].copy()
    whole = make_log(time, states=[states[:, 0], states[:, 1]], setpoints=brief["setpoints"], measured_at=time)
    for number, nothing in enumerate((np.nan, np.inf, 0.0)):
        states[200:240, 1] = nothing
        np.savez(tmp_path / f"{number}.npz", **{**brief, "states": states})
        found = read_log(tmp_path / f"{number}.npz")
        assert found.remarks == ("40 rows of its follower are missing",)
        assert (whole.usable & ~found.usable).sum() == pytest.approx(0.41 / 0.002, abs=2)
        np.testing.assert_array_equal(found.rates[found.usable], whole.rates[found.usable])
    time[300:303] = 0.0
    np.savez(tmp_path / "time.npz", **{**brief, "time": time})
    assert "3 rows of its leader are missing" in read_log(tmp_path / "time.npz").remarks


def test_other_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        read_log(tmp_path / "none.npz")


def test_too_short_a_flight_is_refused(brief) -> None:
    log = {name: rows[:300] for name, rows in brief.items()}
    short = make_log(log["time"], log["setpoints"], log["time"], [log["states"][:, 0], log["states"][:, 1]])
    with pytest.raises(InputError, match="5 s or more"):
        identify(PAIR, short)


SOME = Estimate(1.05, COMPUTED + 4e-4, 0.06, 0.02, (0.001, 0.01, 0.02, 0.001), 0.8, 19)


class TestPlantFile:
    def write(self, place: Path, found: Estimate = SOME) -> Path:
        path = place / "plant.json"
        path.write_text(json.dumps({"preset": "flight", **command.plant_settings(PAIR, found)}))
        return path

    def test_it_is_the_plant_that_was_found(self, tmp_path: Path) -> None:
        rig = cli.apply_plant(PAIR, self.write(tmp_path))
        assert inertia_about_o(rig)[0] == pytest.approx(SOME.inertia, rel=1e-4)
        assert rig.plant.rotor_lag == SOME.lag
        force = crazyflie.motor_force(rig.autopilot.motor_curve, np.array(rig.autopilot.hover_thrust))
        assert 8 * force == pytest.approx(0.0755 * 9.81, rel=1e-4)
        assert rig.scenario.delay == pytest.approx((0.01, 0.03))

    def test_less_inertia_than_there_can_be(self, tmp_path: Path) -> None:
        """Masses at their places are a floor; the report says what to do."""
        light = SOME._replace(inertia=0.8 * COMPUTED)
        validate(cli.apply_plant(PAIR, self.write(tmp_path, light)))
        assert "weigh and measure" in command.report(PAIR, light)

    def test_a_delay_at_the_end_of_its_range_is_told(self) -> None:
        for delay, told in ((0.0, True), (0.008, False), (0.06, True)):
            assert ("by one clock" in command.report(PAIR, SOME._replace(delay=delay))) is told

    def test_train_takes_it_with_its_preset(self, tmp_path: Path) -> None:
        options = train.parser().parse_args(["--plant", str(self.write(tmp_path)), "--out", str(tmp_path / "run")])
        settings, _, _ = new_run.new_run(options, "")
        assert settings.preset == "flight"
        assert settings.plant.rotor_lag == SOME.lag

    def test_flags_overrule_it(self, tmp_path: Path) -> None:
        path, out = self.write(tmp_path), str(tmp_path / "run")
        options = train.parser().parse_args(["--plant", str(path), "--out", out, "--plant.rotor_lag", "0.07"])
        assert new_run.new_run(options, "")[0].plant.rotor_lag == 0.07

    def test_eval_takes_it(self, tmp_path: Path) -> None:
        options = evaluate.parser().parse_args(["--followers", "copy", "--plant", str(self.write(tmp_path))])
        setup = setup_of(options)
        assert setup.preset == "flight"
        assert setup.plant.rotor_lag == SOME.lag
        assert {scenario.mass for scenario in scenarios_of(options, setup)} == {PAIR.plant.object_mass}


class TestCommand:
    def test_from_log_to_plant_file(self, tmp_path: Path, monkeypatch, capsys, brief) -> None:
        monkeypatch.setattr(command, "identify", lambda settings, log: SOME)
        log, out = tmp_path / "bench.npz", tmp_path / "plant.json"
        np.savez(log, **brief)
        assert command.main([str(log), str(log), "--out", str(out)]) == 0
        assert cli.read_plant(out).preset == "flight"
        text = capsys.readouterr().out
        assert "motor lag     60.0" in text
        assert "all 2 logs" in text

    def test_a_rig_too_weak_to_fly_is_told(self, tmp_path: Path, monkeypatch, capsys, brief) -> None:
        monkeypatch.setattr(command, "identify", lambda settings, log: SOME._replace(thrust=0.75))
        log = tmp_path / "bench.npz"
        np.savez(log, **brief)
        assert command.main([str(log)]) == 2
        assert "hovering takes" in capsys.readouterr().err

    def test_gains_that_were_flown(self) -> None:
        leader = {"pid_rate.roll_kp": 500.0, "pid_attitude.yaw_ki": 0.5, "kalman.x": 1.0}
        changed = command.with_gains(PAIR, (leader, {"pid_rate.roll_kp": 500.0}))
        assert changed.autopilot.roll_rate == (500.0, *PAIR.autopilot.roll_rate[1:])
        assert changed.autopilot.yaw == (PAIR.autopilot.yaw[0], 0.5, PAIR.autopilot.yaw[2])
        assert changed.autopilot.follower_ki_scale == 0.0

    @pytest.mark.parametrize("share", [0.0, 0.25, 1.0])
    def test_a_gain_file_says_how_much_the_follower_integrates(self, tmp_path: Path, share: float) -> None:
        controller = dataclasses.replace(PAIR.autopilot, follower_ki_scale=share)
        (tmp_path / "gains.json").write_text(parameter_file(controller))
        assert command.with_gains(PAIR, read_gains(tmp_path / "gains.json")).autopilot == controller

    @pytest.mark.parametrize(
        "follower", [{"pid_rate.roll_kp": 500.0}, {"pid_rate.pitch_ki": 500.0}, {"pid_rate.yaw_ki": 1e9}]
    )
    def test_a_follower_with_other_gains_is_refused(self, follower: dict[str, float]) -> None:
        with pytest.raises(InputError, match="identification takes a follower whose"):
            command.with_gains(PAIR, ({}, follower))

    def test_precise_logs_count_more(self) -> None:
        vague = SOME._replace(lag=0.09, spread=(0.001, 0.01, 0.2, 0.001))
        assert command.average([SOME, vague]).lag == pytest.approx(0.06 + 0.03 / 101)
