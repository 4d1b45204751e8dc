"""`python -m mjxfly`."""

import os
import sys
import threading

from mjxfly.main import main


def run() -> int:
    """Run `main`; return its exit code, or end the process with it if threads of cflib are left."""
    code = main()
    stuck = [thread for thread in threading.enumerate() if not thread.daemon and thread is not threading.main_thread()]
    if stuck:  # after a dead link cflib's threads may deadlock; ours have ended
        sys.stderr.flush()
        os._exit(code)
    return code


if __name__ == "__main__":
    sys.exit(run())
