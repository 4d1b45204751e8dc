"""The paper's figures: numbers of their captions against flights made by hand, refusals, and the page in a browser."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from command_line import TRANSPORT, assert_one_line, call, listing, load_arrays, write_arrays
from conftest import opened

from mjxball.commands.evaluate import main
from mjxball.config import preset
from mjxball.errors import InputError
from mjxball.evaluate import stand_figure
from mjxball.evaluate.paper_figures import NAMES, plot_reward, read_curve, swings
from mjxball.evaluate.results import fly_scenarios
from mjxball.evaluate.scenarios import REFERENCE
from mjxball.policy import Policy
from mjxball.policy.file import shipped_policy

CONFIG = preset("paper")
FAST = ["--physics", "newton-euler"]
CURVE = {
    "steps": [100, 200, 300],
    "episode_return": [-900.0, -80.0, -50.0],
    "eval_steps": [150, 300],
    "eval_return": [-60.0, -20.0],
}


def policy_with(**metadata: Any) -> Policy:
    """The shipped follower with another metadata, under the name `mine`."""
    policy = Policy.load(TRANSPORT)
    policy.name, policy.metadata = "mine", {**policy.metadata, **metadata}
    return policy


# --- numbers of the captions ----------------------------------------------------------------------------------------


def test_swings_count_passages_beyond_a_centimetre() -> None:
    wave = 0.05 * np.cos(np.linspace(0, 3 * np.pi, 101))  # + - + -
    small = 0.009 * np.cos(np.linspace(0, 30 * np.pi, 101))  # within a centimetre: nothing
    assert swings(np.stack([wave, small, -wave], axis=1)) == 3 + 0 + 3


def test_training_curve_is_read_from_the_card() -> None:
    curve = read_curve(policy_with(curve=CURVE))
    assert curve is not None
    assert (curve.steps, curve.returns, curve.evaluated) == ([100, 200, 300], [-900.0, -80.0, -50.0], [-60.0, -20.0])
    assert read_curve(policy_with(curve=None)) is None


@pytest.mark.parametrize(
    "curve",
    [
        [],
        {},
        {**CURVE, "steps": []},
        {**CURVE, "steps": [100, 200]},
        {**CURVE, "eval_return": [-60.0, float("nan")]},
        {**CURVE, "episode_return": [-900.0, "-80", -50.0]},
        {**CURVE, "eval_steps": None},
    ],
)
def test_unsound_training_curve_is_refused(curve: Any) -> None:
    with pytest.raises(InputError, match="policy mine has an unsound training curve"):
        read_curve(policy_with(curve=curve))


# --- the command line -----------------------------------------------------------------------------------------------


def standing(path: Path, **plant: Any) -> Path:
    """The shipped follower for the stand under another name."""
    arrays, metadata = load_arrays(shipped_policy("stand"))
    return write_arrays(path, arrays, {**metadata, "seeds": 4, "plant": {**metadata["plant"], **plant}})


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All figures of the shipped follower with a training curve, and of one that claims to be made for a stand."""
    here = tmp_path_factory.mktemp("figures")
    arrays, metadata = load_arrays()
    write_arrays(here / "curved.npz", arrays, {**metadata, "curve": CURVE})
    flags = [here / "curved.npz", standing(here / "rocked.npz"), "--out", here / "out"]
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(stand_figure, "STAND_START", dataclasses.replace(stand_figure.STAND_START, seconds=22.0))
        assert call(main, ["figures", *flags, *FAST]) == 0
    return here / "out"


def caption(page: Path, name: str) -> str:
    found = re.search(rf'<figcaption id="{name}-caption">(.*?)</figcaption>', page.read_text(), re.DOTALL)
    assert found
    return found[1]


@pytest.mark.slow
def test_every_figure_is_a_file_of_its_own(drawn: Path) -> None:
    assert {path.name for path in drawn.iterdir()} == {"figures.html", *(f"figure-{name}.svg" for name in NAMES)}
    for name in NAMES:
        root = ElementTree.parse(drawn / f"figure-{name}.svg").getroot()
        assert root.tag == "{http://www.w3.org/2000/svg}svg"
        assert len(list(root.iter("{http://www.w3.org/2000/svg}path"))) > 5


@pytest.mark.slow
def test_captions_hold_the_numbers_of_the_flights(drawn: Path) -> None:
    """The reference flight, flown again and measured here."""
    flight = fly_scenarios(CONFIG, [Policy.load(TRANSPORT)], [REFERENCE], "newton-euler")[0].flight
    distance = np.linalg.norm(flight.error, axis=1)
    peak = np.linalg.norm(np.abs(flight.error[flight.time >= 20 - 1e-9]).max(axis=0))
    settled = flight.time[np.flatnonzero(distance > 0.02 * distance[0])[-1]]
    row = f"<td>{peak:.3f} m</td><td>{settled:.1f} s</td>"
    assert f"{row}</tr>" in caption(drawn / "figures.html", "adaptive")
    end = f"<td>{distance[-1]:.3f} m</td>"
    assert f"<td>curved, 0.31 rad/s</td>{row}{end}" in caption(drawn / "figures.html", "speeds")
    assert f"<td>curved, known mass, 0.2 kg</td>{row}{end}" in caption(drawn / "figures.html", "masses")


def test_reward_table_has_a_row_for_every_policy() -> None:
    mimic = policy_with(curve=CURVE, config={"reward": {"kind": "paper"}})
    bare = policy_with(curve=None)
    bare.name = "bare"
    rows = plot_reward([mimic, bare]).rows
    assert rows[0] == ("mine", "paper", "300", "-900", "-50", "-20")
    assert rows[1][:2] == ("bare", "no training curve in its metadata")


@pytest.mark.slow
def test_captions_name_who_is_drawn(drawn: Path) -> None:
    page = drawn / "figures.html"
    assert "curved" in caption(page, "reward")
    assert "rocked" not in caption(page, "reward")
    assert "rocked" not in caption(page, "speeds")
    assert "the paper&#39;s gains, rocked" in caption(page, "stand")
    assert "better settings, rocked" in caption(page, "stand")
    assert "the paper&#39;s gains, curved" not in caption(page, "stand")


@pytest.mark.parametrize("width", [1280, 390], ids=["desktop", "phone"])
def test_figures_open_in_a_browser(browser, drawn: Path, width: int) -> None:
    tab = opened(browser, drawn / "figures.html", width)
    for name in NAMES:
        box = tab.locator(f"h2#{name} + figure svg").bounding_box()
        assert box["width"] > 0.9 * min(width - 32, 720)
        assert box["height"] > 120
        # Letters as the browser draws them, in pixels of the screen: 7 is the least that can be read.
        heights = tab.eval_on_selector_all(
            f"h2#{name} + figure svg text", "t => t.map(x => x.getBoundingClientRect().height)"
        )
        assert min(heights) > 7
    tab.close()


REFUSED = {
    "unknown figure": (["--only", "speed"], "invalid choice: 'speed'"),
    "followers": (["--followers", "lqg"], "unrecognized arguments: --followers"),
    "scenario": (["--omega", 1], "unrecognized arguments: --omega"),
    "no such policy": (["nothing.npz"], "nothing.npz"),
    "policy for another plant": (["thin.npz", "--only", "reward"], "another plant: arm is 0.1"),
    "policy for another stand": (["wide.npz", "--only", "stand"], "another plant: arm is 0.1"),
    "nobody flies free": (["heave.npz", "--only", "stand", "speeds"], "figure speeds needs a policy"),
    "unsound curve": (["odd.npz", "--only", "reward", "speeds"], "policy odd has an unsound training curve"),
    "name of a baseline": (["copy.npz", "--only", "reward"], "two followers are called 'copy'"),
}


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory that holds what bad inputs point at."""
    arrays, metadata = load_arrays()
    write_arrays(tmp_path / "thin.npz", arrays, {**metadata, "plant": {**metadata["plant"], "arm": 0.1}})
    write_arrays(tmp_path / "odd.npz", arrays, {**metadata, "curve": {"steps": 3}})
    write_arrays(tmp_path / "copy.npz", arrays, metadata)
    standing(tmp_path / "heave.npz")
    standing(tmp_path / "wide.npz", arm=0.1)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "figures.html").write_text("kept")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def test_figures_of_a_paper_are_pdf_of_a_columns_width(tmp_path: Path) -> None:
    arrays, metadata = load_arrays()
    write_arrays(tmp_path / "curved.npz", arrays, {**metadata, "curve": CURVE})
    out = tmp_path / "out"
    assert call(main, ["figures", tmp_path / "curved.npz", "--only", "reward", "--style", "paper", "--out", out]) == 0
    assert {path.name for path in out.iterdir()} == {"figures.html", "figure-reward.pdf"}
    drawn = (out / "figure-reward.pdf").read_bytes()
    assert b"/FontFile2" in drawn
    assert b"/MediaBox [ 0 0 252 " in drawn  # 3.5 in
    assert 'href="figure-reward.pdf"' in (out / "figures.html").read_text()


def assert_refused(here: Path, arguments: list[Any], word: str, capsys: pytest.CaptureFixture[str]) -> None:
    before = listing(here)
    code = call(main, ["figures", *FAST, *arguments])
    captured = capsys.readouterr()
    assert code == 2, captured
    assert_one_line(captured.err)
    assert word in captured.err
    assert listing(here) == before


@pytest.mark.parametrize(("arguments", "word"), REFUSED.values(), ids=REFUSED)
def test_bad_request_is_refused(here: Path, arguments: list[Any], word: str, capsys: pytest.CaptureFixture) -> None:
    assert_refused(here, [*arguments, "--out", "new"], word, capsys)


@pytest.mark.parametrize(
    ("out", "word"),
    [([], "required: --out"), (["--out", "full"], "exists and is not empty")],
    ids=["none", "full"],
)
def test_figures_need_an_empty_place(here: Path, out: list[str], word: str, capsys: pytest.CaptureFixture) -> None:
    assert_refused(here, [TRANSPORT, "--only", "reward", *out], word, capsys)
