"""Offset-free model-predictive control of pairs and teams within the limits of rotors and commands (ours).

The filter and the controller are those of `lqg`: a steady-state Kalman filter of the motion, the load's torque, wind
and the error of the lift, and the LQR about what balances them. To it come corrections v of all drones' mean command
over the next second. The cost of an LQR is x'Px plus the sum of v'Wv, W = R + B'PB, for any v. The best corrections
solve

    minimise the sum of v' W v   such that the follower's commands, rotors, tilt and lift keep their limits,

a quadratic program that includes the infinite horizon after its last step exactly. Limits are soft: exceeding them
costs the square, so that there always is a solution. Where the LQR itself keeps the limits, v = 0; for the other
flights of a batch Newton's method solves the program.

Every follower of a team runs it separately, in body axes, on its own measurements, and assumes that the others send the
same command; as those of `lqg` they forget what they estimate.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.linalg.lapack import dposv

from mjxball.arrays import Array, clipped, joined
from mjxball.baselines.hover_model import LIFT, MEASURED, STATES, TILT, TURN
from mjxball.baselines.linear import missed, times
from mjxball.baselines.lqg_tuning import Tuning
from mjxball.baselines.mpc_design import NAME, PAIR, TEAM, Limits, MpcDesign, design, limits_of
from mjxball.config import Config
from mjxball.control import rotations
from mjxball.control.followers import PrivilegedInfo, copy_gains
from mjxball.control.leader import clip_command
from mjxball.control.observation import OWN_STATE, mount_angles
from mjxball.errors import InputError

BLOCKS = (1, 1, 1, 2, 2, 3, 4, 6, 8, 10, 12)  # control steps for which a correction is held: 1 s
CHECKED = (*range(8), 9, 11, 13, 16, 19, 23, 28, 34, 42)  # control steps at which limits are enforced
MASSES = tuple(0.1 * number for number in range(11))  # of objects [kg]; the design for the nearest is used
BEYOND = 100.0  # cost of exceeding a limit, over that of the correction which avoids it
# Newton's method: largest number of steps, gradient in units of the square root of the cost at which it ends.
ITERATIONS, TOLERANCE = 60, 1e-8
AXES = tuple((axis, TILT.start + axis, TURN.start + axis) for axis in (0, 1))  # with indices of its tilt and rate


class QuadraticProgram:
    """The quadratic program for an object of `mass` [kg], in corrections times the square root of their cost."""

    def __init__(self, own: MpcDesign, limits: Limits, mass: float):
        carried = limits.own_mass + limits.load_share * mass
        cost = np.sqrt(np.outer(BLOCKS, own.cost)).ravel()
        states, corrections, low, high, lifting = limit_rows(own, limits, carried)
        corrections = corrections / cost
        size = np.maximum(np.linalg.norm(corrections, axis=1), 1e-3)
        self._states, self._rows = states / size[:, None], corrections / size[:, None]
        self._low, self._high, self._lifting = low / size, high / size, lifting / size
        self._cost = cost[:3]
        self.solved = 0

    def broken(self, x: np.ndarray, hover: np.ndarray) -> np.ndarray:
        """(n,) whether the LQR exceeds a limit from states `x` (n, k); `hover` (n,) is a rotor's force at hover [N]."""
        rows = x @ self._states.T + hover[:, None] * self._lifting
        return ((rows < self._low) | (rows > self._high)).any(axis=-1)

    def corrections(self, x: np.ndarray, hover: np.ndarray) -> np.ndarray:
        """(n, 3) first corrections from states `x` (n, k)."""
        first = np.zeros((len(x), 3))
        for number in np.nonzero(self.broken(x, hover))[0]:
            taken = self._states @ x[number] + hover[number] * self._lifting
            first[number] = least(self._rows, self._low - taken, self._high - taken)[:3] / self._cost
            self.solved += 1
        return first


def least(rows: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """(k,) v with the least |v|^2 / 2 + BEYOND / 2 |what of `rows` (m, k) v is not between `low` and `high`|^2.

    Newton's method with steps that are halved until the cost falls. Its slope is linear in v as long as the same rows
    exceed their limits, so the last step ends at the exact solution.
    """
    v, at = np.zeros(rows.shape[1]), np.zeros(len(rows))
    beyond = at - np.minimum(np.maximum(at, low), high)
    cost, unit = BEYOND * (beyond @ beyond), np.eye(len(v))
    for _ in range(ITERATIONS):
        active = np.nonzero(beyond)[0]
        chosen = rows[active]
        slope = v + BEYOND * (beyond[active] @ chosen)
        if np.abs(slope).max() < TOLERANCE:
            break
        step = dposv(unit + BEYOND * (chosen.T @ chosen), -slope)[1]  # a third of the time of `np.linalg.solve`
        before, change, share = cost, rows @ step, 1.0
        while True:
            there, value = v + share * step, at + share * change
            beyond = value - np.minimum(np.maximum(value, low), high)
            cost = there @ there + BEYOND * (beyond @ beyond)
            if cost <= before or share < 1e-3:
                break
            share *= 0.5
        v, at = there, value
    return v


def limit_rows(own: MpcDesign, limits: Limits, carried: float) -> tuple[np.ndarray, ...]:
    """Rows of the state (m, n), of the corrections (m, k), bounds low and high (m,), and rows of the hover force (m,).

    In this order at every step in `CHECKED`: command (3), rotor forces (4), roll, pitch and lift (3).
    """
    size, count, held = own.drive.shape[0], 3 * len(BLOCKS), np.repeat(np.arange(len(BLOCKS)), BLOCKS)
    loop, drive = own.transition + own.drive @ own.feedback, own.drive @ own.correction
    asked, angles = np.diag([*limits.kp, carried])[[2, 0, 1]], np.zeros((3, size))  # lift, roll, pitch torque
    for axis, angle, rate in AXES:
        angles[1 + axis, [angle, rate]] = -limits.kp[axis], -limits.kd[axis]
    moved, found = np.hstack([np.eye(size), np.zeros((size, count))]), []
    for step in range(max(CHECKED) + 1):
        chosen = np.zeros((3, size + count))
        chosen[:, size + 3 * held[step] :][:, :3] = np.eye(3)
        command = own.feedback @ moved + own.correction @ chosen
        if step in CHECKED:
            rotors = limits.rotors @ (asked @ command + angles @ moved)
            found.append(np.vstack([command, rotors, moved[[TILT.start, TILT.start + 1, LIFT.start]]]))
        moved = loop @ moved + drive @ chosen
    rows, steps = np.vstack(found), len(CHECKED)
    high = np.concatenate([limits.command, np.full(4, limits.rotor_force), own.far_limit])
    low = np.concatenate([-limits.command, np.zeros(4), -own.far_limit])
    lifting = np.repeat([0.0, 1.0, 0.0], [3, 4, 3])
    return rows[:, :size], rows[:, size:], *(np.tile(part, steps) for part in (low, high, lifting))


class Mpc:
    """The controller as a follower.

    Its state (..., n + 3 `delay` + 12) is that of the filter, the newest commands, and the own state as last measured.

    It reads the believed mass of the object. `solved` counts its programs.
    """

    name = NAME
    needs_privileged = False
    tuning, team_tuning = PAIR, TEAM

    def __init__(self, config: Config, tuning: Tuning | None = None):
        plant, self._limits, self._leader = config.plant, limits_of(config), copy_gains(config)
        self._gravity, self._angles, self._others = plant.gravity, mount_angles(plant), plant.count - 1
        tuning = tuning or (self.team_tuning if plant.is_team else self.tuning)
        self.delay = tuning.late  # assumed delay of measurements in control steps
        self.designs = [design(config, tuning, mass) for mass in MASSES]
        self._stacked = MpcDesign(*(np.stack(parts) for parts in zip(*self.designs, strict=True)))
        self._programs = [
            QuadraticProgram(own, self._limits, mass) for own, mass in zip(self.designs, MASSES, strict=True)
        ]

    @property
    def solved(self) -> int:
        """Number of programs solved so far."""
        return sum(program.solved for program in self._programs)

    def start(self, observation: Array) -> Array:
        """See `Controller.start`."""
        measured, zero = self._seen(observation)[..., list(MEASURED)], 0.0 * observation[..., 0]
        known = [measured[..., place] for place in range(len(MEASURED))]
        estimated = joined(known + [zero] * (STATES - len(MEASURED) + 3 * self.delay))
        return observation.__array_namespace__().concat([estimated, observation[..., :OWN_STATE]], axis=-1)

    def step(self, state: Array, observation: Array, privileged: PrivilegedInfo) -> tuple[Array, Array]:
        """See `Controller.step`."""
        xp, dtype, mass = observation.__array_namespace__(), observation.dtype, privileged.believed_mass
        kind = xp.round(clipped(mass, 0.0, MASSES[-1]) / MASSES[1]).astype(int)
        own = MpcDesign(*(xp.asarray(part, dtype=dtype)[kind] for part in self._stacked))
        hover = (self._limits.own_mass + self._limits.load_share * mass) * self._gravity / 4.0
        x, commands = self._estimate(own, state, observation), state[..., STATES:-OWN_STATE]
        now = x
        for late in range(self.delay):
            now = self._moved(own, now, commands[..., 3 * late : 3 * late + 3], hover)
        command = self._command(own, now, hover, kind)
        commands = xp.concat([commands, command], axis=-1)
        moved = self._moved(own, x, commands[..., :3], hover)
        return xp.concat([moved, commands[..., 3:], observation[..., :OWN_STATE]], axis=-1), self._sent(command)

    def _estimate(self, own: MpcDesign, state: Array, observation: Array) -> Array:
        """The filter's state (..., n) corrected by `observation`, at the time of its measurements."""
        x = state[..., :STATES]
        surprise = self._seen(observation)[..., list(MEASURED)] - times(own.measured, x)
        repeated = missed(observation, state[..., -OWN_STATE:])
        return x + times(own.gain, observation.__array_namespace__().where(repeated, 0.0, surprise))

    def _seen(self, observation: Array) -> Array:
        """`observation` (..., 18) in body axes; for teams it comes in mount frames."""
        return observation if self._angles is None else rotations.turned_about_z(observation, self._angles)

    def _sent(self, command: Array) -> Array:
        """`command` (..., 3) in body axes as it is sent; for teams in mount frames."""
        if self._angles is None:
            return command
        return clip_command(rotations.turned_about_z(command, -self._angles), *self._leader[-2:])

    def _moved(self, own: MpcDesign, x: Array, command: Array, hover: Array) -> Array:
        """State (..., n) one period after `x` with the follower's `command` (..., 3) and saturating rotors."""
        led, lost = times(own.led, x), 0.0
        for drones, sent in ((1.0, led), (self._others, command)):
            room, asked = self._room(sent[..., 2], hover)[..., None], self._asked(sent, x)
            lost = lost + drones * (clipped(asked, -room, room) - asked)
        return times(own.transition, x) + times(own.drive, command) + times(own.torque_drive, lost)

    def _asked(self, sent: Array, x: Array) -> Array:
        """Roll and pitch torque (..., 2) [N m] that a drone's attitude loop asks for at the command `sent` (..., 3)."""
        kp, kd = self._limits.kp.tolist(), self._limits.kd.tolist()
        return joined([kp[k] * (sent[..., k] - x[..., angle]) - kd[k] * x[..., rate] for k, angle, rate in AXES])

    def _room(self, vertical: Array, hover: Array) -> Array:
        """Largest torque (...) [N m] of a drone's rotors while they lift with `vertical` (...) [m/s2]."""
        lift = hover * (1.0 + vertical / self._gravity)
        left = lift.__array_namespace__().minimum(lift, self._limits.rotor_force - lift)
        return self._limits.torque_per_force * clipped(left, 0.0, self._limits.rotor_force)

    def _command(self, own: MpcDesign, x: Array, hover: Array, kind: Array) -> Array:
        """Command (..., 3) at state `x` (..., n). The vertical part is clipped first, because it uses rotor force."""
        tilt_limit, vertical_limit = self._leader[-2:]
        desired = times(own.feedback, x) + times(own.correction, self._corrections(x, hover, kind))
        vertical = clipped(desired[..., 2], -vertical_limit, vertical_limit)
        room, parts = self._room(vertical, hover), []
        for axis, angle, rate in AXES:
            kp, kd = float(self._limits.kp[axis]), float(self._limits.kd[axis])
            rest = x[..., angle] + kd / kp * x[..., rate]
            parts.append(clipped(desired[..., axis], rest - room / kp, rest + room / kp))
        return clip_command(joined([*parts, vertical]), tilt_limit, vertical_limit)

    def _corrections(self, x: Array, hover: Array, kind: Array) -> Array:
        """First corrections (..., 3); in JAX by a callback to NumPy."""
        if isinstance(x, np.ndarray):
            return self._solve(x, hover, kind)
        return _from_jax(self._solve)(x, hover, kind)

    def _solve(self, x: Any, hover: Any, kind: Any) -> np.ndarray:
        x, batch = np.asarray(x), np.shape(x)[:-1]
        hover, kind = (np.broadcast_to(np.asarray(part), batch).ravel() for part in (hover, kind))
        states, first = x.reshape(-1, STATES).astype(float), np.zeros((kind.size, 3))
        for one in np.unique(kind).tolist():
            chosen = kind == one
            first[chosen] = self._programs[one].corrections(states[chosen], hover[chosen].astype(float))
        return first.reshape(*batch, 3).astype(x.dtype)


def _from_jax(solve: Callable[..., Any]) -> Callable[..., Any]:
    """`solve` as a JAX function, without a derivative."""
    import jax

    @jax.custom_jvp
    def call(x: Array, hover: Array, kind: Array) -> Any:
        single = np.dtype(np.float32)  # 64-bit types are not enabled in a callback's thread
        shape = jax.ShapeDtypeStruct((*x.shape[:-1], 3), single)
        first = jax.pure_callback(
            lambda *arguments: solve(*arguments).astype(single), shape, x, hover, kind, vmap_method="broadcast_all"
        )
        return first.astype(x.dtype)

    @call.defjvp
    def refuse(primals: Any, tangents: Any) -> Any:
        raise InputError(f"follower {NAME!r} solves its programs outside of JAX and has no derivative")

    return call
