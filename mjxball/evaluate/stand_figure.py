"""The paper's experiment on the test stand (Fig. 7) in simulation, and the same with better settings of the leader."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mjxball import config as configs
from mjxball.baselines import make_baseline
from mjxball.config import Config, ball_limit
from mjxball.control import rotations
from mjxball.control.followers import Follower
from mjxball.evaluate.plots import Figure, panels, thinned
from mjxball.evaluate.running_metrics import STEADY_AFTER
from mjxball.plotting import INK, follower_styles, legend_above, line, logarithmic, rendered
from mjxball.policy import Policy
from mjxball.sim.rollout import check_rate, simulate_batch
from mjxball.sim.scenario import Scenario
from mjxball.sim.trajectory import Trajectory

SETTINGS = {"paper": "the paper's gains", "better": "better settings"}
# The leader's gains of free flight with a quarter of the height integral, and thrust by the motors' curve.
BETTER = {
    "leader.kp": (1.0, 1.0, 4.0),
    "leader.kd": (2.0, 2.0, 3.5),
    "leader.ki": (0.2, 0.1, 0.5),
    "autopilot.thrust_law": "calibrated",
}
LEVEL = 0.08  # height of the leader on the level stand, its goal p_l^d (paper) [m]
# Small initial errors (ours): 3 degrees of roll, 3 cm too low, the ball at rest 3 cm from the middle.
STAND_START = Scenario(
    amplitude=0.0,
    mass=configs.preset("stand").plant.object_mass,
    goal=(0.0, 0.0, 0.0),
    start_position=(0.0, 0.0, -0.03),
    start_tilt=(0.0524, 0.0),
    ball_start=0.03,
    seconds=60.0,
)


@dataclass(frozen=True)
class StandFlight:
    """A flight on the stand, one row per control step."""

    time: np.ndarray  # (T,) [s]
    height: np.ndarray  # (T,) of the leader; `LEVEL` if the stick is level and O at its goal [m]
    roll: np.ndarray  # (T,) of the assembly [rad]
    vertical: np.ndarray  # (T,) follower's vertical acceleration command [m/s2]
    ball: np.ndarray  # (T,) from O along the stick, towards the leader [m]

    @property
    def steady(self) -> np.ndarray:
        """(T,) true from 20 s on."""
        return self.time >= STEADY_AFTER

    @property
    def roll_rms(self) -> float:
        """Root mean square of the roll from 20 s on [deg]."""
        return float(np.degrees(np.sqrt(np.mean(self.roll[self.steady] ** 2))))

    @property
    def ball_range(self) -> float:
        """Range of the ball's position from 20 s on [m]."""
        return float(np.ptp(self.ball[self.steady]))

    @property
    def height_peak(self) -> float:
        """Largest height error of the leader from 20 s on [m]."""
        return float(np.abs(self.height[self.steady] - LEVEL).max())


def stand_config(settings: str = "paper") -> Config:
    """The preset `stand` with the `paper` settings of the leader or the `better` ones."""
    config = configs.preset("stand")
    for name, value in BETTER.items() if settings == "better" else ():
        config = configs.replace(config, name, value)
    return configs.validate(config)


def fly_stand(
    config: Config, followers: Sequence[Follower], leader_error: bool, physics: str, scenario: Scenario
) -> list[StandFlight]:
    """Fly `followers` on the stand; they observe the error of O, or the leader's with `leader_error` (paper).

    The leader's controller is eq. 5 on e_l = p_l^d - p_l; p_l^d is its position with the stick level and O at its goal.
    """
    config = configs.replace(config, "follower.error", "leader" if leader_error else "object")
    for follower in followers:
        check_rate(config, follower)
    flown = simulate_batch(config, [(follower, [scenario]) for follower in followers], physics)
    return [_stand_flight(config, flown.world(number)) for number in range(len(followers))]


def _stand_flight(config: Config, flown: Trajectory) -> StandFlight:
    mount = config.plant.drones[config.plant.leader].mount
    lever = rotations.rotate(rotations.matrix_from_quaternion(flown.quaternion), np.array(mount))
    rise = flown.position[:, 2] - flown.target[:, 2] + lever[:, 2] - mount[2]
    ball = flown.cg_offset / config.plant.moving_fraction
    return StandFlight(flown.time, LEVEL + rise, flown.euler[:, 0], flown.follower_command[:, 2], ball)


def plot_stand(policies: Sequence[Policy], physics: str) -> Figure:
    """Classical followers and the policies for the stand, with both settings of the leader."""
    flown: dict[str, dict[str, StandFlight]] = {}
    for settings in SETTINGS:
        config = stand_config(settings)
        copy = make_baseline("copy", config)
        others: list[Follower] = [*(make_baseline(name, config) for name in ("adaptive", "lqg")), *policies]
        flights = fly_stand(config, [copy], True, physics, STAND_START)
        flights += fly_stand(config, others, False, physics, STAND_START)
        names = [copy.name, *(follower.name for follower in others)]
        flown[settings] = dict(zip(names, flights, strict=True))
    rows = [
        (
            f"{SETTINGS[settings]}, {name}",
            f"{flight.roll_rms:.2f} deg",
            *(f"{1e3 * value:.1f} mm" for value in (flight.ball_range, flight.height_peak)),
        )
        for settings, flights in flown.items()
        for name, flight in flights.items()
    ]
    caption = (
        "Height of the leader (goal dotted), roll, the follower's vertical command (linear within 0.1 m/s²) "
        "and the ball (end stops dotted): two Crazyflies on a stand that frees roll and height, a ball that rolls "
        "freely and is not measured. Left: the leader's gains and thrust law of the paper. Right: a stiffer height "
        "loop and thrust by the motors' curve. copy sees the leader's error, as in the paper, the others the object's."
    )
    heads = ("settings, follower", "roll rms", "ball range", "height off")
    return Figure("stand", "The experiment on the test stand", 7, _picture(flown), caption, heads, rows)


def _picture(flown: dict[str, dict[str, StandFlight]]) -> bytes:
    figure, axes = panels([1.4] * 4, len(flown))
    looks = follower_styles(name for flights in flown.values() for name in flights)
    stop = ball_limit(stand_config().plant)
    for column, (settings, flights) in zip(axes.T, flown.items(), strict=True):
        for axis, lines in zip(column, ((LEVEL,), (0.0,), (), (-stop, stop)), strict=True):
            for value in lines:
                axis.axhline(value, color=INK, linestyle=":", linewidth=1)
        for name, flight in flights.items():
            rows = thinned(len(flight.time))
            curves = flight.height, np.degrees(flight.roll), flight.vertical, flight.ball
            for axis, curve in zip(column, curves, strict=True):
                axis.plot(flight.time[rows], curve[rows], label=name, **line(looks[name]))
        logarithmic(column[2], "symlog", linthresh=0.1)
        column[0].set_title(SETTINGS[settings])
        column[-1].set_xlabel("time [s]")
    labels = ("leader height [m]", "roll [deg]", "follower az [m/s²]", "ball [m]")
    for axis, label in zip(axes[:, 0], labels, strict=True):
        axis.set_ylabel(label)
    legend_above(figure, axes[0])
    return rendered(figure)
