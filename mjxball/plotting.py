"""Matplotlib figures: no window, fixed line styles of followers, styles for screen (light and dark) and paper."""

from __future__ import annotations

import io
import re
import zlib
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from mjxball.files import write_atomically
from mjxball.pictures import COLOURS

BLUE, BROWN, GREEN, PINK, SKY, OLIVE = COLOURS
INK = "#757575"  # 4.6 : 1 on white, 4 : 1 on a dark page
MARKERS = dict(zip(COLOURS, "osD^vP", strict=True))
SOLID, DASH, DOT, DASH_DOT, DASH_DOT_DOT, LONG, SHORT = DASHES = tuple(
    (0, marks) for marks in (None, (5, 2), (1, 1.5), (5, 2, 1, 2), (5, 2, 1, 2, 1, 2), (12, 2), (2.5, 1))
)
# For each dash the followers in the order of COLOURS. Followers that often share a figure differ in colour too.
TABLE = (
    (SOLID, ("stand", "flight", "balance", "universal", "balance-sac", "")),
    (DASH_DOT_DOT, ("lost", "robust", "", "transport-large", "", "paper")),
    (DASH, ("", "", "", "lqg-calm", "lqg-disturbed", "lqg")),
    (DASH_DOT, ("mpc", "copy", "pid", "adaptive", "observer", "adaptive-mass")),
    (DOT, ("oracle", "", "", "", "random", "stay")),
)
LOOKS = {
    name: (colour, dash, MARKERS[colour])
    for dash, names in TABLE
    for colour, name in zip(COLOURS, names, strict=True)
    if name
}
# Styles of other names: dashes and markers that are not in TABLE. The first twelve differ in colour or dash alone.
FREE = tuple(
    (colour, (LONG, SHORT)[turn % 2], "X*hp<d"[(k + turn) % len(COLOURS)])
    for turn in range(len(COLOURS))
    for k, colour in enumerate(COLOURS)
)
SIMULATED = "the same, simulated"  # label of the simulation beside a real flight

_COMMON = {"text.parse_math": False, "svg.fonttype": "none", "pdf.fonttype": 42, "legend.frameon": False}
_INKED = ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color", "grid.color")
_LETTERS = ("font.size", "axes.titlesize", "axes.labelsize", "legend.fontsize", "xtick.labelsize", "ytick.labelsize")
# Sizes are those of a figure with one column [in]; on screen it is readable on a phone.
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
    """Matplotlib's pyplot on the file-only backend. A dollar sign in a name does not start a formula."""
    import matplotlib as mpl

    mpl.use("Agg")
    mpl.rcParams.update(STYLES["screen"])  # type: ignore[arg-type]
    import matplotlib.pyplot as plt

    return plt


def style(name: str) -> Any:
    """Context in which figures have the style `name` of `STYLES`."""
    return pyplot().rc_context(STYLES[name])


def file_format() -> str:
    """File format of the current style: svg or pdf."""
    return str(pyplot().rcParams["savefig.format"])


def follower_styles(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Colour, dash and marker of each follower of one figure, as arguments of `plot`.

    Names in `TABLE` have fixed styles. Another name gets a style of `FREE` that is unused in the figure, in one of the
    colours that occur least often, chosen by the name's checksum. The colour of `copy`, which most figures contain,
    always counts as used.
    """
    looks = {name: LOOKS.get(re.sub(r"(, flown| \(FORCED\))*$", "", name)) for name in sorted(set(names))}
    used = [look for look in (LOOKS["copy"], *looks.values()) if look]
    for name in (name for name, look in looks.items() if look is None):
        checksum, times = zlib.crc32(name.encode()), Counter(look[:length] for look in used for length in (1, 2, 3))
        ranks = [
            (times[look], times[look[:2]], times[look[:1]], (k - checksum) % len(COLOURS), k // len(COLOURS))
            for k, look in enumerate(FREE)
        ]
        looks[name] = chosen = FREE[ranks.index(min(ranks))]
        used.append(chosen)
    styles = {name: _arguments(*look) for name, look in looks.items() if look}
    if SIMULATED in styles:
        styles = {name: {**given, "linewidth": 0.8} for name, given in styles.items()}
        styles[SIMULATED] = {"color": INK, "linewidth": 4.0, "alpha": 0.4, "zorder": 1.5, "marker": "none"}
    return styles


def series_styles(labels: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Arguments of `plot` for curves that do not stand for followers, by their order."""
    colours = [COLOURS[k % len(COLOURS)] for k in range(len(labels))]
    dashes = [DASHES[k % len(DASHES)] for k in range(len(labels))]
    looks = zip(labels, colours, dashes, strict=True)
    return {label: _arguments(colour, dash, MARKERS[colour]) for label, colour, dash in looks}


def _arguments(colour: str, dash: Any, marker: str) -> dict[str, Any]:
    return {"color": colour, "linestyle": dash, "linewidth": 1.2, "marker": marker}


def line(look: Mapping[str, Any]) -> dict[str, Any]:
    """`look` (arguments of `plot`) without its marker, for curves of many points."""
    return {**look, "marker": "none"}


def logarithmic(axes: Any, scale: str = "log", **given: Any) -> None:
    """Make the y-axis of `axes` logarithmic, with plain numbers as ticks, not Matplotlib's formulas (see `pyplot`)."""
    from matplotlib.ticker import FuncFormatter, NullFormatter

    axes.set_yscale(scale, **given)
    ends = [abs(end) for end in axes.get_ylim() if end]
    if scale == "log" or min(axes.get_ylim()) * max(axes.get_ylim()) > 0:
        few = max(ends) < 50 * min(ends)  # decades alone would give hardly any tick
        axes.yaxis.get_major_locator().set_params(subs=(1.0, 2.0, 5.0) if few else (1.0,))
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


def legend_above(figure: Any, axes: Iterable[Any], columns: int = 4, title: str | None = None) -> None:
    """Add one legend above the panels, outside their curves, with every label of `axes` once."""
    handles: dict[str, Any] = {}
    for axis in axes:
        for handle, label in zip(*axis.get_legend_handles_labels(), strict=True):
            handles.setdefault(label, handle)
    place: dict[str, Any] = {"loc": "outside upper center", "ncol": columns, "columnspacing": 1.2}
    long = 3.2  # so that dashes can be told apart
    figure.legend(handles.values(), handles, title=title, fontsize="small", handlelength=long, **place)


def rendered(figure: Any, ending: str | None = None) -> bytes:
    """Contents of a file of the format `ending` (default: the style's) with the figure, which is closed.

    SVG is transparent and keeps text as text. Files contain no date, so that equal figures are equal files.
    """
    ending, stream = ending or file_format(), io.BytesIO()
    if ending == "svg":
        # Ids are hashes of the content, so that figures on one page do not share clip paths.
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
    """Write the figure to `path` atomically, in the format of its suffix, and close it."""
    write_atomically(path, rendered(figure, path.suffix.removeprefix(".")))
