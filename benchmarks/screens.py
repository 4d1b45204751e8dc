"""All that a person looks at, in one run: a real browser and a real pseudo-terminal, as pictures and text in a folder.

`python benchmarks/screens.py OUT [--only PART ...] [--site DIR] [--before DIR]`

Pages at 400 and 1300 pixels, light and dark: the viewer, recorded and live, the report, figures, a notebook, and
TensorBoard, without which its tags are a text. Figures of flights, on the screen's style and on paper. Programs in
terminals of 40, 80 and 130 columns, one that cannot go back on a line, and none at all. Exit code 1, with a line for
each, if a page logs an error, makes one, fetches something from elsewhere, hangs out at the side or folds code, or if a
terminal breaks a line. `--before`: changes.html has what an earlier run, whose OUT is DIR, saw otherwise, side by side.
"""

from __future__ import annotations

import argparse
import filecmp
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
TEXT: dict[str, Any] = {"env": VARIABLES, "text": True, "stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
ENGINE = ("--physics", "newton-euler")
FLY = ("-m", "mjxfly", "flight", "--rehearse", "--seconds", "2")
FAULT = ("--fault", "silent:leader@4")
TRAIN = ("train.py", "paper", *ENGINE, "--sac.total_steps", "12000", "--sac.warmup_steps", "2000")
TRAIN = (*TRAIN, "--sac.replay_size", "12000", "--out", "run")
VIEW, FLOWN = ("-m", "mjxfly.view"), ("--omega", "0.62", "--amplitude", "0.1", "--seconds", "8", *ENGINE, "--out")
PROGRAMS = {  # name: arguments of Python, in a folder of its own
    "train-help": ("train.py", "balance", "--help"),
    "eval-help": ("eval.py", "--help"),
    "fly-help": ("-m", "mjxfly", "--help"),
    "view-help": (*VIEW, "--help"),
    "train": TRAIN,
    "eval": ("eval.py", "balance", *ENGINE, "--seconds", "10"),
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
        text = f'<pre style="overflow-x: auto">{html.escape(one["text/plain"])}</pre>'
        page.write(one.get("text/html") or (picture if "image/png" in one else text))
"""
TAGS = r"""
import pathlib, re
with open("tags.txt", "w") as out:
    for path in sorted(pathlib.Path("run/tensorboard").rglob("events*")):
        tags = {tag.decode() for tag in re.findall(rb"(?:speed|exploring|update|evaluation)/\w+", path.read_bytes())}
        print(path.parent.name, *sorted(tags), sep="\n  ", file=out)
"""
BOARD = ("-m", "tensorboard.main", "--logdir", "run", "--port", "0", "--load_fast=false")
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
    "flight": (("-m", "mjxfly.log", "flight.jsonl", "flown"), "flown/*.png", ("log",)),
    "paper": (("-m", "mjxfly.log", "flight.jsonl", "ink", "--style", "paper"), "ink/*.pdf", ("log",)),
    "report": (("eval.py", "balance", "--followers", "copy", *ENGINE, "--out", "report"), "report/*.[hp][tn]*", ()),
    "figures": (("eval.py", "figures", "balance", *ENGINE, "--out", "figures"), "figures/*.html", ()),
    "notebook": (("-c", NOTEBOOK, str(ROOT / "docs/notebooks/first_follower.ipynb")), "notebook.html", ()),
    "training": (TRAIN, "run/eval/*.png", ()),
    "tensorboard": (BOARD, SERVER, ("training",)),
    "tags": (("-c", TAGS), "tags.txt", ("training",)),
}

# Blocks of code and output whose lines are folded, or end beyond the block if it does not scroll or the page is wide.
CUT = """blocks => blocks.filter(block => {
  const { paddingTop, paddingBottom, lineHeight, overflowX } = getComputedStyle(block);
  const scrolls = overflowX === 'auto' && (innerWidth < 1000 || block.closest('details'));
  const lines = (block.clientHeight - parseFloat(paddingTop) - parseFloat(paddingBottom)) / parseFloat(lineHeight);
  const folded = Math.round(lines) > block.textContent.trimEnd().split('\\n').length;
  return folded || (block.scrollWidth > block.clientWidth && !scrolls);
}).map(block => block.textContent.split('\\n')[0])"""


def terminals(out: Path, only: list[str]) -> Iterator[str]:
    """Every program in every terminal, as text in `out`; yields what is wrong."""
    for name in chosen(PROGRAMS, only, "terminals"):
        for label, (columns, kind) in TERMINALS.items():
            with tempfile.TemporaryDirectory() as place:
                seen = on_terminal(words(PROGRAMS[name]), columns, Path(place), kind) if columns else None
                text = piped(PROGRAMS[name], Path(place)) if seen is None else f"{seen.text}\n"
            (out / f"{name}-{label}.txt").write_text(text, encoding="utf-8")
            print(f"{name} in {label}: {len(text.splitlines())} lines", flush=True)
            if seen is None and "\x1b" in text:
                yield f"{name}, no terminal: it is sent escapes"
            if "error: " in text and name != "refused":
                yield f"{name}, {label}: {text[text.index('error: ') :].splitlines()[0]}"
            if seen is not None and seen.wrapped:
                yield f"{name}, {label} columns: {seen.wrapped} lines are broken"


def chosen(names: Iterable[str], only: list[str], kind: str) -> list[str]:
    """Of `names`, all of a `kind`, those that `only` asks for."""
    return [name for name in names if not only or name in only or kind in only]


def words(arguments: tuple[str, ...]) -> list[str]:
    """`arguments` of Python, with the scripts of this checkout."""
    return [sys.executable, *(str(ROOT / word) if word in ("train.py", "eval.py") else word for word in arguments)]


def piped(arguments: tuple[str, ...], place: Path) -> str:
    """What Python with `arguments` prints where there is no terminal."""
    given = {"cwd": place, "timeout": LONGEST, "stdin": subprocess.DEVNULL, **TEXT}
    return subprocess.run(words(arguments), check=False, **given).stdout


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
            if arguments == BOARD and importlib.util.find_spec("tensorboard") is None:
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
            name = "-".join(("site", *path.relative_to(site.resolve()).with_suffix("").parts))
            yield from pictured(browser, name, path.as_uri(), out)
        browser.close()


@contextmanager
def serving(arguments: tuple[str, ...], place: Path) -> Iterator[str]:
    """The address at which Python with `arguments` says that it serves."""
    with subprocess.Popen(words(arguments), cwd=place, stdin=subprocess.PIPE, **TEXT) as server:
        yield next(found[0] for line in server.stdout or () if (found := re.search(r"http://[^\s/]+/?", line)))
        server.terminate()


def pictured(browser: Any, name: str, address: str, out: Path) -> Iterator[str]:
    """A page in every width and scheme, as pictures in `out`; yields what is wrong."""
    own = ("data:", "file:", "blob:", "about:", *([address] if address.startswith(SERVER) else []))
    for width, scheme in itertools.product(WIDTHS, SCHEMES):
        tab = browser.new_page(viewport={"width": width, "height": 2400}, color_scheme=scheme)
        wrong: list[str] = []
        tab.on("pageerror", lambda error, to=wrong: to.append(str(error)))
        tab.on("console", lambda message, to=wrong: to.append(message.text) if message.type == "error" else None)
        tab.on("request", lambda one, to=wrong: None if one.url.startswith(own) else to.append(f"it fetches {one.url}"))
        tab.goto(address)
        tab.wait_for_timeout(5000 if address.startswith(SERVER) else 800)
        tab.screenshot(path=out / f"{name}-{width}-{scheme}.png", full_page=True)
        if (beyond := tab.evaluate("document.documentElement.scrollWidth") - width) > 0:
            wrong.append(f"hangs out at the side by {beyond} px")
        wrong += [f"a block is cut or folded: {text}" for text in tab.eval_on_selector_all("pre", CUT)]
        tab.close()
        yield from (f"{name}, {width} px, {scheme}: {text}" for text in wrong)
    print(f"{name}: {len(WIDTHS) * len(SCHEMES)} pictures", flush=True)


def compare(out: Path, before: Path) -> None:
    """Write `changes.html`: pictures and texts that are not as they were in `before`, side by side."""
    names = sorted(path.name for path in out.iterdir() if path.suffix in (".png", ".txt"))
    _, other, missing = filecmp.cmpfiles(before, out, names, shallow=False)
    with (out / "changes.html").open("w", encoding="utf-8") as page:
        print("<style>iframe { width: 49%; height: 75vh; zoom: 0.6 }</style>", file=page)
        for name in sorted(other + missing):
            pair = ((place / name).resolve().as_uri() for place in (before, out))
            print(f"<h2>{name}</h2>", *(f'<iframe src="{one}"></iframe>' for one in pair), file=page)
    print(f"{len(other + missing)} of {len(names)} are not as in {before}: {page.name}")


def main() -> int:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--only", nargs="+", default=[], metavar="PART", help="terminals, pages, site, or their parts")
    parser.add_argument("--before", type=Path, metavar="DIR", help="OUT of an earlier run, to be shown beside this one")
    parser.add_argument("--site", type=Path, metavar="DIR", help="built documentation, see CONTRIBUTING.md")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    wrong = [*terminals(options.out, options.only), *pages(options.out, options.site, options.only)]
    sys.stdout.writelines(f"WRONG {line}\n" for line in wrong)
    if options.before:
        compare(options.out, options.before)
    print(f"{len(wrong)} faults; pictures and texts are in {options.out}")
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
