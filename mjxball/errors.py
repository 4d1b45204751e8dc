"""Errors that a user can cause. The message is one sentence: what was wrong, where, what to do."""

import sysconfig
import traceback
from pathlib import Path


class InputError(ValueError):
    """Invalid input. Programs print it as one line on stderr, exit with code 2, and write nothing."""


class TrainingDivergedError(RuntimeError):
    """A loss or a weight is no longer finite."""


FOREIGN = (Exception, SystemExit)  # exceptions to expect from a user's module, which must not exit the program


LIBRARIES = (Path(__file__).parent, Path(sysconfig.get_path("stdlib")))
JAX_PLACE = "The error occurred while tracing"  # begins what JAX says of the place, which the user's line says better


def said(error: BaseException) -> str:
    """Class, message and place of an `error` from a user's module, as one line of printable text.

    The place is the innermost line that belongs neither to mjxball nor to an installed library.
    """
    try:
        message = str(error)
    except FOREIGN:  # `__str__` may be the user's code
        message = ""
    printable = "".join(letter if letter.isprintable() else " " for letter in message.split(JAX_PLACE)[0])
    text = " ".join(printable.split())[:160]
    frames = [frame for frame in traceback.extract_tb(error.__traceback__) if _is_users(frame.filename)]
    where = f", in {Path(frames[-1].filename).name} line {frames[-1].lineno}" if frames else ""
    return f"{type(error).__name__}: {text.rstrip('. ') + where if where else text}"


def _is_users(file: str) -> bool:
    library = any(Path(file).is_relative_to(place) for place in LIBRARIES) or "site-packages" in file
    return not library and not file.startswith("<")
