"""metrics.csv and TensorBoard's events of a run that was killed and goes on."""

from __future__ import annotations

import contextlib
import csv
import io
import struct
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from tensorboardX.proto.event_pb2 import Event
from tensorboardX.proto.plugin_hparams_pb2 import HParamsPluginData

from mjxball.config import apply_overrides, preset
from mjxball.train.curves import MemberLog
from mjxball.train.events import EVENTS, Session, session
from mjxball.train.progress import Progress, columns
from mjxball.train.run_directory import METRICS, read_rows

NAMES = columns((), (), ())
HIDDEN = "_hparams_/"


def events(run: Path, name: str) -> list[Event]:
    """All events of the run `name`, as TensorBoard or a script reads them."""
    found = []
    for path in (run / EVENTS / name).iterdir():
        content, at = path.read_bytes(), 0
        while at < len(content):
            (size,) = struct.unpack_from("<Q", content, at)
            found.append(Event.FromString(content[at + 12 : at + 12 + size]))
            at += size + 16
    return found


def points(run: Path, name: str = "run") -> Counter[tuple[str, int, float]]:
    """(tag, step, value) of every point of the run `name`."""
    return Counter(
        (one.tag, event.step, one.simple_value)
        for event in events(run, name)
        for one in event.summary.value
        if not one.tag.startswith(HIDDEN)
    )


def hyperparameters(run: Path, name: str) -> dict[str, object]:
    """What the run `name` says that it was made with."""
    for event in events(run, name):
        for one in event.summary.value:
            if one.tag == f"{HIDDEN}session_start_info":
                told = HParamsPluginData.FromString(one.metadata.plugin_data.content).session_start_info.hparams
                return {key: getattr(value, value.WhichOneof("kind")) for key, value in told.items()}
    raise AssertionError(f"{name} has no hyperparameters")


def row(steps: int) -> dict[str, float]:
    return {"steps": steps, "seconds": steps / 100, "rate": 8.0, "episode_return": -float(steps)}


@pytest.mark.slow
def test_after_a_kill_and_a_resume_every_point_stands_once(tmp_path: Path) -> None:
    """Checkpoint at 200 steps, rows to 400, killed, resumed: 300 and 400 come again, with other values."""
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    for run in (whole, killed):
        run.mkdir()
        first = Progress(run / METRICS, NAMES, 500, stream=io.StringIO())
        for steps in (100, 200, 300, 400):
            first.show(row(steps) | ({"eval_return": -1.0} if steps == 200 else {}))
        first.close()
    for resumed_at in (200, 200):  # killed once more before its first row
        again = Progress(killed / METRICS, NAMES, 500, resumed_at, stream=io.StringIO())
        assert again.before == 2.0
    for steps in (300, 400):
        again.show(row(steps))
    again.close()
    assert points(killed) == points(whole)
    assert set(points(whole).values()) == {1}
    assert len(points(whole)) == 4 * 3 + 1
    assert read_rows(killed / METRICS) == read_rows(whole / METRICS)


def test_tags_are_in_groups() -> None:
    named = columns(["steady_error"], ["alpha"], ["peak"])
    assert list(named) == [
        *("steps", "seconds", "rate", "episode_return", "steady_error", "alpha", "terminated", "diverged"),
        *("eval_return", "eval_peak"),
    ]
    assert {
        named[name] for name in ("rate", "episode_return", "steady_error", "alpha", "eval_return", "eval_peak")
    } == {
        *("speed/rate", "exploring/episode_return", "exploring/steady_error"),
        *("update/alpha", "evaluation/return", "evaluation/peak"),
    }


def test_a_value_that_is_none_has_no_point(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """The peak of flights that all failed is not a number; tensorboardX warns of such."""
    progress = Progress(tmp_path / METRICS, columns((), (), ["peak"]), 500, stream=io.StringIO())
    progress.show(row(100) | {"eval_return": -1.0, "eval_peak": float("nan")})
    progress.close()
    assert {tag for tag, _, _ in points(tmp_path)} == {
        *("speed/seconds", "speed/rate", "exploring/episode_return", "evaluation/return")
    }
    assert not caplog.records
    assert read_rows(tmp_path / METRICS)[0]["eval_peak"] == "nan"


def test_a_run_by_the_clock_shows_the_time_that_is_left(tmp_path: Path) -> None:
    """Whatever its first steps took and however many are planned: they are planned anew at every row."""
    shown = io.StringIO()
    progress = Progress(tmp_path / METRICS, NAMES, 10**9, stream=shown)
    progress.ends = time.monotonic() + 60.5
    for steps in (100, 200):
        progress.show(row(steps) | {"seconds": 30.0, "rate": 1.0})
        progress.total = 300
    progress.close()
    assert shown.getvalue().count("33%  1:00 left") == 2


def test_a_run_is_called_after_preset_and_seed_and_names_its_hyperparameters(tmp_path: Path) -> None:
    config = apply_overrides(preset("transport"), {"sac.learning_rate": 0.125, "scenario.cg_speed": (0.5, 1.0)})
    own = session(config, 3, 1, {"physics": "mjx"})
    progress = Progress(tmp_path / METRICS, NAMES, 500, stream=io.StringIO(), session=own)
    progress.show(row(100))
    progress.close()
    assert [path.name for path in (tmp_path / EVENTS).iterdir()] == ["transport-seed3"]
    assert len(points(tmp_path, "transport-seed3")) == 3
    told = hyperparameters(tmp_path, "transport-seed3")
    shown = {name: told[name] for name in ("sac.learning_rate", "scenario.cg_speed", "algorithm", "physics", "seed")}
    assert list(shown.values()) == [0.125, "0.5,1", "sac", "mjx", 3.0]
    assert not any(name.startswith(("ppo.", "gradient.")) for name in told)


def test_every_member_has_a_run_that_a_resumed_one_continues(tmp_path: Path) -> None:
    """Evaluations at 200 and 400 steps, resumed from 200: that at 400 comes again, with other values."""
    sessions = [Session(f"transport-seed{seed}", {"seed": seed}) for seed in (5, 6)]
    found = {"eval_return": np.array([-1.0, -2.0]), "eval_peak": np.array([0.5, 0.25])}
    first = MemberLog(tmp_path, sessions, 5)
    first.add(200, found)
    first.add(400, found)
    MemberLog(tmp_path, sessions, 5, resumed_at=200).add(400, {name: 2 * values for name, values in found.items()})
    expected = {200: (-2.0, 0.25), 400: (-4.0, 0.5)}
    assert points(tmp_path, "transport-seed6") == Counter(
        (f"evaluation/{name}", steps, value)
        for steps, values in expected.items()
        for name, value in zip(("return", "peak"), values, strict=True)
    )
    assert hyperparameters(tmp_path, "transport-seed5") == {"seed": 5.0}
    assert len(list((tmp_path / EVENTS / "transport-seed5").iterdir())) == 1


def test_a_full_disk_is_named(tmp_path: Path) -> None:
    """`/dev/full` takes no byte."""
    progress = Progress(tmp_path / METRICS, NAMES, 500, stream=io.StringIO())
    progress._file.close()
    progress._file = open("/dev/full", "a")  # noqa: SIM115
    progress._writer = csv.DictWriter(progress._file, NAMES)
    with pytest.raises(OSError, match="No space") as failed:
        progress.show(row(100))
    assert failed.value.filename == "/dev/full"
    with contextlib.suppress(OSError):
        progress._file.close()
