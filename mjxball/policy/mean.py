"""The mean of policies that were trained on from one start: its weights are the means of theirs."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from mjxball.errors import InputError
from mjxball.policy.file import PolicyFile

OF_ONE = ("seed", "curve", "population")  # what a card says of one training alone


def mean_policy(policies: Sequence[PolicyFile]) -> PolicyFile:
    """Means of the weights of `policies`, two or more of one shape that began as one policy.

    Further training on random flights ends each time a little beside the best weights; the mean of several ends is
    nearer to these (Wortsman et al. 2022, model soups). Policies that began apart have hidden units in another order,
    and their mean is none. Raises InputError for one policy alone, and unless layers and normalisation are the same.
    """
    if len(policies) < 2:
        raise InputError("a mean is of two policies or more, and there is one")
    first = policies[0]
    for other in policies[1:]:
        if [one.shape for one in _learned(other)] != [one.shape for one in _learned(first)]:
            raise InputError("the policies have other layers than each other, and no mean")
        for name in ("observation_mean", "observation_scale", "action_scale"):
            if not np.allclose(getattr(first, name), getattr(other, name), rtol=1e-5, atol=1e-7):
                raise InputError("the policies did not begin as one (train.py --start-from), and have no mean")
    card = {name: value for name, value in first.card.items() if name not in OF_ONE}
    seeds = [policy.card.get("seed") for policy in policies]
    return dataclasses.replace(
        first,
        weights=tuple(_mean([policy.weights[layer] for policy in policies]) for layer in range(len(first.weights))),
        biases=tuple(_mean([policy.biases[layer] for policy in policies]) for layer in range(len(first.biases))),
        gru=first.gru and tuple(_mean(list(same)) for same in zip(*(one.gru or () for one in policies), strict=True)),
        card={**card, "mean_of_seeds": seeds},
    )


def _learned(policy: PolicyFile) -> list[np.ndarray]:
    return [*policy.weights, *(policy.gru or ())]


def _mean(arrays: Sequence[np.ndarray]) -> np.ndarray:
    return np.mean(np.array(arrays, np.float64), axis=0).astype(np.float32)
