"""Every setting: frozen dataclasses whose leaves carry their help text and bounds. SI units throughout."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from mjxball.config._leaf import Range, Vector3, drawn, setting
from mjxball.config._learning import Gradient, Ppo, Sac
from mjxball.config._plant import Plant
from mjxball.config._rigs import Rigs


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
class Attitude:
    """The PD attitude loop that each drone runs once per physics step (ours)."""

    natural_frequency: Vector3 = setting(
        (10.0, 10.0, 4.0), "natural frequency of roll, pitch, yaw [rad/s]", low=0.001, high=1e4
    )
    damping: float = setting(0.9, "damping ratio", low=0.001, high=1000)
    design_object_mass: float = setting(0.2, "object mass that the gains are for [kg]", low=0, high=1e5)


@dataclass(frozen=True)
class Autopilot:
    """What each drone's own computer runs. `ideal` is the PD loop of `Attitude`; `crazyflie` is its firmware's
    cascade, with the gains kp, ki, kd of its parameters pid_attitude.* and pid_rate.*, defaults as delivered.
    """

    kind: Literal["ideal", "crazyflie"] = setting("ideal", "ideal: PD of `attitude`; crazyflie: the firmware's cascade")
    roll: Vector3 = setting((6.0, 3.0, 0.0), "pid_attitude.roll_kp, ki, kd [1/s, 1/s2, 1]", low=0, high=1e6)
    pitch: Vector3 = setting((6.0, 3.0, 0.0), "pid_attitude.pitch_kp, ki, kd", low=0, high=1e6)
    yaw: Vector3 = setting((6.0, 1.0, 0.35), "pid_attitude.yaw_kp, ki, kd", low=0, high=1e6)
    roll_rate: Vector3 = setting(
        (250.0, 500.0, 2.5), "pid_rate.roll_kp, ki, kd [motor command per deg/s]", low=0, high=1e6
    )
    pitch_rate: Vector3 = setting((250.0, 500.0, 2.5), "pid_rate.pitch_kp, ki, kd", low=0, high=1e6)
    yaw_rate: Vector3 = setting((120.0, 16.7, 0.0), "pid_rate.yaw_kp, ki, kd", low=0, high=1e6)
    follower_ki_scale: float = setting(
        1.0, "factor on the follower's ki: two drones that integrate on one body work against each other", low=0, high=1
    )
    motor_curve: Range = setting(
        (0.0915, 0.0677),
        "force of a motor at full power: share of p^2 and of p, p = command / 65535 [N]",
        low=0,
        high=1000,
    )
    drone: Literal["", "2.1", "2.1-legacy", "thrust-upgrade", "brushless"] = setting(
        "", "whose motors follow the battery where scenario.battery is drawn; empty: unknown, they follow the curve"
    )
    thrust_law: Literal["calibrated", "paper"] = setting(
        "calibrated", "calibrated: the motor curve at m (g + az); paper: hover_thrust + thrust_per_acceleration az"
    )
    hover_thrust: float = setting(46000.0, "thr_hov of the paper's law, calibrated for each rig", low=0, high=60_000)
    thrust_per_acceleration: float = setting(1000.0, "k_pz of the paper's law [1/(m/s2)]", low=0, high=60_000)


@dataclass(frozen=True)
class Leader:
    """The leader's PID law (paper eq. 5) and its command limits."""

    kp: Vector3 = setting((0.5, 0.5, 0.5), "proportional gain per axis [1/s2]", low=0, high=1e6)
    kd: Vector3 = setting((1.0, 1.0, 1.0), "derivative gain per axis [1/s]", low=0, high=1e6)
    ki: Vector3 = setting((0.0, 0.0, 0.0), "integral gain per axis [1/s3]", low=0, high=1e6)
    integral_error_limit: Vector3 = setting(
        (1e3, 1e3, 1e3), "largest error per axis that is integrated [m]", low=1e-6, high=1e12
    )
    integral_lead_time: float = setting(
        0.0,
        "the integrated error is error + this * its rate, within the limit: nothing winds up on the way to a goal [s]",
        low=0,
        high=1000,
    )
    tilt_integral_gain: float = setting(
        0.0,
        "difference of both drones' lift for the time integral of the carrier's tilt error about the axis that "
        "the load turns, with follower.residual_on_pid [m/s2 per rad s]",
        low=0,
        high=1e4,
    )
    error: Literal["object", "own"] = setting(
        "object", "what it flies on: e_o of the object, or e_l of its own place, goal + its mount (the paper's stand)"
    )


@dataclass(frozen=True)
class Command:
    """Limits of what any drone is sent, leader or follower."""

    tilt_limit: float = setting(0.6, "largest commanded roll or pitch [rad]", low=1e-6, high=1.2)
    vertical_limit: float = setting(6.0, "largest commanded vertical acceleration [m/s2]", low=1e-6, high=1e6)


@dataclass(frozen=True)
class Follower:
    """What the follower sees and what it commands."""

    action: Literal["residual", "direct"] = setting(
        "residual", "residual: added to the PD law on its own observation; direct: the command itself"
    )
    action_scale_tilt: float = setting(0.2, "roll and pitch at an action of 1 [rad]", low=1e-9, high=1.2)
    action_scale_vertical: float = setting(2.0, "vertical acceleration at an action of 1 [m/s2]", low=1e-9, high=1e6)
    residual_on_pid: bool = setting(
        False,
        "a residual action is added to the leader's PID law, integrals included, not to its PD part alone, behind a "
        "high pass: what lasts is the integrals' part",
    )
    load_axis_only: bool = setting(
        False,
        "of roll and pitch the network commands the one that the load turns; the other follows the PD law or is 0",
    )
    error: Literal["object", "leader"] = setting(
        "object", "what the slots of the object's error carry: e_o, or the leader's e_l"
    )
    ignore_position: bool = setting(True, "the network does not see the absolute position")
    previous_action: bool = setting(False, "the network also sees its last action, scaled to [-1, 1]")
    observation_averages: tuple[float, ...] = setting(
        (),
        "time constants of exponential averages of observations and actions that the network sees [s]",
        low=0.001,
        high=1e6,
    )
    recurrent_units: int = setting(
        0, "units of a GRU whose state the network carries from step to step; 0: none", low=0, high=512
    )
    privileged_critic: bool = setting(False, "in training, critics also see the CG, the true mass and the disturbances")


@dataclass(frozen=True)
class Timing:
    """Clock rates."""

    control_period: float = setting(0.02, "time between two commands [s]", low=0.001, high=1)
    physics_steps: int = setting(4, "physics and attitude-loop steps in a control period", low=1, high=1000)
    episode_steps: int = setting(1000, "control steps of a training episode, then truncated", low=1, high=10**6)


@dataclass(frozen=True)
class ScenarioRanges:
    """What every reset draws anew, uniformly from each range."""

    goal_range: float = setting(1.0, "each coordinate of the goal is drawn from +- this [m]", low=0, high=1e4)
    start_position: float = setting(0.0, "each coordinate of the start is drawn from +- this [m]", low=0, high=1e4)
    start_velocity: float = setting(0.0, "each start velocity is drawn from +- this [m/s]", low=0, high=100)
    start_tilt: float = setting(0.0, "start roll and pitch are drawn from +- this [rad]", low=0, high=1)
    cg_speed: Range = drawn((0.31, 0.31), "angular speed of the CG's sine [rad/s]", low=0, high=100)
    cg_amplitude: Range = drawn((0.05, 0.05), "amplitude of the CG's sine [m]", low=0, high=1e4)
    object_mass: Range = drawn((0.2, 0.2), "true mass of the object [kg]", low=1e-12, high=1e5)
    trim_margin: float = setting(
        0.15,
        "the CG's amplitude is cut to where one drone holds it with this share of its torque left; negative: beyond",
        low=-0.5,
        high=1,
    )
    mass_change: Range = drawn(
        (0.0, 0.0), "mass added to (dropped from, if negative) the object in flight [kg]", low=-1e5, high=1e5
    )
    ball_start: float = setting(0.0, "rolling: the ball starts within +- this from O [m]", low=0, high=1e4)
    noise: Range = drawn(
        (0.0, 0.0), "measurement noise, in standard deviations of motion capture and IMU", low=0, high=100
    )
    delay: Range = drawn((0.0, 0.0), "delay of the follower's measurements [s]", low=0, high=0.5)
    estimator_drift: Range = drawn(
        (0.0, 0.0), "slow measurement error, in standard deviations of a drone's estimator", low=0, high=100
    )
    calm_probability: float = setting(
        0.0, "probability of a flight without noise, drift and gusts, whatever its delay", low=0, high=1
    )
    quantize: bool = setting(False, "states arrive with the resolution of a Crazyflie's log packets")
    leader_uses_measurements: bool = setting(
        False, "the leader flies on the follower's measurements, else on the true state"
    )
    battery: Range = drawn((0.0, 0.0), "voltage of the battery; 0: motors follow the curve [V]", low=0, high=100)
    uncompensated_probability: float = setting(
        0.0, "probability of a firmware that does not compensate for the battery", low=0, high=1
    )
    gust: Range = drawn((0.0, 0.0), "rms of a gust's force on each axis of the world [N]", low=0, high=1e4)
    rotor_lag_scale: Range = drawn((1.0, 1.0), "factor on the rotors' time constant", low=0.001, high=1000)
    thrust_scale: Range = drawn((1.0, 1.0), "factor on each drone's rotor forces, drawn apart", low=0.001, high=1000)
    thrust_scale_common: Range = drawn((1.0, 1.0), "factor on both drones' rotor forces alike", low=0.001, high=1000)
    inertia_scale: Range = drawn((1.0, 1.0), "one factor on the inertia of drones and object", low=0.001, high=1000)
    cg_width: Range = drawn(
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
    drone_mass_scale: Range = drawn(
        (1.0, 1.0), "factor on the drones' masses, which their hover thrust knows", low=0.001, high=1000
    )
    drone_inertia_scale: Range = drawn((1.0, 1.0), "factor on all drones' own inertia", low=0.001, high=1000)
    mount_scale: Range = drawn((1.0, 1.0), "factor on all mounts' distances from O", low=0.001, high=1000)
    arm_scale: Range = drawn((1.0, 1.0), "factor on all rotors' arms", low=0.001, high=1000)
    yaw_per_thrust_scale: Range = drawn((1.0, 1.0), "factor on all rotors' yaw moment over force", low=0.001, high=1000)
    rotor_force_scale: Range = drawn((1.0, 1.0), "factor on all rotors' largest force", low=0.001, high=1000)
    carrier_scale: Range = drawn(
        (1.0, 1.0), "factor on the carrier's mass and inertia, which is known", low=0.001, high=1000
    )
    attitude_gain_scale: Range = drawn((1.0, 1.0), "factor on all attitude gains", low=0.001, high=1000)
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
    unknown_mass: Range = drawn((0.1, 0.35), "true mass of the object in these flights [kg]", low=1e-12, high=1e5)
    termination_distance: float = setting(
        2.5, "an episode ends when |e_o| exceeds this, d_term [m]", low=1e-6, high=1e12
    )


@dataclass(frozen=True)
class Reward:
    """Reward of one control step. `paper` mimics the leader; `task` (ours) scores what the user wants."""

    kind: Literal["paper", "task"] = setting("task", "paper (leader mimicry) or task (balance)")
    error: float = setting(1.0, "weight of |e_o| over error_scale, saturating [1]", low=0, high=1e9)
    error_scale: float = setting(
        0.1, "|e_o| at which the error's cost turns from square to linear [m]", low=1e-9, high=1e6
    )
    velocity: float = setting(0.1, "weight of |de_o/dt|^2 [s2/m2]", low=0, high=1e9)
    tilt: float = setting(0.0, "weight of roll^2 + pitch^2 [1/rad2]", low=0, high=1e9)
    rates: float = setting(0.05, "weight of the squared body rates [s2/rad2]", low=0, high=1e9)
    effort: float = setting(0.02, "weight of the squared network action in [-1, 1]", low=0, high=1e9)
    smoothness: float = setting(0.02, "weight of the squared change of the network action", low=0, high=1e9)
    command_change: float = setting(
        0.0,
        "weight of the squared change of the follower's roll, pitch [1/rad2] and vertical [1e-2 s4/m2] command",
        low=0,
        high=1e9,
    )
    ball: float = setting(0.0, "weight of the square of a rolling ball's offset over its end stop's", low=0, high=1e9)
    steady_action: float = setting(
        0.0,
        "weight of the squared slowest average of the network action: what stands is the integrals' part",
        low=0,
        high=1e9,
    )
    tilt_disagreement: float = setting(
        0.0,
        "weight of the squared difference of both drones' tilt commands about the axis that no load turns",
        low=0,
        high=1e9,
    )
    spread: float = setting(
        0.0,
        "weight of the squared differences of a follower's roll, pitch [1/rad2] and vertical [1e-2 s4/m2] command to "
        "the mean of all followers: they are not to work against each other",
        low=0,
        high=1e9,
    )
    termination: float = setting(50.0, "cost of leaving termination_distance, once", low=0, high=1e9)


@dataclass(frozen=True)
class Bounds:
    """What `eval.py --check` enforces for the exported policy on the reference scenario; 0 leaves a metric free."""

    x_peak: float = setting(0.05, "largest |e_x| after 20 s [m]", low=0, high=1e12)
    settling_time: float = setting(4.0, "2 % settling time [s]", low=0, high=1e12)
    rmse: float = setting(0.36, "root mean square of |e_o| over 20 s [m]", low=0, high=1e12)
    action_error: float = setting(
        0.0, "rms of the command less the leader's, over all three [rad, m/s2]", low=0, high=1e12
    )


@dataclass(frozen=True)
class Config:
    """Everything that determines a run, its seed aside."""

    preset: str = "paper"
    plant: Plant = Plant()
    motion: Motion = Motion()
    attitude: Attitude = Attitude()
    autopilot: Autopilot = Autopilot()
    leader: Leader = Leader()
    command: Command = Command()
    follower: Follower = Follower()
    timing: Timing = Timing()
    scenario: ScenarioRanges = ScenarioRanges()
    rigs: Rigs = Rigs()
    reward: Reward = Reward()
    sac: Sac = Sac()
    ppo: Ppo = Ppo()
    gradient: Gradient = Gradient()
    bounds: Bounds = Bounds()

    @property
    def physics_step(self) -> float:
        """Time of one physics step [s]."""
        return self.timing.control_period / self.timing.physics_steps
