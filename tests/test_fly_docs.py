"""The pages on flying against the code: states, flags, bounds."""

from __future__ import annotations

import json
import math

from command_line import REPOSITORY

from mjxball.fly import command
from mjxball.fly.command import CommandMap
from mjxball.fly.limits import STAND_SPARE, Limits, Times
from mjxball.fly.main import make_parser
from mjxball.fly.mocap_supervision import MocapLimits
from mjxball.fly.packets import THRUST_CEILING, THRUST_FLOOR
from mjxball.fly.supervisor import State

DOCS = REPOSITORY / "docs"
FLYING, SUPERVISOR, MEASURED = (
    (DOCS / name).read_text(encoding="utf-8") for name in ("flying.md", "supervisor.md", "archive/flying.md")
)


def test_every_state_is_explained() -> None:
    assert [state.value for state in State if f"| {state.value} | " not in SUPERVISOR] == []


def test_every_flag_is_named() -> None:
    flags = [
        action.option_strings[-1]
        for action in make_parser()._actions
        if action.option_strings and action.dest not in ("help", "version")
    ]
    assert [flag for flag in flags if flag not in FLYING] == []


def test_bounds_are_those_of_the_code() -> None:
    bounds, times, law = Limits(), Times(), CommandMap()
    expected = {
        "age of a state": f"{1000 * bounds.state_age:.0f} ms",
        "fence around the start": f"±{bounds.fence_high[0]:g} m, "
        f"height {bounds.fence_low[2]:g} .. {bounds.fence_high[2]:g} m",
        "tilt of a drone": f"{math.degrees(bounds.tilt):.0f} degrees",
        "tilt of the drone that is heard, in *hold*": f"{math.degrees(bounds.hold_tilt):.0f} degrees",
        "tilt of the stick by both positions": f"{math.degrees(bounds.stick_tilt):.0f} degrees",
        "length of the stick by both positions": f"±{100 * bounds.stick_error:.0f} cm",
        "battery": f"{bounds.battery:g} V for {bounds.battery_time:g} s",
        "thrust at its bound": f"{bounds.saturation_time:g} s",
        "missed deadlines in a second": f"{bounds.missed_deadlines}",
        "gap between two ticks": f"{1000 * bounds.longest_gap:.0f} ms",
        "height above the goal, on a stand": f"{100 * STAND_SPARE:.0f} cm",
        "sent roll and pitch": f"±{math.degrees(law.tilt_limit):.0f} degrees",
        "sent thrust": f"{THRUST_FLOOR} .. {THRUST_CEILING} units",
        "ramp to hover": f"{times.ramp:g} s",
        "landing speed of the goal": f"{times.land_speed:g} m/s",
        "descent": f"{times.descend_speed:g} m/s for at most {times.descend_limit:g} s",
        "*hold* ends after the last word of a drone by": f"{times.drone_watchdog:g} s",
        "thrust in *hold* below hover": f"up to {100 * command.GENTLE / command.GRAVITY:.0f} %",
        "no good pose of a drone (motion capture)": f"{MocapLimits().lost:g} s",
    }
    rows = [tuple(line.strip("| ").split(" | ")) for line in SUPERVISOR.splitlines() if line.startswith("| ")]
    assert dict(row for row in rows if row[0] in expected) == expected


def test_faults_are_those_that_were_measured() -> None:
    """Of each fault the flight with the harder touchdown."""
    found = json.loads((REPOSITORY / "benchmarks" / "results" / "fly_firmware.json").read_text())["faults"]
    names = dict.fromkeys(one["fault"] for one in found)
    worst = {name: max((one for one in found if one["fault"] == name), key=lambda one: one["speed"]) for name in names}
    section = MEASURED.split("## Faults on the twin")[1].split("\n## ")[0]
    expected = {
        name: (", ".join(f"{off:.2f}" for off in one["off"]), f"{one['speed']:.2f}", f"{one['tilt']:.0f}°")
        for name, one in worst.items()
    }
    rows = [line.strip("| ").split(" | ") for line in section.splitlines() if line.startswith("| ")]
    assert {row[0]: (row[2], row[3], row[4]) for row in rows if row[0] in worst} == expected
