"""Entry points of installed commands but `mjxfly`, which flies: that is `mjxfly.__main__`."""

from __future__ import annotations

from mjxball.entry import run_module


def view() -> int:
    """Run `mjxfly-view`; return its exit code."""
    return run_module("mjxfly.view.main")


def log() -> int:
    """Run `mjxfly-log`; return its exit code."""
    return run_module("mjxfly.log")


def app() -> int:
    """Run `mjxfly-app`; return its exit code."""
    return run_module("mjxfly.app.main")


def design() -> int:
    """Run `mjxfly-design`; return its exit code."""
    return run_module("mjxfly.rig.design")


def gains() -> int:
    """Run `mjxfly-gains`; return its exit code."""
    return run_module("mjxfly.rig.gains")


def identify() -> int:
    """Run `mjxfly-identify`; return its exit code."""
    return run_module("mjxfly.rig.identify")
