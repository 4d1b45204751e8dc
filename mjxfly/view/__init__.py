"""Viewer of flight logs in the browser, during the flight or afterwards: `python -m mjxfly.view LOG`."""
