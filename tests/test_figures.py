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
from mjxball.control.followers import make_baseline
from mjxball.errors import InputError
from mjxball.evaluate.cells import REFERENCE, Cell, run_cells
from mjxball.evaluate.paper import adaptive, experiment, reward, variations
from mjxball.evaluate.paper.command import NAMES
from mjxball.evaluate.paper.figure import listed
from mjxball.policy import Policy
from mjxball.policy.shipped import shipped_policy

CONFIG = preset("paper")
FAST = ["--physics", "newton-euler"]
CURVE = {
    "steps": [100, 200, 300],
    "episode_return": [-900.0, -80.0, -50.0],
    "eval_steps": [150, 300],
    "eval_return": [-60.0, -20.0],
}


@pytest.fixture(scope="module")
def cell() -> Cell:
    """A short flight, to be given other numbers."""
    copy = make_baseline("copy", CONFIG)
    return run_cells(CONFIG, [copy], [dataclasses.replace(REFERENCE, seconds=1.0)], "newton-euler")[0]


def renamed(cell: Cell, name: str, errors: np.ndarray, **metrics: Any) -> Cell:
    """`cell` as flown by `name` with e_o = `errors` (T, 3) and other metrics."""
    flight = dataclasses.replace(cell.flight, position=-errors, target=np.zeros_like(errors))
    return dataclasses.replace(
        cell, follower=name, flight=flight, metrics=dataclasses.replace(cell.metrics, failed=False, **metrics)
    )


def along_x(errors: list[float]) -> np.ndarray:
    return np.array([[error, 0.0, 0.0] for error in errors])


def policy_with(**card: Any) -> Policy:
    """The shipped follower with another card, under the name `mine`."""
    policy = Policy.load(TRANSPORT)
    policy.name, policy.card = "mine", {**policy.card, **card}
    return policy


# --- numbers of the captions ----------------------------------------------------------------------------------------


def test_swings_count_passages_beyond_a_centimetre(cell: Cell) -> None:
    wave = 0.05 * np.cos(np.linspace(0, 3 * np.pi, 101))  # + - + -
    small = 0.009 * np.cos(np.linspace(0, 30 * np.pi, 101))  # within a centimetre: nothing
    flight = renamed(cell, "any", np.stack([wave, small, -wave], axis=1)).flight
    assert adaptive.swings(flight) == 3 + 0 + 3


def test_adaptive_is_beaten_in_what_the_numbers_say(cell: Cell) -> None:
    steady = {"y_peak": 0.0, "z_peak": 0.0}
    cells = [
        renamed(cell, "copy", along_x([1, -1, 1, -1]), overshoot=0.3, settling_time=None, x_peak=0.3, **steady),
        renamed(cell, "adaptive", along_x([1, -1]), overshoot=0.05, settling_time=8.0, x_peak=0.002, **steady),
        renamed(cell, "mine", along_x([1, 0]), overshoot=0.05, settling_time=3.0, x_peak=0.003, y_peak=0.004, z_peak=0),
        renamed(cell, "fell", along_x([1, 0]), overshoot=0, settling_time=None, x_peak=9, y_peak=9, z_peak=9),
    ]
    cells[-1] = dataclasses.replace(cells[-1], metrics=dataclasses.replace(cells[-1].metrics, failed=True))
    agrees, differs = adaptive.judged(cells, ["fell"])
    assert agrees == ('"mine" beats adaptive in swings (0 against 1) and settling (3.0 s against 8.0 s).',)
    assert differs[0] == (
        '"mine" does not beat adaptive in overshoot (5.0 % against 5.0 %) '
        "and peak after 20 s (0.005 m against 0.002 m)."
    )
    assert differs[1] == '"fell" does not beat adaptive in anything, its flight failed.'
    assert differs[2].startswith('"fell" is a mimic. Its reward asks it to copy')
    assert "copy" in differs[3]
    assert "peak after 20 s (0.300 m against 0.002 m)" in differs[3]
    assert len(differs) == 4


def level_cells(cell: Cell, name: str, peaks: list[float], settled: list[float | None]) -> list[tuple[str, Cell]]:
    """Flights of `name` at levels '0 kg', '1 kg', ..."""
    numbers = zip(peaks, settled, strict=True)
    return [
        (f"{k} kg", renamed(cell, name, along_x([1, 0]), x_peak=x, y_peak=0.0, z_peak=0.0, settling_time=s))
        for k, (x, s) in enumerate(numbers)
    ]


def test_variations_say_where_a_policy_settles_and_where_it_only_copies(cell: Cell) -> None:
    family, mine = variations.BY_NAME["mass-known"], policy_with()
    flown = {
        "mine": level_cells(cell, "mine", [0.01, 0.19, 0.3], [3.0, None, None]),
        "copy": level_cells(cell, "copy", [0.2, 0.2, 0.2], [8.0, 8.0, 8.0]),
    }
    assert variations._stable(family, flown, [mine]) == [
        'At every known object mass the pair flies stably with "mine".'
    ]
    assert variations._unsettled(family, flown, [mine]) == [
        '"mine" does not settle at 1 kg and 2 kg: it is up to 0.300 m off after 20 s, at 2 kg.'
    ]
    hardly = "1 kg (0.190 m against 0.200 m) and 2 kg (0.300 m against 0.200 m)"
    assert variations._like_copy("mine", flown) == [f'"mine" peaks hardly lower than copying, or higher, at {hardly}.']
    label, first = flown["mine"][0]
    fallen = dataclasses.replace(first, metrics=dataclasses.replace(first.metrics, failed=True))
    flown["mine"][0] = (label, fallen)
    assert variations._stable(family, flown, [mine]) == []
    assert variations._failed(family, flown, [mine]) == ['"mine" fails at 0 kg.']


def test_words_are_listed() -> None:
    assert [listed(words) for words in ([], ["a"], ["a", "b"], ["a", "b", "c"])] == ["", "a", "a and b", "a, b and c"]


def test_training_curve_is_read_from_the_card() -> None:
    mimic = reward.read_curve(policy_with(curve=CURVE, config={"reward": {"kind": "paper"}}))
    assert mimic is not None
    assert mimic.mimics
    assert reward.read_curve(policy_with(curve=None)) is None
    agrees, differs = reward.judged([mimic])
    assert agrees == ('The return of "mine" rises from -900 to -50 over 300 steps.',)
    assert differs[0] == '"mine" ends at -20 without exploration; the known optimum is 0.'
    assert "Exploring, it has -50" in differs[1]
    assert "less than the paper's million" in differs[2]
    falling = dataclasses.replace(mimic, mimics=False, returns=[-5.0, -6.0, -7.0])
    agrees, differs = reward.judged([falling])
    assert not agrees
    assert "does not rise: it goes from -5 to -7" in differs[0]
    assert "our task reward" in differs[1]


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
        reward.read_curve(policy_with(curve=curve))


# --- the command line -----------------------------------------------------------------------------------------------


def standing(path: Path, **plant: Any) -> Path:
    """The shipped follower for the stand under another name."""
    arrays, card = load_arrays(shipped_policy("stand"))
    return write_arrays(path, arrays, {**card, "seeds": 4, "plant": {**card["plant"], **plant}})


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All figures of the shipped follower with a training curve, and of one that claims to be made for a stand."""
    here = tmp_path_factory.mktemp("figures")
    arrays, card = load_arrays()
    write_arrays(here / "curved.npz", arrays, {**card, "curve": CURVE})
    flags = [here / "curved.npz", "--figures", "all", standing(here / "rocked.npz"), "--out", here / "out"]
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(experiment, "SCENARIO", dataclasses.replace(experiment.SCENARIO, seconds=22.0))
        assert call(main, [*FAST, *flags]) == 0
    return here / "out"


def caption(page: Path, name: str) -> str:
    found = re.search(rf'<figcaption id="{name}-caption">(.*?)</figcaption>', page.read_text(), re.DOTALL)
    assert found
    return found[1]


def test_every_figure_is_a_file_of_its_own(drawn: Path) -> None:
    assert {path.name for path in drawn.iterdir()} == {"figures.html", *(f"figure-{name}.svg" for name in NAMES)}
    for name in NAMES:
        root = ElementTree.parse(drawn / f"figure-{name}.svg").getroot()
        assert root.tag == "{http://www.w3.org/2000/svg}svg"
        assert len(list(root.iter("{http://www.w3.org/2000/svg}path"))) > 5


def test_captions_hold_the_numbers_of_the_flights(drawn: Path) -> None:
    """The reference flight, flown again and measured here."""
    flight = run_cells(CONFIG, [Policy.load(TRANSPORT)], [REFERENCE], "newton-euler")[0].flight
    distance = np.linalg.norm(flight.error, axis=1)
    peak = np.linalg.norm(np.abs(flight.error[flight.time >= 20 - 1e-9]).max(axis=0))
    settled = flight.time[np.flatnonzero(distance > 0.02 * distance[0])[-1]]
    row = f"<td>{peak:.3f} m</td><td>{settled:.1f} s</td>"
    assert f"{row}</tr>" in caption(drawn / "figures.html", "adaptive")
    end = f"<td>{distance[-1]:.3f} m</td>"
    assert f"<td>curved, 0.31 rad/s</td>{row}{end}" in caption(drawn / "figures.html", "speeds")
    assert f"<td>curved, known mass, 0.2 kg</td>{row}{end}" in caption(drawn / "figures.html", "masses")


def test_reward_caption_names_who_has_no_curve_and_who_was_trained_together(tmp_path: Path) -> None:
    arrays, card = load_arrays()
    without = {name: value for name, value in card.items() if name != "curve"}
    files = [
        write_arrays(tmp_path / "bare.npz", arrays, without),
        write_arrays(tmp_path / "four.npz", arrays, {**without, "curve": CURVE, "seeds": 4}),
    ]
    text = reward.draw([Policy.load(path) for path in files]).markup()
    assert "&quot;bare&quot; has no training curve" in text
    assert "Grey is the median of all that were trained together: &quot;four&quot; (4)." in text


def test_captions_name_who_is_drawn(drawn: Path) -> None:
    page = drawn / "figures.html"
    assert "curved" in caption(page, "reward")
    assert "rocked" not in caption(page, "reward")
    assert "rocked" not in caption(page, "speeds")
    assert "the paper&#x27;s gains, rocked" in caption(page, "stand")
    assert "better settings, rocked" in caption(page, "stand")
    assert "the paper&#x27;s gains, curved" not in caption(page, "stand")


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
        assert "Agrees with the paper:" in tab.inner_text(f"#{name}-caption")
    tab.close()


REFUSED = {
    "unknown figure": (["--figures", "speed"], "unknown figure 'speed'; there are all, reward"),
    "no figure": (["--figures", TRANSPORT], "--figures takes a name"),
    "families": (["--figures", "all", "--families", "delay"], "drop --families"),
    "seeds": (["--figures", "all", "--seeds", 2], "drop --seeds"),
    "check": (["--figures", "all", "--check"], "drop --check"),
    "followers": (["--figures", "all", "--followers", "lqg"], "drop --followers"),
    "scenario": (["--figures", "all", "--omega", 1], "drop --omega"),
    "mass change": (["--figures", "all", "--mass-change", "1:0.1"], "drop --mass-change"),
    "stiffness": (["--figures", "all", "--wn-pitch", 5], "drop --wn-pitch"),
    "json": (["--figures", "all", "--json", "new.json"], "drop --json"),
    "no such policy": (["nothing.npz", "--figures", "all"], "nothing.npz"),
    "policy for another plant": (["thin.npz", "--figures", "reward"], "another plant: arm is 0.1"),
    "policy for another stand": (["wide.npz", "--figures", "stand"], "another plant: arm is 0.1"),
    "nobody flies free": (["heave.npz", "--figures", "stand", "speeds"], "figure speeds needs a policy"),
    "unsound curve": (["odd.npz", "--figures", "reward", "speeds"], "policy odd has an unsound training curve"),
    "name of a baseline": (["copy.npz", "--figures", "reward"], "two followers are called 'copy'"),
}


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working directory that holds what bad inputs point at."""
    arrays, card = load_arrays()
    write_arrays(tmp_path / "thin.npz", arrays, {**card, "plant": {**card["plant"], "arm": 0.1}})
    write_arrays(tmp_path / "odd.npz", arrays, {**card, "curve": {"steps": 3}})
    write_arrays(tmp_path / "copy.npz", arrays, card)
    standing(tmp_path / "heave.npz")
    standing(tmp_path / "wide.npz", arm=0.1)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "figures.html").write_text("kept")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def assert_refused(here: Path, arguments: list[Any], word: str, capsys: pytest.CaptureFixture[str]) -> None:
    before = listing(here)
    code = call(main, [*FAST, *arguments])
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
    [([], "--figures needs --out"), (["--out", "full"], "exists and is not empty")],
    ids=["none", "full"],
)
def test_figures_need_an_empty_place(here: Path, out: list[str], word: str, capsys: pytest.CaptureFixture) -> None:
    assert_refused(here, [TRANSPORT, "--figures", "reward", *out], word, capsys)
