"""Motions of the object's centre of gravity along a body axis or in the carrier's plane."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mjxball.arrays import Array
from mjxball.config import Config, cg_limit
from mjxball.errors import InputError
from mjxball.physics.engine import CgState, Load, PathShape, from_coordinates
from mjxball.plant import PlantParameters, plant_parameters

if TYPE_CHECKING:
    from jaxtyping import Float

    from mjxball.physics.engine import Coordinates, Scalar

Prescribed = Callable[[Array, Load], CgState]
ROLLING_FRICTION = 0.005  # over the normal force
STOP_FREQUENCY, STOP_DAMPING = 60.0, 0.4  # of the ball against an end stop [rad/s]; 1 does not bounce
TINY = 1e-18  # [m2], [m2/s2]
CREEP = 0.005  # [m/s] below which rolling friction fades to zero, so that its sign is smooth


def sine(time: Scalar, amplitude: Scalar, speed: Scalar, phase: Scalar) -> CgState:
    """c = A sin(Omega t + phase) and its two derivatives; `speed` is Omega [rad/s]."""
    angle = speed * time + phase
    xp = angle.__array_namespace__()
    offset = amplitude * xp.sin(angle)
    return CgState(offset, amplitude * speed * xp.cos(angle), -speed * speed * offset)


def waypoints(
    time: Scalar, amplitude: Scalar, speed: Scalar, phase: Scalar, places: Float[Array, "... places"]
) -> CgState:
    """The CG moves from waypoint to waypoint, `places` in units of the amplitude, in a closed loop (ours).

    Each segment takes half a period of the sine, pi / Omega, along the quintic that starts and ends at rest. Between
    the ends of the object its speed and acceleration are at most 1.2 times that sine's.
    """
    xp = time.__array_namespace__()
    count = places.shape[-1]
    way = (speed * time + phase) / math.pi
    number = xp.floor(way)
    s, pace = way - number, speed / math.pi
    first = xp.astype(number[..., None] % count, number.dtype) == xp.arange(count, dtype=number.dtype)
    start = (first * places).sum(axis=-1)
    change = (first * xp.roll(places, -1, axis=-1)).sum(axis=-1) - start
    rest = 1.0 - s
    return CgState(
        amplitude * (start + change * s * s * s * (10.0 - 15.0 * s + 6.0 * s * s)),
        amplitude * change * pace * 30.0 * s * s * rest * rest,
        amplitude * change * pace * pace * 60.0 * s * rest * (1.0 - 2.0 * s),
    )


def sine_or_waypoints(time: Scalar, load: Load) -> CgState:
    """Motion of the CG on a line: the flight's sine, or its waypoints where `load.follows_path`."""
    sines = (load.cg_amplitude, load.cg_speed, load.cg_phase)
    swinging = sine(time, *sines)
    if load.cg_path is None or load.follows_path is None:
        return swinging
    xp = time.__array_namespace__()
    travelling = waypoints(time, *sines, load.cg_path)
    return CgState(*(xp.where(load.follows_path > 0, b, a) for a, b in zip(swinging, travelling, strict=True)))


def lissajous(time: Scalar, amplitude: Scalar, speed: Scalar, phase: Scalar, shape: PathShape | None) -> CgState:
    """(A sin a, width A sin(ratio a + lead)) (..., 2), a = Omega t + phase, turned by the direction of `shape`."""
    first = sine(time, amplitude, speed, phase)
    if shape is None:
        return CgState(*(from_coordinates([value, value.__array_namespace__().zeros_like(value)]) for value in first))
    second = sine(time, amplitude * shape.width, speed * shape.ratio, phase * shape.ratio + shape.lead)
    xp = shape.direction.__array_namespace__()
    c, s = xp.cos(shape.direction), xp.sin(shape.direction)
    return CgState(*(from_coordinates([c * u - s * v, s * u + c * v]) for u, v in zip(first, second, strict=True)))


def lissajous_or_waypoints(time: Scalar, load: Load) -> CgState:
    """As `sine_or_waypoints` in the plane; the CG moves in straight lines between waypoints."""
    sines = (load.cg_amplitude, load.cg_speed, load.cg_phase)
    swinging = lissajous(time, *sines, load.cg_shape)
    if load.cg_path is None or load.follows_path is None:
        return swinging
    xp, follows = time.__array_namespace__(), load.follows_path[..., None] > 0
    ways = zip(*(waypoints(time, *sines, load.cg_path[..., axis]) for axis in (0, 1)), strict=True)
    return CgState(*(xp.where(follows, from_coordinates(b), a) for a, b in zip(swinging, ways, strict=True)))


class Spline(NamedTuple):
    """A C2 cubic spline: on piece k, c = sum_j coefficients[k, j] (t - times[k])^(3 - j)."""

    times: Float[np.ndarray, " n"]  # knots [s]
    coefficients: Float[np.ndarray, "n-1 4"]


def fit_spline(times: Any, offsets: Any) -> Spline:
    """The clamped cubic spline (c' = 0 at both ends) through the samples, so that c' and c'' are consistent."""
    from scipy.interpolate import CubicSpline

    spline = CubicSpline(np.asarray(times, float), np.asarray(offsets, float), bc_type="clamped")
    return Spline(spline.x, np.ascontiguousarray(spline.c.T))


def largest_offset(spline: Spline) -> float:
    """Largest |c| that the spline reaches, between its samples included [m]."""
    from scipy.interpolate import PPoly

    curve = PPoly(spline.coefficients.T, spline.times)
    turns = curve.derivative().roots(extrapolate=False)
    places = np.concatenate([spline.times, turns[np.isfinite(turns)]])
    return float(np.abs(curve(places)).max())


def follow_spline(spline: Spline, time: Scalar) -> CgState:
    """Offset, rate and acceleration of `spline` at `time`; before and after its knots the CG stands still."""
    xp = time.__array_namespace__()
    knots, table = (xp.asarray(value, dtype=time.dtype) for value in spline)
    piece = xp.clip((time[..., None] >= knots[1:-1]).sum(axis=-1), 0, len(spline.times) - 2)
    a, b, c, d = (table[piece, j] for j in range(4))
    inside = (time >= knots[0]) & (time <= knots[-1])
    s = xp.clip(time, knots[0], knots[-1]) - knots[piece]
    rate = (3 * a * s + 2 * b) * s + c
    zero = xp.zeros_like(rate)
    acceleration = 6 * a * s + 2 * b
    return CgState(((a * s + b) * s + c) * s + d, xp.where(inside, rate, zero), xp.where(inside, acceleration, zero))


def make_cg_motion(config: Config) -> Prescribed:
    """Return `prescribed(time, load)`, the motion of the CG of the kinds sine and waveform.

    Raises InputError if the spline of a waveform leaves the object between its samples.
    """
    in_plane, waves = len(config.plant.directions) == 2, config.motion
    if waves.kind == "sine":
        return lissajous_or_waypoints if in_plane else sine_or_waypoints
    spline = fit_spline(waves.times, waves.offsets)
    across = fit_spline(waves.times, waves.offsets_across or (0.0,) * len(waves.times)) if in_plane else None
    limit, farthest = cg_limit(config.plant), largest_offset(spline) if across is None else _farthest(spline, across)
    if farthest > limit + 1e-9:
        raise InputError(
            f"the waveform swings to {farthest:.4g} m between its samples "
            f"and leaves the object: the CG reaches {limit:.4g} m; add samples"
        )
    if across is None:
        return lambda time, load: follow_spline(spline, time)

    def follow(time: Scalar, load: Load) -> CgState:
        both = zip(follow_spline(spline, time), follow_spline(across, time), strict=True)
        return CgState(*(from_coordinates(pair) for pair in both))

    return follow


def _farthest(along: Spline, across: Spline) -> float:
    """Largest distance from O [m], from 100 times between every two samples."""
    shares = np.linspace(0, 1, 100)
    time = (along.times[:-1, None] + np.diff(along.times)[:, None] * shares).ravel()
    return float(np.hypot(follow_spline(along, time).offset, follow_spline(across, time).offset).max())


def make_rolling_force(
    config: Config, parameters: PlantParameters | None = None
) -> Callable[[Coordinates, Coordinates, Scalar], Coordinates]:
    """Return `force(offset, rate, ball_mass)` [N] along the load's directions: rolling friction and end stops.

    Friction is -mu m_b g tanh(v / creep). A stop is a one-sided spring and damper that never pulls; the inertia against
    it is 7/5 m_b, that of a solid ball that rolls (ours). The rim of a plate is round and acts along the radius alone.
    """
    params = plant_parameters(config.plant, config.attitude) if parameters is None else parameters
    end, gravity = params.ball_limit, params.gravity
    directions = len(config.plant.directions)
    stiffness = 1.4 * STOP_FREQUENCY**2
    damping = 1.4 * 2 * STOP_DAMPING * STOP_FREQUENCY

    def on_rod(offset: Scalar, rate: Scalar, ball_mass: Scalar) -> Scalar:
        xp = offset.__array_namespace__()
        friction = -ROLLING_FRICTION * gravity * xp.tanh(rate / CREEP)
        beyond = xp.maximum(offset - end, 0.0)
        below = xp.maximum(-end - offset, 0.0)
        upper = xp.where(beyond > 0, xp.minimum(-stiffness * beyond - damping * rate, 0.0), 0.0)
        lower = xp.where(below > 0, xp.maximum(stiffness * below - damping * rate, 0.0), 0.0)
        return ball_mass * (friction + upper + lower)

    def on_plate(offset: Coordinates, rate: Coordinates, ball_mass: Scalar) -> Coordinates:
        xp = offset.__array_namespace__()
        # Both lengths are never 0, so that their gradients exist.
        speed = xp.sqrt((rate * rate).sum(axis=-1) + TINY)[..., None]
        distance = xp.sqrt((offset * offset).sum(axis=-1) + TINY)[..., None]
        outwards = offset / distance
        friction = -ROLLING_FRICTION * gravity * xp.tanh(speed / CREEP) * rate / speed
        beyond = xp.maximum(distance - end, 0.0)
        along = (outwards * rate).sum(axis=-1)[..., None]
        stop = xp.where(beyond > 0, xp.minimum(-stiffness * beyond - damping * along, 0.0), 0.0)
        return ball_mass[..., None] * (friction + stop * outwards)

    return on_rod if directions == 1 else on_plate


def object_mass(time: Scalar, load: Load) -> Scalar:
    """The object's mass [kg] at `time`; a change of mass leaves all velocities as they are."""
    due = time[..., None] >= load.mass_change_time
    return load.object_mass + (due * load.mass_change).sum(axis=-1)
