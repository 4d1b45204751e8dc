"""The schema of the flight log: every kind of record, its fields, their types and units.

A new kind or field is one line of `KINDS`. Readers skip unknown kinds and pass on unknown fields as plain JSON.
`SCHEMA` is raised when an older reader would misread a record, not when kinds or optional fields are added.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from mjxball import config as configs
from mjxball.control.crazyflie import read_pair_gains
from mjxfly import packets
from mjxfly.limits import NAMES

SCHEMA = 2
_STATE_HEADER = 4  # bytes before the variables of a log packet: the block's number, then the time stamp's 24 bits

Record = dict[str, Any]  # "t" [s], "kind", and the kind's fields, decoded


class Type(NamedTuple):
    """JSON type of a field, and its decoder."""

    name: str
    decode: Callable[[Any], Any]  # from the JSON value; raises ValueError or TypeError


class Field(NamedTuple):
    """One field of a kind of record."""

    type: Type
    text: str = ""  # description and unit
    required: bool = True


class Kind(NamedTuple):
    """One kind of record."""

    text: str  # when it is written
    fields: Mapping[str, Field]


class StatePacket(NamedTuple):
    """A drone's state as received."""

    stamp: int  # [ms] of the drone's clock, 24 bits
    state: packets.DroneState


def _number(value: Any, finite: bool = False) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise TypeError
    if finite and not math.isfinite(value):
        raise ValueError
    return float(value)


def _exactly(kind: type, value: Any) -> Any:
    if type(value) is not kind:
        raise TypeError
    return value


def _state(value: Any) -> StatePacket:
    data = bytes.fromhex(value)
    state = packets.unpack_state(data[_STATE_HEADER:])
    return StatePacket(int.from_bytes(data[1:_STATE_HEADER], "little"), state)


def array(*shape: int | None, finite: bool = True) -> Type:
    """Type of an array of `shape`, with None for any length; `finite` rejects inf and NaN."""

    def decode(value: Any) -> np.ndarray:
        found = np.array(value)
        if found.dtype.kind not in "if" or len(found.shape) != len(shape):
            raise TypeError
        fits = all(wanted in (None, length) for wanted, length in zip(shape, found.shape, strict=True))
        if not fits or (finite and not np.isfinite(found).all()):
            raise ValueError
        return found.astype(float)

    return Type("×".join("n" if length is None else str(length) for length in shape) + " numbers", decode)


NUMBER = Type("number", lambda value: _number(value, finite=True))
ANY_NUMBER = Type("number or NaN", _number)
COUNT = Type("integer", functools.partial(_exactly, int))
TEXT = Type("text", functools.partial(_exactly, str))
FLAG = Type("true or false", functools.partial(_exactly, bool))
TEXTS = Type("texts", lambda value: tuple(_exactly(str, text) for text in _exactly(list, value)))
DRONE = Type("leader or follower", lambda value: NAMES[NAMES.index(value)])
STATE = Type("30 bytes as hex", _state)
CONFIG = Type("settings by name", lambda value: configs.validate(configs.from_record(value)))
GAINS = Type("parameters of both drones", read_pair_gains)
JSON = Type("any JSON", lambda value: value)


def record(text: str, /, **fields: Field) -> Kind:
    """A kind of record by its `fields`."""
    return Kind(text, fields)


need, may = Field, functools.partial(Field, required=False)
SETPOINTS = "leader's and follower's roll, pitch [deg], yaw rate [deg/s] and thrust [units] with the wire's signs"
COMMAND = "roll, pitch [rad], vertical acceleration [m/s²] of its controller, while it is in command"
KINDS: dict[str, Kind] = {
    "header": record(
        "first, once",
        schema=need(COUNT, "version of this table"),
        policy=need(TEXT, "its name"),
        config=need(CONFIG, "the policy's configuration"),
        gains=need(GAINS, "that are uploaded"),
        mocap=may(TEXT, "motion capture: system, host, bodies"),
        curve=may(TEXT, "force curve that the firmware is taken to have: `linear` or `older`"),
        wall=may(NUMBER, "seconds since 1970 at `t`"),
        pid=may(COUNT, "of the runner"),
        version=may(TEXT, "of mjxball"),
        command=may(TEXTS, "the command line"),
        uris=may(TEXTS, "of leader and follower"),
        settings=may(JSON, "time, goal and bounds of the flight, and `dry_run`"),
        config_hash=may(TEXT, "of the policy's configuration"),
    ),
    "priority": record("real-time priority was asked for", granted=need(TEXT, "what was granted")),
    "connected": record(
        "a drone's tables are read",
        drone=need(DRONE),
        uri=need(TEXT),
        seconds=need(NUMBER, "it took"),
        latency_ms=may(JSON, "round trip [ms]"),
        protocol=may(COUNT, "CRTP version"),
        version=may(TEXT, "of the firmware"),
        device=may(TEXT, "kind of drone"),
        revision=may(TEXT, "of the firmware's source"),
    ),
    "parameter": record(
        "a parameter is written and confirmed", drone=need(DRONE), name=need(TEXT), value=need(NUMBER)
    ),
    "check": record(
        "a check before flight", name=need(TEXT), passed=need(FLAG), found=need(TEXT, "what was found")
    ),
    "refused": record("the flight does not begin", text=need(TEXT, "why")),
    "console": record("a drone prints", drone=need(DRONE), text=need(TEXT)),
    "state": record(
        "a state arrives",
        drone=need(DRONE),
        raw=need(STATE, "the log packet: block (1 byte), stamp (3) [ms], `packets.STATE_VARIABLES` (26)"),
    ),
    "health": record(
        "20 times a second",
        drone=need(DRONE),
        variance=need(array(3), "of the estimated position [m²]"),
        motors=need(array(4), "PWM 0 .. 65535"),
        thrust=need(ANY_NUMBER, "of the setpoint in force [units]; NaN if the firmware does not say"),
    ),
    "thrust": record(
        "a firmware's force curve is known",
        drone=need(DRONE),
        curve=need(TEXT, "`linear` or `older`"),
        recognised=need(FLAG, "by its motors; else it is the one that was assumed"),
        changed=need(FLAG, "gains for this curve are written"),
    ),
    "tick": record(
        "every period of the loop",
        state=need(TEXT, "of the supervisor"),
        goal=need(array(3), "of O [m]"),
        sent=need(array(2, 4), f"{SETPOINTS}; a dry run sends zeros instead"),
        ages=may(array(2, finite=False), "of both drones' states [s]"),
        late=may(NUMBER, "the tick against its deadline [s]"),
        leader=may(array(3), COMMAND),
        follower=may(array(3), COMMAND),
        observation=may(array(None), "of the policy"),
        hidden=may(array(None), "state of the policy's GRU after it"),
    ),
    "transition": record(
        "the supervisor changes its state", before=need(TEXT), after=need(TEXT), events=need(TEXTS, "of that tick")
    ),
    "pose": record(
        "a measured pose is forwarded, at most 50 times a second",
        drone=need(DRONE),
        age=need(NUMBER, "[s]"),
        position=need(array(3), "[m]"),
        quaternion=need(array(4), "body to world (w, x, y, z)"),
    ),
    "gap": record(
        "no good pose for a while",
        drone=need(DRONE),
        begins=need(FLAG, "else it ends"),
        age=need(ANY_NUMBER, "of the last good pose [s]"),
        text=may(TEXT, "why"),
    ),
    "app": record(
        "an app on board is in another phase, or refuses",
        drone=need(DRONE),
        phase=need(TEXT, "idle, spin, ramp, fly, land, descend or stop"),
        cause=need(TEXT, "of the phase"),
        refusal=need(TEXT, "why it does not start, or good"),
        copying=may(FLAG, "the copying controller flies in the network's place"),
    ),
    "link": record("a link ends", drone=need(DRONE), text=need(TEXT, "why")),
    "warning": record("something else that does not end a flight", text=need(TEXT)),
    "error": record("the runner itself fails", text=need(TEXT)),
    "end": record(
        "last",
        code=need(COUNT, "exit code"),
        cause=may(TEXT, "what ended the flight, if not its plan"),
        told=may(TEXTS, "why it ended and how the pair came down, a sentence each"),
        timing=may(JSON, "the loop's: ticks, missed deadlines, lateness (median, p99, largest) [s]"),
        flown=may(JSON, "figures of the flight under both controllers, see `mjxfly.figures`"),
        overwritten=may(array(None), "setpoints of each link that a newer one replaced"),
    ),
}  # fmt: skip


def decode(raw: Mapping[str, Any]) -> Record | None:
    """The record of one JSON object with "t" and "kind"; None if its kind is not in the table.

    Raises ValueError with a phrase that names the field which is missing or has the wrong type.
    """
    kind = KINDS.get(raw["kind"]) if isinstance(raw["kind"], str) else None
    if kind is None:
        return None
    found = {**raw, "t": _field(raw, "t", need(NUMBER))}
    for name, field in kind.fields.items():
        if name in raw or field.required:
            found[name] = _field(raw, name, field)
    return found


def _field(raw: Mapping[str, Any], name: str, field: Field) -> Any:
    if name not in raw:
        raise ValueError(f"its {raw['kind']} has no {name}")
    try:
        return field.type.decode(raw[name])
    except (ValueError, TypeError, AttributeError, KeyError, IndexError, OverflowError, RecursionError) as error:
        why = f": {error}" if field.type is CONFIG and str(error) else ""
        raise ValueError(f"the {name} of its {raw['kind']} is not {field.type.name}{why}") from None
