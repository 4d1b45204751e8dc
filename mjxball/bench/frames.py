"""What the benchmark and a follower's process send each other: frames of a kind, a length and bytes.

Arrays travel as their shape and float64 values, so that nothing which a follower sends is ever executed.
"""

from __future__ import annotations

import math
import struct

import numpy as np

from mjxball.errors import InputError

HEAD = struct.Struct(">cI")  # kind, bytes that follow
# To the follower: make it for a configuration; then, behind the number of that one, reset it with believed masses, an
# observation.
LOAD, RESET, OBSERVATION = b"L", b"R", b"O"
# From it: it is ready, a command, why there is none.
READY, COMMAND, ERROR = b"K", b"C", b"E"
NUMBER = struct.Struct(">H")  # of the follower, in the order in which they were made
MAX_BYTES = 2**26  # of a frame
MAX_TEXT = 400  # bytes of an error
MAX_DIMENSIONS = 4


def frame(kind: bytes, content: bytes = b"") -> bytes:
    """A frame as it travels."""
    return HEAD.pack(kind, len(content)) + content


def packed(array: np.ndarray) -> bytes:
    """`array` as bytes: the number of its axes, their lengths, values."""
    return struct.pack(f">B{array.ndim}I", array.ndim, *array.shape) + np.asarray(array, "<f8").tobytes()


def unpacked(content: bytes) -> np.ndarray:
    """The array in `content`. Raises InputError if it holds none."""
    axes = content[0] if content else MAX_DIMENSIONS + 1
    head = 1 + 4 * axes
    if axes > MAX_DIMENSIONS or len(content) < head:
        raise InputError("no array was sent")
    shape = struct.unpack(f">{axes}I", content[1:head])
    if len(content) != head + 8 * math.prod(shape):
        raise InputError(f"an array of shape {shape} was announced, and {len(content) - head} bytes came")
    return np.frombuffer(content, "<f8", offset=head).reshape(shape).astype(np.float64)
