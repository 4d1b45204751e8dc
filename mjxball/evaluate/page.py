"""The judge's report: one HTML file that works from disk, without any network."""

from __future__ import annotations

import base64
import dataclasses
import html
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mjxball.evaluate import svg
from mjxball.evaluate.families import GRID, Family
from mjxball.evaluate.judge import RANKED, Score, Summary, by_level, winners, wins
from mjxball.evaluate.wins import wins_table

UNITS = {
    "rmse": "m",
    "settling_time": "s",
    "overshoot": "",
    "x_peak": "m",
    "peak": "m",
    "max_tilt": "rad",
    "effort": "N",
    "smoothness": "rad",
    "saturation": "",
}
CARD_HIDES = ("config", "plant", "observation", "action", "curve")  # long, and in the policy file
COPYING = (
    "Copied commands leave the CG's torque m_o g c to the two attitude loops alone, which settle at a steady tilt, and "
    "the pair sways by (g/kp) m_o g c / (2 Kp): copying perfectly is not balancing."
)
WHY_COPYING_LOSES = f"Its reward asks it to copy the leader, and it does. {COPYING}"
STYLE = """
:root { color-scheme: light; --ink: #1d2329; --line: #d8dde2; --soft: #f4f6f8; --best: #dff0e2; }
body { font: 15px/1.5 system-ui, sans-serif; color: var(--ink); margin: 0 auto; max-width: 1100px; }
body { padding: 0 16px 64px; box-sizing: border-box; }
h1 { font-size: 1.6rem; } h2 { margin-top: 2.4rem; border-bottom: 1px solid var(--line); } summary { cursor: pointer; }
svg { width: 100%; height: auto; } img { max-width: 100%; } figure { margin: 1rem 0; }
pre { background: var(--soft); padding: 10px; white-space: pre-wrap; overflow-wrap: anywhere; font-size: 13px; }
.scroll { overflow-x: auto; } table { border-collapse: collapse; font-size: 13px; font-variant-numeric: tabular-nums; }
th, td { padding: 3px 9px; border-bottom: 1px solid var(--line); text-align: right; white-space: nowrap; }
th:first-child, td:first-child, table.scores :is(th, td):nth-child(-n+3) { text-align: left; }
th button { font: inherit; font-weight: 600; background: none; border: 0; padding: 0; cursor: pointer; }
th button::after { content: " \\2195"; color: #9aa4ad; } tr.best td { background: var(--best); }
small { color: #667; } nav { display: flex; flex-wrap: wrap; gap: 4px 14px; }
figcaption p { margin: 0.5rem 0; } .paper svg { display: block; max-width: 720px; margin: 0 auto; }
.paper :is(th, td:first-child) { white-space: normal; } .paper td:first-child { min-width: 9em; }
tr.more td { border-top: 2px solid var(--line); } td.zero { color: #9aa4ad; }
.verdict { background: var(--soft); padding: 12px 16px; }
label { margin-right: 14px; }
"""
SCRIPT = """
const table = document.getElementById('scores'), body = table.tBodies[0];
const family = document.getElementById('family'), follower = document.getElementById('follower');
function show() {
  for (const row of body.rows)
    row.hidden = (family.value && row.cells[0].textContent !== family.value)
      || (follower.value && row.cells[2].textContent !== follower.value);
}
family.onchange = follower.onchange = show;
table.tHead.onclick = (event) => {
  const cell = event.target.closest('th');
  if (!cell) return;
  const up = cell.getAttribute('aria-sort') !== 'ascending', column = cell.cellIndex;
  for (const other of table.tHead.rows[0].cells) other.removeAttribute('aria-sort');
  cell.setAttribute('aria-sort', up ? 'ascending' : 'descending');
  const key = (row) => {
    const c = row.cells[column];
    return c.dataset.v === undefined ? c.textContent : +c.dataset.v;
  };
  const rows = [...body.rows].sort((a, b) => {
    const x = key(a), y = key(b);
    return (x < y ? -1 : x > y ? 1 : 0) * (up ? 1 : -1);
  });
  body.append(...rows);
};
"""


@dataclass(frozen=True)
class Report:
    """Everything that the page shows."""

    scores: Sequence[Score]
    families: Sequence[Family]
    seeds: int
    command: str
    versions: Mapping[str, str]
    cards: Mapping[str, Mapping[str, Any]]  # policy name -> its card
    picture: bytes | None = None  # animated WebP
    picture_text: str = ""  # its caption, or why there is none


def write_page(report: Report, path: Path) -> None:
    """Write the page."""
    path.write_text(_page(report), encoding="utf-8")


def verdict(scores: Sequence[Score], cards: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The first sentences of the report: who wins, and what each policy has to show against the best classical ones."""
    lines = []
    best = wins(scores)
    ranking = sorted(best, key=lambda name: -best[name])
    total = len(by_level(scores))
    tally = ", ".join(f"{name} {best[name]}" for name in ranking if best[name]) or "nobody's, no flight was that long"
    lines.append(f"Smallest steady-state peak in {total} levels (the oracle, which is told the CG, left out): {tally}.")
    for policy, card in cards.items():
        lost = False
        for rival in (name for name in ("adaptive", "lqg", "lqg-slow") if name in best):
            text, behind = _against(scores, policy, rival)
            lines.append(text)
            lost |= behind
        if lost and card.get("config", {}).get("reward", {}).get("kind") == "paper":
            lines.append(f"{policy} mimics its leader and loses. {WHY_COPYING_LOSES}")
    everybody = dict.fromkeys(score.follower for score in scores)
    failed = {name: sum(s.failures for s in scores if s.follower == name) for name in everybody}
    fell = ", ".join(f"{name} {count}" for name, count in failed.items() if count)
    lines.append(f"Failed flights: {fell}." if fell else "No flight failed.")
    return lines


def _against(scores: Sequence[Score], policy: str, rival: str) -> tuple[str, bool]:
    """(how `policy` compares with `rival`, whether it is behind); who fails in any seed is behind there."""
    ahead = behind = 0
    for rivals in by_level(scores).values():
        peaks = {s.follower: math.inf if s.failures else s.summary("peak").median for s in rivals}
        mine, other = peaks[policy], peaks[rival]
        if math.isnan(mine) or math.isnan(other):
            continue
        ahead, behind = ahead + (mine < other), behind + (mine > other)
    text = f"{policy} has a smaller steady-state peak than {rival} in {ahead} levels and a larger one in {behind}."
    return text, behind > ahead


def _page(report: Report) -> str:
    sections = "".join(_family(family, report) for family in report.families)
    links = "".join(f'<a href="#{family.name}">{family.name}</a>' for family in report.families)
    spoken = "".join(f"<p>{html.escape(line)}</p>" for line in verdict(report.scores, report.cards))
    body = f"""<h1>Followers judged</h1>
<div class="verdict" id="verdict">{spoken}</div>
{wins_table(report.scores)}
<p>Every follower flew the same worlds, {report.seeds} seed(s) a level. Numbers are medians over the seeds with 95 %
bootstrap intervals; a flight that failed or never settled counts as infinitely bad, and who failed in any seed of a
level neither wins it nor is ahead of anybody there.
Reference: CG ±5 cm at 0.31 rad/s, 0.2 kg, from the origin to (1, 1, 1) m, 45 s.</p>
<nav>{links}<a href="#scores-title">all scores</a><a href="#made">how it was made</a></nav>
{_picture(report)}
{sections}
<h2 id="scores-title">All scores</h2>
{_filters(report)}
<div class="scroll">{_table(report.scores)}</div>
{made(report.command, report.versions, report.cards)}
<script>{SCRIPT}</script>"""
    return document("mjxball: followers judged", body)


def document(title: str, body: str) -> str:
    """A whole page around `body`, in the style of every page of ours."""
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{html.escape(title)}</title><style>{STYLE}</style></head><body>
{body}</body></html>
"""


def made(command: str, versions: Mapping[str, str], cards: Mapping[str, Mapping[str, Any]]) -> str:
    """The last section of a page: the command, the versions, and the policies' cards."""
    return f"""<h2 id="made">How it was made</h2>
<pre>{html.escape(command)}</pre>
<pre>{html.escape(json.dumps(dict(versions), indent=1))}</pre>
{_cards(cards)}"""


def _picture(report: Report) -> str:
    if report.picture is None:
        return f"<p><small>{html.escape(report.picture_text)}</small></p>" if report.picture_text else ""
    data = base64.b64encode(report.picture).decode()
    caption = html.escape(report.picture_text)
    film = f'<img id="film" alt="{caption}" src="data:image/webp;base64,{data}">'
    return f"<figure>{film}<figcaption>{caption}</figcaption></figure>"


def _family(family: Family, report: Report) -> str:
    mine = [score for score in report.scores if score.family == family.name]
    parts = [f'<h2 id="{family.name}">{family.name}</h2><p>{html.escape(family.about)}.</p>']
    if family.name == GRID:
        return "".join([*parts, "<p>Steady-state peak in mm, one map for each follower.</p>", svg.heat_maps(mine)])
    if len(family.levels) > 1:
        parts.append(svg.level_curves(mine, family.axis))
    for (_, level), scores in by_level(mine).items():
        parts.append(f"<details><summary>{html.escape(family.axis)}: <b>{html.escape(level)}</b></summary>")
        parts.append(svg.flight_curves(scores))
        parts.append(f'<div class="scroll">{_table(scores, sortable=False)}</div></details>')
    return "".join(parts)


def _filters(report: Report) -> str:
    def options(names: Sequence[str]) -> str:
        return "<option value=''>all</option>" + "".join(f"<option>{html.escape(name)}</option>" for name in names)

    families = options([family.name for family in report.families])
    followers = options(list(dict.fromkeys(score.follower for score in report.scores)))
    return (
        f'<p><label>family <select id="family">{families}</select></label>'
        f'<label>follower <select id="follower">{followers}</select></label></p>'
    )


def _table(scores: Sequence[Score], sortable: bool = True) -> str:
    heads = ["family", "level", "follower", *(f"{name} {UNITS[name]}".strip() for name in RANKED), "failed"]
    cells = "".join(f"<th><button>{head}</button></th>" if sortable else f"<th>{head}</th>" for head in heads)
    winning = {key: winners(rivals, "peak") for key, rivals in by_level(scores).items()}
    rows = []
    for score in scores:
        best = score.follower in winning[score.family, score.level]
        names = "".join(f"<td>{html.escape(text)}</td>" for text in (score.family, score.level, score.follower))
        numbers = "".join(_number(score.summary(name)) for name in RANKED)
        failed = f'<td data-v="{score.failures}">{score.failures}/{len(score.metrics)}</td>'
        rows.append(f"<tr{' class=best' if best else ''}>{names}{numbers}{failed}</tr>")
    name = ' id="scores"' if sortable else ""
    return f'<table class="scores"{name}><thead><tr>{cells}</tr></thead><tbody>{"".join(rows)}</tbody></table>'


def _number(summary: Summary) -> str:
    median, low, high = dataclasses.astuple(summary)
    if math.isnan(median):
        return '<td data-v="1e300">-</td>'
    if math.isinf(median):
        return '<td data-v="1e299">never</td>'
    end = f"{high:.3g}" if math.isfinite(high) else "never"
    spread = "" if low == high else f" <small>[{low:.3g}, {end}]</small>"
    return f'<td data-v="{median:.9g}">{median:.3g}{spread}</td>'


def _cards(cards: Mapping[str, Mapping[str, Any]]) -> str:
    parts = []
    for name, card in cards.items():
        shown = {key: value for key, value in card.items() if key not in CARD_HIDES}
        text = html.escape(json.dumps(shown, indent=1, default=str))
        parts.append(f"<details><summary>card of <b>{html.escape(name)}</b></summary><pre>{text}</pre></details>")
    return "".join(parts)
