"""Store flights with the oracle's arrivals: `python -m mjxball.bench.store [TRACK ...]`."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path

from mjxball.bench.draw import stored_forms
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
    for track in options.tracks or TRACKS:
        FOLDER.mkdir(exist_ok=True)
        for stem, stored in stored_forms(track).items():
            text = json.dumps(stored, indent=None, separators=(",", ":"))
            write_atomically(FOLDER / f"{stem}.json", text.replace("},{", "},\n{") + "\n")
        sys.stdout.write(f"{track}: stored\n")
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
