"""An entry of the benchmark that is good but for what is changed."""

from __future__ import annotations

import datetime
from typing import Any

from mjxball.bench.success import REASONS


def results(**changed: Any) -> dict[str, Any]:
    """Results of a condition: 100 of 120 flights succeed."""
    reasons = {**dict.fromkeys(REASONS, 0), "crashed": 2, "late": 4, "leaves": 5, "rotors": 10}
    found = {"flights": 120, "succeeded": 100, "reasons": reasons, "arrival_ratio": 1.1, "late_error_90": 0.008}
    return {**found, "rotor_power": 1.02, "rotor_limit_share": 0.02, "command_change": 0.01, **changed}


def known(calm: Any = None, **changed: Any) -> dict[str, Any]:
    """An entry that is good but for what is changed."""
    found = {
        **{"benchmark": "mjxball-bench", "version": 2, "draw": 0, "key": "0123456789abcdef" * 2},
        **{"follower": "mine", "sha256": "ab" * 32, "date": datetime.datetime.now(datetime.UTC).date().isoformat()},
        **{
            "cpu_time": 1e-3,
            "tracks": {"pair": {"calm": calm or results(), "disturbed": results(late_error_90=0.018)}},
        },
        **{"not_flown": {"team": "it is for pairs"}, "command": "python eval.py bench mine.npz --out mine.json"},
        **{"commit": "93771579971e", "versions": {"python": "3.11.7"}},
    }
    return {**found, **changed}


def reasons(**changed: int) -> dict[str, Any]:
    """Results with other counts of reasons."""
    return results(reasons={**results()["reasons"], **changed})


def without(name: str, found: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in found.items() if key != name}
