"""The documentation: it builds without a warning, loads nothing from elsewhere, and what it shows runs."""

from __future__ import annotations

import argparse
import html
import importlib
import json
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import pytest
from command_line import REPOSITORY, environment

from screens import CUT

DOCS = REPOSITORY / "docs"
pytestmark = pytest.mark.slow
PAGES = sorted([REPOSITORY / "README.md", REPOSITORY / "CONTRIBUTING.md", *DOCS.rglob("*.md")])
NOTEBOOK = DOCS / "notebooks" / "first_follower.ipynb"
RUN = [
    "docs/tutorial.md",
    "docs/view.md",
    *(f"docs/howto/own-{n}.md" for n in ("rig", "model", "reward", "baseline", "environment", "algorithm")),
]
MAINS = {
    "train.py": "mjxball.commands.train",
    "mjxball-train": "mjxball.commands.train",
    "eval.py": "mjxball.commands.evaluate",
    "mjxball-eval": "mjxball.commands.evaluate",
    "mjxball-view": "mjxball.view.main",
    "mjxball.export": "mjxball.export",
    "mjxball.view": "mjxball.view.main",
    "mjxfly": "mjxfly.main",
    "mjxfly.app": "mjxfly.app.main",
    "mjxfly.log": "mjxfly.log",
    "mjxfly.view": "mjxfly.view.main",
    "mjxball.assembly": "mjxball.assembly",
    "mjxfly.rig.design": "mjxfly.rig.design",
}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built pages. A warning is an error."""
    place = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-d", place / "trees", DOCS, place / "html"]
    # A graphics library that MuJoCo would load reports what it lacks on stderr.
    child = {**environment(), "PYTHONPATH": str(REPOSITORY), "MUJOCO_GL": "disabled"}
    done = subprocess.run(command, env=child, capture_output=True, text=True, timeout=900, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return place / "html"


class Loads(HTMLParser):
    """What a browser fetches by itself when it opens a page; links that a reader must click are none of it."""

    LINKS = frozenset(
        ("stylesheet", "icon", "shortcut", "preload", "prefetch", "preconnect", "dns-prefetch", "manifest")
    )

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in attrs}
        if tag == "link" and not self.LINKS & set(given.get("rel", "").split()):
            return
        names = [
            "src",
            "srcset",
            "data",
            "poster",
            "background",
            *(("href",) if tag in ("link", "use", "image") else ()),
        ]
        self.found += [given[name] for name in names if name in given]
        self.found += re.findall(r"url\(([^)]+)\)", given.get("style", ""))


def elsewhere(address: str) -> bool:
    """Whether `address` is not a file beside the page."""
    return bool(re.match(r"\s*['\"]?\s*(?:[a-z][a-z0-9+.-]*:)?//", address, re.IGNORECASE))


def test_pages_load_nothing_from_elsewhere(site: Path) -> None:
    pages = list(site.rglob("*.html"))
    assert len(pages) > 30
    for page in pages:
        loads = Loads()
        loads.feed(page.read_text())
        assert loads.found
        assert [address for address in loads.found if elsewhere(address)] == [], page
    for sheet in site.rglob("*.css"):
        text = sheet.read_text()
        assert [one for one in re.findall(r"url\(([^)]+)\)", text) if elsewhere(one)] == [], sheet
        assert not re.search(r"@import\s+(?:url\()?['\"]?(?:https?:)?//", text), sheet


def test_the_check_sees_what_it_must_see() -> None:
    loads = Loads()
    loads.feed('<script src="https://a/b.js"></script><link rel="stylesheet" href="//a/b.css"><img src="c.png">')
    loads.feed(
        '<a href="https://fine">x</a><link rel="canonical" href="https://fine"><p style="background:url(http://a)">'
    )
    assert loads.found == ["https://a/b.js", "//a/b.css", "c.png", "http://a"]
    assert [elsewhere(address) for address in loads.found] == [True, True, False, True]


def test_pages_fit_in_a_browser(site: Path, browser: Any) -> None:
    """On a desktop and on a phone."""
    tab = browser.new_page()
    requests: list[str] = []
    errors: list[str] = []
    tab.on("request", lambda request: requests.append(request.url))
    tab.on("pageerror", lambda error: errors.append(str(error)))
    for page in sorted(site.rglob("*.html")):
        tab.goto(page.as_uri())
        for width in (1300, 390):
            tab.set_viewport_size({"width": width, "height": 800})
            assert tab.evaluate("document.documentElement.scrollWidth") <= width, page.name
            assert tab.eval_on_selector_all("pre", CUT) == [], page.name
        assert tab.eval_on_selector_all("img", "all => all.every(one => one.naturalWidth > 0)"), page.name
    assert [url for url in requests if not url.startswith(("file:", "data:"))] == []
    assert errors == []


@pytest.mark.parametrize(("words", "page"), [("simulate_batch", "flights"), ("disturbance observer", "followers")])
def test_the_search_finds_names_and_words(site: Path, browser: Any, words: str, page: str) -> None:
    """From disk, without a server."""
    tab = browser.new_page()
    errors: list[str] = []
    tab.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    tab.goto(f"{(site / 'search.html').as_uri()}?q={words}")
    tab.wait_for_selector("#search-results h2:has-text('Search Results')", timeout=20_000)  # it lists them one by one
    assert page in tab.inner_text("#search-results").lower()
    assert errors == []


def test_pictures_are_small_and_still_ones_are_the_scripts() -> None:
    sys.path.append(str(DOCS))
    from pictures import MADE

    named = {name for page in PAGES for name in re.findall(r"!\[[^]]*\]\(([^)]+)\)", page.read_text())}
    shown = {Path(name).name for name in named if "://" not in name}  # a badge is elsewhere
    quoted = {name for page in PAGES for name in re.findall(r"\{literalinclude\} (\S+)", page.read_text())}
    assert set(MADE) <= shown | quoted
    assert shown - set(MADE) <= {"balance.gif", "architecture.svg", "loop.svg", "real-flights.svg"}
    for name in shown - {"balance.gif"}:
        assert (DOCS / name).stat().st_size < 150_000, name


def test_formulas_are_the_browsers_own(site: Path) -> None:
    text = (site / "model.html").read_text()
    assert text.count("<math") > 50
    assert "\\frac" not in text
    assert "mathjax" not in "".join(re.findall(r"<script[^>]*>", text)).lower()
    assert "munderover><mi>" not in text.replace("\n", "")  # an accented letter's subscript stands beside it


def test_the_reference_states_shapes_and_units(site: Path) -> None:
    """Shapes in signatures and comments beside fields come through, and so does every setting."""
    flights = html.unescape(re.sub(r"<[^>]+>", "", (site / "reference" / "flights.html").read_text()))
    assert "position: Float[Array, '... 3']" in flights.replace("…", "...")
    assert re.search(r"position:? *(?:– |— )?of O in the world \[m\]", flights)
    settings = (site / "reference" / "settings.html").read_text()
    for flag in ("--plant.object_mass", "--sac.total_steps", "--reward.error_scale"):
        assert flag in settings


def shown(text: str) -> Iterator[list[str]]:
    """Every command of this project that a Markdown text shows, as words: in blocks for the shell, and inline."""
    blocks = re.findall(r"^```(?:bash|sh)\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE)
    lines = [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]
    prose = re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)
    lines += [" ".join(span.split()) for span in re.findall(r"`([^`]+)`", prose)]
    for line in lines:
        if match := re.search(r"(?:^|\s|/)(?:python3? (?:-m )?|(?=mjx[a-z]+-[a-z]+(?:\s|$)))(\S+(?:\s.*)?)$", line):
            words = shlex.split(match[1], comments=True)
            if len(words) > 1 and (words[0] in MAINS or words[0].startswith("benchmarks/")):
                yield words


class ParsedError(BaseException):
    """Raised once the command line has been read, before anything is done."""


def parses(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """The program's own parser accepts the words; a sentence of refusal fails the test."""
    read = argparse.ArgumentParser.parse_args

    def stop(parser: argparse.ArgumentParser, args: Any = None, namespace: Any = None) -> None:
        read(parser, args, namespace)
        raise ParsedError

    main = importlib.import_module(MAINS[words[0]]).main
    numbers = [re.sub(r"(?<![A-Za-z])[A-Z]$", "1", word) for word in words[1:]]  # `--seed N`
    with monkeypatch.context() as patch:
        patch.setattr(argparse.ArgumentParser, "parse_args", stop)
        with pytest.raises((ParsedError, SystemExit)) as ended:
            main(numbers)
    assert isinstance(ended.value, ParsedError) or ended.value.code == 0, words  # --help, --version


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(REPOSITORY)))
def test_commands_parse(page: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for words in shown(page.read_text()):
        gone = page.parent.name == "archive" and words[0] not in MAINS and not (REPOSITORY / words[0]).exists()
        if "..." in words or gone:  # an archive tells of scripts as they were
            continue
        if words[0] in MAINS:
            parses(words, monkeypatch)
        else:
            source = (REPOSITORY / words[0]).read_text()
            unknown = [word for word in words if re.match(r"--\w", word) and word.split("=")[0].strip() not in source]
            assert unknown == [], words


def test_the_reader_of_commands() -> None:
    block = "python train.py paper --seed 3  # why\n.venv/bin/python eval.py \\\n bench\nls"
    text = f"```bash\n{block}\n```\n`python -m mjxfly\nx.npz`, `python -m mjxfly`"
    assert list(shown(text)) == [["train.py", "paper", "--seed", "3"], ["eval.py", "bench"], ["mjxfly", "x.npz"]]


def test_a_flag_that_does_not_exist_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(AssertionError):
        parses(["eval.py", "--no-such-flag"], monkeypatch)


@pytest.mark.parametrize("page", RUN)
def test_python_on_the_page_runs(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """All blocks of a page, in order, in one namespace, as a reader would type them; their asserts count.

    A block of TOML or XML that begins with a file's name is that file.
    """
    (tmp_path / "policies").symlink_to(REPOSITORY / "policies")
    monkeypatch.chdir(tmp_path)
    text = (REPOSITORY / page).read_text()
    named = r"^```(?:toml|xml)\n((?:#|<!--) (\S+\.(?:toml|xml))(?: -->)?\n.*?)^```"
    for block, name in re.findall(named, text, flags=re.DOTALL | re.MULTILINE):
        (tmp_path / name).write_text(block)
    blocks = re.findall(r"^```python\n(.*?)^```", text, flags=re.DOTALL | re.MULTILINE)
    assert blocks
    names: dict[str, Any] = {"__name__": "page"}
    for number, block in enumerate(blocks):
        exec(compile(block, f"{page}, block {number + 1}", "exec"), names)


def test_the_notebook_is_stored_without_outputs() -> None:
    cells = json.loads(NOTEBOOK.read_text())["cells"]
    assert all(
        cell["outputs"] == [] and cell["execution_count"] is None for cell in cells if cell["cell_type"] == "code"
    )


def stored(cell: dict[str, Any], kind: str) -> Path:
    """The output of a cell of the notebook that the site shows."""
    return NOTEBOOK.with_name(f"{NOTEBOOK.stem}-{cell['id']}{kind}")


def test_stored_outputs_of_the_notebook_are_small_and_of_its_cells() -> None:
    found = set(NOTEBOOK.parent.glob(f"{NOTEBOOK.stem}-*"))
    cells = json.loads(NOTEBOOK.read_text())["cells"]
    assert found <= {stored(cell, kind) for cell in cells for kind in (".txt", ".svg", ".png")}
    assert len(found) == 6
    assert max(path.stat().st_size for path in found) < 150_000
    assert all(
        cell["metadata"]["alt"] for cell in cells if not {stored(cell, ".svg"), stored(cell, ".png")}.isdisjoint(found)
    )


@pytest.mark.release
def test_the_notebook_runs() -> None:
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(NOTEBOOK, as_version=4)
    nbformat.validate(notebook)
    NotebookClient(
        notebook, timeout=120, kernel_name="python3", resources={"metadata": {"path": NOTEBOOK.parent}}
    ).execute()
    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    printed = "".join(output.get("text", "") for output in outputs if output.get("name") == "stdout")
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 2
    shown = "".join(stored(cell, ".txt").read_text() for cell in notebook.cells if stored(cell, ".txt").exists())
    number = r"\d+\.\d+"
    assert re.sub(number, "", shown) == re.sub(number, "", printed)  # `python docs/pictures.py notebook`
    assert [*map(float, re.findall(number, shown))] == pytest.approx(
        [*map(float, re.findall(number, printed))], rel=1e-3, abs=2e-4
    )
    swayed = {name: float(far) for name, far in re.findall(r"^(\w+) +sways (\S+) m +settles", printed, re.MULTILINE)}
    assert swayed["copy"] > 0.29  # docs/mimicking.md: 0.296 m
    assert max(swayed["lqg"], swayed["transport-large"]) < 0.01
    predicted, flown = map(float, re.search(r"predicted (\S+) m, flown (\S+) m", printed).groups())
    assert abs(predicted - flown) < 5e-4  # what the last of 45 s leaves of the swing
