#!/usr/bin/env python3
"""Judge followers on a CPU: `python eval.py [POLICY.npz ...]`, see `python eval.py --help`."""

import sys

from mjxball.entry import evaluate

if __name__ == "__main__":
    sys.exit(evaluate())
