"""The configuration: frozen dataclasses whose fields carry their help text and bounds. SI units."""

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
    """The attitude controller on board of each drone.

    `ideal` is the PD loop of `Attitude`; `crazyflie` is the cascade of that firmware, with the gains kp, ki, kd of its
    parameters pid_attitude.* and pid_rate.* and its defaults.
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
        1.0,
        "factor on the follower's ki: on one body the integrals of two drones work against each other",
        low=0,
        high=1,
    )
    motor_curve: Range = setting(
        (0.0915, 0.0677),
        "force of a motor at full power: share of p^2 and of p, p = command / 65535 [N]",
        low=0,
        high=1000,
    )
    drone: Literal["", "2.1", "2.1-legacy", "thrust-upgrade", "brushless"] = setting(
        "", "the drone, for the effect of scenario.battery on its motors; empty: unknown, motors follow the curve"
    )
    thrust_law: Literal["calibrated", "paper"] = setting(
        "calibrated", "calibrated: the motor curve at m (g + az); paper: hover_thrust + thrust_per_acceleration az"
    )
    hover_thrust: float = setting(
        46000.0, "thr_hov of the paper's thrust command, calibrated for each rig", low=0, high=60_000
    )
    thrust_per_acceleration: float = setting(
        1000.0, "k_pz of the paper's thrust command [1/(m/s2)]", low=0, high=60_000
    )


@dataclass(frozen=True)
class Leader:
    """The leader's PID controller (paper eq. 5)."""

    kp: Vector3 = setting((0.5, 0.5, 0.5), "proportional gain per axis [1/s2]", low=0, high=1e6)
    kd: Vector3 = setting((1.0, 1.0, 1.0), "derivative gain per axis [1/s]", low=0, high=1e6)
    ki: Vector3 = setting((0.0, 0.0, 0.0), "integral gain per axis [1/s3]", low=0, high=1e6)
    integral_error_limit: Vector3 = setting(
        (1e3, 1e3, 1e3), "largest error per axis that enters the integral [m]", low=1e-6, high=1e12
    )
    integral_lead_time: float = setting(
        0.0,
        "the integral is of error + this * its rate, within the limit: it does not wind up on the way to a goal [s]",
        low=0,
        high=1000,
    )
    error: Literal["object", "own"] = setting(
        "object",
        "the error it controls: e_o of the object, or e_l of its own position, goal + its mount (paper's stand)",
    )


@dataclass(frozen=True)
class Command:
    """Limits of the command to any drone, leader or follower."""

    tilt_limit: float = setting(0.6, "largest commanded roll or pitch [rad]", low=1e-6, high=1.2)
    vertical_limit: float = setting(6.0, "largest commanded vertical acceleration [m/s2]", low=1e-6, high=1e6)


@dataclass(frozen=True)
class Follower:
    """The follower's observation and command."""

    action: Literal["residual", "direct"] = setting(
        "residual", "residual: added to a PD controller on its own observation; direct: the command itself"
    )
    action_scale_tilt: float = setting(0.2, "roll and pitch at an action of 1 [rad]", low=1e-9, high=1.2)
    action_scale_vertical: float = setting(2.0, "vertical acceleration at an action of 1 [m/s2]", low=1e-9, high=1e6)
    load_axis_only: bool = setting(
        False,
        "the network commands roll or pitch, whichever the load's torque turns; the other is the PD controller's or 0",
    )
    error: Literal["object", "leader"] = setting(
        "object", "the error in the observation: e_o of the object, or the leader's e_l"
    )
    ignore_position: bool = setting(True, "the network does not observe the absolute position")
    previous_action: bool = setting(False, "the network also observes its last action, scaled to -1 to 1")
    observation_averages: tuple[float, ...] = setting(
        (),
        "time constants of exponential averages of observations and actions that the network observes [s]",
        low=0.001,
        high=1e6,
    )
    stale: bool = setting(False, "the network also observes whether its measurement is still the last one")
    recurrent_units: int = setting(0, "units of the network's GRU; 0: none", low=0, high=512)
    privileged_critic: bool = setting(
        False, "in training, critics also observe the CG, the true mass and the disturbances"
    )


@dataclass(frozen=True)
class Timing:
    """Clock rates."""

    control_period: float = setting(0.02, "time between two commands [s]", low=0.001, high=1)
    physics_steps: int = setting(4, "steps of physics and attitude loop in a control period", low=1, high=1000)
    episode_steps: int = setting(1000, "control steps of a training episode, then truncated", low=1, high=10**6)


@dataclass(frozen=True)
class Reward:
    """Reward of one control step. `paper` rewards imitation of the leader, `task` (ours) balance at the goal."""

    kind: Literal["paper", "task"] = setting("task", "paper (imitation of the leader) or task (balance)")
    error: float = setting(1.0, "weight of |e_o| over error_scale [1]", low=0, high=1e9)
    error_scale: float = setting(
        0.1, "|e_o| up to which the cost of the error is quadratic, beyond it linear [m]", low=1e-9, high=1e6
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
    ball: float = setting(
        0.0, "weight of the squared offset of a rolling ball over that of its end stop", low=0, high=1e9
    )
    steady_action: float = setting(
        0.0,
        "weight of the squared slowest average of the network action: lasting loads are left to the integrals",
        low=0,
        high=1e9,
    )
    tilt_disagreement: float = setting(
        0.0,
        "weight of the squared difference of both drones' tilt commands about the axis without a torque of the load",
        low=0,
        high=1e9,
    )
    spread: float = setting(
        0.0,
        "weight of the squares of what in the followers' commands moves nothing: roll and pitch less their mean "
        "[1/rad2], vertical accelerations less the plane over the mounts that fits them best [1e-2 s4/m2]",
        low=0,
        high=1e9,
    )
    rotor_limits: float = setting(
        0.0,
        "weight of the sum over all rotors of the squared share by which a force is nearer than a tenth of the largest "
        "to a limit",
        low=0,
        high=1e9,
    )
    termination: float = setting(50.0, "cost of a termination", low=0, high=1e9)


@dataclass(frozen=True)
class Bounds:
    """Bounds that `eval.py --check` enforces for the exported policy on the reference scenario; 0: none."""

    x_peak: float = setting(0.05, "largest |e_x| after 20 s [m]", low=0, high=1e12)
    settling_time: float = setting(4.0, "2 % settling time [s]", low=0, high=1e12)
    rmse: float = setting(0.36, "root mean square of |e_o| over 20 s [m]", low=0, high=1e12)
    action_error: float = setting(
        0.0, "rms of the difference to the leader's command, over all three [rad, m/s2]", low=0, high=1e12
    )


@dataclass(frozen=True)
class Config:
    """Everything that determines a run, besides its seed."""

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
        """Duration of one physics step [s]."""
        return self.timing.control_period / self.timing.physics_steps
