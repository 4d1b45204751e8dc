"""The named presets."""

from __future__ import annotations

import types
from dataclasses import replace

from mjxball.config._common import DISTURBED, LARGE_SAC, RECURRENT, RECURRENT_GRADIENT
from mjxball.config._crazyflie import flight, stand
from mjxball.config._learning import Gradient, Ppo, Sac
from mjxball.config._plant_file import read_plant
from mjxball.config._scenario import Rigs, ScenarioRanges
from mjxball.config._settings import Attitude, Bounds, Command, Config, Follower, Reward
from mjxball.config._tree import apply_overrides
from mjxball.errors import InputError


def _paper() -> Config:
    return Config(
        preset="paper",
        follower=Follower(action="direct", action_scale_tilt=0.6, action_scale_vertical=6.0, ignore_position=False),
        reward=Reward(kind="paper", termination=0.0),
        # The reward is for the leader's command, under which the object sways by 0.30 m and does not settle.
        bounds=Bounds(x_peak=0.36, settling_time=0.0, rmse=0.55, action_error=0.02),
        sac=Sac(
            total_steps=1_000_000,
            num_envs=16,
            replay_size=1_000_000,
            batch_size=256,
            updates_per_step=8,
            warmup_steps=10_000,
            policy_layers=(256, 256),
            critic_layers=(256, 256),
            learning_rate=3e-4,
            learning_rate_final_ratio=1.0,
            discount=0.99,
            tau=0.005,
            alpha=0.3,
            alpha_fixed=True,
            num_critics=1,
            state_value=True,
            num_evaluations=10,
        ),
    )


def _transport() -> Config:
    return Config(
        preset="transport",
        scenario=ScenarioRanges(
            cg_speed=(0.2, 3.2),
            cg_amplitude=(0.0, 0.10),
            object_mass=(0.1, 0.3),
            start_velocity=0.2,
            start_tilt=0.05,
        ),
        reward=Reward(error_scale=0.05),
        # The loss has little noise: with less momentum two thirds of the steps suffice.
        gradient=Gradient(gradient_steps=80, learning_rate=2.5e-2, adam_betas=(0.7, 0.99)),
        sac=Sac(
            total_steps=768_000,
            num_envs=512,
            replay_size=768_000,
            updates_per_step=8,
            discount=0.97,
            n_step=5,
            learning_rate=4e-3,
            learning_rate_final_ratio=0.02,
            tau=0.03,
            num_evaluations=2,
        ),
    )


def _large() -> Config:
    """Common to larger trainings: all loads that one drone can trim, with little noise and delay."""
    return Config(
        follower=Follower(action_scale_tilt=0.3, observation_averages=(0.05, 0.2), privileged_critic=True),
        scenario=ScenarioRanges(
            cg_speed=(0.2, 3.2),
            cg_amplitude=(0.0, 0.17),
            object_mass=(0.1, 0.6),
            start_velocity=0.2,
            start_tilt=0.05,
            # Without noise the command chatters between its limits.
            noise=(0.0, 1.0),
            delay=(0.0, 0.04),
            rotor_lag_scale=(0.7, 1.4),
        ),
        bounds=Bounds(x_peak=0.015, settling_time=2.8, rmse=0.345),
        # The weight of speed prevents overshoot, that of changes of the command keeps noise from the rotors.
        reward=Reward(error_scale=0.02, velocity=6.0, smoothness=1.5),
        sac=replace(LARGE_SAC, total_steps=2_048_000, discount=0.97, n_step=5, learning_rate=3e-3),
    )


def _balance() -> Config:
    """One follower for known and unknown loads: a recurrent network trained by first-order gradients."""
    large = _large()
    return replace(
        large,
        preset="balance",
        follower=replace(
            RECURRENT,
            recurrent_units=96,
            stale=True,
            action_scale_tilt=0.4,
            action_scale_vertical=4.0,
            privileged_critic=True,
        ),
        scenario=replace(
            large.scenario,
            **DISTURBED,
            # Faster loads than documented, and loads beyond what one drone trims, as a margin.
            cg_speed=(0.2, 3.5),
            trim_margin=-0.15,
            unknown_mass_probability=0.4,
            unknown_mass=(0.1, 0.4),
            # Beyond the ranges of mjxball-bench, so that its own are no ends.
            attitude_frequency=(6.0, 24.0),
            rotor_lag_scale=(0.7, 1.5),
            inertia_scale=(0.8, 1.2),
            cg_waypoint_probability=0.3,
            goal_motion_probability=0.25,
        ),
        bounds=Bounds(x_peak=0.005, settling_time=2.2, rmse=0.335),
        # With this weight of speed no seed overshoots by the 2 % that count as settled.
        reward=replace(
            large.reward,
            error=0.25,
            error_scale=0.004,
            velocity=12.0,
            smoothness=0.2,
            command_change=40.0,
            rotor_limits=20.0,
        ),
        # With batches of 1024 transitions and four times as many updates commands chatter.
        sac=replace(
            large.sac,
            total_steps=6_144_000,
            batch_size=8192,
            updates_per_step=4,
            replay_size=1_024_000,
            learning_rate=2e-3,
            policy_layers=(64,),
            critic_layers=(256, 256),
            critic_layer_norm=True,
        ),
        gradient=replace(
            RECURRENT_GRADIENT,
            gradient_steps=2300,
            num_envs=512,
            policy_layers=(64,),
            horizon=200,
            windows_per_episode=(3, 8),
            gradient_decay=0.98,
            estimation=0.3,
        ),
    )


def _quick() -> Config:
    """A first follower in two minutes on two cores: a disturbed pair, nominal but for sensors, air and mass."""
    balance = _balance()
    return replace(
        balance,
        preset="quick",
        follower=replace(balance.follower, recurrent_units=32),
        scenario=replace(
            balance.scenario,
            calm_probability=0.5,
            unknown_mass_probability=0.0,
            goal_motion_probability=0.0,
            cg_waypoint_probability=0.0,
        ),
        gradient=replace(
            balance.gradient,
            gradient_steps=1800,
            num_envs=32,
            policy_layers=(32,),
            horizon=150,
            windows_per_episode=(3, 6),
            num_evaluations=4,
        ),
    )


TEAM_GRADIENT = replace(RECURRENT_GRADIENT, policy_layers=(48,), horizon=150)


def _team() -> Config:
    """Two to six drones on a ring with one policy for all followers; the load moves in the plane."""
    large = _large()
    return replace(
        apply_overrides(large, read_plant("team6").settings),
        preset="team",
        follower=replace(RECURRENT, action_scale_tilt=0.4, action_scale_vertical=4.0),
        scenario=replace(
            large.scenario,
            team_sizes=(2, 3, 4, 6),
            cg_amplitude=(0.0, 0.3),
            cg_width=(0.0, 1.0),
            cg_waypoint_probability=0.2,
            object_mass=(0.3, 0.9),
            drone_mass_scale=(0.9, 1.1),
            drone_inertia_scale=(0.8, 1.2),
            mount_scale=(0.9, 1.1),
            arm_scale=(0.9, 1.1),
            yaw_per_thrust_scale=(0.8, 1.2),
            rotor_force_scale=(0.9, 1.1),
            carrier_scale=(0.5, 1.5),
            attitude_gain_scale=(0.9, 1.1),
            thrust_scale=(0.95, 1.05),
        ),
        bounds=Bounds(x_peak=0.05, settling_time=0.0, rmse=0.36),
        reward=replace(
            large.reward,
            error=0.25,
            error_scale=0.004,
            velocity=10.5,
            smoothness=0.1,
            command_change=15.0,
            spread=30.0,
            tilt=30.0,
        ),
        sac=replace(large.sac, num_envs=528, replay_size=528_000),
        ppo=Ppo(num_envs=528),
        gradient=TEAM_GRADIENT,
    )


def _universal() -> Config:
    """One follower for disturbed teams of any drones and loads, which knows only where drones are mounted."""
    large = _large()
    team = apply_overrides(large, read_plant("team6").settings)
    return replace(
        team,
        preset="universal",
        plant=replace(team.plant, rotor_lag=0.04),
        # In the middle of the range of random rigs.
        attitude=Attitude(natural_frequency=(7.0, 7.0, 3.0), damping=0.8, design_object_mass=0.4),
        command=Command(tilt_limit=0.6, vertical_limit=8.0),
        follower=replace(RECURRENT, recurrent_units=96, stale=True, action_scale_tilt=0.6, action_scale_vertical=8.0),
        scenario=replace(
            large.scenario,
            **DISTURBED,
            team_sizes=(2, 3, 4, 5, 6),
            cg_speed=(0.1, 4.0),
            cg_amplitude=(0.0, 0.2),
            cg_width=(0.0, 1.0),
            cg_waypoint_probability=0.3,
            goal_motion_probability=0.15,
            rotor_lag_scale=(1.0, 1.0),
            mass_known=False,
        ),
        rigs=Rigs(number=4096, mass_step=0.3),
        bounds=Bounds(x_peak=0.02, settling_time=4.0, rmse=0.4),
        reward=replace(_team().reward, rates=0.5, command_change=40.0, rotor_limits=20.0),
        sac=replace(large.sac, num_envs=600, replay_size=600_000),
        ppo=Ppo(num_envs=600),
        # For a GPU. Short flights alone let followers drift against each other, long ones alone let them settle late.
        gradient=replace(
            TEAM_GRADIENT,
            policy_layers=(64,),
            num_envs=3300,
            gradient_steps=2300,
            windows_per_episode=(3, 12),
            learning_rate_final_ratio=0.01,
            gradient_decay=0.985,
            exchanged_memory=0.25,
        ),
    )


def _lost() -> Config:
    """One follower for disturbed rings of three to six drones, of which any one may stop."""
    universal = _universal()
    return replace(
        universal,
        preset="lost",
        scenario=replace(
            universal.scenario,
            team_sizes=(3, 4, 5, 6),
            object_mass=(0.3, 0.9),
            goal_motion_probability=0.0,
            lost_follower_probability=0.3,
            lost_leader_probability=0.1,
        ),
        rigs=Rigs(),
        sac=replace(universal.sac, num_envs=560, replay_size=560_000),
        ppo=Ppo(num_envs=560),
        # For two cores, from the weights of `universal`.
        gradient=replace(universal.gradient, num_envs=112, gradient_steps=1900, learning_rate=3e-3),
    )


PRESETS: types.MappingProxyType[str, Config] = types.MappingProxyType(
    {
        made.preset: made
        for made in (_quick(), _transport(), _paper(), _balance(), _team(), _universal(), _lost(), stand(), flight())
    }
)
PRESETS_ABOUT = {
    "quick": "a pair, in two minutes on two cores",
    "transport": "a pair by SAC, with exact sensors",
    "paper": "the paper's reward and SAC",
    "balance": "the best for a pair; wants a GPU",
    "team": "rings of two to six drones",
    "universal": "any team, rig and load; wants a GPU",
    "lost": "rings of which a drone may stop",
    "stand": "two Crazyflies on the test stand",
    "flight": "two Crazyflies in free flight",
}


def algorithm_of(name: str) -> str:
    """The algorithm that trains the preset `name` unless another one is asked for."""
    return "gradient" if name in ("quick", "balance", "team", "universal", "lost", "flight") else "sac"


def preset(name: str) -> Config:
    """The preset `name`; InputError for an unknown one."""
    if name not in PRESETS:
        raise InputError(f"unknown preset {name!r}; choose from {', '.join(PRESETS)}")
    return PRESETS[name]
