"""Tables of measurements on the pages are those of the files that they name."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from typing import Any

from command_line import REPOSITORY
from tables import rows

Numbers = list[Any]  # in the order of a row; None: never


def measured(name: str) -> Any:
    return json.loads((REPOSITORY / "benchmarks" / "results" / f"{name}.json").read_text())


def one(found: list[dict[str, Any]], **given: Any) -> dict[str, Any]:
    (row,) = (row for row in found if all(row.get(key) == value for key, value in given.items()))
    return row


def stability() -> Iterator[tuple[str, Numbers]]:
    found = measured("balance_stability")
    own = [row for row in found["hovers"] if row["follower"] == "balance" and not row.get("unknown")]
    margins = [row["delay_margin"] for row in own]
    worst = [max(row["radius"] for row in own), *([] if None in margins else [1e3 * min(margins)])]
    error = 1e3 * max(row["error"] for row in own)
    peaks = [1e3 * found["peaks [m]"][name] for name in ("median", "99 %", "largest")]
    stable = sum(row["stable"] for row in own)
    yield f"{stable} of {len(own)}", [*worst, error, found["failed"], *peaks]


def modes() -> Iterator[tuple[str, Numbers]]:
    found = measured("universal_modes")["hovers"]
    for plant in ("pair", "team3", "team4", "team6"):
        own = [row for row in found if row["plant"] == plant]
        stable = [sum(row["stable"] for row in own if row["delay"] == delay) for delay in (0.0, 0.02, 0.04, 0.06)]
        yield plant, [*stable, 1e3 * max(row["error"] for row in own), 1e3 * max(row["swing"] for row in own)]


def minutes() -> Iterator[tuple[str, Numbers]]:
    found = [row for row in measured("horizon")["rows"] if row["seconds"] == 600]
    for name, policy, plant in (
        *((name, name, "paper") for name in ("balance", "balance-sac")),
        *((name, "universal", name) for name in ("pair", "team3", "team4", "team6")),
        *((f"ring of {size}", "lost", f"ring of {size}") for size in (3, 6)),
    ):
        own = [row for row in found if (row["policy"], row["plant"]) == (policy, plant)]
        peak = max(row[f"{axis}_peak"] for row in own for axis in "xyz")
        spread = [row["command_spread"] for row in own if row["command_spread"] is not None]
        yield (
            {"pair": "`universal`, pair", "ring of 3": "`lost`, ring of 3"}.get(name, name),
            [1e3 * peak, max(row["rotor_power"] for row in own), *([max(spread)] if spread else [])],
        )


def beyond() -> Iterator[tuple[str, Numbers]]:
    found = measured("beyond")["rows"]
    for case in dict.fromkeys(row["case"] for row in found):
        names = ("lqg-calm", "lqg-disturbed", "balance-sac", "balance", "oracle")
        *own, oracle = (one(found, case=case, follower=name) for name in names)
        errors = [None if row["error"] is None else 1e3 * row["error"] for row in (*own, oracle)]
        yield case, [*errors[:-1], own[-1]["power"], 100 * own[-1]["rotor_limit_share"], errors[-1]]


def lost() -> Iterator[tuple[str, Numbers]]:
    for row in measured("lost")["rows"]:
        shares = [100 * row[name] / row["flights"] for name in ("in_air", "below_peak")]
        peaks = [None if row[name] is None else 1e3 * row[name] for name in ("peak", "whole_late_90")]
        cost = [row["rotor_power"], 100 * row["rotor_limit_share"]]
        yield f"`{row['follower']}`, {row['condition']}", [*shares, *peaks, *cost]


def first() -> Iterator[tuple[str, Numbers]]:
    columns = {"policy": 1, "command": 1, "calm": 100, "disturbed": 100}
    found, cost = measured("first_command"), {"rotor_power": 1, "rotor_limit_share": 100}
    for row in found["rows"]:
        warm = ", warm" if row["cache"] == "warm" else ""
        costs = [scale * row[f"{one} {name}"] for name, scale in cost.items() for one in ("calm", "disturbed")]
        yield f"seed {row['seed']}{warm}", [*(scale * row[name] for name, scale in columns.items()), *costs]
    own = found["again"]
    costs = [scale * own[f"{one} {name}"] for name, scale in cost.items() for one in ("calm", "disturbed")]
    yield "seed 0, with another noise", [100 * own["calm"], 100 * own["disturbed"], *costs]
    (sac,) = measured("first_command_sac")["rows"]
    yield "--algorithm sac", [scale * sac[name] for name, scale in columns.items()]
    for name in ("lqg", "lqg-disturbed", "balance"):
        entry = json.loads((REPOSITORY / "benchmarks" / "leaderboard" / f"{name}.json").read_text())
        counts = [entry["tracks"]["pair"][one] for one in ("calm", "disturbed")]
        shares = [100 * one["succeeded"] / one["flights"] for one in counts]
        costs = [scale * one[key] for key, scale in cost.items() for one in counts]
        yield f"`{name}`", [*shares, *costs]


def training() -> Iterator[tuple[str, Numbers]]:
    for place, name in (("one H200", "training_h200"), ("two cores", "training_2_cores")):
        found = measured(name)["summary"]
        (own,), brax = found["ours"], found["stock"][-1]
        yield f"{place}: `train", [own["cold"], own["warm"], own["x_peak"], own["settling_time"]]
        assert not brax["at the bar"]
        steps = f"{round(brax['steps'], -3):,}".replace(",", " ")
        yield f"{place}: Brax, {steps} steps", [brax["cold"], brax["x_peak"], brax["settling_time"]]


def algorithms() -> Iterator[tuple[str, Numbers]]:
    for places, name in (
        (("one H200: SAC", "one H200: PPO", "CPU of the H200's machine: gradients"), "algorithms_h200"),
        (("two cores: SAC", "two cores: PPO", "two cores: gradients"), "algorithms_2_cores"),
    ):
        for place, algorithm in zip(places, ("sac", "ppo", "gradient"), strict=True):
            own = one(measured(name)["table"], algorithm=algorithm)
            far = [1e3 * own["x_peak"], 1e3 * own["x_peak_worst"]]
            yield place, [own["cold"], own["warm"], *far, own["settling_time"], own["settling_time_worst"]]


def trainers() -> Iterator[tuple[str, Numbers]]:
    found = measured("foreign_trainers")["rows"]
    for line, name in (
        *(("SAC: `train.py", "train.py-sac"), ("SBX", "sbx-sac"), ("Stable-Baselines3 2", "sb3-sac")),
        *(("Brax 0", "brax-sac"), ("PPO: `train.py", "train.py-ppo"), ("Stable-Baselines3 |", "sb3-ppo")),
        ("Brax |", "brax-ppo"),
    ):
        own = one(found, trainer=name)
        far = 1e3 * own["x_peak"]
        yield line, [own["steps"], own["cpu_seconds"], own["return"], far, own["settling_time"]]
    yield "copy", [one(found, trainer="copy")["return"]]


def crazyflies() -> Iterator[tuple[str, Numbers]]:
    for row in measured("crazyflie")["flight"]:
        yield row["follower"], [row["crashes"], row["rmse"], row["rmse, worst of 99 %"]]


def twin() -> Iterator[tuple[str, Numbers]]:
    found = measured("twin_hover")["rows"]
    followers = ("flight", "universal", "lqg", "lqg-calm", "lqg-disturbed")
    for drone, case in dict.fromkeys((row["drone"], row["case"]) for row in found):
        line = case if drone == "2.1" else f"{drone.replace('-', ' ')}, {case}"
        yield line, [1e3 * one(found, drone=drone, case=case, follower=name)["rms"] for name in followers]
    for name in followers:
        own = one(found, drone="2.1", case="as delivered", follower=name)
        numbers = [1e3 * own["largest"], 1e3 * own["sideways"], 1e3 * own["change"], own["touchdown"]]
        yield name, numbers
    assert not any(row["limit"] for row in found)
    assert {row["end"] for row in found} == {"done"}


def onboard() -> Iterator[tuple[str, Numbers]]:
    found = measured("onboard")["inference"]
    for name in ("universal", "balance", "flight"):
        own = [one(found, policy=name, weights=weights) for weights in ("float32", "int8")]
        yield name, [*(number for row in own for number in (row["flash"] / 1e3, row["ms"])), own[1]["error_rms"]]


def ablation() -> Iterator[tuple[str, Numbers]]:
    for row in measured("ablation")["rows"]:
        part = row["left out"].replace("; loops known", ", but each LQG is given")
        yield part, [100 * row[name] for name in ("lqg", "lqg-disturbed", "balance")]


SECTIONS: dict[str, tuple[str, Callable[[], Iterator[tuple[str, Numbers]]]]] = {
    "Stability": ("results", stability),
    "Modes of the team at hover": ("archive/rigs", modes),
    "Ten minutes": ("results", minutes),
    "Outside the benchmark": ("results", beyond),
    "A lost drone": ("results", lost),
    "The default training": ("results", first),
    "Training time": ("results", training),
    "Training time ": ("results", algorithms),
    "Other trainers": ("gym", trainers),
    "Which disturbances matter": ("leaderboard", ablation),
    "Two Crazyflies": ("results", crazyflies),
    "Two Crazyflies ": ("results", twin),
    "Cost and tests": ("hardware", onboard),
}


@rows("section", SECTIONS)
def test_a_table_is_that_of_its_file(section: str) -> None:
    page, wanted = SECTIONS[section]
    text = (
        (REPOSITORY / "docs" / f"{page}.md").read_text().partition(f"## {section.strip()}\n")[2].partition("\n## ")[0]
    )
    rows = [line.replace("**", "").strip("|").split("|") for line in text.splitlines() if line.startswith("|")]
    lines = [f"| {' | '.join(cell.strip() for cell in cells)} |" for cells in rows]
    for name, numbers in wanted():
        found = [line for line in lines if line.startswith((f"| {name}", f"| `{name}`"))]
        assert found, name
        assert any(agree(line, numbers) for line in found), (name, numbers, found)


def is_rounded(text: str, number: float) -> bool:
    """Whether `text` is the `number`, rounded to its digits."""
    return abs(float(text.replace(" ", "")) - number) <= 0.5001 * 10.0 ** -len(text.partition(".")[2])


def agree(line: str, numbers: Numbers) -> bool:
    """The row has these numbers, rounded to its digits, in this order; others may follow or stand before the first."""
    cells = re.sub(r"(?<=\d) (?=\d{3} )", "", line.partition(" | ")[2])
    shown = re.findall(r"(?<![\w.])(?:-?\d+(?:\.\d+)?(?![\w.]*\w)|never|failed)", cells)
    return len(shown) >= len(numbers) and all(
        text in ("never", "failed") if number is None else text[0] not in "nf" and is_rounded(text, number)
        for text, number in zip(shown, numbers, strict=False)
    )


@rows("policy", ("balance", "paper", "flight", "stand", "universal", "lost"))
def test_what_was_flown_for_ten_minutes(policy: str) -> None:
    """Every number of millimetres is the largest error in a flight of this policy."""
    text = (REPOSITORY / "docs" / "followers.md").read_text()
    table = text.partition("steady for ten minutes")[2].partition("\n\n")[0]
    (row,) = re.findall(rf"^\| `{policy}` \| (.*?) \|", table, flags=re.MULTILINE)
    own = [row for row in measured("horizon")["rows"] if row["policy"] == policy]
    peaks = [1e3 * max(row[f"{axis}_peak"] or 0.0 for axis in "xyz") for row in own]
    shown = re.findall(r"(?:from )?([\d.]+)(?: to ([\d.]+))? mm", row)
    assert shown
    for number in filter(None, sum(shown, ())):
        assert any(agree(f" | {number}", [peak]) for peak in peaks), (number, peaks)
