"""Flight logs: read back, flown again, drawn, played; and a flight against the pure simulation."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from command_line import assert_one_line, call
from fly_policies import untrained
from fly_virtual import VirtualTwin, log_header

from mjxball import config as configs
from mjxball.control import rotations
from mjxball.policy import Policy, shipped_policy
from mjxball.sim.rollout import simulate
from mjxball.sim.scenario import Scenario
from mjxfly import policy_setup
from mjxfly.flight_log import Journal
from mjxfly.limits import FlightSettings
from mjxfly.log import main as draw
from mjxfly.recording import Recording, _tick_remarks, read_recording, simulate_setpoints
from mjxfly.supervisor import FlightState
from mjxfly.twin.conditions import Conditions, Surroundings, drone_kind
from mjxfly.twin.physics import make_pair
from mjxfly.view.main import main as view

OLDER = drone_kind(curve="older")  # the motors of the preset
EXACT = Surroundings(exact=True)  # neither the simulation nor `simulate_setpoints` has an estimator


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of 4 s of free flight in virtual time, as the runner writes it."""
    path, contents = tmp_path_factory.mktemp("log") / "flight.jsonl", untrained("flight")
    with Journal(path, **log_header(contents)) as notes:
        settings = FlightSettings(seconds=4.0, goal=(0.1, 0.0, 0.4))
        physics = make_pair(contents.metadata, OLDER, EXACT)
        world = VirtualTwin(settings, contents=contents, physics=physics, log=notes)
        world.fly_until(FlightState.DONE)
    return path


@pytest.fixture(scope="module")
def recording(log: Path) -> Recording:
    return read_recording(log)


def test_the_log_holds_the_flight(recording: Recording) -> None:
    assert recording.config == configs.preset("flight")
    assert set(recording.phase) == {"spin", "ramp", "fly", "land", "stop", "done"}
    assert np.diff(recording.time) == pytest.approx(0.01)
    flying = np.array(recording.phase) == "fly"
    assert np.isfinite(recording.leader[flying][1:]).all()
    assert np.isnan(recording.leader[np.array(recording.phase) == "ramp"]).all()
    # The leader and a copy of it: they climb and stay over the place, and drift along the stick as the CG moves.
    assert (np.abs(recording.position[flying][-1] - [0.1, 0.0, 0.4]) < [0.1, 0.5, 0.15]).all()
    assert recording.setup.curves == ("older", "older")  # as the motors said, whatever the header takes them for
    config = policy_setup.with_curve(recording.config, "older")
    assert recording.setup.gains == policy_setup.gains_of(config)
    plant = config.plant
    weight = (sum(drone.mass for drone in plant.drones) + plant.object_mass) * plant.gravity
    # It hangs in the air for the last second: what the curve makes of the thrust that was sent is its weight.
    assert recording.rotor_force[flying][-100:].sum(axis=(1, 2)).mean() == pytest.approx(weight, rel=0.04)
    np.testing.assert_allclose(recording.rotor_force[~flying][-1], 0.0)


def test_the_goal_is_shown_as_it_was_before_the_landing(recording: Recording) -> None:
    """The one that steers a landing sinks until the pair touches down."""
    landing = np.array(recording.phase) == "land"
    assert recording.goal[landing, 2].min() < recording.position[0, 2] + 0.1
    np.testing.assert_allclose(
        recording.target[landing], np.broadcast_to([0.1, 0.0, 0.4], (landing.sum(), 3)), atol=0.01
    )
    np.testing.assert_array_equal(recording.target[~landing][:10], recording.goal[~landing][:10])
    assert np.flatnonzero(landing)[0] == recording.guided_rows


def test_the_same_commands_fly_the_same_way(recording: Recording) -> None:
    """The recorded setpoints alone, with no controller that sees where it is, end where the flight ended."""
    again = simulate_setpoints(recording, OLDER)
    # Setpoints take effect within a tick; 6 s later that has grown to a centimetre or two.
    np.testing.assert_allclose(again.position, recording.position, atol=0.03)
    euler = [rotations.euler_from_matrix(rotations.matrix_from_quaternion(r.quaternion)) for r in (again, recording)]
    np.testing.assert_allclose(*euler, atol=np.radians(1.0))
    amplitude = Conditions.of(recording.config).cg_amplitude
    assert np.abs(again.cg_offset).max() == pytest.approx(amplitude, rel=0.02)
    assert again.position[0] == pytest.approx(recording.position[0])


def test_a_flight_is_what_the_pure_simulation_says(recording: Recording) -> None:
    """Position and roll of the flight under both controllers within 20 % of the simulation's, from the air."""
    config, met = recording.config, Conditions.of(recording.config)
    rows = [number for number, phase in enumerate(recording.phase) if phase == "fly"]
    begun = recording.time[rows[0]]
    scenario = Scenario(
        met.cg_speed, met.cg_amplitude, met.object_mass, config.plant.object_mass, (0.1, 0.0, 0.4), 4.0,
        phase=met.cg_speed * begun,
    )  # fmt: skip
    flown = simulate(config, Policy(untrained("flight"), "nobody"), scenario, "newton-euler")
    count = min(len(rows), len(flown.time))
    quaternion = recording.quaternion[rows[:count]]
    roll = rotations.euler_from_matrix(rotations.matrix_from_quaternion(quaternion))[:, 0]
    pairs = [(recording.position[rows[:count], k], flown.position[:count, k]) for k in range(3)]
    for mine, theirs in (*pairs, (roll, flown.euler[:count, 0])):
        assert np.sqrt(np.mean(mine**2)) == pytest.approx(np.sqrt(np.mean(theirs**2)), rel=0.2)


def test_a_log_is_drawn_and_played(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for flags in ([], ["--simulate"]):
        assert call(draw, [log, tmp_path / f"figures{len(flags)}", *flags]) == 0
        assert ("height mm" in capsys.readouterr().out) is bool(flags)
        assert (tmp_path / f"figures{len(flags)}" / "flight.png").stat().st_size > 20_000
    assert call(view, [log, "--out", tmp_path / "page.html"]) == 0
    assert "nobody, flown" in (tmp_path / "page.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["nowhere.jsonl", "x"], "cannot be read"),
        (["log.jsonl", "x.xlsx"], "must end in .mcap, .csv, .parquet"),
        (["log.jsonl", "x.csv", "--plant", "crazyflie"], "--plant, --simulate and --style belong to figures"),
        (["log.jsonl", "x.csv", "--simulate"], "--plant, --simulate and --style belong to figures"),
        (["log.jsonl", "x.csv", "--style", "paper"], "--plant, --simulate and --style belong to figures"),
    ],
)
def test_refusals(arguments: list[str], reason: str, tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    assert call(draw, arguments) == 2
    errors = capsys.readouterr().err
    assert_one_line(errors)
    assert reason in errors


def test_what_is_damaged_in_a_log_is_left_out(log: Path, recording: Recording, tmp_path: Path) -> None:
    """One state of 0.4 s of one drone, and one tick that has no goal: the same flight but for them, and it is said."""
    path, kept = tmp_path / "damaged.jsonl", []
    lines = [json.loads(line) for line in log.read_text(encoding="utf-8").splitlines()]
    begun = next(one["t"] for one in lines if one["kind"] == "tick" and one["state"] == "fly")
    for record in lines:
        lost = record["kind"] == "state" and record["drone"] == "leader" and 1.0 <= record["t"] - begun <= 1.4
        torn = record["kind"] == "tick" and 1.995 < record["t"] - begun <= 2.005
        kept += [] if lost else [json.dumps({**record, "goal": None} if torn else record) + "\n"]
    path.write_text("".join(kept), encoding="utf-8")
    found = read_recording(path)
    assert len(found.time) == len(recording.time) - 1
    said = [remark.partition(": ")[2].split(" for ")[0] for remark in found.remarks]
    assert said[0].endswith("is damaged: the goal of its tick is not 3 numbers")
    assert "no end" in said[1]
    assert said[2:] == ["there is no state of the leader"]
    shared = np.isin(recording.time, found.time)
    flown = recording.time[shared] - recording.time[recording.phase.index("fly")]
    held = (flown > 0.99) & (flown < 1.43)  # the next state comes a tick later
    np.testing.assert_array_equal(found.position[~held], recording.position[shared][~held])
    assert np.abs(found.position - recording.position[shared]).max() > 1e-3


def test_ticks_are_held_against_those_that_the_policy_is_flown_with() -> None:
    """`universal` commands every 20 ms, in every second tick: each log of it was said to be off its period."""
    config = policy_setup.config_of(policy_setup.load_policy(shipped_policy("universal")).metadata)
    assert config.timing.control_period == 0.02
    for step, remarked in ((0.01, False), (0.02, True), (0.013, True)):
        assert bool(_tick_remarks([step * number for number in range(100)], config)) is remarked


def test_other_plants_fly_again_on_the_stand_in(recording: Recording) -> None:
    ideal = dataclasses.replace(recording.config, autopilot=configs.Autopilot())
    short = {name: getattr(recording, name)[:50] for name in ("time", "sent", "position", "velocity", "rates")}
    again = simulate_setpoints(dataclasses.replace(recording, config=ideal, **short))
    assert np.isnan(again.cg_offset).all()
    assert np.isfinite(again.position).all()
