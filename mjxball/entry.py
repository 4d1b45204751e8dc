"""Entry points of `mjxball-train` and `mjxball-eval`, and of train.py and eval.py; imports nothing heavy by itself."""

from __future__ import annotations

import gc

from mjxball.cli import quit_on_interrupt, run_command

# Tracing makes millions of objects that live on: looking through them for cycles as often as Python does by itself
# takes a tenth of a short training.
COLLECTED_AFTER = (100_000, 50, 100)  # objects, and collections of each younger generation


def train() -> int:
    """Run `train.py`; return its exit code."""
    quit_on_interrupt()  # until training starts there is nothing to save
    gc.set_threshold(*COLLECTED_AFTER)

    def command() -> int:
        from mjxball.commands.train import main

        return main()

    return run_command(command)


def evaluate() -> int:
    """Run `eval.py`; return its exit code."""
    quit_on_interrupt()  # there is nothing to save
    gc.set_threshold(*COLLECTED_AFTER)

    def command() -> int:
        from mjxball.commands.evaluate import main

        return main()

    return run_command(command)
