"""`python -m mjxball.fly`."""

import os
import sys
import threading

from mjxball.fly.main import main

if __name__ == "__main__":
    code = main()
    stuck = [thread for thread in threading.enumerate() if not thread.daemon and thread is not threading.main_thread()]
    if stuck:  # cflib's threads of a dead link may wait for each other for ever; everything of ours is closed
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)
