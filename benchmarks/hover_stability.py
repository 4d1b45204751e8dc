"""Local stability of leader, follower and plant about hover: the closed loop's eigenvalues, and the delay it bears.

With the CG at rest at an offset, the loop over one control step is a smooth map of everything that it remembers: the
object's position, attitude, velocity and rates, the rotors, the follower's memory, and the observations under way if
its measurements are late. Its fixed point is found by flying and by Newton's method, its Jacobian there by JAX, in
float64. A network with ReLU units is linear around almost every point, so the eigenvalues say what a small error
does, no more. A recurrent follower may have several fixed points, and circle about one with millimetres: the one
nearest to the flight's mean is taken.

    python benchmarks/hover_stability.py policies/universal.npz --plants team3 team4 team6 --json FILE

A team's map holds every follower's memory, and so the modes that the load cannot see: followers against each other. The
table has the slowest mode of each hover, its time constant, negative where it grows, and how much of it is the load's.
"""

from __future__ import annotations

import dataclasses
import json
import math
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from mjxball import cli
from mjxball.config import Config
from mjxball.control import rotations
from mjxball.control.followers import Law
from mjxball.evaluate.policies import load_policy
from mjxball.physics import newton_euler
from mjxball.physics.engine import Load, PlantState
from mjxball.physics.step import jax_repeat, make_control_step, start_state
from mjxball.policy import Policy
from mjxball.policy.file import load_file
from mjxball.sim import rollout
from mjxball.sim.closed_loop import ClosedLoop, LoopState
from mjxball.sim.disturbances import Sample, SensorModel, SensorState
from mjxball.sim.scenario import Scenario

Array = Any
SETTLE, WATCHED = 3000, 1000  # control steps flown towards the fixed point, and those whose mean is taken
NEWTON, HALVINGS = 40, 12  # then steps of Newton's method, each as short as makes the residual smallest
SOUND = 1e-8  # largest change over a control step, in SI units, of what counts as a fixed point
NEUTRAL = 1e-6  # a memory that the loop does not use keeps its value: eigenvalue 1
KEPT = 1e-9  # of an eigenvalue from 1: a memory that never changes, as where the drones are mounted
LOAD = slice(12)  # of what the map is of: position, attitude, velocity and rates of the carrier and its load
OFFSETS, DELAYS = (0.0, 0.05), (0, 2)  # of a team's hovers: the CG [m], control steps


@dataclass(frozen=True)
class Hover:
    """The closed loop about hover with the CG at rest."""

    offset: float  # of the CG [m]
    mass: float  # of the object [kg]
    delay: int  # control steps by which the follower's measurements are late
    residual: float  # change over a control step at the fixed point; above `SOUND` there is none
    error: float  # |e_o| at the fixed point [m]
    tilt: float  # hypot(roll, pitch) there [rad]
    radius: float  # largest |eigenvalue| of the map over one control step
    swing: (
        float  # half of what the position still moves after `SETTLE` steps of flight, of the axis that moves most [m]
    )
    slowest: float  # largest |eigenvalue| but those of memories that never change
    seen: float  # share of the load's numbers in that mode's length; the rest is rotors and memories

    @property
    def stable(self) -> bool:
        """True if there is a hover in which small errors do not grow."""
        return bool(self.residual < SOUND and self.radius < 1 + NEUTRAL)


def linearised_hovers(
    config: Config, law: Law, cases: Sequence[tuple[float, float, float]], delay: int = 0
) -> list[Hover]:
    """The hover of every case: (CG offset [m], object mass [kg], believed mass [kg])."""
    return linearised(config, lambda _: law, np.zeros(1), cases, delay)[0]


def linearised(
    config: Config, law: Callable[[Any], Law], numbers: Any, cases: Sequence[tuple[float, float, float]], delay: int
) -> list[list[Hover]]:
    """`linearised_hovers` of every one of k laws, `law` of traced numbers: a tree of arrays (k, ...)."""
    with jax.enable_x64(True), jax.default_device(jax.local_devices(backend="cpu")[0]):
        scenarios = [
            Scenario(omega=0.0, phase=np.pi / 2, amplitude=offset, mass=mass, believed_mass=believed)
            for offset, mass, believed in cases
        ]
        loads = jax.tree.map(jnp.asarray, rollout.load_of(config, scenarios))

        def of_one(own: Any) -> tuple[Array, Array, Array, Array]:
            start, step = closed_loop(config, law(own), delay)
            return jax.vmap(lambda load: _linearise(start(load), lambda z: step(z, load)))(loads)

        found = map(np.asarray, jax.jit(jax.vmap(of_one))(jax.tree.map(jnp.asarray, numbers)))
    return [
        [
            Hover(
                *(offset, mass, delay, float(left), float(np.linalg.norm(z[:3])), float(np.hypot(z[3], z[4]))),
                *(_radius(jacobian), float(swing), *_slowest(jacobian)),
            )
            for (offset, mass, _), z, left, jacobian, swing in zip(cases, *one, strict=True)
        ]
        for one in zip(*found, strict=True)
    ]


def _radius(jacobian: np.ndarray) -> float:
    """Largest |eigenvalue|, infinite where the flight towards the fixed point ran away."""
    return float(np.abs(np.linalg.eigvals(jacobian)).max()) if np.isfinite(jacobian).all() else np.inf


def _slowest(jacobian: np.ndarray) -> tuple[float, float]:
    """(largest |eigenvalue| but those that are 1, share of the load in that mode)."""
    if not np.isfinite(jacobian).all():
        return np.inf, np.nan
    values, modes = np.linalg.eig(jacobian)
    number = int(np.argmax(np.where(np.abs(values - 1) < KEPT, 0.0, np.abs(values))))
    mode = np.abs(modes[:, number])
    return float(np.abs(values[number])), float(np.linalg.norm(mode[LOAD]) / np.linalg.norm(mode))


def delay_margins(
    config: Config, law: Law, cases: Sequence[tuple[float, float, float]], longest: int = 15
) -> list[int]:
    """For every case the control steps of delay up to which its hover stays stable; -1 if it never is."""
    margins = [-1] * len(cases)
    for delay in range(longest + 1):
        for number, hover in enumerate(linearised_hovers(config, law, cases, delay)):
            if hover.stable and margins[number] == delay - 1:
                margins[number] = delay
        if max(margins) < delay:
            break
    return margins


def closed_loop(config: Config, law: Law, delay: int) -> tuple[Callable[[Load], Array], Callable[[Array, Load], Array]]:
    """(`start(load)` -> z, `step(z, load)` -> z one control period on) for a goal at the origin, on vectors z (k,).

    z holds position, Euler angles, velocity, rates, rotor forces, the follower's memory, older observations.
    """
    period = config.timing.control_period
    physics = make_control_step(config, newton_euler.make_engine(config.plant, config.attitude), jax_repeat)
    privileged, loop = rollout.make_privileged_info(config), ClosedLoop(config, physics, SensorModel(delay))
    goal, still, zero = jnp.zeros(3), jnp.zeros(3), jnp.zeros(())

    def flat(plant: PlantState, memory: Any, past: Array) -> tuple[Array, Any]:
        euler = rotations.euler_from_matrix(rotations.matrix_from_quaternion(plant.quaternion))
        return ravel_pytree((plant.position, euler, plant.velocity, plant.rates, plant.rotor_force, memory, past))

    def first(load: Load) -> tuple[PlantState, Any, Array]:
        plant = start_state(config, still, still, still, load.believed_mass, zero)
        observation = loop.observe(plant, goal)
        return plant, law.start(observation), jnp.broadcast_to(observation, (delay, *observation.shape))

    def start(load: Load) -> Array:
        return flat(*first(load))[0]

    def step(z: Array, load: Load) -> Array:
        unflatten = flat(*first(load))[1]
        position, euler, velocity, rates, rotors, memory, older = unflatten(z)
        plant = PlantState(position, rotations.quaternion_from_euler(euler), velocity, rates, rotors, zero, zero, zero)
        past = jnp.concatenate([loop.observe(plant, goal)[None], older])
        sensors = SensorState(delay, (), past) if delay else SensorState()
        state = LoopState(plant, loop.zero_integral(still), sensors, jnp.zeros((), bool))
        memory, answer = law.step(memory, past[-1], privileged(plant, load))
        moved, _, _ = loop.step(state, past[-1], answer, load, (goal, goal), Sample(), 0.0)
        older = moved.sensors.past[1:] if delay else older
        # A flight that diverged stays where it was, which is no hover.
        return jnp.where(moved.diverged, jnp.nan, flat(moved.plant._replace(time=zero), memory, older)[0])

    if config.autopilot.kind != "ideal":
        raise ValueError("a firmware's whole numbers have no derivative: only the ideal autopilot is linearised")
    if config.leader.ki != (0.0, 0.0, 0.0):
        raise ValueError(f"the leader's integral term {config.leader.ki} has no place in this loop of {period:g} s")
    return start, step


def _linearise(start: Array, step: Callable[[Array], Array]) -> tuple[Array, Array, Array, Array]:
    """(fixed point, its residual, Jacobian there, swing flown [m]) of `step`, found from `start`.

    A flight that never comes to rest circles about its fixed point: its mean is nearer to it than any of its states.
    """
    z = jax.lax.fori_loop(0, SETTLE, lambda _, z: step(z), start)

    def watch(_: Array, seen: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        z, total, low, high = seen
        return step(z), total + z, jnp.minimum(low, z), jnp.maximum(high, z)

    _, total, low, high = jax.lax.fori_loop(0, WATCHED, watch, (z, jnp.zeros_like(z), z, z))
    still = jnp.eye(len(z))
    slopes = jax.jacfwd(lambda z: (step(z) - z,) * 2, has_aux=True)
    shares = jnp.append(0.5 ** jnp.arange(HALVINGS), 0.0)  # of Newton's step

    def polish(_: Array, found: tuple[Array, ...]) -> tuple[Array, ...]:
        point = found[0]
        slope, change = slopes(point)
        # A memory that the loop does not use has no slope, and no change either.
        tried = point - shares[:, None] * jnp.linalg.solve(slope - NEUTRAL**2 * still, change)
        left = jax.vmap(lambda z: jnp.linalg.norm(step(z) - z))(tried)
        return tried[jnp.nanargmin(left)], point, change, slope

    mean = total / WATCHED
    _, z, change, slope = jax.lax.fori_loop(0, NEWTON, polish, (mean, mean, mean, still))
    return z, jnp.abs(change).max(), slope + still, (high - low)[:3].max() / 2


def main(arguments: Sequence[str] | None = None) -> int:
    """Slowest modes of whole teams."""
    parser = cli.make_parser("python benchmarks/hover_stability.py", __doc__.split("\n\n")[0])
    parser.add_argument("policies", nargs="+", type=Path, metavar="POLICY.npz")
    parser.add_argument("--plants", nargs="+", default=["team3", "team4", "team6"], metavar="NAME|FILE")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args(arguments)
    rows: list[dict[str, Any]] = []
    for path in options.policies:
        for plant in options.plants:
            config = cli.plant_setup(Path(plant))
            law, mass = in_float64(path, config), config.plant.object_mass
            for delay in DELAYS:
                for hover in linearised_hovers(config, law, [(offset, mass, mass) for offset in OFFSETS], delay):
                    rows.append(row_of(path.stem, plant, hover, config.timing.control_period))
    if options.json:
        options.json.write_text(json.dumps({"rows": rows}, indent=1, allow_nan=False) + "\n")
    return 0


def in_float64(path: Path, config: Config) -> Law:
    """The law of a policy file on the plant of `config`, in double precision."""
    load_policy(path, config)  # which refuses and warns
    policy = Policy(load_file(path), path.stem, np.float64)
    policy.join(config.plant)
    return policy.law


def row_of(policy: str, plant: str, hover: Hover, period: float) -> dict[str, Any]:
    """A hover in the table, which is printed; None where there is no fixed point."""
    found = hover.residual < SOUND and math.isfinite(hover.slowest) and hover.slowest not in (0.0, 1.0)
    constant = -period / math.log(hover.slowest) if found else None
    row = {"policy": policy, "plant": plant, **dataclasses.asdict(hover), "time_constant": constant}
    shown = f"{constant:8.1f} s, {hover.seen:.1%} of it the load's" if constant is not None else "   no hover found"
    print(
        f"{policy:12} {plant:8} CG {hover.offset:.2f} m, delay {hover.delay}: slowest mode {hover.slowest:.6f}, {shown}"
    )
    return {
        name: value if not isinstance(value, float) or math.isfinite(value) else None for name, value in row.items()
    }


if __name__ == "__main__":
    sys.exit(cli.run_command(main))
