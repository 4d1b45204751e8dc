"""Errors that a user can cause. Each is one sentence: what was wrong, where, what to do."""


class InputError(ValueError):
    """Bad input: printed as one line on stderr, exit code 2, nothing written."""


class TrainingDivergedError(RuntimeError):
    """A loss or a weight is not finite any more."""
