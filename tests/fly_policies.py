"""Support: policies of the Crazyflie presets that nobody trained: the leader's PD controller, copied."""

from __future__ import annotations

import dataclasses
import functools

import jax
import numpy as np
from conftest import policy_of

from mjxball import config as configs
from mjxball.algorithms import sac
from mjxball.algorithms.gradient import FirstOrderGradient
from mjxball.env import TransportEnv
from mjxball.policy import PolicyFile
from mjxball.policy.export import policy_file
from mjxball.sim.follower import network_interface
from mjxball.train.environments import Environments


@functools.cache
def untrained(preset: str) -> PolicyFile:
    """A policy file of `preset` from the exporter, its last layer zero: a residual policy then copies its leader."""
    config = configs.preset(preset)
    env = TransportEnv(config, "newton-euler")
    if config.follower.recurrent_units:
        algorithm = FirstOrderGradient(config, Environments(env, 3))
        network = algorithm.policy(algorithm.init(jax.random.key(0)))
    else:
        networks = sac.make_networks(config.sac, env.input_mask, env.action_size, env.critic_mask)
        network = policy_of(env, sac.create(networks, config.sac, env.observation_size, jax.random.key(0)))
    contents = policy_file(config, network_interface(config), network, steps=0)
    weights, biases = contents.weights, contents.biases
    last = np.zeros_like(weights[-1]), np.zeros_like(biases[-1])
    return dataclasses.replace(contents, weights=(*weights[:-1], last[0]), biases=(*biases[:-1], last[1]))
