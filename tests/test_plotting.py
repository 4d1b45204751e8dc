"""Pictures: one look for each follower that colour-blind readers can tell apart, text, pages of both colours, PDF."""

from __future__ import annotations

import itertools
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from mjxball.baselines import CONTROLLERS
from mjxball.plotting import (
    COLOURS,
    FREE,
    GREEN,
    INK,
    LOOKS,
    SIMULATED,
    follower_styles,
    logarithmic,
    pyplot,
    rendered,
    save,
    series_styles,
    style,
)
from mjxball.policy.file import shipped_policies
from mjxball.view.page import AXES, DRONES, PARTS, SCENE

# Of linear RGB, severity 1: Machado, Oliveira and Fernandes, "A physiologically-based model for simulation of color
# vision deficiency", 2009, https://doi.org/10.1109/TVCG.2009.113.
SIGHT = {
    "normal": np.eye(3),
    "protanopia": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
    "deuteranopia": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
}
XYZ = np.array(
    [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]
)
LEAST = 14.0  # CIEDE2000 of two colours; 2 are hardly seen side by side
PAGES = ("#ffffff", "#131416")  # of the documentation, light and dark


def linear(colour: str) -> np.ndarray:
    """(3,) sRGB without its gamma."""
    shown = np.array([int(colour[k : k + 2], 16) / 255 for k in (1, 3, 5)])
    return np.where(shown <= 0.04045, shown / 12.92, ((shown + 0.055) / 1.055) ** 2.4)


def lab(colour: str, sight: str) -> np.ndarray:
    """(3,) CIELAB under D65 of what is seen."""
    seen = XYZ @ np.clip(np.array(SIGHT[sight]) @ linear(colour), 0, 1) / (XYZ @ np.ones(3))
    f = np.where(seen > (6 / 29) ** 3, np.cbrt(seen), seen / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def ciede2000(one: np.ndarray, other: np.ndarray) -> float:
    """Sharma, Wu and Dalal, "The CIEDE2000 color-difference formula", 2005, https://doi.org/10.1002/col.20070."""
    (l1, a1, b1), (l2, a2, b2) = one, other
    mean = (np.hypot(a1, b1) + np.hypot(a2, b2)) / 2
    a1, a2 = np.array([a1, a2]) * (1.5 - 0.5 * np.sqrt(mean**7 / (mean**7 + 25.0**7)))
    c1, c2, h1, h2 = np.hypot(a1, b1), np.hypot(a2, b2), np.arctan2(b1, a1), np.arctan2(b2, a2)
    turn = (h2 - h1 + np.pi) % (2 * np.pi) - np.pi
    light, chroma, hue = (l1 + l2) / 2, (c1 + c2) / 2, np.degrees(h1 + turn / 2) % 360
    cosines = (np.cos(np.radians(angle)) for angle in (hue - 30, 2 * hue, 3 * hue + 6, 4 * hue - 63))
    t = 1 + np.dot((-0.17, 0.24, 0.32, -0.20), list(cosines))
    x = (l2 - l1) / (1 + 0.015 * (light - 50) ** 2 / np.sqrt(20 + (light - 50) ** 2))
    y = (c2 - c1) / (1 + 0.045 * chroma)
    z = 2 * np.sqrt(c1 * c2) * np.sin(turn / 2) / (1 + 0.015 * chroma * t)
    rotation = np.sin(np.radians(60 * np.exp(-(((hue - 275) / 25) ** 2))))
    rotation *= -2 * np.sqrt(chroma**7 / (chroma**7 + 25.0**7))
    return float(np.sqrt(x * x + y * y + z * z + rotation * y * z))


def contrast(colour: str, page: str) -> float:
    """As WCAG 2 defines it."""
    dark, light = sorted(XYZ[1] @ linear(one) + 0.05 for one in (colour, page))
    return light / dark


def test_the_colour_difference_is_that_of_the_paper() -> None:
    """Three rows of its table 1."""
    for one, other, difference in (
        ((50.0, 2.6772, -79.7751), (50.0, 0.0, -82.7485), 2.0425),
        ((2.0776, 0.0795, -1.1350), (0.9033, -0.0636, -0.5514), 0.9082),
        ((22.7233, 20.0904, -46.6940), (23.0331, 14.9730, -42.5619), 2.0373),
    ):
        assert ciede2000(np.array(one), np.array(other)) == pytest.approx(difference, abs=1e-4)


def test_followers_of_one_dash_differ_in_colour_for_the_colour_blind() -> None:
    looks = [*LOOKS.values(), *FREE[:12]]
    assert len({str(look[:2]) for look in looks}) == len(looks)  # all others differ in their dash
    for (one, dash, _), (other, same, _) in itertools.combinations(looks, 2):
        if dash == same:
            for sight in SIGHT:
                assert ciede2000(lab(one, sight), lab(other, sight)) > LEAST, (one, other, sight)


def test_what_the_viewer_draws_together_differs_for_the_colour_blind() -> None:
    style_sheet = (PARTS / "style.css").read_text()
    bad = re.findall(r"--bad: light-dark\((\S+), (\S+)\)", style_sheet)[0]
    groups = [DRONES, AXES, SCENE, *({"good": GREEN, "bad": one} for one in bad)]
    for group in groups:
        for (name, one), (other, two) in itertools.combinations(group.items(), 2):
            for sight in SIGHT:
                assert ciede2000(lab(one, sight), lab(two, sight)) > LEAST, (name, other, sight)


def test_colours_are_seen_on_light_and_dark_pages() -> None:
    for page in PAGES:
        assert min(contrast(colour, page) for colour in COLOURS) > 3  # WCAG 2: graphics
        assert contrast(INK, page) > 3.9


def test_every_follower_that_has_a_name_has_a_look() -> None:
    assert {*CONTROLLERS, *(path.stem for path in shipped_policies())} <= set(LOOKS)
    shared = follower_styles(LOOKS)
    assert all(follower_styles([name])[name] == shared[name] for name in LOOKS)
    named = follower_styles(["flight, flown", "balance (FORCED)", SIMULATED])
    for name, own in (("flight, flown", "flight"), ("balance (FORCED)", "balance")):
        assert {**named[name], "linewidth": shared[own]["linewidth"]} == shared[own]
    for name in set(named) - {SIMULATED}:  # what was flown is seen upon the same curve, simulated
        assert named[name]["linewidth"] * 4 < named[SIMULATED]["linewidth"]
    assert named[SIMULATED]["zorder"] < 2


def points(look: dict[str, Any]) -> tuple[str, str]:
    """What tells points of one follower from those of another."""
    return look["color"], look["marker"]


def test_other_names_have_looks_of_their_own() -> None:
    """README's `mine` and 20 % of these names had colour and marker of `copy`, and all those of some follower."""
    known = follower_styles(LOOKS)
    dashes, markers = ({str(look[part]) for look in known.values()} for part in ("linestyle", "marker"))
    beside = [["copy"], ["copy", "lqg"], ["copy", "pid", "lqg", "oracle", "balance"]]
    words = ("mine", "my-policy", "student", "baseline", "sac-2", "gru", "seed")
    for name in (f"{word}{number}" for word in words for number in ("", *range(60))):
        for others in beside:
            looks = follower_styles([name, *others])
            mine = looks[name]
            assert mine == follower_styles([*others, name])[name]
            assert mine["color"] not in {looks[other]["color"] for other in others}, (name, others)
            assert mine["marker"] not in markers, name
            assert str(mine["linestyle"]) not in dashes, name
            assert all(looks[other] == known[other] for other in others)
    names = [f"mine{k}" for k in range(len(FREE))]
    for count in (2, 6, 12, 36):
        looks = follower_styles([*names[:count], "copy", "balance"])
        assert len(set(map(points, looks.values()))) == count + 2
        lines = {(look["color"], str(look["linestyle"])) for look in looks.values()}
        assert len(lines) == min(count, 12) + 2
    assert len(follower_styles([*names, "one more"])) == len(names) + 1
    assert len({str(look) for look in series_styles(names).values()}) == len(names)


@pytest.mark.parametrize(("scale", "given"), [("log", {}), ("symlog", {"linthresh": 1.0})])
def test_ticks_of_logarithmic_axes_are_plain_numbers(scale: str, given: dict, tmp_path: Path) -> None:
    figure, axes = pyplot().subplots()
    axes.plot([0, 1, 2], [0.01, 1.0, 1000.0], label="$a_b$")
    logarithmic(axes, scale, **given)
    save(figure, tmp_path / "picture.png")
    shown = [label.get_text() for label in axes.get_yticklabels() if label.get_text()]
    assert {"1", "1000"} <= set(shown)
    assert not any("$" in text for text in shown)


def test_a_short_logarithmic_axis_has_more_ticks_than_decades() -> None:
    figure, axes = pyplot().subplots()
    axes.plot([0, 1], [0.3, 0.9])
    logarithmic(axes)
    figure.canvas.draw()
    low, high = axes.get_ylim()
    assert sum(low <= tick <= high for tick in axes.get_yticks()) >= 2
    pyplot().close(figure)


def test_vector_graphics_have_no_ground_of_their_own() -> None:
    def draw() -> bytes:
        figure, axes = pyplot().subplots()
        axes.plot([0, 1], [0, 1], **follower_styles(["balance"])["balance"])
        axes.set_title("text")
        return rendered(figure)

    picture = draw()
    assert picture.startswith(b"<svg")
    assert not re.search(rb"#(000000|ffffff)", picture)
    assert b">text</text>" in picture
    with style("paper"):
        paper = draw()
    assert paper.startswith(b"%PDF")
    assert b"/FontFile2" in paper  # TrueType, embedded
    assert b"/Type3" not in paper
    assert re.search(rb"/MediaBox \[ 0 0 252 ", paper)  # 3.5 in
