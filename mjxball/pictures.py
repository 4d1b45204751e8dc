"""Small SVG figures for notebooks and pages, without dependencies: curves, and the plan view of a rig."""

from __future__ import annotations

import html
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

# Palette of all figures: distinct with protanopia and deuteranopia, contrast at least 3 : 1 on white and dark pages.
COLOURS = ("#1f5aff", "#98623a", "#318174", "#ff0f87", "#469ab9", "#b28f00")
MOST_POINTS = 400  # of a curve
SMALL = 'font-size="11" fill="currentColor"'


class Curve(NamedTuple):
    """A line, or with `dots` separate points."""

    name: str
    x: Any  # sequences or arrays of numbers
    y: Any
    dots: bool = False


def curves(shown: Sequence[Curve], x_label: str, y_label: str, width: int = 480, height: int = 170) -> str:
    """SVG of curves over common axes. Points that are not finite are left out."""
    lines = [(one, [(x, y) for x, y in _thinned(one) if math.isfinite(x) and math.isfinite(y)]) for one in shown]
    points = [point for _, line in lines for point in line] or [(0.0, 0.0)]
    (left, right), (low, high) = (_range(values) for values in zip(*points, strict=True))

    def place(point: tuple[float, float]) -> tuple[float, float]:
        x, y = (point[0] - left) / (right - left), (point[1] - low) / (high - low)
        return 64 + (width - 74) * x, height - 34 - (height - 56) * y

    parts = [f'<rect x="64" y="22" width="{width - 74}" height="{height - 56}" fill="none" stroke="#9a9a9a"/>']
    for number, (one, line) in enumerate(lines):
        colour = COLOURS[number % len(COLOURS)]
        at = [f"{x:.1f},{y:.1f}" for x, y in map(place, line)]
        if one.dots:
            spots = (place(point) for point in line)
            parts += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{colour}"/>' for x, y in spots]
        else:
            parts.append(f'<polyline points="{" ".join(at)}" fill="none" stroke="{colour}" stroke-width="1.3"/>')
        named = html.escape(one.name)
        parts.append(f'<text x="{64 + 110 * number}" y="15" font-size="11" fill="{colour}">{named}</text>')
    for text, x, y, anchor in (
        (f"{left:.4g}", 64, height - 20, "start"),
        (f"{right:.4g}", width - 10, height - 20, "end"),
        (x_label, (width + 54) / 2, height - 20, "middle"),
        (f"{high:.3g}", 60, 30, "end"),
        (f"{low:.3g}", 60, height - 34, "end"),
        (y_label, 4, height - 4, "start"),
    ):
        parts.append(f'<text x="{x}" y="{y}" text-anchor="{anchor}" {SMALL}>{html.escape(text)}</text>')
    return _svg(width, height, parts)


def plan(
    mounts: Iterable[Sequence[float]],
    leader: int,
    arms: Sequence[float],
    edges: Sequence[float],
    held: Sequence[float] = (),
) -> str:
    """SVG of a rig from above, x to the right: its box, and a circle of the radius `arms` for each drone [m].

    The leader's circle is filled. With `held`, for a page, drones are numbered, there is a scale bar, and an ellipse
    with these half axes (x, y) shows where the load's CG may rest [m].
    """
    places = [(float(mount[0]), float(mount[1])) for mount in mounts]
    reach = max([*(max(abs(x), abs(y)) + arm for (x, y), arm in zip(places, arms, strict=True)), *edges[:2], 1e-9])
    size = 480.0 if held else 150.0
    scale = 0.46 * size / reach

    def at(x: float, y: float) -> tuple[float, float]:
        return size / 2 + scale * x, size / 2 - scale * y

    x, y = at(-edges[0] / 2, edges[1] / 2)
    box = f'width="{scale * edges[0]:.1f}" height="{scale * edges[1]:.1f}"'
    parts = [f'<rect x="{x:.1f}" y="{y:.1f}" {box} fill="#9a9a9a" fill-opacity="0.35" stroke="#9a9a9a"/>']
    for number, ((x, y), arm) in enumerate(zip(places, arms, strict=True)):
        cx, cy = at(x, y)
        look = f'fill="{COLOURS[0]}" fill-opacity="{0.6 if number == leader else 0.1}" stroke="{COLOURS[0]}"'
        parts.append(f'<circle cx="{cx:.1f}" cy="{cy:.1f}" r="{scale * arm:.1f}" {look}/>')
        if held:
            called = f"{number} leads" if number == leader else str(number)
            above = cy - scale * arm - 6
            parts.append(f'<text x="{cx:.1f}" y="{above:.1f}" text-anchor="middle" {SMALL}>{called}</text>')
    if not held:
        return _svg(int(size), int(size), parts)
    rx, ry = (max(scale * half, 1.5) for half in held)
    middle, look = size / 2, f'fill="{COLOURS[1]}" fill-opacity="0.5"'
    parts.append(f'<ellipse cx="{middle:.1f}" cy="{middle:.1f}" rx="{rx:.1f}" ry="{ry:.1f}" {look}/>')
    length = 10.0 ** math.floor(math.log10(0.5 * reach))
    foot = f"the CG may rest within {max(held):.3g} m of O, brown"
    parts += [
        f'<path d="M10 {size + 14:.0f} h{scale * length:.1f}" stroke="{COLOURS[0]}" stroke-width="2"/>',
        f'<text x="10" y="{size + 30:.0f}" {SMALL}>{length:g} m</text>',
        f'<text x="{size - 10:.0f}" y="{size + 30:.0f}" text-anchor="end" {SMALL}>{foot}</text>',
    ]
    return _svg(int(size), int(size) + 40, parts)


def summary(title: str, facts: Mapping[str, object], picture: str = "") -> str:
    """HTML of a title, `facts` as lines of name and value, and an SVG `picture`."""
    rows = "".join(
        f"<div><b>{html.escape(str(name))}</b> {html.escape(str(value))}</div>" for name, value in facts.items()
    )
    head = f"<div><b>{html.escape(title)}</b></div>"
    return f'<div style="font: 13px sans-serif">{head}{rows}{picture}</div>'


def _svg(width: int, height: int, parts: Sequence[str]) -> str:
    size = f'width="{width}" height="{height}" viewBox="0 0 {width} {height}"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {size} font-family="sans-serif">{"".join(parts)}</svg>'


def _thinned(curve: Curve) -> list[tuple[float, float]]:
    """At most `MOST_POINTS` points of `curve`, evenly spaced in its index."""
    step = max(1, math.ceil(len(curve.x) / MOST_POINTS))
    return [(float(x), float(y)) for x, y in zip(curve.x[::step], curve.y[::step], strict=True)]


def _range(values: Sequence[float]) -> tuple[float, float]:
    low, high = min(values), max(values)
    return (low, high) if high > low else (low - 0.5, high + 0.5)
