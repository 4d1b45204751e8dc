"""Ranges from which whole rigs are drawn, for a follower that flies any of them."""

from __future__ import annotations

from dataclasses import dataclass

from mjxball.config._leaf import Range, drawn, setting


@dataclass(frozen=True)
class Rigs:
    """Random rigs (`sim.rigs`) of `scenario.team_sizes` drones, their loads included; by factor: even in the logarithm.

    The object's mass, beliefs, thrusts and how far the CG goes are then those of the rig, and `scenario` says how it
    moves and what disturbs.
    """

    number: int = setting(0, "rigs of each size that training draws its worlds from; 0: the plant's own", low=0)
    drone_mass: Range = drawn((0.03, 3.0), "mass of each drone, by factor [kg]", above=0)
    arm_scale: Range = drawn((0.8, 1.25), "factor on the rotors' arm, which is 0.12 m at 1 kg", above=0)
    inertia_scale: Range = drawn((0.7, 1.4), "factor on a drone's own inertia", above=0)
    spacing: Range = drawn((2.3, 4.5), "distance of neighbours on the ring over the arm", above=0)
    mount_jitter: float = setting(
        0.1,
        "each mount is off the even ring by up to this share of its radius and of the angle between two",
        low=0,
        high=0.3,
    )
    yaw_per_thrust: Range = drawn((0.1, 0.25), "yaw moment of a rotor over its force, over the arm", above=0)
    thrust_to_weight: Range = drawn((1.6, 4.0), "all rotors' largest force over the weight with the load", above=1)
    rotor_lag: Range = drawn((0.015, 0.15), "time constant of the rotors, by factor [s]", above=0)
    carrier_share: Range = drawn((0.02, 0.1), "mass of the carrier over that of all drones", above=0)
    object_share: Range = drawn((0.05, 0.6), "mass of the object over that of all drones", above=0)
    believed_factor: float = setting(
        2.0, "largest factor by which the object's mass is believed wrongly", low=1, high=4
    )
    thrust_scale: Range = drawn((0.8, 1.2), "share that each drone gives of the force it is asked for", above=0)
    thrust_fade: Range = drawn(
        (0.0, 0.002), "share of all thrust that is lost in a second as batteries empty [1/s]", low=0, high=0.02
    )
    loop_frequency: Range = drawn((4.0, 20.0), "natural frequency of the pitch loop, by factor [rad/s]", above=0)
    loop_damping: Range = drawn((0.5, 1.1), "damping of the attitude loops without rotor lag", above=0)
    unsaturated_tilt: float = setting(
        0.15, "tilt step that all rotors can answer without saturation, at least: it caps loop_frequency [rad]", above=0
    )
    least_damping: float = setting(
        0.3, "rigs whose loops are damped by less with their rotor lag are drawn anew", low=0, high=1
    )
    mass_step: float = setting(
        0.0,
        "in flight the object's mass changes by up to this share of itself, as far as that can be trimmed",
        low=0,
        high=0.9,
    )
