"""Parameters of `lqg`, found by `benchmarks/tuning.py` on flights of a draw that no table reports.

Costs of that script, 1 if every flight succeeds as early as with `oracle` and 5 if none does, and successes, of 72
flights of the pair in each condition, after 3840 sets: 2.40 of the defaults in both conditions (93 % calm, 18 % in
the world), 1.03 of `CALM` (97 %, calm), 3.40 of `WORLD` (24 %, in the world). `TEAM`: 2.60 for 12 loads of rings of 3
and 5 in each condition (1440 sets).
"""

from __future__ import annotations

from typing import NamedTuple

from mjxball.baselines.hover_model import LoadModel

LONGEST_DELAY = 4  # control steps


class Costs(NamedTuple):
    """What the LQR weighs, and limits of what it acts on."""

    position: float  # horizontal error with a cost of 1 [m]
    velocity: float  # and its rate [m/s]
    height: float  # vertical error with a cost of 1 [m]
    climb: float  # and its rate [m/s]
    error_limit: float  # largest horizontal error that is acted on [m]
    tilt_limit: float  # largest tilt that errors and rates ask for [rad]
    height_limit: float  # largest vertical error that is acted on [m]
    climb_limit: float  # largest vertical acceleration that errors and rates ask for [m/s2]


class Tuning(NamedTuple):
    """Parameters of the controller: those of `Costs`, and of the filter and its model."""

    position: float = 0.0284
    velocity: float = 0.168
    height: float = 0.037
    climb: float = 0.181
    error_limit: float = 0.237
    tilt_limit: float = 0.461
    height_limit: float = 0.231
    climb_limit: float = 4.75
    load_walk: float = 298  # noise intensity of the load torque's second derivative, over J [(rad/s4)2/s]
    load_frequency: float = 2.45  # of the load's oscillation [rad/s]
    load_damping: float = 0.0347  # of that oscillation
    load_time: float = 26.5  # time constant with which its torque is forgotten [s]
    wind_walk: float = 0.369  # noise intensity of the wind's acceleration [(m/s2)2/s]
    wind_time: float = 7.56  # time constant with which it is forgotten [s]
    lift_walk: float = 0.0126  # as of the wind, of errors of mass and thrust
    lift_time: float = 184
    acceleration_walk: float = 0.00696  # of every velocity [(m/s)2/s]
    turn_walk: float = 0.0395  # of roll and pitch rate [(rad/s)2/s]
    velocity_noise: float = 0.0134  # standard deviations of measurements, beside `POSITION_NOISE` [m/s]
    angle_noise: float = 0.00309  # [rad]
    rate_noise: float = 0.0037  # [rad/s]
    loop_scale: float = 1.01  # assumed factor on the attitude loops' natural frequency
    delay: float = 1.14  # of the measurements, rounded [control steps]

    @property
    def costs(self) -> Costs:
        """Those of the LQR."""
        return Costs(*self[: len(Costs._fields)])

    @property
    def load(self) -> LoadModel:
        """That of the disturbances."""
        return LoadModel(self.load_frequency, self.load_damping, self.load_time, self.wind_time, self.lift_time)

    @property
    def late(self) -> int:
        """Delay in control steps."""
        return min(max(round(float(self.delay)), 0), LONGEST_DELAY)


CALM = Tuning(
    position=0.0285,
    velocity=0.212,
    height=0.048,
    climb=0.253,
    error_limit=0.236,
    tilt_limit=0.47,
    height_limit=0.254,
    climb_limit=4.36,
    load_walk=1.96e03,
    load_frequency=1.6,
    load_damping=0.0426,
    load_time=48,
    wind_walk=0.66,
    wind_time=16.2,
    lift_walk=0.0308,
    lift_time=106,
    acceleration_walk=0.00305,
    turn_walk=0.0121,
    velocity_noise=0.00506,
    angle_noise=0.00309,
    rate_noise=0.0238,
    loop_scale=1,
    delay=0.185,
)
WORLD = Tuning(
    position=0.0901,
    velocity=0.287,
    height=0.0404,
    climb=0.274,
    error_limit=0.326,
    tilt_limit=0.286,
    height_limit=0.148,
    climb_limit=2.09,
    load_walk=151,
    load_frequency=2.46,
    load_damping=0.0592,
    load_time=81.8,
    wind_walk=0.281,
    wind_time=31.8,
    lift_walk=0.00847,
    lift_time=90.3,
    acceleration_walk=0.00408,
    turn_walk=0.0705,
    velocity_noise=0.0374,
    angle_noise=0.00369,
    rate_noise=0.0379,
    loop_scale=0.969,
    delay=0.822,
)
# Of several followers, whose sensors and noises disagree: what each of them estimates must be forgotten.
TEAM = Tuning(
    position=0.00779,
    velocity=0.174,
    height=0.0116,
    climb=0.308,
    error_limit=0.159,
    tilt_limit=1.06,
    height_limit=0.18,
    climb_limit=8.55,
    load_walk=968,
    load_frequency=10.7,
    load_damping=0.23,
    load_time=2.67,
    wind_walk=0.00405,
    wind_time=4.42,
    lift_walk=0.00807,
    lift_time=7.4,
    acceleration_walk=0.00338,
    turn_walk=0.272,
    velocity_noise=0.0118,
    angle_noise=0.00106,
    rate_noise=0.0328,
    loop_scale=0.911,
    delay=2.18,
)
TEAM_CALM, TEAM_WORLD = TEAM, TEAM
