"""Support: small models for MuJoCo, MJCF and URDF, of a drone and of a rig."""

from __future__ import annotations

from pathlib import Path

CROSS = ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))
SQUARE = tuple((0.5**0.5 * x, 0.5**0.5 * y) for x, y in ((1, -1), (-1, -1), (-1, 1), (1, 1)))
INERTIAL = '<inertial pos="0 0 0" mass="1.2" diaginertia="0.003 0.004 0.006"/>'


def rotors(name: str = "", arm: float = 0.15, places: tuple = CROSS, height: float = 0.02) -> str:
    """Four sites around a body's origin."""
    return "".join(
        f'<site name="{name}{number}" pos="{arm * x!r} {arm * y!r} {height}"/>' for number, (x, y) in enumerate(places)
    )


def motors(name: str = "", force: float = 7.0, yaw: float = 0.02, more: str = "") -> str:
    """Their actuators, which turn by + - + - `yaw` [m]."""
    return "".join(
        f'<motor name="{name}{n}" site="{name}{n}" gear="0 0 1 0 0 {yaw * (-1) ** n}" ctrlrange="0 {force}" {more}/>'
        for n in range(4)
    )


def mjcf(bodies: str, actuators: str, more: str = "") -> str:
    """A whole model."""
    return (
        f'<mujoco><compiler autolimits="true" angle="radian"/>{more}<worldbody>{bodies}</worldbody>'
        f"<actuator>{actuators}</actuator></mujoco>"
    )


DRONE = mjcf(f'<body name="quad" pos="0 0 1"><freejoint/>{INERTIAL}{rotors()}</body>', motors())


def rig(second: str = "", more: str = "") -> str:
    """A bar with a drone at each end, one heavier, turned, with stronger rotors.

    `second` goes into that one's body, `more` into the bar's.
    """
    bar = '<geom type="box" size="0.3 0.02 0.01" mass="0.25" contype="0" conaffinity="0"/>'
    heavy = '<inertial pos="0 0 0.01" mass="1.5" diaginertia="0.004 0.004 0.007"/>'
    return mjcf(
        f'<body name="bar" pos="0 0 1"><freejoint/>{bar}'
        f'<body name="one" pos="0.31 0 0.02">{INERTIAL}{rotors("a")}</body>'
        f'<body name="two" pos="-0.29 0.01 0.03" euler="0 0 0.4">{heavy}{rotors("b", 0.17)}{second}</body>'
        f"{more}</body>",
        motors("a") + motors("b", 9.0, -0.03),
    )


# The rig's load: a ball of the radius beside, with the armature of one that rolls.
BALL = "[plant]\nball_radius = 0.05"
LOAD = (
    '<body name="load"><joint name="slide" type="slide" axis="1 0 0" armature="0.12"/>'
    '<inertial pos="0 0 0" mass="0.3" diaginertia="0.0003 0.0003 0.0003"/></body>'
)


def urdf(mass: str = "0.6", names: str = "prop", inertial: bool = True) -> str:
    """A drone whose rotors are links without mass; its shape is a mesh that there is not."""
    inertia = '<inertia ixx="0.002" iyy="0.002" izz="0.0035" ixy="0" ixz="0" iyz="0"/>'
    own = f'<inertial><mass value="{mass}"/>{inertia}</inertial>' if inertial else ""
    shape = '<collision><geometry><mesh filename="package://none/frame.dae"/></geometry></collision>'
    links = "".join(
        f'<link name="{names}{n}"/><joint name="j{n}" type="fixed"><parent link="base"/><child link="{names}{n}"/>'
        f'<origin xyz="{0.14 * x} {0.14 * y} 0.01"/></joint>'
        for n, (x, y) in enumerate(SQUARE)
    )
    return f'<?xml version="1.0"?><robot name="quad"><link name="base">{own}{shape}</link>{links}</robot>'


def written(place: Path, text: str, beside: str = "", name: str = "model.xml") -> Path:
    """The model and, if it is not empty, the file beside it."""
    path = place / name
    path.write_text(text)
    path.with_suffix(".toml").unlink(missing_ok=True)
    if beside:
        path.with_suffix(".toml").write_text(beside)
    return path
