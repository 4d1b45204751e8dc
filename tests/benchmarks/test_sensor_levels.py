"""Levels of sensors, estimated from synthetic flights whose errors are known."""

from __future__ import annotations

import gzip
import json
import math
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import lfilter, savgol_filter
from scipy.spatial.transform import Rotation

import sensor_levels
from mjxball.errors import InputError
from sensor_levels import (
    PERIOD,
    attitude_loop,
    gaps,
    gauss_markov,
    main,
    read_flight,
    slope,
    time_shift,
    time_shifts,
    white_noise,
)

SECONDS, GRAVITY = 60.0, 9.81
DRAG, LAG, OFFSET, SINK = 0.4, 0.02, (0.010, -0.006, 0.003), 0.008  # [1/s], [s], [rad], [m/s]
TIMES = PERIOD * np.arange(round(SECONDS / PERIOD))


def path(times: np.ndarray) -> np.ndarray:
    """A figure of eight of 6 s, 1 m above the ground (T, 3) [m]."""
    turn = 2 * math.pi * times / 6
    return np.stack([0.8 * np.sin(turn), 0.4 * np.sin(2 * turn), np.ones_like(times)], axis=1)


def markov(random: np.random.Generator, deviation: float, time: float, components: int = 1) -> np.ndarray:
    """A first-order Gauss-Markov process (T, components)."""
    keep = math.exp(-PERIOD / time)
    steps = deviation * math.sqrt(1 - keep**2) * random.normal(size=(len(TIMES) + 2000, components))
    return lfilter([1], [1, -keep], steps, axis=0)[2000:]


def test_white_noise_is_found_on_a_moving_signal() -> None:
    """6 %: the median over 60 windows of 100 correlated residuals knows a deviation to 2.2 %."""
    random = np.random.default_rng(1)
    for deviation in (1e-4, 1e-3):
        found = white_noise(path(TIMES) + deviation * random.normal(size=(len(TIMES), 3)))
        assert found == pytest.approx([deviation] * 3, rel=0.06)


def test_time_shifts_are_found_to_a_fraction_of_a_sample() -> None:
    """0.2 ms: interpolation on straight lines over 10 ms, of 0.9 m/s2, errs by 0.02 mm at 0.5 m/s and more."""
    early = path(TIMES)[:, :2]
    assert time_shift(path(TIMES - 0.0173)[:, :2], early) == pytest.approx(0.0173, abs=2e-4)
    assert time_shift(path(TIMES + 0.034)[:, :2] + 5.0, early) == pytest.approx(-0.034, abs=2e-4)
    varying = 0.02 + 0.03 * np.sin(2 * math.pi * TIMES / 0.7)
    found = time_shifts(path(TIMES - varying)[:, :2], early, np.gradient(early, PERIOD, axis=0))
    inside = slice(20, -20)  # beyond the ends nothing is known
    assert np.abs(found - varying)[inside].max() < 1e-3  # the path's slowest part is pulled to zero by 1 %


def test_a_gauss_markov_process_is_found_below_white_noise() -> None:
    """60 s hold 60 independent values of a process of 0.5 s: its deviation is known to 9 %, of 20 flights to 2 %."""
    random = np.random.default_rng(2)
    found = [gauss_markov(markov(random, 2.0, 0.5, 2) + random.normal(size=(len(TIMES), 2)), 2) for _ in range(20)]
    deviation, time = np.mean(found, axis=0)
    assert deviation == pytest.approx(2.0, rel=0.06)
    assert time == pytest.approx(0.5, rel=0.15)


def test_the_longest_gap_of_an_interpolated_column_is_found() -> None:
    """A gap of the source between two grid points of 100 Hz is found exactly; one of 20 ms is too short to count."""
    random = np.random.default_rng(3)
    known = np.delete(np.arange(len(TIMES)), [*range(101, 108), 500, *range(2001, 2004)])  # 80, 20, 40 ms
    column = np.round(np.interp(TIMES, TIMES[known], random.normal(size=len(known))), 9)
    rate, longest = gaps(column)
    assert (rate, longest) == (pytest.approx(2.0), pytest.approx(80.0))


def test_the_error_of_a_slope_covers_the_truth_though_the_noise_is_correlated() -> None:
    """2 standard errors cover 95 %; of 40 flights at least 33, what chance falls below in 1 of 300 cases."""
    random, speed, covered = np.random.default_rng(4), np.gradient(path(TIMES)[:, 0], PERIOD), 0
    for _ in range(40):
        found, constant, error = slope(-DRAG * speed + 0.1 + markov(random, 0.05, 0.3)[:, 0], speed)
        covered += abs(found + DRAG) < error
        assert constant == pytest.approx(0.1, abs=0.03)  # 0.05 over the root of 100 independent values, 6 deviations
    assert covered >= 33


def test_the_bandwidth_of_an_attitude_loop_is_found() -> None:
    """The grid of bandwidths is 8 % wide, that of delays a sample."""
    setpoint = markov(np.random.default_rng(5), 1.0, 0.3)[:, 0]
    keep = math.exp(-12 * PERIOD)
    measured = 0.8 * np.roll(lfilter([1 - keep], [1, -keep], setpoint), 4)
    assert attitude_loop(setpoint, measured, 8) == (pytest.approx(12, rel=0.08), pytest.approx(40))


def flight(folder: Path) -> Path:
    """A flight's file: position late by `LAG` behind gyro, velocity and attitude; `DRAG`, `OFFSET`, `SINK`."""
    random, rise = np.random.default_rng(6), np.clip(TIMES / 2, 0, 1)
    place = path(TIMES) * rise[:, None]
    velocity = savgol_filter(place, 11, 3, deriv=1, delta=PERIOD, axis=0)
    pull = np.gradient(velocity, PERIOD, axis=0) + [0, 0, GRAVITY] + DRAG * velocity
    up = pull / np.linalg.norm(pull, axis=1, keepdims=True)
    attitude = Rotation.from_rotvec(np.stack([-up[:, 1], up[:, 0], np.zeros(len(up))], axis=1))
    steps = (attitude[:-1].inv() * attitude[1:]).as_rotvec() / PERIOD
    force = attitude.inv().apply(pull - DRAG * velocity) / GRAVITY
    late, sinking = path(TIMES - LAG) * rise[:, None], velocity - [0, 0, SINK]
    sent = {
        **dict(zip(("px", "py", "pz"), (place + 5e-5 * random.normal(size=place.shape)).T, strict=True)),
        **dict(zip(("qx", "qy", "qz", "qw"), attitude.as_quat().T, strict=True)),
        **{f"est_stateEstimate_{axis}": column for axis, column in zip("xyz", late.T, strict=True)},
        **{f"est_stateEstimate_v{axis}": column for axis, column in zip("xyz", sinking.T, strict=True)},
        **{f"imu_gyro_{axis}": column for axis, column in zip("xyz", np.vstack([steps, steps[-1:]]).T, strict=True)},
        **{f"imu_acc_{axis}": column for axis, column in zip("xyz", force.T, strict=True)},
        **{f"motor_motor_m{number}": 40000 * force[:, 2] * np.exp(0.002 * TIMES) for number in (1, 2, 3, 4)},
        **{f"pid_controller_{name}": np.zeros_like(TIMES) for name in ("roll", "pitch", "cmd_thrust")},
        **{f"att_stateEstimate_{name}": np.zeros_like(TIMES) for name in ("roll", "pitch")},
    }
    estimate = (attitude * Rotation.from_rotvec(OFFSET)).as_quat().T
    sent |= {f"att_stateEstimate_q{name}": column for name, column in zip("xyzw", estimate, strict=True)}
    found = folder / "figure8.csv.gz"
    with gzip.open(found, "wt", encoding="utf-8") as stream:
        rows = np.stack([TIMES, *sent.values()], axis=1)
        np.savetxt(stream, rows, fmt="%.9f", delimiter=",", header=",".join(["t", *sent]), comments="")
    return found


def test_levels_of_a_whole_flight(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    flight(tmp_path)
    monkeypatch.setattr(sys, "argv", ["sensor_levels.py", str(tmp_path), "--json", str(tmp_path / "levels.json")])
    assert main() == 0
    levels = {row["level"]: row["figure8"] for row in json.loads((tmp_path / "levels.json").read_text())["levels"]}
    assert levels["noise, mocap position [mm]"] == pytest.approx([0.05] * 3, rel=0.05)
    for name in ("gyro", "attitude", "velocity"):
        # Rates are differences to the next sample: half of one ahead.
        assert levels[f"lag of positions behind {name} [ms]"] == pytest.approx(20 + 5 * (name == "gyro"), abs=1)
    assert levels["offset, attitude [mrad]"] == pytest.approx([1e3 * part for part in OFFSET], abs=0.3)
    assert levels["offset, velocity [mm/s]"] == pytest.approx([0, 0, -1e3 * SINK], abs=0.5)
    for axis in "xy":
        assert levels[f"drag, {axis} [1/s], 2 standard errors"][0] == pytest.approx(DRAG, rel=0.02)
    assert levels["fade over motors [1/s], 2 standard errors"][0] == pytest.approx(-0.002, rel=0.02)
    assert levels["uneven motors"] == pytest.approx(0, abs=1e-6)
    assert levels["mocap gaps a minute, longest [ms]"] == pytest.approx([0, 10])


def test_what_is_no_flight_is_refused_in_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["sensor_levels.py", str(tmp_path)])
    with pytest.raises(InputError, match="no flights"):
        sensor_levels.main()
    for text in ("t,px\n0,1\n0.01,1\n", "t,px,py,pz,qx,qy,qz,qw\n" + "0,0,0,1,0,0,0,1\n" * 200, "t,pz\n0,x\n1,1\n"):
        with gzip.open(tmp_path / "other.csv.gz", "wt", encoding="utf-8") as stream:
            stream.write(text)
        with pytest.raises(InputError, match="flight"):
            read_flight(tmp_path / "other.csv.gz")
    (tmp_path / "other.csv.gz").write_bytes(b"t,px\n")
    with pytest.raises(InputError, match="flight"):
        read_flight(tmp_path / "other.csv.gz")
