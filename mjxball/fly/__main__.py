"""`python -m mjxball.fly`."""

import sys

from mjxball.fly.main import main

if __name__ == "__main__":
    sys.exit(main())
