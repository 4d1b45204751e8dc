"""The shipped policy for any rig with the law as it is made now, or as older files have it."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence

import numpy as np

from mjxball.baselines.multi_model_lqg import MODELS, multi_model_lqg
from mjxball.config import preset
from mjxball.control.multi_model_lqg import MultiModelLqg
from mjxball.policy import PolicyFile, load_file
from mjxball.policy.export import _numbers
from mjxball.policy.file import law_of, shipped_policy
from mjxball.policy.law_fields import LATER_SHAPES, SWING_SHAPES

OLDEST = {*LATER_SHAPES, *SWING_SHAPES}  # what the first files do not have


def with_law(without: Collection[str] = (), models: Sequence[tuple[float, float]] = MODELS) -> PolicyFile:
    """The shipped network with the law as it is made now, `without` fields that older files do not have."""
    universal, lqg = load_file(shipped_policy("universal")), _numbers(multi_model_lqg(preset("universal"), models))
    card = {**universal.card, "lqg": {name: value for name, value in lqg.items() if name not in without}}
    size = 18 + law_of(card).shown

    def fitting(numbers: np.ndarray) -> np.ndarray:
        return np.resize(numbers, (size, *numbers.shape[1:]))  # what swings add is the last that a network sees

    return dataclasses.replace(
        universal,
        weights=(fitting(universal.weights[0]), *universal.weights[1:]),
        observation_mean=fitting(universal.observation_mean),
        observation_scale=fitting(universal.observation_scale),
        card=card,
    )


def still(law: MultiModelLqg) -> MultiModelLqg:
    """`law` as files have it that know nothing of swings."""
    return law._replace(**{name: MultiModelLqg._field_defaults[name] for name in SWING_SHAPES})
