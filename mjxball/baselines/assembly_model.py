"""The plant of the classical followers: the assembly about roll and pitch, and the leader's PID."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from mjxball.arrays import Array, clipped, matmul
from mjxball.config import Config
from mjxball.control import leader, rotations
from mjxball.control.constants import drone_loop, thrust_slopes
from mjxball.control.followers import copy_gains
from mjxball.control.observation import ERROR, ERROR_RATE, copy_command, mount_angles
from mjxball.errors import InputError
from mjxball.plant import plant_parameters

SIGNS = (-1.0, 1.0)  # of the roll torque of a load at +y, of the pitch torque of one at +x


class AssemblyModel(NamedTuple):
    """N drones about roll and pitch, body axes, and how F = N - 1 followers share a wrench.

    A follower finds what all of them should do from its own measurements, and sends its own command of that (`own`).
    Arrays of several followers have an axis F for it, those of a pair's one have none.
    """

    axes: tuple[int, ...]  # about which the load turns the assembly: 0 roll, 1 pitch
    kp: tuple[float, float]  # of one drone's attitude loop about roll and pitch [N m/rad]
    kd: tuple[float, float]  # [N m s/rad]
    inertia: tuple[float, float]  # of the assembly about O, CG at O, nominal object [kg m2]
    leader: int
    followers: int  # F
    mounts: np.ndarray  # (N, 2) from O [m]
    own_mass: np.ndarray  # (N,) [kg]
    known_mass: np.ndarray  # (N,) that a drone believes to lift besides the load [kg]
    load_share: np.ndarray  # (N,) of the load's weight that each drone believes to carry
    effect: np.ndarray  # (F, 3, 3) lift, roll and pitch torque about O per each follower's own
    inverse_cost: np.ndarray  # (F, 3) squares of lift [N2] and torques [N2 m2] over those of the rotor forces they take
    asked_per_wrench: np.ndarray  # (F, 3, 3) each follower's lift and torques per wrench about O, if nothing fails
    angles: np.ndarray | None  # (F,), of one follower (), of the mount frames; None: body axes [rad]
    gravity: float  # [m/s2]
    extra_lift: float  # vertical acceleration that a torque of motors with a curve gives, over its square
    lag: float  # of the rotors, the drones' mean [s]
    period: float  # between two commands [s]
    natural_frequency: tuple[float, float]  # of the closed roll and pitch loops of `Attitude` [rad/s]
    damping: float

    def in_body_axes(self, observation: Array) -> Array:
        """`observation` (..., 18), of several followers (..., F, 18), in body axes; also other vectors (..., 3 k)."""
        return observation if self.angles is None else rotations.turned_about_z(observation, self.angles)

    def own(self, commands: Array) -> Array:
        """What each follower sends, in its mount frame, of the `commands` (..., F, F, 3) that it finds for all, second.

        One follower's are (..., 1, 3) and become (..., 3).
        """
        if self.followers == 1:
            mine = commands[..., 0, :]
        else:
            mine = (commands * np.eye(self.followers, dtype=commands.dtype)[..., None]).sum(axis=-2)
        return mine if self.angles is None else rotations.turned_about_z(mine, -self.angles)

    def of_followers(self, values: Array) -> Array:
        """(..., F) of `values` (..., N) of all drones."""
        ahead, behind = values[..., : self.leader], values[..., self.leader + 1 :]
        return behind if self.leader == 0 else values.__array_namespace__().concat([ahead, behind], axis=-1)

    def carried(self, believed_mass: Array) -> Array:
        """Mass that every drone assumes to lift (..., N) with an object of `believed_mass` (...) [kg]."""
        xp = believed_mass.__array_namespace__()
        known, share = (xp.asarray(part, dtype=believed_mass.dtype) for part in (self.known_mass, self.load_share))
        return known + share * believed_mass[..., None]

    def corrections(self, wrench: Array, carried: Array, thrust: Array | None = None) -> Array:
        """Addition to all followers' commands (..., F, 3) that gives `wrench` (..., 3) about O together.

        Wrench: lift [N], roll and pitch torque [N m]; `carried` (..., N) of all drones; `thrust` (..., N) what they
        give of what they are asked for, None: all of it. Of all that give the wrench, those with the least sum of
        squares of the rotor forces asked for: the one follower of a pair gives it by its rotors' torques.
        """
        xp = wrench.__array_namespace__()
        effect, inverse_cost, kp, asked_per_wrench = (
            xp.asarray(part, dtype=wrench.dtype)
            for part in (self.effect, self.inverse_cost, self.kp, self.asked_per_wrench)
        )
        if thrust is None:
            asked = matmul(asked_per_wrench, wrench[..., None, :, None])[..., 0]
        else:
            effect = self.of_followers(thrust)[..., None, None] * effect
            whole = matmul(effect, inverse_cost[..., None] * effect.mT).sum(axis=-3)
            price = xp.linalg.solve(whole, wrench[..., None])
            asked = inverse_cost * matmul(effect.mT, price[..., None, :, :])[..., 0]
        vertical = asked[..., 0] / self.of_followers(carried)
        return xp.concat([asked[..., 1:] / kp, vertical[..., None]], axis=-1)

    def each_alone(self) -> AssemblyModel:
        """The model in which every follower gives one F-th of a wrench about O by itself, by lift and rotor torques.

        Of what followers disagree about only the mean then acts on the assembly; shared by unequal lifts, all would.
        """
        alone = np.linalg.inv(self.effect) / self.followers
        return self if self.followers == 1 else self._replace(asked_per_wrench=alone)

    @property
    def turned(self) -> slice:
        """Of (roll, pitch), those of `axes`."""
        return slice(self.axes[0], self.axes[-1] + 1)

    def on_axes(self, values: Array) -> Array:
        """(..., 2) roll and pitch of `values` (..., A) about `axes`, 0 about another."""
        xp = values.__array_namespace__()
        zero = xp.zeros_like(values[..., 0])
        each = [values[..., self.axes.index(axis)] if axis in self.axes else zero for axis in (0, 1)]
        return xp.stack(each, axis=-1)

    def lever_torque(self, lift: Array) -> Array:
        """(..., 2) roll and pitch torque about O of `lift` (..., N), what the drones lift beyond their own weight."""
        xp = lift.__array_namespace__()
        x, y = xp.asarray(self.mounts.T, dtype=lift.dtype)
        return xp.stack([(lift * y).sum(axis=-1), -(lift * x).sum(axis=-1)], axis=-1)

    def without_extra_lift(self, vertical: Array, trim: Array) -> Array:
        """`vertical` (...) [m/s2] minus the extra lift of motors that hold the torques kp `trim` (..., 2) [rad]."""
        return vertical - self.extra_lift * sum((self.kp[axis] * trim[..., axis]) ** 2 for axis in (0, 1))


class CopiedPid:
    """The leader's PID on the follower's own observation; with the leader's integral each drone lifts its share."""

    def __init__(self, config: Config):
        controller = config.leader
        self._pid = controller.kp, controller.kd, controller.ki
        self._pd = copy_gains(config)
        self._band, self._period = controller.integral_error_limit, config.timing.control_period
        self._lead = controller.integral_lead_time

    def start(self, observation: Array) -> Any:
        """Integral (..., 3) [m s] at the first `observation` (..., 18); () if the leader has none."""
        return observation.__array_namespace__().zeros_like(observation[..., ERROR]) if any(self._pid[2]) else ()

    def step(self, integral: Any, observation: Array) -> tuple[Any, Array]:
        """(integral, command (..., 3)) at `observation` (..., 18), both in body axes."""
        if not any(self._pid[2]):
            return integral, copy_command(observation, *self._pd)
        error, rate = observation[..., ERROR], observation[..., ERROR_RATE]
        band = error.__array_namespace__().asarray(self._band, dtype=error.dtype)
        command = leader.pid_command(error, rate, integral, self._pid, *self._pd[2:])
        return integral + self._period * clipped(error + self._lead * rate, -band, band), command


def ideal_model(config: Config, name: str) -> AssemblyModel:
    """`assembly_model` for the follower `name`; InputError unless the plant flies freely with ideal loops."""
    if config.plant.stand != "free" or config.autopilot.kind != "ideal":
        raise InputError(f"follower {name!r} balances plants that fly freely with ideal loops; this plant is another")
    return assembly_model(config, name)


def pair_model(config: Config, name: str) -> AssemblyModel:
    """`ideal_model`; InputError unless the plant is a free pair along x with ideal loops, led by its first drone."""
    plant = config.plant
    alike = plant.count == 2 and plant.leader == 0 and plant.cg_axis == "x" and plant.stand == "free"
    if not alike or config.autopilot.kind != "ideal":
        raise InputError(f"follower {name!r} balances a free pair along x with ideal loops; this plant is another")
    return ideal_model(config, name)


def assembly_model(config: Config, name: str) -> AssemblyModel:
    """The assembly for the follower `name`; InputError if a stand locks the axis that the load turns.

    A Crazyflie's attitude loop is approximated by the PD part of its cascade at hover, without the integrals.
    """
    plant, attitude = config.plant, config.attitude
    firmware, several = config.autopilot.kind == "crazyflie", plant.count > 2
    if plant.stand != "free" and plant.cg_axis != "y":
        raise InputError(f"follower {name!r} needs free flight, or a load along y; this stand locks pitch")
    if firmware and (several or plant.leader or len(plant.directions) == 2):
        raise InputError(
            f"follower {name!r} flies Crazyflies in pairs, the leader first, with a load that moves along a line"
        )
    constants = plant_parameters(plant, attitude)
    inertia = np.diag(constants.drone_inertia) + plant.object_mass * constants.object_inertia_per_mass
    kp, kd, extra_lift = constants.gains.kp[:2], constants.gains.kd[:2], 0.0
    # Drones that fail turn a team about both axes, wherever its load moves.
    axes = (0, 1) if several else tuple(sorted(1 - axis for axis in plant.directions))
    if firmware:
        loops = [drone_loop(config, axis) for axis in (0, 1)]
        kp, kd = (np.array([getattr(loop, gain) for loop in loops]) for gain in ("kp", "kd"))
        extra_lift = loops[axes[0]].thrust_surplus / thrust_slopes(config)[1]
    roll, pitch, _ = attitude.natural_frequency
    followers = np.array(plant.followers)
    effect = np.array([[[1.0, 0.0, 0.0], [y, 1.0, 0.0], [-x, 0.0, 1.0]] for x, y, _ in constants.mounts[followers]])
    arms = constants.arm[followers]  # a lift T takes four forces T / 4, a torque tau two of tau / 2 L
    inverse_cost = np.stack([0.0 * arms + 4.0, 2.0 * arms**2, 2.0 * arms**2], axis=-1)
    priced = inverse_cost[:, :, None] * effect.mT
    return AssemblyModel(
        axes=axes,
        kp=(float(kp[0]), float(kp[1])),
        kd=(float(kd[0]), float(kd[1])),
        inertia=(float(inertia[0]), float(inertia[1])),
        leader=plant.leader,
        followers=len(followers),
        mounts=constants.mounts[:, :2],
        own_mass=constants.drone_mass,
        known_mass=constants.known_mass,
        load_share=constants.load_share,
        effect=effect,
        inverse_cost=inverse_cost,
        asked_per_wrench=priced @ np.linalg.inv((effect @ priced).sum(axis=0)),
        angles=mount_angles(plant),
        gravity=plant.gravity,
        extra_lift=extra_lift,
        lag=float(constants.rotor_lag.mean()),
        period=config.timing.control_period,
        natural_frequency=(roll, pitch),
        damping=attitude.damping,
    )
