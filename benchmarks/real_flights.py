"""Real flights in the NanoBench CSV layout beside this project's plant, cascade and motors.

`python benchmarks/real_flights.py DIR [--fit NAME ...] [--json FILE] [--figure FILE]`

Fits motor lag, torque over inertia and force over mass to two flights of DIR and reports on all others: forecasts of
attitude and rates from logged motor commands beside constant rates, the cascade's motor commands beside the logged
ones, and specific force against command and voltage. Half a minute on one core. See docs/archive/real-flights.md.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path

from mjxball import cli
from mjxball.errors import InputError
from mjxball.train.run_directory import commit
from nanobench import report, study

FIGURES = (".svg", ".png")


def parser() -> cli.Parser:
    """The flags."""
    result = cli.make_parser("python benchmarks/real_flights.py", "Hold real flights against the simulated drone.")
    result.add_argument("directory", type=Path, metavar="DIR", help="with the flights' .csv or .csv.gz files")
    result.add_argument("--fit", nargs="+", default=study.FITTED, metavar="NAME", help="flights to fit to")
    result.add_argument("--json", type=Path, metavar="FILE")
    result.add_argument("--figure", type=Path, metavar="FILE", help="of suffix .svg or .png")
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Fit, report, write; return the exit code."""
    options = parser().parse_args(arguments)

    def run() -> int:
        if options.figure and options.figure.suffix not in FIGURES:
            raise InputError(f"--figure {options.figure.name} must end in {' or '.join(FIGURES)}")
        for path in (options.json, options.figure):
            if path and not path.absolute().parent.is_dir():
                raise InputError(f"directory {path.absolute().parent} does not exist")
        found = study.study(options.directory, tuple(options.fit))
        data = study.to_json(found)
        print(report.tables(data))
        if options.json:
            command = "python benchmarks/real_flights.py DIR"
            if tuple(options.fit) != study.FITTED:
                command += f" --fit {' '.join(options.fit)}"
            data = {"command": command, "commit": commit(), **data}
            options.json.write_text(json.dumps(data, indent=1, allow_nan=False) + "\n")
        if options.figure:
            report.draw(found, options.figure)
        return 0

    return cli.run_command(run)


if __name__ == "__main__":
    sys.exit(main())
