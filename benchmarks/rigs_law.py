"""The law of `universal` on random rigs: which models, how fast a load, how long a memory, how firm a feedback.

    python benchmarks/rigs_law.py --json benchmarks/results/rigs_law.json
    python benchmarks/rigs_law.py --cases later --sizes 2 4 --seed 77 --policy policies/universal.npz
    python benchmarks/rigs_law.py --cases delay --sizes 2 4 --seed 77 --policy policies/universal.npz
    python benchmarks/rigs_law.py --cases told --sizes 2 4 --seed 77 --policy policies/universal.npz
    python benchmarks/rigs_law.py --cases axes --sizes 2 3 --seed 77 --policy policies/universal.npz
    python benchmarks/rigs_law.py --cases swings --sizes 3 --seed 77 --rigs 100 --policy policies/universal.npz
    python benchmarks/rigs_law.py --cases sizes --sizes 2 3 4 5 6 --seed 77 --policy policies/universal.npz

As `benchmarks/rigs.py`, of rigs of three drones, or of others that neither a training nor a judgement draws (`--seed`).
The law flies alone, or under the network of `--policy` as it is, which was trained with another; of a law without
swings it is not shown them, of one that it was not trained with it sees nothing new. A model is a natural
frequency of the loops [rad/s] and a lag of the rotors [s], see `mjxball.baselines.multi_model_lqg`. `told`: one
model, of the rig's own loops and rotors; and the LQGs that know the rig, each against the better of both. `axes`: a
pair's own filters and room about roll, and all of it about the rig's axes. `swings`: room for what is held, and loads
that swing held against ahead of time. `sizes`: factors on the feedback of the error, and for how much small actions of
the network count; those of each size that a policy has fly in `benchmarks/rigs.py --seed 77`.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import rigs as judge
from mjxball import cli
from mjxball.baselines.multi_model_lqg import MODELS, SCORE_TIME, TUNING, multi_model_lqg
from mjxball.config import Config, Plant, preset, replace
from mjxball.control.followers import Law
from mjxball.control.multi_model_lqg import MultiModelLqg
from mjxball.evaluate.policies import load_policy
from mjxball.evaluate.rigs import AnyRigBase, AnyRigLaw, Flown, fly
from mjxball.policy import Policy
from mjxball.sim.rigs import HELD_OUT, HELD_OUT_RIGS, RigTable, draw_rigs, rig_config, unpadded

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
NINE: Models = (
    *((4.5, 0.03), (4.5, 0.08), (4.5, 0.15)),
    *((7.0, 0.025), (7.0, 0.06), (7.0, 0.12)),
    *((11.0, 0.025), (11.0, 0.07), (17.0, 0.03)),
)
TWO_DAMPINGS = (0.6, 0.95)


def later(seconds: float, models: Models = NINE) -> Models:
    """`models` with lags that are `seconds` longer."""
    return tuple((loop, lag + seconds) for loop, lag in models)


class Case(NamedTuple):
    """What differs from one law to the next, and what it was until commit ae6ef53."""

    name: str
    models: Models = NINE
    torque_walk: float = 300.0
    score_time: float = SCORE_TIME  # [s]
    position: float = 0.2  # that costs 1 [m]
    velocity: float = TUNING.velocity  # that costs 1 [m/s]
    damping: tuple[float, ...] = ()  # of each model; (): that of the preset
    added_lift: float = 0.0  # share of the lift that the network adds whose torque a pair's scores are told
    pair_roll: bool = False  # whether a pair has its own filters and room about roll
    rig_axes: bool = False  # whether all this is about the rig's axes, not those of the mount frame
    held_room: bool = False  # whether more than two drones have room for what they hold
    swings: bool = False  # whether loads that swing are held against ahead of time
    by_size: tuple[tuple[float, ...], ...] = ()  # rows of `MultiModelLqg.by_size`; (): none
    delay: float | None = None  # [s] added to the lag of the rig's own rotors, if its own loop is the only model

    def law(self, config: Config) -> MultiModelLqg:
        """Its numbers."""
        tuning = TUNING._replace(position=self.position, velocity=self.velocity, torque_walk=self.torque_walk)
        laws = []
        for damping in self.damping or (config.attitude.damping,):
            damped = replace(config, "attitude.damping", damping)
            laws.append(multi_model_lqg(damped, self.models, tuning))
        numbers = {name: np.concatenate([getattr(law, name) for law in laws]) for name in OF_MODELS}
        c00, c01, c11 = numbers["certainty"].T
        prior = 0.5 * np.log(c00 * c11 - c01 * c01)
        keep = np.array([1.0 - config.timing.control_period / self.score_time, laws[0].keep[1]])
        common = {"prior": prior - prior.max(), "keep": keep, "added_lift": np.array(self.added_lift)}
        common["rig_axes"] = np.array(float(self.rig_axes))
        if not self.pair_roll:
            common |= dict.fromkeys(("pair_roll_gain", "pair_roll_certainty", "pair_roll_prior"), None)
            common["pair_roll_room"] = np.array(1.0)
        if self.swings:
            common["swing_ahead"] = np.concatenate([law.swing_ahead for law in laws])
        else:
            common |= {"swing": None, "swing_ahead": None, "swing_keep": np.array(0.0)}
        common["by_size"] = np.array(self.by_size) if self.by_size else None
        common["held_room"] = np.array(laws[0].held_room if self.held_room else 0.0)
        return laws[0]._replace(**numbers, **common)

    def of_rigs(self, config: Config, rigs: RigTable) -> MultiModelLqg:
        """The numbers of the law of every rig, stacked where they differ, for `of_rig`."""
        lags = rigs.numbers.rotor_lag.mean(axis=1) + self.delay
        loops = zip(rigs.frequency[:, 0].tolist(), lags.tolist(), rigs.damping.tolist(), strict=True)
        laws = [self._replace(models=((loop, lag),), damping=(damping,)).law(config) for loop, lag, damping in loops]
        return laws[0]._replace(**{name: np.stack([getattr(law, name) for law in laws]) for name in OF_MODELS})


LIFT_TOLD = Case("12 pairs, lift told", MODELS, TUNING.torque_walk, position=TUNING.position, added_lift=1.0)
RIG_AXES = LIFT_TOLD._replace(name="about the rig's axes", pair_roll=True, rig_axes=True)
HELD = RIG_AXES._replace(name="room for what is held", held_room=True)
AS_IT_IS = HELD._replace(name="as it is", swings=True)
FIRMER, ADDED = ((1.0, 1.0), (1.2, 1.1), (1.35, 1.17), (1.5, 1.25)), (1.0, 0.8, 0.6, 0.45)
OF_MODELS = ("axis", "axis_gain", "certainty", "tilt", "stiffness", "damping")
CASES = {
    "first": [
        *(Case("4 loops, one lag", FOUR, walk, score) for walk, score in ((20.0, 4.0), (300.0, SCORE_TIME))),
        *(Case("10 pairs", TEN, walk) for walk in (5.0, 20.0, 60.0, 400.0)),
        Case("8 pairs", EIGHT),
        *(Case("13 pairs", THIRTEEN, score_time=score) for score in (2.0, SCORE_TIME, 16.0)),
        Case("9 pairs"),
    ],
    "later": [
        Case("9 pairs"),
        *(Case("9 pairs", torque_walk=walk) for walk in (1000.0, 3000.0)),
        *(Case("9 pairs", position=position) for position in (0.15, 0.3)),
        *(Case("9 pairs", velocity=velocity) for velocity in (0.5, 0.8)),
        *(Case("9 pairs", torque_walk=1000.0, position=position) for position in (0.17, 0.15)),
        Case("7 pairs, two dampings", NINE[:3] + NINE[4:6] + NINE[7:], damping=TWO_DAMPINGS),
    ],
    "delay": [
        Case("9 pairs"),
        Case("9 pairs, 25 ms later", later(0.025), 1000.0, position=0.17),
        *(Case("12 pairs", MODELS, walk, position=position) for walk, position in ((1000.0, 0.17), (500.0, 0.2))),
        LIFT_TOLD,
    ],
    "axes": [LIFT_TOLD, LIFT_TOLD._replace(name="a pair's own roll", pair_roll=True), RIG_AXES],
    "swings": [RIG_AXES, HELD, AS_IT_IS],
    "sizes": [
        *(
            AS_IT_IS._replace(name=f"firmer {firm[0]}, added {part}", by_size=((*firm, part, part),))
            for part in ADDED
            for firm in FIRMER
        ),
    ],
    "told": [
        *(Case("9 pairs", torque_walk=walk, position=position) for walk, position in ((300.0, 0.2), (1000.0, 0.17))),
        *(Case("the rig's own loop", delay=delay) for delay in (0.0, 0.025)),
        *(Case("the rig's own loop", torque_walk=1000.0, position=0.17, delay=delay) for delay in (0.0, 0.025)),
    ],
}


class Variant(AnyRigBase):
    """The law with other numbers."""

    def __init__(self, config: Config, law: MultiModelLqg):
        super().__init__(config)
        self._law = law


def of_rig(law: MultiModelLqg, masses: np.ndarray, rig: RigTable) -> MultiModelLqg:
    """Of `law`, made by `Case.of_rigs` of rigs whose objects have these `masses`, the numbers for one `rig` of them."""
    row = jnp.argmin(jnp.abs(jnp.asarray(masses, jnp.float32) - rig.object_mass))
    return law._replace(**{name: jnp.asarray(getattr(law, name), jnp.float32)[row] for name in OF_MODELS})


class ToldBase(Variant):
    """The law that is told each rig's loop and rotors."""

    def __init__(self, config: Config, law: MultiModelLqg, masses: np.ndarray):
        super().__init__(config, law)
        self._masses = masses

    def on(self, rig: RigTable, plant: Plant) -> ToldBase:
        """See `AnyRigBase`."""
        found: Any = super().on(rig, plant)
        found._law = of_rig(self._law, self._masses, rig)
        return found


class UnderNetwork(AnyRigLaw):
    """A policy with another law in place of its own."""

    def __init__(self, policy: Policy, law: MultiModelLqg):
        super().__init__(policy)
        (first, *weights), biases, mean, scale = self._parts
        more = law.shown - self._law.lqg.shown  # the swings are the last that a network sees
        first, mean, scale = (
            part[: len(part) + more]
            if more < 0
            else np.concatenate([part, np.zeros((more, *part.shape[1:]), part.dtype)])
            for part in (first, mean, scale)
        )
        self._parts, self._law = ((first, *weights), biases, mean, scale), self._law._replace(lqg=law)


class ToldLaw(UnderNetwork):
    """A policy whose law is told each rig's loop and rotors."""

    def __init__(self, policy: Policy, law: MultiModelLqg, masses: np.ndarray):
        super().__init__(policy, law)
        self._masses = masses

    def on(self, rig: RigTable, plant: Plant) -> ToldLaw:
        """See `AnyRigLaw`."""
        found: Any = super().on(rig, plant)
        stacked: Any = self._law.lqg
        found._law = self._law._replace(lqg=of_rig(stacked, self._masses, rig))
        return found


def followers(case: Case, config: Config, rigs: RigTable, path: Path | None) -> dict[str, Law]:
    """The law of `case` alone and, if there is a policy at `path`, under its network."""
    policy = load_policy(path, rig_config(config, rigs, 0)) if path else None
    if case.delay is not None:
        told, masses = case.of_rigs(config, rigs), rigs.object_mass
        alone: Law = ToldBase(config, told, masses)
        return {"law alone": alone} | ({policy.name: ToldLaw(policy, told, masses)} if policy else {})
    law = case.law(config)
    return {"law alone": Variant(config, law)} | ({policy.name: UnderNetwork(policy, law)} if policy else {})


def judged(
    size: int, follower: str, case: Case | None, knowing: dict[str, Flown], flown: Flown, rigs: RigTable, config: Config
) -> dict[str, Any]:
    """What `flown` is against the LQGs that know the rigs; printed too."""
    found = judge.row_of(knowing | {"law": flown}, "law", rigs, config.timing.control_period)
    told = ""
    if case:
        told = (
            f"{case.name:22} {case.torque_walk:5g} {case.score_time:4g} s {case.position:5g} m {case.velocity:4g} m/s"
        )
        told += "" if case.delay is None else f" {case.delay:5g} s"
    print(f"{size} {follower:10} {told} " + " ".join(f"{key} {found[key]:.3f}" for key in SHOWN), flush=True)
    return {"drones": size, "follower": follower, **(case._asdict() if case else {}), **found}


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
        told = judge.KNOWING if options.cases == "told" else ()
        rows += [judged(size, name, None, flown, flown[name], rigs, config) for name in told]
        for case in CASES[options.cases]:
            for follower, law in followers(case, config, rigs, options.policy).items():
                flights = fly(config, rigs, law, judge.FLIGHTS)
                rows.append(judged(size, follower, case, flown, flights, rigs, config))
    if options.json:
        settings = {"rigs": options.rigs, "seed": options.seed}
        options.json.write_text(json.dumps({**settings, "rows": rows}, indent=1) + "\n")
    return 0


SHOWN = ("failed", "peak_50", "small", "soon", "met", "sooner")

if __name__ == "__main__":
    sys.exit(cli.run_command(main))
