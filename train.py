#!/usr/bin/env python3
"""Train a follower: `python train.py [PRESET]`, see `python train.py --help`."""

import sys

from mjxball.entry import train

if __name__ == "__main__":
    sys.exit(train())
