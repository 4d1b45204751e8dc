"""Figures and errors of a recorded flight, or a file for other programs: `python -m mjxfly.log LOG OUT`.

LOG is a flight log (.jsonl), a bag or cfclient's folder. OUT ends in .mcap (ROS 2 messages; of .jsonl alone), .csv or
.parquet; or it is a new directory, for figures of the flight, with --simulate beside the simulation of its setpoints.
"""

from __future__ import annotations

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjxball import cli, running
from mjxball.errors import InputError
from mjxball.evaluate.metrics import measure, rotor_limits
from mjxball.evaluate.plots import PANELS, draw_flights
from mjxball.evaluate.results import Result, scenario_title
from mjxball.plotting import BROWN, INK, SIMULATED, STYLES, file_format, save, style
from mjxball.sim.scenario import Scenario
from mjxball.terminal import warn
from mjxball.view.flight import Mark
from mjxfly.log_export import WRITERS
from mjxfly.log_import import UNKNOWN
from mjxfly.recording import Recording, read_recording, simulate_setpoints, trajectory_of
from mjxfly.twin.conditions import Conditions
from mjxfly.view.marks import marks_of_log

MOMENTS = (1.0, 2.0, 5.0, 10.0)  # [s] after the motors first turned
CLOSE = 0.04  # share of a flight's length below which names of phases would overlap
FAULT = BROWN
DIVERGED = 0.25  # [m] difference from which the open-loop simulation is not plotted any more
ASSUMED = tuple((kind, index, f"assumed {text}" if kind == "cg_offset" else text) for kind, index, text in PANELS)


def main(arguments: list[str] | None = None) -> int:
    """Plot or export a log; return the exit code."""
    about, formats = (__doc__ or "").split("\n\n")
    parser = cli.make_parser("python -m mjxfly.log", about, epilog=formats)
    parser.add_argument("log", type=Path, metavar="LOG", help="flight log, bag, or folder of cfclient's logs")
    parser.add_argument("out", type=Path, metavar="OUT", help="new file, whose ending says what, or new directory")
    about = "figures of a bag: shipped plant, or file of the rig that flew"
    parser.add_argument("--plant", type=Path, metavar="NAME|FILE", help=about)
    about = "figures: also simulate the setpoints as sent, open loop, and print the differences"
    parser.add_argument("--simulate", action="store_true", help=about)
    about = "of figures: screen (default), or paper: PDF of a column's width"
    parser.add_argument("--style", choices=STYLES, default="screen", help=about)
    options = parser.parse_args(arguments)
    return running.run_command(lambda: _plot_or_export(options))


def _plot_or_export(options: argparse.Namespace) -> int:
    out, kind = options.out, options.out.suffix
    if not kind:
        return evaluate_log(options.log, out, options.style, options.plant, options.simulate)
    if kind not in WRITERS:
        endings = ", ".join(WRITERS)
        raise InputError(f"output {out} must end in {endings}, which chooses the format, or in none: a directory")
    if options.plant or options.simulate or options.style != "screen":
        raise InputError(f"--plant, --simulate and --style belong to figures, and {out} is a file")
    for remark in WRITERS[kind](cli.output_file(out, kind), options.log):
        warn(f"note: {remark}")
    print(out)  # noqa: T201
    return 0


def evaluate_log(path: Path, out: Path, look: str = "screen", plant: Path | None = None, simulate: bool = False) -> int:
    """Plot the log `path` into the new directory `out`; with `simulate` beside the simulation; return the exit code.

    `plant` is the rig that flew, for a log that does not name it. Raises InputError if the log does.
    """
    recording = read_recording(path, cli.plant_setup(plant, "flight"))
    if plant is not None and recording.policy != UNKNOWN:
        raise InputError(f"flight log {path} says which rig flew: drop --plant")
    cli.output_directory(out)
    for remark in recording.remarks:
        warn(remark)
    recorded, simulated = result_of(recording, f"{recording.policy}, flown"), None
    if simulate:
        simulated = result_of(simulate_setpoints(recording), SIMULATED)
        print(differences(recorded, simulated))  # noqa: T201
    marks = marks_of_log(path, float(recording.time[-1]))
    for mark in marks:
        if mark.kind != "phase":
            print(f"{mark.time:6.1f} s  {mark.text}")  # noqa: T201
    with style(look):
        first = next((mark.text for mark in marks if mark.kind == "fault"), "no fault")
        figure = draw(recorded, simulated, recording.guided_rows, f"{path.name}: {recording.policy}, {first}", marks)
        path = out / f"flight.{'png' if file_format() == 'svg' else file_format()}"
        out.mkdir(parents=True, exist_ok=True)
        save(figure, path)
    print(f"figure: {path}")  # noqa: T201
    return 0


def result_of(recording: Recording, name: str) -> Result:
    """A recording as a result, with the scenario that the simulation assumes."""
    config, flight = recording.config, trajectory_of(recording)
    assumed = Conditions.of(config)
    parameters = (assumed.cg_speed, assumed.cg_amplitude, assumed.object_mass)
    scenario = Scenario(*parameters, ball_start=assumed.ball, seconds=float(flight.time[-1]))
    metrics = measure(flight, config.scenario.termination_distance, rotor_limits(config.plant, [scenario])[0])
    return Result(name, scenario, metrics, flight, config.motion.kind)


def draw(recorded: Result, simulated: Result | None, guided: int, title: str, marks: Sequence[Mark]) -> Any:
    """Figure of a recorded flight with its phases and faults, and of the simulated one until it is `DIVERGED`.

    The goal is plotted for the first `guided` rows. Mass and CG of the object are assumed: the log lacks them.
    """
    flights, panels = [without_goal(recorded, guided)], [panel for panel in ASSUMED if panel[0] != "cg_offset"]
    if simulated is not None:
        flights.append(_cut(without_goal(simulated, guided), valid_rows(recorded, simulated)))
        title, panels = f"{title}\nassumed for the simulation: {scenario_title(recorded)}", list(ASSUMED)
    figure = draw_flights(flights, title, panels)
    _draw_marks(figure.axes, marks, float(recorded.flight.time[-1]))
    return figure


def _draw_marks(axes: Sequence[Any], marks: Sequence[Mark], last: float) -> None:
    """Lines where phases and faults begin, named above the first panel; names of what is close together are joined."""
    groups: list[list[Mark]] = []
    for mark in (one for one in marks if one.kind != "end"):
        close = bool(groups) and mark.time - groups[-1][0].time < CLOSE * last
        groups[-1].append(mark) if close else groups.append([mark])
    for group in groups:
        fault = any(one.kind == "fault" for one in group)
        colour, dash = (FAULT, "-") if fault else (INK, ":")
        for axis in axes:
            axis.axvline(group[0].time, color=colour, linestyle=dash, linewidth=0.8, zorder=1)
        text = ", ".join(dict.fromkeys(one.text.partition(":")[0] for one in group))
        top = axes[0].get_xaxis_transform()
        where = {"transform": top, "rotation": 35, "rotation_mode": "anchor", "va": "bottom", "ha": "left"}
        axes[0].text(group[0].time, 1.03, text, color=colour, fontsize="small", **where)


def differences(recorded: Result, simulated: Result) -> str:
    """A table of the largest differences between both flights until each of `MOMENTS`."""
    a, b = recorded.flight, simulated.flight
    moments = [moment for moment in MOMENTS if moment < a.time[-1]] + [float(a.time[-1])]
    lines = ["time s   position mm   height mm   roll deg   (largest difference until then)"]
    for moment in moments:
        rows = a.time <= moment
        apart = a.position[rows] - b.position[rows]
        roll = np.degrees(a.euler[rows, 0] - b.euler[rows, 0])
        largest = np.linalg.norm(apart, axis=1).max(), np.abs(apart[:, 2]).max(), np.abs(roll).max()
        lines.append(f"{moment:6.1f}{1e3 * largest[0]:14.1f}{1e3 * largest[1]:12.1f}{largest[2]:11.2f}")
    known = valid_rows(recorded, simulated)
    if known < len(a.time):
        lines.append(
            f"the open-loop simulation is {DIVERGED:g} m away after {a.time[known]:.1f} s and not drawn from there on"
        )
    return "\n".join(lines)


def valid_rows(recorded: Result, simulated: Result) -> int:
    """Number of rows before the simulation is `DIVERGED` or more from the recorded flight."""
    apart = np.linalg.norm(recorded.flight.position - simulated.flight.position, axis=1)
    lost = np.flatnonzero(~(apart < DIVERGED))
    return int(lost[0]) if len(lost) else len(apart)


def without_goal(result: Result, rows: int) -> Result:
    """`result` with its goal NaN after the first `rows`, where it was not tracked."""
    target = np.array(result.flight.target, float)
    target[rows:] = np.nan
    return dataclasses.replace(result, flight=result.flight._replace(target=target))


def _cut(result: Result, rows: int) -> Result:
    """`result` with its motion NaN after the first `rows`, so that it is not plotted."""
    flight, parts = result.flight, {}
    for name in ("position", "velocity", "euler", "cg_offset"):
        parts[name] = np.array(getattr(flight, name), float)
        parts[name][rows:] = np.nan
    return dataclasses.replace(result, flight=flight._replace(**parts))


if __name__ == "__main__":
    running.quit_on_interrupt()
    sys.exit(main())
