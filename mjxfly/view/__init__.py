"""A flight in the browser while it is flown, and after: `python -m mjxfly.view LOG`."""
