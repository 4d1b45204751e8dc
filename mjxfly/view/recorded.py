"""Conversion of a flight log to a `Flight` of the viewer."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from mjxball.errors import InputError
from mjxball.terminal import warn
from mjxball.view.flight import Flight, check_flight, flight_of
from mjxfly.log_bags import is_bag
from mjxfly.log_import import UNKNOWN
from mjxfly.recording import read_recording, trajectory_of
from mjxfly.view.marks import marks_of_log


def read_log(path: Path) -> Flight:
    """Return the flight in a log of `mjxfly`, from the start of its motors. Raises InputError for no flight log.

    A log does not contain CG, object mass and contact forces; they are set to 0, the plant's mass and 0, and not shown.
    """
    if path.suffix != ".jsonl" and not is_bag(path):
        raise InputError(
            f"{path} is no flight (.npz), flight log (.jsonl) or bag (.mcap), policy (.npz) or run directory"
        )
    recording = read_recording(path)
    if recording.policy == UNKNOWN:
        raise InputError(f"{path} says no goal that could be shown; mjxfly.log draws it")
    for remark in recording.remarks:
        warn(remark)
    known = trajectory_of(recording)._replace(
        leader_command=np.nan_to_num(recording.leader),
        follower_command=np.nan_to_num(recording.follower),
        cg_offset=np.zeros(rows := len(recording.time)),
        object_mass=np.full(rows, recording.config.plant.object_mass),
        contact_force=np.zeros((rows, 2, 3)),
    )
    hidden = np.nan_to_num(recording.hidden) if recording.hidden.shape[1] else None
    title = f"{recording.policy}, flown (ball and contact forces were not measured)"
    marks = marks_of_log(path, float(recording.time[-1]))
    flight = flight_of(known, recording.config.plant, title, hidden)
    return check_flight(dataclasses.replace(flight, marks=marks), str(path))
