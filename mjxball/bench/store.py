"""Store flights, the oracle's arrivals and what known followers reach: `python -m mjxball.bench.store`."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mjxball.bench import NAME, VERSION
from mjxball.bench.draw import QUICK_TRACKS, quick_group, read_stored, stored_forms
from mjxball.bench.quick import known_form
from mjxball.bench.tracks import TRACKS
from mjxball.cli import make_parser
from mjxball.files import write_atomically
from mjxball.running import run_command

FOLDER = Path(__file__).parent / "draws"


def main(arguments: Sequence[str] | None = None) -> int:
    """Fly the oracle and write a file for each track."""
    parser = make_parser("python -m mjxball.bench.store", __doc__)
    parser.add_argument("tracks", nargs="*", metavar="TRACK", help=f"of {', '.join(TRACKS)} (default all)")
    options = parser.parse_args(arguments)
    if unknown := sorted(set(options.tracks) - set(TRACKS)):
        parser.error(f"there is no track {unknown[0]}")
    FOLDER.mkdir(exist_ok=True)
    for track in options.tracks or TRACKS:
        for stem, stored in stored_forms(track).items():
            _write(stem, stored)
        if track in QUICK_TRACKS:
            read_stored.cache_clear()
            quick_group.cache_clear()
            stem = f"{track}-known"
            _write(stem, {"benchmark": NAME, "version": VERSION, "track": stem, **known_form(track)})
        sys.stdout.write(f"{track}: stored\n")
    return 0


def _write(stem: str, stored: dict[str, Any]) -> None:
    text = json.dumps(stored, indent=None, separators=(",", ":"))
    write_atomically(FOLDER / f"{stem}.json", text.replace("},{", "},\n{") + "\n")


if __name__ == "__main__":
    sys.exit(run_command(main))
