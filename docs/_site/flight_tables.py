"""Tables of the pages on flying, made from the code: the directive `generated` prints them as Markdown."""

from __future__ import annotations

import itertools
import json
import math
import statistics
from pathlib import Path
from typing import Any

from mjxball.policy import Policy
from mjxball.policy.file import shipped_policy
from mjxfly import lift, setpoints
from mjxfly.limits import STAND_SPARE, Limits, Times
from mjxfly.log_schema import KINDS
from mjxfly.log_sources import HEADER, RECORD, TOPICS, VARIABLES
from mjxfly.main import make_parser
from mjxfly.mocap_supervision import MocapLimits
from mjxfly.packets import THRUST_CEILING, THRUST_FLOOR
from mjxfly.policy_setup import config_of
from mjxfly.setpoints import CommandMap
from mjxfly.supervisor import TRANSITIONS, Event, FlightState
from mjxfly.twin.conditions import FAULT_KINDS, Conditions
from mjxfly.twin.drone import ACTED


def log_kinds() -> str:
    """The kinds of records in a flight log, and their fields."""
    lines = ["| kind | when | field | type | meaning |", "|---|---|---|---|---|"]
    for name, kind in KINDS.items():
        head = f"`{name}` | {kind.text}"
        for field, (type_, text, required) in kind.fields.items():
            lines.append(f"| {head} | `{field}`{'' if required else ' (optional)'} | {type_.name} | {text} |")
            head = " | "
    return "\n".join(lines)


def log_sources() -> str:
    """What is read of bags and of cfclient's files."""
    lines = ["| topic | type | what is read |", "|---|---|---|"]
    for name, topic in TOPICS.items():
        place = "" if name in (HEADER, RECORD, "tf") else "/DRONE"
        lines.append(f"| `{place}/{name}` | `{topic.type}` | {topic.text} |")
    lines += ["", "| log variable | quantity | component | factor to SI units, or as sent |", "|---|---|---|---|"]
    for name, variable in VARIABLES.items():
        lines.append(f"| `{name}` | {variable.quantity} | {variable.place + 1} | × {variable.factor:.6g} |")
    return "\n".join(lines)


def transitions() -> str:
    """The supervisor's transitions, an event a line and a state a column; an empty cell keeps the state."""
    states = [state for state in FlightState if state is not FlightState.DONE]
    lines = ["| event | " + " | ".join(state.value for state in states) + " |", "|---" * (len(states) + 1) + "|"]
    cells = {key: state.value for key, state in TRANSITIONS.items()} | {(FlightState.HOLD, Event.RESUMED): "as before"}
    for event in Event:
        lines.append(f"| {event.value} | " + " | ".join(cells.get((state, event), "") for state in states) + " |")
    return "\n".join(lines)


def flags() -> str:
    """The flags of `python -m mjxfly`."""
    lines = ["| flag | meaning |", "|---|---|"]
    for action in make_parser()._actions:
        if action.option_strings and action.dest not in ("help", "version"):
            shown = action.metavar or ("|".join(action.choices) if action.choices else "")
            shown = " ".join(shown) if isinstance(shown, tuple) else shown
            flag = f"`{action.option_strings[-1]} {shown}`".replace(" `", "`").replace("|", "\\|")
            lines.append(f"| {flag} | {action.help} |")
    return "\n".join(lines)


def bounds() -> str:
    """What ends a flight, and how long its parts last."""
    limits, times, controller = Limits(), Times(), CommandMap()
    rows = {
        "age of a state": f"{1000 * limits.state_age:.0f} ms",
        "fence around the start": f"±{limits.fence_high[0]:g} m, "
        f"height {limits.fence_low[2]:g} .. {limits.fence_high[2]:g} m",
        "tilt of a drone": f"{math.degrees(limits.tilt):.0f} degrees",
        "tilt of the drone whose states arrive, in *hold*": f"{math.degrees(limits.hold_tilt):.0f} degrees",
        "tilt of the stick, from both positions": f"{math.degrees(limits.stick_tilt):.0f} degrees",
        "error of the stick's length, from both positions": f"±{100 * limits.stick_error:.0f} cm",
        "battery": f"{limits.battery:g} V for {limits.battery_time:g} s",
        "battery in hover, predicted for the end of a landing": f"{lift.RESERVE:g} V above the voltage "
        "at which full power just carries the pair",
        "time with the thrust at its bound": f"{limits.saturation_time:g} s",
        "missed deadlines of the loop in a second": f"{limits.missed_deadlines}",
        "gap between two ticks of the loop": f"{1000 * limits.longest_gap:.0f} ms",
        "height above the goal, on a stand": f"{100 * STAND_SPARE:.0f} cm",
        "sent roll and pitch": f"±{math.degrees(controller.tilt_limit):.0f} degrees",
        "sent thrust": f"{THRUST_FLOOR} .. {THRUST_CEILING} units",
        "ramp to hover": f"{times.ramp:g} s, and at most {times.lift:g} s more until the pair is off the ground",
        "landing speed of the goal": f"{times.land_speed:g} m/s",
        "descent": f"{times.descend_speed:g} m/s for at most {times.descent_limit(0.4):.2g} s from 0.4 m",
        "longest *hold*, from the last packet of a drone": f"{times.drone_watchdog:g} s",
        "thrust in *hold* below hover": f"up to {100 * setpoints.UNEVEN / setpoints.GRAVITY:.0f} %, "
        f"{100 * setpoints.GENTLE / setpoints.GRAVITY:.0f} % if no drone's states arrive",
        "time without a valid pose of a drone (motion capture)": f"{MocapLimits().lost:g} s",
    }
    return "\n".join(["| bound | value |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows.items())])


def parameters() -> str:
    """The parameters on which the twin acts, by group."""
    lines = ["| group | parameters that the twin uses |", "|---|---|"]
    for group, names in itertools.groupby(sorted(ACTED), lambda name: name.partition(".")[0]):
        lines.append(f"| `{group}` | {', '.join(name.partition('.')[2] for name in names)} |")
    return "\n".join(lines)


def loads() -> str:
    """What each shipped policy for two Crazyflies carries on the twin."""
    lines = ["| policy | object [g] | CG on the twin |", "|---|---|---|"]
    for name in ("flight", "stand"):
        config = config_of(Policy.load(shipped_policy(name)).metadata)
        met = Conditions.of(config)
        moves = f"a sine of {1000 * met.cg_amplitude:.0f} mm at {met.cg_speed:g} rad/s"
        if config.motion.kind == "rolling":
            moves = f"a free ball that starts {100 * met.ball:g} cm from O"
        lines.append(f"| `{name}` | {1000 * met.object_mass:g} | {moves} |")
    return "\n".join(lines)


FAULTS = Path(__file__).parents[2] / "benchmarks" / "results" / "fly_faults_virtual.json"
TURNED = 90  # [degrees] of tilt, from which on the pair lies on its back


def faults() -> str:
    """What `--fault` does, and what `benchmarks/fly_faults_virtual.py` found: the flight with the harder touchdown."""
    rows = json.loads(FAULTS.read_text(encoding="utf-8"))["faults"]
    head = ("`--fault`", "what happens", "reaction", "motors off [s]", "touchdown", "largest tilt", "drift sideways")
    lines = [f"| {' | '.join(head)} |", "|---" * len(head) + "|"]
    for name in dict.fromkeys([*FAULT_KINDS, *(row["fault"] for row in rows)]):
        about = f"`{name}` | {FAULT_KINDS[name].about}" if name in FAULT_KINDS else f"| {name}"
        own = [row for row in rows if row["fault"] == name]
        if not own:
            lines.append(f"| {about} |" + " |" * (len(head) - 2))
            continue
        worst = max(own, key=lambda row: row["speed"])
        off = ", ".join(f"{value:.2f}" for value in worst["off"])
        numbers = f"{worst['speed']:.2f} m/s | {worst['tilt']:.0f}° | {worst['drift']:.2f} m"
        lines.append(f"| {about} ({worst['drone']}) | {reaction(worst)} | {off} | {numbers} |")
    return "\n".join(lines)


POSITIONING = FAULTS.with_name("fly_positioning.json")


def positioning() -> str:
    """Hover of `flight` on each system, by `benchmarks/fly_faults_virtual.py --positioning`."""
    rows = json.loads(POSITIONING.read_text(encoding="utf-8"))["flights"]
    names = ("rms", "x", "y", "z")
    lines = [
        f"| system | {' | '.join(f'{name} [mm]' for name in names)} | largest tilt | lost pose noticed after |",
        "|---" * (len(names) + 3) + "|",
    ]
    for system in dict.fromkeys(row["positioning"] for row in rows):
        own = [row for row in rows if row["positioning"] == system]
        flown = [row for row in own if not row["fault"]]
        cells = []
        for name in names:
            found = [row[name] for row in flown]
            cells.append(f"{statistics.median(found):.0f} ({max(found):.0f})")
        seen = [f"{row['seen']:.1f} s" for row in own if row["fault"]]
        cells += [f"{max(row['tilt'] for row in flown):.1f}°", *(seen or [""])]
        lines.append(f"| {system} | {' | '.join(cells)} |")
    return "\n".join(lines)


def reaction(row: dict[str, Any]) -> str:
    """What the supervisor did, in words."""
    states = [state for state in row["way"] if state not in ("done", "stop")]
    if not row["cause"] and states[-1:] == ["land"]:
        asked = "as asked" in row["told"][0]
        text = "lands as asked" if asked else "hold, flies on" if "hold" in states else "flies on"
    else:
        text = ", ".join(dict.fromkeys(states)) or "stop"
    stopped = f" ({row['cause'].lower().replace('_', ' ')})" if row["cause"] else ""
    return text + stopped + ("; **turns over**" if row["tilt"] > TURNED else "")
