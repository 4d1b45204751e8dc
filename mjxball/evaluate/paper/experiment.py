"""The paper's Fig. 7: the experiment on the test stand, with the paper's gains and with better ones."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from mjxball.config import ball_reach
from mjxball.control.followers import Follower, make_baseline
from mjxball.evaluate import svg
from mjxball.evaluate.metrics import STEADY_AFTER
from mjxball.evaluate.paper.figure import Figure, Table, called, legend_above, listed, panels, thinned
from mjxball.evaluate.paper.stand import LEVEL, SCENARIO, SETTINGS, StandFlight, fly_stand, stand_config
from mjxball.policy import Policy

BASELINES = ("copy", "adaptive", "lqg")
JOLT = 2.0  # [s] of the start, in which the vertical command may leave its panel
HELD = 5e-3  # height that the leader may be off after 20 s [m]
AT_STOP = 1e-3  # [m]
SHOWS = (
    "Height of the leader (its goal dotted), roll of the assembly, the follower's vertical acceleration command, whose "
    "first 2 s may leave the panel, and the ball (end stops dotted). Two Crazyflies with their firmware's cascade on a "
    "stand that frees roll and height, a ball that rolls freely and that nobody measures. Left the leader as in the "
    "paper: its gains, on its own position, thrust = 46000 + 1000 az. Right a stiffer height loop (kp 4, kd 3.5, "
    "ki 0.5) and thrust by the motors' curve. copy sees the leader's error, as in the paper, the others the object's; "
    "policies were trained with the paper's settings."
)


def draw(policies: Sequence[Policy], physics: str) -> Figure:
    """Fly the classical followers and the policies made for the stand with both settings, and draw."""
    flown: dict[str, dict[str, StandFlight]] = {}
    for settings in SETTINGS:
        config = stand_config(settings)
        followers: list[Follower] = [*(make_baseline(name, config) for name in BASELINES), *policies]
        flown[settings] = {f.name: fly_stand(config, f, f.name == "copy", physics, SCENARIO) for f in followers}
    agrees, differs = judged(flown, ball_reach(stand_config().plant))
    if not policies:
        differs = (*differs, "No trained follower is in it: none of the policies was made for the stand.")
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


def judged(flown: dict[str, dict[str, StandFlight]], reach: float) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Whether the roll is "maintained at zero", where the ball lies and the leader hangs; `reach` of the ball [m]."""
    agrees, differs = [], []
    for settings, flights in flown.items():
        where = f"With {SETTINGS[settings]}"
        start = abs(math.degrees(next(iter(flights.values())).roll[0]))
        rolls = {name: f"{called(name)} ({roll_rms(flight):.2f} deg rms)" for name, flight in flights.items()}
        less = [text for name, text in rolls.items() if roll_rms(flights[name]) < start]
        if less:
            agrees.append(
                f"{where} the roll of {start:.2f} deg at the start is smaller after 20 s with {listed(less)}."
            )
        more = [text for name, text in rolls.items() if not roll_rms(flights[name]) < start]
        if more:
            differs.append(f"{where} the roll of {start:.2f} deg at the start is not reduced by {listed(more)}.")
        stopped = [called(name) for name, flight in flights.items() if np.abs(flight.ball).max() > reach - AT_STOP]
        if stopped:
            differs.append(f"{where} the ball runs into a stop with {listed(stopped)}.")
        off = [
            f"{called(name)} ({_millimetres(height_peak(flight))})"
            for name, flight in flights.items()
            if height_peak(flight) > HELD
        ]
        if off:
            differs.append(f"{where} the leader is still off its height after 20 s with {listed(off)}.")
    return tuple(agrees), tuple(differs)


def roll_rms(flight: StandFlight) -> float:
    """Root mean square of the roll after 20 s [deg]."""
    return float(np.degrees(np.sqrt(np.mean(flight.roll[_steady(flight)] ** 2))))


def ball_range(flight: StandFlight) -> float:
    """Way between the ball's outermost places after 20 s [m]."""
    return float(np.ptp(flight.ball[_steady(flight)]))


def height_peak(flight: StandFlight) -> float:
    """Largest distance of the leader from its height after 20 s [m]."""
    return float(np.abs(flight.height[_steady(flight)] - LEVEL).max())


def _millimetres(metres: float) -> str:
    return f"{1e3 * metres:.1f} mm"


def _steady(flight: StandFlight) -> np.ndarray:
    return flight.time >= STEADY_AFTER


def _table(flown: dict[str, dict[str, StandFlight]]) -> Table:
    heads = ("settings, follower", "roll rms", "ball range", "ball farthest off", "height off", "rms vertical command")
    rows = []
    for settings, flights in flown.items():
        for name, flight in flights.items():
            rms = float(np.sqrt(np.mean(flight.vertical[_steady(flight)] ** 2)))
            farthest = float(np.abs(flight.ball[_steady(flight)]).max())
            places = map(_millimetres, (ball_range(flight), farthest, height_peak(flight)))
            rows.append((f"{SETTINGS[settings]}, {name}", f"{roll_rms(flight):.2f} deg", *places, f"{rms:.3f} m/s²"))
    return Table(heads, tuple(rows))


def _draw(flown: dict[str, dict[str, StandFlight]]) -> str:
    figure, axes = panels([1.4] * 4, len(flown))
    shade = svg.colours([name for flights in flown.values() for name in flights])
    reach = ball_reach(stand_config().plant)
    for column, (settings, flights) in zip(axes.T, flown.items(), strict=True):
        for axis, places in zip(column, ((LEVEL,), (0.0,), (), (-reach, reach)), strict=True):
            for place in places:
                axis.axhline(place, color="black", linestyle=":", linewidth=1)
        for name, flight in flights.items():
            rows = thinned(len(flight.time))
            drawn = flight.height, np.degrees(flight.roll), flight.vertical, flight.ball
            for axis, one in zip(column, drawn, strict=True):
                axis.plot(flight.time[rows], one[rows], color=shade[name], linewidth=1.1, label=name)
        # The jolt of the start would flatten the rest.
        after = np.concatenate([flight.vertical[flight.time >= JOLT] for flight in flights.values()])
        column[2].set_ylim(*(1.15 * limit for limit in (min(after.min(), -0.01), max(after.max(), 0.01))))
        column[0].set_title(SETTINGS[settings])
        column[-1].set_xlabel("time [s]")
    labels = ("leader height [m]", "roll [deg]", "follower az [m/s²]", "ball [m]")
    for axis, label in zip(axes[:, 0], labels, strict=True):
        axis.set_ylabel(label)
    legend_above(figure, axes[0])
    return svg.as_text(figure)
