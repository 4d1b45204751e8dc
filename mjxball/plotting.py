"""Matplotlib as everything here uses it: without a window, one look for each follower, on light and dark pages."""

from __future__ import annotations

import io
import re
import zlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from mjxball.files import write_whole
from mjxball.pictures import COLOURS

BLUE, BROWN, GREEN, PINK, SKY, OLIVE = COLOURS
INK = "#757575"  # 4.6 : 1 on white, 4 : 1 on a dark page
MARKERS = dict(zip(COLOURS, "osD^vP", strict=True))
SOLID, DASH, DOT, DASH_DOT, DASH_DOT_DOT, LONG, SHORT = DASHES = tuple(
    (0, marks) for marks in (None, (5, 2), (1, 1.5), (5, 2, 1, 2), (5, 2, 1, 2, 1, 2), (12, 2), (2.5, 1))
)
# A row of dashes: followers in the order of COLOURS. What is often drawn together differs in colour, too.
TABLE = (
    (SOLID, ("stand", "flight", "balance", "universal", "sac", "flight-upgrade")),
    (DASH_DOT_DOT, ("", "robust", "", "transport", "flight-brushless", "paper")),
    (DASH, ("lqg-offset-free", "lqg-slow-known-rig", "lqg-known-failures", "lqg-known-rig", "lqg-slow", "lqg")),
    (DASH_DOT, ("mpc", "copy", "pid", "adaptive", "observer", "adaptive-mass")),
    (DOT, ("oracle", "", "memoryless", "", "random", "stay")),
)
LOOKS = {
    name: (colour, dash, MARKERS[colour])
    for dash, names in TABLE
    for colour, name in zip(COLOURS, names, strict=True)
    if name
}
# For all other names: dashes and markers that none of the table has. The first twelve differ without their markers.
FREE = tuple(
    (colour, (LONG, SHORT)[turn % 2], "X*hp<d"[(k + turn) % len(COLOURS)])
    for turn in range(len(COLOURS))
    for k, colour in enumerate(COLOURS)
)
SIMULATED = "the same, simulated"  # beside a flight that was flown

_COMMON = {"text.parse_math": False, "svg.fonttype": "none", "pdf.fonttype": 42, "legend.frameon": False}
_INKED = ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color", "grid.color")
_LETTERS = ("font.size", "axes.titlesize", "axes.labelsize", "legend.fontsize", "xtick.labelsize", "ytick.labelsize")
# The width is that of a figure with one column [in]; a screen's is readable on a phone.
STYLES: dict[str, dict[str, Any]] = {
    "screen": {
        **_COMMON,
        **dict.fromkeys(_INKED, INK),
        "figure.figsize": (4.5, 3.0),
        "savefig.format": "svg",
        "grid.alpha": 0.25,
    },
    "paper": {
        **_COMMON,
        **dict.fromkeys(_INKED, "black"),
        **dict.fromkeys(_LETTERS, 7),
        "figure.figsize": (3.5, 2.4),
        "savefig.format": "pdf",
        "grid.alpha": 0.2,
        "axes.linewidth": 0.6,
    },
}


@cache
def pyplot() -> Any:
    """Matplotlib's pyplot on the file-only backend. Dollars in a name are dollars, and begin no formula."""
    import matplotlib as mpl

    mpl.use("Agg")
    mpl.rcParams.update(STYLES["screen"])  # type: ignore[arg-type]
    import matplotlib.pyplot as plt

    return plt


def style(name: str) -> Any:
    """Context in which figures have the style `name` of `STYLES`."""
    return pyplot().rc_context(STYLES[name])


def file_format() -> str:
    """Of the figures of the style in force: svg or pdf."""
    return str(pyplot().rcParams["savefig.format"])


def follower_styles(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Colour, dash and marker of each follower of one figure, as arguments of `plot`.

    Those of `TABLE` are fixed. Another name has a place of `FREE` that no other name of the figure has, of the colours
    that are there least often the one that its checksum says. The colour of `copy`, which stands in most figures,
    counts as if it were there.
    """
    known = {name: LOOKS.get(re.sub(r"(, flown| \(FORCED\))*$", "", name)) for name in sorted(set(names))}
    drawn = [look for look in (LOOKS["copy"], *known.values()) if look]
    for name in (name for name, look in known.items() if look is None):
        place, times = zlib.crc32(name.encode()), Counter(look[:kept] for look in drawn for kept in (1, 2, 3))
        ranks = [
            (times[look], times[look[:2]], times[look[:1]], (k - place) % len(COLOURS), k // len(COLOURS))
            for k, look in enumerate(FREE)
        ]
        known[name] = own = FREE[ranks.index(min(ranks))]
        drawn.append(own)
    looks = {name: _arguments(*look) for name, look in known.items() if look}
    if SIMULATED in looks:
        looks = {name: {**look, "linewidth": 0.8} for name, look in looks.items()}
        looks[SIMULATED] = {"color": INK, "linewidth": 4.0, "alpha": 0.4, "zorder": 1.5, "marker": "none"}
    return looks


def series_styles(labels: Sequence[str]) -> dict[str, dict[str, Any]]:
    """The same for curves that are not of different followers, in order."""
    colours = [COLOURS[k % len(COLOURS)] for k in range(len(labels))]
    dashes = [DASHES[k % len(DASHES)] for k in range(len(labels))]
    looks = zip(labels, colours, dashes, strict=True)
    return {label: _arguments(colour, dash, MARKERS[colour]) for label, colour, dash in looks}


def _arguments(colour: str, dash: Any, marker: str) -> dict[str, Any]:
    return {"color": colour, "linestyle": dash, "linewidth": 1.2, "marker": marker}


def line(look: Mapping[str, Any]) -> dict[str, Any]:
    """`look` without its marker, for curves of many points."""
    return {**look, "marker": "none"}


def logarithmic(axes: Any, scale: str = "log", **given: Any) -> None:
    """Make y of `axes` logarithmic. Its ticks are plain numbers: Matplotlib's own are formulas, see `pyplot`."""
    from matplotlib.ticker import FuncFormatter, NullFormatter

    axes.set_yscale(scale, **given)
    ends = [abs(end) for end in axes.get_ylim() if end]
    if scale == "log" or min(axes.get_ylim()) * max(axes.get_ylim()) > 0:
        few = max(ends) < 50 * min(ends)  # then decades alone are hardly a tick
        axes.yaxis.get_major_locator().set_params(subs=(1.0, 2.0, 5.0) if few else (1.0,))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


def legend_above(figure: Any, axes: Iterable[Any], columns: int = 4, title: str | None = None) -> None:
    """One legend above the panels, off their curves, with every label of `axes` once."""
    handles: dict[str, Any] = {}
    for axis in axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    place: dict[str, Any] = {"loc": "outside upper center", "ncol": columns, "columnspacing": 1.2}
    long = 3.2  # so that dashes can be told apart
    figure.legend(handles.values(), handles, title=title, fontsize="small", handlelength=long, **place)


def rendered(figure: Any, ending: str | None = None) -> bytes:
    """The figure as a file of the format `ending`, without one of the style's; it is closed.

    SVG is transparent, with text as text. No date is in it, so that equal figures are equal files.
    """
    ending, stream = ending or file_format(), io.BytesIO()
    if ending == "svg":
        # Ids are drawn from the content, so that figures of one page do not share clip paths.
        figure.savefig(stream, format=ending, transparent=True, metadata={"Date": None, "Creator": None})
    elif ending == "pdf":
        figure.savefig(stream, format=ending, metadata={"CreationDate": None})
    else:
        figure.savefig(stream, format=ending, dpi=132)
    pyplot().close(figure)
    if ending != "svg":
        return stream.getvalue()
    text = stream.getvalue().decode()
    text = text[text.index("<svg") :].replace("<svg", '<svg role="img"', 1)
    return re.sub(r' d="[^"]*"', lambda path: re.sub(r"(\.\d\d)\d+", r"\1", path[0]), text).encode()


def save(figure: Any, path: Path) -> None:
    """Write the picture `path`, whole or not at all; its ending is the format. The figure is closed."""
    write_whole(path, rendered(figure, path.suffix.removeprefix(".")))
