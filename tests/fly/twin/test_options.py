"""The flags that say what the twin is: handed on as they are, and refused in one sentence."""

from __future__ import annotations

import argparse

import pytest

from mjxball.errors import InputError
from mjxfly.main import check_twin_options, make_parser, twin_options
from mjxfly.twin.conditions import CURVES, DRONES, OLDER_FORCE, Surroundings, add_twin_options, drone_kind, surroundings

ASKED = "--twin-drone brushless --twin-curve older --twin-noise 3 --twin-pose-hz 20 --twin-deck no --twin-delay 0.01"
ASKED += " --twin-gains 0.95 1.05 --twin-seed 7"


def drone_kind_of(flags: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    add_twin_options(parser)
    return parser.parse_args(flags)


def test_the_runner_hands_on_what_it_was_asked() -> None:
    options = make_parser().parse_args(["policy.npz", "--rehearse", *ASKED.split()])
    check_twin_options(options)
    told = drone_kind_of(twin_options(options))
    assert surroundings(told) == Surroundings(3.0, 20.0, False, 0.01, (0.95, 1.05), seed=7)
    assert (told.twin_drone, told.twin_curve) == ("brushless", "older")
    nothing = make_parser().parse_args(["policy.npz", "--rehearse"])
    assert twin_options(nothing) == []
    assert surroundings(drone_kind_of([])) == Surroundings()


@pytest.mark.parametrize(
    "flags",
    ["--twin-noise=-1", "--twin-pose-hz=0", "--twin-delay=2", "--twin-gains 0 1", "--twin-seed=-1"],
)
def test_unsound_ones_are_refused(flags: str) -> None:
    options = make_parser().parse_args(["policy.npz", "--rehearse", *flags.split()])
    with pytest.raises(InputError, match="--twin-"):
        check_twin_options(options)


def test_without_a_rehearsal_there_is_no_twin() -> None:
    options = make_parser().parse_args(["policy.npz", "--twin-noise", "2"])
    with pytest.raises(InputError, match="--rehearse only"):
        check_twin_options(options)


def test_kinds_differ_in_what_they_say() -> None:
    delivered = drone_kind()
    assert (delivered.device, delivered.version, delivered.compensated) == ("Crazyflie 2.1", "2026.08", True)
    assert drone_kind("brushless").idle == 7000
    older = drone_kind(curve="older")
    assert (older.compensated, older.older_force, older.version) == (False, True, "2025.02")
    assert sum(OLDER_FORCE) == pytest.approx(0.159, abs=1e-3)  # N of one motor at full power
    assert not drone_kind(curve="cubic").compensated
    assert len({drone_kind(drone, curve) for drone in DRONES for curve in CURVES}) == len(DRONES) * len(CURVES)
