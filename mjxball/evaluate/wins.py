"""The report's table of wins: who is best in how many levels, by which metric, in which family."""

from __future__ import annotations

import html
from collections.abc import Sequence

from mjxball.evaluate.judge import Score, by_level, wins

COUNTED = {
    "peak": "steady-state peak",
    "rmse": "RMSE",
    "settling_time": "settling",
    "overshoot": "overshoot",
}


def wins_table(scores: Sequence[Score]) -> str:
    """Rows: all levels by each metric of `COUNTED`, then each family by the steady-state peak.

    Columns: every follower but the oracle, those that win most first.
    """
    best = wins(scores)
    names = sorted(best, key=lambda name: -best[name])
    rows = [_row(f"all, {label}", scores, names, metric, metric == "peak") for metric, label in COUNTED.items()]
    families = dict.fromkeys(score.family for score in scores)
    if len(families) > 1:
        for number, family in enumerate(families):
            mine = [score for score in scores if score.family == family]
            rows.append(_row(family, mine, names, "peak", number == 0))
    heads = "".join(f"<th>{html.escape(head)}</th>" for head in ("smallest median", "levels", *names))
    return f"""<h2 id="wins">Wins</h2>
<p>In how many levels each follower has the smallest median over the seeds: all levels by four metrics, then each family
by the steady-state peak. Who fails in any seed wins nothing there, nor does the oracle, and the overshoot is only
won by who comes within 10 % of the goal; equal numbers win together.</p>
<div class="scroll"><table id="wins-table"><thead><tr>{heads}</tr></thead>
<tbody>{"".join(rows)}</tbody></table></div>"""


def _row(label: str, scores: Sequence[Score], names: Sequence[str], metric: str, first: bool) -> str:
    count = wins(scores, metric)
    most = max((count[name] for name in names), default=0)
    cells = "".join(_cell(count[name], most) for name in names)
    style = " class=more" if first else ""
    return f"<tr{style}><td>{html.escape(label)}</td><td>{len(by_level(scores))}</td>{cells}</tr>"


def _cell(count: int, most: int) -> str:
    if not count:
        return '<td class="zero">0</td>'
    return f"<td><b>{count}</b></td>" if count == most else f"<td>{count}</td>"
