"""Real flights: the reader, the fit and the comparison recover a simulated flight, and real data where they are given.

MJXBALL_REAL_FLIGHTS names a directory of NanoBench flights for the last test.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from command_line import REPOSITORY, call, environment
from flights_made import COLUMNS, Truth, fly, write

import real_flights
from mjxball.control.crazyflie import PERIOD
from mjxball.errors import InputError
from nanobench import cascade, lift
from nanobench.flights import Flight, find_flights, read_flight
from nanobench.rotation import fit_rotation, track_of
from nanobench.study import FITTED, Study, study, to_json

TRUTH = Truth()
SCRIPT = REPOSITORY / "benchmarks" / "real_flights.py"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A directory of two flights to fit and one to hold out, of which one is packed."""
    place = tmp_path_factory.mktemp("flights")
    names = (f"{FITTED[0]}.csv", f"{FITTED[1]}.csv.gz", "other.csv")
    for name, columns in zip(names, fly(TRUTH, 16.0, len(names)), strict=True):
        write(columns, place / name)
    return place


@pytest.fixture(scope="module")
def flights(made: Path) -> list[Flight]:
    return [read_flight(path) for path in find_flights(made).values()]


@pytest.fixture(scope="module")
def reported(made: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Study, Path]:
    """What the script found, and where it wrote `out.json` and `out.png`."""
    place, kept = tmp_path_factory.mktemp("reported"), []
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(real_flights.study, "study", lambda *given: kept.append(study(*given)) or kept[0])
        assert call(real_flights.main, [made, "--json", place / "out.json", "--figure", place / "out.png"]) == 0
    return kept[0], place


@pytest.fixture(scope="module")
def found(reported: tuple[Study, Path]) -> Study:
    return reported[0]


def test_a_flight_is_read_in_our_units(flights: list[Flight]) -> None:
    flight = flights[0]
    rows = flight.airborne
    assert 1.9 < flight.time[rows.start] - 0.5 < 2.6  # 0.5 s at rest, 2 s after the motors have spun up
    # Specific force is the weight on average: flights begin and end at rest in height.
    np.testing.assert_allclose(flight.acceleration[rows, 2].mean(), 9.81, rtol=0.02)
    # The estimator's attitude turns as the gyro says; gyro noise of 0.003 rad/s and 1 % for the other Euler angles.
    turned = np.gradient(flight.estimate[rows, :2], flight.time[rows], axis=0)
    for axis in (0, 1):
        assert np.corrcoef(turned[:, axis], flight.gyro[rows, axis])[0, 1] > 0.99
    assert flight.has_cascade


def test_rows_that_are_missing_count_as_damaged(made: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    lines = (made / "other.csv").read_text().splitlines(keepends=True)
    (tmp_path / "other.csv").write_text("".join([*lines[:800], *lines[830:]]))  # 0.3 s
    whole, found = read_flight(made / "other.csv"), read_flight(tmp_path / "other.csv")
    assert "nothing for 0.31 s" in capsys.readouterr().err
    before = 798  # the header is no row
    assert found.damaged[before - 1 : before + 4].all()
    np.testing.assert_array_equal(found.damaged[: before - 5], whole.damaged[: before - 5])


def test_the_fit_recovers_the_simulated_drone(flights: list[Flight]) -> None:
    fit = fit_rotation([track_of(flight) for flight in flights])
    # Lag and delay are one for slow commands. The drone's own step adds a tick of 2 ms; rows every 10 ms.
    assert fit.lag + fit.delay == pytest.approx(TRUTH.lag + (TRUTH.delay + 1) * PERIOD, abs=0.006)
    assert fit.lag == pytest.approx(TRUTH.lag, abs=0.012)
    # Gusts of 2 rad/s2 that the controller answers, and commands between two rows: see the module.
    np.testing.assert_allclose(fit.gain[:2], TRUTH.gain[:2], rtol=0.15)
    np.testing.assert_allclose(fit.blow_back, [TRUTH.blow_back, -TRUTH.blow_back], rtol=0.25)
    assert np.all(fit.errors["gain"][:2] < 0.1 * fit.gain[:2])


def test_force_over_mass_and_its_exponents(flights: list[Flight]) -> None:
    lifts = {flight.name: lift.lift_of(flight, TRUTH.lag, TRUTH.delay * PERIOD) for flight in flights}
    models = lift.compare(lifts, {})
    factor = lift.nominal_factor(models)
    assert factor == pytest.approx(TRUTH.force_over_mass, rel=0.005)  # exact but for rows every 10 ms
    worse = {name: np.abs(fit.left[flights[0].name]).mean() for name, fit in models.items()}
    assert min(worse, key=worse.__getitem__) == "factor x cubic 2.1"
    exponents = lift.elasticities(list(lifts.values()))
    # A force of command times voltage alone has one exponent for both, and compensation leaves none.
    assert exponents["command"][0] == pytest.approx(exponents["voltage"][0], abs=0.1)
    assert exponents["voltage, compensated"][0] == pytest.approx(0.0, abs=0.05)


def test_the_cascade_repeats_its_own_commands(flights: list[Flight]) -> None:
    replayed = cascade.replay(flights[0])
    errors, sizes = cascade.errors(replayed), cascade.sizes(replayed)
    # Derivative terms of a signal known every 10 ms instead of 2 ms; the integrals' levels are taken out.
    for part in ("roll", "pitch"):
        assert np.median(errors[part]) < 0.4 * np.median(sizes[part])
    assert np.median(errors["collective"]) < 20  # of 65535: linear interpolation of thrust and voltage
    offsets = cascade.compensation(flights[0])
    assert abs(offsets["2.1"]) < 20 < abs(offsets["2.1-legacy"])


@pytest.mark.slow
def test_forecasts_beat_constant_rates_on_the_held_out_flight(found: Study) -> None:
    forecast = found.forecasts["other"]
    for row, share in ((10, 0.75), (25, 0.95)):  # rows of 10 ms
        errors = {name: np.sqrt(np.mean(forecast.rates(name)[row, :, :2] ** 2)) for name in forecast.paths}
        assert errors["model"] < share * errors["constant rate"]
    # Rates integrated from the gyro give the attitude back: 0.003 rad/s of noise over 0.5 s.
    assert np.abs(forecast.attitude("measured rates")[50]).max() < 0.02


@pytest.mark.slow
def test_the_report_holds_plain_finite_numbers(found: Study) -> None:
    data = to_json(found)
    assert data["held_out"] == ["other"]
    json.dumps(data, allow_nan=False)
    low, high = data["ranges"]["lag_plus_delay_s"]
    assert low <= data["fit"]["lag_s"] + data["fit"]["delay_s"] <= high


def run(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(SCRIPT), *map(str, arguments)]
    child = {**environment(), "PYTHONPATH": str(REPOSITORY)}
    return subprocess.run(command, env=child, capture_output=True, text=True, timeout=300, check=False)


def test_bad_input_is_one_sentence(flights: list[Flight], made: Path, tmp_path: Path) -> None:
    good = {name: column[:900] for name, column in fly(TRUTH, 2.0, 1)[0].items()}
    count = len(good["t"])
    backwards, holey = good["t"].copy(), good["imu_gyro_x"].copy()
    backwards[7], holey[5] = backwards[3], np.nan
    long = {name: np.tile(column, 6) for name, column in good.items()} | {"t": np.arange(6 * count) * 0.01}
    cases = {
        "lacks the columns motor_motor_m1, pwr_pm_vbat": {
            name: column for name, column in long.items() if name not in ("motor_motor_m1", "pwr_pm_vbat")
        },
        "not finite in imu_gyro_x": long | {"imu_gyro_x": np.tile(holey, 6)},
        "row 8: the time goes back by 0.03 s": long | {"t": np.tile(backwards, 6)},
        "10 ms would be 0.01 s": long | {"t": 10.0 * np.arange(6 * count)},
        "0.02 s apart": long | {"t": 0.02 * np.arange(6 * count)},
        "less than 5 s of flight": long | {name: 0 * long["t"] for name in COLUMNS if name.startswith("motor_")},
        "s are needed": good,
    }
    for sentence, columns in cases.items():
        path = write(columns, tmp_path / "case.csv")
        with pytest.raises(InputError, match=sentence):
            read_flight(path)
    (tmp_path / "case.csv").write_text(",".join(COLUMNS) + "\n" + ",".join(["word"] * len(COLUMNS)) + "\n")
    with pytest.raises(InputError, match="not a table of numbers"):
        read_flight(tmp_path / "case.csv")
    for directory, sentence in ((tmp_path / "none", "not a directory"), (tmp_path, "lacks the flight")):
        with pytest.raises(InputError, match=sentence):
            study(directory)


def test_the_script_refuses_in_one_line_with_code_2(tmp_path: Path) -> None:
    result = run(tmp_path, "--json", tmp_path / "out.json")
    assert result.returncode == 2
    assert result.stdout == ""
    assert len(result.stderr.strip().splitlines()) == 1
    assert "holds no flight" in result.stderr
    assert not (tmp_path / "out.json").exists()


@pytest.mark.slow
def test_the_script_writes_what_it_found(reported: tuple[Study, Path]) -> None:
    data = json.loads((reported[1] / "out.json").read_text())
    assert {"command", "commit", "fit", "forecasts", "cascade", "thrust", "ranges"} <= data.keys()
    assert (reported[1] / "out.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.release
def test_the_real_flights() -> None:
    found = study(Path(os.environ["MJXBALL_REAL_FLIGHTS"]))
    # Physics of a 2.1: lag and delay together 50 to 75 ms, and forecasts 0.1 s ahead better than constant rates.
    assert 0.05 < found.fit.lag + found.fit.delay < 0.075
    for name in found.held_out:
        made = found.forecasts[name]
        errors = {key: np.abs(made.rates(key)[10, :, :2]) for key in ("model", "constant rate")}
        for share in (0.5, 0.9, 0.99):
            assert np.quantile(errors["model"], share) < np.quantile(errors["constant rate"], share)
