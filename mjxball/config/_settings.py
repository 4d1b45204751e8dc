"""Every setting: frozen dataclasses whose leaves carry their help text and bounds. SI units throughout."""

# Without `from __future__ import annotations`: the type of a field is read, and is no text.
from dataclasses import dataclass
from typing import Literal

from mjxball.config._leaf import Range, Vector3, setting
from mjxball.config._learning import Gradient, Ppo, Sac
from mjxball.config._plant import Plant
from mjxball.config._scenario import Motion, Rigs, ScenarioRanges


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
