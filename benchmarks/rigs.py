"""One follower on 1000 rigs that no training sampled, beside controllers that know each rig.

Rigs of 2 to 6 drones in equal numbers, three random flights of 30 s each, the same for everybody; noise, drift and
delay as in training (settings of the preset `universal`). The object's mass stays what it is; with --mass-step it
changes once in a flight, as in training. `lqg` knows the rig's masses, inertia, mounts, loops and rotors; it is the
reference of a rig, by the median of its flights, in settling and in peak apart. A rig is met where the policy's median
settling is at most 1.25 times and its median peak at most 5 mm, times the rig's length over 0.17 m where that is
larger, above the reference's, or where the reference itself has none.

With --seed 77 the rigs are others than those held out: to choose among policies.
"""

from __future__ import annotations

import functools
import math
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from bounds import Bound, limits, numbers
from harness import Row, arguments, say, table, write
from mjxball.baselines.adaptive import Adaptive
from mjxball.baselines.lqg import Lqg
from mjxball.bench.tracks import RIG_LENGTH
from mjxball.config import Config, from_record, preset, replace
from mjxball.control.followers import Controller, Copy
from mjxball.errors import InputError
from mjxball.evaluate.metrics import Metrics
from mjxball.evaluate.policies import flies_any_rig, load_policy
from mjxball.policy import Policy
from mjxball.policy.inference import NetworkController
from mjxball.running import run_command
from mjxball.sim.rigs import HELD_OUT, HELD_OUT_RIGS, RigTable, rig_config, sample_rigs, unpadded
from random_rigs import AnyRigController, fly_random_rigs, rig_controllers
from teams import effort_of

SIZES, FLIGHTS = (2, 3, 4, 5, 6), 3
LATER, MORE = 1.25, 0.005  # settling, peak [m] of a rig of the pair's length
WANTED = {"peak": Bound(MORE), "settling": Bound(relative=LATER - 1)}
KNOWING = ("lqg",)
PAIR_LOAD = 0.2  # [kg]
SHARES = ("failed", "unsettled", "crashed_alone", "soon", "small", "met", "sooner")

Made = tuple[str, Callable[[Config, RigTable], Controller | list[Controller]]]


def followers(paths: Sequence[Path]) -> list[Made]:
    """(name, what makes its controller for rigs of one size), the LQG that knows each rig first."""
    return [
        ("lqg", lambda config, rigs: rig_controllers(config, rigs, Lqg)),
        ("copy", lambda config, rigs: Copy(config)),
        ("adaptive-mass", lambda config, rigs: rig_controllers(config, rigs, _adaptive)),
        *((path.stem, functools.partial(network, path)) for path in paths),
    ]


def network(path: Path, config: Config, rigs: RigTable) -> Controller:
    """A policy for any rig, or one for a single plant, which takes every rig for its own."""
    policy = Policy.load(path)
    if flies_any_rig(policy):
        return AnyRigController(load_policy(path, rig_config(config, rigs, 0)))
    own, size = from_record(policy.metadata["config"]), int(rigs.size[0])
    if own.plant.count != size:
        raise InputError(f"{path} was made for {own.plant.count} drones, not {size}; say --sizes {own.plant.count}")
    return NetworkController(load_policy(path, own))


def _adaptive(config: Config) -> Controller:
    """With mass adaptation, and limits of its estimates that grow with the rig as they are for the pair."""
    controller, plant = Adaptive(config, adapts_mass=True), config.plant
    weight = plant.object_mass / PAIR_LOAD
    length = max(math.hypot(*drone.mount) for drone in plant.drones) / RIG_LENGTH
    controller._estimate_limits = tuple(limit * max(1.0, weight * length) for limit in controller._estimate_limits)
    controller._mass_limit *= max(1.0, weight)
    return controller


def compare(config: Config, options: Any) -> dict[str, Any]:
    """Every follower on held-out rigs of all sizes, and the shares of rigs that are met."""
    rows, whole = list[Row](), dict[str, list[Row]]()
    for size in options.sizes:
        sampled = sample_rigs(config, size, options.rigs, options.seed)
        rigs = unpadded(sampled.rigs, size)
        flown: dict[str, list[list[Metrics]]] = {}
        for name, make in followers(options.policies):
            begun = time.perf_counter()
            flown[name] = fly_random_rigs(config, rigs, make(config, rigs), FLIGHTS)
            seconds = round(time.perf_counter() - begun, 1)
            row = {"drones": size, "follower": name, **row_of(flown, name, rigs)}
            whole.setdefault(name, []).append(row)
            rows.append({**row, "seconds": seconds})
            say(rows[-1], ".3g")
        rejected = {"drawn": sampled.candidates, "unstable": sampled.unstable, "untrimmed": sampled.untrimmed}
        rows.append({"drones": size, "rigs": options.rigs, **rejected})
    shares = {
        name: {key: float(np.mean([row[key] for row in parts])) for key in SHARES if key in parts[0]}
        for name, parts in whole.items()
    }
    table([{"follower": name, **own} for name, own in shares.items()], ("follower", *SHARES))
    return {"rows": rows, "all": shares}


def row_of(flown: dict[str, list[list[Metrics]]], name: str, rigs: RigTable) -> Row:
    """Shares of failed flights, medians over rigs, and the shares of rigs that are met."""
    medians = {who: np.median([[numbers(one) for one in own] for own in flown[who]], axis=1) for who in flown}
    peak, settling, _ = medians[name].T
    row = {
        "failed": float(_failed(flown[name]).mean()),
        "unsettled": float(np.isinf(settling).mean()),
        **{f"settling_{q}": _quantile(settling, q) for q in (50, 90)},
        **{f"peak_{q}": _quantile(peak, q) for q in (50, 90)},
        **effort_of([one for own in flown[name] for one in own]),
    }
    if not set(KNOWING) <= flown.keys():
        return row
    smallest, soonest, _ = np.min([medians[one] for one in KNOWING], axis=0).T
    length = np.maximum(rigs.length / RIG_LENGTH, 1.0)
    most = limits({"peak": smallest, "settling": soonest}, WANTED, length)
    small, soon = peak <= most["peak"], settling <= most["settling"]
    alone = _failed(flown[name]) & ~np.all([_failed(flown[one]) for one in KNOWING], axis=0)
    return {
        **row,
        "crashed_alone": float(alone.mean()),
        "crashed_alone_flights": int(alone.sum()),
        "soon": float(soon.mean()),
        "small": float(small.mean()),
        "met": float((soon & small).mean()),
        "sooner": float((settling < soonest).mean()),
    }


def _failed(flown: list[list[Metrics]]) -> np.ndarray:
    return np.array([[one.failed for one in own] for own in flown])


def _quantile(values: np.ndarray, share: int) -> float | None:
    """None if it is beyond what was reached."""
    found = float(np.quantile(values, share / 100, method="higher"))
    return found if math.isfinite(found) else None


def main(given: Sequence[str] | None = None) -> int:
    """Fly, print, write."""
    parser = arguments(__file__, __doc__)
    parser.add_argument("policies", nargs="*", type=Path, metavar="POLICY.npz")
    parser.add_argument("--rigs", type=int, default=HELD_OUT_RIGS, metavar="N", help="of each number of drones (200)")
    parser.add_argument("--seed", type=int, default=HELD_OUT, help="of other rigs, to choose policies by")
    parser.add_argument("--sizes", type=int, nargs="+", default=list(SIZES), metavar="N", help="numbers of drones")
    parser.add_argument("--mass-step", action="store_true", help="a change of the mass in every flight, as in training")
    options = parser.parse_args(given)
    config = preset("universal")
    write(options.json, compare(config if options.mass_step else replace(config, "rigs.mass_step", 0.0), options))
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
