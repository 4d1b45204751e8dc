"""The process of a follower in the benchmark: `python -m mjxball.bench.child IN OUT FOLLOWER`, pipes by number.

It receives the nominal plant's configuration, believed masses and observations, and nothing else.
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from typing import Any, BinaryIO

import numpy as np

from mjxball.bench import frames
from mjxball.bench.followers import entrant
from mjxball.config import from_record
from mjxball.control.followers import Baseline, PrivilegedInfo
from mjxball.errors import FOREIGN, InputError, said
from mjxball.evaluate.followers import answered
from mjxball.reading import parse_json


@dataclass
class Made:
    """A follower made for one plant, and what its drones believe the object's mass to be in each flight."""

    follower: Any
    believed: np.ndarray  # (n,) [kg]


class Host:
    """Answers frames for the follower that `text` names."""

    def __init__(self, text: str):
        self._name, self._make = entrant(text)
        self._made: list[Made] = []

    def answer(self, kind: bytes, content: bytes) -> bytes:
        """The frame that answers one of `kind`. Raises InputError if the follower does not do its part."""
        if kind == frames.LOAD:
            made = self._make(from_record(parse_json(content.decode())))
            refuse_privileged(made)
            self._made.append(Made(made, np.zeros(0)))
            return frames.frame(frames.READY)
        (number,) = frames.NUMBER.unpack_from(content)
        own, values = self._made[number], frames.unpacked(content[frames.NUMBER.size :])
        if kind == frames.RESET:
            own.believed = values
            own.follower.reset()
            return frames.frame(frames.READY)
        if isinstance(own.follower, Baseline):
            several = values.ndim - 1 - own.believed.ndim
            believed = np.reshape(own.believed, own.believed.shape + (1,) * several)
            own.follower.privileged = PrivilegedInfo.of_believed(np.broadcast_to(believed, values.shape[:-1]).copy())
        command = answered(self._name, own.follower(values), values)
        return frames.frame(frames.COMMAND, frames.packed(command))


def refuse_privileged(follower: Any) -> None:
    """Raise InputError for a follower that needs what no observation contains."""
    if getattr(getattr(follower, "controller", None), "needs_privileged", False):
        raise InputError(f"{follower.name} is not ranked: it needs privileged information, which no follower can have")


def serve(receive: BinaryIO, send: BinaryIO, text: str) -> None:
    """Answer frames until the pipe is closed."""
    host: Host | None = None
    while len(head := receive.read(frames.HEAD.size)) == frames.HEAD.size:
        kind, length = frames.HEAD.unpack(head)
        content = receive.read(length)
        try:
            host = host or Host(text)
            found = host.answer(kind, content)
        except FOREIGN as error:  # whatever the follower's code raises
            why = str(error) if isinstance(error, InputError) else f"follower {text} raised {said(error)}"
            found = frames.frame(frames.ERROR, why.encode()[: frames.MAX_TEXT])
        send.write(found)
        send.flush()


def main() -> None:
    """Serve the pipes that the command line names."""
    pipes = [int(number) for number in sys.argv[1:3]]
    for number in pipes:
        os.set_inheritable(number, False)
    with os.fdopen(pipes[0], "rb") as receive, os.fdopen(pipes[1], "wb") as send:
        serve(receive, send, sys.argv[3])


if __name__ == "__main__":
    main()
