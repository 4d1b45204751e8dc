"""How much better a follower is that was trained for one rig alone: `universal` goes on training on each of some rigs.

    python benchmarks/rigs_own.py policies/universal.npz --json FILE     # 15 minutes on one core
    python benchmarks/rigs_own.py policies/universal.npz --sizes 2 3 4 --rigs 100 --worlds 24 --steps 500     # a GPU's

The first held-out rigs of each size. Every rig has weights of its own, which begin as the policy's and take steps of
Adam by first-order gradients (`algorithms.gradient`) on flights of that rig alone, paid as the policy's card says; all
rigs of a size are one program. They are judged as in `benchmarks/rigs.py`, on flights that training does not fly; with
--after-steps by what follows a step of the mass and of the CG in flight as well.
"""

from __future__ import annotations

import dataclasses
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import rigs as judge
from mjxball import cli
from mjxball.algorithms.base import Phase
from mjxball.algorithms.gradient import FirstOrderGradient
from mjxball.config import Config, from_record, preset, replace
from mjxball.env import TransportEnv
from mjxball.evaluate.rigs import AnyRigLaw, fly
from mjxball.policy import Policy, PolicyFile, load_file
from mjxball.policy.export import with_network
from mjxball.sim.rigs import RigTable, held_out, rig_config
from mjxball.train.compilation import compiler_options
from mjxball.train.program import MATMUL_PRECISION, Environments

LEARN = Phase(np.asarray(False), np.asarray(False))
SEED = 1  # of the flights in training; those that are judged have 0


class OneRigEnv(TransportEnv):
    """Worlds that all have one rig, whose numbers may be traced."""

    def __init__(self, config: Config, rig: RigTable):
        super().__init__(config, "newton-euler")
        self._rig = rig

    def reset(self, rng: Any, difficulty: Any = 1.0, number: Any = None, rig: Any = None) -> Any:
        """See `TransportEnv.reset`."""
        return super().reset(rng, difficulty, None, self._rig)


class OwnWeights(AnyRigLaw):
    """A policy whose network alone differs from rig to rig, for `evaluate.rigs.stacked`."""

    def __init__(self, policy: Policy):
        plain = AnyRigLaw(policy)
        self.name, self._network, self._geometry = plain.name, plain._network, None
        self._shared = lambda: plain._law

    @property
    def _law(self) -> Any:  # type: ignore[override]
        return self._shared()


def train(config: Config, rigs: RigTable, policy: PolicyFile, options: Any) -> list[PolicyFile]:
    """`policy` after `options.steps` gradients on flights of each of `rigs`, which are of one size."""
    size, trained = int(rigs.size[0]), from_record(policy.card["config"])
    learning = dataclasses.replace(
        config.gradient,
        gradient_decay=trained.gradient.gradient_decay,
        num_envs=options.worlds * (size - 1),
        gradient_steps=options.steps,
        learning_rate=options.rate,
        policy_layers=tuple(len(bias) for bias in policy.biases[:-1]),
    )
    one_rig = dataclasses.replace(config.rigs, number=1)
    own = dataclasses.replace(
        rig_config(config, rigs, 0), attitude=config.attitude, rigs=one_rig, reward=trained.reward, gradient=learning
    )
    tables = jax.tree.map(lambda part: jnp.asarray(part, jnp.float32), rigs)

    def parts(rig: RigTable) -> tuple[Environments, FirstOrderGradient]:
        environments = Environments(OneRigEnv(own, rig), learning.num_envs)
        return environments, FirstOrderGradient(own, environments)

    def begin(rig: RigTable, key: Any) -> Any:
        return parts(rig)[0].reset(key)

    def gradient(rig: RigTable, state: Any, worlds: Any, key: Any, progress: Any) -> Any:
        environments, algorithm = parts(rig)
        state, envs = algorithm.collect(state, environments.begin(worlds, 1.0), [key], LEARN)
        state, _ = algorithm.update(state, [], progress, LEARN)
        return state, envs.states

    first = jax.tree.map(lambda part: part[0], rigs)
    blank = parts(first)[1].init(jax.random.PRNGKey(0))
    start = parts(first)[1].start_from(jax.tree.map(np.asarray, blank), policy)
    state = jax.tree.map(lambda leaf: jnp.stack([jnp.asarray(leaf)] * rigs.total), start)
    key = jax.random.PRNGKey(SEED)
    with jax.default_matmul_precision(MATMUL_PRECISION):
        worlds = jax.jit(jax.vmap(begin))(tables, jax.random.split(key, rigs.total))
        mapped = jax.vmap(gradient, in_axes=(0, 0, 0, 0, None))
        keys = jax.random.split(key, rigs.total)
        lowered = jax.jit(mapped).lower(tables, state, worlds, keys, np.float32(0))
        step = lowered.compile(compiler_options(FirstOrderGradient, rigs.total))
        for count in range(options.steps):
            key, own_key = jax.random.split(key)
            state, worlds = step(
                tables, state, worlds, jax.random.split(own_key, rigs.total), np.float32(count / options.steps)
            )
            if count % 25 == 24:
                print(f"{size} drones: {count + 1} gradients, loss {np.median(state.loss):.3f}", file=sys.stderr)
    algorithm, known = parts(first)[1], jax.tree.map(np.asarray, state)
    one = lambda row: jax.tree.map(lambda leaf: leaf[row], known)  # noqa: E731
    return [with_network(policy, algorithm.policy(one(row))) for row in range(rigs.total)]


def main(arguments: Sequence[str] | None = None) -> int:
    """Train, fly, print, write."""
    parser = cli.make_parser("python benchmarks/rigs_own.py", __doc__.split("\n\n")[0])
    parser.add_argument("policy", type=Path, metavar="POLICY.npz")
    parser.add_argument("--sizes", type=int, nargs="+", default=[2, 4], metavar="N", help="numbers of drones")
    parser.add_argument("--rigs", type=int, default=10, metavar="R", help="of each size (default 10)")
    parser.add_argument("--worlds", type=int, default=12, metavar="W", help="of each rig in training (default 12)")
    parser.add_argument("--steps", type=int, default=100, metavar="S", help="gradients (default 100)")
    parser.add_argument("--rate", type=float, default=2e-3, help="Adam's rate at the start (default 2e-3)")
    parser.add_argument("--after-steps", action="store_true", help="fly steps of the mass and of the CG too")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args(arguments)
    config, contents, rows = replace(preset("universal"), "rigs.mass_step", 0.0), load_file(options.policy), []
    period, stepped = config.timing.control_period, []
    for size in options.sizes:
        rigs = held_out(config, size).rows(slice(options.rigs))
        begun, known = time.perf_counter(), (*judge.KNOWING, options.policy.stem)
        laws = {name: make(config, rigs) for name, make in judge.followers([options.policy]) if name in known}
        laws["trained for it alone"] = [
            OwnWeights(Policy(own, name="own")) for own in train(config, rigs, contents, options)
        ]
        flown = {name: fly(config, rigs, law, judge.FLIGHTS) for name, law in laws.items()}
        for name in flown:
            found = judge.row_of(flown, name, rigs, period)
            rows.append({"drones": size, "rigs": options.rigs, "follower": name, **found})
            print(json.dumps(rows[-1]))
        for kind in judge.CHANGES if options.after_steps else ():
            for name, law in laws.items():
                found = judge.after_step(judge.fly_step(kind, config, rigs, law), period)
                stepped.append({"step": kind, "drones": size, "rigs": options.rigs, "follower": name, **found})
                print(json.dumps(stepped[-1]))
        print(f"{size} drones: {time.perf_counter() - begun:.0f} s", file=sys.stderr)
    if options.json:
        found = {"steps": options.steps, "worlds": options.worlds, "rate": options.rate, "rows": rows}
        found |= {"after_steps": stepped} if stepped else {}
        options.json.write_text(json.dumps(found, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(cli.run_command(main))
