"""Text in pictures: names stay as they are, and ticks are numbers."""

from pathlib import Path

import pytest

pytest.importorskip("matplotlib")

from mjxball.plotting import logarithmic, pyplot, save


@pytest.mark.parametrize(("scale", "given"), [("log", {}), ("symlog", {"linthresh": 1.0})])
def test_ticks_of_logarithmic_axes_are_plain_numbers(scale: str, given: dict, tmp_path: Path) -> None:
    figure, axes = pyplot().subplots()
    axes.plot([0, 1, 2], [0.01, 1.0, 1000.0], label="$a_b$")
    logarithmic(axes, scale, **given)
    save(figure, tmp_path / "picture.png")
    shown = [label.get_text() for label in axes.get_yticklabels() if label.get_text()]
    assert {"1", "1000"} <= set(shown)
    assert not any("$" in text for text in shown)
    pyplot().close(figure)
