"""What a follower for any rig knows of it: linear probes of its memory.

    python benchmarks/rigs_probe.py policies/universal.npz --json benchmarks/results/rigs_probe.json

300 held-out rigs of two, three and four drones, two flights each, without a step of the mass. After 0.5, 1, 2 and 8 s
a ridge regression from the first follower's memory, in its mount frame, to what nobody tells it: the tilt that all
drones would have to command to hold the load's moment m_o c, along and across its mount; the share of the weight that
all drones at hover do not lift, and of that what is due to the believed mass; the followers' mean thrust gain; the
delay; the logarithm of the loops' natural frequency. Fitted to every other rig, R^2 on the rest; 0: it knows the
mean.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjxball import cli
from mjxball.config import Config, preset, replace
from mjxball.control import rotations
from mjxball.control.observation import mount_angles
from mjxball.env import TransportEnv
from mjxball.evaluate.policies import load_policy
from mjxball.evaluate.rigs import AnyRigLaw
from mjxball.physics.motion import make_prescribed
from mjxball.sim.rigs import RigTable, held_out, rig_config, whole

SIZES, RIGS, FLIGHTS, TIMES, RIDGE = (2, 3, 4), 100, 2, (0.5, 1.0, 2.0, 8.0), 1e-2
TRUTHS = ("moment along", "moment across", "lift", "mass error", "thrust gain", "delay", "loop frequency")


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly, regress, print, write."""
    parser = cli.make_parser("python benchmarks/rigs_probe.py", __doc__.split("\n\n")[0])
    parser.add_argument("policy", type=Path, metavar="POLICY.npz")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args(arguments)
    config = replace(preset("universal"), "rigs.mass_step", 0.0)
    flown = [_memories(config, held_out(config, size).rows(slice(RIGS)), options.policy) for size in SIZES]
    rows = []
    for number, time in enumerate(TIMES):
        memory = np.concatenate([one[0][..., number, :] for one in flown])
        truth = np.concatenate([one[1][..., number, :] for one in flown])
        found = _explained(memory, truth)
        rows.append({"time": time, **{name: round(float(r2), 2) for name, r2 in zip(TRUTHS, found, strict=True)}})
        print(json.dumps(rows[-1]))
    if options.json:
        options.json.write_text(json.dumps({"rows": rows}, indent=1) + "\n")
    return 0


def _explained(memory: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """R^2 (t,) of every truth (R, K, t) by the memory (R, K, m) on every other rig."""
    fit, rest = slice(0, None, 2), slice(1, None, 2)
    inputs, wanted = ([part[which].reshape(-1, part.shape[-1]) for which in (fit, rest)] for part in (memory, truth))
    middle, spread = inputs[0].mean(axis=0), inputs[0].std(axis=0) + 1e-6
    a, b = (np.column_stack([np.clip((x - middle) / spread, -5, 5), np.ones(len(x))]) for x in inputs)
    weights = np.linalg.solve(a.T @ a + RIDGE * len(a) * np.eye(a.shape[1]), a.T @ wanted[0])
    left = ((wanted[1] - b @ weights) ** 2).mean(axis=0)
    return 1 - left / wanted[1].var(axis=0)


def _memories(config: Config, rigs: RigTable, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """(what the first follower's network sees of its memory (R, K, T, s), truths (R, K, T, t)) at `TIMES`."""
    size = int(rigs.size[0])
    alone = rig_config(config, rigs, 0)
    every = AnyRigLaw(load_policy(path, alone))
    own = dataclasses.replace(alone, attitude=config.attitude, rigs=dataclasses.replace(config.rigs, number=1))
    env, cg = TransportEnv(own, "newton-euler"), make_prescribed(own)
    ends = np.array([round(time / env.dt) for time in TIMES])

    def first(value: Any) -> Any:
        return value if size == 2 else value[0]

    def flight(rig: RigTable, key: Any) -> tuple[Any, Any]:
        state = env.reset(key, 1.0, None, rig)
        numbers = whole(rig.numbers, own.plant.gravity)
        angle = first(jnp.asarray(mount_angles(own.plant, numbers.mounts)))
        law = every.on(rig, own.plant)

        def step(carry: Any, _: None) -> Any:
            state, memory = carry
            seen = every.shown(state.obs[..., :18], memory)
            memory, command = law.step(memory, state.obs[..., :18], None)
            state = env.step_with_command(state, command)
            world = state.pipeline_state
            place = cg(world.loop.plant.time, world.load).offset
            held = jnp.stack([place[0] / numbers.gains.kp[1], place[1] / numbers.gains.kp[0], 0.0 * place[0]])
            tilt = own.plant.gravity * rig.object_mass / size * rotations.turned_about_z(held, -angle)[:2]
            weight = numbers.drone_mass.sum() + numbers.carrier_mass + rig.object_mass
            lift = 1.0 - (rig.thrust * (numbers.known_mass + numbers.share * rig.believed_mass)).sum() / weight
            wrong = (rig.object_mass - rig.believed_mass) / weight
            delay = world.disturbances.delay.astype(jnp.float32)
            known = [
                tilt,
                jnp.stack([lift, wrong]),
                rig.thrust[1:].mean()[None],
                delay[None],
                jnp.log(rig.frequency[1])[None],
            ]
            return (state, memory), (first(seen), jnp.concatenate(known))

        start = state, law.start(state.obs[..., :18])
        return jax.tree.map(lambda part: part[ends - 1], jax.lax.scan(step, start, None, length=int(ends[-1]))[1])

    keys = jax.random.split(jax.random.key(4), (rigs.total, FLIGHTS))
    table = jax.tree.map(lambda part: jnp.asarray(part, jnp.float32), rigs)
    fly = jax.jit(jax.vmap(lambda rig, own_keys: jax.vmap(lambda key: flight(rig, key))(own_keys)))
    memory, truth = fly(table, keys)
    return np.asarray(memory), np.asarray(truth)


if __name__ == "__main__":
    sys.exit(cli.run_command(main))
