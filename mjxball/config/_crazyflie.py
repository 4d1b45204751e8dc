"""Two Crazyflies on a stick with a ball: presets `stand` and `flight`. Their rig is `config/plants/crazyflie.toml`."""

from __future__ import annotations

from dataclasses import replace

from mjxball.config._common import DISTURBED, LARGE_SAC, RECURRENT, RECURRENT_GRADIENT
from mjxball.config._plant_file import read_plant
from mjxball.config._scenario import ScenarioRanges
from mjxball.config._settings import Bounds, Command, Config, Follower, Leader, Reward, Timing
from mjxball.config._tree import apply_overrides

PAIR = replace(
    apply_overrides(Config(), read_plant("crazyflie").settings),
    timing=Timing(control_period=0.01, physics_steps=5, episode_steps=1500),
    # Stiff in height, with an integral, so that the leader's thrust fits its share of the weight: a difference of lift
    # acts over half the stick, and beyond 4 % of hover thrust the rotors of one drone cannot hold it about roll.
    leader=Leader(
        kp=(1.0, 1.0, 2.5),
        kd=(1.6, 1.6, 3.5),
        ki=(0.2, 0.2, 1.5),
        integral_error_limit=(0.1, 0.1, 0.3),
        integral_lead_time=1.0,
    ),
    command=Command(tilt_limit=0.26, vertical_limit=6.0),
)


def stand() -> Config:
    """The paper's experiment: roll and height free, pitch locked, a rolling ball, the paper's gains and thrust."""
    return replace(
        apply_overrides(PAIR, read_plant("stand").settings),
        preset="stand",
        leader=Leader(
            kp=(1.0, 1.0, 0.1),
            kd=(2.0, 2.0, 5.0),
            ki=(0.2, 0.1, 0.1),
            error="own",
        ),
        command=Command(tilt_limit=0.26, vertical_limit=3.0),
        follower=Follower(
            action="residual",
            action_scale_tilt=0.2,
            action_scale_vertical=3.0,
            observation_averages=(0.05, 0.2, 1.0),
            ignore_position=True,
            privileged_critic=True,
        ),
        scenario=ScenarioRanges(
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
            thrust_scale_common=(0.99, 1.01),
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
    """The disturbed pair in free flight with a moving ball, the paper's future work."""
    return replace(
        PAIR,
        preset="flight",
        # About the other axis the leader's integral would compensate for the follower, until motors are at their limit.
        follower=replace(
            RECURRENT,
            recurrent_units=56,
            stale=True,
            load_axis_only=True,
            action_scale_tilt=0.2,
            action_scale_vertical=1.5,
            privileged_critic=True,
        ),
        scenario=replace(
            ScenarioRanges(**DISTURBED),
            goal_range=0.5,
            start_velocity=0.1,
            start_tilt=0.05,
            cg_speed=(0.2, 1.6),
            cg_amplitude=(0.0, 0.02),  # the Crazyflie 2.1 has no thrust for more; see `plants/`
            object_mass=(0.015, 0.02),
            mass_known=False,
            delay=(0.0, 0.07),
            estimator_drift=(0.5, 2.0),
            quantize=True,
            leader_uses_measurements=True,
            rotor_drag=(0.25, 0.45),
            wind=(0.0, 0.3),
            gust=(0.0, 0.01),
            floor_clearance=(0.02, 1.0),
            rotor_lag_scale=(0.7, 1.6),
            thrust_scale=(0.93, 1.07),
            thrust_scale_common=(0.95, 1.05),
            thrust_fade=(0.0, 0.002),
            battery=(3.2, 4.2),
            uncompensated_probability=0.2,
            inertia_scale=(0.8, 1.25),
            cg_waypoint_probability=0.3,
            calm_probability=0.4,
            termination_distance=1.5,
        ),
        bounds=Bounds(x_peak=0.05, settling_time=0.0, rmse=0.2),
        # Without a cost of effort the leader's integral and the network push against each other after minutes.
        reward=Reward(
            error=0.25,
            error_scale=0.006,
            velocity=8.0,
            effort=0.1,
            smoothness=0.2,
            command_change=40.0,
            rotor_limits=20.0,
        ),
        sac=replace(LARGE_SAC, discount=0.985),
        # For a GPU.
        gradient=replace(
            RECURRENT_GRADIENT,
            gradient_steps=2000,
            num_envs=1024,
            policy_layers=(48,),
            horizon=300,
            windows_per_episode=(3, 8, 30),
            learning_rate_final_ratio=0.01,
            gradient_decay=0.996,
            estimation=0.3,
            exchanged_memory=0.25,
        ),
    )
