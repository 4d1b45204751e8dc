"""The law of `universal` without its network on held-out rigs: which models, how fast a load, how long a memory.

    python benchmarks/rigs_law.py --json benchmarks/results/rigs_law.json

As `benchmarks/rigs.py`, of rigs of three drones. A model is a natural frequency of the loops [rad/s] and a lag of the
rotors [s], see `mjxball.baselines.multi_model_lqg`.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import rigs as judge
from mjxball import cli
from mjxball.baselines.multi_model_lqg import MODELS, SCORE_TIME, TORQUE_WALK, multi_model_lqg
from mjxball.config import Config, preset, replace
from mjxball.evaluate.rigs import AnyRigBase, Flown, fly
from mjxball.sim.rigs import HELD_OUT_RIGS, RigTable, held_out

LOOPS = (4.5, 7.0, 11.0, 17.0)
Models = tuple[tuple[float, float], ...]


def crossed(lags: Sequence[float], most: float) -> Models:
    """`LOOPS` and `lags` whose product is at most `most`."""
    return tuple((loop, lag) for loop in LOOPS for lag in lags if loop * lag <= most)


FOUR: Models = tuple((loop, min(0.05, 0.35 / loop)) for loop in LOOPS)
TEN, THIRTEEN = crossed((0.02, 0.05, 0.12), 0.9), crossed((0.02, 0.04, 0.08, 0.14), 1.0)
EIGHT: Models = (
    *((4.5, 0.04), (4.5, 0.14), (7.0, 0.025), (7.0, 0.1)),
    *((11.0, 0.02), (11.0, 0.07), (17.0, 0.018), (17.0, 0.05)),
)
CASES: list[tuple[str, Models, float, float]] = [  # name, models, torque walk, score time [s]
    *(("4 loops, one lag", FOUR, walk, score) for walk, score in ((20.0, 4.0), (300.0, SCORE_TIME))),
    *(("10 pairs", TEN, walk, SCORE_TIME) for walk in (5.0, 20.0, 60.0, 400.0)),
    ("8 pairs", EIGHT, TORQUE_WALK, SCORE_TIME),
    *(("13 pairs", THIRTEEN, TORQUE_WALK, score) for score in (2.0, SCORE_TIME, 16.0)),
    ("9 pairs: as it is", MODELS, TORQUE_WALK, SCORE_TIME),
]


class Variant(AnyRigBase):
    """The law with other models."""

    def __init__(self, config: Config, models: Models, walk: float, score: float):
        super().__init__(config)
        law = multi_model_lqg(config, models, walk)
        self._law = law._replace(keep=[1.0 - config.timing.control_period / score, law.keep[1]])


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly, print, write."""
    parser = cli.make_parser("python benchmarks/rigs_law.py", __doc__.split("\n\n")[0])
    parser.add_argument("--rigs", type=int, default=HELD_OUT_RIGS, metavar="N", help="how many (default 200)")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args(arguments)
    config = replace(preset("universal"), "rigs.mass_step", 0.0)
    rigs, period = held_out(config, 3, options.rigs), config.timing.control_period
    flown: dict[str, Flown] = {}
    for name, make in judge.followers([]):
        if name in judge.KNOWING:
            flown[name] = _flown(config, rigs, make(config, rigs))
    rows: list[dict[str, Any]] = []
    for name, models, walk, score in CASES:
        flown["law"] = _flown(config, rigs, Variant(config, models, walk, score))
        found = judge.row_of(flown, "law", rigs, period)
        rows.append({"models": name, "pairs": models, "torque_walk": walk, "score_time": score, **found})
        print(f"{name:18} {walk:5g} {score:4g} s " + " ".join(f"{key} {found[key]:.3f}" for key in SHOWN), flush=True)
    if options.json:
        options.json.write_text(json.dumps({"rows": rows}, indent=1) + "\n")
    return 0


def _flown(config: Config, rigs: RigTable, laws: Any) -> Flown:
    return fly(config, rigs, laws, judge.FLIGHTS)


SHOWN = ("failed", "peak_50", "small", "soon", "met", "sooner")

if __name__ == "__main__":
    sys.exit(cli.run_command(main))
