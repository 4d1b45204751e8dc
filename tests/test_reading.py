"""Files of others: JSON says everything once, time runs forward; every reader refuses or tells."""

from __future__ import annotations

import ast
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import REPOSITORY
from fly_policies import untrained
from fly_virtual import log_header
from models import DRONE
from tables import rows

from mjxball import config as configs
from mjxball.config import preset, read_plant
from mjxball.config._model import read_model
from mjxball.errors import InputError
from mjxball.evaluate.scenarios import read_waveform
from mjxball.policy.file import load_file, shipped_policy
from mjxball.reading import check_times, following, is_number, parse_json, parse_toml
from mjxball.train.curves import training_curve
from mjxball.train.progress import COMMON, Progress
from mjxball.train.run_directory import read_config, read_rows, read_sweep, write_config
from mjxball.view.flight import Flight, load_flight, save_flight, shapes
from mjxfly import flight_log
from mjxfly.crazyswarm import read_pair
from mjxfly.flight_log import Journal
from mjxfly.preflight import read_gains


def test_json_is_that_of_the_standard_library_but_for_keys_that_stand_twice() -> None:
    for text in ('{"a": [1, {"b": null}], "c": {"a": 2.5}}', "[1e400, NaN]", '"x"'):
        assert repr(parse_json(text)) == repr(json.loads(text))
        assert repr(parse_json(text.encode())) == repr(json.loads(text))
    for text in ('{"a": 1, "a": 1}', '[{"b": {"a": 1, "c": 2, "a": 3}}]'):
        with pytest.raises(ValueError, match="'a' stands twice"):
            parse_json(text)


def test_the_package_reads_json_in_one_place() -> None:
    found = set()
    for path in REPOSITORY.glob("mjx*/**/*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            called = node.func if isinstance(node, ast.Call) else node
            if isinstance(called, ast.Attribute) and called.attr in ("load", "loads"):
                found |= {path.name} if ast.unparse(called.value) == "json" else set()
    assert found == {"reading.py"}


def twice(text: str, key: str) -> str:
    """`text` whose first `"key":` stands there before, too."""
    assert f'"{key}":' in text
    return text.replace(f'"{key}":', f'"{key}": 1, "{key}":', 1)


def plant_of(place: Path) -> None:
    path = place / "rig.json"
    path.write_text('{"plant.object_mass": 0.2, "plant.object_mass": 0.3}')
    read_plant(path)


def gains_of(place: Path) -> None:
    path = place / "gains.json"
    path.write_text('{"pid_rate.roll_kp": 250, "pid_rate.roll_kp": 900}')
    read_gains(path)


def sweep_of(place: Path) -> None:
    path = place / "sweep.json"
    path.write_text('{"sac.alpha": [0.1, 0.2], "sac.alpha": [0.3, 0.4]}')
    read_sweep(path, 2, preset("transport"))


def run_of(place: Path) -> None:
    write_config(place, preset("transport"), {"seed": 0, "physics": "mjx", "seeds": 1, "sweep": None})
    text = (place / "config.json").read_text()
    (place / "config.json").write_text(twice(text, "object_mass"))
    read_config(place)


def metadata_of(place: Path) -> None:
    with np.load(shipped_policy("balance")) as stored:
        arrays: dict[str, Any] = dict(stored)
    arrays["card"] = np.array(twice(str(arrays["card"]), "bounds"))
    np.savez(place / "policy.npz", **arrays)
    load_file(place / "policy.npz")


@rows("read", [plant_of, gains_of, sweep_of, run_of, metadata_of])
def test_every_file_with_a_key_twice_is_refused(read: Callable[[Path], None], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="stands twice"):
        read(tmp_path)


def readers(place: Path) -> dict[str, tuple[str, Callable[[Path], Any]]]:
    """By file name what is in it, and what reads it."""
    write_config(place, preset("transport"), {"seed": 0, "physics": "mjx", "seeds": 1, "sweep": None})
    with Journal(place / "log.jsonl", **log_header(untrained("flight"))) as log:
        log.note("end", code=0)
    robot = "    enabled: true\n    type: cf21\n    uri: radio://0/80/2M/E7E7E7E70"
    robots = f"robot_types:\n  cf21: {{}}\nrobots:\n  leader:\n{robot}1\n  follower:\n{robot}2\n"
    return {
        "plant.json": ('{"plant.object_mass": 0.2}\n', read_plant),
        "plant.toml": ("[plant]\nobject_mass = 0.2\n", read_plant),
        "gains.json": ('{"pid_rate.roll_kp": 250}\n', read_gains),
        "cg.csv": ("0,0\n1,0.01\n2,0\n3,0\n", read_waveform),
        "robots.yaml": (robots, lambda path: repr(read_pair(path))),
        "model.xml": (DRONE.replace("><", ">\n<"), lambda path: repr(read_model(path))),
        "sweep.json": ('{"sac.alpha": [0.1, 0.2]}\n', lambda path: read_sweep(path, 2, preset("transport"))),
        "metrics.csv": ("steps,reward\n1,2\n", read_rows),
        "config.json": ((place / "config.json").read_text(), lambda path: repr(read_config(path.parent))),
        "log.jsonl": ((place / "log.jsonl").read_text(), lambda path: [one["t"] for one in flight_log.read(path)]),
    }


def test_every_text_is_read_with_a_byte_order_mark_and_other_line_ends(tmp_path: Path) -> None:
    """As editors on Windows write them; one in UTF-16 is called so."""
    for name, (text, read) in readers(tmp_path).items():
        path = tmp_path / name
        found = []
        for content in (text, "\ufeff" + text, text.replace("\n", "\r\n"), "\ufeff" + text.replace("\n", "\r\n")):
            path.write_bytes(content.encode())
            found.append(read(path))
        assert all(one == found[0] for one in found), name
        for code in ("utf-16", "utf-16-be"):
            path.write_bytes(("\ufeff" * (code == "utf-16-be") + text).encode(code))
            with pytest.raises(InputError, match="it is UTF-16; save it as UTF-8"):
                read(path)


def test_rows_whose_time_does_not_follow_are_left_out() -> None:
    even = [0.01 * number for number in range(100)]
    assert following(even) == [*range(100)]
    for times, lost in (
        ([*even[:50], 0.0, 0.0, 0.0, *even[53:]], {50, 51, 52}),
        ([*even[:50], 1e9, 1e9, *even[52:]], {50, 51}),
        ([*even[:50], math.nan, math.inf, *even[52:]], {50, 51}),
        ([*even[:50], even[49], *even[51:]], {50}),
    ):
        assert set(range(100)) - {*following(times)} == lost
    for times in ([*even[:50], *even[:50]], [0.0] * 9, [math.nan] * 9):
        with pytest.raises(ValueError, match=r"row \d+: (the time goes back|a time stands twice|a time is not finite)"):
            following(times)


def test_times_that_do_not_run_forward_are_refused() -> None:
    for times, said in (
        ([0.0, 0.1, 0.2, -2.8, -2.7], "row 4: the time goes back by 3 s"),
        ([0.0, 0.1, 0.1, 0.2], "row 3: a time stands twice"),
        ([0.0, 0.1, float("nan")], "row 3: a time is not finite"),
        ([0.0, 10.0, 20.0], "10 s apart, not 0.001 to 0.1 s; 10 ms would be 0.01 s"),
        ([0.0, 1e-6, 2e-6], "1e-06 s apart"),
    ):
        with pytest.raises(ValueError, match=said):
            check_times(times, 1e-3, 0.1)


def test_holes_are_told_with_their_place_and_length() -> None:
    even = [5.0 + 0.01 * number for number in range(100)]
    assert check_times(even, 1e-3, 0.1) == []
    (remark,) = check_times([*even[:20], *even[50:]])
    assert "nothing for 0.31 s from 0.19 s on" in remark
    (remark,) = check_times([*even[:20], *even[50:70], *even[80:]])
    assert "0.31 s" in remark
    assert "1 shorter" in remark


def test_a_waveform_is_refused_or_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "cg.csv"
    for times, said in (
        ([0, 1, 2, 1.5, 3], "row 4: the time goes back by 0.5 s"),
        ([0, 1, 1, 2], "row 3: a time stands twice"),
        ([0, 2000, 4000, 6000], "2000 ms would be 2 s"),
    ):
        path.write_text("time,offset\n" + "".join(f"{time},0.0\n" for time in times))
        with pytest.raises(InputError, match=said):
            read_waveform(path)
    path.write_text("".join(f"{time},0.0\n" for time in (0, 1, 2, 3, 13, 14)))
    assert read_waveform(path)[0] == (0, 1, 2, 3, 13, 14)
    assert "nothing for 10 s from 3 s on" in capsys.readouterr().err


def test_a_flight_file_of_another_rate_is_refused(tmp_path: Path) -> None:
    plant = configs.Plant()
    arrays = {name: np.zeros((9, *shape)) for name, shape in shapes(plant).items()}
    path = tmp_path / "flight.npz"
    for step, said in ((20.0, "20 ms would be 0.02 s"), (-0.02, "the time goes back by 0.02 s")):
        save_flight(path, Flight("made", plant, {**arrays, "time": step * np.arange(9)}))
        with pytest.raises(InputError, match=said):
            load_flight(path)
    save_flight(path, Flight("made", plant, {**arrays, "time": 0.02 * np.arange(9)}))
    assert load_flight(path)["time"][-1] == pytest.approx(0.16)


def test_rows_of_a_run_that_do_not_follow_are_left_out_and_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As two processes that wrote one file leave it: 100, 200, 200, 150, 300."""
    names = [*COMMON, "eval_return"]
    table = [(100, 1.0), (200, 2.0), (200, 2.5), (150, 1.5), ("", 9.0), (300, 3.0)]
    text = ",".join(names) + "\n" + "".join(f"{steps},{value},1.0,{value},\n" for steps, value in table)
    path = tmp_path / "metrics.csv"
    path.write_text(text)
    curve = training_curve(tmp_path, 0)
    assert (curve["steps"], curve["episode_return"]) == ([100, 200, 300], [1.0, 2.0, 3.0])
    assert "3 of 6 rows do not follow" in capsys.readouterr().err
    (tmp_path / "other.csv").write_text("steps,seconds,steps\n1,2,3\n")
    with pytest.raises(InputError, match="stands twice"):
        read_rows(tmp_path / "other.csv")
    progress = Progress(path, dict.fromkeys(names, ""), 1000, resumed_at=250)
    progress.close()
    assert progress.before == 2.0
    assert [line.split(",")[0] for line in path.read_text().splitlines()] == ["steps", "100", "200"]


def test_numbers_that_64_bits_do_not_hold_are_endless() -> None:
    """As 1e400 is: whoever checks a number then says which one it is."""
    for digits, number in (("1" + "0" * 400, math.inf), ("-1" + "0" * 400, -math.inf), (str(2**63), 2**63), ("7", 7)):
        for found in (parse_json(f'{{"a": [{digits}]}}'), parse_toml(f"a = [{digits}]")):
            assert found == {"a": [number]}
            assert type(found["a"][0]) is type(number)


def test_numbers_that_can_be_computed_with() -> None:
    sound = (0, 0.0, -1, 1e-30, -1e12, 10**12)
    assert all(map(is_number, sound))
    for odd in (True, None, "1", [1], math.nan, math.inf, 1e-31, -1e-320, 5e-324, 1.1e12, 10**400):
        assert not is_number(odd), odd
    assert not is_number(2.0, 1.0)
