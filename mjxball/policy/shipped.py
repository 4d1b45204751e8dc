"""Where the policies that come with mjxball are."""

from __future__ import annotations

from pathlib import Path


def shipped_policies() -> list[Path]:
    """Policy files of the source tree's `policies/`, by name; empty if there is none."""
    return sorted((Path(__file__).parents[2] / "policies").glob("*.npz"))


def stand_policies() -> list[Path]:
    """Policy files that were made for the paper's test stand: they fly nowhere else."""
    return sorted((Path(__file__).parents[2] / "policies" / "stand").glob("*.npz"))
