"""Whether any commands bring four drones down when one is lost: the others' commands, optimised with full information.

    python benchmarks/descent.py --json benchmarks/results/descent.json
    python benchmarks/descent.py --lost 2 --seconds 5 --blind 0 0.02 0.04 0.06 0.1

`team4` hovers at its goal with the CG at O, one follower's rotors stop, the leader flies its plain PD law, to that goal
or to one that sinks. The commands of the two others, every 0.1 s, and a linear feedback on what each sees are found by
gradients through the closed form (Adam, several random starts at once), so that for the whole flight the assembly sinks
at most 1 m/s and tilts at most 30 degrees. Rotors are those of the plant. What is found exists; what is not may. With
`--blind` the followers hover on for so long after the loss: a follower that is not told sees it one or two steps late.
"""

from __future__ import annotations

import itertools
import json
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from mjxball import cli
from mjxball.cache import enable_compilation_cache
from mjxball.config import Config, preset, replace, with_plant
from mjxball.control import rotations
from mjxball.physics import newton_euler
from mjxball.physics.step import jax_repeat, make_control_step
from mjxball.sim import rollout
from mjxball.sim.closed_loop import ClosedLoop
from mjxball.sim.disturbances import followers_axis, record, sensors_of
from mjxball.sim.scenario import Scenario

Array = Any
SECONDS, SINKING = 10.0, (0.0, 0.5)  # [s], [m/s] of the leader's goal
STARTS, STEPS, KNOT = 8, 400, 5  # random starts, steps of Adam, control steps between two commands that are found
RATE, HORIZON = 0.015, 0.5  # of Adam; [s] that count at first, then more and more
VERTICAL_LIMIT = 12.0  # [m/s2]
FASTEST, STEEPEST = 1.0, 30.0  # [m/s] downwards, [degrees]


def main(arguments: Sequence[str] | None = None) -> int:
    """Optimise, print, write."""
    parser = cli.make_parser("python benchmarks/descent.py", __doc__.split("\n\n")[0])
    parser.add_argument("--steps", type=int, default=STEPS, help="of Adam")
    parser.add_argument("--seconds", type=float, default=SECONDS)
    parser.add_argument("--lost", type=int, nargs="+", choices=(1, 2, 3), default=[1, 2, 3], help="which follower")
    parser.add_argument("--sinking", type=float, nargs="+", default=SINKING, help="of the leader's goal [m/s]")
    parser.add_argument("--blind", type=float, nargs="+", default=[0.0], help="hover on for so long after the loss [s]")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    enable_compilation_cache()
    four = replace(with_plant(preset("paper"), "team4"), "command.vertical_limit", VERTICAL_LIMIT)
    rows = []
    for lost, sinking, blind in itertools.product(options.lost, options.sinking, options.blind):
        course = Course(four, lost, sinking, options.seconds, blind)
        rows.append({"lost": lost, "goal_sinks": sinking, "blind": blind, **best(course, options.steps)})
        print(json.dumps(rows[-1]))
        sys.stdout.flush()
    if options.json:
        options.json.write_text(json.dumps({"seconds": options.seconds, "rows": rows}, indent=1) + "\n")
    return 0


class Course:
    """Flights as a function of commands (knots, starts, F, 3) and gains (starts, F, 3, 15), of which tanh is taken."""

    def __init__(self, config: Config, lost: int, sinking: float, seconds: float, blind: float):
        self.period = period = config.timing.control_period
        self.seconds, self.followers = seconds, len(config.plant.followers)
        scenario = Scenario(amplitude=0.0, mass=config.plant.object_mass, goal=(0.0, 0.0, 0.0), seconds=seconds)
        flights = [Scenario(**{**vars(scenario), "lost": ((lost, 0.0),)})] * STARTS
        self.count, axis = round(seconds / period), followers_axis(config)
        disturbances = [flight.disturbance for flight in flights]
        sensors, self._delays = sensors_of(disturbances, period, axis)
        step = make_control_step(config, newton_euler.make_engine(config.plant, config.attitude), jax_repeat)
        self._loop = ClosedLoop(config, jax.vmap(step), sensors)
        known = rollout.load_of(config, flights), rollout.start_of(config, flights)
        known = (*known, record(disturbances, self.count + 2, period, axis).at(0))
        self._load, self._start, self._sample = jax.tree.map(lambda leaf: np.asarray(leaf, np.float32), known)
        self._limits = jnp.array([config.command.tilt_limit, config.command.tilt_limit, VERTICAL_LIMIT])
        down = -sinking * period * np.arange(self.count + 1, dtype=np.float32)
        self._goals = np.broadcast_to(
            down[:, None, None] * np.array([0, 0, 1], np.float32), (self.count + 1, STARTS, 3)
        )
        self.knots = self.count // KNOT + 2
        self._sees = (np.arange(self.count) >= round(blind / period)).astype(np.float32)

    def fly(self, commands: Array, gains: Array) -> tuple[Array, Array, Array]:
        """(velocity (rows, starts, 3), cosine of the tilt (rows, starts), position (rows, starts, 3))."""
        place = np.arange(self.count) / KNOT
        first, share = place.astype(int), (place % 1).astype(np.float32)[:, None, None, None]
        given = commands[first] * (1 - share) + commands[first + 1] * share

        def step(
            carry: tuple[Any, Array], inputs: tuple[Array, Array, Array, Array]
        ) -> tuple[Any, tuple[Array, Array, Array]]:
            state, seen = carry
            own, sees, *goals = inputs
            asked = sees * self._limits * jnp.tanh(own + jnp.einsum("nfkj,nfj->nfk", gains, seen[..., 3:18]))
            state, seen, _ = self._loop.step(state, seen, asked, self._load, tuple(goals), self._sample, np.float32(0))
            upright = rotations.matrix_from_quaternion(state.plant.quaternion)[..., 2, 2]
            return (state, seen), (state.plant.velocity, upright, state.plant.position)

        begun = self._loop.start(self._start, self._goals[0], self._sample, self._delays)
        return jax.lax.scan(jax.checkpoint(step), begun, (given, self._sees, self._goals[:-1], self._goals[1:]))[1]

    def cost(self, found: tuple[Array, Array], horizon: Array) -> Array:
        """Of all starts, of what happens within `horizon` [s]."""
        velocity, upright, _ = self.fly(*found)
        time = np.arange(self.count)[:, None] * 0.02
        counts = jax.nn.sigmoid((horizon - time) / 0.15)
        falls = jnp.minimum(jnp.maximum(-velocity[..., 2] - 0.85 * FASTEST, 0.0), 8.0) ** 2
        tilts = jnp.maximum(math.cos(math.radians(0.9 * STEEPEST)) - upright, 0.0) ** 2
        drifts = jnp.minimum((velocity**2).sum(axis=-1), 64.0)
        return (counts * (falls + 30 * tilts + 0.01 * drifts)).sum() / counts.sum()


def best(course: Course, steps: int) -> dict[str, Any]:
    """How long the best start stays within the bounds [s], and its fastest fall, largest tilt and where it ends."""
    followers, key = course.followers, jax.random.key(0)
    found = 0.05 * jax.random.normal(key, (course.knots, STARTS, followers, 3)), jnp.zeros((STARTS, followers, 3, 15))
    schedule = optax.cosine_decay_schedule(RATE, steps, 0.05)
    adam = optax.chain(optax.clip_by_global_norm(1.0), optax.adam(schedule))
    state = adam.init(found)

    @jax.jit
    def update(found: Any, state: Any, horizon: Array) -> Any:
        slope = jax.tree.map(jnp.nan_to_num, jax.grad(course.cost)(found, horizon))
        moved, state = adam.update(slope, state)
        return optax.apply_updates(found, moved), state

    for number in range(steps):
        part = min(1.0, number / (0.6 * steps))
        found, state = update(found, state, np.float32(HORIZON + part * (course.seconds - HORIZON)))
    velocity, upright, place = (np.asarray(part, float) for part in jax.jit(course.fly)(*found))
    fall, tilt = -velocity[..., 2], np.degrees(np.arccos(np.clip(upright, -1, 1)))
    within = (fall <= FASTEST) & (tilt <= STEEPEST)
    held = np.where(within.all(axis=0), course.count, within.argmin(axis=0)) * course.period
    one = int(np.argmax(held - 1e-3 * fall.max(axis=0)))
    return {
        "held": float(held[one]),
        "fall": float(fall[:, one].max()),
        "tilt": float(tilt[:, one].max()),
        "speed": float(np.linalg.norm(velocity[:, one], axis=-1).max()),
        "ends": place[-1, one].round(2).tolist(),
    }


if __name__ == "__main__":
    sys.exit(cli.run_command(main))
