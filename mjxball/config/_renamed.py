"""Names that settings had in earlier versions. Files and command lines that use them keep their meaning."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mjxball.errors import InputError

# Old dotted path -> new one. Old flags are accepted and hidden in --help.
RENAMED = {
    "plant.leader_mass": "plant.drones.0.mass",
    "plant.leader_inertia": "plant.drones.0.inertia",
    "plant.leader_mount": "plant.drones.0.mount",
    "plant.follower_mass": "plant.drones.1.mass",
    "plant.follower_inertia": "plant.drones.1.inertia",
    "plant.follower_mount": "plant.drones.1.mount",
    "sac.steps": "sac.total_steps",
    "sac.worlds": "sac.num_envs",
    "sac.batch": "sac.batch_size",
    "sac.updates": "sac.updates_per_step",
    "sac.prefill": "sac.warmup_steps",
    "sac.replay": "sac.replay_size",
    "sac.privileged": "follower.privileged_critic",
    "sac.privileged_critic": "follower.privileged_critic",
    "sac.critics": "sac.num_critics",
    "sac.return_steps": "sac.n_step",
    "sac.target_rate": "sac.tau",
    "sac.evaluations": "sac.num_evaluations",
    "scenario.goal_reach": "scenario.goal_range",
    "scenario.wander": "scenario.estimator_drift",
    "scenario.wire": "scenario.quantize",
    "scenario.cg_visits": "scenario.cg_waypoint_probability",
    "scenario.cg_random_visits": "scenario.cg_waypoint_probability",
    "scenario.leader_measured": "scenario.leader_uses_measurements",
    "scenario.older_firmware": "scenario.uncompensated_probability",
    "scenario.uncompensated_share": "scenario.uncompensated_probability",
    "scenario.thrust_common": "scenario.thrust_scale_common",
    "leader.tilt_limit": "command.tilt_limit",
    "leader.vertical_limit": "command.vertical_limit",
    "follower.tilt_limit": "follower.action_scale_tilt",
    "follower.vertical_limit": "follower.action_scale_vertical",
    "follower.filters": "follower.observation_averages",
    "scenario.unknown_share": "scenario.unknown_mass_probability",
    "follower.shares_integrals": "follower.residual_on_pid",
    "leader.level_gain": "leader.tilt_integral_gain",
    "leader.integral_band": "leader.integral_error_limit",
    "leader.integral_lead": "leader.integral_lead_time",
    "autopilot.follower_integrals": "autopilot.follower_ki_scale",
    "sac.learning_rate_end": "sac.learning_rate_final_ratio",
    "gradient.learning_rate_end": "gradient.learning_rate_final_ratio",
    "gradient.damping": "gradient.gradient_decay",
    "reward.standing": "reward.steady_action",
    "reward.opposition": "reward.tilt_disagreement",
}
# Former settings that are constants now, with their value. Files may hold no other.
CONSTANT: dict[str, Any] = {
    "motion.rolling_friction": 0.005,
    "motion.stop_frequency": 60.0,
    "motion.stop_damping": 0.4,
    "autopilot.attitude_limits": (20.0, 20.0, 360.0),
    "autopilot.rate_limits": (33.3, 33.3, 166.7),
    "scenario.mass_change_time": (5.0, 15.0),
    "sac.policy_delay": 1,
    "sac.gradient_clip": 0.0,
    "sac.max_grad_norm": 0.0,
    "sac.curriculum": 0.0,
    "sac.alpha_learning_rate": 1e-3,
    "sac.policy_ema_rate": 0.002,
    "sac.policy_average": 0.002,
    "ppo.curriculum": 0.0,
    "ppo.unrolls": 1,
    "ppo.epochs": 8,
    "ppo.activation": "relu",
    "ppo.value_layers": (64, 64),
    "ppo.learning_rate_final_ratio": 0.02,
    "ppo.learning_rate_end": 0.02,
    "ppo.gae_lambda": 0.95,
    "ppo.clipping": 0.2,
    "ppo.reward_scale": 0.02,
    "ppo.max_grad_norm": 1.0,
    "gradient.max_grad_norm": 1.0,
    "autopilot.sag": 0.0,
    "scenario.cg_lissajous_probability": 0.3,
    "scenario.relay_probability": 0.0,
    "scenario.relay_rate": (5.0, 10.0),
    "scenario.relay_loss": (0.0, 0.0),
    "gradient.until_termination": False,
    "gradient.impulse_response_from": 0.75,
    "follower.base": "pd",
    "follower.history": 1,
    "follower.washout_time": 8.0,
    "follower.washout": 8.0,
    "follower.differential_thrust_share": 0.0,
    "follower.load_by_lift": 0.0,
    "rigs.drone_mass": (0.03, 3.0),
    "rigs.arm_scale": (0.8, 1.25),
    "rigs.inertia_scale": (0.7, 1.4),
    "rigs.spacing": (2.3, 4.5),
    "rigs.mount_jitter": 0.1,
    "rigs.yaw_per_thrust": (0.1, 0.25),
    "rigs.thrust_to_weight": (1.6, 4.0),
    "rigs.rotor_lag": (0.015, 0.15),
    "rigs.carrier_share": (0.02, 0.1),
    "rigs.object_share": (0.05, 0.6),
    "rigs.believed_factor": 2.0,
    "rigs.thrust_scale": (0.8, 1.2),
    "rigs.thrust_fade": (0.0, 0.002),
    "rigs.fade": (0.0, 0.002),
    "rigs.loop_frequency": (4.0, 20.0),
    "rigs.loop_damping": (0.5, 1.1),
    "rigs.unsaturated_tilt": 0.15,
    "rigs.authority": 0.15,
    "rigs.least_damping": 0.3,
}
# Of these, those that count for nothing where another setting is 0 or off: there files hold any value.
SWITCH = {
    "follower.washout_time": "follower.residual_on_pid",
    "follower.washout": "follower.residual_on_pid",
    "scenario.cg_lissajous_probability": "scenario.cg_width",
    "gradient.impulse_response_from": "gradient.impulse_response",
    **{path: "rigs.number" for path in CONSTANT if path.startswith("rigs.")},
}
# Settings of several numbers that were one number before.
ONCE_ONE = ("gradient.windows_per_episode",)


def current_name(path: str) -> str:
    """The present name of the setting at the dotted `path`."""
    return RENAMED.get(path, path)


def old_names(path: str) -> list[str]:
    """Earlier names of the setting at the dotted `path`."""
    return [old for old, new in RENAMED.items() if new == path]


def with_current_names(data: Any) -> Any:
    """Nested settings as a file holds them, {part: {name: value}}, with present names; anything else as it is.

    Raises InputError if a setting stands there under two names, or a constant with another value.
    """
    if not isinstance(data, dict):
        return data
    found = {part: dict(values) if isinstance(values, dict) else values for part, values in data.items()}
    plant = found.get("plant")
    if isinstance(plant, dict) and isinstance(plant.get("drones"), (list, tuple)):
        plant["drones"] = [dict(drone) if isinstance(drone, dict) else drone for drone in plant["drones"]]
    for path in ONCE_ONE:
        part, _, name = path.partition(".")
        if isinstance(found.get(part), dict) and type(found[part].get(name)) is int:
            found[part][name] = [found[part][name]]
    for old in (*RENAMED, *CONSTANT):
        part, _, name = old.partition(".")
        if not isinstance(found.get(part), dict) or name not in found[part]:
            continue
        value = found[part].pop(name)
        if old in CONSTANT:
            if old not in SWITCH or _is_on(found, SWITCH[old]):
                check_constant(old, value)
            continue
        *way, new_name = RENAMED[old].split(".")
        place = _place(found, way)
        if not isinstance(place, dict):
            raise InputError(f"configuration has no place for {RENAMED[old]}, which stands there as {old}")
        if new_name in place:
            raise InputError(f"{RENAMED[old]} is given twice, also under its old name {old}")
        place[new_name] = value
    return found


def _is_on(data: dict[str, Any], path: str) -> bool:
    """Whether the nested `data` have a setting at `path` that is neither 0 nor off."""
    part, _, name = path.partition(".")
    value = data[part].get(name) if isinstance(data.get(part), dict) else None
    return any(value) if isinstance(value, (list, tuple)) else bool(value)


def _place(data: Any, way: Sequence[str]) -> Any:
    """What stands in nested `data` at the end of `way`; made if it is missing, None if something else is there."""
    for step, after in zip(way, (*way[1:], ""), strict=True):
        if isinstance(data, dict):
            data = data.setdefault(step, [] if after.isdecimal() else {})
        elif isinstance(data, list) and step.isdecimal():
            data += [{} for _ in range(int(step) + 1 - len(data))]
            data = data[int(step)]
        else:
            return None
    return data


def check_constant(path: str, value: Any) -> None:
    """Raise InputError unless `value` is what the former setting at `path` is fixed to."""
    wanted = CONSTANT[path]
    value = tuple(value) if isinstance(value, list) else value
    if value != wanted:
        where = f" where {SWITCH[path]} is not 0" if path in SWITCH else ""
        raise InputError(f"{path} is no setting any more: it is {wanted!r}{where}, and cannot be {value!r}")
