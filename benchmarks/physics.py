"""Physics steps per second of MJX, the closed form and C MuJoCo, in one run.

A physics step is the whole plant: both attitude loops, rotor lag, accelerations and the integrator. Every figure
is the median of several timed calls after one that is not counted; compile time is the first call's extra.

    python benchmarks/physics.py --num-envs 1024 65536 --json physics.json
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjxball import config as configs
from mjxball.physics import mjx, newton_euler
from mjxball.physics.engine import Load, PlantState
from mjxball.physics.step import jax_repeat, make_control_step, make_stepper, python_repeat, start_state

REPEATS = 5
ENGINES = {"newton-euler": newton_euler.make_engine, "mjx": mjx.make_engine}
LOOPS = {"loop": jax_repeat, "unrolled": python_repeat}  # the physics steps of a control step; training uses `loop`


def batch(config: configs.Config, worlds: int, dtype: type) -> tuple[PlantState, np.ndarray, Load]:
    """A batch of hovering worlds with different CG motions, and their commands."""
    random = np.random.default_rng(0)
    mass = random.uniform(0.1, 0.3, worlds).astype(dtype)
    sine = (random.uniform(low, high, worlds).astype(dtype) for low, high in ((0.02, 0.1), (0.3, 3.0), (0, 6.28)))
    none = np.zeros((worlds, 0), dtype)
    load = Load(mass, mass, *sine, none, none)
    zero = np.zeros((worlds, 3), dtype)
    euler = random.normal(0, 0.05, (worlds, 3)).astype(dtype)
    commands = random.normal(0, 0.02, (worlds, config.plant.count, 3)).astype(dtype)
    ball = zero[:, 0] if len(config.plant.directions) == 1 else zero[:, :2]
    return start_state(config, zero, euler, zero, mass, ball), commands, load


def plant_of(name: str) -> configs.Config:
    """The preset `transport`, or that of the shipped plant `name`, on this plant."""
    return configs.with_plant(configs.preset(configs.read_plant(name).preset or "transport"), name)


def make_run(config: configs.Config, name: str, loop: str, control_steps: int) -> Any:
    """A function (state, commands, load) -> state that advances a batch `control_steps` control steps."""
    engine = ENGINES[name](config.plant, config.attitude)
    step = jax.vmap(make_control_step(config, engine, LOOPS[loop]))

    def run(state: PlantState, commands: Any, load: Load) -> PlantState:
        return jax.lax.fori_loop(0, control_steps, lambda _, s: step(s, commands, load), state)

    return run


def time_jax(config: configs.Config, name: str, worlds: int, control_steps: int, loop: str) -> dict[str, float]:
    """Steps/s and compile seconds of one JAX engine at one size."""
    run = make_run(config, name, loop, control_steps)
    arguments = jax.tree.map(jnp.asarray, batch(config, worlds, np.float32))
    started = time.perf_counter()
    compiled = jax.jit(run).lower(*arguments).compile()
    compile_seconds = time.perf_counter() - started
    result = jax.block_until_ready(compiled(*arguments))
    if not bool(jnp.isfinite(result.position).all()):
        raise RuntimeError("the benchmark's plant diverged")
    times, cpu = [], []
    for _ in range(REPEATS):
        started, busy = time.perf_counter(), time.process_time()
        jax.block_until_ready(compiled(*arguments))
        times.append(time.perf_counter() - started)
        cpu.append(time.process_time() - busy)
    steps = worlds * control_steps * config.timing.physics_steps
    return {
        "steps_per_second": steps / statistics.median(times),
        "steps_per_cpu_second": steps / statistics.median(cpu),
        "compile_seconds": compile_seconds,
    }


def time_mujoco(config: configs.Config, control_steps: int) -> dict[str, float]:
    """Steps/s of C MuJoCo through this package's Python loop, one world on one thread."""
    stepper = make_stepper(config, "mujoco")
    state, commands, load = batch(config, 1, np.float64)
    times = []
    for _ in range(REPEATS):
        started = time.perf_counter()
        moved = state
        for _ in range(control_steps):
            moved = stepper(moved, commands, load)
        times.append(time.perf_counter() - started)
    return {"steps_per_second": control_steps * config.timing.physics_steps / statistics.median(times)}


def time_mj_step(config: configs.Config, steps: int = 20_000) -> dict[str, float]:
    """Steps/s of bare `mj_step` on the fused model, one thread: MuJoCo's own ceiling here."""
    import mujoco

    from mjxball.assembly import build_model

    model = build_model(config.plant, config.physics_step, fuse=True)
    data = mujoco.MjData(model)
    times = []
    for _ in range(REPEATS):
        mujoco.mj_resetData(model, data)
        started = time.perf_counter()
        mujoco.mj_step(model, data, steps)
        times.append(time.perf_counter() - started)
    return {"steps_per_second": steps / statistics.median(times)}


def main() -> None:
    """Print the table and write JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--num-envs",
        "--worlds",
        dest="worlds",
        metavar="N",
        type=int,
        nargs="+",
        default=[256, 1024, 8192, 65536, 1048576],
    )
    parser.add_argument("--engines", nargs="+", choices=[*ENGINES, "mujoco"], default=[*ENGINES, "mujoco"])
    parser.add_argument("--loops", nargs="+", choices=LOOPS, default=list(LOOPS))
    parser.add_argument("--work", type=float, default=2e7, help="physics steps in a timed call, at most")
    parser.add_argument("--plants", nargs="+", choices=configs.PLANTS, default=["pair"])
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    plants = {name: plant_of(name) for name in options.plants}
    config = plants[options.plants[0]]
    device = jax.devices()[0].device_kind
    rows = []
    print(f"{device}, jax {jax.__version__}, float32, {config.physics_step * 1e3:g} ms steps")
    columns = f"{'M steps/s':>11} {'/CPU s':>9} {'compile s':>10}"
    print(f"{'plant':>10} {'engine':>14} {'loop':>9} {'worlds':>9} {columns}", flush=True)

    def report(plant: str, engine: str, loop: str, worlds: int, figures: dict[str, float]) -> None:
        rows.append({"plant": plant, "engine": engine, "loop": loop, "worlds": worlds, "device": device, **figures})
        compiled = f"{figures['compile_seconds']:10.2f}" if "compile_seconds" in figures else f"{'-':>10}"
        rate = figures["steps_per_second"] / 1e6
        busy = f"{figures['steps_per_cpu_second'] / 1e6:9.3f}" if "steps_per_cpu_second" in figures else f"{'-':>9}"
        print(f"{plant:>10} {engine:>14} {loop:>9} {worlds:>9} {rate:>11.3f} {busy} {compiled}", flush=True)

    for name in (engine for engine in options.engines if engine in ENGINES):
        for loop in options.loops:
            for worlds in options.worlds:
                for plant, setup in plants.items():
                    steps = max(2, min(500, int(options.work / worlds / setup.timing.physics_steps)))
                    report(plant, name, loop, worlds, time_jax(setup, name, worlds, steps, loop))
    if "mujoco" in options.engines:
        for plant, setup in plants.items():
            report(plant, "mujoco (ours)", "-", 1, time_mujoco(setup, 500))
            report(plant, "mj_step", "-", 1, time_mj_step(setup))
    if options.json:
        options.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    main()
