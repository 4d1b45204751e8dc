"""A follower, told the plant, that takes the loop over from its leader: LQR and a Kalman filter for the CG's torque.

The pair obeys the sum of both drones' commands, so the follower commands twice what the pair should do less what the
leader does, which it computes from its own observation (ours).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from mjxball.config import Config
from mjxball.control.baselines.gains import LoadAxis, copied_law, pitch_gains
from mjxball.control.baselines.law import Brief
from mjxball.control.observation import ERROR, ERROR_RATE, copy_command

Array = Any
TILT, VERTICAL = 0.15, 1.0  # [rad], [m/s2] that cost 1
VERTICAL_REACH = 2.0  # of the position and velocity part [m/s2]
CORRECTION_LIMIT = 0.6  # of pitch against the CG's torque [rad]
LIMITS = (0.6, 1.0, 6.0)  # of roll, pitch [rad] and vertical acceleration [m/s2]
THETA_NOISE, RATE_NOISE = 2e-3, 2e-2  # deviations of a measurement [rad], [rad/s]


class Tuning(NamedTuple):
    """What is chosen of `lqg`."""

    position: float = 0.25  # that costs 1 [m]
    velocity: float = 1.0  # that costs 1 [m/s]
    torque_walk: float = 9.0  # intensity of the white noise that drives d' [(N m/s)2 s]
    tilt_reach: float = 0.25  # of the position and velocity part [rad]


# The default reproduces the independent simulation and limit-cycles where commands are late. SLOW settles earliest
# under noise and 40 ms of delay, of those in `benchmarks/lqg_tuning.py` that settle in every cell, with and without.
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


class Memory(NamedTuple):
    """Estimate and the torque command that acts until the next step."""

    estimate: Array  # (..., 5)
    drive: Array  # (...) [N m]
    started: Array  # (...) 1 after the first step


class Takeover:
    """What `lqg` and `memoryless` share: everything but how the CG's torque d is found."""

    needs_truth = False
    name = ""
    tuning = Tuning()

    def __init__(self, config: Config):
        self._law = copied_law(config)
        self._plant = pitch_gains(config, self.name)
        self._feedback = feedback(self._plant, self.tuning)

    def _wanted(self, observation: Array) -> Array:
        """What the pair should do: roll, pitch, vertical acceleration (..., 3)."""
        xp = observation.__array_namespace__()
        ex, ey, ez = (observation[..., ERROR][..., k] for k in range(3))
        vx, vy, vz = (-observation[..., ERROR_RATE][..., k] for k in range(3))
        roll_angle, pitch_angle = observation[..., 3], observation[..., 4]
        roll_rate, pitch_rate = observation[..., 9], observation[..., 10]
        f = self._feedback
        reach = self.tuning.tilt_reach
        pitch = xp.clip(f.pitch[0] * ex - f.pitch[1] * vx, -reach, reach)
        pitch = pitch - f.pitch[2] * pitch_angle - f.pitch[3] * pitch_rate
        roll = xp.clip(f.roll[0] * ey - f.roll[1] * vy, -reach, reach)
        roll = roll - f.roll[2] * roll_angle - f.roll[3] * roll_rate
        vertical = xp.clip(f.height[0] * ez - f.height[1] * vz, -VERTICAL_REACH, VERTICAL_REACH)
        return xp.stack([roll, pitch, vertical], axis=-1)

    def _command(self, observation: Array, wanted: Array, torque: Array, brief: Brief) -> tuple[Array, Array, Array]:
        """(command, sum of both pitch commands, thrust difference T_l - T_f) against the CG's `torque` (...)."""
        xp = observation.__array_namespace__()
        p = self._plant
        led = copy_command(observation, *self._law)
        level = xp.cos(observation[..., 3]) * xp.cos(observation[..., 4])
        vertical = xp.clip(2.0 * wanted[..., 2] - led[..., 2], -LIMITS[2], LIMITS[2])
        carried = [m + s * brief.believed_mass for m, s in zip(p.drone_mass, p.share, strict=True)]
        difference = (carried[0] * (p.gravity + led[..., 2]) - carried[1] * (p.gravity + vertical)) / level
        correction = xp.clip((p.half_length * difference - torque) / p.kp, -CORRECTION_LIMIT, CORRECTION_LIMIT)
        pitch = xp.clip(2.0 * wanted[..., 1] - led[..., 1] + correction, -LIMITS[1], LIMITS[1])
        roll = xp.clip(2.0 * wanted[..., 0] - led[..., 0], -LIMITS[0], LIMITS[0])
        return xp.stack([roll, pitch, vertical], axis=-1), led[..., 1] + pitch, difference


class Memoryless(Takeover):
    """d from the balance of torques at standstill: 2 Kp (theta - theta*) + 2 Kd q."""

    name = "memoryless"

    def start(self, observation: Array) -> Any:
        """See `Law.start`."""
        return ()

    def step(self, memory: Any, observation: Array, brief: Brief) -> tuple[Any, Array]:
        """See `Law.step`."""
        wanted = self._wanted(observation)
        theta, rate = observation[..., 4], observation[..., 10]
        torque = 2.0 * self._plant.kp * (theta - wanted[..., 1]) + 2.0 * self._plant.kd * rate
        return memory, self._command(observation, wanted, torque, brief)[0]


class Lqg(Takeover):
    """d from a steady-state Kalman filter on pitch, pitch rate, d, d' and the rotors' torque."""

    name = "lqg"

    def __init__(self, config: Config):
        super().__init__(config)
        self._filter = kalman(self._plant, self.tuning.torque_walk)

    def start(self, observation: Array) -> Memory:
        """See `Law.start`."""
        xp = observation.__array_namespace__()
        zero = xp.zeros_like(observation[..., 0])
        theta, rate = observation[..., 4], observation[..., 10]
        return Memory(xp.stack([theta, rate, zero, zero, zero], axis=-1), zero, zero)

    def step(self, memory: Memory, observation: Array, brief: Brief) -> tuple[Memory, Array]:
        """See `Law.step`."""
        xp = observation.__array_namespace__()
        transition, drive, gain = (xp.asarray(part, dtype=observation.dtype) for part in self._filter)
        predicted = memory.estimate @ transition.T + memory.drive[..., None] * drive
        predicted = xp.where(memory.started[..., None] > 0, predicted, memory.estimate)
        measured = xp.stack([observation[..., 4], observation[..., 10]], axis=-1)
        estimate = predicted + (measured - predicted[..., :2]) @ gain.T
        wanted = self._wanted(observation)
        command, pitches, difference = self._command(observation, wanted, estimate[..., 2], brief)
        torque = self._plant.kp * pitches - self._plant.half_length * difference
        return Memory(estimate, torque, xp.ones_like(memory.started)), command


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
    """K of u = -K x, one input, that minimises the integral of x'Qx + u'Ru for x' = A x + B u.

    From the stable invariant subspace of the Hamiltonian matrix.
    """
    n = len(a)
    hamiltonian = np.block([[a, -b @ np.linalg.solve(r, b.T)], [-q, -a.T]])
    values, vectors = np.linalg.eig(hamiltonian)
    stable = vectors[:, values.real < 0]
    cost = np.real(stable[n:] @ np.linalg.inv(stable[:n]))
    return tuple(map(float, np.linalg.solve(r, b.T @ cost)[0]))


def kalman(plant: LoadAxis, torque_walk: float) -> Filter:
    """The filter's matrices; its gain is the fixed point of the discrete Riccati recursion."""
    a = np.zeros((5, 5))
    a[0, 1] = a[2, 3] = 1.0
    a[1, 2] = a[1, 4] = 1.0 / plant.inertia
    a[4] = np.array([-2.0 * plant.kp, -2.0 * plant.kd, 0.0, 0.0, -1.0]) / plant.lag
    b = np.array([0.0, 0.0, 0.0, 0.0, 1.0 / plant.lag])
    transition, drive = discretise(a, b, plant.period)
    noise = np.zeros((5, 5))
    noise[3, 3] = torque_walk * plant.period
    seen = np.eye(2, 5)
    measurement = np.diag([THETA_NOISE**2, RATE_NOISE**2])
    covariance = np.eye(5)
    for _ in range(5000):
        predicted = transition @ covariance @ transition.T + noise
        gain = predicted @ seen.T @ np.linalg.inv(seen @ predicted @ seen.T + measurement)
        covariance = (np.eye(5) - gain @ seen) @ predicted
    return Filter(transition, drive, gain)


def discretise(a: np.ndarray, b: np.ndarray, period: float) -> tuple[np.ndarray, np.ndarray]:
    """(A, B) of x_k+1 = A x_k + B u_k for x' = a x + b u with u held, by the exponential's series on small steps."""
    n, halvings = len(a), 10
    block = np.zeros((n + 1, n + 1))
    block[:n, :n], block[:n, n] = a, b
    small = block * (period / 2**halvings)
    result, term = np.eye(n + 1), np.eye(n + 1)
    for order in range(1, 12):
        term = term @ small / order
        result = result + term
    for _ in range(halvings):
        result = result @ result
    return result[:n, :n], result[:n, n]
