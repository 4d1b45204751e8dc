"""Quantisation of weights to 8-bit integers, with one scale (`step`) per output. Needs NumPy only."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from mjxball.policy.file import PolicyFile

MAX_INT8 = 127


class Rows(NamedTuple):
    """One quantised layer, whose weights are approximately `step[:, None] * weight`."""

    weight: np.ndarray  # (outputs, inputs) int8
    step: np.ndarray  # (outputs,) float32


def rows_of(weight: np.ndarray) -> Rows:
    """The layer `weight` (inputs, outputs) quantised such that the largest weight of each output is 127 steps."""
    rows = np.asarray(weight, np.float32).T
    step = np.abs(rows).max(axis=1) / np.float32(MAX_INT8)
    rounded = np.rint(rows / np.where(step > 0, step, 1)[:, None])
    return Rows(rounded.astype(np.int8), step.astype(np.float32))


def balanced(policy: PolicyFile) -> PolicyFile:
    """`policy` with the same outputs, but input weights of similar size for all inputs, for less quantisation error.

    The inputs, which have 16 bits on board, are scaled by powers of two to compensate. Weights of unused inputs are 0.
    """
    size, used = len(policy.observation_mean), policy.observation_scale > 0
    first = policy.weights[0] if policy.gru is None else policy.gru[0]
    rms = np.sqrt(np.mean(np.square(first[-size:], dtype=float), axis=1))
    factor = np.exp2(np.rint(np.log2(np.where(used & (rms > 0), rms, 1.0)))).astype(np.float32)

    def rescaled(weight: np.ndarray) -> np.ndarray:
        return np.concatenate([weight[:-size], weight[-size:] * (used / factor)[:, None]]).astype(np.float32)

    weights, scale = (rescaled(policy.weights[0]), *policy.weights[1:]), policy.observation_scale * factor
    gru = policy.gru and (rescaled(policy.gru[0]), *policy.gru[1:])
    return dataclasses.replace(policy, weights=weights, observation_scale=scale, gru=gru)


def quantized(policy: PolicyFile) -> PolicyFile:
    """`policy` with the weights of its 8-bit export as floats: it flies like the export, except for activations."""
    policy = balanced(policy)

    def rounded(weight: np.ndarray) -> np.ndarray:
        rows = rows_of(weight)
        return (rows.weight * rows.step[:, None]).T

    gru = policy.gru and (rounded(policy.gru[0]), rounded(policy.gru[1]), policy.gru[2])
    return dataclasses.replace(policy, weights=tuple(map(rounded, policy.weights)), gru=gru)
