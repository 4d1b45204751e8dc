"""Support: when imported, sets what tests and the processes they start rely on, whoever started pytest.

`nohup` and scripts that go on by themselves ignore signals, and shells have settings of their own.
"""

from __future__ import annotations

import os
import signal

FROM_A_SHELL = ("COLUMNS", "FORCE_COLOR", "LINES", "NO_COLOR", "TZ")
KEPT = ("JAX_PLATFORMS", "PYTHONPATH")

for number in (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT, signal.SIGTERM):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
os.umask(0o022)
for name in list(os.environ):
    if (name.startswith(("JAX_", "LC_", "PYTHON")) and name not in KEPT) or name in FROM_A_SHELL:
        del os.environ[name]
os.environ["LANG"] = "C.UTF-8"
os.environ.setdefault("JAX_PLATFORMS", "cpu")
