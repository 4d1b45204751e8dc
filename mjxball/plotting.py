"""Matplotlib as everything here uses it: without a window."""

from __future__ import annotations

from typing import Any


def pyplot() -> Any:
    """Matplotlib's pyplot on the file-only backend. Dollars in a name are dollars, and begin no formula."""
    import matplotlib as mpl

    mpl.use("Agg")
    mpl.rcParams["text.parse_math"] = False
    import matplotlib.pyplot as plt

    return plt
