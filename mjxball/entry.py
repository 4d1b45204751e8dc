"""Entry points of `mjxball-train` and `mjxball-eval`, and of train.py and eval.py; imports nothing heavy by itself."""

from __future__ import annotations

import traceback
from collections.abc import Callable

from mjxball.cli import FAULT, collect_seldom, quit_on_interrupt, run_command, switch_often


def train() -> int:
    """Run `train.py`; return its exit code."""
    quit_on_interrupt()  # until training starts there is nothing to save
    collect_seldom()
    switch_often()

    def command() -> int:
        from mjxball.commands.train import main

        return main()

    return _exit_code(command)


def evaluate() -> int:
    """Run `eval.py`; return its exit code."""
    quit_on_interrupt()  # there is nothing to save
    collect_seldom()

    def command() -> int:
        from mjxball.commands.evaluate import main

        return main()

    return _exit_code(command)


def _exit_code(command: Callable[[], int]) -> int:
    """That of `command`; `FAULT` after an error of the program's own: 1, which Python would say, is a result."""
    try:
        return run_command(command)
    except Exception:
        traceback.print_exc()
        return FAULT
