"""Success of a follower while it trains, in a few flights of mjxball-bench beside followers that are known."""

from __future__ import annotations

import contextlib
import json
import queue
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import NamedTuple

from mjxball.bench.quick import Success, known_success, quick_success
from mjxball.errors import InputError
from mjxball.files import write_atomically

STEM = "success"  # of the files in a run's directory eval


class Point(NamedTuple):
    """Success of the follower at a time."""

    seconds: float  # since the command began
    success: Success


class Watch:
    """Flies policies in a thread of its own, which ends with the process: Ctrl-C waits for no flight."""

    def __init__(self, track: str, began: float, say: Callable[[str], None]):
        """`began`: monotonic time when the command did [s]. `say` is called with a sentence for every policy."""
        self._track, self._began, self._say = track, began, say
        self._waiting: queue.Queue[tuple[Path, float] | None] = queue.Queue()
        self.known: dict[str, Success] = {}
        self.points: list[Point] = []
        self._thread = threading.Thread(target=self._work, daemon=True)

    def start(self) -> None:
        """Begin with what the known followers reach, flown only where that is not stored."""
        self._thread.start()

    def __call__(self, policy: Path) -> None:
        """Fly the policy file as it will be when its turn comes, in place of one that still waits."""
        with contextlib.suppress(queue.Empty):
            self._waiting.get_nowait()
        self._waiting.put((policy, time.monotonic() - self._began))

    def end(self) -> None:
        """Wait until all is flown."""
        self._waiting.put(None)
        self._thread.join()

    def _work(self) -> None:
        from mjxball.bench.draw import quick_group
        from mjxball.evaluate.policies import load_policy

        config = quick_group(self._track).config
        self.known = known_success(self._track)
        while job := self._waiting.get():
            path, seconds = job
            try:
                (success,) = quick_success(self._track, [load_policy(path, config)])
            except InputError as error:  # it commands what is not finite
                self._say(f"success after {seconds:.0f} s: not measured, {error}")
                continue
            self.points.append(Point(seconds, success))
            others = "; ".join(f"{name} {_percent(one)}" for name, one in self.known.items())
            self._say(f"success after {seconds:.0f} s: {_percent(success)} % calm/disturbed ({others})")


def _percent(success: Success) -> str:
    return "/".join(f"{100 * share:.0f}" for share in success.values())


def write(watched: Watch, out: Path) -> str:
    """The table of all followers; the points also go to `out`/success.json and .png."""
    rows: Mapping[str, Success] = {"this policy": watched.points[-1].success, **watched.known}
    out.mkdir(exist_ok=True)
    record = {
        "points": [{"seconds": round(one.seconds, 1), **one.success} for one in watched.points],
        "known": watched.known,
    }
    write_atomically(out / f"{STEM}.json", json.dumps(record, indent=1) + "\n")
    _plot(watched, out / f"{STEM}.png")
    conditions = list(watched.points[-1].success)
    width = max(map(len, rows))
    lines = [f"{'success [%]':{width}}  {'  '.join(conditions)}"]
    for name, success in rows.items():
        lines.append(f"{name:{width}}  " + "  ".join(f"{100 * success[one]:{len(one)}.0f}" for one in conditions))
    return "\n".join(lines)


def _plot(watched: Watch, path: Path) -> None:
    """Success over time, the known followers as lines."""
    from mjxball.plotting import legend_above, line, pyplot, save, series_styles

    figure, axes = pyplot().subplots(1, 2, sharey=True, figsize=(8, 3.4), constrained_layout=True)
    looks = series_styles(["this policy", *watched.known])
    for axis, condition in zip(axes, watched.points[-1].success, strict=True):
        times = [one.seconds for one in watched.points]
        shares = [100 * one.success[condition] for one in watched.points]
        axis.plot(times, shares, label="this policy", **looks["this policy"])
        for name, success in watched.known.items():
            axis.plot([0, times[-1]], [100 * success[condition]] * 2, label=name, **line(looks[name]))
        axis.set(title=condition, xlabel="time since the start of the command [s]", ylim=(0, 100))
        axis.grid()
    axes[0].set_ylabel("success [%]")
    legend_above(figure, axes[:1])
    save(figure, path)
