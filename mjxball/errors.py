"""Errors that a user can cause. Each is one sentence: what was wrong, where, what to do."""


class InputError(ValueError):
    """Bad input: printed as one line on stderr, exit code 2, nothing written."""


class TrainingDivergedError(RuntimeError):
    """A loss or a weight is not finite any more."""


FOREIGN = (Exception, SystemExit)  # what a user's own module may raise: to leave the program is not its to say


def said(error: BaseException) -> str:
    """`error` of a user's own module in one line of printable text."""
    try:
        told = str(error)
    except FOREIGN:  # its own words, too, are somebody else's code
        told = ""
    text = "".join(letter if letter.isprintable() else " " for letter in told)
    return f"{type(error).__name__}: {' '.join(text.split())[:160]}"
