"""Viewer of flights in the browser: `python -m mjxball.view RUN_OR_FLIGHT`."""
