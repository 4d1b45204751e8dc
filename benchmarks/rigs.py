"""One follower on 1000 rigs that no training drew, beside laws that are told each rig.

    python benchmarks/rigs.py policies/universal.npz --json benchmarks/results/rigs.json
    python benchmarks/rigs.py policies/universal.npz --steps --sizes 2 4 --figure steps.png

Rigs of 2 to 6 drones in equal numbers, three random flights of 30 s each, the same for everybody; noise, drift and
delay as in training (settings of the preset `universal`). The object's mass stays what it is; with --mass-step it
changes once in a flight, as in training, and the LQGs are told at once. `lqg-known-rig` and `lqg-slow-known-rig` know
the rig: masses, inertia, mounts, loops, rotors, what each drone gives of its thrust; they estimate the load's torque
alone.
The better of both is the reference of a rig, by the median of its flights, in settling and in peak apart. A rig is met
where the policy's median settling is at most 1.25 times and its median peak at most 5 mm, times the rig's length over
0.17 m where that is larger, above the reference's, or where the reference itself has none.

The two LQGs are held to the same bar; what is met beside either of them alone stands in fields of its own.

With --seed 77 the rigs are others than those held out: to choose among policies.

With --beyond: outside one range of training at a time, on rigs that are drawn like the others.

With --steps: at 15 s the object's mass changes by 30 %, or the CG jumps to where it would be half a period later.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjxball import cli
from mjxball.baselines.adaptive import Adaptive
from mjxball.baselines.lqg import KnownRigLqg, SlowKnownRigLqg
from mjxball.config import Config, from_record, preset, replace
from mjxball.control.followers import Copy, Law
from mjxball.errors import InputError
from mjxball.evaluate.policies import flies_any_rig, load_policy
from mjxball.evaluate.rigs import AnyRigLaw, Flown, cg_jumps, fly, mass_changes, rig_laws
from mjxball.policy import Policy
from mjxball.policy.policy import NetworkLaw
from mjxball.sim.rigs import (
    HELD_OUT,
    HELD_OUT_RIGS,
    RigTable,
    draw_rigs,
    loop_damping,
    rig_config,
    unpadded,
)

SIZES, FLIGHTS = (2, 3, 4, 5, 6), 3
LATER, MORE, LENGTH = 1.25, 0.005, 0.17  # the bar: settling, peak [m], of a rig of that length [m]
KNOWING = ("lqg-known-rig", "lqg-slow-known-rig")
PAIR_LOAD = 0.2  # [kg]
STEP, BACK, AFTER = 15.0, 1.5, 5.0  # [s] when the load changes, within which it is balanced again, what is flown then
BEYOND = {
    "rigs.drone_mass": (3.0, 6.0),
    "rigs.object_share": (0.6, 0.8),
    "rigs.thrust_to_weight": (1.4, 1.6),
    "rigs.rotor_lag": (0.15, 0.2),
    "rigs.loop_frequency": (3.0, 4.0),
    "rigs.loop_damping": (0.4, 0.5),
    "rigs.thrust_scale": (0.7, 0.8),
    "scenario.cg_speed": (6.0, 8.0),
    "scenario.delay": (0.06, 0.08),
    "scenario.noise": (1.0, 2.0),
}
MASS_STEP = 0.3  # largest, of the object's mass
SHARES = (
    *("failed", "unsettled", "crashed_alone", "soon", "small", "met", "sooner"),
    *(f"{part}_{one}" for one in KNOWING for part in ("met_beside", "sooner_than")),
)

Made = tuple[str, Callable[[Config, RigTable], Law | list[Law]]]


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly, print, write."""
    parser = cli.make_parser("python benchmarks/rigs.py", __doc__.split("\n\n")[0])
    parser.add_argument("policies", nargs="*", type=Path, metavar="POLICY.npz")
    parser.add_argument(
        "--rigs", type=int, default=HELD_OUT_RIGS, metavar="N", help="of each number of drones (default 200)"
    )
    parser.add_argument("--seed", type=int, default=HELD_OUT, help="of other rigs, to choose policies by")
    parser.add_argument("--sizes", type=int, nargs="+", default=list(SIZES), metavar="N", help="numbers of drones")
    parser.add_argument("--mass-step", action="store_true", help="a change of the mass in every flight, as in training")
    parser.add_argument("--beyond", action="store_true", help="rigs just outside one range at a time instead")
    parser.add_argument("--steps", action="store_true", help="a step of the mass or the CG in flight")
    parser.add_argument("--figure", type=Path, metavar="FILE.png", help="error against time since the step")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args(arguments)
    if options.figure and not options.steps:
        raise InputError("--figure is of --steps")
    if options.beyond and options.steps:
        raise InputError("--beyond and --steps are two benchmarks; run one after the other")
    if options.mass_step and options.steps:
        raise InputError("--steps says itself when the mass changes; leave --mass-step out")
    config = preset("universal")
    if not options.mass_step:
        config = replace(config, "rigs.mass_step", 0.0)
    made = steps if options.steps else beyond if options.beyond else compare
    found = made(config, options)
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n")
    return 0


def followers(paths: Sequence[Path]) -> list[Made]:
    """(name, what makes its law for rigs of one size), the two LQGs that know each rig first."""
    return [
        ("lqg-known-rig", lambda config, rigs: rig_laws(config, rigs, KnownRigLqg)),
        ("lqg-slow-known-rig", lambda config, rigs: rig_laws(config, rigs, SlowKnownRigLqg)),
        ("copy", lambda config, rigs: Copy(config)),
        ("adaptive-mass", lambda config, rigs: rig_laws(config, rigs, _adaptive)),
        *((path.stem, functools.partial(network, path)) for path in paths),
    ]


def network(path: Path, config: Config, rigs: RigTable) -> Law:
    """A policy for any rig, or one for a single plant, which takes every rig for its own."""
    policy = Policy.load(path)
    if flies_any_rig(policy):
        return AnyRigLaw(load_policy(path, rig_config(config, rigs, 0)))
    own, size = from_record(policy.card["config"]), int(rigs.size[0])
    if own.plant.count != size:
        raise InputError(f"{path} was made for {own.plant.count} drones, not {size}; say --sizes {own.plant.count}")
    return NetworkLaw(load_policy(path, own))


def _adaptive(config: Config) -> Law:
    """With mass adaptation, and limits of its estimates that grow with the rig as they are for the pair."""
    law, plant = Adaptive(config, adapts_mass=True), config.plant
    weight = plant.object_mass / PAIR_LOAD
    length = max(math.hypot(*drone.mount) for drone in plant.drones) / LENGTH
    law._estimate_limits = tuple(limit * max(1.0, weight * length) for limit in law._estimate_limits)
    law._mass_limit *= max(1.0, weight)
    return law


def compare(config: Config, options: Any) -> dict[str, Any]:
    """Every follower on held-out rigs of all sizes, and the shares of rigs that are met."""
    period, rows, whole = config.timing.control_period, [], {}
    for size in options.sizes:
        drawn = draw_rigs(config, size, options.rigs, options.seed)
        rigs = unpadded(drawn.rigs, size)
        flown: dict[str, Flown] = {}
        for name, make in followers(options.policies):
            begun = time.perf_counter()
            flown[name] = fly(config, rigs, make(config, rigs), FLIGHTS)
            seconds = round(time.perf_counter() - begun, 1)
            for known in judged(name):
                row = {"drones": size, "follower": known, **row_of(flown, known, rigs, period)}
                rows.append({**row, "seconds": seconds})
                whole.setdefault(known, []).append(row)
                print(json.dumps(rows[-1]))
                sys.stdout.flush()
        rejected = {"drawn": drawn.draws, "unstable": drawn.unstable, "untrimmed": drawn.untrimmed}
        rows.append({"drones": size, "rigs": options.rigs, **rejected})
    shares = {
        name: {key: round(float(np.mean([row[key] for row in parts])), 4) for key in SHARES if key in parts[0]}
        for name, parts in whole.items()
    }
    print(json.dumps(shares, indent=1))
    return {"rows": rows, "all": shares}


def rigs_of(config: Config, size: int, options: Any) -> RigTable:
    """The rigs of `size` drones to fly."""
    return unpadded(draw_rigs(config, size, options.rigs, options.seed).rigs, size)


def beyond(config: Config, options: Any) -> dict[str, Any]:
    """The LQGs that know the rig and the policies outside one range at a time."""
    rows = []
    for path, ends in BEYOND.items():
        outside = replace(config, path, ends)
        for size in options.sizes:
            rigs, flown = rigs_of(outside, size, options), {}
            for name, make in followers(options.policies):
                if name not in WORST:
                    flown[name] = fly(outside, rigs, make(outside, rigs), FLIGHTS)
                    for known in judged(name):
                        row = row_of(flown, known, rigs, config.timing.control_period)
                        rows.append({"setting": path, "range": ends, "drones": size, "follower": known, **row})
                        print(json.dumps(rows[-1]))
                        sys.stdout.flush()
    return {"rows": rows}


def judged(name: str) -> Sequence[str]:
    """Whose rows are complete when `name` has flown: those of the two LQGs once both have."""
    return {KNOWING[0]: (), KNOWING[1]: KNOWING}.get(name, (name,))


def row_of(flown: dict[str, Flown], name: str, rigs: RigTable, period: float) -> dict[str, Any]:
    """Shares of failed flights, medians over rigs, and the shares of rigs that are met."""
    settling, peak = (np.median(getattr(flown[name], part)(period), axis=1) for part in ("settling", "peak"))
    row = {
        "failed": float(flown[name].failed.mean()),
        "unsettled": float(np.isinf(settling).mean()),
        **{f"settling_{q}": _quantile(settling, q) for q in (50, 90)},
        **{f"peak_{q}": _quantile(peak, q) for q in (50, 90)},
    }
    effort = flown[name].effort
    if effort is not None:
        row |= {"at_limit": float(effort.at_limit.mean())}
        for part in ("tilt_spread", "lift_spread", "power"):
            of_rig = np.median(getattr(effort, part), axis=1)
            row |= {f"{part}_{q}": _quantile(of_rig, q) for q in (50, 90)}
    if not set(KNOWING) <= flown.keys():
        return row
    knowing = [flown[one] for one in KNOWING]
    theirs = {
        part: np.array([np.median(getattr(one, part)(period), axis=1) for one in knowing])
        for part in ("settling", "peak")
    }
    more = MORE * np.maximum(rigs.length / LENGTH, 1.0)

    def reached(settled: np.ndarray, highest: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return (settling <= LATER * settled) | np.isinf(settled), (peak <= highest + more) | np.isinf(highest)

    best, smallest = (theirs[part].min(axis=0) for part in ("settling", "peak"))
    soon, small = reached(best, smallest)
    alone = flown[name].failed & ~np.all([one.failed for one in knowing], axis=0)
    for one, settled, highest in zip(KNOWING, theirs["settling"], theirs["peak"], strict=True):
        row[f"met_beside_{one}"] = float(np.all(reached(settled, highest), axis=0).mean())
        row[f"sooner_than_{one}"] = float((settling < settled).mean())
    return {
        **row,
        "crashed_alone": float(alone.mean()),
        "crashed_alone_flights": int(alone.sum()),
        "soon": float(soon.mean()),
        "small": float(small.mean()),
        "met": float((soon & small).mean()),
        "sooner": float((settling < best).mean()),
        "met_by_damping": _by_damping(soon & small, rigs),
    }


def _by_damping(met: np.ndarray, rigs: RigTable) -> list[float]:
    """Shares that are met of the fifth of the rigs with the least damped attitude loops, of the next, and so on."""
    lag = rigs.numbers.rotor_lag[:, :1]
    damping = loop_damping(rigs.frequency[:, :2], rigs.damping[:, None], lag).min(axis=-1)
    return [float(met[part].mean()) for part in np.array_split(np.argsort(damping), 5) if len(part)]


def _quantile(values: np.ndarray, share: int) -> float | None:
    """None if it is beyond what was reached."""
    found = float(np.quantile(values, share / 100, method="higher"))
    return found if math.isfinite(found) else None


def steps(config: Config, options: Any) -> dict[str, Any]:
    """Error after a step at 15 s, of the mass and of the CG, see `after_step`."""
    period, rows, curves = config.timing.control_period, [], {}
    for kind in CHANGES:
        for size in options.sizes:
            rigs = rigs_of(config, size, options)
            for name, make in followers(options.policies):
                found = fly_step(kind, config, rigs, make(config, rigs))
                rows.append({"step": kind, "drones": size, "follower": name, **after_step(found, period)})
                print(json.dumps(rows[-1]))
                sys.stdout.flush()
                since = found.error[..., round(STEP / period) - 50 :]
                curves.setdefault((kind, name), []).append(np.where(found.failed[..., None], np.inf, since))
    if options.figure:
        _draw(curves, period, options.figure)
    return {"rows": rows}


def fly_step(kind: str, config: Config, rigs: RigTable, laws: Law | Sequence[Law]) -> Flown:
    """Flights with a step of `kind` at 15 s, and none else."""
    most = MASS_STEP if kind == "mass" else 0.0
    flown = dataclasses.replace(config, rigs=dataclasses.replace(config.rigs, mass_step=most))
    return fly(flown, rigs, laws, FLIGHTS, STEP + AFTER, 1, (STEP, CHANGES[kind]))


def after_step(found: Flown, period: float) -> dict[str, float | None]:
    """Share of flights that fail; shares of the rigs, by the median flight:

    `back`: 1.5 s after the step and for the rest of 5 s not above what it was in the 2 s before by more than 2 % of the
    first error; `within_2_percent`: within 2 % of the first error in that time; `stood`: so in the 2 s before, and
    `stands_again`, of these rigs alone: in both.
    """
    before, after = round(STEP / period), round((STEP + BACK) / period)
    level, calm = 0.02 * found.error[..., :1], found.error[..., before - 100 : before]
    later = found.error[..., after:]

    def most(flights: Any) -> np.ndarray:
        return np.median(flights & ~found.failed, axis=1) > 0

    back = most((later <= level + calm.max(axis=-1, keepdims=True)).all(axis=-1))
    strict = most((later <= level).all(axis=-1))
    stood = most((calm <= level).all(axis=-1))
    return {
        "failed": float(found.failed.mean()),
        "back": float(back.mean()),
        "within_2_percent": float(strict.mean()),
        "stood": float(stood.mean()),
        "stands_again": float(strict[stood].mean()) if stood.any() else None,
    }


CHANGES = {"mass": mass_changes, "CG": cg_jumps}


def _draw(curves: dict[Any, list[np.ndarray]], period: float, path: Path) -> None:
    """Error against time since the step: median and 10 to 90 %, for these LQGs and the policies."""
    from mjxball.plotting import pyplot

    figure, axes = pyplot().subplots(1, len(CHANGES), figsize=(9, 3.6), sharey=True, layout="constrained")
    for kind, place in zip(CHANGES, axes, strict=True):
        for color, (name, parts) in enumerate((n, p) for (k, n), p in curves.items() if k == kind and n not in WORST):
            error = np.concatenate([part.reshape(-1, part.shape[-1]) for part in parts])
            low, middle, high = (1e3 * np.quantile(error, q, axis=0, method="lower") for q in (0.1, 0.5, 0.9))
            since = period * (np.arange(error.shape[-1]) - 50)
            place.plot(since, middle, color=f"C{color}", label=name)
            place.fill_between(since, low, high, color=f"C{color}", alpha=0.15, linewidth=0)
        place.set(
            title=f"step of the {'mass' if kind == 'mass' else 'CG'}", xlabel="time since the step [s]", ylim=(0, 150)
        )
        place.grid(alpha=0.3)
    axes[0].set_ylabel("error of the object [mm]")
    axes[0].legend(frameon=False)
    figure.savefig(path, dpi=120)


WORST = ("copy", "adaptive-mass")  # not of the steps, nor outside of training


if __name__ == "__main__":
    sys.exit(cli.run_command(main))
