"""What is shown at a terminal, by rich: a status that is redrawn in place, and tables. Elsewhere plain lines.

rich costs 40 ms to import; whoever has imported flax has paid for it.
"""

from __future__ import annotations

import io
import os
import re
import sys
import textwrap
import unicodedata
from collections.abc import Callable, Sequence
from typing import Any, TextIO

PERIOD = 0.5  # [s] between two redraws
GAP = "  "  # between the parts of a line
LONGEST = 900  # characters of a sentence about a mistake
Lines = Sequence[Sequence[str]]  # each of parts, the most important first


def is_live(stream: TextIO) -> bool:
    """Whether `stream` is a terminal that can go back on a line."""
    return stream.isatty() and os.environ.get("TERM", "dumb") not in ("dumb", "unknown", "")


def columns_of(stream: TextIO) -> int:
    """Width of the terminal `stream`, whose window may have changed; 80 if it does not say."""
    try:
        return os.get_terminal_size(stream.fileno()).columns or 80
    except (OSError, ValueError):
        return 80


def fitted(parts: Sequence[str], columns: int) -> str:
    """As many of `parts` from the first on as a line of `columns` holds; of a first one too long its beginning."""
    line = parts[0][:columns] if parts else ""
    for part in parts[1:]:
        if len(line) + len(GAP) + len(part) > columns:
            break
        line += GAP + part
    return line


def folded(text: str, columns: int) -> str:
    """`text` in lines of up to `columns`, which break between words; where two blanks part what fits, there alone."""
    parts = re.split(r"  +", text.strip())
    if len(parts) > 1 and max(map(len, parts)) <= columns:
        text = re.sub(r"(?<=\S) (?=\S)", "\xa0", text)
    return textwrap.fill(text, columns, break_on_hyphens=False).replace("\xa0", " ")


TURNS = ("LRE", "RLE", "LRO", "RLO", "PDF", "LRI", "RLI", "FSI", "PDI")  # of the direction of what follows


def fitted_to(stream: TextIO | None, text: str) -> str:
    """`text` for `stream`, blanks for what steers a terminal or turns a line, `folded` if that is a terminal.

    Of a stream that is closed the program has None.
    """
    text = "".join(letter if _prints(letter) else " " for letter in text)
    return folded(text, columns_of(stream)) if stream and stream.isatty() else text


def _prints(letter: str) -> bool:
    """Letters, blanks, joiners and the end of a line do; controls, line separators and turns of direction do not."""
    if letter.isprintable() or letter == "\n":
        return True
    return unicodedata.category(letter) in ("Cf", "Zs") and unicodedata.bidirectional(letter) not in TURNS


def say(text: str) -> None:
    """Print a sentence on stdout, now; at a terminal it breaks between words."""
    _print(text, sys.stdout)


def warn(text: str) -> None:
    """The same on stderr."""
    _print(text, sys.stderr)


def _print(text: str, stream: TextIO | None) -> None:
    """Text and its end in one piece: `print` writes two, between which another thread's may come."""
    if stream:
        stream.write(f"{fitted_to(stream, text)}\n")
        stream.flush()


def sentence(text: str) -> str:
    """`text` about a mistake in one line that a person can read."""
    line = " ".join(text.splitlines())
    return line if len(line) <= LONGEST else f"{line[:LONGEST]} ..."


class Status:
    """Lines at the bottom of a terminal, redrawn in place and cut to its width, with lines of their own above them.

    Without a terminal, or in one that cannot go back on a line, there are only those of their own.
    """

    def __init__(self, stream: TextIO | None = None):
        self._stream = stream or sys.stderr
        self.live = is_live(self._stream)
        self._shown: Callable[[], Lines] = list
        self._display: Any = None

    def show(self, lines: Callable[[], Lines]) -> None:
        """Show from now on what `lines` returns, which is asked again every `PERIOD`."""
        self._shown = lines
        if not self.live:
            return
        if self._display is None:
            self._display = _display(self._stream, self._render)
            self._display.start()
        self._display.refresh()

    def say(self, text: str) -> None:
        """Print `text` on lines of its own; at a terminal they break between words."""
        self._print(fitted_to(self._stream, text))

    def row(self, parts: Sequence[str]) -> None:
        """Print `parts` on a line of their own; at a terminal as many as it holds."""
        self._print(fitted(parts, columns_of(self._stream)) if self._stream.isatty() else GAP.join(parts))

    def _print(self, text: str) -> None:
        if self._display is None:
            print(text, file=self._stream, flush=True)
        else:
            self._display.console.print(text)

    def close(self) -> None:
        """Take the lines away."""
        if self._display is not None:
            self._display.stop()
        self._display, self.live = None, False

    def _render(self) -> Any:
        from rich.text import Text

        columns = columns_of(self._stream)
        return Text("\n".join(fitted(parts, columns) for parts in self._shown()), no_wrap=True)


def _display(stream: TextIO, render: Callable[[], Any]) -> Any:
    from rich.console import Console
    from rich.live import Live

    class Plain(Console):
        def show_cursor(self, show: bool = True) -> bool:
            """The cursor stays: a process that is killed could not bring it back."""
            return False

    # The window says its width, not a variable that a shell exported before it was resized.
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


COMFORTABLE = 16  # width below which words are not folded
INDENT = "  "  # of rows below what they have in common


def table(heads: Sequence[str], rows: Sequence[Sequence[str]], words: Sequence[int], name: int) -> str:
    """A table of `rows` below `heads`, in which a line break parts a name from its unit. Columns `words` hold words.

    Column `name` says what a row is of; what stands before it many rows have in common. On a terminal that is too
    narrow words are folded; else what is common, or also the name and words behind it, is a line above its rows,
    whichever shows more. What does not fit then is left out from the right, and a line says what. Elsewhere a row is
    a line.
    """
    width = columns_of(sys.stdout) if sys.stdout and sys.stdout.isatty() else 10_000
    cells = list(zip(heads, *rows, strict=True))
    shown = {0: _fitting(cells, words, width)}
    begins = (name, *(n + 1 for n in words if n >= name))
    shown |= {n: n + _fitting(cells[n:], (), width - len(INDENT)) for n in begins}
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
    """The `lines` of a table, each row below what it and the rows before it have in common."""
    top, said = len(lines) - len(common), ""
    found = [INDENT + line for line in lines[:top]]
    for text, line in zip(common, lines[top:], strict=True):
        if text != said:
            found += folded(text, width).splitlines()
        found.append(INDENT + line)
        said = text
    return found


def _fitting(cells: Sequence[Sequence[str]], words: Sequence[int], width: int) -> int:
    """How many of the columns `cells` fit, one at least, where those of `words` are folded."""
    total, fitting = -2, 0
    for number, column in enumerate(cells):
        whole = max(len(line) for cell in column for line in cell.split("\n"))
        longest = max((len(word) for cell in column for word in cell.split()), default=0)
        total += 2 + (max(longest, min(whole, COMFORTABLE)) if number in words else whole)
        fitting += total <= width
    return max(fitting, 1)


def _named(head: str, cell: str, word: bool) -> str:
    """A cell where no head stands above it."""
    name, _, unit = head.partition("\n")
    return cell if word else f"{name} {cell} {unit}".strip()


def _rendered(cells: Sequence[Sequence[str]], words: Sequence[int], width: int) -> list[str]:
    """Lines of the columns `cells`, each with its head."""
    from rich.console import Console
    from rich.table import Table

    made = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False)
    for number, (head, *_) in enumerate(cells):
        word = number in words
        made.add_column(_text(head), justify="left" if word else "right", no_wrap=not word, vertical="bottom")
    for row in list(zip(*cells, strict=True))[1:]:
        made.add_row(*map(_text, row))
    console = Console(file=io.StringIO(), width=width, color_system=None, highlight=False)
    console.print(made)
    return [line.rstrip() for line in console.file.getvalue().splitlines()]  # type: ignore[attr-defined]


def _text(text: str) -> Any:
    from rich.text import Text

    return Text(text)
