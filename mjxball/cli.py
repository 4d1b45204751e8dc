"""Shared by all command lines: parser, output paths, and flags generated from the configuration."""

from __future__ import annotations

import argparse
import contextlib
import difflib
import itertools
import os
import re
import sys
import textwrap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from mjxball import __version__
from mjxball import config as configs
from mjxball.errors import InputError
from mjxball.reading import MAX_SIZE, MIN_SIZE, is_number, shown
from mjxball.running import run_command
from mjxball.terminal import sentence, warn

SHELLS = ("bash", "zsh", "tcsh")
Describe = Callable[["Parser", argparse.Namespace, Any], set[str] | None]


class Parser(argparse.ArgumentParser):
    """An argument parser with bounded numbers, whose errors are one sentence on stderr and exit code 2."""

    def __init__(self, *given: Any, **named: Any):
        super().__init__(*given, **named)
        self.register("type", float, lambda text: _number(text, float))
        self.register("type", int, lambda text: _number(text, int))

    def parse_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> argparse.Namespace:
        """Like argparse, but a list may begin with a negative number: `--scenario.mass_change -0.1,0.2`."""
        words: list[str] = []
        for word in sys.argv[1:] if args is None else args:
            if words and re.fullmatch(r"--[^=]+", words[-1]) and re.match(r"-\.?\d[^,]*,", word):
                words[-1] += f"={word}"  # Python before 3.14 takes the list for a flag
            else:
                words.append(word)
        return super().parse_args(words, namespace)

    def error(self, message: str) -> None:  # type: ignore[override]
        """Print `message`, for an unknown flag with the most similar known one, and exit with code 2."""
        unknown = re.match(r"unrecognized arguments: (--[^ =]+)", message)
        known = [flag for action in self._actions if action.help != argparse.SUPPRESS for flag in action.option_strings]
        similar = difflib.get_close_matches(unknown[1], known, 1, cutoff=0.8) if unknown else []
        warn(sentence(f"{self.prog}: {message}{f'; did you mean {similar[0]}?' if similar else ''}"))
        self.exit(2)

    def _print_message(self, message: str, file: Any = None) -> None:
        """Print a text of argparse, which itself ignores that a text cannot be written."""

        def write() -> int:
            print(message, end="", file=file or sys.stderr)
            return 0

        if code := run_command(write):
            self.exit(code)


def _number(text: str, kind: type[float] | type[int]) -> float:
    """The number of a flag; ArgumentTypeError for text, NaN, infinity, or a size that float32 cannot compute with."""
    with contextlib.suppress(ValueError):
        if is_number(number := kind(text)):
            return number
    wanted = (
        f"a whole number of at most {MAX_SIZE:g}" if kind is int else f"a number, 0 or {MIN_SIZE:g} to {MAX_SIZE:g}"
    )
    raise argparse.ArgumentTypeError(f"takes {wanted}, not {shown(text)}")


class Formatter(argparse.HelpFormatter):
    """A help formatter that also wraps flags, usage and headings that are longer than a line of the terminal."""

    def __init__(self, prog: str, **given: Any):
        super().__init__(prog, **{"max_help_position": 32, **given})

    def _format_action_invocation(self, action: argparse.Action) -> str:
        return self._folded(super()._format_action_invocation(action), self._current_indent)

    def start_section(self, heading: str | None) -> None:
        """Begin a group of flags under a wrapped heading."""
        super().start_section(heading and self._folded(heading, 0))

    def _format_usage(self, *given: Any) -> str:
        return self._folded(super()._format_usage(*given).strip(), 0) + "\n\n"

    def _split_lines(self, text: str, width: int) -> list[str]:
        paragraphs = (" ".join(part.split()) for part in text.split("\n\n"))
        return [line for part in paragraphs for line in textwrap.wrap(part, width, break_on_hyphens=False)]

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        lines = self._split_lines(text, width - len(indent))
        return "\n".join(indent + line for line in lines)

    def _folded(self, text: str, indent: int) -> str:
        plain = re.sub(r"\x1b\[[\d;]*m", "", text)  # without the colours of Python 3.14
        width = self._width - indent
        if max(map(len, plain.splitlines())) <= width:
            return text
        inner = " " * (indent + 4)
        lines = (
            textwrap.fill(line, width, subsequent_indent=inner, break_on_hyphens=False) for line in plain.splitlines()
        )
        return "\n".join(lines)


class Command(Parser):
    """The parser of one command of a program with several (`add_subparsers`); reports its unknown flags itself."""

    def __init__(self, **given: Any):
        super().__init__(allow_abbrev=False, formatter_class=Formatter, **given)

    def parse_known_args(self, *given: Any, **named: Any) -> Any:
        """Like argparse, but unknown arguments are an error here, where similar flags are known."""
        found, left = super().parse_known_args(*given, **named)
        if left:
            self.error(f"unrecognized arguments: {' '.join(left)}")
        return found, left


class Help(argparse.Action):
    """`--help` prints the common flags, `--help all` every flag; other topics depend on the program.

    `describe(parser, namespace, topic)` returns the flags to print, None for all, and may change their texts.
    """

    def __init__(self, option_strings: Sequence[str], dest: str, describe: Describe, **given: Any):
        super().__init__(option_strings, dest, nargs="?", default=argparse.SUPPRESS, **given)
        self._describe = describe

    def __call__(self, parser: Any, namespace: argparse.Namespace, values: Any, option_string: Any = None) -> None:
        """Print and exit."""
        try:
            flags = self._describe(parser, namespace, values)
        except InputError as error:
            parser.error(str(error))
        for action in parser._actions:
            if flags is not None and not flags & {*action.option_strings, "" if action.option_strings else action.dest}:
                action.help = argparse.SUPPRESS
        for group in parser._action_groups:
            if any(action.help == argparse.SUPPRESS for action in group._group_actions):
                group.description = None  # it describes the whole group
        parser.print_help()
        parser.exit()


class Completion(argparse.Action):
    """`--print-completion SHELL` prints a script by which the shell completes the command (shtab).

    Completed are the `suggested` words of an action that has any, and files for paths and positional arguments.
    """

    def __call__(self, parser: Any, namespace: argparse.Namespace, values: Any, option_string: Any = None) -> None:
        """Print and exit."""
        try:
            import shtab
        except ModuleNotFoundError:
            parser.error("shtab is not installed; pip install shtab")
        parts = [
            action.choices.values() for action in parser._actions if isinstance(action, argparse._SubParsersAction)
        ]
        for action in (action for one in (parser, *itertools.chain(*parts)) for action in one._actions):
            action.choices = getattr(action, "suggested", action.choices)
            named = action.option_strings or action.choices
            if getattr(action.type, "__name__", "") in ("Path", "policy_path") or not named:
                action.complete = shtab.FILE
        parser._print_message(f"{shtab.complete(parser, values)}\n", sys.stdout)
        parser.exit()


def make_parser(
    program: str,
    description: str,
    usage: str | None = None,
    epilog: str | None = None,
    describe: Describe | None = None,
) -> Parser:
    """A parser of the command `program` with `--help`, `--version` and completion; flags cannot be abbreviated.

    Installed commands (`mjxball-train`) show their own name instead of `program`. `describe`: see `Help`.
    """
    called = Path(sys.argv[0]).stem
    name = called if called.startswith("mjx") else program
    given: dict[str, Any] = {"allow_abbrev": False, "formatter_class": Formatter, "add_help": describe is None}
    parser = Parser(prog=name, description=description, usage=usage, epilog=epilog, **given)
    if describe is not None:
        about = "show the common flags, of TOPIC all every flag, and exit"
        parser.add_argument("-h", "--help", action=Help, describe=describe, metavar="TOPIC", help=about)
    parser.add_argument("--version", action="version", version=f"mjxball {__version__}", help="show it and exit")
    if " " not in name:  # shells complete commands of one word
        about = f"print what makes {', '.join(SHELLS)} complete this command, and exit"
        parser.add_argument("--print-completion", action=Completion, choices=SHELLS, metavar="SHELL", help=about)
    return parser


def output_directory(path: Path, but: Sequence[str] = ()) -> Path:
    """`path` if it is an empty or a missing directory that can be written, else InputError. Creates nothing.

    Files with names in `but` are ignored.
    """
    if (path.exists() or path.is_symlink()) and not path.is_dir():
        raise InputError(f"output directory {path} exists and is no directory")
    above = next(parent for parent in path.absolute().parents if parent.exists())
    if not above.is_dir():
        raise InputError(f"output directory {path} would lie below the file {above}")
    if not os.access(path if path.exists() else above, os.W_OK):
        raise InputError(f"output directory {path} cannot be written")
    if path.is_dir() and any(one.name not in but for one in path.iterdir()):
        raise InputError(f"output directory {path} exists and is not empty; choose another")
    return path


def output_file(path: Path, suffix: str) -> Path:
    """`path` if it ends in `suffix`, does not exist and can be written to its directory, else InputError."""
    if path.suffix != suffix:
        raise InputError(f"output file {path} must end in {suffix}")
    if path.exists():
        raise InputError(f"output file {path} exists; choose another name")
    if not path.absolute().parent.is_dir():
        raise InputError(f"directory {path.absolute().parent} does not exist")
    if path.is_symlink() or not os.access(path.absolute().parent, os.W_OK):
        raise InputError(f"output file {path} cannot be written")
    return path


def add_config_flags(parser: argparse.ArgumentParser) -> None:
    """Add `--<path> VALUE` with its help text for every setting, in one group for each section."""
    groups: dict[str, Any] = {}
    for path, _, item in configs.leaves(configs.Config()):
        section = path.partition(".")[0]
        group = groups.get(section) or parser.add_argument_group(section, configs.about_section(section))
        groups[section] = group
        about = item.metadata["about"].replace("%", "%%")
        group.add_argument(f"--{path}", metavar="VALUE", dest=f"config:{path}", default=None, help=about)


def show_defaults(parser: argparse.ArgumentParser, settings: configs.Config) -> None:
    """Append the value in `settings` to the help of every `--<path>` as its default."""
    values = {path: configs.to_text(value) or "none" for path, value, _ in configs.leaves(settings)}
    for action in parser._actions:
        text = values.get(action.dest.removeprefix("config:"))
        if text is not None and action.dest.startswith("config:") and action.help != argparse.SUPPRESS:
            action.help = f"{action.help} (default {text.replace('%', '%%')})"


def apply_config_flags(config: configs.Config, options: argparse.Namespace) -> configs.Config:
    """`config` with the settings of `--plant FILE` and of every given `--<path> VALUE`, validated."""
    flags = {
        name.removeprefix("config:"): text
        for name, text in vars(options).items()
        if name.startswith("config:") and text is not None
    }
    return _with_plant(config, options.plant, flags)


def read_plant(path: Path) -> configs.PlantFile:
    """The plant file `path` or the shipped plant of that name; InputError if there is none or its preset is unknown."""
    found = configs.read_plant(path)
    if found.preset is not None and found.preset not in configs.PRESETS:
        raise InputError(f"plant file {path}: preset {found.preset!r} is none of {', '.join(configs.PRESETS)}")
    return found


def plant_setup(path: Path | None, default: str = "paper") -> configs.Config:
    """The preset of the plant file `path`, else the preset `default`, with that plant; validated.

    Flights are on this plant alone, without the other teams and random rigs on which the preset trains.
    """
    if path is None:
        return configs.preset(default)
    found = read_plant(path)
    preset = configs.preset(found.preset or default)
    return _with_plant(
        configs.apply_overrides(preset, {"scenario.team_sizes": (), "rigs.number": 0}), path, None, found
    )


def apply_plant(config: configs.Config, path: Path | None) -> configs.Config:
    """`config` with the settings of the plant file `path`, validated; without a path `config`."""
    return config if path is None else _with_plant(config, path)


def _with_plant(
    config: configs.Config,
    path: Path | None,
    flags: Mapping[str, str] | None = None,
    found: configs.PlantFile | None = None,
) -> configs.Config:
    """`mjxball.config.with_plant`; stderr lists what a model leaves open and is assumed, and what of it is ignored."""
    found = found or (None if path is None else read_plant(path))
    result = configs.with_plant(config, path, flags, found)
    if path is not None and found is not None:
        for line in found.assumed:
            warn(f"{path.name}: {line}")
    return result
