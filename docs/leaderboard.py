#!/usr/bin/env python3
"""Write docs/leaderboard.md from the entries in benchmarks/leaderboard/.

`python docs/leaderboard.py [FILE.md]`; an entry of another version, of other flights or of changed sources is refused.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

from mjxball.bench import NAME, VERSION
from mjxball.bench.entry import cells, read_entry
from mjxball.bench.score import CONDITIONS
from mjxball.bench.tracks import FLIGHTS, SECONDS, TRACKS
from mjxball.cli import make_parser, run_command
from mjxball.errors import InputError
from mjxball.files import write_whole

REPOSITORY = Path(__file__).parents[1]
ENTRIES, PAGE = REPOSITORY / "benchmarks" / "leaderboard", REPOSITORY / "docs" / "leaderboard.md"
HEAD = f"""# Leaderboard

{NAME}, version {VERSION}: every follower flies the same random flights, {FLIGHTS} of {SECONDS:g} s in each track and
condition. A flight is **met** if it does not fail and is as good as the best classical follower that knows the plant:
its peak after 20 s is at most 3 mm larger, it settles (2 %) at most 10 % or 0.1 s later, and it overshoots by at most
1 % more. The best is taken in each number apart, of `lqg`, `lqg-slow` and `lqg-offset-free` in the same flight; of
random rigs, of the two LQGs that are told the rig; of Crazyflies, of `lqg`, which so
meets all of its own. Every load leaves a [margin](model.md#what-can-be-trimmed) of 15 %.

| track | plant and flights | disturbed |
|---|---|---|
| pair, mass known | the paper's; CG 2 - 17 cm at 0.2 - 3.1 rad/s, 0.1 - 0.6 kg | noise, 40 ms |
| pair, mass unknown | the same, believed to be 0.2 kg; the references know it | noise, 40 ms |
| teams of 3 to 6 | rings; the load on a path in the plane | noise, 40 ms |
| any rig | rigs that no training draws, masses and thrusts not as believed | noise, 20 ms |
| two Crazyflies | simulated 2.1 with a ball, masses and thrusts off | noise / 2, drift, 30 ms, the radio's resolution |

`balance`, `sac`, `universal`, `flight` and `paper` are [shipped](followers.md#trained). `transport` (2
million steps of SAC) and `robust` are in `policies/archive/`.
`transport-sac`, `-ppo` and `-gradient` are what `python train.py transport --physics newton-euler --algorithm sac`,
`ppo` or `gradient` comes to within a minute and a half on two cores. `brax-*`, `sb3-*` and `sbx-sac` are Brax's,
Stable-Baselines3's and SBX's own SAC and PPO, of seed 0, in the same environment for as many steps: `python
benchmarks/foreign_trainers.py sb3-sac sb3-sac.npz`. Their returns and CPU seconds: [other
trainers](gym.md#other-trainers). `balance-memoryless` is `balance` without its GRU and its last action, 219 CPU
seconds of `python train.py balance --algorithm gradient --follower.recurrent_units 0 --follower.previous_action false
--gradient.policy_layers 64,64 --gradient.gradient_steps 500 --gradient.num_envs 64`. `memoryless` is a [classical
law](followers.md). `raptor` is two policies of [RAPTOR](https://arxiv.org/abs/2509.11481), which command the rotors of
leader and follower; `python benchmarks/raptor.py` flies them.

Entries of a track stand newest first, those of one day by their share met. `oracle` and `lqg-known-failures` are told
what no follower can know, `stay` and `random` are no laws: they are not ranked.

Columns: share met and its 95 % interval, flights that failed, median settling time, 90 % quantile of the peaks, time
with a rotor at its limit, rms change of commands from step to step. A dash: never, or nothing to measure.

## Send an entry

```bash
python eval.py --benchmark my_policy.npz --out my_policy.json
```

`my_policy.npz` may be an ONNX file with the inputs of [our exports](policy-file.md#export) (extra `onnx`), or
`module:Class` ([your own follower](howto/own-baseline.md)). A track takes up to ten minutes on two cores; `--tracks
pair` flies one. A track whose plants the follower refuses is left out. Add the file to `benchmarks/leaderboard/`, run
`python docs/leaderboard.py`, and open a pull request. We repeat it with `--draw`, on flights that nobody has seen.
"""


def page(entries: list[dict[str, Any]]) -> str:
    """The whole page."""
    parts = [HEAD]
    for name, track in TRACKS.items():
        rows = sorted(
            (entry for entry in entries if name in entry["tracks"]),
            key=lambda entry: (entry["date"], [entry["tracks"][name][one]["met"] for one in CONDITIONS]),
            reverse=True,
        )
        parts.append(f"## {track.title[0].upper()}{track.title[1:]}\n")
        parts.append(
            "| follower | | met % | 95 % | failed % | settles s | 90 % peak mm | limit % | change mrad | date, commit |"
        )
        parts.append("|---|---|---|---|---|---|---|---|---|---|")
        for entry in rows:
            beside = ((f"`{entry['follower']}`", entry["date"]), ("", entry["commit"][:7]))
            for condition, (called, made) in zip(CONDITIONS, beside, strict=True):
                shown = " | ".join(cells(entry["tracks"][name][condition]))
                parts.append(f"| {called} | {condition} | {shown} | {made} |")
        parts.append("")
    return "\n".join(parts)


def main(arguments: list[str] | None = None) -> int:
    """Write the page."""
    parser = make_parser("python docs/leaderboard.py", "Write the leaderboard's page from its entries.")
    parser.add_argument("out", nargs="?", type=Path, default=PAGE, metavar="FILE.md")
    out = parser.parse_args(arguments).out
    if out.suffix != ".md":
        raise InputError(f"the page is a file .md, not {out}")
    entries = [read_entry(path) for path in sorted(ENTRIES.glob("*.json"))]
    names = [entry["follower"] for entry in entries]
    if twice := [name for name in names if names.count(name) > 1]:
        raise InputError(f"two entries are of {twice[0]}")
    write_whole(out, page(entries))
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
