"""`python -m mjxfly`."""

import os
import sys
import threading

from mjxfly.main import main


def run() -> int:
    """Fly; return the exit code, or end the process with it."""
    code = main()
    stuck = [thread for thread in threading.enumerate() if not thread.daemon and thread is not threading.main_thread()]
    if stuck:  # cflib's threads of a dead link may wait for each other for ever; everything of ours is closed
        sys.stderr.flush()
        os._exit(code)
    return code


if __name__ == "__main__":
    sys.exit(run())
