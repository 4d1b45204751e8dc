"""The shapes in signatures are those of the arrays, in every call of a training step and of flights.

Modules import `jaxtyping` for type checkers alone; here they are loaded as a type checker reads them.
"""

from __future__ import annotations

import functools
import inspect
import types
import typing
from collections.abc import Callable
from typing import Any

import jaxtyping
import pytest
from command_line import REPOSITORY, run

pytestmark = pytest.mark.slow

CHECKED = ("physics", "sim", "algorithms", "env", "rewards", "train.program")


def check(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function`, which raises TypeError if an array that it is given or returns has another shape or dtype."""
    signature = inspect.signature(function)

    @functools.wraps(function)
    def checked(*arguments: Any, **named: Any) -> Any:
        hints = typing.get_type_hints(function)
        for name, value in signature.bind(*arguments, **named).arguments.items():
            verify(value, hints.get(name), f"{name} of {function.__qualname__}")
        result = function(*arguments, **named)
        verify(result, hints.get("return"), f"result of {function.__qualname__}")
        return result

    return checked


def verify(value: Any, hint: Any, where: str) -> None:
    """Raise TypeError unless arrays in `value` are as `hint` says; of other types nothing is asked."""
    parts = typing.get_args(hint)
    if isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union:
        plain = tuple(part for part in parts if isinstance(part, type) and part is not Any)
        whole = float in parts and isinstance(value, int)
        if any(map(is_array, parts)) and not (Any in parts or whole or isinstance(value, plain)):
            raise TypeError(f"{where} is {told(value)}, not {hint}")
    elif typing.get_origin(hint) is tuple:
        hints = parts[:1] * len(value) if Ellipsis in parts else parts
        for number, (one, part) in enumerate(zip(value, hints, strict=True)):
            verify(one, part, f"{where}[{number}]")
    elif is_array(hint):
        if not isinstance(value, hint):
            raise TypeError(f"{where} is {told(value)}, not {hint.__name__}")
    elif hasattr(hint, "_fields") and isinstance(value, hint):
        hints = typing.get_type_hints(hint)
        absent = {name for name, default in hint._field_defaults.items() if default is None}
        for name in hint._fields:
            if not (name in absent and getattr(value, name) is None):
                verify(getattr(value, name), hints[name], f"{where}.{name}")


def told(value: Any) -> str:
    return f"{value.dtype}{list(value.shape)}" if hasattr(value, "shape") else repr(value)


def is_array(hint: Any) -> bool:
    return isinstance(hint, type) and issubclass(hint, jaxtyping.AbstractArray)


PROGRAM = """
import sys, typing
import brax.envs.base, jax, jaxtyping, mujoco.mjx, optax, scipy.interpolate  # their own are not meant
sys.path[:0] = ["tests", "benchmarks"]
import test_shapes
typing.TYPE_CHECKING = True
packages = ["batch", *(f"mjxball.{name}" for name in %r)]
with jaxtyping.install_import_hook(packages, "test_shapes.check"):
    import batch, mjxball.env, mjxball.physics.step, mjxball.train.program
typing.TYPE_CHECKING = False
%s
print("done")
"""
TRAINING = """
import jax
from conftest import with_settings
from mjxball import config
from mjxball.train.program import TrainingProgram, train_mode
for preset, physics in (("balance", "mjx"), ("flight", "newton-euler"), ("paper", "newton-euler")):
    small = {"num_envs": 8, "batch_size": 8, "replay_size": 8000}
    settings = with_settings(config.preset(preset), sac=small, follower={"recurrent_units": 0})
    program = TrainingProgram(settings, physics)
    state = jax.eval_shape(program.create, jax.random.key(0))
    jax.eval_shape(program.advance, state, train_mode(1))
"""
FLIGHTS = """
import dataclasses
from mjxball import config
from mjxball.baselines import make_baseline
from batch import fly_compiled
from mjxball.sim.disturbances import Disturbance
from mjxball.sim.rollout import simulate_batch
from mjxball.sim.scenario import Scenario
settings = config.preset("paper")
noisy = dict(noise=1.0, delay=0.04, gust=0.1, estimator_drift=1.0, quantize=True)
disturbed = Disturbance(**noisy, gap_rate=0.5, jitter=0.01, offset=1.0, pose_lag=0.02)
flown = [Scenario(seconds=0.1), Scenario(seconds=0.1, disturbance=disturbed, mass_changes=((0.05, 0.1),))]
follower = make_baseline("copy", settings)
fly_compiled(settings, follower, flown)
for physics in ("newton-euler", "mujoco"):
    simulate_batch(settings, [(follower, flown)], physics)
"""


def test_shapes_of_training_steps_and_flights() -> None:
    done = run(["-c", PROGRAM % (CHECKED, TRAINING + FLIGHTS)], REPOSITORY)
    assert done.stdout.endswith("done\n"), done.stderr[-3000:]
