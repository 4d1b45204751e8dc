"""What the policies of the world learn in is the world that the benchmark flies."""

from __future__ import annotations

from mjxball.bench import conditions
from mjxball.config import preset


def test_balance_learns_in_ranges_that_contain_those_of_the_world() -> None:
    air, ranges = conditions.OUTDOORS, preset("balance").scenario
    for name, (low, high) in {
        "noise": conditions.NOISE,
        "estimator_drift": conditions.DRIFT,
        "offset": (conditions.OFFSET, conditions.OFFSET),
        "pose_lag": conditions.POSE_LAG,
        "gap_rate": conditions.GAP_RATE,
        "jitter": conditions.JITTER,
        "delay": (0.0, conditions.DELAY),
        "thrust_scale": conditions.THRUST,
        "rotor_drag": air.drag,
        "wind": air.wind,
        "thrust_fade": air.fade,
        "download": air.download,
        "floor_clearance": air.clearance,
        "attitude_frequency": air.loops,
    }.items():
        least, most = getattr(ranges, name)
        assert least <= low, name
        assert high <= most, name
    assert preset("balance").follower.stale
