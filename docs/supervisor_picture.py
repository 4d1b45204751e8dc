"""The flight supervisor as a state chart in SVG, for docs/flying.md. `python docs/pictures.py supervisor` writes it.

States, arrows and the events beside them come from `mjxfly.supervisor.TRANSITIONS`; only the layout is written here.
An arrow from a frame stands for one arrow from each state in it. The kill key, which works in every state, has one
arrow. A transition that no arrow shows is an error.
"""

from __future__ import annotations

import html
import textwrap
from collections.abc import Iterator
from typing import NamedTuple

from mjxball.pictures import COLOURS
from mjxfly.supervisor import AIRBORNE, ENDED, FAULTS, ON_GROUND, PLANNED, TRANSITIONS, Event, FlightState

S = FlightState
WIDTH, HEIGHT = 500, 630
SOLID, DASHED = COLOURS[:2]
LINE = 14  # [px] height of a line of text
TALL = 34  # [px] height of a state
NO_BREAK = "\u00a0"  # space at which a label is not broken
MOST = 4  # names of events beside an arrow; more faults are counted


class Box(NamedTuple):
    """A state, or a frame of states: centre and size [px]."""

    x: float
    y: float
    width: float = 86
    height: float = TALL


class Arrow(NamedTuple):
    """An arrow along `path`, with a label whose first line is at `place`. Several `sources` share a frame."""

    sources: tuple[FlightState, ...]
    target: FlightState
    path: str  # of SVG
    place: tuple[float, float]
    wide: int = 12  # characters in a line of the label
    most: int = MOST
    anchor: str = "start"


BOXES = {
    S.CHECK: Box(232, 52),
    S.ARM: Box(232, 108),
    S.SPIN: Box(232, 164),
    S.RAMP: Box(232, 270),
    S.FLY: Box(232, 336),
    S.LAND: Box(232, 430),
    S.DESCEND: Box(418, 430),
    S.HOLD: Box(56, 336, 80),
    S.STOP: Box(243, 542, 470),
    S.DONE: Box(56, 606, 80),
    S.KILL: Box(300, 606),
}
RAISED = (S.RAMP, S.FLY, S.LAND)
DRIVEN = (*RAISED, S.DESCEND)
FRAMES = (
    ("on the ground", Box(232, 102, 142, 186)),
    ("in the air", Box(243, 341, 470, 248)),
    ("", Box(315, 347, 314, 226)),
    ("", Box(239, 347, 146, 212)),
)
ARROWS = (
    Arrow((S.CHECK,), S.ARM, "M232 69V91", (239, 85)),
    Arrow((S.ARM,), S.SPIN, "M232 125V147", (239, 141)),
    Arrow((S.SPIN,), S.RAMP, "M232 181V253", (239, 212)),
    Arrow((S.RAMP,), S.FLY, "M232 287V319", (239, 308)),
    Arrow((S.FLY,), S.LAND, "M232 353V413", (239, 366), 10, 3),
    Arrow(ON_GROUND, S.STOP, "M303 108H489V542H478", (310, 86), 26),
    Arrow(AIRBORNE, S.STOP, "M128 465V525", (134, 484), 11),
    Arrow(DRIVEN, S.HOLD, "M158 346H96", (100, 362), 10),
    Arrow(RAISED, S.DESCEND, "M312 376H400V413", (320, 370)),
    Arrow((S.RAMP,), S.DESCEND, "M275 270H436V413", (320, 287), 17),
    Arrow((S.LAND,), S.DESCEND, "M275 430H375", (320, 424)),
    Arrow((S.HOLD,), S.FLY, "M96 328H189", (98, 322)),
    Arrow((S.HOLD,), S.STOP, "M50 353V525", (56, 484), 9),
    Arrow((S.LAND,), S.STOP, "M232 447V525", (238, 484), 13),
    Arrow((S.DESCEND,), S.STOP, "M448 447V525", (442, 484), 13, anchor="end"),
    Arrow((S.STOP,), S.DONE, "M56 559V589", (62, 577), 20),
    Arrow((S.KILL,), S.DONE, "M257 606H96", (140, 600)),
)
KILL = "M470 606H343"


def events(arrow: Arrow) -> list[Event]:
    """The events that take each source of `arrow` to its target; for one source, those that no frame's arrow shows."""
    shared = [other for other in ARROWS if other.target is arrow.target and len(other.sources) > len(arrow.sources)]
    hidden = {event for other in shared if set(arrow.sources) <= set(other.sources) for event in events(other)}
    return [
        event
        for event in Event
        if all(TRANSITIONS.get((source, event)) is arrow.target for source in arrow.sources) and event not in hidden
    ]


def words(arrow: Arrow) -> list[str]:
    """The lines of an arrow's label: names of its events, faults last, and their number if they are many."""
    found = {event: event.name.lower().replace("_", NO_BREAK) for event in events(arrow)}
    names = [name for event, name in found.items() if event not in FAULTS]
    faults = [name for event, name in found.items() if event in FAULTS]
    counted = faults if len(faults) <= arrow.most else [f"{len(faults)}{NO_BREAK}faults"]
    return textwrap.wrap(", ".join([*names, *counted]), arrow.wide)


def check() -> None:
    """Raise ValueError if the picture does not show exactly the transitions of the code."""
    shown = {(source, event): arrow.target for arrow in ARROWS for event in events(arrow) for source in arrow.sources}
    killed = {(state, Event.KEY_KILL): S.KILL for state in S if state not in (S.KILL, S.DONE)}
    if wrong := set((shown | killed).items()) ^ set(TRANSITIONS.items()):
        raise ValueError(f"docs/supervisor_picture.py draws other transitions than mjxfly.supervisor has: {wrong}")


def state_chart() -> str:
    """The picture as SVG with a white background, readable at a width of 368 px. Raises ValueError, see `check`."""
    check()
    title = "The flight supervisor: states, and the events that lead from one to another"
    style = (
        "text{font:12.5px system-ui,'Segoe UI',Helvetica,Arial,sans-serif;fill:#222}"
        ".state{font-weight:600;font-size:15px;text-anchor:middle}"
        f"path{{fill:none;stroke-width:1.6}}.solid{{stroke:{SOLID}}}.dashed{{stroke:{DASHED};stroke-dasharray:5 3}}"
    )
    heads = "".join(
        f'<marker id="{name}" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="8" markerHeight="8" '
        f'markerUnits="userSpaceOnUse" orient="auto"><path d="M0 0L8 4L0 8z" style="fill:{colour};stroke:none"/>'
        "</marker>"
        for name, colour in (("solid", SOLID), ("dashed", DASHED))
    )
    parts = [*_frames(), *_arrows(), *_states(), *_legend()]
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{HEIGHT}" viewBox="0 0 {WIDTH} {HEIGHT}" '
        f'role="img"><title>{html.escape(title)}</title><style>{style}</style><defs>{heads}</defs>\n'
        f'<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>\n' + "\n".join(parts) + "\n</svg>\n"
    )


def _rectangle(box: Box, look: str) -> str:
    x, y = box.x - box.width / 2, box.y - box.height / 2
    return f'<rect x="{x:g}" y="{y:g}" width="{box.width:g}" height="{box.height:g}" rx="7" {look}/>'


def _text(x: float, y: float, lines: list[str], anchor: str = "start") -> Iterator[str]:
    for number, line in enumerate(lines):
        yield f'<text x="{x:g}" y="{y + LINE * number:g}" text-anchor="{anchor}">{html.escape(line)}</text>'


def _line(path: str, name: str) -> str:
    return f'<path d="{path}" class="{name}" marker-end="url(#{name})"/>'


def _frames() -> Iterator[str]:
    for name, box in FRAMES:
        yield _rectangle(box, 'fill="#00305a" fill-opacity=".05" stroke="#8a97a3"')
        yield from _text(box.x - box.width / 2 + 8, box.y - box.height / 2 + 16, [name] if name else [])


def _arrows() -> Iterator[str]:
    for arrow in ARROWS:
        planned = PLANNED & set(events(arrow))
        yield _line(arrow.path, "solid" if planned else "dashed")
        yield from _text(*arrow.place, words(arrow), arrow.anchor)
    yield _line(KILL, "dashed")
    yield from _text(466, 600, ["key kill"], "end")
    yield from _text(466, 621, ["in every state"], "end")


def _states() -> Iterator[str]:
    for state, box in BOXES.items():
        look = 'fill="#fdeccb" stroke="#b98320"' if state in ENDED else 'fill="#d7e8f7" stroke="#3f7cac"'
        yield _rectangle(box, look)
        yield f'<text class="state" x="{box.x:g}" y="{box.y + 5:g}">{state.value}</text>'


def _legend() -> Iterator[str]:
    yield from (_line(f"M10 {y}H50", name) for y, name in ((22, "solid"), (42, "dashed")))
    yield from _text(56, 26, ["normal flight"])
    yield from _text(56, 46, ["request, fault,", "time limit"])
    yield from _text(10, 92, ["An arrow from a", "frame holds for", "each state in it."])
