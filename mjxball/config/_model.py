"""A drone or a rig from a model in MJCF or URDF: masses, centres, inertia and rotors. Needs MuJoCo."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from mjxball.config._model_acts import (
    Rigid,
    Rotor,
    Slide,
    Thruster,
    check_all_was_named,
    refuse_disabled,
    refuse_other_models,
    without,
)
from mjxball.config._model_source import MAX_MODEL, ROTOR, captured_warnings, compiled, printable
from mjxball.errors import InputError
from mjxball.files import read_text

UPRIGHT = 1e-3  # largest angle of a rotor to z [rad]
WANTED = "expected rotors: <motor> on a <site> with gear 0 0 1 0 0 YAW"
Vector = np.ndarray


class RotorSite(NamedTuple):
    """The position of a rotor, from the file beside the model."""

    name: str  # a site or body at the rotor; with `place` the body in whose axes that is, "": the free body
    place: tuple[float, float, float] | None = None  # [m]


class ModelDrone(NamedTuple):
    """A drone; a single rotor stands for the thrust of all four, whose positions are then unknown."""

    name: str
    rigid: Rigid
    rotors: tuple[Rotor, ...]


class Model(NamedTuple):
    """One drone, or a rig of several drones on a carrier."""

    drones: tuple[ModelDrone, ...]
    carrier: Rigid | None  # the bodies without drones and load; None for a single drone
    load: tuple[Rigid, str] | None  # a body on slides, as at the start, and the slides' axes: x, y or xy
    gravity: float  # [m/s2]
    left_out: tuple[str, ...]  # properties of the model that a plant does not have


def read_model(path: Path, rotors: Sequence[RotorSite] = ()) -> Model:
    """The model in `path`; `rotors` are the positions of rotors if no actuators give them.

    Raises InputError unless it is a model of a quadrotor or of a rigid rig of several.
    """
    text = read_text(path, "model", MAX_MODEL)
    try:
        names = [rotor.name for rotor in rotors if not rotor.place]
        return _Tree(*compiled(path, text, names), rotors, path).model()
    except InputError as error:
        raise InputError(f"model {path}: {error}") from None


class _Tree:
    """The one tree of bodies that flies in a compiled model, in its initial state."""

    def __init__(self, model: Any, data: Any, is_urdf: bool, sites: Sequence[RotorSite], path: Path):
        import mujoco

        self.m, self.d, self.mujoco = model, data, mujoco
        self.is_urdf, self.sites, self.beside = is_urdf, sites, path.with_suffix(".toml").name
        self.root = self._root()
        self.turn = self.d.xmat[self.root].reshape(3, 3).T
        self.moments: set[int] = set()  # bodies on which actuators exert moments without forces
        self.bearing: set[int] = set()  # bodies with rotors
        self.left_out: list[str] = []
        self.thrusters: list[Thruster] = []
        self.slides: list[Slide] = []

    def model(self) -> Model:
        """The model; InputError for what a plant cannot represent."""
        refuse_other_models(self.m, self.root, self._named)
        if self.d.ncon:
            one, other = (self._named("geom", geom) for geom in self.d.contact[0].geom)
            raise InputError(f"{one} touches {other} at the start, expected no contact: the rig flies free")
        drones, carrier, load = self._bodies()
        rigids = [*(drone.rigid for drone in drones), *([carrier] if carrier else [])]
        slid = load[0] if load else None
        with captured_warnings():
            bare, lines = without(self.m, self.slides, slid.mass if slid else 0.0, self._named)
            check_all_was_named(bare, rigids, slid, self.slides, self.thrusters)
        return Model(drones, carrier, load, -self.m.opt.gravity[2], (*self.left_out, *lines))

    def _bodies(self) -> tuple[tuple[ModelDrone, ...], Rigid | None, tuple[Rigid, str] | None]:
        """(drones, carrier, load)."""
        groups = self._groups()
        if len(groups) == 1:
            (rotors,) = groups.values()
            self._load(lone=True)
            return (self._drone(self.root, rotors),), None, None
        if self.root in groups:
            raise InputError(
                f"{self._named('body', self.root)} carries rotors and drones, expected each drone in a body of its own"
            )
        drones = tuple(self._drone(body, rotors) for body, rotors in groups.items())
        flying = set().union(*(self._below(body) for body in groups))
        load, bodies = self._load(lone=False)
        return drones, self._rigid(self._below(self.root) - flying - bodies), load

    def _drone(self, body: int, rotors: Sequence[Rotor]) -> ModelDrone:
        return ModelDrone(self._name(body), self._rigid(self._below(body)), tuple(rotors))

    def _root(self) -> int:
        m, kinds = self.m, self.mujoco.mjtJoint
        free = [int(body) for body, kind in zip(m.jnt_bodyid, m.jnt_type, strict=True) if kind == kinds.mjJNT_FREE]
        if not free:
            raise InputError("no body of it flies, expected one with a <freejoint/>")
        if len(free) > 1:
            one, other = (self._named("body", body) for body in free[:2])
            raise InputError(f"{one} and {other} fly apart, expected one free body that carries everything")
        for joint, body in enumerate(m.jnt_bodyid):
            if m.body_rootid[body] != free[0]:
                raise InputError(f"{self._named('joint', joint)} moves what does not fly, expected one tree of bodies")
        return free[0]

    def _groups(self) -> dict[int, list[Rotor]]:
        """The rotors of every drone, by the body of the drone."""
        m = self.m
        found: dict[int, list[Rotor]] = {}
        for body, rotor in self._listed_rotors() if self.sites or self.is_urdf else self._actuated():
            found.setdefault(body, []).append(rotor)
        self.bearing = set(found)
        if not found:
            where = f"links called like rotors, or names or places in {self.beside}: rotors = [...]"
            raise InputError(f"it has no rotors, {f'expected {where}' if self.is_urdf else WANTED}")
        if len(found) > 1 and not self.moments and all(len(rotors) == 1 for rotors in found.values()):
            groups: dict[int, list[Rotor]] = {}
            for body, (rotor,) in found.items():  # each rotor is a body
                groups.setdefault(int(m.body_parentid[body]), []).append(rotor)
            found = groups
        for body, rotors in found.items():
            if len(rotors) not in ((1, 4) if body in self.moments else (4,)):
                named = f"; tell them in {self.beside}: rotors = [...]" if self.is_urdf else ""
                raise InputError(f"{self._named('body', body)} has {len(rotors)} rotors, expected 4 a drone{named}")
        return found

    def _listed_rotors(self) -> list[tuple[int, Rotor]]:
        """(body, rotor) from the file beside the model, without it from links of a URDF with names of rotors."""
        m, d, kind = self.m, self.d, self.mujoco.mjtObj
        if m.nu:
            self._leave_out("actuators: the file beside the model tells its rotors")
        links = [RotorSite(one) for body in range(m.nbody) if ROTOR.search(one := m.body(body).name)]
        found = []
        for name, place in self.sites or links:
            if place:
                body = self.mujoco.mj_name2id(m, kind.mjOBJ_BODY, name) if name else self.root
                self._check_listed(name, body)
                found.append((body, Rotor(self._here(d.xpos[body] + d.xmat[body].reshape(3, 3) @ place))))
                continue
            site = self.mujoco.mj_name2id(m, kind.mjOBJ_SITE, name)
            body = int(m.site_bodyid[site]) if site >= 0 else self.mujoco.mj_name2id(m, kind.mjOBJ_BODY, name)
            self._check_listed(name, body)
            point = d.site_xpos[site] if site >= 0 else d.xipos[body] if self.is_urdf else d.xpos[body]
            axis = self.turn @ (d.site_xmat[site] if site >= 0 else d.xmat[body]).reshape(3, 3)[:, 2]
            if self.is_urdf and (np.linalg.norm(axis[:2]) > UPRIGHT or axis[2] < 0):
                raise InputError(f"rotor {name} points along {_words(axis)}, expected 0 0 1: z is up")
            found.append((body, Rotor(self._here(point))))
        return found

    def _check_listed(self, name: str, body: int) -> None:
        if body <= 0 or self.m.body_rootid[body] != self.root:
            raise InputError(f"{self.beside} says rotors {name!r}, expected a site or body of what flies")

    def _actuated(self) -> list[tuple[int, Rotor]]:
        if self.m.nu != getattr(self.m, "nactuator", self.m.nu):  # from MuJoCo 3.13 on
            raise InputError(f"an actuator of it has several controls, {WANTED}")
        return [one for number in range(self.m.nu) if (one := self._actuator(number)) is not None]

    def _actuator(self, number: int) -> tuple[int, Rotor] | None:
        """(body, rotor) of an actuator; None if it exerts only a moment."""
        m, name = self.m, self._named("actuator", number)
        site, reference = m.actuator_trnid[number]
        if m.actuator_trntype[number] != self.mujoco.mjtTrn.mjTRN_SITE or reference >= 0:
            raise InputError(f"{name} acts on no site, {WANTED}")
        gain, lag = m.actuator_gainprm[number][0], self._lag(number)
        fixed = m.actuator_gaintype[number] == self.mujoco.mjtGain.mjGAIN_FIXED
        if not fixed or m.actuator_biasprm[number].any() or not gain or lag is None:
            raise InputError(f"{name} is no plain motor, {WANTED}")
        refuse_disabled(m, number, self._named)
        frame = self.turn @ self.d.site_xmat[site].reshape(3, 3)
        force, moment = (frame @ (gain * part) for part in m.actuator_gear[number].reshape(2, 3))
        body, size = int(m.site_bodyid[site]), float(np.linalg.norm(force))
        if not size:
            self.moments.add(body)
            return None
        if np.linalg.norm(force[:2]) > UPRIGHT * size or force[2] < 0 or np.linalg.norm(moment[:2]) > UPRIGHT * size:
            raise InputError(
                f"{name} pushes along {_words(force / size)} and turns about {_words(moment / size)} in the axes of "
                f"{self._named('body', self.root)}, expected 0 0 1 and 0 0 YAW: z is up"
            )
        low, high = self._inputs(number, gain)
        if high <= 0:
            raise InputError(f"{name} pushes with at most {high * size:g} N, expected more than 0")
        if -np.inf < low < 0:
            self._leave_out("rotors that push down")
        if low > 0:
            self._leave_out(f"the least force of rotors, {low * size:g} N by the lower end of ctrlrange or forcerange")
        most = high * size if np.isfinite(high) else None
        rotor = Rotor(self._here(self.d.site_xpos[site]), most, moment[2] / size, lag or None)
        self.thrusters.append(Thruster(number, size, (low, high), rotor))
        return body, rotor

    def _lag(self, number: int) -> float | None:
        """Time constant of an actuator [s], 0 without one; None for dynamics of another kind."""
        kind, kinds = int(self.m.actuator_dyntype[number]), self.mujoco.mjtDyn
        if kind == kinds.mjDYN_NONE:
            return 0.0
        filters = (kinds.mjDYN_FILTER, kinds.mjDYN_FILTEREXACT)
        return float(self.m.actuator_dynprm[number][0]) if kind in filters else None

    def _inputs(self, number: int, gain: float) -> tuple[float, float]:
        """Least and largest control by ctrlrange, actrange and forcerange."""
        m, low, high = self.m, -np.inf, np.inf
        if m.actuator_ctrllimited[number] and not m.opt.disableflags & self.mujoco.mjtDisableBit.mjDSBL_CLAMPCTRL:
            low, high = m.actuator_ctrlrange[number]
        if m.actuator_actlimited[number]:
            low, high = max(low, m.actuator_actrange[number][0]), min(high, m.actuator_actrange[number][1])
        if m.actuator_forcelimited[number]:
            least, most = sorted(m.actuator_forcerange[number] / gain)
            low, high = max(low, least), min(high, most)
        return float(low), float(high)

    def _load(self, lone: bool) -> tuple[tuple[Rigid, str] | None, set[int]]:
        """((load, axes of its slides) or None, its bodies); InputError if other bodies move, besides propellers."""
        m, kinds = self.m, self.mujoco.mjtJoint
        loads: dict[int, set[str]] = {}
        for joint, (body, kind) in enumerate(zip(m.jnt_bodyid, m.jnt_type, strict=True)):
            direction = self.turn @ self.d.xmat[body].reshape(3, 3) @ m.jnt_axis[joint]
            axis = np.abs(direction)
            if kind == kinds.mjJNT_FREE:
                continue
            if kind == kinds.mjJNT_HINGE and int(body) in self.bearing - {self.root}:
                self._leave_out("the spin of propellers")
                continue
            if lone or kind != kinds.mjJNT_SLIDE or axis[:2].max() < 1 - UPRIGHT or m.body_parentid[body] != self.root:
                raise InputError(
                    f"{self._named('joint', joint)} moves {self._named('body', int(body))}, expected a rigid "
                    f"{'drone' if lone else 'rig with at most a load that slides along x or y'}"
                )
            loads.setdefault(int(body), set()).add("xy"[int(axis[:2].argmax())])
            self.slides.append(Slide(joint, direction))
        if len(loads) > 1:
            one, other = (self._named("body", body) for body in [*loads][:2])
            raise InputError(f"{one} and {other} both slide, expected one load")
        for body, axes in loads.items():
            below = self._below(body)
            return (self._rigid(below), "".join(sorted(axes))), below
        return None, set()

    def _leave_out(self, what: str) -> None:
        if what not in self.left_out:
            self.left_out.append(what)

    def _here(self, point: Vector) -> Vector:
        return np.array(self.turn @ (point - self.d.xpos[self.root]))

    def _below(self, body: int) -> set[int]:
        """`body` and its descendants, which have larger indices."""
        found = {body}
        for other in range(body + 1, self.m.nbody):
            if int(self.m.body_parentid[other]) in found:
                found.add(other)
        return found

    def _rigid(self, bodies: Collection[int]) -> Rigid:
        """The `bodies` as one rigid body."""
        ids = sorted(bodies)
        masses, places = self.m.body_mass[ids], np.array([self._here(self.d.xipos[one]) for one in ids]).reshape(-1, 3)
        mass = float(masses.sum())
        centre = masses @ places / mass if mass else places.mean(axis=0)
        inertia = np.zeros((3, 3))
        for one, part, place in zip(ids, masses, places - centre, strict=True):
            frame = self.turn @ self.d.ximat[one].reshape(3, 3)
            inertia += frame @ np.diag(self.m.body_inertia[one]) @ frame.T
            inertia += part * (place @ place * np.eye(3) - np.outer(place, place))
        return Rigid(mass, centre, inertia)

    def _name(self, body: int) -> str:
        return printable(self.m.body(body).name)

    def _named(self, kind: str, number: int) -> str:
        return f"{kind} {printable(getattr(self.m, kind)(number).name) or number}"


def _words(vector: Vector) -> str:
    return " ".join(f"{part:.3g}" for part in vector + 0.0)
