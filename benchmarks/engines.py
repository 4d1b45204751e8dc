"""Accelerations of closed form, MJX and C MuJoCo for teams of drones of any number, load and stand.

No two rigs are alike: masses, inertias, mounts, yaw angles, carrier. Closed form and MJX run once with numbers that are
traced, every world with the rig of its own, and the closed form once more with constants. A difference is that of a
state's accelerations, over the largest of them, the load's included.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import jax
import numpy as np

from harness import Row, arguments, say, write
from mjxball.config import Attitude, Drone, Motion, Plant, preset
from mjxball.physics import mjx, motion, mujoco, newton_euler
from mjxball.physics.engine import Load, PathShape, PlantState, Wrench, total_wrench
from mjxball.plant import PlantParameters, plant_parameters
from mjxball.running import run_command

TIMES = (0.0, 2.0, 3.0, 7.0, 12.0, 19.0)
WAVEFORM = Motion(kind="waveform", times=TIMES, offsets=(0.0, 0.03, -0.02, 0.04, -0.03, 0.0))
IN_PLANE = replace(WAVEFORM, offsets_across=(0.0, -0.02, 0.03, 0.01, -0.02, 0.01))
LINE, PLANE = ("sine", "waveform", "waypoints", "rod"), ("ellipse", "figure of eight", "waveform", "waypoints", "plate")
SHAPES = {"ellipse": (0.6, 1.0), "figure of eight": (0.8, 2.0)}  # width and ratio of both sines
FRACTIONS = (1.0, 0.4)  # of the object that moves


def random_team(count: int, seed: int, **changes: Any) -> Plant:
    """`count` drones of which no two are alike, anywhere and turned by any angle, on a carrier with a moving load."""
    random = np.random.default_rng(seed)
    drones = tuple(
        Drone(
            mass=random.uniform(0.5, 1.5),
            inertia=tuple(random.uniform(2e-3, 3.5e-3, 3)),
            mount=(*random.uniform(-0.4, 0.4, 2), random.uniform(-0.05, 0.05)),
            yaw=random.uniform(-np.pi, np.pi),
            arm=random.uniform(0.08, 0.15),
            rotor_force_max=random.uniform(5, 9),
            rotor_lag=random.uniform(0.02, 0.05),
            yaw_per_thrust=random.uniform(0.01, 0.03),
        )
        for _ in range(count)
    )
    settings: dict[str, Any] = {
        "drones": drones,
        "carrier_mass": 0.05 * count,
        "carrier_inertia": (2e-3, 3e-3, 4e-3),
        "object_mass": 0.1 * count,
        "object_size": (0.5, 0.44, 0.08),
        "cg_axis": "xy",
    }
    return Plant(**(settings | changes))


def random_states(plant: Plant, count: int, random: np.random.Generator) -> PlantState:
    """States that the plant's stand allows: any attitude, rates of a few rad/s, rotors anywhere in their range."""
    quaternion, rates = random.normal(size=(count, 4)), random.normal(size=(count, 3)) * 2
    position, velocity = random.normal(size=(2, count, 3))
    if plant.stand != "free":
        quaternion[:, 2:], rates[:, 1:] = 0, 0
        keep = np.array([0.0, 0.0, float(plant.stand == "heave")])
        position, velocity = position * keep, velocity * keep
    half, places = reach(plant), (count,) if len(plant.directions) == 1 else (count, 2)
    return PlantState(
        position=position,
        quaternion=quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True),
        velocity=velocity,
        rates=rates,
        rotor_force=random.uniform(0, plant.rotor_force_max, (count, plant.count, 4)),
        ticks=np.zeros(count, int),
        time=random.uniform(0, 20, count),
        ball_offset=random.uniform(-half, half, places),
        ball_rate=random.normal(size=places),
    )


def reach(plant: Plant) -> float:
    """Half of the object's length along the load's directions [m]."""
    return min(plant.object_size[axis] for axis in plant.directions) / 2


def random_load(plant: Plant, path: str, count: int, random: np.random.Generator) -> Load:
    """Masses that change and a motion of the kind `path`."""
    load = Load(
        object_mass=random.uniform(0.2, 0.6, count),
        believed_mass=np.full(count, 0.2),
        cg_amplitude=random.uniform(0, plant.moving_fraction * reach(plant), count),
        cg_speed=random.uniform(0.3, 3.1, count),
        cg_phase=random.uniform(0, 6.28, count),
        mass_change=random.uniform(-0.05, 0.2, (count, 2)),
        mass_change_time=random.uniform(0, 20, (count, 2)),
    )
    if path in SHAPES:
        shape = (random.uniform(-3, 3, count), *np.full((count, 2), SHAPES[path]).T, random.uniform(0, 6, count))
        return load._replace(cg_shape=PathShape(*shape))
    if path == "waypoints":
        places = random.uniform(-0.7, 0.7, (count, 8, *(() if len(plant.directions) == 1 else (2,))))
        return load._replace(cg_path=places, follows_path=np.ones(count))
    return load


Case = tuple[str, PlantState, Wrench, np.ndarray, Any]  # function, state, wrench, object mass, what moves the load


def arguments_of(plant: Plant, path: str, count: int, seed: int) -> Case:
    """What an engine is asked on `count` random states of `plant` with a load that moves like `path`."""
    random = np.random.default_rng(seed)
    parameters, state = plant_parameters(plant, Attitude()), random_states(plant, count, random)
    load, wrench = random_load(plant, path, count, random), total_wrench(plant, parameters, state.rotor_force)
    mass = motion.object_mass(state.time, load)
    waves = WAVEFORM if len(plant.directions) == 1 else IN_PLANE
    config = replace(preset("paper"), plant=plant, motion=waves if path == "waveform" else Motion())
    if path in ("rod", "plate"):
        force = motion.make_rolling_force(config)(state.ball_offset, state.ball_rate, plant.moving_fraction * mass)
        return "rolling", state, wrench, mass, force
    return "prescribed", state, wrench, mass, motion.make_cg_motion(config)(state.time, load)


def difference(found: Any, expected: Any, case: Case) -> float:
    """Largest difference of any state's accelerations, over that state's largest."""
    given = (case[-1].acceleration,) if case[0] == "prescribed" else ()
    rows = [[np.asarray(part).reshape(len(part), -1) for part in (*parts, *given)] for parts in (found, expected)]
    one, other = (np.concatenate(parts, axis=-1) for parts in rows)
    return float((np.abs(one - other).max(axis=-1) / np.abs(other).max(axis=-1)).max())


def traced(make: Callable[..., Any], plant: Plant) -> dict[str, Any]:
    """The engine's functions (numbers of every rig, its states, ...) -> accelerations, in float64."""

    def function(name: str) -> Any:
        def one(parameters: PlantParameters, *arguments: Any) -> Any:
            return getattr(make(plant, Attitude(), parameters), name)(*arguments)

        batched = jax.jit(jax.vmap(jax.vmap(one, in_axes=(None, 0, 0, 0, 0))))

        def called(*arguments: Any) -> Any:
            with jax.enable_x64(True):
                return jax.tree.map(np.asarray, batched(*arguments))

        return called

    return {name: function(name) for name in ("prescribed", "rolling")}


def stacked(trees: list[Any]) -> Any:
    """Trees of arrays as one tree with a leading axis."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)


def measure(count: int, paths: tuple[str, ...], stand: str, states: int, rigs: int) -> Iterator[Row]:
    """Rows of all `paths` for teams of `count` on `stand`, `states` in all on `rigs` different rigs."""
    axis = "y" if paths is LINE else "xy"
    plants = [
        random_team(count, seed=100 * count + rig, stand=stand, cg_axis=axis, moving_fraction=FRACTIONS[rig % 2])
        for rig in range(rigs)
    ]
    numbers = stacked([plant_parameters(plant, Attitude()) for plant in plants])
    engines = {"closed form, traced": newton_euler.make_engine, "MJX, traced": mjx.make_engine}
    functions = {name: traced(make, plants[1]) for name, make in engines.items()}
    for number, path in enumerate(paths):
        cases = [arguments_of(plant, path, states // rigs, 1000 * number + rig) for rig, plant in enumerate(plants)]
        name = cases[0][0]
        expected, constant = (
            [getattr(make(plant, Attitude()), name)(*case[1:]) for plant, case in zip(plants, cases, strict=True)]
            for make in (mujoco.make_engine, newton_euler.make_engine)
        )
        row: Row = {"drones": count, "load": f"{path} ({axis})", "stand": stand, "states": states}
        row["closed form"] = max(map(difference, constant, expected, cases))
        together = stacked([case[1:] for case in cases])
        for engine, function in functions.items():
            found = function[name](numbers, *together)
            each = [jax.tree.map(lambda leaf: leaf[rig], found) for rig in range(rigs)]  # noqa: B023
            row[engine] = max(map(difference, each, expected, cases))
        yield row


def main(given: Sequence[str] | None = None) -> int:
    """Measure, print, write."""
    parser = arguments(__file__, __doc__)
    parser.add_argument("--drones", type=int, nargs="+", default=[2, 3, 4, 6])
    parser.add_argument("--stands", nargs="+", choices=("free", "pivot", "heave"), default=["free", "pivot", "heave"])
    parser.add_argument("--states", type=int, default=10_000, help="for every number of drones, load and stand")
    parser.add_argument("--rigs", type=int, default=10, help="different rigs among them")
    options = parser.parse_args(given)
    rows, started = [], time.process_time()
    for count in options.drones:
        for stand in options.stands:
            for paths in (LINE, PLANE):
                for row in measure(count, paths, stand, options.states, options.rigs):
                    rows.append(row)
                    say(row, ".1e")
    worst = {name: max(row[name] for row in rows) for name in ("closed form", "closed form, traced", "MJX, traced")}
    say({"worst:": "", **worst, "CPU s": round(time.process_time() - started)}, ".1e")
    write(options.json, {"worst": worst, "rows": rows})
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
