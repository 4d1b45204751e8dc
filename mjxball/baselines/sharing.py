"""How followers share what an assembly needs besides the leader's command, within the limits of their rotors (ours)."""

from __future__ import annotations

from typing import NamedTuple

from mjxball.arrays import Array
from mjxball.baselines.assembly_model import AssemblyModel
from mjxball.config import Config
from mjxball.control.mixer import torque_per_force
from mjxball.plant import plant_parameters
from mjxball.plant.parameters import rigid_moment

SPARE = 0.02  # share of a rotor's largest force at either end that no command uses


class Wanted(NamedTuple):
    """What all drones together should do, from one follower's point of view; body axes."""

    command: Array  # (..., 3) mean roll, pitch [rad] and vertical acceleration [m/s2] of all drones
    led: Array  # (..., 3) the leader's command
    rest: Array  # (..., 2) tilt command at which an attitude loop asks for no torque [rad]


class Assumed(NamedTuple):
    """What a follower knows or assumes of the flight."""

    carried: Array  # (..., N) mass that each drone assumes to lift [kg]
    mass: Array  # (...) of the assembly [kg]
    level: Array  # (...) cosine of the tilt, by which thrusts are divided
    thrust: Array | None = None  # (..., N) factor on each drone's rotor forces; None: 1
    loop_scale: Array | None = None  # (...) factor on the attitude loops' natural frequency; None: 1


class Sharing(NamedTuple):
    """Shares of all followers in what the leader leaves to them.

    All lift alike. Each adds its share of the torque that the assembly needs and the leader does not give: of N
    attitude loops at the mean command, and against unequal thrusts.
    """

    model: AssemblyModel
    moment: Array  # (2,) S of the drones [kg m]
    limits: tuple[float, float]  # of commands [rad], [m/s2]
    most: Array  # (N,) largest force of each drone's rotors [N]
    lever: Array  # (N,) torque per rotor force [m]

    def __call__(self, wanted: Wanted, assumed: Assumed) -> tuple[Array, Array]:
        """(commands (..., F, 3), what they ask for (..., 3): torques about the CG [N m], lift over mass [m/s2]).

        What the leader's rotors fall short of its command counts as asked for, too. Torques have precedence: where a
        rotor would reach its limit, followers lift less, or more.
        """
        xp, model, carried = wanted.command.__array_namespace__(), self.model, assumed.carried
        kp, lifting = self._stiffness(assumed), carried if assumed.thrust is None else carried * assumed.thrust
        left = assumed.mass * (model.gravity + wanted.command[..., 2])
        left = left - lifting[..., model.leader] * (model.gravity + wanted.led[..., 2])
        alike = (left / model.of_followers(lifting).sum(axis=-1) - model.gravity)[..., None]
        alike = xp.clip(alike + 0.0 * model.of_followers(carried), -self.limits[1], self.limits[1])
        safe = 0.0 * alike + wanted.led[..., 2:]
        turned = self._by_leader(wanted, assumed, kp)
        ends = [self._corrections(wanted, turned, assumed, vertical) for vertical in (safe, alike)]
        share = self._share(safe, alike, ends[0], ends[1], assumed, kp)
        vertical = safe + share * (alike - safe)
        more = ends[0] + share[..., None] * (ends[1] - ends[0])
        rest = xp.broadcast_to(wanted.rest[..., None, :], (*vertical.shape, 2))
        followed = self._limited(
            rest, xp.concat([rest + more[..., :2], (vertical + more[..., 2])[..., None]], axis=-1), assumed, kp
        )
        lift = carried * self._of_all(0.0 * wanted.led[..., 2], followed[..., 2])
        turn = kp * followed[..., :2].sum(axis=-2) + self._about_cg(lift, assumed.mass)
        turn = turn + turned - kp * (wanted.led[..., :2] - wanted.rest)  # what the leader's rotors do not give
        return followed, xp.concat([turn, (lift.sum(axis=-1) / assumed.mass)[..., None]], axis=-1)

    def _by_leader(self, wanted: Wanted, assumed: Assumed, kp: Array) -> Array:
        """Roll and pitch torque (..., 2) of the leader's rotors within their limits, at full thrust [N m]."""
        xp, lead = wanted.led.__array_namespace__(), self.model.leader
        hover = assumed.carried[..., lead] * (self.model.gravity + wanted.led[..., 2]) / (4.0 * assumed.level)
        most, lever = float(self.most[lead]), float(self.lever[lead])
        room = lever * xp.clip(xp.minimum(hover, most - hover), 0.0, most)[..., None]
        return xp.clip(kp * (wanted.led[..., :2] - wanted.rest), -room, room)

    def _corrections(self, wanted: Wanted, turned: Array, assumed: Assumed, vertical: Array) -> Array:
        """What followers that lift with `vertical` (..., F) add to commands without torque (..., F, 3).

        The leader has `turned` (..., 2) [N m].
        """
        xp, model, led = vertical.__array_namespace__(), self.model, wanted.led
        factor = xp.ones_like(assumed.carried) if assumed.thrust is None else assumed.thrust
        turn = len(model.own_mass) * self._stiffness(assumed) * (wanted.command[..., :2] - wanted.rest)
        turn = turn - factor[..., model.leader, None] * turned
        lift = factor * assumed.carried * (model.gravity + self._of_all(led[..., 2], vertical))
        turn = turn - self._about_cg(lift, assumed.mass)
        more = model.corrections(xp.concat([0.0 * turn[..., :1], turn], axis=-1), assumed.carried, assumed.thrust)
        if assumed.loop_scale is None:
            return more
        return xp.concat([more[..., :2] / assumed.loop_scale[..., None, None] ** 2, more[..., 2:]], axis=-1)

    def _stiffness(self, assumed: Assumed) -> Array:
        """Gain (2,) or (..., 2) of a drone's attitude loop [N m/rad]."""
        kp = assumed.mass.__array_namespace__().asarray(self.model.kp, dtype=assumed.mass.dtype)
        return kp if assumed.loop_scale is None else kp * assumed.loop_scale[..., None] ** 2

    def _limits_of(self, like: Array) -> tuple[Array, Array]:
        """(torque per rotor force [m], largest force [N]) of the followers (F,)."""
        xp = like.__array_namespace__()
        parts = [self.model.of_followers(xp.asarray(part, dtype=like.dtype)) for part in (self.lever, self.most)]
        return parts[0], parts[1]

    def _of_all(self, led: Array, followed: Array) -> Array:
        """(..., N) of the leader's `led` (...) and `followed` (..., F)."""
        place = self.model.leader
        parts = [followed[..., :place], led[..., None], followed[..., place:]]
        return led.__array_namespace__().concat(parts, axis=-1)

    def _about_cg(self, lift: Array, mass: Array) -> Array:
        """Roll and pitch torque (..., 2) about the CG of `lift` (..., N), with the load at O [N m]."""
        xp = lift.__array_namespace__()
        x, y = xp.asarray(self.moment, dtype=lift.dtype)
        arm = (lift.sum(axis=-1) / mass)[..., None]
        return self.model.lever_torque(lift) - xp.concat([arm * y, -arm * x], axis=-1)

    def _share(self, safe: Array, alike: Array, first: Array, last: Array, assumed: Assumed, kp: Array) -> Array:
        """Largest share (..., 1) of the way from `safe` to `alike` (..., F) at which no rotor limits a torque.

        `first` and `last` (..., F, 3) are the corrections at its ends. Forces and torques are linear in between.
        """
        xp, carried = alike.__array_namespace__(), self.model.of_followers(assumed.carried)
        lever, most = self._limits_of(alike)
        per_rotor = carried / (4.0 * assumed.level[..., None])
        lifts = [per_rotor * (self.model.gravity + end + more[..., 2]) for end, more in ((safe, first), (alike, last))]
        turns = [kp[..., None, :] * more[..., :2] / lever[:, None] for more in (first, last)]
        most_share = 1.0 + 0.0 * alike[..., :1]
        for axis in (0, 1):
            for sign in (-1.0, 1.0):
                for low in (True, False):
                    over = [
                        sign * turn[..., axis] + (SPARE * most - lift if low else lift - (1.0 - SPARE) * most)
                        for turn, lift in zip(turns, lifts, strict=True)
                    ]
                    grows = over[1] - over[0]
                    reached = xp.where(grows > 0, -over[0] / xp.where(grows > 0, grows, 1.0), 1.0)
                    most_share = xp.minimum(most_share, xp.clip(reached, 0.0, 1.0).min(axis=-1)[..., None])
        return most_share

    def _within(self, vertical: Array, assumed: Assumed) -> Array:
        """`vertical` (..., F) [m/s2] within the limits of commands and of rotors that turn nothing."""
        xp, carried = vertical.__array_namespace__(), self.model.of_followers(assumed.carried)
        per_rotor = 4.0 * assumed.level[..., None] * self._limits_of(vertical)[1] / carried
        low, high = SPARE * per_rotor - self.model.gravity, (1.0 - SPARE) * per_rotor - self.model.gravity
        return xp.clip(xp.clip(vertical, low, high), -self.limits[1], self.limits[1])

    def _limited(self, rest: Array, followed: Array, assumed: Assumed, kp: Array) -> Array:
        """`followed` (..., F, 3) clipped to what commands and rotors allow; at `rest` (..., F, 2) nothing turns."""
        xp, carried = followed.__array_namespace__(), self.model.of_followers(assumed.carried)
        lever, most = self._limits_of(followed)
        vertical = self._within(followed[..., 2], assumed)
        hover = carried * (self.model.gravity + vertical) / (4.0 * assumed.level[..., None])
        room = lever * (xp.minimum(hover, most - hover) - SPARE * most)
        room = xp.maximum(room, 0.0 * room)[..., None] / kp[..., None, :]
        tilts = xp.clip(rest + xp.clip(followed[..., :2] - rest, -room, room), -self.limits[0], self.limits[0])
        return xp.concat([tilts, vertical[..., None]], axis=-1)


def level(observation: Array) -> Array:
    """Cosine (...) of the tilt in an `observation` (..., 18), at least a half."""
    xp = observation.__array_namespace__()
    return xp.maximum(xp.cos(observation[..., 3]) * xp.cos(observation[..., 4]), 0.5 + 0.0 * observation[..., 3])


def sharing(config: Config, model: AssemblyModel) -> Sharing:
    """That of the followers of `config`."""
    params, limits = plant_parameters(config.plant, config.attitude), config.command
    lever = torque_per_force(params.arm, config.plant.layout)
    both = limits.tilt_limit, limits.vertical_limit
    return Sharing(model, rigid_moment(params)[:2], both, params.rotor_force_max, lever)
