"""What is shown at a terminal: nothing is wrapped, nothing is left over; and elsewhere plain lines."""

from __future__ import annotations

import io
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from command_line import REPOSITORY, environment, script, tiny
from pseudo_terminal import on_terminal

from mjxball import terminal
from mjxball.evaluate.results import metric_text
from mjxball.terminal import Working, fitted, folded, table

WIDTHS = (40, 80, 100, 130)
TRAINING = """
import sys, time, pathlib
from mjxball.train.progress import Progress, Session, columns
names = columns(["steady_error"], ["alpha", "entropy"], ["steady_error", "peak"])
progress = Progress(pathlib.Path("metrics.csv"), names, 768000, session=Session("transport-seed0"))
progress.begin("compiling", "the training program for 1 x a device with quite a long name", "Ctrl-C stops")
progress.say("compiled in 8.1 s")
for k in range(1, 7):
    row = {"steps": k * 128000, "seconds": k, "rate": 25222.0, "episode_return": -1.2e4 / k, "steady_error": 0.0123}
    row |= {"alpha": 0.02, "entropy": 1.0, "terminated": 0, "diverged": 0}
    if k == 3:
        row |= {"eval_return": -1e4, "eval_steady_error": 0.01, "eval_peak": 0.5}
    progress.show(row)
    time.sleep(0.05)
    if k == 2:
        print("a warning of a library", file=sys.stderr)
progress.close()
print("the end")
"""
LINES = ["compiled in 8.1 s", "a warning of a library", "the end"]


@pytest.fixture(scope="module")
def training(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """A program that shows the progress of a training that there is not."""
    path = tmp_path_factory.mktemp("program") / "training.py"
    path.write_text(TRAINING)
    return [sys.executable, str(path)]


@pytest.mark.parametrize("columns", [*WIDTHS, 0])
def test_progress_fits_and_leaves_nothing_behind(
    columns: int, training: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "70")  # what a shell exported before its window was resized
    seen = on_terminal(training, columns, tmp_path)
    assert (seen.code, seen.wrapped) == (0, 0), seen.text
    live = [state for state in seen.states if "Ctrl-C saves and stops" in state]
    assert any(re.search(r"17%  0:[12]\d left  25\.2 k/s", state) for state in live)  # it counts down from 0:25
    assert max(len(re.findall("k/s  ?", state)) + state.count("Ctrl-C") for state in live) <= 3  # one status alone
    left = seen.text.splitlines()
    assert [line for line in left if line in LINES] == LINES
    rest = [line for line in left if line not in LINES]
    assert len(rest) == 1, rest
    (row,) = rest
    parts = ["384,000 steps", "eval return -1e+04", "steady error 0.01", "peak 0.5", "50%", "0:15 left", "25.2 k/s"]
    shown = re.split("  +", row.strip())
    assert shown == parts[: len(shown)]
    assert len(shown) >= {40: 2, 80: 5, 0: 5}.get(columns, len(parts))


@pytest.mark.slow
def test_a_dumb_terminal_and_a_pipe_have_a_line_a_row(training: list[str], tmp_path: Path) -> None:
    dumb = on_terminal(training, 80, tmp_path, term="dumb")
    piped = subprocess.run(training, capture_output=True, text=True, cwd=tmp_path, env=ENVIRONMENT, check=True)
    for text in (dumb.text, piped.stderr):
        assert len(re.findall(r"^ +[\d,]+ steps", text, re.MULTILINE)) == 6
        assert "\x1b" not in text
    assert dumb.wrapped == 0
    assert len(piped.stderr.splitlines()) == 6 + 3


ENVIRONMENT = {**environment(), "PYTHONPATH": str(REPOSITORY)}


@pytest.mark.slow
def test_a_real_training_fits_and_is_stopped(tmp_path: Path) -> None:
    columns = 40
    command = [sys.executable, str(script("train.py")), *tiny(out="run")]
    whole = on_terminal(command, columns, tmp_path)
    assert (whole.code, whole.wrapped) == (0, 0), whole.text
    assert any("Ctrl-C stops" in state for state in whole.states)
    assert "Ctrl-C" not in whole.text
    assert re.search(r"^\* ", whole.text, re.MULTILINE)  # the reference scenario
    again = [sys.executable, str(script("train.py")), *tiny(out="other", sac__total_steps=400_000)]
    stopped = on_terminal(again, columns, tmp_path, interrupt_at="% ")
    assert (stopped.code, stopped.wrapped) == (130, 0), stopped.text
    assert "Ctrl-C saves" not in stopped.text


def test_parts_that_do_not_fit_are_left_out() -> None:
    assert fitted(["0123456789"], 4) == "0123"
    assert fitted(["ab", "cd", "ef"], 6) == "ab  cd"
    assert fitted([], 7) == ""
    assert folded("one two three", 8) == "one two\nthree"
    assert folded("return 5  steady error 3  alpha", 18) == "return 5\nsteady error 3\nalpha"


# --- tables ---------------------------------------------------------------------------------------------------------


def test_numbers_of_a_table() -> None:
    assert [metric_text("settling_time", value) for value in (None, np.inf, 2.0)] == ["never", "never", "2.00"]
    assert [metric_text("overshoot", value) for value in (None, np.nan, np.inf, 0.125)] == ["-", "-", "failed", "12.5"]


TABLE = """
from mjxball.terminal import table
rows = [["*", "waveform", "+0.1 kg at 12 s, -0.1 kg at 24 s", name, *["0.1234"] * 9] for name in ("a", "a_follower")]
print(table(["", "kind", "scenario", "follower", *[f"value{k}\\nm" for k in range(9)]], rows, (1, 2, 3), 3))
"""


@pytest.mark.parametrize("columns", WIDTHS)
def test_a_table_fits(columns: int, tmp_path: Path) -> None:
    seen = on_terminal([sys.executable, "-c", TABLE], columns, tmp_path)
    assert (seen.code, seen.wrapped) == (0, 0)
    assert "…" not in seen.text
    shown, _, left_out = " ".join(seen.text.split()).partition("left out on this narrow terminal: ")
    values = [f"value{k}" for k in range(9)]
    fitting = 5 if columns == 40 else 9
    assert [one for one in values if one in shown] == values[:fitting]
    assert left_out == ", ".join(values[fitting:])
    assert shown.count("0.1234") == 2 * fitting
    assert [shown.count(word) for word in ("a_follower", "waveform")] == [1, 1 if columns == 100 else 2]


def test_a_table_in_a_file_has_a_line_a_row() -> None:
    found = table(["name", "value\nm"], [["with several words", "1"]] * 3, (0,), 0)
    assert found.splitlines() == [
        "                    value",
        "name                    m",
        *["with several words      1"] * 3,
    ]


def test_a_sentence_breaks_between_words_behind_columns_too() -> None:
    """Two blanks part columns, which stay whole if they fit; a long sentence behind them breaks between its words."""
    sentence = "good  headings: leader +0.0 degrees from the follower; each one costs 6 mm of hover error"
    lines = folded(sentence, 60).splitlines()
    assert max(map(len, lines)) <= 60
    assert " ".join(lines).split() == sentence.split()
    assert folded("steps 12 of 20  eval return -3  eval peak 0.1", 24).splitlines() == [
        "steps 12 of 20",
        "eval return -3",
        "eval peak 0.1",
    ]


def test_what_steers_a_terminal_is_blank() -> None:
    """Joiners of letters and blanks that do not break stay; turns of the direction and line separators do not."""
    text = "a\x1b[31mb\u202ec\u2028d\x85e\nf\u200dg\u00a0h\u0627"
    assert terminal.fitted_to(None, text) == "a [31mb c d e\nf\u200dg\u00a0h\u0627"


def test_a_closed_stream_is_no_fault(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Of one that the caller closed Python has None."""
    monkeypatch.setattr(sys, "stderr", None)
    terminal.warn("a warning")
    monkeypatch.setattr(sys, "stdout", None)
    terminal.say("a sentence")
    monkeypatch.undo()
    assert capsys.readouterr() == ("", "")


def test_a_sentence_of_one_thread_is_not_cut_by_another(monkeypatch: pytest.MonkeyPatch) -> None:
    """`print` writes a text and its end apart: lines of two drones that connect were glued together."""
    pieces: list[str] = []

    class Shared(io.StringIO):
        def write(self, text: str) -> int:
            pieces.append(text)
            return len(text)

    monkeypatch.setattr(sys, "stdout", Shared())
    monkeypatch.setattr(sys, "stderr", Shared())
    terminal.say("leader: connecting")
    terminal.warn("follower: connecting")
    assert pieces == ["leader: connecting\n", "follower: connecting\n"]


def test_working_says_what_lasts_and_how_far_it_is(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with Working("thinking"):
        pass
    assert capsys.readouterr().err == ""
    monkeypatch.setattr(terminal, "SOON", 0.05)
    monkeypatch.setattr(terminal, "QUIET", 0.05)
    with Working("flying 2 followers") as working:
        working(0.25)
        time.sleep(0.5)
    first, second, *_ = capsys.readouterr().err.splitlines()
    assert (first, second) == ("flying 2 followers ...", "flying 2 followers  25%  0 s")


def test_work_goes_on_without_stderr(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(terminal, "SOON", 0.01)
    for stream in (None, io.StringIO()):
        if stream:
            stream.close()
        monkeypatch.setattr(sys, "stderr", stream)
        with Working("flying"):
            time.sleep(0.05)
