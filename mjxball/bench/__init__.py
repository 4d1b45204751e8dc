"""mjxball-bench: the same flights for every follower, compared with a controller that knows everything.

`tracks` samples flights in two `conditions`, `draw` selects those that the oracle succeeds in and stores them
(`store`), `process` runs a follower in a process of its own (`child`), `evaluation` flies it, `success` is the
criterion, `entry` the result file and `checks` what it must satisfy; docs/leaderboard.py tabulates entries. Flights and
criterion of a version never change.
"""

NAME, VERSION = "mjxball-bench", 2
CONDITIONS = ("calm", "disturbed")
