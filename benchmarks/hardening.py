"""Bad and hostile command lines and files (`hostile.py`), each in a process and a directory of its own.

    python benchmarks/hardening.py [--lines 250] [--jobs 2] [--only TEXT] [--json FILE]

Of each it asserts: exit code 2, one sentence on stderr, no traceback, less than 20 s and 3 GB, nothing overwritten and
nothing left behind. Prints what of that does not hold; exit code 1 if anything does not.
"""

from __future__ import annotations

import concurrent.futures
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hostile import Case, every_case, prepare, spread
from hostile_files import ROOT
from mjxball import cli

LINES, SECONDS, MEMORY = 250, 20.0, 3.0e9  # [s] of a line, [bytes] resident at most
POLL = 0.05  # [s]
LONGEST = 1000  # characters of a sentence, paths included


def main(arguments: Sequence[str] | None = None) -> int:
    """Run, print, write."""
    parser = cli.make_parser("python benchmarks/hardening.py", __doc__.split("\n\n")[0])
    parser.add_argument("--lines", type=int, default=LINES, metavar="N", help="how many of the cases, evenly chosen")
    parser.add_argument("--jobs", type=int, default=2, metavar="N", help="processes at a time (2)")
    parser.add_argument("--only", default="", metavar="TEXT", help="of cases whose program and flaw have TEXT")
    parser.add_argument("--seconds", type=float, default=SECONDS, metavar="S", help="of a line; more on a busy machine")
    parser.add_argument("--json", type=Path, metavar="FILE")
    options = parser.parse_args(arguments)
    cases = [case for case in every_case() if options.only in f"{case.program}: {case.flaw}"]
    chosen = spread(cases, options.lines)
    rows = []
    with concurrent.futures.ThreadPoolExecutor(options.jobs) as pool:
        for row in pool.map(lambda case: run(case, options.seconds), chosen):
            rows.append(row)
            if row["wrong"]:
                print(f"{row['program']:9} {row['flaw']:44} {'; '.join(row['wrong'])}", flush=True)
    bad = [row for row in rows if row["wrong"]]
    for name in dict.fromkeys(row["program"] for row in rows):
        mine = [row for row in rows if row["program"] == name]
        refused, slowest = sum(not row["wrong"] for row in mine), max(row["seconds"] for row in mine)
        most = max(row["bytes"] for row in mine) / 1e9
        print(f"{name:9} {refused:3} of {len(mine):3} refused well, at most {slowest:.1f} s and {most:.2f} GB")
    causes = Counter(cause.split(":")[0] for row in bad for cause in row["wrong"])
    print(f"{len(rows) - len(bad)} of {len(rows)} of {len(cases)} lines; {dict(causes)}")
    if options.json:
        lines = ",\n".join(json.dumps(row) for row in rows)
        options.json.write_text(f'{{"lines": [\n{lines}\n]}}\n')
    return 1 if bad else 0


def run(case: Case, longest: float) -> dict[str, Any]:
    """What a case's process did, `wrong` being what it should not have."""
    with tempfile.TemporaryDirectory(prefix="hardening-") as folder:
        place, temporary, errors = Path(folder) / "work", Path(folder) / "tmp", Path(folder) / "stderr"
        place.mkdir()
        temporary.mkdir()
        prepare(case, place)
        before = listing(place)
        code, seconds, memory, why = watched(case, place, temporary, errors, longest)
        stderr = errors.read_text(errors="replace")[:20_000]
        changed = sorted(name for name, _ in before.items() ^ listing(place).items())
        left = sorted(path.name for path in temporary.iterdir())
    wrong = [why] if why else [] if code == 2 else [f"exit code: {code}"]
    wrong += [] if why else sentences(stderr)
    wrong += [f"changed: {', '.join(changed[:4])}"] if changed else []
    wrong += [f"left behind: {', '.join(left[:4])}"] if left else []
    line = [word.replace(str(ROOT) + "/", "") for word in case.arguments]
    return {
        **{"program": case.program, "flaw": case.flaw, "line": line, "code": code, "seconds": round(seconds, 2)},
        **{"bytes": memory, "stderr": stderr.replace(str(ROOT), "").strip()[-600:], "wrong": wrong},
    }


def sentences(stderr: str) -> list[str]:
    """What is wrong with what a refused command said."""
    lines = [line for line in stderr.splitlines() if line.strip() and not line.startswith("warning:")]
    if "Traceback" in stderr:
        return [f"traceback: {lines[-1][:150]}"]
    if len(lines) != 1:
        return [f"sentences: {len(lines)}"]
    return ["long: a sentence" for _ in "1" if len(lines[0]) > LONGEST]


def watched(
    case: Case, place: Path, temporary: Path, errors: Path, longest: float
) -> tuple[int | None, float, int, str | None]:
    """(exit code, seconds, bytes resident at most, why it was ended) of the case's process."""
    own = {"TMPDIR": str(temporary), "PYTHONPATH": str(ROOT), "JAX_PLATFORMS": "cpu"}
    started, most, why = time.monotonic(), 0, None
    with errors.open("wb") as stream:
        process = subprocess.Popen(
            [sys.executable, *case.arguments],
            cwd=place,
            env={**os.environ, **own},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=stream,
            start_new_session=True,
        )
        while process.poll() is None and why is None:
            time.sleep(POLL)
            most = max(most, resident(process.pid))
            if time.monotonic() - started > longest:
                why = f"time: more than {longest:g} s"
            if most > MEMORY:
                why = f"memory: more than {MEMORY / 1e9:g} GB"
        if why:
            os.killpg(process.pid, signal.SIGKILL)
        code = process.wait()
    return code if why is None else None, time.monotonic() - started, most, why


def resident(process: int) -> int:
    """Bytes of memory that a process has in use, 0 if it has ended."""
    try:
        pages = Path(f"/proc/{process}/statm").read_text().split()[1]
    except (OSError, IndexError):
        return 0
    return int(pages) * os.sysconf("SC_PAGE_SIZE")


def listing(place: Path) -> dict[str, tuple[int, int]]:
    """Every file below a directory: (bytes, when it was written [ns])."""
    found = {}
    for path in place.rglob("*"):
        status = path.lstat()
        found[str(path.relative_to(place))] = (0 if path.is_dir() else status.st_size, status.st_mtime_ns)
    return found


if __name__ == "__main__":
    raise SystemExit(cli.run_command(main))
