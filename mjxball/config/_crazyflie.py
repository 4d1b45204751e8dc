"""Two Crazyflies on a stick with a ball: the rig, its variants, and the presets `stand` and `flight`."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from mjxball.config._plant import Drone, Plant
from mjxball.config._settings import (
    Autopilot,
    Bounds,
    Config,
    Follower,
    Leader,
    Motion,
    Reward,
    Sac,
    Scenario,
    Timing,
)
from mjxball.config._tree import leaves

# mass [kg], motor curve [N], whose motor: firmware of 2025.12.1 on compensates for the battery, force is a line.
DRONES: dict[str, tuple[float, tuple[float, float], Any]] = {
    "2.1": (0.029, (0.0, 0.12), "2.1"),
    "2.1-older": (0.029, (0.0915, 0.0677), "2.1"),  # firmware before that: the command is the PWM
    "thrust-upgrade": (0.0345, (0.0, 0.18), "thrust-upgrade"),
    "brushless": (0.0393, (0.0, 0.20), "brushless"),
}  # with a positioning deck where it is not part of the drone

# Roll, roll rate, yaw, yaw rate of the pair, as `python -m mjxball.rig.gains` computes them; pitch is as delivered.
# The 2.1's are those of its older curve with the rates in the newer one's units: what leaves more thrust turns faster.
GAINS = {
    "2.1": ((3.25, 0.0, 0.0), (1530.0, 742.0, 45.9), (1.61, 0.0, 0.0), (1895.0, 28.8, 0.0)),
    "2.1-older": ((3.25, 0.0, 0.0), (937.0, 454.0, 28.1), (1.61, 0.0, 0.0), (1160.0, 17.6, 0.0)),
    "thrust-upgrade": ((2.41, 0.0, 0.0), (1330.0, 495.0, 26.5), (1.61, 0.0, 0.0), (1640.0, 24.2, 0.0)),
    "brushless": ((2.41, 0.0, 0.0), (1350.0, 445.0, 27.0), (1.61, 0.0, 0.0), (1660.0, 24.2, 0.0)),
}


def rig(drone: str = "2.1") -> Plant:
    """Two drones 0.30 m apart on a carbon stick along body y, 10 g with its mounts, and a 7.5 g ball that it guides.

    Weighs 75.5 g with the 2.1, which hovers at 50 562 of 60 000 units, and at the paper's 46 000 on the older curve.
    """
    mass, curve, _ = DRONES[drone]
    inertia = (1.66e-5, 1.66e-5, 2.93e-5)
    return Plant(
        drones=tuple(Drone(mass=mass, inertia=inertia, mount=(0.0, y, 0.0)) for y in (0.15, -0.15)),
        object_mass=0.0175,
        object_size=(0.02, 0.30, 0.01),
        moving_fraction=0.0075 / 0.0175,
        ball_radius=0.006,
        ball_stop=0.08,
        cg_axis="y",
        arm=0.046,
        layout="x",
        rotor_force_max=sum(curve),
        rotor_lag=0.05,
        yaw_per_thrust=0.006,
    )


def autopilot(drone: str = "2.1") -> Autopilot:
    """The firmware with gains for the coupled pair: the stick makes roll 43 and yaw 25 times heavier."""
    roll, roll_rate, yaw, yaw_rate = GAINS.get(drone, GAINS["2.1"])
    return Autopilot(
        kind="crazyflie",
        motor_curve=DRONES[drone][1],
        drone=DRONES[drone][2],
        roll=roll,
        roll_rate=roll_rate,
        yaw=yaw,
        yaw_rate=yaw_rate,
    )


# Drones with thrust to spare bear the ball at its stop; all their firmwares compensate for the battery.
STRONG: dict[str, Any] = {"scenario.cg_amplitude": (0.0, 0.034), "scenario.uncompensated_share": 0.0}


def rig_settings(drone: str) -> dict[str, Any]:
    """What a plant file of the pair of `DRONES` says: every setting of plant and autopilot that a 2.1 has otherwise."""
    mine, usual = (Config(plant=rig(name), autopilot=autopilot(name)) for name in (drone, "2.1"))
    pairs = zip(leaves(mine), leaves(usual), strict=True)
    changed = {path: value for (path, value, _), (_, other, _) in pairs if value != other}
    return changed if drone.startswith("2.1") else {**changed, **STRONG}


PAIR = Config(
    plant=rig(),
    # Only the leader's firmware integrates: told different angles, two that do wind up against each other until motors
    # are full and the pair sinks.
    autopilot=replace(autopilot(), follower_integrals=0.0),
    timing=Timing(control_period=0.01, physics_steps=5, episode_steps=1500),
    # Stiff in height and with an integral term, so that the leader finds the thrust for its share of the weight: what
    # the two lift apart acts over half the stick, and beyond 4 % of hover no drone's rotors hold that about roll.
    leader=Leader(
        kp=(1.0, 1.0, 2.5),
        kd=(1.6, 1.6, 3.5),
        ki=(0.2, 0.2, 1.5),
        integral_band=(0.1, 0.1, 0.3),
        integral_lead=1.0,
        level_gain=10.0,
        tilt_limit=0.26,
        vertical_limit=6.0,
    ),
)


# For a GPU.
LARGE_SAC = Sac(
    total_steps=2_560_000,
    num_envs=512,
    batch_size=512,
    updates_per_step=16,
    replay_size=512_000,
    policy_layers=(128, 128),
    critic_layers=(128, 128),
    privileged_critic=True,
    n_step=15,
    learning_rate=2e-3,
    learning_rate_end=0.02,
)


def stand() -> Config:
    """The paper's experiment: roll and height free, pitch locked, a rolling ball, the paper's gains and thrust law."""
    return replace(
        PAIR,
        preset="stand",
        plant=replace(PAIR.plant, stand="heave"),
        motion=Motion(kind="rolling"),
        # The paper's 46 000 and 1000 units, on the older curve, give this force and slope on the newer one.
        autopilot=replace(PAIR.autopilot, thrust_law="paper", hover_thrust=50568.0, thrust_per_acceleration=1634.5),
        leader=Leader(
            kp=(1.0, 1.0, 0.1),
            kd=(2.0, 2.0, 5.0),
            ki=(0.2, 0.1, 0.1),
            tilt_limit=0.26,
            vertical_limit=3.0,
            error="own",
        ),
        follower=Follower(
            action="residual",
            action_scale_tilt=0.2,
            action_scale_vertical=3.0,
            observation_averages=(0.05, 0.2, 1.0),
            ignore_position=True,
        ),
        scenario=Scenario(
            goal_range=0.0,
            start_position=0.03,
            start_tilt=0.1,
            cg_amplitude=(0.0, 0.0),
            object_mass=(0.0175, 0.0175),
            ball_start=0.05,
            noise=(0.0, 0.5),
            delay=(0.0, 0.03),
            estimator_drift=(0.0, 1.0),
            quantize=True,
            leader_uses_measurements=True,
            rotor_lag_scale=(0.6, 2.0),
            thrust_scale=(0.99, 1.01),
            thrust_common=(0.99, 1.01),
            inertia_scale=(0.6, 1.4),
            termination_distance=1.0,
        ),
        reward=Reward(
            error_scale=0.05, velocity=2.0, tilt=5.0, rates=0.2, ball=10.0, tilt_disagreement=20.0, termination=200.0
        ),
        bounds=Bounds(x_peak=0.0, settling_time=0.0, rmse=0.05),
        sac=replace(LARGE_SAC, discount=0.99, reward_scale=0.1),
    )


def flight() -> Config:
    """The pair in free flight with a moving ball, the paper's future work."""
    return replace(
        PAIR,
        preset="flight",
        # The leader's integral hides what the follower commands where no load turns the pair, until motors are full.
        follower=Follower(
            load_axis_only=True,
            action_scale_tilt=0.12,
            action_scale_vertical=0.8,
            observation_averages=(0.05, 0.2, 1.0),
            shares_integrals=True,
            washout_time=8.0,
        ),
        scenario=Scenario(
            goal_range=0.5,
            start_velocity=0.1,
            start_tilt=0.05,
            cg_speed=(0.2, 1.2),
            cg_amplitude=(0.0, 0.02),  # of the plain 2.1, whose thrust leaves no more; see `rig_settings`
            object_mass=(0.015, 0.02),
            mass_known=False,
            noise=(0.0, 0.5),
            delay=(0.0, 0.05),
            estimator_drift=(0.0, 3.0),
            quantize=True,
            leader_uses_measurements=True,
            gust=(0.0, 0.01),
            rotor_lag_scale=(0.6, 2.0),
            thrust_scale=(0.9, 1.1),
            thrust_common=(0.95, 1.05),
            battery=(3.2, 4.2),
            uncompensated_share=0.5,
            inertia_scale=(0.6, 1.4),
            cg_random_visits=0.3,
            termination_distance=1.5,
        ),
        reward=Reward(error_scale=0.02, velocity=8.0, steady_action=0.2),
        bounds=Bounds(x_peak=0.05, settling_time=0.0, rmse=0.2),
        sac=replace(LARGE_SAC, discount=0.985),
    )
