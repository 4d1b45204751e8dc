"""How loads move, what every reset samples, and random rigs."""

# Without `from __future__ import annotations`: the type of a field is read, and is no text.
from dataclasses import dataclass
from typing import Literal

from mjxball.config._leaf import Range, sampled, setting


@dataclass(frozen=True)
class Motion:
    """How the centre of gravity moves along `plant.cg_axis`, or in the plane where that is xy."""

    kind: Literal["sine", "waveform", "rolling"] = setting(
        "sine", "sine: drawn or given per flight; waveform: the samples below; rolling: a free ball with end stops"
    )
    times: tuple[float, ...] = setting((), "waveform: increasing sample times [s]", low=-1e5, high=1e5, most=100_000)
    offsets: tuple[float, ...] = setting(
        (),
        "waveform: CG offsets at those times, a C2 spline between, held outside [m]",
        low=-1e4,
        high=1e4,
        most=100_000,
    )
    offsets_across: tuple[float, ...] = setting(
        (),
        "waveform in the plane: CG offsets along body y at those times, and offsets are those along x [m]",
        low=-1e4,
        high=1e4,
        most=100_000,
    )


@dataclass(frozen=True)
class ScenarioRanges:
    """What every reset draws anew, uniformly from each range."""

    goal_range: float = setting(1.0, "each coordinate of the goal is drawn from +- this [m]", low=0, high=1e4)
    start_position: float = setting(0.0, "each coordinate of the start is drawn from +- this [m]", low=0, high=1e4)
    start_velocity: float = setting(0.0, "each start velocity is drawn from +- this [m/s]", low=0, high=100)
    start_tilt: float = setting(0.0, "start roll and pitch are drawn from +- this [rad]", low=0, high=1)
    cg_speed: Range = sampled((0.31, 0.31), "angular speed of the CG's sine [rad/s]", low=0, high=100)
    cg_amplitude: Range = sampled((0.05, 0.05), "amplitude of the CG's sine [m]", low=0, high=1e4)
    object_mass: Range = sampled((0.2, 0.2), "true mass of the object [kg]", low=1e-12, high=1e5)
    trim_margin: float = setting(
        0.15,
        "the CG's amplitude is cut to where one drone holds it with this share of its torque left; negative: beyond",
        low=-0.5,
        high=1,
    )
    mass_change: Range = sampled(
        (0.0, 0.0), "mass added to (dropped from, if negative) the object in flight [kg]", low=-1e5, high=1e5
    )
    ball_start: float = setting(0.0, "rolling: the ball starts within +- this from O [m]", low=0, high=1e4)
    noise: Range = sampled(
        (0.0, 0.0), "measurement noise, in standard deviations of motion capture and IMU", low=0, high=100
    )
    delay: Range = sampled((0.0, 0.0), "delay of the follower's measurements [s]", low=0, high=0.5)
    estimator_drift: Range = sampled(
        (0.0, 0.0), "slow measurement error, in standard deviations of a drone's estimator", low=0, high=100
    )
    calm_probability: float = setting(
        0.0, "probability of a flight without noise, drift and gusts, whatever its delay", low=0, high=1
    )
    quantize: bool = setting(False, "states arrive with the resolution of a Crazyflie's log packets")
    leader_uses_measurements: bool = setting(
        False, "the leader flies on the follower's measurements, else on the true state"
    )
    battery: Range = sampled((0.0, 0.0), "voltage of the battery; 0: motors follow the curve [V]", low=0, high=100)
    uncompensated_probability: float = setting(
        0.0, "probability of a firmware that does not compensate for the battery", low=0, high=1
    )
    gust: Range = sampled((0.0, 0.0), "rms of a gust's force on each axis of the world [N]", low=0, high=1e4)
    rotor_lag_scale: Range = sampled((1.0, 1.0), "factor on the rotors' time constant", low=0.001, high=1000)
    thrust_scale: Range = sampled((1.0, 1.0), "factor on each drone's rotor forces, drawn apart", low=0.001, high=1000)
    thrust_scale_common: Range = sampled((1.0, 1.0), "factor on both drones' rotor forces alike", low=0.001, high=1000)
    inertia_scale: Range = sampled((1.0, 1.0), "one factor on the inertia of drones and object", low=0.001, high=1000)
    cg_width: Range = sampled(
        (0.0, 0.0),
        "in the plane: amplitude of the CG's second sine, across the first one, over that one's; in three flights of "
        "ten it is twice as fast, else the path is an ellipse",
        low=0,
        high=100,
    )
    cg_waypoint_probability: float = setting(
        0.0, "probability that the CG moves between random waypoints instead of in a sine", low=0, high=1
    )
    team_sizes: tuple[int, ...] = setting(
        (),
        "numbers of drones, one after the other from world to world: rings of the plant's drones, neighbours as far "
        "apart, carrier and load in proportion; empty: the plant",
        low=2,
        high=16,
    )
    drone_mass_scale: Range = sampled(
        (1.0, 1.0), "factor on the drones' masses, which their hover thrust knows", low=0.001, high=1000
    )
    drone_inertia_scale: Range = sampled((1.0, 1.0), "factor on all drones' own inertia", low=0.001, high=1000)
    mount_scale: Range = sampled((1.0, 1.0), "factor on all mounts' distances from O", low=0.001, high=1000)
    arm_scale: Range = sampled((1.0, 1.0), "factor on all rotors' arms", low=0.001, high=1000)
    yaw_per_thrust_scale: Range = sampled(
        (1.0, 1.0), "factor on all rotors' yaw moment over force", low=0.001, high=1000
    )
    rotor_force_scale: Range = sampled((1.0, 1.0), "factor on all rotors' largest force", low=0.001, high=1000)
    carrier_scale: Range = sampled(
        (1.0, 1.0), "factor on the carrier's mass and inertia, which is known", low=0.001, high=1000
    )
    attitude_gain_scale: Range = sampled((1.0, 1.0), "factor on all attitude gains", low=0.001, high=1000)
    lost_follower_probability: float = setting(
        0.0, "probability that one follower's rotors stop, 3 to 15 s after the start", low=0, high=1
    )
    mass_known: bool = setting(True, "hover thrust uses the true object mass, else the plant's nominal one")
    unknown_mass_probability: float = setting(
        0.0,
        "probability of an object mass that the hover thrust does not know, from unknown_mass",
        low=0,
        high=1,
    )
    unknown_mass: Range = sampled((0.1, 0.35), "true mass of the object in these flights [kg]", low=1e-12, high=1e5)
    termination_distance: float = setting(
        2.5, "an episode ends when |e_o| exceeds this, d_term [m]", low=1e-6, high=1e12
    )


@dataclass(frozen=True)
class Rigs:
    """Random rigs (`mjxball.sim.rigs`) of `scenario.team_sizes` drones, their loads included.

    The object's mass, beliefs, thrusts and how far the CG goes are then those of the rig, and `scenario` says how it
    moves and what disturbs.
    """

    number: int = setting(
        0, "rigs of each size that training draws its worlds from; 0: the plant's own", low=0, high=1_000_000
    )
    mass_step: float = setting(
        0.0,
        "in flight the object's mass changes by up to this share of itself, as far as that can be trimmed",
        low=0,
        high=0.9,
    )
