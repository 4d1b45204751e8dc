"""Covariance matrix adaptation, CMA-ES (Hansen 2016): the search of `tuning.py`."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np

SEED = 1007


def minimise(
    cost: Callable[[np.ndarray], np.ndarray], start: np.ndarray, width: float, sets: int, rounds: int
) -> tuple[np.ndarray, float]:
    """(point (k,), its cost) where `cost` of points (S, k) is least, found by CMA-ES about `start` (k,)."""
    k, random = len(start), np.random.default_rng(SEED)
    weights = np.log(sets / 2 + 0.5) - np.log(np.arange(1, sets // 2 + 1))
    weights /= weights.sum()
    mu = 1 / (weights**2).sum()
    c_path, c_width = (4 + mu / k) / (k + 4 + 2 * mu / k), (mu + 2) / (k + mu + 5)
    c_one = 2 / ((k + 1.3) ** 2 + mu)
    c_mu = min(1 - c_one, 2 * (mu - 2 + 1 / mu) / ((k + 2) ** 2 + mu))
    damping = 1 + 2 * max(0.0, math.sqrt((mu - 1) / (k + 1)) - 1) + c_width
    length = math.sqrt(k) * (1 - 1 / (4 * k) + 1 / (21 * k * k))
    mean, covariance, path, width_path = start.copy(), np.eye(k), np.zeros(k), np.zeros(k)
    best, least, begun = start, math.inf, time.perf_counter()
    for number in range(rounds):
        values, axes = np.linalg.eigh(covariance)
        root = axes * np.sqrt(np.maximum(values, 1e-20))
        steps = random.standard_normal((sets, k)) @ root.T
        found = cost(mean + width * steps)
        order = np.argsort(found)
        if found[order[0]] < least:
            best, least = mean + width * steps[order[0]], float(found[order[0]])
        step = weights @ steps[order[: len(weights)]]
        mean = mean + width * step
        white = axes @ ((axes.T @ step) / np.sqrt(np.maximum(values, 1e-20)))
        width_path = (1 - c_width) * width_path + math.sqrt(c_width * (2 - c_width) * mu) * white
        path = (1 - c_path) * path + math.sqrt(c_path * (2 - c_path) * mu) * step
        chosen = steps[order[: len(weights)]]
        covariance = (1 - c_one - c_mu) * covariance + c_one * np.outer(path, path)
        covariance += c_mu * (chosen.T * weights) @ chosen
        width *= math.exp(c_width / damping * (np.linalg.norm(width_path) / length - 1))
        seconds = time.perf_counter() - begun
        print(
            f"{seconds:.0f} s, round {number + 1}: {least:.3f} median {np.median(found):.3f} width {width:.3f}",
            flush=True,
        )
    return best, least
