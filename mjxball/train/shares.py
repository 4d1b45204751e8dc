"""Shares: a population trained in equal parts, each a separate run, and gathered afterwards."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from mjxball import config as configs
from mjxball.config import Config
from mjxball.errors import InputError
from mjxball.policy.file import PolicyFile, load_file, save_file
from mjxball.train.curves import LOG, POLICIES, best_member, read_members
from mjxball.train.run_directory import METRICS, MOST_MEMBERS, POLICY, members_of, read_config, read_metrics, write_rows

SAME = ("physics", "seeds", "source_hash", "versions", "extensions", "extension_hash")


def read(text: str) -> tuple[int, int]:
    """(I, N) of the flag `--share I/N`; InputError unless I is one of 0 .. N - 1."""
    found = re.fullmatch(r"([0-9]{1,4})/([0-9]{1,4})", text)
    if not found or int(found[1]) >= int(found[2]):
        raise InputError(f"--share must be I/N with I = 0 .. N - 1, such as 0/8, not {text!r}")
    return int(found[1]), int(found[2])


def take(origin: dict[str, Any], index: int, number: int) -> None:
    """Reduce the population that `origin` describes to the part `index` of `number`, and record both in `origin`.

    Raises InputError if the members cannot be divided equally: parts of equal size share one compiled program.
    """
    count, rest = divmod(origin["seeds"], number)
    if rest:
        raise InputError(f"--num-seeds {origin['seeds']} cannot be divided into {number} equal shares")
    members = slice(index * count, (index + 1) * count)
    if origin["sweep"] is not None:
        origin["sweep"] = {name: values[members] for name, values in origin["sweep"].items()}
    if isinstance(origin.get("start_from"), list):
        origin["start_from"] = origin["start_from"][members]
    origin |= {"seed": origin["seed"] + members.start, "seeds": count, "share": [index, number]}


def gather(runs: Sequence[Path], out: Path) -> tuple[Config, dict[str, Any]]:
    """Write `members/`, `members.csv` and the best member's `policy.npz` of all `runs` to `out`.

    Returns (configuration, origin) of the whole population. Raises InputError unless `runs` are all parts of one
    population, each trained to its end.
    """
    found: dict[int, tuple[Path, Config, dict[str, Any]]] = {}
    for run in runs:
        settings, origin = read_config(run)
        index = _share(run, origin)[0]
        if index in found:
            raise InputError(f"{found[index][0]} and {run} are both share {index}")
        found[index] = (run, settings, origin)
    parts = [found[index] for index in sorted(found)]
    _refuse_unlike(parts)
    number = parts[0][2]["share"][1]
    if missing := [str(index) for index in range(number) if index not in found]:
        raise InputError(f"of {number} shares these are missing: {', '.join(missing)}")
    rows = [row for run, _, origin in parts for row in _evaluations(run, origin)]
    rows.sort(key=lambda row: (row["steps"], row["seed"]))
    policies = {seed: policy for run, _, origin in parts for seed, policy in _policies(run, origin).items()}
    (out / POLICIES).mkdir(parents=True)
    for seed, policy in policies.items():
        save_file(out / POLICIES / f"seed{seed}.npz", policy)
    write_rows(out / LOG, list(rows[-1]), rows)
    _, settings, first = parts[0]
    save_file(out / POLICY, policies[first["seed"] + best_member(rows)])
    return settings, {**first, "seeds": number * first["seeds"]}


def _share(run: Path, origin: dict[str, Any]) -> tuple[int, int]:
    """(index, number) of the share that `run` trained. Raises InputError if it trained none."""
    share = origin.get("share")
    if (
        not isinstance(share, list)
        or [type(value) for value in share] != [int, int]
        or not 0 <= share[0] < share[1] <= MOST_MEMBERS
    ):
        raise InputError(f"{run} is no part of a population: it was not trained with --share I/N")
    extensions = origin.get("extensions") or {}
    if not isinstance(extensions, dict):
        raise InputError(f"{run} says extensions {extensions!r}, expected names")
    if extensions.get("env"):
        raise InputError(f"{run} trained on an environment of its own, whose members are not compared")
    return share[0], share[1]


def _refuse_unlike(parts: Sequence[tuple[Path, Config, dict[str, Any]]]) -> None:
    """Raise InputError unless all `parts` are of one population."""
    records = [_common(settings, origin) for _, settings, origin in parts]
    for (run, *_), record in zip(parts, records, strict=True):
        unlike = [name for name, value in record.items() if value != records[0][name]]
        if unlike:
            raise InputError(f"{run} is of another population than {parts[0][0]}: they differ in {', '.join(unlike)}")


def _common(settings: Config, origin: dict[str, Any]) -> dict[str, Any]:
    """Values that must be equal in all parts of one population."""
    index, number = origin["share"]
    return {
        **{name: origin.get(name) for name in SAME},
        "configuration": configs.config_hash(settings),
        "first seed": origin["seed"] - index * origin["seeds"],
        "number of shares": number,
        "swept settings": sorted(origin["sweep"] or ()),
    }


def _evaluations(run: Path, origin: dict[str, Any]) -> list[dict[str, Any]]:
    """Rows of `members.csv`; those of a run of one member come from `metrics.csv`. InputError for an unfinished run."""
    rows: list[dict[str, Any]] = list(read_members(run))
    if origin["seeds"] == 1:
        try:
            rows = [
                {
                    "steps": int(row["steps"]),
                    "seed": origin["seed"],
                    **{name: float(value or "nan") for name, value in row.items() if name.startswith("eval_")},
                }
                for row in read_metrics(run / METRICS)
                if row.get("eval_return")
            ]
        except (KeyError, ValueError):
            raise InputError(f"{run / METRICS} is damaged: it holds what is no number") from None
    if not rows or not (run / "eval").is_dir():  # created when training ends
        raise InputError(f"{run} was not trained to its end; say --resume {run}")
    return rows


def _policies(run: Path, origin: dict[str, Any]) -> dict[int, PolicyFile]:
    """Policy files by seed. Raises InputError unless every seed of the run has one."""
    files = [run / POLICY] if origin["seeds"] == 1 else members_of(run)
    policies: dict[Any, PolicyFile] = {policy.metadata.get("seed"): policy for policy in map(load_file, files)}
    seeds = range(origin["seed"], origin["seed"] + origin["seeds"])
    if set(policies) != set(seeds):
        raise InputError(f"{run} must hold the policies of seeds {seeds[0]} to {seeds[-1]}")
    return policies
