"""Training: runs of `train.py` with any algorithm, and `train(config, key)`, the same as a pure function."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mjxball.train.functional import train

__all__ = ["train"]


def __getattr__(name: str) -> Any:
    """Import `train`, and JAX with it, on first use."""
    if name != "train":
        raise AttributeError(f"module 'mjxball.train' has no attribute {name!r}")
    from mjxball.train.functional import train

    return train
