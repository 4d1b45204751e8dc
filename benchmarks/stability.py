"""How stable a policy is: eigenvalues and delay margins about hover, and thousands of random flights.

With the CG at rest at an offset, the loop over one control step is a smooth map of everything that it remembers: the
object's position, attitude, velocity and rates, the rotors, the follower's memory, and the observations under way if
its measurements are late. Its fixed point is found by flying and by Newton's method, its Jacobian there by JAX, in
float64. A network with ReLU units is linear around almost every point, so the eigenvalues say what a small error
does, no more. A recurrent follower may have several fixed points, and circle about one with millimetres: the one
nearest to the flight's mean is taken.

- For a grid of CG offsets and object masses that one drone can trim: the spectral radius of leader, policy and plant
  over one control step about hover (below 1: small errors die out), the time constant that goes with it, and the
  largest delay of the follower's measurements, in whole control steps, that keeps it below 1. LQG, adaptive beside it.
- A policy for any rig: the hovers of `horizon.RIGS` with the CG at O and `AWAY` off, for delays up to `LATEST`.
- Otherwise random feasible flights: CG speed, amplitude, phase, mass, goal, start and tilt, all uniform. None
  may fail. The ten with the largest steady-state peak are listed.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from batch import controller_of, fly_compiled
from harness import Row, arguments, say, table, write
from horizon import own_plants
from mjxball.arrays import Array
from mjxball.baselines import make_baseline
from mjxball.config import Config, preset
from mjxball.control import rotations
from mjxball.control.constants import trim_limit
from mjxball.control.followers import Controller, Follower
from mjxball.control.observation import OWN_STATE
from mjxball.evaluate.policies import flies_any_rig, load_policy
from mjxball.physics import newton_euler
from mjxball.physics.engine import Load, PlantState
from mjxball.physics.step import jax_repeat, make_plant_step, start_state
from mjxball.policy import Policy
from mjxball.running import run_command
from mjxball.sim import rollout
from mjxball.sim.closed_loop import ClosedLoop, LoopState
from mjxball.sim.goals import Goal
from mjxball.sim.scenario import Scenario
from mjxball.sim.sensors import Sample, SensorModel, SensorSettings, SensorState

SETTLE, WATCHED = 3000, 1000  # control steps flown towards the fixed point, and those whose mean is taken
NEWTON, HALVINGS = 40, 12  # then steps of Newton's method, each as short as makes the residual smallest
SOUND = 1e-8  # largest change over a control step, in SI units, of what counts as a fixed point
NEUTRAL = 1e-6  # a memory that the loop does not use keeps its value: eigenvalue 1
CG_OFFSETS, MASSES = (-0.17, -0.1, -0.05, 0.0, 0.05, 0.1, 0.17), (0.1, 0.2, 0.4, 0.6)  # of the pair's hovers
MARGIN, BELIEVED = 0.15, 0.2  # of what can be trimmed; mass that is believed if it is unknown [kg]
LONGEST = 10  # control steps of delay that are tried
AWAY, LATEST = 0.05, 3  # CG off O [m] and longest delay [control steps] of a policy for any rig


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
    swing: float  # half of what the position still moves after `SETTLE` steps, of the axis that moves most [m]

    @property
    def stable(self) -> bool:
        """True if there is a hover in which small errors do not grow."""
        return bool(self.residual < SOUND and self.radius < 1 + NEUTRAL)


def linearised_hovers(
    config: Config, controller: Controller, cases: Sequence[tuple[float, float, float]], delay: int = 0
) -> list[Hover]:
    """The hover of every case: (CG offset [m], object mass [kg], believed mass [kg])."""
    with jax.enable_x64(True), jax.default_device(jax.local_devices(backend="cpu")[0]):
        scenarios = [
            Scenario(omega=0.0, phase=np.pi / 2, amplitude=offset, mass=mass, believed_mass=believed)
            for offset, mass, believed in cases
        ]
        loads = jax.tree.map(jnp.asarray, rollout.load_of(config, scenarios))
        start, step = closed_loop(config, controller, delay)
        each = jax.vmap(lambda load: _linearise(start(load), lambda z: step(z, load)))
        found = map(np.asarray, jax.jit(each)(loads))
    return [
        Hover(
            *(offset, mass, delay, float(left), float(np.linalg.norm(z[:3])), float(np.hypot(z[3], z[4]))),
            *(_radius(jacobian), float(swing)),
        )
        for (offset, mass, _), z, left, jacobian, swing in zip(cases, *found, strict=True)
    ]


def _radius(jacobian: np.ndarray) -> float:
    """Largest |eigenvalue|, infinite where the flight towards the fixed point ran away."""
    return float(np.abs(np.linalg.eigvals(jacobian)).max()) if np.isfinite(jacobian).all() else np.inf


def delay_margins(
    config: Config, controller: Controller, cases: Sequence[tuple[float, float, float]], longest: int = 15
) -> list[int]:
    """For every case the control steps of delay up to which its hover stays stable; -1 if it never is."""
    margins = [-1] * len(cases)
    for delay in range(longest + 1):
        for number, hover in enumerate(linearised_hovers(config, controller, cases, delay)):
            if hover.stable and margins[number] == delay - 1:
                margins[number] = delay
        if max(margins) < delay:
            break
    return margins


def closed_loop(
    config: Config, controller: Controller, delay: int
) -> tuple[Callable[[Load], Array], Callable[[Array, Load], Array]]:
    """(`start(load)` -> z, `step(z, load)` -> z one control period on) for a goal at the origin, on vectors z (k,).

    z holds position, Euler angles, velocity, rates, rotor forces, the follower's memory, older observations.
    """
    period = config.timing.control_period
    physics = make_plant_step(config, newton_euler.make_engine(config.plant, config.attitude), jax_repeat)
    sensors = SensorModel(delay, present=delay > 0)
    privileged, loop = rollout.make_privileged_info(config), ClosedLoop(config, physics, sensors)
    goal, still, zero = jnp.zeros(3), jnp.zeros(3), jnp.zeros(())

    def flat(plant: PlantState, memory: Any, past: Array) -> tuple[Array, Any]:
        euler = rotations.euler_from_matrix(rotations.matrix_from_quaternion(plant.quaternion))
        return ravel_pytree((plant.position, euler, plant.velocity, plant.rates, plant.rotor_force, memory, past))

    def first(load: Load) -> tuple[PlantState, Any, Array]:
        plant = start_state(config, still, still, still, load.believed_mass, zero)
        observation = loop.observe(plant, goal)
        own = observation[..., :OWN_STATE]
        return plant, controller.start(observation), jnp.broadcast_to(own, (delay, *own.shape))

    def start(load: Load) -> Array:
        return flat(*first(load))[0]

    def step(z: Array, load: Load) -> Array:
        unflatten = flat(*first(load))[1]
        position, euler, velocity, rates, rotors, memory, older = unflatten(z)
        begin, turn = jnp.zeros((), jnp.int32), rotations.quaternion_from_euler(euler)
        plant = PlantState(position, turn, velocity, rates, rotors, begin, zero, zero, zero)
        past = jnp.concatenate([loop.observe(plant, goal)[None, ..., :OWN_STATE], older])
        late = SensorState(SensorSettings(delay), past=past) if delay else ()
        state = LoopState(plant, jnp.zeros_like(still), late, jnp.zeros((), bool))
        carry = rollout.Carry(state, loop.observe_by(past[-1], goal), memory)
        inputs = rollout.Inputs(zero, Goal(goal), Goal(goal), None, None, Sample())
        (moved, _, memory), _ = rollout.control_step(loop, controller, privileged, load, carry, inputs)
        older = moved.sensors.past[1:] if delay else older
        # A flight that diverged stays where it was, which is no hover.
        return jnp.where(moved.diverged, jnp.nan, flat(moved.plant, memory, older)[0])

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


def grid(config: Config, unknown: bool) -> list[tuple[float, float, float]]:
    """(CG offset, mass, believed mass) of every hover that one drone can trim."""
    every = [(offset, mass, BELIEVED if unknown else mass) for mass in MASSES for offset in CG_OFFSETS]
    return [case for case in every if abs(case[0]) <= trim_limit(config.plant, case[1], MARGIN, case[2])]


def about_hover(config: Config, follower: Follower, cases: list[Any]) -> list[Row]:
    """One row for each case."""
    controller, period = controller_of(follower), config.timing.control_period
    found, margins = linearised_hovers(config, controller, cases), delay_margins(config, controller, cases, LONGEST)
    rows = []
    for hover, margin in zip(found, margins, strict=True):
        row = {"follower": follower.name, "offset": hover.offset, "mass": hover.mass, "radius": hover.radius}
        row["time_constant"] = -period / math.log(hover.radius) if 0 < hover.radius < 1 else None
        row |= {"stable": hover.stable, "error": hover.error}
        rows.append(row | {"delay_margin": margin * period if margin >= 0 else None})
    return rows


def of_rig(path: Path, label: str, config: Config) -> Iterator[Row]:
    """One row for each CG at rest and delay of a policy for any rig, with the plant's object."""
    controller, mass = controller_of(load_policy(path, config)), config.plant.object_mass
    for delay in range(LATEST + 1):
        for hover in linearised_hovers(config, controller, [(0.0, mass, mass), (AWAY, mass, mass)], delay):
            row: Row = {"plant": label, "offset": hover.offset, "delay": delay * config.timing.control_period}
            yield row | {"stable": hover.stable, "radius": hover.radius, "error": hover.error, "swing": hover.swing}


def _vector(random: np.random.Generator, size: float) -> tuple[float, float, float]:
    x, y, z = map(float, random.uniform(-size, size, 3))
    return x, y, z


def random_scenarios(config: Config, count: int, unknown: bool, seed: int = 0) -> list[Scenario]:
    """Feasible scenarios, uniform in everything."""
    random, scenarios = np.random.default_rng(seed), []
    for _ in range(count):
        mass = float(random.uniform(0.1, 0.35 if unknown else 0.6))
        reach = min(0.17, trim_limit(config.plant, mass, MARGIN, BELIEVED if unknown else mass))
        scenarios.append(
            Scenario(
                omega=float(random.uniform(0.0, 3.1)),
                amplitude=float(random.uniform(0.0, reach)),
                phase=float(random.uniform(0, 2 * math.pi)),
                mass=mass,
                believed_mass=BELIEVED if unknown else None,
                goal=_vector(random, 1.0),
                start_position=_vector(random, 0.3),
                start_velocity=_vector(random, 0.3),
                start_tilt=(float(random.uniform(-0.15, 0.15)), float(random.uniform(-0.15, 0.15))),
            )
        )
    return scenarios


def main(given: Sequence[str] | None = None) -> int:
    """Measure, print, write."""
    parser = arguments(__file__, __doc__)
    parser.add_argument("policy", type=Path, metavar="POLICY.npz")
    parser.add_argument("--flights", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0, help="of the random flights")
    parser.add_argument("--unknown", action="store_true", help="the hover thrust believes 0.2 kg, whatever the mass")
    options = parser.parse_args(given)
    if flies_any_rig(Policy.load(options.policy)):
        rows = [row for label, setup in own_plants(options.policy) for row in of_rig(options.policy, label, setup)]
        table(rows)
        write(options.json, {"hovers": rows})
        return 0
    config = preset("paper")
    policy = load_policy(options.policy, config)
    cases = grid(config, options.unknown)
    classical = "adaptive-mass" if options.unknown else "adaptive", "lqg"
    rows, shown = [], []
    followers: list[Follower] = [policy, *(make_baseline(name, config) for name in classical)]
    for follower in followers:
        mine = about_hover(config, follower, cases)
        rows += mine
        margins = [1e3 * row["delay_margin"] for row in mine if row["delay_margin"] is not None]
        row = {"follower": follower.name, "hovers": len(mine), "stable": sum(row["stable"] for row in mine)}
        row |= {"radius": max(row["radius"] for row in mine), "error mm": 1e3 * max(row["error"] for row in mine)}
        shown.append(row | {"margin ms": f"{min(margins, default=0):.0f} - {max(margins, default=0):.0f}"})
    table(shown)
    table([row for row in rows if not row["stable"]], ("follower", "offset", "mass", "radius"))
    scenarios = random_scenarios(config, options.flights, options.unknown, options.seed)
    flown = fly_compiled(config, policy, scenarios)
    peaks = [metrics.axis_peak for metrics in flown]
    failed = sum(metrics.failed for metrics in flown)
    middle, high, most = map(float, np.quantile(peaks, [0.5, 0.99, 1.0]))
    quantiles = {"median": middle, "99 %": high, "largest": most}
    say({"random flights": len(flown), "failed": failed, "peaks": ""} | {k: 1e3 * v for k, v in quantiles.items()})
    worst = sorted(zip(peaks, scenarios, strict=True), key=lambda one: -one[0])[:10]
    fields = ("mass", "amplitude", "omega", "goal")
    table([{"peak": most, **{name: getattr(scenario, name) for name in fields}} for most, scenario in worst])
    sound = sorted(value for value in peaks if math.isfinite(value))
    found = {"hovers": rows, "flights": len(flown), "failed": failed, "peaks [m]": quantiles}
    write(options.json, found | {"largest peaks": sound[-100:]})
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
