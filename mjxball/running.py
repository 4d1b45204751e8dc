"""Running a command: exit codes, errors in one line, Ctrl-C, the interpreter's settings."""

from __future__ import annotations

import atexit
import gc
import os
import signal
import sys
from collections.abc import Callable

from mjxball.errors import InputError
from mjxball.terminal import sentence, warn
from mjxball.xla import explained

FAULT = 3  # exit code after a defect of the program; 1 says that a check failed
# The extra that installs a package, if it is not `train`.
EXTRAS = {"onnx": "onnx", "gymnasium": "gym"}
EXTRAS |= dict.fromkeys(("cflib", "yaml", "mcap", "mcap_ros2", "rosbags", "pyarrow", "websockets"), "fly")


before_quitting: list[Callable[[], None]] = []  # what an exit that skips `finally` has to call


def quit_on_interrupt() -> None:
    """Make Ctrl-C end the process at once, without output, code 130; an interrupted import can abort Python."""

    def quit_now(*_: object) -> None:
        for one in before_quitting:
            one()
        os._exit(130)

    signal.signal(signal.SIGINT, quit_now)


def collect_seldom() -> None:
    """Collect garbage less often: tracing makes millions of lasting objects, which every collection visits.

    Python's default costs a tenth of the time of a short training, and 0.7 s at the end of the process.
    """
    gc.set_threshold(100_000, 50, 100)
    atexit.register(gc.freeze)


def switch_often() -> None:
    """Switch threads every 0.5 ms instead of 5: the training thread waits whenever another thread imports."""
    sys.setswitchinterval(5e-4)


def run_command(command: Callable[[], int]) -> int:
    """Run `command`. Bad input, a failing file or a missing package is one line on stderr and exit code 2."""
    try:
        code = command()
        if sys.stdout is not None:
            sys.stdout.flush()
        return code
    except InputError as error:
        warn(sentence(f"error: {error}"))
        return 2
    except OSError as error:
        where = error.filename or "standard output or a file"
        _discard_stdout()
        warn(f"error: {where}: {error.strerror or error}")
        return 2
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("mjx"):  # a defect of this distribution
            raise
        extra = EXTRAS.get(error.name or "", "train")
        warn(f"error: {error.name} is not installed; pip install 'mjxball[{extra}]'")
        return 2
    except (MemoryError, RuntimeError, AssertionError) as error:
        why = explained(error)
        if why is None:
            raise
        warn(f"error: {why}")
        return 2


def _discard_stdout() -> None:
    """Redirect stdout if it cannot be written; Python would try again at exit and print its own error."""
    try:
        sys.stdout.flush()
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
