"""Errors that a user can cause. The message is one sentence: what was wrong, where, what to do."""


class InputError(ValueError):
    """Invalid input. Programs print it as one line on stderr, exit with code 2, and write nothing."""


class TrainingDivergedError(RuntimeError):
    """A loss or a weight is no longer finite."""


FOREIGN = (Exception, SystemExit)  # exceptions to expect from a user's module, which must not exit the program


def said(error: BaseException) -> str:
    """Class and message of an `error` from a user's module, as one line of printable text."""
    try:
        message = str(error)
    except FOREIGN:  # `__str__` may be the user's code
        message = ""
    text = "".join(letter if letter.isprintable() else " " for letter in message)
    return f"{type(error).__name__}: {' '.join(text.split())[:160]}"
