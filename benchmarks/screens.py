"""All that a person looks at, in one run: a real browser and a real pseudo-terminal, as pictures and text in a folder.

`python benchmarks/screens.py OUT [--only PART ...] [--site DIR]`

Pages at 400 and 1300 pixels, light and dark: the viewer, recorded and live, the report, figures, a notebook, and
TensorBoard, without which its tags are a text. Figures of flights, on the screen's style and on paper. Programs in
terminals of 40, 80 and 130 columns, one that cannot go back on a line, and none at all. Exit code 1, with a line for
each, if a page logs an error, makes one, fetches something from elsewhere or hangs out at the side, or if a terminal
breaks a line.
"""

from __future__ import annotations

import argparse
import importlib.util
import itertools
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.append(str(ROOT / "tests"))
from command_line import environment  # noqa: E402
from pseudo_terminal import on_terminal  # noqa: E402

BROWSERS = ("chromium-headless-shell", "chromium", "google-chrome")
WIDTHS, SCHEMES = (400, 1300), ("light", "dark")
LONGEST = 600.0  # [s] that a program may take
VARIABLES = {**environment(), "PYTHONPATH": str(ROOT)}
ENGINE = ("--physics", "newton-euler")
FLY = ("-m", "mjxball.fly", "flight", "--rehearse", "--seconds", "2")
FAULT = ("--fault", "silent:leader@4")
TRAIN = ("train.py", "paper", *ENGINE, "--sac.total_steps", "12000", "--sac.warmup_steps", "2000")
TRAIN = (*TRAIN, "--sac.replay_size", "12000", "--out", "run")
VIEW, FLOWN = ("-m", "mjxball.view"), ("--omega", "0.62", "--amplitude", "0.1", "--seconds", "8", *ENGINE, "--out")
PROGRAMS = {  # name: arguments of Python, in a folder of its own
    "train-help": ("train.py", "--help"),
    "train-preset-help": ("train.py", "balance", "--help"),
    "eval-help": ("eval.py", "--help"),
    "fly-help": ("-m", "mjxball.fly", "--help"),
    "view-help": (*VIEW, "--help"),
    "train": TRAIN,
    "eval": ("eval.py", "balance", *ENGINE, "--seconds", "10"),
    "suite": ("eval.py", "--suite", "cg-speed", "--followers", "copy", "lqg", *ENGINE, "--num-seeds", "1"),
    "fly": FLY,
    "fly-fault": (*FLY, *FAULT),
    "refused": ("eval.py", "nothing.npz"),
}
TERMINALS = {"40": (40, "xterm"), "80": (80, "xterm"), "130": (130, "xterm"), "dumb": (80, "dumb"), "none": (0, "")}
NOTEBOOK = """
import html, sys, nbclient, nbformat
book = nbclient.NotebookClient(nbformat.read(sys.argv[1], as_version=4), kernel_name="python3").execute()
outputs = [output for cell in book.cells for output in cell.get("outputs", ())]
with open("notebook.html", "w") as page:
    for one in (output.get("data", {"text/plain": output.get("text")}) for output in outputs):
        picture = f'<img style="max-width: 100%" src="data:image/png;base64,{one.get("image/png")}">'
        text = f'<pre style="white-space: pre-wrap">{html.escape(one["text/plain"])}</pre>'
        page.write(one.get("text/html") or (picture if "image/png" in one else text))
"""
TAGS = r"""
import pathlib, re
with open("tags.txt", "w") as out:
    for path in sorted(pathlib.Path("run/tensorboard").rglob("events*")):
        tags = {tag.decode() for tag in re.findall(rb"(?:speed|exploring|update|evaluation)/\w+", path.read_bytes())}
        print(path.parent.name, *sorted(tags), sep="\n  ", file=out)
"""
SERVER = "http"  # what it says that it serves is looked at
# name: arguments of Python, in one folder for all; what is looked at then, files or a server; what must be made before
SEEN: dict[str, tuple[tuple[str, ...], str, tuple[str, ...]]] = {
    "viewer": ((*VIEW, "balance", *FLOWN, "viewer.html"), "viewer.html", ()),
    "viewer-team": ((*VIEW, "universal", "--plant", "team4", *FLOWN, "team.html"), "team.html", ()),
    "viewer-two": ((*VIEW, "balance", "copy", *FLOWN, "two.html"), "two.html", ()),
    "log": ((*FLY, "--log", "flight.jsonl"), "", ()),
    "log-fault": ((*FLY, *FAULT, "--log", "fault.jsonl"), "", ()),
    "viewer-log": ((*VIEW, "fault.jsonl", "--out", "log.html"), "log.html", ("log-fault",)),
    "live": ((*VIEW, "fault.jsonl", "--live"), SERVER, ("log-fault",)),
    "flight": (("eval.py", "--flight", "flight.jsonl", "--out", "flown"), "flown/*.png", ("log",)),
    "paper": (("eval.py", "--flight", "flight.jsonl", "--style", "paper", "--out", "ink"), "ink/*.pdf", ("log",)),
    "report": (("eval.py", "balance", "--followers", "copy", *ENGINE, "--out", "report"), "report/*.[hp][tn]*", ()),
    "figures": (("eval.py", "balance", "--figures", "all", *ENGINE, "--out", "figures"), "figures/*.html", ()),
    "notebook": (("-c", NOTEBOOK, str(ROOT / "docs/notebooks/first_follower.ipynb")), "notebook.html", ()),
    "training": (TRAIN, "run/eval/*.png", ()),
    "tensorboard": (
        ("-m", "tensorboard.main", "--logdir", "run", "--port", "0", "--load_fast=false"),
        SERVER,
        ("training",),
    ),
    "tags": (("-c", TAGS), "tags.txt", ("training",)),
}

# Lines of code and output that end beyond their block, and on a wide page what has more lines than its text.
CUT = """blocks => blocks.filter(block => {
  const { paddingTop, paddingBottom, lineHeight } = getComputedStyle(block);
  const wide = innerWidth > 1000 && !block.closest('details');
  const lines = (block.clientHeight - parseFloat(paddingTop) - parseFloat(paddingBottom)) / parseFloat(lineHeight);
  const broken = wide && Math.round(lines) > block.textContent.trimEnd().split('\\n').length;
  return block.scrollWidth > block.clientWidth || broken;
}).map(block => block.textContent.split('\\n')[0])"""


def terminals(out: Path, only: list[str]) -> Iterator[str]:
    """Every program in every terminal, as text in `out`; yields what is wrong."""
    for name in chosen(PROGRAMS, only, "terminals"):
        for label, (columns, kind) in TERMINALS.items():
            with tempfile.TemporaryDirectory() as place:
                if columns:
                    seen = on_terminal(words(PROGRAMS[name]), columns, Path(place), kind)
                    text, broken = f"{seen.text}\n", seen.wrapped
                else:
                    text, broken = piped(PROGRAMS[name], Path(place)), 0
                    if "\x1b" in text:
                        yield f"{name}, no terminal: it is sent escapes"
            (out / f"{name}-{label}.txt").write_text(text, encoding="utf-8")
            print(f"{name} in {label}: {len(text.splitlines())} lines", flush=True)
            if "error: " in text and name != "refused":
                yield f"{name}, {label}: {text[text.index('error: ') :].splitlines()[0]}"
            if broken:
                yield f"{name}, {label} columns: {broken} lines are broken"


def chosen(names: Iterable[str], only: list[str], kind: str) -> list[str]:
    """Of `names`, all of a `kind`, those that `only` asks for."""
    return [name for name in names if not only or name in only or kind in only]


def words(arguments: tuple[str, ...]) -> list[str]:
    """`arguments` of Python, with the scripts of this checkout."""
    return [sys.executable, *(str(ROOT / word) if word in ("train.py", "eval.py") else word for word in arguments)]


def piped(arguments: tuple[str, ...], place: Path) -> str:
    """What Python with `arguments` prints where there is no terminal."""
    command: dict[str, Any] = {"cwd": place, "env": VARIABLES, "text": True, "timeout": LONGEST}
    streams: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    return subprocess.run(words(arguments), check=False, **command, **streams).stdout


def make(name: str, place: Path, made: set[str]) -> None:
    """Run what `name` of `SEEN` needs in `place`, and its own program, unless that is `made` or serves."""
    arguments, seen, before = SEEN[name]
    for needed in before:
        make(needed, place, made)
    if name not in made and seen != SERVER:
        piped(arguments, place)
    made.add(name)


def pages(out: Path, site: Path | None, only: list[str]) -> Iterator[str]:
    """All of `SEEN` and of the `site` as pictures in `out`; yields what is wrong."""
    from playwright.sync_api import sync_playwright

    program = next(filter(None, map(shutil.which, BROWSERS)), None)
    if program is None:
        yield "no Chromium is installed"
        return
    made: set[str] = set()
    with sync_playwright() as play, tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        place, browser = Path(folder), play.chromium.launch(executable_path=program, args=["--no-sandbox"])
        for name in chosen(SEEN, only, "pages"):
            arguments, seen, _ = SEEN[name]
            if arguments[1] == "tensorboard.main" and importlib.util.find_spec("tensorboard") is None:
                continue
            make(name, place, made)
            if seen == SERVER:
                yield from pictured(browser, name, stack.enter_context(serving(arguments, place)), out)
                continue
            found = sorted(place.glob(seen)) if seen else []
            if seen and not found:
                yield f"{name}: nothing was made"
            for path in found:
                if path.suffix == ".html":
                    yield from pictured(browser, name, path.as_uri(), out)
                else:
                    shutil.copy(path, out / f"{name}-{path.name}")
        for path in sorted(site.resolve().rglob("*.html")) if site and chosen(["site"], only, "pages") else ():
            yield from pictured(browser, f"site-{path.stem}", path.as_uri(), out)
        browser.close()


@contextmanager
def serving(arguments: tuple[str, ...], place: Path) -> Iterator[str]:
    """The address at which Python with `arguments` says that it serves."""
    streams: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    with subprocess.Popen(words(arguments), cwd=place, env=VARIABLES, text=True, **streams) as server:
        yield next(found[0] for line in server.stdout or () if (found := re.search(r"http://[^\s/]+/?", line)))
        server.terminate()


def pictured(browser: Any, name: str, address: str, out: Path) -> Iterator[str]:
    """A page in every width and scheme, as pictures in `out`; yields what is wrong."""
    for width, scheme in itertools.product(WIDTHS, SCHEMES):
        wrong = looked_at(browser, address, width, scheme, out / f"{name}-{width}-{scheme}.png")
        yield from (f"{name}, {width} px, {scheme}: {text}" for text in wrong)
    print(f"{name}: {len(WIDTHS) * len(SCHEMES)} pictures", flush=True)


def looked_at(browser: Any, address: str, width: int, scheme: str, picture: Path) -> list[str]:
    """What is wrong with the page at `address`; its picture is written."""
    tab = browser.new_page(viewport={"width": width, "height": 2400}, color_scheme=scheme)
    wrong: list[str] = []
    own = ("data:", "file:", "blob:", "about:", *([address] if address.startswith(SERVER) else []))
    tab.on("pageerror", lambda error: wrong.append(str(error)))
    tab.on("console", lambda message: wrong.append(message.text) if message.type == "error" else None)
    tab.on("request", lambda one: None if one.url.startswith(own) else wrong.append(f"it fetches {one.url}"))
    tab.goto(address)
    tab.wait_for_timeout(5000 if address.startswith(SERVER) else 800)
    tab.screenshot(path=picture)
    beyond = tab.evaluate("document.documentElement.scrollWidth") - width
    if beyond > 0:
        wrong.append(f"hangs out at the side by {beyond} px")
    wrong += [f"a block is cut or broken: {text}" for text in tab.eval_on_selector_all("pre", CUT)]
    tab.close()
    return wrong


def main() -> int:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    known = "terminals, pages, site, or names of their parts"
    parser.add_argument("--only", nargs="+", default=[], metavar="PART", help=known)
    parser.add_argument("--site", type=Path, metavar="DIR", help="built documentation, see CONTRIBUTING.md")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    wrong = [*terminals(options.out, options.only), *pages(options.out, options.site, options.only)]
    for line in wrong:
        print(f"WRONG {line}")
    print(f"{len(wrong)} faults; pictures and texts are in {options.out}")
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
