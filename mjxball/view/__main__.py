"""`python -m mjxball.view`."""

import sys

from mjxball.view.command import main

sys.exit(main())
