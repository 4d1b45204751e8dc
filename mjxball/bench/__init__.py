"""mjxball-bench: the same flights for every follower, compared with classical followers that know the plant.

`tracks` has the flights, `followers` loads followers, `references` has classical results, `success` the criterion,
`entry` the result file; docs/leaderboard.py tabulates entries. Flights and criterion of a version never change.
"""

NAME, VERSION = "mjxball-bench", 1
