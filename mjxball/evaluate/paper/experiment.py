"""The paper's Fig. 7: the experiment on the test stand, on both readings of the stand."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mjxball.control.followers import Follower, make_baseline
from mjxball.evaluate import svg
from mjxball.evaluate.metrics import STEADY_AFTER
from mjxball.evaluate.paper.figure import Figure, Table, called, legend_above, listed, panels, thinned
from mjxball.evaluate.paper.stand import LEVEL, STANDS, StandFlight, fly_stand, stand_config
from mjxball.policy import Policy

JOLT = 2.0  # [s] of the start, in which the vertical command may leave its panel
FOLLOWS = 0.9  # correlation of roll and CG from which on the roll is the CG's doing
SHOWS = (
    "Height of the leader (its goal dotted), roll of the assembly and the follower's vertical acceleration command, "
    "whose first 2 s may leave the panel, on a stand that is a pivot at O and on one that frees roll and height; the "
    "paper does not say which it had. CG ±0.05 m at 0.31 rad/s along the stick, leader gains of the paper's experiment "
    "on its own position, pitch locked. copy sees the leader's error, as in the paper; a policy the object's error "
    "that it was trained with. The plant is the pair of the paper's simulations laid across the stand, two drones of "
    "1 kg and an object of 0.2 kg, not two Crazyflies, whose thrust scale and attitude loops are not modelled yet; and "
    "the CG follows a sine, where the experiment's ball rolled freely."
)


def draw(policies: Sequence[Policy], physics: str) -> Figure:
    """Fly copying and the policies made for each stand, and draw."""
    flown: dict[str, dict[str, StandFlight]] = {}
    for stand in STANDS:
        config = stand_config(stand)
        mine = [policy for policy in policies if policy.card["plant"].get("stand") == stand]
        followers: list[tuple[Follower, bool]] = [(make_baseline("copy", config), True)]
        followers += [(policy, False) for policy in mine]
        flown[stand] = {f.name: fly_stand(config, f, leader_error, physics) for f, leader_error in followers}
    agrees, differs = judged(flown)
    if not policies:
        differs = (*differs, "No trained follower is in it: none of the policies was made for a stand.")
    return Figure(
        name="stand",
        title="The experiment on the test stand",
        number=7,
        drawing=_draw(flown),
        shows=SHOWS,
        table=_table(flown),
        agrees=agrees,
        differs=differs,
    )


def judged(flown: dict[str, dict[str, StandFlight]]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Whether the roll is "maintained at zero", and what is left of it and of the height."""
    agrees, differs = [], []
    for stand, flights in flown.items():
        where = {"pivot": "On the pivot", "heave": "With roll and height free"}[stand]
        start = abs(math.degrees(next(iter(flights.values())).roll[0]))
        rolls = {name: f"{called(name)} ({roll_peak(flight):.2f} deg)" for name, flight in flights.items()}
        less = [text for name, text in rolls.items() if roll_peak(flights[name]) < start]
        if less:
            agrees.append(
                f"{where} the roll of {start:.2f} deg at the start is smaller after 20 s with {listed(less)}."
            )
        more = [text for name, text in rolls.items() if not roll_peak(flights[name]) < start]
        if more:
            differs.append(f"{where} the roll of {start:.2f} deg at the start is not reduced by {listed(more)}.")
        shares = {name: correlation(flight) for name, flight in flights.items()}
        follows = [f"{called(name)} ({share:.2f})" for name, share in shares.items() if abs(share) > FOLLOWS]
        if follows:
            differs.append(
                f"{where} what is left of the roll still follows the CG, by its correlation: {listed(follows)}."
            )
        off = [
            f"{called(name)} ({_millimetres(flight)})"
            for name, flight in flights.items()
            if height_peak(flight) > 0.5 * abs(flight.height[0] - LEVEL)
        ]
        if off:
            differs.append(f"{where} the leader is still off its height after 20 s with {listed(off)}.")
    return tuple(agrees), tuple(differs)


def roll_peak(flight: StandFlight) -> float:
    """Largest roll after 20 s [deg]."""
    return float(np.degrees(np.abs(flight.roll[_steady(flight)]).max()))


def height_peak(flight: StandFlight) -> float:
    """Largest distance of the leader from its height after 20 s [m]."""
    return float(np.abs(flight.height[_steady(flight)] - LEVEL).max())


def correlation(flight: StandFlight) -> float:
    """Of roll and CG offset after 20 s; weight on the leader's side of the stick rolls it down: negative."""
    steady = _steady(flight)
    return float(np.corrcoef(flight.roll[steady], flight.cg_offset[steady])[0, 1])


def _millimetres(flight: StandFlight) -> str:
    return f"{1e3 * height_peak(flight):.1f} mm"


def _steady(flight: StandFlight) -> np.ndarray:
    return flight.time >= STEADY_AFTER


def _table(flown: dict[str, dict[str, StandFlight]]) -> Table:
    heads = ("stand, follower", "roll after 20 s", "height off after 20 s", "rms vertical command")
    rows = []
    for stand, flights in flown.items():
        for name, flight in flights.items():
            rms = float(np.sqrt(np.mean(flight.vertical[_steady(flight)] ** 2)))
            numbers = (f"{roll_peak(flight):.2f} deg", _millimetres(flight), f"{rms:.3f} m/s²")
            rows.append((f"{STANDS[stand]}, {name}", *numbers))
    return Table(heads, tuple(rows))


def _draw(flown: dict[str, dict[str, StandFlight]]) -> str:
    figure, axes = panels([1.4] * 3, len(flown))
    shade = svg.colours([name for flights in flown.values() for name in flights])
    for column, (stand, flights) in zip(axes.T, flown.items(), strict=True):
        column[0].axhline(LEVEL, color="black", linestyle=":", linewidth=1)
        column[1].axhline(0.0, color="black", linestyle=":", linewidth=1)
        for name, flight in flights.items():
            rows = thinned(len(flight.time))
            for axis, drawn in zip(column, (flight.height, np.degrees(flight.roll), flight.vertical), strict=True):
                axis.plot(flight.time[rows], drawn[rows], color=shade[name], linewidth=1.1, label=name)
        # The jolt of the start would flatten the rest.
        after = np.concatenate([flight.vertical[flight.time >= JOLT] for flight in flights.values()])
        column[2].set_ylim(*(1.15 * limit for limit in (min(after.min(), -0.01), max(after.max(), 0.01))))
        column[0].set_title(STANDS[stand])
        column[2].set_xlabel("time [s]")
    for axis, label in zip(axes[:, 0], ("leader height [m]", "roll [deg]", "follower az [m/s²]"), strict=True):
        axis.set_ylabel(label)
    legend_above(figure, axes[0])
    return svg.as_text(figure)
