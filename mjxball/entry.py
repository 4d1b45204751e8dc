"""Entry points of `mjxball-train` and `mjxball-eval`, and of train.py and eval.py; imports nothing heavy by itself."""

from __future__ import annotations

from mjxball.cli import collect_seldom, quit_on_interrupt, run_command, switch_often


def train() -> int:
    """Run `train.py`; return its exit code."""
    quit_on_interrupt()  # until training starts there is nothing to save
    collect_seldom()
    switch_often()

    def command() -> int:
        from mjxball.commands.train import main

        return main()

    return run_command(command)


def evaluate() -> int:
    """Run `eval.py`; return its exit code."""
    quit_on_interrupt()  # there is nothing to save
    collect_seldom()

    def command() -> int:
        from mjxball.commands.evaluate import main

        return main()

    return run_command(command)
