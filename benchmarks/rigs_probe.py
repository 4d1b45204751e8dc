"""What a follower knows of its rig: linear probes of its memory.

    python benchmarks/rigs_probe.py policies/universal.npz --json benchmarks/results/rigs_probe.json

Of a policy for any rig 300 held-out rigs of two, three and four drones, two flights each, without a step of the mass;
of another one 600 flights drawn as in its training. After 0.5, 1, 2 and 8 s a ridge regression from the first
follower's memory, of a recurrent one the state of its GRU, to what nobody tells it, in its mount frame: the tilt that
all drones would have to command to hold the load's moment m_o c, along and across its mount; the share of the weight
that all drones at hover do not lift, and of that what is due to the believed mass; the followers' mean thrust gain; the
delay; the logarithm of the loops' natural frequency. Fitted to every other rig or flight, R^2 on the rest; 0: it knows
the mean, null: it is the same in all flights.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjxball import cli
from mjxball import config as configs
from mjxball.config import Config, preset, replace
from mjxball.control import rotations
from mjxball.control.observation import OBSERVATION_SIZE, mount_angles
from mjxball.env import PipelineState, TransportEnv
from mjxball.evaluate.policies import load_policy
from mjxball.evaluate.rigs import AnyRigLaw
from mjxball.physics.motion import make_prescribed
from mjxball.policy import Policy
from mjxball.policy.policy import NetworkLaw
from mjxball.policy.team import is_for_any
from mjxball.sim.rigs import RigTable, held_out, rig_config, whole

SIZES, RIGS, FLIGHTS, TIMES, RIDGES = (2, 3, 4), 100, 2, (0.5, 1.0, 2.0, 8.0), (1e-3, 1e-2, 0.1, 1.0, 10.0)
TRUTHS = ("moment along", "moment across", "lift", "mass error", "thrust gain", "delay", "loop frequency")


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly, regress, print, write."""
    parser = cli.make_parser("python benchmarks/rigs_probe.py", __doc__.split("\n\n")[0])
    parser.add_argument("policy", type=Path, metavar="POLICY.npz")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args(arguments)
    if is_for_any(Policy.load(options.policy).card):
        config = replace(preset("universal"), "rigs.mass_step", 0.0)
        flown = [_of_rigs(config, held_out(config, size).rows(slice(RIGS)), options.policy) for size in SIZES]
    else:
        flown = [_of_flights(options.policy)]
    rows = []
    for number, time in enumerate(TIMES):
        memory = np.concatenate([one[0][..., number, :] for one in flown])
        truth = np.concatenate([one[1][..., number, :] for one in flown])
        found = _explained(memory, truth)
        known = {name: None if np.isnan(r2) else round(float(r2), 2) for name, r2 in zip(TRUTHS, found, strict=True)}
        rows.append({"time": time, **known})
        print(json.dumps(rows[-1]))
    if options.json:
        options.json.write_text(json.dumps({"rows": rows}, indent=1) + "\n")
    return 0


def _explained(memory: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """R^2 (t,) of every truth (R, K, t) by the memory (R, K, m) on every other rig.

    Each with the ridge that explains most where half of the rigs that are fitted to are left out.
    """
    parts = memory[::2], truth[::2]
    inner = np.array([_regressed(*(part[k::2] for part in parts for k in (0, 1)), ridge) for ridge in RIDGES])
    found = np.array([_regressed(memory[::2], memory[1::2], truth[::2], truth[1::2], ridge) for ridge in RIDGES])
    return found[np.argmax(np.nan_to_num(inner), axis=0), np.arange(truth.shape[-1])]


def _regressed(
    memory: np.ndarray, other_memory: np.ndarray, truth: np.ndarray, other_truth: np.ndarray, ridge: float
) -> np.ndarray:
    """R^2 (t,) on the others; NaN where the truth is the same in all flights."""
    inputs, wanted = (
        [x.reshape(-1, x.shape[-1]) for x in pair] for pair in ((memory, other_memory), (truth, other_truth))
    )
    middle, spread, mean = inputs[0].mean(axis=0), inputs[0].std(axis=0) + 1e-6, wanted[0].mean(axis=0)
    a, b = (np.clip((x - middle) / spread, -5, 5) for x in inputs)
    weights = np.linalg.solve(a.T @ a + ridge * len(a) * np.eye(a.shape[1]), a.T @ (wanted[0] - mean))
    left = ((wanted[1] - mean - b @ weights) ** 2).mean(axis=0)
    return 1 - left / np.where(wanted[1].std(axis=0) > 1e-6, wanted[1].var(axis=0), np.nan)


def _of_rigs(config: Config, rigs: RigTable, path: Path) -> tuple[np.ndarray, np.ndarray]:
    """(what the first follower's network sees of its memory (R, K, T, s), truths (R, K, T, t)) at `TIMES`."""
    size = int(rigs.size[0])
    alone = rig_config(config, rigs, 0)
    every = AnyRigLaw(load_policy(path, alone))
    own = dataclasses.replace(alone, attitude=config.attitude, rigs=dataclasses.replace(config.rigs, number=1))
    env, cg = TransportEnv(own, "newton-euler"), make_prescribed(own)

    def flight(rig: RigTable, key: Any) -> tuple[Any, Any]:
        numbers = whole(rig.numbers, own.plant.gravity)
        angle = jnp.atleast_1d(jnp.asarray(mount_angles(own.plant, numbers.mounts)))[0]
        weight = numbers.drone_mass.sum() + numbers.carrier_mass + rig.object_mass

        def truth(world: PipelineState) -> Any:
            place = cg(world.loop.plant.time, world.load).offset
            held = jnp.stack([place[0] / numbers.gains.kp[1], place[1] / numbers.gains.kp[0], 0.0 * place[0]])
            tilt = own.plant.gravity * rig.object_mass / size * rotations.turned_about_z(held, -angle)[:2]
            lift = 1.0 - (rig.thrust * (numbers.known_mass + numbers.share * rig.believed_mass)).sum() / weight
            wrong = (rig.object_mass - rig.believed_mass) / weight
            delay = world.disturbances.delay.astype(jnp.float32)
            return jnp.stack([*tilt, lift, wrong, rig.thrust[1:].mean(), delay, jnp.log(rig.frequency[1])])

        return _flown(env, every.on(rig, own.plant), env.reset(key, 1.0, None, rig), truth)

    keys = jax.random.split(jax.random.key(4), (rigs.total, FLIGHTS))
    table = jax.tree.map(lambda part: jnp.asarray(part, jnp.float32), rigs)
    fly = jax.jit(jax.vmap(lambda rig, own_keys: jax.vmap(lambda key: flight(rig, key))(own_keys)))
    memory, truth = fly(table, keys)
    return np.asarray(memory), np.asarray(truth)


def _of_flights(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """The same of flights of a pair that are drawn as its training draws them (K, 1, T, .)."""
    config = configs.from_record(Policy.load(path).card["config"])
    law, env, cg = NetworkLaw(load_policy(path, config)), TransportEnv(config, "newton-euler"), make_prescribed(config)
    nothing = jnp.zeros(())

    def truth(world: PipelineState) -> Any:
        load, place = world.load, cg(world.loop.plant.time, world.load).offset
        disturbed, thrust = world.disturbances, jnp.ones(2) if load.thrust_scale is None else load.thrust_scale
        wrong = load.object_mass - load.believed_mass
        delay = disturbed.delay.astype(jnp.float32) if disturbed else nothing
        return jnp.stack(
            [load.object_mass * jnp.atleast_1d(place)[0], nothing, wrong, wrong, thrust[1], delay, nothing]
        )

    keys = jax.random.split(jax.random.key(4), len(SIZES) * RIGS * FLIGHTS)
    memory, found = jax.jit(jax.vmap(lambda key: _flown(env, law, env.reset(key), truth)))(keys)
    return np.asarray(memory)[:, None], np.asarray(found)[:, None]


def _flown(env: TransportEnv, law: NetworkLaw, state: Any, truth: Callable[[PipelineState], Any]) -> tuple[Any, Any]:
    """(what the first follower's GRU remembers (T, s), `truth` (T, t)) at `TIMES`."""
    ends = np.array([round(time / env.dt) for time in TIMES])

    def step(carry: Any, _: None) -> Any:
        state, memory = carry
        observation = state.obs[..., :OBSERVATION_SIZE]
        seen = law.hidden(memory)
        memory, command = law.step(memory, observation, None)
        state = env.step_with_command(state, command)
        return (state, memory), (seen.reshape(-1, seen.shape[-1])[0], truth(state.pipeline_state))

    start = state, law.start(state.obs[..., :OBSERVATION_SIZE])
    return jax.tree.map(lambda part: part[ends - 1], jax.lax.scan(step, start, None, length=int(ends[-1]))[1])


if __name__ == "__main__":
    sys.exit(cli.run_command(main))
