#!/usr/bin/env python3
"""Train a follower: `python train.py [PRESET]`, see `python train.py --help`."""

import os
import signal
import sys

# Until training starts there is nothing to save, and an import cut short by Ctrl-C can abort the interpreter.
signal.signal(signal.SIGINT, lambda *_: os._exit(130))

from mjxball.train.main import main  # noqa: E402

if __name__ == "__main__":
    sys.exit(main())
