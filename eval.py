#!/usr/bin/env python3
"""Judge followers on a CPU: `python eval.py [POLICY.npz ...]`, see `python eval.py --help`."""

import os
import signal
import sys

# Ctrl-C has nothing to save here, and an import or a compilation cut short can abort the interpreter.
signal.signal(signal.SIGINT, lambda *_: os._exit(130))

from mjxball.evaluate.main import main  # noqa: E402

if __name__ == "__main__":
    sys.exit(main())
