"""`python -m mjxball.view`."""

import sys

from mjxball.running import quit_on_interrupt
from mjxball.view.main import main

if __name__ == "__main__":
    quit_on_interrupt()  # there is nothing to save
    sys.exit(main())
