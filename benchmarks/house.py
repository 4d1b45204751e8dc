"""What a newcomer meets, and what a run costs, in two checkouts side by side: sizes, imports, cold and warm training.

    git worktree add ../before COMMIT
    python benchmarks/house.py ../before . --repeats 3 --json benchmarks/results/house.json

Both are timed in turn with the same interpreter, each training in a process of its own with README's command; cold:
an empty cache of compiled programs, warm: the cache that the cold run left. Medians of seconds by the clock, and of CPU
seconds, which other programs on the machine change less; the load averages are written to the JSON file. With
`--repeats 0` sizes alone are counted, and the timings in the JSON file stay, with the commits that they are of.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SETTINGS = "from mjxball import config; from dataclasses import fields, is_dataclass as d; c = config.Config();" \
    "print(sum(len(fields(getattr(c, f.name))) for f in fields(c) if d(getattr(c, f.name))))"  # fmt: skip
IMPORTS = {"import of a policy": "import mjxball.policy", "import of training": "import mjxball.train.program"}


def sizes(tree: Path) -> dict[str, float]:
    """Counts of what there is to read."""
    modules = list((tree / "mjxball").rglob("*.py"))
    pages = [path for path in (tree / "docs").rglob("*.md") if "archive" not in path.parts]
    archived = (tree / "docs" / "archive").rglob("*.md")

    def words(paths: object) -> int:
        return sum(len(path.read_text(encoding="utf-8").split()) for path in paths)  # type: ignore[attr-defined]

    return {
        "lines of the package": sum(len(path.read_text(encoding="utf-8").splitlines()) for path in modules),
        "modules": len(modules),
        "words of README": words([tree / "README.md"]),
        "words of the docs": words(pages),
        "words of the docs' archive": words(archived),
        "settings": int(run(tree, ["-c", SETTINGS])[-1]),
    }


def run(tree: Path, arguments: list[str], **variables: str) -> tuple[float, float, str]:
    """(seconds, CPU seconds, standard output) of `python ARGUMENTS` in `tree`. Raises CalledProcessError."""
    environment = {**os.environ, "PYTHONPATH": str(tree), "JAX_PLATFORMS": "cpu", **variables}
    began, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run(
        [sys.executable, *arguments], cwd=tree, env=environment, check=True, capture_output=True, text=True
    )
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    busy = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return time.perf_counter() - began, busy, done.stdout


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("--repeats", type=int, default=3, help="of each timing; 0: sizes alone")
    parser.add_argument("--json", type=Path, default=None, metavar="FILE")
    options = parser.parse_args()
    trees = {"before": options.before.resolve(), "after": options.after.resolve()}
    found = {name: sizes(tree) for name, tree in trees.items()}
    times: dict[str, dict[str, list[float]]] = {name: {} for name in trees}
    loads = [os.getloadavg()[0]]
    for _ in range(options.repeats):
        for name, tree in trees.items():
            with tempfile.TemporaryDirectory() as place:
                tasks: dict[str, tuple[list[str], dict[str, str]]] = {
                    what: (["-c", code], {}) for what, code in IMPORTS.items()
                }
                for what in ("training, cold", "training, warm"):
                    command = ["train.py", "--seed", "0", "--out", f"{place}/{what[10:]}"]
                    tasks[what] = (command, {"MJXBALL_CACHE": f"{place}/cache"})
                for what, (command, variables) in tasks.items():
                    seconds, busy, _ = run(tree, command, **variables)
                    times[name].setdefault(f"{what} [s]", []).append(seconds)
                    times[name].setdefault(f"{what} [CPU s]", []).append(busy)
            loads.append(os.getloadavg()[0])
            print(name, {what: round(values[-1], 1) for what, values in times[name].items()}, flush=True)
    commits = {name: run_git(tree) for name, tree in trees.items()}
    timed = {"commits": commits, "load": loads, "all": times}
    if not options.repeats and options.json and options.json.exists():
        timed = json.loads(options.json.read_text())["timed"]
    rows = {
        name: {**found[name], **{w: round(statistics.median(v), 2) for w, v in timed["all"][name].items()}}
        for name in trees
    }
    print(f"{'':28} {'before':>10} {'after':>10}")
    for what in rows["before"]:
        print(f"{what:28} {rows['before'][what]:>10} {rows['after'][what]:>10}")
    if options.json:
        options.json.write_text(json.dumps({"commits": commits, "medians": rows, "timed": timed}, indent=1) + "\n")


def run_git(tree: Path) -> str:
    """The commit that is checked out in `tree`."""
    asked = ["git", "-C", str(tree), "rev-parse", "--short", "HEAD"]
    return subprocess.run(asked, check=True, capture_output=True, text=True).stdout.strip()


if __name__ == "__main__":
    main()
