"""What a training takes at the least, from its settings alone; what cannot fit is refused before it compiles.

Lower bounds: nothing that would work is refused. What they leave out (temporary arrays, other programs) is noticed
later, see `mjxball.xla.explained`.
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

NUMBER = 4  # [B] of one number
STATE = 100  # numbers of an environment: two drones, a load, what the follower remembers
ROW = 2 * OBSERVATION_SIZE + ACTION_SIZE + 3  # numbers of a recorded step
COPIES = 2  # of the whole state: it trains on while a checkpoint of it is written
PROGRAM = 0.5e9  # [B] of compiling and running the smallest training, beyond what imports have taken
MOST_STEPS = 2**31 - 1  # environment steps are counted in 32 bits


class Required(NamedTuple):
    """At the least, for all members."""

    memory: float  # [B] on all devices together
    steps: int  # environment steps of each member


def required(config: Config, algorithm: str, members: int) -> Required:
    """What `members` followers take, trained by `sac`, `ppo` or `gradient`."""
    of = {"sac": _sac, "ppo": _ppo, "gradient": _gradient}[algorithm]
    steps, state, data = of(config)
    return Required(NUMBER * members * (COPIES * state + data), steps)


def _weights(inputs: int, layers: Sequence[int], outputs: int) -> int:
    return sum(a * b + b for a, b in itertools.pairwise((inputs, *layers, outputs)))


def _policy(config: Config, layers: Sequence[int]) -> int:
    """Weights of a policy, whose GRU's state the first and the last layer see as well."""
    units, outputs = config.follower.recurrent_units, 2 * ACTION_SIZE
    gru = 3 * units * (OBSERVATION_SIZE + units + 1)
    return gru + _weights(OBSERVATION_SIZE + units, layers, outputs) + units * outputs


# Each: environment steps, numbers of the state, of other arrays.
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
    kept = sum(gradient.policy_layers) + 4 * config.follower.recurrent_units + STATE  # of every step, for the way back
    data = gradient.num_envs * gradient.horizon
    return gradient.gradient_steps * data, 3 * policy + gradient.num_envs * STATE, data * kept


def check(config: Config, algorithm: str, members: int) -> None:
    """Refuse by InputError, with the numbers, what this computer's memory or 32 bits do not hold."""
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
    """Names of the settings that make a run large."""
    own = getattr(config, algorithm)
    names = ("num_envs", "replay_size", "batch_size", "horizon", "unroll_length", "policy_layers", "critic_layers")
    return ", ".join(f"{algorithm}.{name}" for name in names if hasattr(own, name)) + " or --num-seeds"


def room_for_arrays() -> tuple[float, str]:
    """Memory for arrays on JAX's devices [B], and where."""
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
    """What the kernel would give without ending programs, swap included [B]."""
    found = {line.split(":")[0]: line.split()[1] for line in _lines(Path("/proc/meminfo"))}
    known = [float(found[name]) * 1024 for name in ("MemAvailable", "SwapFree") if name in found]
    return sum(known) if "MemAvailable" in found else float("inf")


def _left_of_group() -> float:
    """What a container or a job of a cluster may still take [B]."""
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
