"""Entry points of installed commands, train.py and eval.py. Heavy modules are imported when a command runs."""

from __future__ import annotations

import importlib
import traceback

from mjxball.running import FAULT, collect_seldom, quit_on_interrupt, run_command, switch_often


def train() -> int:
    """Run `train.py`; return its exit code."""
    collect_seldom()
    switch_often()
    return run_module("mjxball.commands.train")  # which handles Ctrl-C itself once training has started


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
    """Run `main` of `module` and return its exit code. Ctrl-C exits at once, without a traceback.

    After an unexpected exception the code is `FAULT`, because Python's 1 is the code of some results.
    """
    quit_on_interrupt()
    try:
        return run_command(lambda: int(importlib.import_module(module).main()))
    except Exception:
        traceback.print_exc()
        return FAULT
