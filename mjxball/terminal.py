"""Output at a terminal by rich: a status that is redrawn in place, and tables. Without a terminal plain lines.

rich takes 40 ms to import, but flax imports it anyway.
"""

from __future__ import annotations

import contextlib
import io
import math
import os
import re
import sys
import textwrap
import threading
import time
import unicodedata
from collections.abc import Callable, Sequence
from typing import Any, TextIO

PERIOD = 0.5  # [s] between two redraws
SOON, QUIET = 0.6, 4.0  # [s] after which `Working` prints its first line, and each other
GAP = "  "  # between the parts of a line
LONGEST = 900  # characters of an error message
Lines = Sequence[Sequence[str]]  # lines, each a list of parts, the most important part first


def is_live(stream: TextIO) -> bool:
    """Whether `stream` is a terminal that can redraw a line."""
    return not stream.closed and stream.isatty() and os.environ.get("TERM", "dumb") not in ("dumb", "unknown", "")


def columns_of(stream: TextIO) -> int:
    """Current width of the terminal `stream` [columns]; 80 if unknown."""
    try:
        return os.get_terminal_size(stream.fileno()).columns or 80
    except (OSError, ValueError):
        return 80


def fitted(parts: Sequence[str], columns: int) -> str:
    """The first of `parts` that fit into a line of `columns`, joined; the first part is cut if it is too long."""
    line = parts[0][:columns] if parts else ""
    for part in parts[1:]:
        if len(line) + len(GAP) + len(part) > columns:
            break
        line += GAP + part
    return line


def folded(text: str, columns: int) -> str:
    """`text` wrapped to `columns` between words, or only at double blanks if the parts between these fit."""
    parts = re.split(r"  +", text.strip())
    if len(parts) > 1 and max(map(len, parts)) <= columns:
        text = re.sub(r"(?<=\S) (?=\S)", "\xa0", text)
    return textwrap.fill(text, columns, break_on_hyphens=False).replace("\xa0", " ")


BIDI_CONTROLS = ("LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI")  # change the direction of text


def fitted_to(stream: TextIO | None, text: str) -> str:
    """`text` with control characters replaced by blanks, `folded` if `stream` is a terminal. None: a closed stream."""
    text = "".join(letter if _prints(letter) else " " for letter in text)
    return folded(text, columns_of(stream)) if stream and stream.isatty() else text


def _prints(letter: str) -> bool:
    """Whether `letter` is printable, a blank, a joiner or a newline, and no control of terminal or text direction."""
    if letter.isprintable() or letter == "\n":
        return True
    return unicodedata.category(letter) in ("Cf", "Zs") and unicodedata.bidirectional(letter) not in BIDI_CONTROLS


def say(text: str) -> None:
    """Print a sentence on stdout and flush; at a terminal it is wrapped between words."""
    _print(text, sys.stdout)


def warn(text: str) -> None:
    """`say` on stderr."""
    _print(text, sys.stderr)


def _print(text: str, stream: TextIO | None) -> None:
    """Write text and newline in one call: `print` makes two, between which another thread may write."""
    if stream:
        stream.write(f"{fitted_to(stream, text)}\n")
        stream.flush()


def sentence(text: str) -> str:
    """An error message `text` as one line of at most `LONGEST` characters."""
    line = " ".join(text.splitlines())
    return line if len(line) <= LONGEST else f"{line[:LONGEST]} ..."


class Status:
    """Lines at the bottom of a terminal, redrawn in place and cut to its width, with permanent lines above them.

    Without a terminal, or in one that cannot redraw a line, only the permanent lines are printed.
    """

    def __init__(self, stream: TextIO | None = None):
        self._given = stream
        self.live = self._stream is not None and is_live(self._stream)
        self._shown: Callable[[], Lines] = list
        self._display: Any = None

    @property
    def _stream(self) -> Any:
        """The stream; stderr as it is now, which another status may redirect above its lines, or None if closed."""
        return self._given or sys.stderr

    def show(self, lines: Callable[[], Lines]) -> None:
        """Show the result of `lines`, which is called again every `PERIOD`."""
        self._shown = lines
        if not self.live:
            return
        if self._display is None:
            self._display = _display(self._stream, self._render)
            self._display.start()
        self._display.refresh()

    def say(self, text: str) -> None:
        """Print `text` permanently; at a terminal it is wrapped between words."""
        self._print(fitted_to(self._stream, text))

    def row(self, parts: Sequence[str]) -> None:
        """Print `parts` permanently on one line; at a terminal as many as fit."""
        fits = self._stream is not None and self._stream.isatty()
        self._print(fitted(parts, columns_of(self._stream)) if fits else GAP.join(parts))

    def _print(self, text: str) -> None:
        if self._stream is None:
            return
        if self._display is None:
            print(text, file=self._stream, flush=True)
        else:
            self._display.console.print(text)

    def close(self) -> None:
        """Remove the status."""
        if self._display is not None:
            self._display.stop()
        self._display, self.live = None, False

    def _render(self) -> Any:
        from rich.text import Text

        columns = columns_of(self._stream)
        return Text("\n".join(fitted(parts, columns) for parts in self._shown()), no_wrap=True)


class Working:
    """Says on stderr what a program does, and while that lasts every few seconds how far it is: a context manager.

    At a terminal one line is redrawn and removed at the end, else lines are printed. What takes less than `SOON` passes
    in silence.
    """

    def __init__(self, text: str):
        """`text`: such as "flying 3 followers"."""
        self._text, self._status, self._share = text, Status(), math.nan
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._report, daemon=True)

    def __call__(self, share: float) -> None:
        """Note the `share` that is done, 0 to 1."""
        self._share = share

    def __enter__(self) -> Working:
        self._began = time.monotonic()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        self._status.close()

    def _parts(self) -> list[str]:
        share = [] if math.isnan(self._share) else [f"{self._share:.0%}"]
        return [self._text, *share, f"{time.monotonic() - self._began:.0f} s"]

    def _report(self) -> None:
        with contextlib.suppress(OSError, ValueError):  # a stream that is closed or full stops no work
            self._say()

    def _say(self) -> None:
        if self._ended.wait(SOON):
            return
        if self._status.live:
            self._status.show(lambda: [self._parts()])
            return
        self._status.row([f"{self._text} ..."])
        while not self._ended.wait(QUIET):
            self._status.row(self._parts())


def _display(stream: TextIO, render: Callable[[], Any]) -> Any:
    from rich.console import Console
    from rich.live import Live

    class Plain(Console):
        def show_cursor(self, show: bool = True) -> bool:
            """Keep the cursor: a process that is killed could not restore it."""
            return False

    # rich must ask the window for its width, not variables that a shell exported before a resize.
    known = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES")}
    console = Plain(file=stream, force_terminal=True, highlight=False, markup=False, emoji=False, _environ=known)
    return Live(
        console=console,
        get_renderable=render,
        refresh_per_second=1 / PERIOD,
        transient=True,
        redirect_stdout=False,
        redirect_stderr=stream is sys.stderr,
    )


COMFORTABLE = 16  # width below which columns of words are not wrapped
INDENT = "  "  # of rows below a line with their common cells


def table(heads: Sequence[str], rows: Sequence[Sequence[str]], words: Sequence[int], name: int) -> str:
    """A table of `rows` below `heads`, in which a newline separates name and unit. Columns `words` hold words.

    Column `name` identifies a row; columns before it are often equal in consecutive rows. On a narrow terminal columns
    of words are wrapped. If that is not enough, the columns before `name`, or also `name` and the words after it, move
    to a line above their rows, whichever shows more columns. Columns that still do not fit are left out from the right
    and listed in a last line. Without a terminal nothing is wrapped.
    """
    width = columns_of(sys.stdout) if sys.stdout and sys.stdout.isatty() else 10_000
    cells = list(zip(heads, *rows, strict=True))
    shown = {0: _fitting(cells, words, width)}
    starts = (name, *(n + 1 for n in words if n >= name))
    shown |= {n: n + _fitting(cells[n:], (), width - len(INDENT)) for n in starts}
    above = max(shown, key=lambda n: shown[n])
    end = shown[above]
    lines = _rendered(cells[above:end], [number - above for number in words], width)
    if above:
        common = ["  ".join(_named(heads[k], row[k], k in words) for k in range(above) if row[k]) for row in rows]
        lines = _below(common, lines, width)
    if end < len(heads):
        left_out = ", ".join(head.split("\n")[0] for head in heads[end:])
        lines += textwrap.wrap(f"left out on this narrow terminal: {left_out}", width)
    return "\n".join(lines)


def _below(common: Sequence[str], lines: Sequence[str], width: int) -> list[str]:
    """The `lines` of a table, indented, with the text in `common` above each group of rows that share it."""
    top, previous = len(lines) - len(common), ""
    result = [INDENT + line for line in lines[:top]]
    for text, line in zip(common, lines[top:], strict=True):
        if text != previous:
            result += folded(text, width).splitlines()
        result.append(INDENT + line)
        previous = text
    return result


def _fitting(cells: Sequence[Sequence[str]], words: Sequence[int], width: int) -> int:
    """Number of the columns `cells` that fit into `width`, at least one, if columns `words` are wrapped."""
    total, fitting = -2, 0
    for number, column in enumerate(cells):
        whole = max(len(line) for cell in column for line in cell.split("\n"))
        longest = max((len(word) for cell in column for word in cell.split()), default=0)
        total += 2 + (max(longest, min(whole, COMFORTABLE)) if number in words else whole)
        fitting += total <= width
    return max(fitting, 1)


def _named(head: str, cell: str, word: bool) -> str:
    """A cell with its name and unit, for a line without heads; a `word` alone."""
    name, _, unit = head.partition("\n")
    return cell if word else f"{name} {cell} {unit}".strip()


def _rendered(cells: Sequence[Sequence[str]], words: Sequence[int], width: int) -> list[str]:
    """Lines of a table with the columns `cells`, whose first cells are the heads."""
    from rich.console import Console
    from rich.table import Table

    grid = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False)
    for number, (head, *_) in enumerate(cells):
        word = number in words
        grid.add_column(_text(head), justify="left" if word else "right", no_wrap=not word, vertical="bottom")
    for row in list(zip(*cells, strict=True))[1:]:
        grid.add_row(*map(_text, row))
    console = Console(file=io.StringIO(), width=width, color_system=None, highlight=False)
    console.print(grid)
    return [line.rstrip() for line in console.file.getvalue().splitlines()]  # type: ignore[attr-defined]


def _text(text: str) -> Any:
    from rich.text import Text

    return Text(text)
