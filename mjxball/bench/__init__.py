"""mjxball-bench: the same flights for every follower, held against classical followers that know the plant.

`tracks` says what is flown, `followers` how a follower of any origin is loaded, `references` what classical ones reach,
`success` when a flight is met, `entry` what is written; docs/leaderboard.py makes tables of entries. What a version
flies and counts never changes. Beside it: `suites` of single difficulties, `scores` of followers on them, `report`.
"""

NAME, VERSION = "mjxball-bench", 1
