"""The flags that say what the twin is: handed on as they are, and refused in one sentence."""

from __future__ import annotations

import argparse

import numpy as np
import pytest
from command_line import call
from tables import rows

from mjxball.config import preset
from mjxball.errors import InputError
from mjxball.policy import shipped_policy
from mjxfly.main import check_twin_options, main, make_parser, twin_options
from mjxfly.twin.conditions import (
    BODY_FAULTS,
    CURVES,
    DRONES,
    OLDER_FORCE,
    Surroundings,
    add_twin_options,
    drone_kind,
    surroundings,
)
from mjxfly.twin.coupled import CoupledPair
from mjxfly.twin.physics import SimplePair

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


@rows(
    "policy, flags, sentence",
    [
        ("transport-large", "--fault weak:leader@1", "--fault weak:leader@1 is for policies that were trained on"),
        ("transport-large", "--fault pose-lost:follower@1", "pose-lost:follower@1 is for policies"),
        ("transport-large", "--twin-noise 2", "--twin-noise is for policies that were trained on Crazyflies"),
        ("transport-large", "--twin-gains 1 0.9", "--twin-gains is for policies that were trained on Crazyflies"),
        ("flight", "--fault peer:leader@1", "--fault peer:leader@1 is for --onboard"),
        ("flight", "--fault pose-jump:leader@1 --twin-deck no", "is of the deck's poses"),
    ],
)
def test_what_the_twin_would_ignore_is_refused(
    policy: str, flags: str, sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("cflib")
    assert call(main, [shipped_policy(policy), "--rehearse", *flags.split()]) == 2
    assert sentence in capsys.readouterr().err


def test_models_refuse_what_they_do_not_simulate() -> None:
    """The simple model acts on a battery that gives way, and on no other body fault; the coupled one on all."""
    pair, coupled = SimplePair(), CoupledPair(preset("flight"))
    pair.disturb(1, "battery", 3.0)
    assert pair.advance(np.zeros((2, 4)), 0.005).battery == pytest.approx([4.1, 3.0])
    for what in BODY_FAULTS - {"battery"}:
        with pytest.raises(InputError, match=f"not '{what}'"):
            pair.disturb(0, what, 1.0)
        coupled.disturb(0, what, 1.0)
    with pytest.raises(InputError, match="not 'bent'"):
        coupled.disturb(0, "bent", 1.0)
    with pytest.raises(InputError, match=r"does not simulate surroundings\.gains"):
        SimplePair(surroundings=Surroundings(gains=(1.0, 0.9)))
