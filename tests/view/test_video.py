"""Videos of flights: what is in the file, and what is refused."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import assert_one_line, call, listing, without_progress

from mjxball.errors import InputError
from mjxball.evaluate.render import render
from mjxball.view.flight import Flight, flight_from, save_flight
from mjxball.view.main import main

Image = pytest.importorskip("PIL.Image")


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A pair's and a team's flight of 1 s and 0.5 s."""
    place = tmp_path_factory.mktemp("flights")
    for name, plant, seconds in (("pair", None, 1.0), ("team", Path("team3"), 0.5)):
        save_flight(place / f"{name}.npz", flight_from("adaptive", {"seconds": seconds}, "newton-euler", plant))
    return place / "pair.npz", place / "team.npz"


def made(arguments: list[Any], capsys: pytest.CaptureFixture[str]) -> None:
    code = call(main, arguments)
    errors = without_progress(capsys.readouterr().err)
    if "no working GL library" in errors:
        pytest.skip(errors)
    assert (code, errors) == (0, "")


@pytest.mark.slow
def test_a_gif_shows_the_flight(flights: tuple[Path, Path], tmp_path: Path, capsys: Any) -> None:
    """One second at half speed has 26 pictures of 80 ms, and the rig moves in them."""
    made([flights[0], "--video", tmp_path / "out.gif", "--speed", 0.5], capsys)
    with Image.open(tmp_path / "out.gif") as film:
        assert (film.n_frames, film.size, film.info["duration"], film.info["loop"]) == (26, (360, 360), 80, 0)
        first = np.asarray(film.convert("RGB")).astype(int)
        film.seek(25)
        last = np.asarray(film.convert("RGB")).astype(int)
    assert (np.abs(last - first).max(axis=-1) > 60).sum() > 200


@pytest.mark.slow
def test_an_mp4_shows_two_flights_side_by_side(flights: tuple[Path, Path], tmp_path: Path, capsys: Any) -> None:
    """Of two plants and lengths; read back by the same coder."""
    coder = shutil.which("ffmpeg") or pytest.importorskip("imageio_ffmpeg").get_ffmpeg_exe()
    made([*flights, "--video", tmp_path / "out.mp4", "--speed", 2], capsys)
    command = [coder, "-loglevel", "error", "-i", tmp_path / "out.mp4", "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    raw = subprocess.run(command, capture_output=True, check=True).stdout
    pictures = np.frombuffer(raw, np.uint8).reshape(-1, 720, 2 * 720, 3).astype(int)
    assert len(pictures) == 16  # 0.5 s of 30 a second, and the first one
    blue = (pictures[..., 2] > 130) & (pictures[..., 0] < 110) & (pictures[..., 1] < 130)
    pair, team = blue[0, :, :720].sum(), blue[0, :, 720:].sum()
    assert pair > 20
    assert team > 1.4 * pair  # two followers instead of one


def test_videos_that_cannot_be_are_refused(
    flights: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.gif").write_text("mine")
    before = listing(tmp_path)
    for arguments, words in (
        (["--video", "out.avi"], "must end in .mp4 or .gif"),
        (["--video", "there.gif"], "exists"),
        (["--video", "nowhere/out.gif"], "does not exist"),
        (["--video", "out.gif", "--speed", "0"], "--speed must be"),
        (["--video", "out.gif", "--speed", "-1"], "--speed must be"),
        (["--video", "out.gif", "--speed", "0.01"], "is too long"),
        (["--out", "page.html", "--speed", "2"], "--speed is of --video"),
        ([flights[1], "--save", "both.npz"], "--save writes one flight"),
        ([flights[1], flights[1]], "two flights fit side by side"),
    ):
        assert call(main, [flights[0], *arguments]) == 2, words
        errors = capsys.readouterr().err
        assert_one_line(errors)
        assert words in errors
    assert listing(tmp_path) == before


def test_no_coder_and_no_gl_library_are_a_sentence(
    flights: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.setenv("MUJOCO_GL", "disabled")
    assert call(main, [flights[0], "--video", tmp_path / "out.gif"]) == 2
    errors = capsys.readouterr().err
    assert_one_line(errors)
    assert "MuJoCo's renderer" in errors
    monkeypatch.setattr(shutil, "which", lambda *_: None)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    assert call(main, [flights[0], "--video", tmp_path / "out.mp4"]) == 2
    errors = capsys.readouterr().err
    assert_one_line(errors)
    assert "needs ffmpeg" in errors
    assert list(tmp_path.iterdir()) == []


def test_a_coder_that_fails_is_named(
    flights: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = tmp_path / "ffmpeg"
    broken.write_text("#!/bin/sh\necho 'no such codec' >&2\nexit 1\n")
    broken.chmod(0o755)
    monkeypatch.setattr(shutil, "which", lambda *_: str(broken))
    flown: Flight = flight_from(str(flights[1]), {}, "")
    with pytest.raises(InputError, match=r"no such codec|no working GL library"):
        render([flown.plant], {"team": flown.arrays}, ".mp4")


def test_two_flights_of_one_title_are_told_apart(flights: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "same.npz").write_bytes(flights[0].read_bytes())
    assert call(main, [flights[0], tmp_path / "same.npz", "--out", tmp_path / "page.html"]) == 0
    title = flight_from(str(flights[0]), {}, "").title
    assert f"<title>pair.npz: {title} | same.npz: {title}</title>" in (tmp_path / "page.html").read_text()
