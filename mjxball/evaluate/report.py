"""Files that an evaluation leaves: JSON and figures."""

from __future__ import annotations

import itertools
import json
from collections.abc import Sequence
from pathlib import Path

from mjxball.evaluate.cells import Cell
from mjxball.evaluate.figures import draw_flights, scenario_name

CELLS = "cells.json"


def to_json(cells: Sequence[Cell]) -> str:
    """`{"cells": [...]}` as scripts outside the project read it."""
    return json.dumps({"cells": [cell.record() for cell in cells]}, indent=2, allow_nan=False) + "\n"


def write_report(cells: Sequence[Cell], out: Path) -> list[Path]:
    """Write `cells.json` and one figure per scenario into `out`; return the paths."""
    out.mkdir(parents=True, exist_ok=True)
    paths = [out / CELLS]
    paths[0].write_text(to_json(cells))
    for _, group in itertools.groupby(cells, key=lambda cell: cell.scenario):
        same = list(group)
        paths.append(out / f"{scenario_name(same[0])}.png")
        draw_flights(same, paths[-1])
    return paths
