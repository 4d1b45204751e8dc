"""Entry points of installed commands, and of train.py and eval.py; imports nothing heavy by itself."""

from __future__ import annotations

import importlib
import traceback

from mjxball.cli import FAULT, collect_seldom, quit_on_interrupt, run_command, switch_often


def train() -> int:
    """Run `train.py`; return its exit code."""
    collect_seldom()
    switch_often()
    return run_module("mjxball.commands.train")  # until training starts there is nothing to save


def evaluate() -> int:
    """Run `eval.py`; return its exit code."""
    collect_seldom()
    return run_module("mjxball.commands.evaluate")


def view() -> int:
    """Run `mjxball-view`; return its exit code."""
    return run_module("mjxball.view.main")


def export() -> int:
    """Run `mjxball-export`; return its exit code."""
    return run_module("mjxball.export")


def run_module(module: str) -> int:
    """`main` of `module`, which Ctrl-C ends at once: there is nothing to save.

    Returns its exit code; `FAULT` after an error of the program's own: 1, which Python would say, is a result.
    """
    quit_on_interrupt()
    try:
        return run_command(lambda: int(importlib.import_module(module).main()))
    except Exception:
        traceback.print_exc()
        return FAULT
