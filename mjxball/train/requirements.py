"""Lower bounds of a training's memory and steps from its settings, to refuse before compilation what cannot run.

As lower bounds they refuse nothing that would work. They omit temporary arrays and other programs; if memory runs out
later, `mjxball.xla.explained` reports it.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax

from mjxball.config import Config
from mjxball.control.observation import ACTION_SIZE, OBSERVATION_SIZE
from mjxball.errors import InputError
from mjxball.xla import room_in_address_space

NUMBER = 4  # size of a float32 [B]
STATE = 100  # floats of an environment's state: two drones, a load, the follower's memory
ROW = 2 * OBSERVATION_SIZE + ACTION_SIZE + 3  # floats of a recorded step
COPIES = 2  # of the whole state: training continues while a checkpoint is written
PROGRAM = 0.5e9  # memory to compile and run the smallest training, beyond that of imports [B]
MOST_STEPS = 2**31 - 1  # environment steps are counted in 32 bits


class Required(NamedTuple):
    """Lower bounds for a training."""

    memory: float  # of all members, on all devices together [B]
    steps: int  # environment steps of each member


def required(config: Config, algorithm: str, members: int) -> Required:
    """Lower bounds for `members` followers trained by `sac`, `ppo` or `gradient`."""
    sizes = {"sac": _sac, "ppo": _ppo, "gradient": _gradient}[algorithm]
    steps, state, data = sizes(config)
    return Required(NUMBER * members * (COPIES * state + data), steps)


def _weights(inputs: int, layers: Sequence[int], outputs: int) -> int:
    return sum(a * b + b for a, b in itertools.pairwise((inputs, *layers, outputs)))


def _policy(config: Config, layers: Sequence[int]) -> int:
    """Number of weights of a policy. Its first and last layer also take the GRU's state."""
    units, outputs = config.follower.recurrent_units, 2 * ACTION_SIZE
    gru = 3 * units * (OBSERVATION_SIZE + units + 1)
    return gru + _weights(OBSERVATION_SIZE + units, layers, outputs) + units * outputs


# (environment steps, floats of the state, floats of other arrays)
_Sizes = tuple[int, float, float]


def _sac(config: Config) -> _Sizes:
    sac = config.sac
    policy = _policy(config, sac.policy_layers)
    critics = sac.num_critics * _weights(OBSERVATION_SIZE + ACTION_SIZE, sac.critic_layers, 1)
    row = ROW + 2 * config.follower.recurrent_units
    state = 4 * policy + 4 * critics + (sac.replay_size + sac.num_envs) * row + sac.num_envs * STATE
    return sac.total_steps, state, sac.updates_per_step * sac.batch_size * row


def _ppo(config: Config) -> _Sizes:
    from mjxball.algorithms.ppo import VALUE_LAYERS  # with Brax

    ppo = config.ppo
    policy, value = _policy(config, ppo.policy_layers), _policy(config, VALUE_LAYERS)
    data = ppo.num_envs * ppo.unroll_length * (ROW + 2 * config.follower.recurrent_units)
    return ppo.total_steps, 3 * (policy + value) + ppo.num_envs * STATE, data


def _gradient(config: Config) -> _Sizes:
    gradient = config.gradient
    policy = _policy(config, gradient.policy_layers)
    stored = sum(gradient.policy_layers) + 4 * config.follower.recurrent_units + STATE  # per step, for backpropagation
    data = gradient.num_envs * gradient.horizon
    return gradient.gradient_steps * data, 3 * policy + gradient.num_envs * STATE, data * stored


def check(config: Config, algorithm: str, members: int) -> None:
    """Raise InputError if the training needs more memory than is free, or more steps than 32 bits can count."""
    needs = required(config, algorithm, members)
    if needs.steps > MOST_STEPS:
        raise InputError(f"the run has {needs.steps:.3g} environment steps, and {MOST_STEPS:.3g} can be counted")
    room, where = room_for_arrays()
    if needs.memory > room:
        raise InputError(
            f"the run needs at least {needs.memory / 1e9:.3g} GB of memory, and {room / 1e9:.3g} GB are free {where}; "
            f"make {_largest(config, algorithm)} smaller"
        )


def _largest(config: Config, algorithm: str) -> str:
    """Names of the settings on which the memory of a run depends most, for an error message."""
    settings = getattr(config, algorithm)
    names = ("num_envs", "replay_size", "batch_size", "horizon", "unroll_length", "policy_layers", "critic_layers")
    return ", ".join(f"{algorithm}.{name}" for name in names if hasattr(settings, name)) + " or --num-seeds"


def room_for_arrays() -> tuple[float, str]:
    """(free memory for arrays on JAX's devices [B], phrase that says what limits it)."""
    devices: list[Any] = jax.local_devices()
    limits = [(device.memory_stats() or {}).get("bytes_limit") for device in devices]
    if devices[0].platform != "cpu":
        known = sum(filter(None, limits)) * max(jax.device_count() // len(devices), 1)
        return (known, f"on {jax.device_count()} x {devices[0].device_kind}") if known else (float("inf"), "")
    rooms = {"on this computer": _available(), "in its control group": _left_of_group()}
    rooms["below the limit of ulimit -v"] = room_in_address_space()
    where = min(rooms, key=lambda name: rooms[name])
    return max(rooms[where] - PROGRAM, 0.0) * jax.process_count(), where


def _available() -> float:
    """Available memory of the machine, swap included [B]; infinite if unknown."""
    table = {line.split(":")[0]: line.split()[1] for line in _lines(Path("/proc/meminfo"))}
    known = [float(table[name]) * 1024 for name in ("MemAvailable", "SwapFree") if name in table]
    return sum(known) if "MemAvailable" in table else float("inf")


def _left_of_group() -> float:
    """Memory left in the process's control group, of a container or a cluster's job [B]; infinite without a limit."""
    least = float("inf")
    for folder, limit, used in (
        (Path("/sys/fs/cgroup"), "memory.max", "memory.current"),
        (Path("/sys/fs/cgroup/memory"), "memory.limit_in_bytes", "memory.usage_in_bytes"),
    ):
        numbers = [line for name in (limit, used) for line in _lines(folder / name)]
        if len(numbers) == 2 and all(number.isdecimal() for number in numbers):
            cached = [line.split()[1] for line in _lines(folder / "memory.stat") if line.startswith("inactive_file ")]
            least = min(least, float(numbers[0]) - float(numbers[1]) + sum(map(float, cached)))
    return least


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text(encoding="ascii").split("\n")[:-1]
    except (OSError, UnicodeDecodeError):
        return []
