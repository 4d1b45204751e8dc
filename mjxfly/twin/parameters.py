"""Parameters of one drone of the twin: the firmware's table, the values after boot, and the effect of writes.

Names, types and defaults are those of bitcraze/crazyflie-firmware 2026.08 with the drivers of its decks.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from typing import NamedTuple

from mjxfly.app.protocol import CONTROLLER, GROUP, OUT_OF_TREE, PID
from mjxfly.app.protocol import PARAMETERS as APP_PARAMETERS
from mjxfly.twin.conditions import DroneKind
from mjxfly.twin.logs import listed

TYPES = {"uint8_t": (8, "B"), "uint16_t": (9, "H"), "uint32_t": (10, "I"), "int8_t": (0, "b")}
TYPES |= {"int16_t": (1, "h"), "int32_t": (2, "i"), "float": (6, "f")}
READ_ONLY, EXTENDED = 0x40, 0x10
# Requests that the firmware resets to 0 within about a millisecond: a radio never reads the written value back.
CLEARED = {"kalman.resetEstimation", "supervisor.infdmp", "syslink.probe", "system.taskDump", "system.storageStats"}
CLEARED |= {"health.startPropTest", "health.startBatTest"}
ESTIMATOR = "stabilizer.estimator"
COMPLEMENTARY, KALMAN = 1, 2  # values of `ESTIMATOR`
CONTROLLERS = {PID, 2, 3, 4, 5}  # PID, Mellinger, INDI, Brescianini, Lee
MASSES = {"thrust-upgrade": 0.0325, "brushless": 0.0393}  # [kg] by motor: defaults of the Lee and Mellinger controllers


class Parameter(NamedTuple):
    """One parameter of the firmware."""

    name: str  # "group.name"
    kind: str  # a key of TYPES
    default: float
    read_only: bool = False
    persistent: bool = False

    @property
    def type_byte(self) -> int:
        """Type and flags in the table of contents."""
        return TYPES[self.kind][0] | READ_ONLY * self.read_only | EXTENDED * self.persistent

    def pack(self, value: float) -> bytes:
        """Encode `value` in the parameter's type."""
        return struct.pack("<" + TYPES[self.kind][1], value if self.kind == "float" else int(value))

    def unpack(self, data: bytes) -> float:
        """Decode `data`. Raises struct.error for a wrong length."""
        return float(struct.unpack("<" + TYPES[self.kind][1], data)[0])


PARAMETERS = tuple(
    Parameter(row["name"], row["type"], float(row["default"] or 0), row["access"] == "r", row["access"] == "p")
    for row in listed("param")
)
OF_APP = tuple(Parameter(f"{GROUP}.{name}", kind, 0.0, read_only) for name, kind, read_only in APP_PARAMETERS)


def defaults_of(kind: DroneKind) -> dict[str, float]:
    """Return the parameters' values after boot of a drone of a `kind`, without decks and apps."""
    values = {parameter.name: parameter.default for parameter in PARAMETERS}
    values["powerDist.idleThrust"] = float(kind.idle)
    if kind.motor == "brushless":
        values["pm.lowVoltage"], values["posCtlPid.thrustBase"] = 3.35, 30000.0
    for controller in ("ctrlLee", "ctrlMel"):
        values[f"{controller}.mass"] = MASSES.get(kind.motor, values[f"{controller}.mass"])
    for axis in ("roll", "pitch"):
        values[f"pid_rate.{axis}_kp"] = kind.rate_gain
        values[f"pid_rate.{axis}_ki"] = 2 * kind.rate_gain
    return values


class Values:
    """Parameter values of one drone."""

    def __init__(
        self,
        kind: DroneKind,
        on_write: Callable[[str, float], None] = lambda name, value: None,
        decks: Mapping[str, float] | None = None,
        app: Callable[[], Mapping[str, float]] | None = None,
    ):
        """`on_write(name, value)` is called after every write, with the value in force or a request that clears itself.

        `decks`: values after boot that the decks change. `app` returns the values of the app's parameters.
        """
        self.listed = PARAMETERS + (() if app is None else OF_APP)
        self.defaults = defaults_of(kind) | dict(decks or {}) | {one.name: one.default for one in OF_APP}
        controllers = CONTROLLERS
        if app is not None:  # a firmware built with an app starts with the out-of-tree controller
            controllers = {*CONTROLLERS, OUT_OF_TREE}
            self.defaults[CONTROLLER] = float(OUT_OF_TREE)
        # Parameters that select a component: the valid values, and the one that 0 selects.
        self._choices = {
            CONTROLLER: (controllers, self.defaults[CONTROLLER]),
            ESTIMATOR: ({COMPLEMENTARY, KALMAN}, float(COMPLEMENTARY)),
        }
        self._values, self._on_write, self._app = dict(self.defaults), on_write, app

    def __getitem__(self, name: str) -> float:
        group, _, variable = name.partition(".")
        return self._app()[variable] if self._app is not None and group == GROUP else self._values[name]

    def write(self, name: str, value: float) -> None:
        """Write a value; an unknown value of a selection changes nothing."""
        if name in self._choices:
            known, default = self._choices[name]
            value = default if value == 0 else value if value in known else self._values[name]
        self._values[name] = 0.0 if name in CLEARED else value
        self._on_write(name, value)
