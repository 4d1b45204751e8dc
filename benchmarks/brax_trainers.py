"""Brax's own PPO and SAC on `mjxball.env.TransportEnv`: JAX has removed a function that both call."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from mjxball.errors import InputError
from mjxball.quiet import import_brax_env

AGENTS = ("ppo", "sac")


def brax_trainer(agent: str) -> Callable[..., Any]:
    """`train` of `brax.training.agents.<agent>.train`, ppo or sac, with Brax's arguments.

    Gives JAX `jax.device_put_replicated` back, for the whole process, if it is missing. The returned function raises
    InputError for `randomization_fn`, which changes a `sys` that only Brax's own environments have.
    """
    if agent not in AGENTS:
        raise InputError(f"Brax's trainer must be one of {', '.join(AGENTS)}, not {agent!r}")
    if not hasattr(jax, "device_put_replicated"):
        setattr(jax, "device_put_replicated", _replicated)  # noqa: B010
    import_brax_env()
    brax_train = importlib.import_module(f"brax.training.agents.{agent}.train").train

    def train(environment: Any, **settings: Any) -> Any:
        if settings.get("randomization_fn") is not None:
            raise InputError("randomization_fn changes Brax's sys; here every reset draws a world from config.scenario")
        return brax_train(environment, **settings)

    return train


def _replicated(tree: Any, devices: Sequence[Any]) -> Any:
    """A copy for every device along a new leading axis."""
    return jax.tree.map(lambda leaf: jnp.stack([jnp.asarray(leaf)] * len(devices)), tree)
