"""Command line of `eval.py`. The first word selects the command, `fly` by default."""

from __future__ import annotations

import shlex
import sys

from mjxball import cli, running
from mjxball.commands import bench, figures, fly

COMMANDS = {"fly": fly, "bench": bench, "figures": figures}
WHOLE = ("-h", "--help", "--version", "--print-completion")  # flags of the program, not of a command


def parser() -> cli.Parser:
    """Argument parser of `eval.py`, which also lists the flags of `fly`."""
    result = cli.make_parser(
        "eval.py",
        description="Fly followers on a CPU and measure them. Without a command: fly, whose flags are listed here.",
        usage="%(prog)s [COMMAND] [POLICY.npz ...] [--flag ...]",
        epilog="Without policies, followers or scenarios: every shipped policy and baseline on the standard scenarios. "
        "Logs of real flights: docs/flight-log.md.",
    )
    commands = result.add_subparsers(
        title="commands", dest="command", metavar="COMMAND", prog=result.prog, parser_class=cli.Command
    )
    for name, module in COMMANDS.items():
        about = str(module.__doc__)
        module.add_arguments(commands.add_parser(name, help=about, description=f"{about[0].upper()}{about[1:]}."))
    fly.add_flags(result)
    return result


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return the exit code."""
    given = sys.argv[1:] if arguments is None else arguments
    named = given and (given[0] in COMMANDS or given[0].partition("=")[0] in WHOLE)
    options = parser().parse_args(given if named else ["fly", *given])
    command = shlex.join(["python", "eval.py", *given])
    return running.run_command(lambda: COMMANDS[options.command].run(options, command))
