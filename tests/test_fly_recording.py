"""Flight logs: read back, flown again, drawn, played; and a flight against the pure simulation."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
from command_line import assert_one_line, call
from fly_policies import untrained
from fly_virtual import World

from mjxball import config as configs
from mjxball.commands import evaluate
from mjxball.control import rotations
from mjxball.control.firmware_gains import to_json
from mjxball.errors import InputError
from mjxball.fly import card
from mjxball.fly.contract import FlightSettings
from mjxball.fly.journal import Journal, read
from mjxball.fly.recording import Recording, fly_again, read_recording
from mjxball.fly.supervisor import State
from mjxball.fly.twin.conditions import Conditions
from mjxball.fly.twin.pairs import make_pair
from mjxball.policy import Policy
from mjxball.rollout import simulate
from mjxball.scenario import Scenario
from mjxball.view.command import main as view


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of 4 s of free flight in virtual time, as the runner writes it."""
    path, contents = tmp_path_factory.mktemp("log") / "flight.jsonl", untrained("flight")
    config = card.config_of(contents.card)
    header = {
        "policy": "nobody",
        "config": configs.to_dict(config),
        "gains": to_json(card.gains_of(config)),
    }
    with Journal(path, **header) as notes:
        settings = FlightSettings(seconds=4.0, goal=(0.1, 0.0, 0.4))
        world = World(settings, contents=contents, physics=make_pair(contents.card), notes=notes)
        world.fly_until(State.DONE)
    return path


@pytest.fixture(scope="module")
def recording(log: Path) -> Recording:
    return read_recording(log)


def test_the_log_holds_the_flight(recording: Recording) -> None:
    assert recording.config == configs.preset("flight")
    assert set(recording.phase) == {"ramp", "fly", "land", "stop", "done"}
    assert np.diff(recording.time) == pytest.approx(0.01)
    flying = np.array(recording.phase) == "fly"
    assert np.isfinite(recording.leader[flying][1:]).all()
    assert np.isnan(recording.leader[np.array(recording.phase) == "ramp"]).all()
    assert recording.position[flying][-1] == pytest.approx([0.1, 0.0, 0.4], abs=0.3)
    np.testing.assert_allclose(recording.rotor_force[~flying][-1], 0.0)


def test_the_same_commands_fly_the_same_way(recording: Recording) -> None:
    """The recorded setpoints alone, with no law that sees where it is, end where the flight ended."""
    again = fly_again(recording)
    # Setpoints take effect within a tick; 6 s later that has grown to a centimetre or two.
    np.testing.assert_allclose(again.position, recording.position, atol=0.03)
    euler = [rotations.euler_from_matrix(rotations.matrix_from_quaternion(r.quaternion)) for r in (again, recording)]
    np.testing.assert_allclose(*euler, atol=np.radians(1.0))
    amplitude = Conditions.of(recording.config).cg_amplitude
    assert np.abs(again.cg_offset).max() == pytest.approx(amplitude, rel=0.02)
    assert again.position[0] == pytest.approx(recording.position[0])


def test_a_flight_is_what_the_pure_simulation_says(recording: Recording) -> None:
    """Position and roll of the flight under both laws within 20 % of the simulation's, which lifts off in the air."""
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
    assert call(evaluate.main, ["--flight", log, "--out", tmp_path / "figures"]) == 0
    assert "height mm" in capsys.readouterr().out
    assert (tmp_path / "figures" / "flight.png").stat().st_size > 20_000
    assert call(view, [log, "--out", tmp_path / "page.html"]) == 0
    assert "nobody, flown" in (tmp_path / "page.html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--flight", "log.jsonl"], "--flight needs --out"),
        (["--flight", "log.jsonl", "--out", "x", "--followers", "copy"], "drop --followers"),
        (["mine.npz", "--flight", "log.jsonl", "--out", "x"], "drop the policies"),
        (["--flight", "nowhere.jsonl", "--out", "x"], "cannot be read"),
    ],
)
def test_refusals(arguments: list[str], reason: str, tmp_path: Path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    assert call(evaluate.main, arguments) == 2
    errors = capsys.readouterr().err
    assert_one_line(errors)
    assert reason in errors


DAMAGE = {
    "empty": lambda records: [],
    "no header": lambda records: records[1:],
    "no config": lambda records: [{**records[0], "config": {}}, *records[1:]],
    "odd config": lambda records: [{**records[0], "config": 3}, *records[1:]],
    "odd gains": lambda records: [{**records[0], "gains": ["x"]}, *records[1:]],
    "no ticks": lambda records: [record for record in records if record["kind"] != "tick"],
    "no states": lambda records: [record for record in records if record["kind"] != "state"],
    "text for setpoints": lambda records: [{**record, "sent": "much"} for record in records],
    "torn states": lambda records: [{**record, "raw": "00"} for record in records],
    "time is text": lambda records: [{**record, "t": "now"} for record in records],
    "time is not finite": lambda records: [*records[:-9], {**records[-9], "kind": "tick", "t": float("nan")}],
    "ticks at one time": lambda records: [{**record, "t": 1.0} for record in records],
    "no goal": lambda records: [{**record, "goal": None} for record in records],
}


@pytest.mark.parametrize("name", DAMAGE)
def test_damaged_logs_are_refused(name: str, log: Path, tmp_path: Path) -> None:
    path = tmp_path / "damaged.jsonl"
    records = DAMAGE[name](list(read(log))[:1500])
    path.write_text("".join(json.dumps(record) + "\n" for record in records), encoding="utf-8")
    with pytest.raises(InputError) as refused:
        read_recording(path)
    assert len(str(refused.value).splitlines()) == 1


def test_other_plants_fly_again_on_the_stand_in(recording: Recording) -> None:
    ideal = dataclasses.replace(recording.config, autopilot=configs.Autopilot())
    short = {name: getattr(recording, name)[:50] for name in ("time", "sent", "position", "velocity", "rates")}
    again = fly_again(dataclasses.replace(recording, config=ideal, **short))
    assert np.isnan(again.cg_offset).all()
    assert np.isfinite(again.position).all()
