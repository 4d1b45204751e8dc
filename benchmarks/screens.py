"""All that a person looks at, in one run: a real browser and a real pseudo-terminal, as pictures and text in a folder.

`python benchmarks/screens.py OUT [--only PART ...] [--site DIR]`

Pages at 400 and 1300 pixels, light and dark; programs in terminals of 40, 80 and 130 columns, one that cannot go back
on a line, and none at all. Exit code 1, with a line for each, if a page logs an error, makes one, fetches something
from elsewhere or hangs out at the side, or if a terminal breaks a line.
"""

from __future__ import annotations

import argparse
import fcntl
import os
import pty
import select
import shutil
import struct
import subprocess
import sys
import tempfile
import termios
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyte

ROOT = Path(__file__).resolve().parents[1]
BROWSERS = ("chromium-headless-shell", "chromium", "google-chrome")
WIDTHS, SCHEMES = (400, 1300), ("light", "dark")
ROWS, LONGEST = 50, 240.0  # of a terminal; seconds that a program may take
FLY = ("-m", "mjxball.fly", "flight", "--rehearse", "--seconds", "2")
TRAIN = ("train.py", "paper", "--physics", "newton-euler", "--sac.total_steps", "12000", "--sac.warmup_steps", "2000")
PROGRAMS = {  # name: arguments of Python, in a folder of its own
    "train-help": ("train.py", "--help"),
    "train-preset-help": ("train.py", "balance", "--help"),
    "eval-help": ("eval.py", "--help"),
    "fly-help": ("-m", "mjxball.fly", "--help"),
    "view-help": ("-m", "mjxball.view", "--help"),
    "train": (*TRAIN, "--sac.replay_size", "12000", "--out", "run"),
    "eval": ("eval.py", "balance", "--physics", "newton-euler", "--seconds", "10"),
    "suite": (
        "eval.py",
        "--suite",
        "cg-speed",
        "--followers",
        "copy",
        "lqg",
        "--physics",
        "newton-euler",
        "--num-seeds",
        "1",
    ),
    "fly": FLY,
    "fly-fault": (*FLY, "--fault", "silent:leader@4"),
    "refused": ("eval.py", "nothing.npz"),
}
TERMINALS = {"40": (40, "xterm"), "80": (80, "xterm"), "130": (130, "xterm"), "dumb": (80, "dumb"), "none": (0, "")}


class Terminal(pyte.HistoryScreen):
    """A screen that counts the lines which it had to break."""

    broken = 0

    def draw(self, data: str) -> None:
        """See `pyte.Screen.draw`."""
        for letter in data:
            self.broken += self.cursor.x == self.columns
            super().draw(letter)

    def everything(self) -> str:
        """All lines, those that have left at the top included."""
        gone = ["".join(line[x].data for x in range(self.columns)).rstrip() for line in self.history.top]
        return "\n".join([*gone, *(line.rstrip() for line in self.display)]).rstrip() + "\n"


def in_terminal(arguments: tuple[str, ...], columns: int, kind: str, place: Path) -> tuple[str, int]:
    """What Python with `arguments` leaves in a terminal of `columns`, and how many lines that broke."""
    screen = Terminal(columns, ROWS, history=5000)
    stream, (ours, theirs) = pyte.ByteStream(screen), pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", ROWS, columns, 0, 0))
    with subprocess.Popen(
        [sys.executable, *arguments], cwd=place, env=environment(kind), stdin=theirs, stdout=theirs, stderr=theirs
    ) as program:
        os.close(theirs)
        end = time.monotonic() + LONGEST
        while time.monotonic() < end:
            readable, _, _ = select.select([ours], [], [], 0.5)
            try:
                data = os.read(ours, 1 << 16) if readable else b""
            except OSError:  # the program has ended
                break
            if readable and not data:
                break
            stream.feed(data)
        else:
            program.kill()
    os.close(ours)
    return screen.everything(), screen.broken


def environment(terminal: str) -> dict[str, str]:
    """Of a program in a `terminal` of that kind, with the sources of this checkout."""
    kept = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES", "NO_COLOR")}
    own = {"TERM": terminal} if terminal else {}
    return {**kept, "JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT), **own}


def terminals(out: Path, only: list[str]) -> Iterator[str]:
    """Every program in every terminal, as text in `out`; yields what is wrong."""
    for name, arguments in PROGRAMS.items():
        if only and name not in only and "terminals" not in only:
            continue
        words = tuple(str(ROOT / word) if word in ("train.py", "eval.py") else word for word in arguments)
        for label, (columns, kind) in TERMINALS.items():
            with tempfile.TemporaryDirectory() as place:
                if columns:
                    text, broken = in_terminal(words, columns, kind, Path(place))
                else:
                    done = subprocess.run(
                        [sys.executable, *words],
                        cwd=place,
                        env=environment(kind),
                        stdin=subprocess.DEVNULL,
                        stdout=subprocess.PIPE,
                        stderr=subprocess.STDOUT,
                        timeout=LONGEST,
                        check=False,
                    )
                    text, broken = done.stdout.decode(), 0
                    if "\x1b" in text:
                        yield f"{name}, no terminal: it is sent escapes"
            (out / f"{name}-{label}.txt").write_text(text, encoding="utf-8")
            print(f"{name} in {label}: {len(text.splitlines())} lines")
            if "error: " in text and name != "refused":
                yield f"{name}, {label}: {text[text.index('error: ') :].splitlines()[0]}"
            if broken:
                yield f"{name}, {label} columns: {broken} lines are broken"


def pages(place: Path, site: Path | None, only: list[str]) -> dict[str, Path]:
    """Pages to be looked at, made in `place`."""
    found = {
        "viewer": ("-m", "mjxball.view", "balance", "--omega", "0.62", "--amplitude", "0.1", "--seconds", "8"),
        "viewer-team": ("-m", "mjxball.view", "universal", "--plant", "team4", "--seconds", "8"),
        "viewer-two": (
            "-m",
            "mjxball.view",
            "balance",
            "copy",
            "--omega",
            "0.62",
            "--amplitude",
            "0.1",
            "--seconds",
            "8",
        ),
        "viewer-log": ("-m", "mjxball.view", "flight.jsonl"),
        "report": (
            str(ROOT / "eval.py"),
            "balance",
            "--followers",
            "copy",
            "--physics",
            "newton-euler",
            "--out",
            "report",
        ),
    }
    made = {}
    for name, words in found.items():
        if only and name not in only and "pages" not in only:
            continue
        if name == "viewer-log":
            asked = [*FLY, "--fault", "silent:leader@4", "--log", "flight.jsonl"]
            subprocess.run(
                [sys.executable, *asked], cwd=place, env=environment(""), check=False, stdout=subprocess.DEVNULL
            )
        page = place / ("report/report.html" if name == "report" else f"{name}.html")
        more = () if name == "report" else ("--physics", "newton-euler", "--out", str(page))
        more = ("--out", str(page)) if name == "viewer-log" else more
        command = [sys.executable, *words, *more]
        subprocess.run(command, cwd=place, env=environment(""), check=False, stdout=subprocess.DEVNULL)
        made[name] = page
    if site:
        made |= {f"site-{path.stem}": path for path in sorted(site.glob("*.html")) if not only or "site" in only}
    return made


def browsed(out: Path, made: dict[str, Path]) -> Iterator[str]:
    """Every page in every width and scheme, as a picture in `out`; yields what is wrong."""
    from playwright.sync_api import sync_playwright

    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        yield "no Chromium is installed"
        return
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=program, args=["--no-sandbox"])
        for name, page in made.items():
            if not page.exists():
                yield f"{name}: there is no page"
                continue
            for width in WIDTHS:
                for scheme in SCHEMES:
                    picture = out / f"{name}-{width}-{scheme}.png"
                    yield from (
                        f"{name}, {width} px, {scheme}: {text}"
                        for text in looked_at(browser, page, width, scheme, picture)
                    )
            print(f"{name}: {len(WIDTHS) * len(SCHEMES)} pictures")
        browser.close()


def looked_at(browser: Any, page: Path, width: int, scheme: Any, picture: Path) -> list[str]:
    """What is wrong with `page`; its picture is written."""
    tab = browser.new_page(viewport={"width": width, "height": 2400}, color_scheme=scheme)
    wrong: list[str] = []
    tab.on("pageerror", lambda error: wrong.append(str(error)))
    tab.on("console", lambda message: wrong.append(message.text) if message.type == "error" else None)
    tab.on(
        "request",
        lambda request: (
            None if request.url.startswith(("data:", "file:", "blob:")) else wrong.append(f"it fetches {request.url}")
        ),
    )
    tab.goto(page.as_uri())
    tab.wait_for_timeout(800)
    tab.screenshot(path=picture)
    beyond = tab.evaluate("document.documentElement.scrollWidth") - width
    if beyond > 0:
        wrong.append(f"hangs out at the side by {beyond} px")
    tab.close()
    return wrong


def main() -> int:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="PART", help="terminals, pages, site, or names of their parts"
    )
    parser.add_argument("--site", type=Path, metavar="DIR", help="built documentation, see CONTRIBUTING.md")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as place:
        wrong = [*terminals(options.out, options.only)]
        wrong += browsed(options.out, pages(Path(place), options.site, options.only))
    for line in wrong:
        print(f"WRONG {line}")
    print(f"{len(wrong)} faults; pictures and texts are in {options.out}")
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
