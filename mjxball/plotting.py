"""Matplotlib as everything here uses it: without a window."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from mjxball.files import write_whole


def pyplot() -> Any:
    """Matplotlib's pyplot on the file-only backend. Dollars in a name are dollars, and begin no formula."""
    import matplotlib as mpl

    mpl.use("Agg")
    mpl.rcParams["text.parse_math"] = False
    import matplotlib.pyplot as plt

    return plt


def logarithmic(axes: Any, scale: str = "log", **given: Any) -> None:
    """Make y of `axes` logarithmic. Its ticks are plain numbers: Matplotlib's own are formulas, see `pyplot`."""
    from matplotlib.ticker import FuncFormatter, NullFormatter

    axes.set_yscale(scale, **given)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


def save(figure: Any, path: Path) -> None:
    """Write the picture `path`, whole or not at all; its ending is the format."""
    stream = io.BytesIO()
    figure.savefig(stream, format=path.suffix.removeprefix("."), dpi=110)
    write_whole(path, stream.getvalue())
