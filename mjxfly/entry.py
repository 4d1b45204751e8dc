"""Entry point of the installed commands `mjxfly-*`; that of `mjxfly` itself is `mjxfly.__main__`."""

from __future__ import annotations

import sys
from pathlib import Path

from mjxball.entry import run_module

MAINS = {"view": "view.main", "log": "log", "app": "app.main"}
MAINS |= {name: f"rig.{name}" for name in ("design", "gains", "identify", "mount")}


def run() -> int:
    """Run the command named by this process's file name, such as `mjxfly-view`; return its exit code."""
    return run_module(f"mjxfly.{MAINS[Path(sys.argv[0]).stem.partition('-')[2]]}")
