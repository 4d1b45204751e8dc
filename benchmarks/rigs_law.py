"""The law of `universal` on random rigs: which models, how fast a load, how long a memory, how firm a feedback.

    python benchmarks/rigs_law.py --json benchmarks/results/rigs_law.json
    python benchmarks/rigs_law.py --cases later --sizes 2 4 --seed 77 --policy policies/universal.npz

As `benchmarks/rigs.py`, of rigs of three drones, or of others that neither a training nor a judgement draws (`--seed`).
The law flies alone, or under the network of `--policy` as it is, which was trained with another. A model is a natural
frequency of the loops [rad/s] and a lag of the rotors [s], see `mjxball.baselines.multi_model_lqg`.
"""

from __future__ import annotations

import dataclasses
import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import rigs as judge
from mjxball import cli
from mjxball.baselines.multi_model_lqg import MODELS, SCORE_TIME, TORQUE_WALK, multi_model_lqg
from mjxball.baselines.team_lqg import TUNING
from mjxball.config import Config, preset, replace
from mjxball.control.followers import Law
from mjxball.control.multi_model_lqg import MultiModelLqg
from mjxball.evaluate.rigs import AnyRigBase, Flown, fly
from mjxball.policy import load_file, save_file
from mjxball.sim.rigs import HELD_OUT, HELD_OUT_RIGS, draw_rigs, unpadded

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
TWO_DAMPINGS = (0.6, 0.95)


class Case(NamedTuple):
    """What differs from one law to the next."""

    name: str
    models: Models = MODELS
    torque_walk: float = TORQUE_WALK
    score_time: float = SCORE_TIME  # [s]
    position: float = TUNING.position  # that costs 1 [m]
    velocity: float = TUNING.velocity  # that costs 1 [m/s]
    damping: tuple[float, ...] = ()  # of each model; (): that of the preset

    def law(self, config: Config) -> MultiModelLqg:
        """Its numbers."""
        tuning = TUNING._replace(position=self.position, velocity=self.velocity)
        laws = []
        for damping in self.damping or (config.attitude.damping,):
            damped = replace(config, "attitude.damping", damping)
            laws.append(multi_model_lqg(damped, self.models, self.torque_walk, tuning))
        numbers = {name: np.concatenate([getattr(law, name) for law in laws]) for name in OF_MODELS}
        c00, c01, c11 = numbers["certainty"].T
        prior = 0.5 * np.log(c00 * c11 - c01 * c01)
        keep = np.array([1.0 - config.timing.control_period / self.score_time, laws[0].keep[1]])
        return laws[0]._replace(**numbers, prior=prior - prior.max(), keep=keep)


OF_MODELS = ("axis", "axis_gain", "certainty", "tilt", "stiffness", "damping")
CASES = {
    "first": [
        *(Case("4 loops, one lag", FOUR, walk, score) for walk, score in ((20.0, 4.0), (300.0, SCORE_TIME))),
        *(Case("10 pairs", TEN, walk) for walk in (5.0, 20.0, 60.0, 400.0)),
        Case("8 pairs", EIGHT),
        *(Case("13 pairs", THIRTEEN, TORQUE_WALK, score) for score in (2.0, SCORE_TIME, 16.0)),
        Case("9 pairs: as it is"),
    ],
    "later": [
        Case("9 pairs: as it is"),
        *(Case("9 pairs", torque_walk=walk) for walk in (1000.0, 3000.0)),
        *(Case("9 pairs", position=position) for position in (0.15, 0.3)),
        *(Case("9 pairs", velocity=velocity) for velocity in (0.5, 0.8)),
        *(Case("9 pairs", torque_walk=1000.0, position=position) for position in (0.17, 0.15)),
        Case("7 pairs, two dampings", MODELS[:3] + MODELS[4:6] + MODELS[7:], damping=TWO_DAMPINGS),
    ],
}


class Variant(AnyRigBase):
    """The law with other numbers."""

    def __init__(self, config: Config, law: MultiModelLqg):
        super().__init__(config)
        self._law = law


def under(network: Path, law: MultiModelLqg, config: Config, rigs: Any) -> Law:
    """The policy of the file `network` with `law` in place of its own."""
    contents = load_file(network)
    card = {**contents.card, "lqg": {name: np.asarray(value).tolist() for name, value in law._asdict().items()}}
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / network.name
        save_file(path, dataclasses.replace(contents, card=card))
        return judge.network(path, config, rigs)


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly, print, write."""
    parser = cli.make_parser("python benchmarks/rigs_law.py", __doc__.split("\n\n")[0])
    parser.add_argument("--cases", choices=tuple(CASES), default="first", help="which laws (default first)")
    parser.add_argument("--sizes", type=int, nargs="+", default=[3], metavar="N", help="numbers of drones (default 3)")
    parser.add_argument("--rigs", type=int, default=HELD_OUT_RIGS, metavar="N", help="how many (default 200)")
    parser.add_argument("--seed", type=int, default=HELD_OUT, help="of the rigs (default: those held out)")
    parser.add_argument("--policy", type=Path, metavar="POLICY.npz", help="also under the network of this one")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args(arguments)
    config, rows = replace(preset("universal"), "rigs.mass_step", 0.0), []
    for size in options.sizes:
        rigs = unpadded(draw_rigs(config, size, options.rigs, options.seed).rigs, size)
        flown: dict[str, Flown] = {}
        for name, make in judge.followers([]):
            if name in judge.KNOWING:
                flown[name] = fly(config, rigs, make(config, rigs), judge.FLIGHTS)
        for case in CASES[options.cases]:
            law = case.law(config)
            made: dict[str, Law] = {"law alone": Variant(config, law)}
            if options.policy:
                made[options.policy.stem] = under(options.policy, law, config, rigs)
            for follower, one in made.items():
                flown["law"] = fly(config, rigs, one, judge.FLIGHTS)
                found = judge.row_of(flown, "law", rigs, config.timing.control_period)
                rows.append({"drones": size, "follower": follower, **case._asdict(), **found})
                shown = " ".join(f"{key} {found[key]:.3f}" for key in SHOWN)
                told = f"{case.torque_walk:5g} {case.score_time:4g} s {case.position:5g} m {case.velocity:4g} m/s"
                print(f"{size} {follower:10} {case.name:22} {told} {shown}", flush=True)
    if options.json:
        settings = {"rigs": options.rigs, "seed": options.seed}
        options.json.write_text(json.dumps({**settings, "rows": rows}, indent=1) + "\n")
    return 0


SHOWN = ("failed", "peak_50", "small", "soon", "met", "sooner")

if __name__ == "__main__":
    sys.exit(cli.run_command(main))
