"""The load's motion, the distribution of initial states, plants and disturbances, and random rigs."""

# Without `from __future__ import annotations`: the type of a field is read, and is no text.
from dataclasses import dataclass
from typing import Literal

from mjxball.config._leaf import Range, sampled, setting


@dataclass(frozen=True)
class Motion:
    """Motion of the centre of gravity along `plant.cg_axis`, or in the plane where that is xy."""

    kind: Literal["sine", "waveform", "rolling"] = setting(
        "sine", "sine: sampled or given per flight; waveform: the samples below; rolling: a free ball with end stops"
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
    """Distribution of flights: every reset samples uniformly from each range."""

    goal_range: float = setting(1.0, "range +- of each coordinate of the goal [m]", low=0, high=1e4)
    goal_motion_probability: float = setting(
        0.0, "probability of a goal that moves along a line or around a circle", low=0, high=1
    )
    goal_speed: Range = sampled((0.0, 0.5), "speed of goals that move [m/s]", low=0, high=100)
    goal_step_probability: float = setting(0.0, "probability that the goal jumps once, 5 to 15 s on", low=0, high=1)
    start_position: float = setting(0.0, "range +- of each coordinate of the start [m]", low=0, high=1e4)
    start_velocity: float = setting(0.0, "range +- of each component of the start velocity [m/s]", low=0, high=100)
    start_tilt: float = setting(0.0, "range +- of roll and pitch at the start [rad]", low=0, high=1)
    cg_speed: Range = sampled((0.31, 0.31), "angular speed of the CG's sine [rad/s]", low=0, high=100)
    cg_amplitude: Range = sampled((0.05, 0.05), "amplitude of the CG's sine [m]", low=0, high=1e4)
    object_mass: Range = sampled((0.2, 0.2), "true mass of the object [kg]", low=1e-12, high=1e5)
    trim_margin: float = setting(
        0.15,
        "the CG's amplitude is limited so that one drone holds it with this share of its torque left; negative: beyond",
        low=-0.5,
        high=1,
    )
    mass_change: Range = sampled((0.0, 0.0), "change of the object's mass in flight [kg]", low=-1e5, high=1e5)
    ball_start: float = setting(0.0, "rolling: range +- of the ball's offset from O at the start [m]", low=0, high=1e4)
    noise: Range = sampled(
        (0.0, 0.0), "measurement noise, in standard deviations of motion capture and IMU", low=0, high=100
    )
    delay: Range = sampled((0.0, 0.0), "delay of the follower's measurements [s]", low=0, high=0.5)
    estimator_drift: Range = sampled(
        (0.0, 0.0), "slow measurement error, in standard deviations of a drone's estimator", low=0, high=100
    )
    offset: Range = sampled(
        (0.0, 0.0), "constant errors of each drone's measurements, in standard deviations", low=0, high=100
    )
    pose_lag: Range = sampled(
        (0.0, 0.0), "time constant with which measured position and velocity follow the true ones [s]", low=0, high=1
    )
    gap_rate: Range = sampled(
        (0.0, 0.0), "mean number of gaps of up to 0.5 s in the measurements [1/s]", low=0, high=10
    )
    jitter: Range = sampled(
        (0.0, 0.0), "commands take effect up to so late, less than a control period [s]", low=0, high=1
    )
    object_sensor: bool = setting(
        False, "the object's error has a sensor of its own; else followers compute it from their own states"
    )
    calm_probability: float = setting(
        0.0, "probability of a flight without noise, drift, gusts, gaps, lag and jitter", low=0, high=1
    )
    quantize: bool = setting(False, "measured states have the resolution of a Crazyflie's log packets")
    leader_uses_measurements: bool = setting(False, "the leader uses the follower's measurements, else the true state")
    battery: Range = sampled((0.0, 0.0), "voltage of the battery; 0: motors follow their curve [V]", low=0, high=100)
    uncompensated_probability: float = setting(
        0.0, "probability of a firmware that does not compensate for the battery", low=0, high=1
    )
    gust: Range = sampled((0.0, 0.0), "rms of a gust's force on each axis of the world [N]", low=0, high=1e4)
    rotor_drag: Range = sampled((0.0, 0.0), "rotor drag of each drone over its mass [1/s]", low=0, high=100)
    wind: Range = sampled(
        (0.0, 0.0), "speed of a steady wind in any horizontal direction, felt by rotor drag [m/s]", low=0, high=100
    )
    floor_clearance: Range = sampled(
        (0.0, 0.0),
        "height of the lower of start and goal above the ground, for ground effect; 0: no ground [m]",
        low=0,
        high=1e4,
    )
    download: Range = sampled((0.0, 0.0), "share of its thrust that a rotor above the object loses", low=0, high=0.9)
    attitude_frequency: Range = sampled(
        (0.0, 0.0),
        "natural frequency of ideal roll loops, pitch and yaw in proportion; 0: that of attitude [rad/s]",
        low=0,
        high=1000,
    )
    thrust_fade: Range = sampled((0.0, 0.0), "share of all thrust that is lost in a second [1/s]", low=0, high=0.02)
    rotor_lag_scale: Range = sampled((1.0, 1.0), "factor on the rotors' time constant", low=0.001, high=1000)
    thrust_scale: Range = sampled(
        (1.0, 1.0), "factor on the rotor forces of each drone, sampled for each", low=0.001, high=1000
    )
    thrust_scale_common: Range = sampled(
        (1.0, 1.0), "common factor on the rotor forces of all drones", low=0.001, high=1000
    )
    inertia_scale: Range = sampled(
        (1.0, 1.0), "common factor on the inertia of drones and object", low=0.001, high=1000
    )
    cg_width: Range = sampled(
        (0.0, 0.0),
        "in the plane: amplitude of the CG's second sine, perpendicular to the first, over that of the first; the path "
        "is an ellipse; in three flights of ten the second sine has twice the frequency",
        low=0,
        high=100,
    )
    cg_waypoint_probability: float = setting(
        0.0, "probability that the CG moves between random waypoints instead of along a sine", low=0, high=1
    )
    team_sizes: tuple[int, ...] = setting(
        (),
        "numbers of drones, alternating over environments: rings of the plant's drones at the plant's spacing, carrier "
        "and load in proportion; empty: the plant",
        low=2,
        high=16,
    )
    drone_mass_scale: Range = sampled(
        (1.0, 1.0), "factor on the drones' masses, known to their hover thrust", low=0.001, high=1000
    )
    drone_inertia_scale: Range = sampled((1.0, 1.0), "factor on the inertia of all drones", low=0.001, high=1000)
    mount_scale: Range = sampled((1.0, 1.0), "factor on the distances of all mounts from O", low=0.001, high=1000)
    arm_scale: Range = sampled((1.0, 1.0), "factor on the arms of all rotors", low=0.001, high=1000)
    yaw_per_thrust_scale: Range = sampled(
        (1.0, 1.0), "factor on yaw moment over force of all rotors", low=0.001, high=1000
    )
    rotor_force_scale: Range = sampled((1.0, 1.0), "factor on the largest force of all rotors", low=0.001, high=1000)
    carrier_scale: Range = sampled(
        (1.0, 1.0), "factor on the carrier's mass and inertia, known to controllers", low=0.001, high=1000
    )
    attitude_gain_scale: Range = sampled((1.0, 1.0), "factor on all attitude gains", low=0.001, high=1000)
    lost_follower_probability: float = setting(
        0.0, "probability that the rotors of one follower stop, 3 to 15 s after the start", low=0, high=1
    )
    lost_leader_probability: float = setting(0.0, "probability that those of the leader stop instead", low=0, high=1)
    mass_known: bool = setting(True, "hover thrust uses the true mass of the object, else the plant's nominal one")
    unknown_mass_probability: float = setting(
        0.0,
        "probability of an object mass from unknown_mass, unknown to the hover thrust",
        low=0,
        high=1,
    )
    unknown_mass: Range = sampled((0.1, 0.35), "true mass of the object in those flights [kg]", low=1e-12, high=1e5)
    termination_distance: float = setting(
        2.5, "d_term: an episode terminates when |e_o| exceeds it [m]", low=1e-6, high=1e12
    )


@dataclass(frozen=True)
class Rigs:
    """Random rigs (`mjxball.sim.rigs`) of `scenario.team_sizes` drones, with their loads.

    The rig then determines the object's mass, the assumed mass, thrusts and the CG's amplitude, and `scenario` the
    rest: the CG's motion and the disturbances.
    """

    number: int = setting(
        0, "rigs of each size from which training samples its environments; 0: the plant alone", low=0, high=1_000_000
    )
    mass_step: float = setting(
        0.0,
        "largest change of the object's mass in flight over that mass, where the changed mass can be trimmed",
        low=0,
        high=0.9,
    )
