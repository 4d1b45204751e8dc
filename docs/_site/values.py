"""Values on the pages come from the code: `{{ takeoff.CLIMB }}` is replaced before a page is parsed.

Between the braces stands a Python expression of the names below, and a format where the page rounds: `{{ TILT:.2f }}`.
"""

from __future__ import annotations

import functools
import importlib
import json
import math
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

REPOSITORY = Path(__file__).parents[2]
sys.path[:0] = [str(REPOSITORY), str(REPOSITORY / "benchmarks")]

from mjxball.bench import CONDITIONS  # noqa: E402
from mjxball.bench.draw import STORED_DRAW, read_stored  # noqa: E402
from mjxball.bench.tracks import TRACKS, candidate  # noqa: E402
from mjxball.cli import plant_setup  # noqa: E402
from mjxball.config import Autopilot, preset, total_mass  # noqa: E402
from mjxball.control import crazyflie, motors  # noqa: E402
from mjxball.control.axes import axes  # noqa: E402
from mjxball.control.constants import hover  # noqa: E402
from mjxball.plant import plant_parameters  # noqa: E402
from mjxball.policy import file  # noqa: E402
from mjxball.policy.formats.c_header import weight_bytes  # noqa: E402
from mjxball.sim import disturbances  # noqa: E402
from mjxfly.limits import Limits, Times  # noqa: E402
from mjxfly.margins import REQUIREMENTS, gains_of  # noqa: E402
from mjxfly.mocap_supervision import MocapLimits  # noqa: E402
from mjxfly.mount_modes import loop_on_mount, lowest_mode  # noqa: E402
from mjxfly.preflight import Preflight  # noqa: E402
from mjxfly.twin.conditions import Battery  # noqa: E402
from mjxfly.twin.coupled import WORN_SAG  # noqa: E402

MODULES = (  # known by their last name
    *("horizon", "math", "mjxball.config", "mjxball.xla", "mjxball.control.crazyflie"),
    *(
        "mjxball.control.network_interface",
        "mjxball.control.motors",
        "mjxball.control.observation",
        "mjxball.evaluate.metrics",
        "mjxball.evaluate.running_metrics",
        "mjxball.physics.engine",
        "mjxball.sim.sensors",
    ),
    *("mjxball.bench", "mjxball.sim.rigs", "mjxball.algorithms.gradient"),
    *(f"mjxball.bench.{name}" for name in ("conditions", "draw", "success", "tracks")),
    *("mjxball.policy.container", "mjxball.policy.file", "mjxball.sim.disturbances", "mjxball.train.loop"),
    *("mjxball.train.program", "mjxfly.app.protocol", "mjxfly.view.live"),
    *(
        f"mjxfly.{name}"
        for name in ("measured", "monitor", "policy_setup", "positioning", "preflight", "probe", "setpoints")
    ),
    *(f"mjxfly.{name}" for name in ("takeoff", "uri", "watchdog")),
)
DEG = 180 / math.pi
pair, older, upgrade, brushless = (
    plant_setup(Path(f"crazyflie{name}")) for name in ("", "-older", "-thrust-upgrade", "-brushless")
)
rig, team, plate = pair.plant, plant_setup(Path("team3")).plant, plant_setup(Path("plate4")).plant
ball = rig.object_mass * rig.moving_fraction  # [kg]
paper, transport, flight, stand = (preset(name) for name in ("paper", "transport", "flight", "stand"))
two = paper.plant
stiffness = np.array(plant_parameters(two, paper.attitude).gains.kp)  # of the attitude loop [N m/rad]
tilt = 0.2 * 9.81 * 0.05 / stiffness[1]  # of a command that holds 0.2 kg 5 cm off [rad]
full = float(motors.force(motors.MOTORS["2.1"], np.array(crazyflie.FULL), 3.0 - WORN_SAG))
c_files = "".join(path.read_text() for path in sorted((REPOSITORY / "mjxfly/app").glob("*.[ch]")))
defined = re.findall(r"#define (\w+) ([\d.e-]+)[fu]?\b", c_files)


def layers(name: str) -> SimpleNamespace:
    """Recurrent units and units of the layer of a shipped policy."""
    with np.load(file.shipped_policy(name)) as found:
        return SimpleNamespace(recurrent=len(found["gru_recurrent"]), dense=len(found["bias_0"]))


@functools.cache
def results(name: str) -> Any:
    """Contents of a file of `benchmarks/results/`."""
    return json.loads((REPOSITORY / "benchmarks" / "results" / f"{name}.json").read_text())


def largest(found: list[dict[str, Any]], key: str) -> float:
    """The largest value of `key` in rows of such a file."""
    return max(row[key] for row in found)


def hovers(board: bool) -> list[float]:
    """Errors of `flight` in hover [mm rms], of every radio delay, with its controller on board or on the laptop."""
    found = results("onboard_flights")["delay"]
    return [row["rmse"] for row in found if row["policy"] == "flight" and (row["case"] != "laptop") is board]


def rounding(pivot: bool) -> float:
    """Largest relative difference between the engines' accelerations, on the pivot or elsewhere."""
    own = [row for row in results("engines")["rows"] if (row["stand"] == "pivot") is pivot]
    return max(row[name] for row in own for name in row if "form" in name or "MJX" in name)


def span(ends: tuple[float, float], factor: float = 1.0) -> str:
    """A range, times `factor`."""
    return " - ".join(f"{factor * end:g}" for end in ends)


@functools.cache
def oracle_share(track: str) -> str:
    """calm/disturbed: of the candidates of draw 0 whose load can be trimmed, those that the oracle succeeds in [%]."""
    shares = []
    for condition in CONDITIONS:
        tried = kept = 0
        for number, (plant, stored) in enumerate(
            zip(TRACKS[track].flights(STORED_DRAW), read_stored(track)["plants"], strict=True)
        ):
            found = [which for which, _ in stored[condition]]
            candidates = (
                candidate(track, STORED_DRAW, number, condition, which, plant.sample) for which in range(found[-1] + 1)
            )
            tried, kept = tried + sum(one is not None for one in candidates), kept + len(found)
        shares.append(f"{100 * kept / tried:.0f}")
    return "/".join(shares)


def ranked(track: str, follower: str, conditions: Sequence[str] = CONDITIONS) -> str:
    """calm/disturbed: successes of `follower` on the leaderboard [%]."""
    entries = importlib.import_module("docs.leaderboard").entries()
    (own,) = (entry["tracks"][track] for entry in entries if entry["follower"] == follower)
    return "/".join(f"{100 * own[one]['succeeded'] / own[one]['flights']:.0f}" for one in conditions)


teams = [row for row in results("horizon")["rows"] if (row["policy"], row["seconds"]) == ("universal", 600)]
ten_minutes = {
    key: largest([row for row in teams if row["drones"] > 2], key) for key in ("command_spread", "rotor_power")
}

delivered = {
    row["follower"]: row
    for row in results("twin_hover")["rows"]
    if (row["drone"], row["case"]) == ("2.1", "as delivered")
}

NAMES: dict[str, Any] = {
    **{name.rpartition(".")[2]: importlib.import_module(name) for name in MODULES},
    **{name: value for name, value in globals().items() if not name.startswith("_")},
    "C": SimpleNamespace(**{name: float(value) for name, value in defined}),  # of the apps on board
    "axes": axes,
    "hover": hover,
    "autopilot": Autopilot(),
    "limits": Limits(),
    "times": Times(),
    "mocap": MocapLimits(),
    "ready": Preflight(),
    "battery": Battery(),
    "need": REQUIREMENTS,
    "modes": [lowest_mode(loop_on_mount(gains_of(pair.autopilot, axis), axis, pair), 0.02) for axis in axes(pair)[:2]],
    "frequency": paper.attitude.natural_frequency,
    "inertia": 2 * stiffness / np.array(paper.attitude.natural_frequency) ** 2,
    "balance": layers("balance"),
    "universal": layers("universal"),
    "noise": disturbances.NOISE[[0, 3, 6, 9]],
    "lift": 8 * full / 9.81 / total_mass(rig),  # share of the weight that a battery of 3 V carries
    "ten_minutes": SimpleNamespace(**ten_minutes),
    "silent": [row for row in results("fly_faults_virtual")["faults"] if row["fault"] == "silent-up"],
    "twin": SimpleNamespace(
        nearer=delivered["flight"]["rms"] / delivered["lqg"]["rms"],
        crashes={row["follower"]: row["crashes"] for row in results("crazyflie")["flight"]},
    ),
    "kept": {row["follower"]: row["kept"] * row["starts"] for row in results("crazyflie")["stand"]},
    "upload": len(weight_bytes(file.load_file(file.shipped_policy("flight")))),
}


def replaced(text: str) -> str:
    """The text of a page, its expressions evaluated; large numbers in groups of three digits."""

    def value(found: re.Match[str]) -> str:
        return format(eval(found[1], NAMES), found[2] or "g").replace(",", " ")

    return re.sub(r"\{\{ (.+?)(?::([^:{}]+))? \}\}", value, text)


def setup(app: Any) -> dict[str, bool]:
    """Register with Sphinx."""

    def read(app: Any, name: str, source: list[str]) -> None:
        source[0] = replaced(source[0])

    app.connect("source-read", read)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
