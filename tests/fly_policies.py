"""Support: policies of the Crazyflie presets that nobody trained: the leader's PD controller, copied."""

from __future__ import annotations

import dataclasses
import functools

import jax
import numpy as np
from conftest import policy_of

from mjxball import config as configs
from mjxball.algorithms import sac
from mjxball.env import TransportEnv
from mjxball.policy import PolicyFile
from mjxball.policy.export import policy_file
from mjxball.sim.follower import network_interface


@functools.cache
def untrained(preset: str) -> PolicyFile:
    """A policy file of `preset` from the exporter, its last layer zero: a residual policy then copies its leader."""
    config = configs.preset(preset)
    env = TransportEnv(config, "newton-euler")
    networks = sac.make_networks(config.sac, env.input_mask, env.action_size, env.critic_mask)
    learner = sac.create(networks, config.sac, env.observation_size, jax.random.key(0))
    contents = policy_file(config, network_interface(config), policy_of(env, learner), steps=0)
    weights, biases = contents.weights, contents.biases
    last = np.zeros_like(weights[-1]), np.zeros_like(biases[-1])
    return dataclasses.replace(contents, weights=(*weights[:-1], last[0]), biases=(*biases[:-1], last[1]))
