"""A program in a real pseudo-terminal, and what its user has seen."""

from __future__ import annotations

import fcntl
import os
import pty
import select
import struct
import subprocess
import termios
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import pyte
from command_line import REPOSITORY, environment


class Screen(pyte.HistoryScreen):
    """Counts the characters that did not fit into their line."""

    wrapped = 0

    def draw(self, data: str) -> None:
        for character in data:
            self.wrapped += self.cursor.x >= self.columns
            super().draw(character)


class Seen(NamedTuple):
    """What stood on the terminal after each write, and with all that has scrolled away at the end."""

    states: list[str]
    text: str
    wrapped: int
    code: int


def on_terminal(
    command: Sequence[str | Path], columns: int, here: Path, term: str = "xterm-256color", interrupt_at: str = ""
) -> Seen:
    """Run `command` in a terminal of `columns`, 0: which it does not tell; Ctrl-C once `interrupt_at` is shown."""
    main, own = pty.openpty()
    fcntl.ioctl(own, termios.TIOCSWINSZ, struct.pack("HHHH", 40 if columns else 0, columns, 0, 0))
    variables = {**environment(), "TERM": term, "PYTHONPATH": str(REPOSITORY)}
    child = subprocess.Popen(
        command, stdin=own, stdout=own, stderr=own, cwd=here, env=variables, start_new_session=True, close_fds=True
    )
    os.close(own)
    screen = Screen(columns or 80, 40, history=10_000)
    stream, states, ends = pyte.ByteStream(screen), [], time.monotonic() + 240
    while time.monotonic() < ends:
        if not select.select([main], [], [], 1.0)[0]:
            continue
        try:
            data = os.read(main, 65536)
        except OSError:  # Linux's way to say that the last one has closed it
            break
        stream.feed(data)
        states.append("\n".join(line.rstrip() for line in screen.display).rstrip())
        if interrupt_at and interrupt_at in states[-1]:
            child.send_signal(2)
            interrupt_at = ""
    code = child.wait(10)
    os.close(main)
    gone = ["".join(line[place].data for place in range(screen.columns)).rstrip() for line in screen.history.top]
    return Seen(states, "\n".join([*gone, *(line.rstrip() for line in screen.display)]).rstrip(), screen.wrapped, code)
