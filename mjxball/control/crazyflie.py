"""A Crazyflie's firmware controller: setpoint, cascade of attitude and rate PIDs, mixing, motor curve. NumPy and JAX.

Written from what the firmware does (bitcraze/crazyflie-firmware 2026.08), in its units: degrees, degrees a second,
motor commands 0 .. 65535. Its pitch, pitch rate and yaw output have the opposite sign of ours. The state of one drone's
loops is one array, so that batches of flights and drones are stepped at once.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from mjxball.arrays import Array, clipped, joined
from mjxball.config import Autopilot

PERIOD = 0.002  # [s] of the attitude and rate loops: 500 Hz
FULL = 65535.0  # motor command of full power
THRUST_FLOOR, THRUST_CEILING = 10001, 60000  # range that the laptop sends in flight; the firmware caps at the ceiling
IDLE = 1000.0  # thrust below which the firmware stops the motors
TILT_LIMIT = 15.0  # of every roll and pitch setpoint [deg]
ATTITUDE_LIMITS = (20.0, 20.0, 360.0)  # of the attitude integrals of roll, pitch, yaw [deg s]
RATE_LIMITS = (33.3, 33.3, 166.7)  # of the rate integrals [deg]
OUTPUT_LIMIT = 32767.0  # of a rate loop's output
SIGNS = (1.0, -1.0, 1.0)  # ours -> firmware's roll, pitch, yaw
TO_FIRMWARE = tuple(sign * 180.0 / math.pi for sign in SIGNS)  # ours [rad] -> firmware's [deg]
# "pid_attitude.roll_kp" -> (field of `Autopilot`, place in it)
PARAMETERS: dict[str, tuple[str, int]] = {
    f"{group}.{axis}_{gain}": (f"{axis}{suffix}", place)
    for group, suffix in (("pid_attitude", ""), ("pid_rate", "_rate"))
    for axis in ("roll", "pitch", "yaw")
    for place, gain in enumerate(("kp", "ki", "kd"))
}
STOCK = Autopilot()  # the delivered gains
PAIR = ("leader", "follower")

Gains = dict[str, float]  # parameter name -> value
PairGains = tuple[Gains, Gains]  # leader, follower


class Loops(NamedTuple):
    """State of one drone's cascade, firmware axes; the array's last axis holds these fields in order."""

    attitude_integral: Array  # (..., 3) [deg s]
    rate_integral: Array  # (..., 3) [deg]
    attitude: Array  # (..., 3) as last measured [deg]
    rates: Array  # (..., 3) as last measured [deg/s]
    yaw: Array  # (..., 1) to hold [deg]


def unpack(loops: Array) -> Loops:
    """Split `loops` (..., 13) into named parts."""
    parts = (loops[..., 0:3], loops[..., 3:6], loops[..., 6:9], loops[..., 9:12], loops[..., 12:13])
    return Loops(*parts)


def start_loops(euler: Array, rates: Array) -> Array:
    """Loops (..., 13) after a reset: integrals 0, the present yaw is held. `euler` [rad], `rates` [rad/s]."""
    xp = euler.__array_namespace__()
    attitude, turning = to_firmware(euler), to_firmware(rates)
    return xp.concat([xp.zeros_like(euler), xp.zeros_like(euler), attitude, turning, attitude[..., 2:]], axis=-1)


def to_firmware(angles: Array) -> Array:
    """`angles` (..., 3) [rad] or [rad/s] in the firmware's axes and degrees."""
    xp = angles.__array_namespace__()
    return angles * xp.asarray(TO_FIRMWARE, dtype=angles.dtype)


def motor_force(curve: tuple[float, float], command: Array) -> Array:
    """Force (...) [N] of a motor at `command` (...) 0 .. 65535: a p^2 + b p of p = command / 65535."""
    p = command / FULL
    return (curve[0] * p + curve[1]) * p


def motor_command(curve: tuple[float, float], force: Array) -> Array:
    """Command (...) at which a motor gives `force` (...) [N]; the inverse of `motor_force`, not bounded above."""
    xp = force.__array_namespace__()
    a, b = curve
    force = xp.maximum(force, xp.zeros_like(force))
    return FULL * (force / b if a == 0 else (xp.sqrt(b * b + 4 * a * force) - b) / (2 * a))


def setpoints(autopilot: Autopilot, command: Array, carried_mass: Array, gravity: float) -> Array:
    """Setpoints (..., 4) as sent: roll, pitch [deg], yaw rate [deg/s], thrust, in the firmware's signs.

    `command` (..., 3) is roll, pitch [rad] and vertical acceleration [m/s2]. Thrust is the paper's, thr_hov + k_pz az,
    or calibrated: the motor curve at T = m (g + az) / (cos roll cos pitch), `carried_mass` m (...) [kg].
    """
    xp = command.__array_namespace__()
    limit = math.radians(TILT_LIMIT)
    roll, pitch = (clipped(command[..., i], -limit, limit) for i in (0, 1))
    vertical = command[..., 2]
    if autopilot.thrust_law == "paper":
        thrust = autopilot.hover_thrust + autopilot.thrust_per_acceleration * vertical
    else:
        force = carried_mass * (gravity + vertical) / (xp.cos(roll) * xp.cos(pitch))
        thrust = motor_command(autopilot.motor_curve, force / 4)
    thrust = _whole(clipped(thrust, THRUST_FLOOR, THRUST_CEILING), xp.round)
    return joined([xp.rad2deg(roll), -xp.rad2deg(pitch), xp.zeros_like(roll), thrust])


def cascade(
    autopilot: Autopilot,
    loops: Array,
    setpoint: Array,
    euler: Array,
    rates: Array,
    integrals: Array | None = None,
    compensate: Callable[[Array], Array] | None = None,
    rate_share: Array | None = None,
) -> tuple[Array, Array]:
    """(loops (..., 13), motor commands (..., 4)) after one tick of 2 ms.

    `setpoint` (..., 4) is that of `setpoints`; `euler` (..., 3) [rad] and body `rates` (..., 3) [rad/s] are measured.
    Optional: `integrals` (..., 1), a factor on every ki; `compensate`, which turns thrust commands into PWM
    (`motors.compensated`) before they are capped; `rate_share` (..., 1), a factor on all pid_rate gains. Without thrust
    the motors stop and the loops are reset.
    """
    xp = euler.__array_namespace__()
    old, attitude, turning = unpack(loops), to_firmware(euler), to_firmware(rates)
    # The sent yaw rate has the opposite sign; the firmware integrates it into a yaw angle.
    yaw = _wrapped(old.yaw - PERIOD * setpoint[..., 2:3])
    desired = xp.concat([setpoint[..., :2], yaw], axis=-1)
    outer = (autopilot.roll, autopilot.pitch, autopilot.yaw)
    inner = (autopilot.roll_rate, autopilot.pitch_rate, autopilot.yaw_rate)
    errors = desired - attitude
    error = xp.concat([errors[..., :2], _wrapped(errors[..., 2:])], axis=-1)
    moved = attitude - old.attitude
    moved = xp.concat([moved[..., :2], _wrapped(moved[..., 2:])], axis=-1)
    attitude_integral, asked = _pid(outer, ATTITUDE_LIMITS, old.attitude_integral, error, moved, integrals)
    rate_error = asked - turning
    rate_integral, output = _pid(inner, RATE_LIMITS, old.rate_integral, rate_error, turning - old.rates, integrals)
    output = output if rate_share is None else rate_share * output
    output = _whole(clipped(output, -OUTPUT_LIMIT, OUTPUT_LIMIT), xp.trunc)
    thrust = setpoint[..., 3]
    on = (thrust >= IDLE)[..., None]
    motors = mix(xp.minimum(thrust, float(THRUST_CEILING)), output, compensate)
    after = xp.concat([attitude_integral, rate_integral, attitude, turning, yaw], axis=-1)
    if isinstance(on, np.ndarray) and on.all():
        return after, motors
    return xp.where(on, after, start_loops(euler, rates)), xp.where(on, motors, 0.0)


def integral_shares(xp: Any, autopilot: Autopilot, dtype: Any, drones: int = 2, leader: int = 0) -> Array:
    """Factors (N, 1) on every drone's ki: 1 for the leader, `follower_ki_scale` for the others."""
    shares = [[1.0 if number == leader else autopilot.follower_ki_scale] for number in range(drones)]
    return xp.asarray(shares, dtype=dtype)


def mix(thrust: Array, output: Array, compensate: Callable[[Array], Array] | None = None) -> Array:
    """Motor commands (..., 4) of `thrust` (...) and the rate loops' `output` (..., 3); `compensate` as for `cascade`.

    M1 front right, M2 back right, M3 back left, M4 front left. The excess over full power is taken off all four.
    """
    xp = thrust.__array_namespace__()
    roll, pitch = _whole(output[..., 0] / 2, xp.trunc), _whole(output[..., 1] / 2, xp.trunc)
    yaw = -output[..., 2]
    motors = xp.stack(
        [
            thrust - roll + pitch + yaw,
            thrust - roll - pitch - yaw,
            thrust + roll - pitch + yaw,
            thrust + roll + pitch - yaw,
        ],
        axis=-1,
    )
    if compensate is not None:
        motors = compensate(motors)
    excess = xp.maximum(xp.max(motors, axis=-1, keepdims=True) - FULL, 0.0)
    return clipped(motors - excess, 0.0, FULL)


def _pid(
    gains: tuple[Any, Any, Any],
    limits: tuple[float, float, float],
    integral: Array,
    error: Array,
    moved: Array,
    share: Array | None,
) -> tuple[Array, Array]:
    """(integral, output) (..., 3) of three PIDs with derivative on the measurement, which changed by `moved` [deg]."""
    xp = error.__array_namespace__()
    kp, ki, kd = (xp.asarray(column, dtype=error.dtype) for column in zip(*gains, strict=True))
    bound = xp.asarray(limits, dtype=error.dtype)
    ki = ki if share is None else ki * share
    integral = clipped(integral + PERIOD * error, -bound, bound)
    return integral, kp * error + ki * integral - kd / PERIOD * moved


def _whole(value: Array, rounded: Callable[[Array], Array]) -> Array:
    """`rounded(value)` (...) with the gradient of `value` (straight through), because that of rounding is 0.

    The rounding error is exact in floating point. It is cast through integers, which stops its gradient.
    """
    whole = rounded(value)
    if isinstance(value, np.ndarray | np.generic):
        return whole
    cut = whole - value
    return value + cut.view(f"int{8 * cut.dtype.itemsize}").view(cut.dtype)


def _wrapped(angle: Array) -> Array:
    """`angle` (...) [deg] within +-180."""
    xp = angle.__array_namespace__()
    return angle - 360.0 * xp.round(angle / 360.0)


def gains_of(autopilot: Autopilot) -> Gains:
    """Firmware parameters of the leader, whose cascade is that of `autopilot`."""
    return {name: getattr(autopilot, field)[place] for name, (field, place) in PARAMETERS.items()}


def pair_gains(autopilot: Autopilot) -> PairGains:
    """Firmware parameters of leader and follower; the follower's ki are scaled by `autopilot.follower_ki_scale`."""
    leader = gains_of(autopilot)
    share = autopilot.follower_ki_scale
    return leader, {name: value * share if name.endswith("_ki") else value for name, value in leader.items()}


def read_pair_gains(data: Any) -> PairGains:
    """Gains from JSON: `{"leader": {name: value}, "follower": {name: value}}`, or `{name: value}` for both.

    Raises ValueError for anything else.
    """
    if isinstance(data, dict) and data.keys() == set(PAIR):
        return _checked_gains(data[PAIR[0]]), _checked_gains(data[PAIR[1]])
    return _checked_gains(data), _checked_gains(data)


def gains_to_json(gains: PairGains) -> dict[str, Gains]:
    """JSON object of `gains` for `read_pair_gains`."""
    return dict(zip(PAIR, gains, strict=True))


def _checked_gains(data: Any) -> Gains:
    valid = isinstance(data, dict) and all(
        name.count(".") == 1 and type(value) in (int, float) and math.isfinite(value) for name, value in data.items()
    )
    if not valid:
        raise ValueError("parameter names with finite numbers")
    return {name: float(value) for name, value in data.items()}


def with_gains(autopilot: Autopilot, gains: Gains) -> Autopilot:
    """`autopilot` with `gains`, whose names must be those of `PARAMETERS`."""
    changed: dict[str, Any] = {}
    for name, value in gains.items():
        field, place = PARAMETERS[name]
        values = list(changed.get(field, getattr(autopilot, field)))
        values[place] = float(value)
        changed[field] = tuple(values)
    return dataclasses.replace(autopilot, **changed)


def with_stock_gains(autopilot: Autopilot) -> Autopilot:
    """`autopilot` with the gains of a newly flashed firmware."""
    return with_gains(autopilot, gains_of(STOCK))
