"""Settings of the plant: drones fixed to a carrier, and the load that moves on it. SI units, body axes, origin O."""

# Without `from __future__ import annotations`: the type of a field is read, and is no text.
from dataclasses import dataclass
from typing import Literal

from mjxball.config._leaf import Vector3, setting
from mjxball.errors import InputError


@dataclass(frozen=True)
class Drone:
    """One drone and its mount. A zero in a field after `yaw` stands for the plant's value, common to all drones."""

    mass: float = setting(1.0, "mass of the drone [kg]", low=1e-6, high=1e5)
    inertia: Vector3 = setting(
        (2.3e-3, 2.3e-3, 4.0e-3), "principal inertia about its own axes [kg m2]", low=1e-12, high=1e8
    )
    mount: Vector3 = setting((0.0, 0.0, 0.0), "centre of the drone from O, body axes [m]", low=-1e5, high=1e5)
    yaw: float = setting(0.0, "rotation about body z on the carrier [rad]", low=-6.3, high=6.3)
    arm: float = setting(0.0, "distance of its centre to each rotor, 0: plant.arm [m]", low=0, high=1e5)
    rotor_force_max: float = setting(0.0, "largest force of one rotor, 0: plant.rotor_force_max [N]", low=0, high=1e6)
    rotor_lag: float = setting(0.0, "time constant of a rotor's force, 0: plant.rotor_lag [s]", low=0, high=1e4)
    yaw_per_thrust: float = setting(
        0.0, "yaw moment of a rotor over its force, 0: plant.yaw_per_thrust [m]", low=0, high=1e5
    )


@dataclass(frozen=True)
class Plant:
    """A rigid carrier with drones, one of which leads, and a load that moves. Defaults are the `paper` plant."""

    drones: tuple[Drone, ...] = (Drone(mount=(0.17, 0.0, 0.0)), Drone(mount=(-0.17, 0.0, 0.0)))
    leader: int = setting(0, "index of the drone that leads, from 0", low=0, high=15)
    carrier_mass: float = setting(
        0.0, "mass of the carrier, without the part of the object that does not move [kg]", low=0, high=1e5
    )
    carrier_inertia: Vector3 = setting(
        (0.0, 0.0, 0.0), "principal inertia of the carrier about O [kg m2]", low=0, high=1e8
    )
    object_mass: float = setting(0.2, "nominal mass of the object [kg]", low=1e-12, high=1e5)
    object_size: Vector3 = setting(
        (0.34, 0.10, 0.05), "edges of the object, a uniform box centred at O [m]", low=1e-6, high=1e5
    )
    moving_fraction: float = setting(
        1.0, "share of the object's mass that moves; the rest is a fixed box centred at O", low=1e-6, high=1
    )
    ball_radius: float = setting(0.02, "radius of the moving ball [m]", low=1e-6, high=1e4)
    ball_stop: float = setting(
        0.0,
        "distance of the ball's centre from O at an end stop or the rim, 0: at the object's end [m]",
        low=0,
        high=1e4,
    )
    cg_axis: Literal["x", "y", "xy"] = setting(
        "x", "body axis along which the CG moves and a pair is mounted; xy: the CG moves in the plane"
    )
    stand: Literal["free", "pivot", "heave"] = setting(
        "free", "free flight; pivot: O fixed, only roll free; heave: roll and height free"
    )
    arm: float = setting(0.12, "distance of a drone's centre to each rotor [m]", low=1e-6, high=1e5)
    layout: Literal["plus", "x"] = setting(
        "plus", "rotors on the body axes, 1 at +x, 2 at +y; or between them as on a Crazyflie, 1 at +x -y, 2 at -x -y"
    )
    rotor_force_max: float = setting(5.5, "largest force of one rotor [N]", low=1e-6, high=1e6)
    rotor_lag: float = setting(0.03, "time constant of a rotor's force [s]", low=1e-9, high=1e4)
    yaw_per_thrust: float = setting(0.02, "yaw moment of a rotor over its force [m]", low=1e-9, high=1e5)
    gravity: float = setting(9.81, "gravitational acceleration [m/s2]", low=1e-6, high=1e4)
    mount_frequency: float = setting(
        0.0,
        "elastic mounts: frequency of a drone that turns about its own x or y on a carrier held still, 0: rigid [Hz]",
        low=0,
        high=1e4,
    )
    mount_damping: float = setting(0.02, "damping ratio of that oscillation", low=0, high=1)

    def __repr__(self) -> str:
        """A summary; `to_json` gives every setting."""
        mass = sum(drone.mass for drone in self.drones) + self.carrier_mass + self.object_mass
        load = f"object {self.object_mass:g} kg along {self.cg_axis}"
        return (
            f"<Plant of {self.count} drones, {mass:.4g} kg, {load}{'' if self.stand == 'free' else f', {self.stand}'}>"
        )

    def _repr_html_(self) -> str:
        """The rig from above, for notebooks."""
        from mjxball import pictures

        facts = {
            "masses": f"{', '.join(f'{drone.mass:g}' for drone in self.drones)} kg, object {self.object_mass:g} kg",
            "leader": f"drone {self.leader}, filled",
            "load moves along": self.cg_axis,
        }
        mounts = [drone.mount for drone in self.drones]
        drawn = pictures.plan(mounts, self.leader, self.of_drones("arm"), self.object_size)
        return pictures.summary(f"rig of {self.count} drones, from above", facts, drawn)

    @property
    def count(self) -> int:
        """Number of drones N."""
        return len(self.drones)

    @property
    def is_team(self) -> bool:
        """Whether followers use mount frames: there are several, or the load moves in the plane."""
        return len(self.drones) > 2 or len(self.directions) == 2

    @property
    def followers(self) -> tuple[int, ...]:
        """Indices of all drones but the leader, in order."""
        return tuple(number for number in range(len(self.drones)) if number != self.leader)

    @property
    def pair(self) -> tuple[Drone, Drone]:
        """Leader and follower of a plant of two drones whose load moves along a line; InputError for other plants.

        Flights of pairs need such a plant; the physics does not.
        """
        if len(self.drones) != 2 or len(self.directions) != 1:
            where = "along a line" if len(self.directions) == 1 else "in the plane"
            raise InputError(
                "flights need a leader, one follower and a load that moves along a line; this plant has "
                f"{self.count} drones and a load that moves {where}"
            )
        if self.leader != 0:
            raise InputError("flights need the leader listed first, and plant.leader is 1")
        return self.drones[0], self.drones[1]

    @property
    def directions(self) -> tuple[int, ...]:
        """Body axes (0 x, 1 y) along which the load moves: one for a line, two for a plane."""
        return tuple("xy".index(axis) for axis in self.cg_axis)

    @property
    def is_disc(self) -> bool:
        """Whether pictures show a disc: the load moves in the plane, and all drones are mounted within that disc."""
        radius = min(self.object_size[:2]) / 2
        ring = all(drone.mount[0] ** 2 + drone.mount[1] ** 2 <= (1.01 * radius) ** 2 for drone in self.drones)
        return len(self.directions) == 2 and ring

    @property
    def load_shares(self) -> tuple[float, ...]:
        """Share of the load's weight that each drone carries, with the CG at O.

        Of all shares that add up to 1 and have no moment about O, those with the least sum of squares:
        1/N - (r_i - m) C^-1 m, with mean m and scatter C of the mounts along the load's directions (ours).
        """
        count, axes = len(self.drones), self.directions
        mean = [sum(drone.mount[axis] for drone in self.drones) / count for axis in axes]
        off = [[drone.mount[axis] - m for axis, m in zip(axes, mean, strict=True)] for drone in self.drones]
        scatter = [[sum(row[i] * row[j] for row in off) for j in range(len(axes))] for i in range(len(axes))]
        weights = _solved(scatter, mean)
        return tuple(1 / count - sum(a * b for a, b in zip(row, weights, strict=True)) for row in off)

    @property
    def known_masses(self) -> tuple[float, ...]:
        """Mass that each drone lifts besides its share of the load [kg]: its own and the same share of the carrier."""
        return tuple(
            drone.mass + share * self.carrier_mass for drone, share in zip(self.drones, self.load_shares, strict=True)
        )

    def of_drones(self, name: str) -> tuple[float, ...]:
        """`name` (arm, rotor_force_max, rotor_lag or yaw_per_thrust) of every drone; a zero is the plant's value."""
        return tuple(getattr(drone, name) or getattr(self, name) for drone in self.drones)


def _solved(matrix: list[list[float]], vector: list[float]) -> list[float]:
    """Least-norm solution of a symmetric system of one or two equations, which may be singular."""
    if len(vector) == 1:
        return [vector[0] / matrix[0][0]] if matrix[0][0] > 0 else [0.0]
    (a, b), (_, d) = matrix
    determinant, trace = a * d - b * b, a + d
    x, y = vector
    if determinant > 1e-9 * trace * trace:
        return [(d * x - b * y) / determinant, (a * y - b * x) / determinant]
    square = trace * trace or 1.0
    return [(a * x + b * y) / square, (b * x + d * y) / square]
