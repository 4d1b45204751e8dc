"""LQG for the paper's pair: the follower takes over the loop by LQR and a Kalman filter for the CG's torque (ours).

The pair follows the sum of both drones' commands. The follower therefore commands twice what the pair should do, less
the leader's command, which it computes from its own observation.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.linalg import expm, solve_continuous_are, solve_discrete_are

from mjxball.baselines.load_axis import LoadAxis, pitch_axis
from mjxball.config import Config
from mjxball.control.followers import PrivilegedInfo, copy_gains
from mjxball.control.observation import ERROR, ERROR_RATE, copy_command

Array = Any
TILT, VERTICAL = 0.15, 1.0  # [rad], [m/s2] that cost 1
VERTICAL_LIMIT = 2.0  # of the position and velocity part [m/s2]
CORRECTION_LIMIT = 0.6  # of pitch against the CG's torque [rad]
LIMITS = (0.6, 1.0, 6.0)  # of roll, pitch [rad] and vertical acceleration [m/s2]
THETA_NOISE, RATE_NOISE = 2e-3, 2e-2  # deviations of a measurement [rad], [rad/s]


class Tuning(NamedTuple):
    """What is chosen of `lqg`."""

    position: float = 0.25  # that costs 1 [m]
    velocity: float = 1.0  # that costs 1 [m/s]
    torque_walk: float = 9.0  # intensity of the white noise that drives d' [(N m/s)2 s]
    tilt_limit: float = 0.25  # of the position and velocity part [rad]


# The default reproduces an independent simulation; with delayed commands it limit-cycles. SLOW settles earliest under
# noise and 40 ms of delay among the sets in `benchmarks/lqg_tuning.py` that settle in every case.
SLOW = Tuning(0.15, 0.6, 0.003, 0.3)


class Gains(NamedTuple):
    """Feedback of one axis on (position, velocity, angle, rate), or on (position, velocity) of the height."""

    roll: tuple[float, ...]
    pitch: tuple[float, ...]
    height: tuple[float, ...]


class Filter(NamedTuple):
    """Steady-state Kalman filter: x <- A x + B u, then x <- x + L (y - C x), on (theta, q, d, d', rotor torque)."""

    transition: np.ndarray  # (5, 5)
    drive: np.ndarray  # (5,)
    gain: np.ndarray  # (5, 2)


class State(NamedTuple):
    """Estimate and the torque command that acts until the next step."""

    estimate: Array  # (..., 5)
    drive: Array  # (...) [N m]
    started: Array  # (...) 1 after the first step


class Takeover:
    """What `lqg` and `memoryless` share: everything but how the CG's torque d is found."""

    needs_privileged = False
    name = ""
    tuning = Tuning()

    def __init__(self, config: Config):
        self._law = copy_gains(config)
        self._plant = pitch_axis(config, self.name)
        self._feedback = feedback(self._plant, self.tuning)

    def _desired(self, observation: Array) -> Array:
        """What the pair should do: roll, pitch, vertical acceleration (..., 3)."""
        xp = observation.__array_namespace__()
        ex, ey, ez = (observation[..., ERROR][..., k] for k in range(3))
        vx, vy, vz = (-observation[..., ERROR_RATE][..., k] for k in range(3))
        roll_angle, pitch_angle = observation[..., 3], observation[..., 4]
        roll_rate, pitch_rate = observation[..., 9], observation[..., 10]
        f = self._feedback
        limit = self.tuning.tilt_limit
        pitch = xp.clip(f.pitch[0] * ex - f.pitch[1] * vx, -limit, limit)
        pitch = pitch - f.pitch[2] * pitch_angle - f.pitch[3] * pitch_rate
        roll = xp.clip(f.roll[0] * ey - f.roll[1] * vy, -limit, limit)
        roll = roll - f.roll[2] * roll_angle - f.roll[3] * roll_rate
        vertical = xp.clip(f.height[0] * ez - f.height[1] * vz, -VERTICAL_LIMIT, VERTICAL_LIMIT)
        return xp.stack([roll, pitch, vertical], axis=-1)

    def _command(
        self, observation: Array, desired: Array, torque: Array, privileged: PrivilegedInfo
    ) -> tuple[Array, Array, Array]:
        """(command, sum of both pitch commands, thrust difference T_l - T_f) against the CG's `torque` (...)."""
        xp = observation.__array_namespace__()
        p = self._plant
        led = copy_command(observation, *self._law)
        level = xp.cos(observation[..., 3]) * xp.cos(observation[..., 4])
        vertical = xp.clip(2.0 * desired[..., 2] - led[..., 2], -LIMITS[2], LIMITS[2])
        carried = [m + s * privileged.believed_mass for m, s in zip(p.drone_mass, p.share, strict=True)]
        difference = (carried[0] * (p.gravity + led[..., 2]) - carried[1] * (p.gravity + vertical)) / level
        correction = xp.clip((p.half_length * difference - torque) / p.kp, -CORRECTION_LIMIT, CORRECTION_LIMIT)
        pitch = xp.clip(2.0 * desired[..., 1] - led[..., 1] + correction, -LIMITS[1], LIMITS[1])
        roll = xp.clip(2.0 * desired[..., 0] - led[..., 0], -LIMITS[0], LIMITS[0])
        return xp.stack([roll, pitch, vertical], axis=-1), led[..., 1] + pitch, difference


class Memoryless(Takeover):
    """d from the balance of torques at standstill: 2 Kp (theta - theta*) + 2 Kd q."""

    name = "memoryless"

    def start(self, observation: Array) -> Any:
        """See `Law.start`."""
        return ()

    def step(self, state: Any, observation: Array, privileged: PrivilegedInfo) -> tuple[Any, Array]:
        """See `Law.step`."""
        desired = self._desired(observation)
        theta, rate = observation[..., 4], observation[..., 10]
        torque = 2.0 * self._plant.kp * (theta - desired[..., 1]) + 2.0 * self._plant.kd * rate
        return state, self._command(observation, desired, torque, privileged)[0]


class Lqg(Takeover):
    """d from a steady-state Kalman filter on pitch, pitch rate, d, d' and the rotors' torque."""

    name = "lqg"

    def __init__(self, config: Config):
        super().__init__(config)
        self._filter = kalman(self._plant, self.tuning.torque_walk)

    def start(self, observation: Array) -> State:
        """See `Law.start`."""
        xp = observation.__array_namespace__()
        zero = xp.zeros_like(observation[..., 0])
        theta, rate = observation[..., 4], observation[..., 10]
        return State(xp.stack([theta, rate, zero, zero, zero], axis=-1), zero, zero)

    def step(self, state: State, observation: Array, privileged: PrivilegedInfo) -> tuple[State, Array]:
        """See `Law.step`."""
        xp = observation.__array_namespace__()
        transition, drive, gain = (xp.asarray(part, dtype=observation.dtype) for part in self._filter)
        predicted = state.estimate @ transition.T + state.drive[..., None] * drive
        predicted = xp.where(state.started[..., None] > 0, predicted, state.estimate)
        measured = xp.stack([observation[..., 4], observation[..., 10]], axis=-1)
        estimate = predicted + (measured - predicted[..., :2]) @ gain.T
        desired = self._desired(observation)
        command, pitches, difference = self._command(observation, desired, estimate[..., 2], privileged)
        torque = self._plant.kp * pitches - self._plant.half_length * difference
        return State(estimate, torque, xp.ones_like(state.started)), command


class SlowLqg(Lqg):
    """The same with a filter that is slow enough for noise and late commands."""

    name = "lqg-slow"
    tuning = SLOW


def feedback(plant: LoadAxis, tuning: Tuning) -> Gains:
    """LQR of both tilt axes, each with its closed attitude loop, and of the height."""
    costs = tuning.position**-2, tuning.velocity**-2

    def tilt(frequency: float, sign: float) -> tuple[float, ...]:
        a = np.zeros((4, 4))
        a[0, 1] = a[2, 3] = 1.0
        a[1, 2] = sign * plant.gravity
        a[3, 2], a[3, 3] = -(frequency**2), -2.0 * plant.damping * frequency
        b = np.array([[0.0], [0.0], [0.0], [frequency**2]])
        return lqr(a, b, np.diag([*costs, 0.0, 0.0]), np.array([[TILT**-2]]))

    height = lqr(
        np.array([[0.0, 1.0], [0.0, 0.0]]),
        np.array([[0.0], [1.0]]),
        np.diag(costs),
        np.array([[VERTICAL**-2]]),
    )
    roll, pitch = plant.natural_frequency
    return Gains(tilt(roll, -1.0), tilt(pitch, 1.0), height)


def lqr(a: np.ndarray, b: np.ndarray, q: np.ndarray, r: np.ndarray) -> tuple[float, ...]:
    """K of u = -K x, one input, that minimises the integral of x'Qx + u'Ru for x' = A x + B u."""
    cost = solve_continuous_are(a, b, q, r)
    return tuple(map(float, np.linalg.solve(r, b.T @ cost)[0]))


def kalman(plant: LoadAxis, torque_walk: float) -> Filter:
    """The matrices of the steady-state filter."""
    a = np.zeros((5, 5))
    a[0, 1] = a[2, 3] = 1.0
    a[1, 2] = a[1, 4] = 1.0 / plant.inertia
    a[4] = np.array([-2.0 * plant.kp, -2.0 * plant.kd, 0.0, 0.0, -1.0]) / plant.lag
    b = np.array([[0.0], [0.0], [0.0], [0.0], [1.0 / plant.lag]])
    transition, drive = discretise(a, b, plant.period)
    process_noise = np.zeros((5, 5))
    process_noise[3, 3] = torque_walk * plant.period
    measured = np.eye(2, 5)
    measurement_noise = np.diag([THETA_NOISE**2, RATE_NOISE**2])
    predicted = solve_discrete_are(transition.T, measured.T, process_noise, measurement_noise)
    gain = predicted @ measured.T @ np.linalg.inv(measured @ predicted @ measured.T + measurement_noise)
    return Filter(transition, drive[:, 0], gain)


def discretise(a: np.ndarray, b: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
    """(A (n, n), B (n, m)) of x_k+1 = A x_k + B u_k for x' = a x + b u with u held for a `period` [s]."""
    n, m = b.shape
    whole = expm(np.block([[a, b], [np.zeros((m, n + m))]]) * period)
    return whole[:n, :n], whole[:n, n:]
