"""Do the tests notice what they should? A copy of the tree gets one small fault of `mutants.toml` at a time.

A fault is killed if a test fails. First the tests that are likely to notice it run, then, if none of them does, the
whole tier. `--likely` stops before that: then "not by the likely tests" says nothing about the others. Nothing of
mjxball is imported here, `harness.py` included: tests run in forks of this process, and must find the copy's.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).parents[1]
TABLE = Path(__file__).with_suffix(".toml")
TIERS = {
    "quick": "not slow and not release",
    "full": "slow or release",
}  # marker expressions; full: quick, then this one
LIMIT, TIER_LIMIT = 900.0, 3600.0  # [s] for the likely tests and for a tier, after which a fault counts as noticed
NOTHING_RAN, FAILED, TIMED_OUT = 5, 1, -1  # exit codes: the first two are pytest's
PRELOADED = ("jax", "flax.linen", "optax", "mujoco", "scipy.linalg", "hypothesis", "pytest")


class Mutant(NamedTuple):
    """One fault."""

    file: str  # below the repository
    old: str  # occurs once in it
    new: str
    tests: tuple[str, ...]  # that are likely to notice: files or node ids

    def applied(self, text: str) -> str:
        """`text` of the file with the fault. Raises ValueError unless `old` occurs exactly once."""
        if text.count(self.old) != 1:
            raise ValueError(f"{self.file}: {self.old!r} occurs {text.count(self.old)} times, not once")
        return text.replace(self.old, self.new)


class Verdict(NamedTuple):
    """What became of a fault."""

    tier: str  # likely, quick or slow: who noticed; "" if nobody did
    test: str  # the first test that failed
    seconds: float


def read_table(path: Path = TABLE) -> list[Mutant]:
    """All faults."""
    rows = tomllib.loads(path.read_text(encoding="utf-8"))["mutant"]
    return [Mutant(row["file"], row["old"], row["new"], tuple(row["tests"])) for row in rows]


def copied(tree: Path, place: Path) -> Path:
    """A copy of the tracked files of `tree`, compiled to bytecode."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=tree, check=True, capture_output=True, text=True).stdout
    for name in filter(None, listed.split("\0")):
        if (tree / name).is_file():
            (place / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(tree / name, place / name)
    subprocess.run([sys.executable, "-m", "compileall", "-q", "mjxball", "tests"], cwd=place, check=False)
    return place


@contextlib.contextmanager
def faulty(scratch: Path, mutant: Mutant) -> Any:
    """While entered the copy has the fault."""
    path = scratch / mutant.file
    text = path.read_text(encoding="utf-8")
    stored = list((path.parent / "__pycache__").glob(f"{path.stem}.*.pyc"))
    for one in stored:
        one.unlink()  # nobody writes it again: see `pytest_in_child`
    path.write_text(mutant.applied(text), encoding="utf-8")
    try:
        yield
    finally:
        path.write_text(text, encoding="utf-8")


def pytest_in_child(scratch: Path, arguments: list[str], output: Path, limit: float) -> int:
    """Exit code of pytest in a forked process, which has its heaviest imports behind it; `TIMED_OUT` after `limit`."""
    child = os.fork()
    if child == 0:
        os.setsid()
        code = FAILED
        try:
            with output.open("wb") as stream:
                for number in (1, 2):
                    os.dup2(stream.fileno(), number)
            os.chdir(scratch)
            os.environ.update(PYTHONPATH=str(scratch), PYTHONDONTWRITEBYTECODE="1", JAX_PLATFORMS="cpu")
            sys.dont_write_bytecode = True
            sys.path[:0] = [str(scratch)]
            import pytest

            code = int(pytest.main(["-x", "-q", "-p", "no:cacheprovider", *arguments]))
        finally:
            sys.stdout.flush()
            os._exit(code)
    end = time.monotonic() + limit
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.02)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return TIMED_OUT


def first_failure(output: Path) -> str:
    """The test that pytest says failed first."""
    found = re.search(r"^(?:FAILED|ERROR) (.+?)(?: - |$)", output.read_text(errors="replace"), re.MULTILINE)
    return found[1] if found else ""


def evaluate(scratch: Path, mutant: Mutant, suite: str, likely_only: bool) -> Verdict:
    """Run the tests against one fault until one of them notices it."""
    began, output = time.monotonic(), scratch.parent / "output.txt"
    marks = {"likely": TIERS["quick"] if suite == "quick" else ""}
    if not likely_only:
        marks |= {"quick": TIERS["quick"], **({"slow": TIERS["full"]} if suite == "full" else {})}
    with faulty(scratch, mutant):
        for tier, mark in marks.items():
            narrow = tier == "likely"
            which = list(mutant.tests) if narrow else ["-n", "2", "--dist", "loadfile"]
            code = pytest_in_child(scratch, [*which, "-m", mark], output, LIMIT if narrow else TIER_LIMIT)
            if code not in (0, NOTHING_RAN):
                test = "(time limit)" if code == TIMED_OUT else first_failure(output)
                return Verdict(tier, test, time.monotonic() - began)
    return Verdict("", "", time.monotonic() - began)


def sound(scratch: Path, mutants: list[Mutant], suite: str) -> bool:
    """Whether the likely tests pass without any fault: else a fault would seem to be killed."""
    tests = sorted({test for mutant in mutants for test in mutant.tests})
    mark = TIERS["quick"] if suite == "quick" else ""
    output = scratch.parent / "output.txt"
    code = pytest_in_child(scratch, [*tests, "-m", mark], output, TIER_LIMIT)
    if code:
        print(output.read_text(errors="replace")[-3000:])
    return code == 0


def row_of(number: int, mutant: Mutant, verdict: Verdict | None) -> dict[str, Any]:
    """One fault and its end as JSON; `verdict` None: the tree has another text there."""
    found = {"number": number, "file": mutant.file, "old": mutant.old, "new": mutant.new}
    if verdict is None:
        return {**found, "killed": None, "by": "the text is not in this tree"}
    killed = {"killed": bool(verdict.tier), "tier": verdict.tier, "by": verdict.test}
    return found | killed | {"seconds": round(verdict.seconds, 1)}


def report(rows: list[dict[str, Any]], suite: str) -> dict[str, Any]:
    """All rows with their counts."""
    asked = [row for row in rows if row["killed"] is not None]
    found = {
        "suite": suite,
        "mutants": len(rows),
        "evaluated": len(asked),
        "killed": sum(row["killed"] for row in asked),
    }
    return found | {"survivors": [row["number"] for row in asked if not row["killed"]], "rows": rows}


def numbers_of(text: str, count: int) -> set[int]:
    """`N,N-N` as numbers, all of them if it says nothing."""
    parts = [part.split("-") for part in filter(None, text.split(","))]
    return {n for part in parts for n in range(int(part[0]), int(part[-1]) + 1)} or set(range(count))


def main(given: Sequence[str] | None = None) -> int:
    """Command line; exit code 1 if a fault survives."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", type=Path, metavar="FILE", help="written after every fault")
    parser.add_argument("--suite", choices=TIERS, default="quick", help="quick: the first tier; full: all")
    parser.add_argument("--likely", action="store_true", help="only the tests that are likely to notice")
    parser.add_argument("--numbers", default="", metavar="N,N-N", help="of the faults in the table, from 0; all")
    parser.add_argument("--file", default="", metavar="TEXT", help="only faults in files whose path holds TEXT")
    parser.add_argument("--tree", type=Path, default=ROOT, help="checkout whose tests are asked")
    parser.add_argument("--unchecked", action="store_true", help="do not first run the likely tests without a fault")
    options = parser.parse_args(given)
    table = list(enumerate(read_table()))
    wanted = numbers_of(options.numbers, len(table))
    table = [(n, one) for n, one in table if n in wanted and options.file in one.file]
    for name in PRELOADED:
        __import__(name)
    rows: list[dict[str, Any]] = []
    suite = "likely tests alone" if options.likely else options.suite
    with tempfile.TemporaryDirectory() as place:
        scratch = copied(options.tree.resolve(), Path(place) / "tree")
        if not options.unchecked and not sound(scratch, [one for _, one in table], options.suite):
            print("the tests fail without any fault", file=sys.stderr)
            return 2
        for number, mutant in table:
            try:
                mutant.applied((scratch / mutant.file).read_text(encoding="utf-8"))
                verdict = evaluate(scratch, mutant, options.suite, options.likely)
            except (ValueError, FileNotFoundError):
                verdict = None
            rows.append(row := row_of(number, mutant, verdict))
            said = "-" if verdict is None else "killed" if verdict.tier else "SURVIVED"
            print(f"{number:3} {said:8} {mutant.file}: {mutant.new.strip()[:60]}  {row['by']}", flush=True)
            if options.json:
                options.json.write_text(json.dumps(report(rows, suite), indent=1) + "\n")
    done = report(rows, suite)
    print(f"{done['killed']} of {done['evaluated']} killed by the {suite}")
    return 1 if done["survivors"] else 0


if __name__ == "__main__":
    sys.exit(main())
