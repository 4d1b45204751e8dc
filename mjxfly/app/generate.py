"""Generation of the apps of two Crazyflies from a policy: C sources, headers, files of the firmware's build."""

from __future__ import annotations

import json
import math
import shutil
import tempfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjxball.config import Config
from mjxball.errors import InputError
from mjxball.policy.file import PolicyFile
from mjxball.policy.formats.c_header import APP, c_header, float_bytes, footprint, weight_bytes
from mjxfly import flight, policy_setup, setpoints, takeoff
from mjxfly.app.protocol import CAUSES
from mjxfly.setpoints import CURVE_NAMES
from mjxfly.telemetry import Rig

CORE = ("core.h", "core.c", "checks.h", "controllers.h", "packets.h")  # without firmware types
SOURCES = (*CORE, "glue.c")
ROLES = ("leader", "follower")
PERIODS = (5, 20)  # [ms] shortest and longest control period of an app
STACK = 2400  # [bytes] of the app's task without the network's arrays
# Metadata, besides the weights' shapes, in which leader, follower and an upload must agree.
SAME = (
    "history",
    "previous_action",
    "filters",
    "action_mode",
    "action_reach",
    "command_limits",
    "leader_kp",
    "leader_kd",
    "gravity",
    "control_period",
    "plant",
    "config",
)
# Constants of the laptop's flight that the C files use by their names here, `rig.h` defines them.
SHARED = {
    setpoints: ("NEAR_GROUND", "BRAKE_TILT"),
    flight: ("LIFTED",),
    takeoff: (
        *("BEGIN", "MOST_LIFT", "CLIMB", "CLIMB_GAIN", "CLIMB_INTEGRAL"),
        *("LEVEL_GAIN", "LEVEL_DAMPING", "LEVEL_INTEGRAL", "LOAD", "APART"),
    ),
}
EXACT = ("-ffp-contract=off", "-fno-math-errno")


def sources() -> Path:
    """Return the directory of the C files that do not depend on the policy."""
    return Path(__file__).parent


def options(int8: bool) -> tuple[str, ...]:
    """Return gcc's options for `core.c`: 8 bit weights need -O2; with float32, -Os is smaller and no slower."""
    return ("-O2" if int8 else "-Os", *EXACT)


def key_of(policy: PolicyFile) -> int:
    """Return the compatibility key: a CRC of `SAME` and the weights' shapes, not of the weights."""
    fields = {name: policy.metadata.get(name) for name in SAME}
    shapes = [array.shape for array in (*policy.weights, *(policy.gru or ()))]
    return zlib.crc32(json.dumps([fields, shapes], sort_keys=True).encode())


def weights_crc(policy: PolicyFile, int8: bool) -> int:
    """Return the CRC of the weights in their encoding on board."""
    return zlib.crc32(weight_bytes(policy) if int8 else float_bytes(policy))


def check_policy(policy: PolicyFile, name: str) -> Config:
    """Return the configuration of a policy that can fly on board. Raises InputError for another plant or period."""
    plant = policy.metadata["plant"]
    drones = plant.get("drones", ())
    if policy.metadata.get("firmware") is None or (drones and len(drones) != 2):
        raise InputError(f"{name} is for another plant than a pair of Crazyflies, such as that of flight")
    period = 1000 * float(policy.metadata["control_period"])
    if abs(period - round(period)) > 1e-6 or not PERIODS[0] <= round(period) <= PERIODS[1]:
        wanted = f"whole milliseconds from {PERIODS[0]} to {PERIODS[1]}"
        raise InputError(f"{name} has a control period of {period:g} ms; an app keeps {wanted}")
    return policy_setup.config_of(policy.metadata)


def rig_header(policy: PolicyFile, config: Config, int8: bool) -> str:
    """Return `rig.h`: parameters of both controllers and of the supervisor, and a sentence for each `CAUSES`."""
    leader, stand = config.leader, config.plant.stand != "free"
    goal, rig = policy_setup.goal_of(config), Rig.of_plant(config.plant)
    bounds = policy_setup.limits_of(config, goal)
    variants = policy_setup.variants(config)
    angle = policy_setup.mount_angle(policy.metadata)
    first = next(iter(variants[0]))
    fields: dict[str, Any] = {
        "ident": f"{weights_crc(policy, int8)}u",
        "key": f"{key_of(policy)}u",
        "period": round(1000 * config.timing.control_period),
        "mount": [rig.leader_mount, rig.follower_mount],
        **({"mount_frame": [math.cos(angle), math.sin(angle)]} if "team" in policy.metadata else {}),
        "carried": [own[first].map.carried_mass for own in variants],
        "kp": leader.kp,
        "kd": leader.kd,
        "ki": leader.ki,
        "band": leader.integral_error_limit,
        "lead": leader.integral_lead_time,
        "stand": int(stand),
        "own_error": int(leader.error != "object"),
        "knows_rates": int(config.scenario.goal_motion_probability > 0),
        "paper": int(config.autopilot.thrust_law == "paper"),
        "goal": goal,
        "fence_low": bounds.fence_low,
        "fence_high": bounds.fence_high,
        "land_spare": policy_setup.times_of(config).land_spare,
        "battery": bounds.battery,
        "maps": [_map(variants[0].get(name)) for name in CURVE_NAMES],
    }
    lines = ",\n".join(f"    .{name} = {_literal(value)}" for name, value in fields.items())
    causes = ",\n".join(f'    "{text}"' for text in CAUSES)
    defined = "".join(
        f"#define {name} {_literal(float(getattr(module, name)))}\n"
        for module, names in SHARED.items()
        for name in names
    )
    return (
        f"/* See core.h. */\n#pragma once\n{defined}"
        f"static const mjxball_rig_parameters mjxball_rig = {{\n{lines},\n}};\n\n"
        f"static const char *const mjxball_texts[MJXBALL_CAUSES] = {{\n{causes},\n}};\n"
    )


def _map(variant: Any) -> list[Any]:
    """Fields of `mjxball_map`; `variant` None: a force curve with which the policy does not fly."""
    if variant is None:
        return [1.0, 0.0, 0.0, 1.0, 0]
    thrust = variant.map
    return [thrust.hover, thrust.per_acceleration, thrust.curve.quadratic, thrust.curve.linear, 1]


def _literal(value: Any) -> str:
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "{" + ", ".join(map(_literal, value)) + "}"
    if isinstance(value, float):
        return np.format_float_scientific(np.float32(value), unique=True, trim="0") + "f"
    return str(value)


def files_of(policy: PolicyFile, name: str, int8: bool) -> Mapping[str, str]:
    """Return the contents of all files of the apps by path. Raises InputError if the policy cannot fly on board."""
    config = check_policy(policy, name)
    cost = footprint(policy, int8)
    files = {f"src/{one}": (sources() / one).read_text(encoding="utf-8") for one in SOURCES}
    files["src/policy.h"] = c_header(policy, name, int8, APP)
    files["src/rig.h"] = rig_header(policy, config, int8)
    for number, role in enumerate(ROLES):
        stack = STACK + (cost.stack if number else 0)
        files[f"{role}/Makefile"] = MAKEFILE
        files[f"{role}/Kbuild"] = "obj-y += src/\n"
        files[f"{role}/app-config"] = APP_CONFIG.format(words=math.ceil(stack / 4))
        files[f"{role}/src/Kbuild"] = KBUILD.format(options=" ".join(options(int8)), number=number)
        for one in ("core", "glue"):
            files[f"{role}/src/{one}.c"] = f'#include "../../src/{one}.c"\n'
    weights = "8 bit" if int8 else "float32"
    files["README.md"] = README.format(
        name=name,
        hash=policy.metadata["config_hash"],
        weights=weights,
        period=round(1000 * config.timing.control_period),
        flash=cost.flash,
        ident=weights_crc(policy, int8),
    )
    return files


def check_place(place: Path) -> None:
    """Raise InputError unless a directory can be created at `place`."""
    if place.exists():
        raise InputError(f"{place} exists; choose another name")
    if not place.absolute().parent.is_dir():
        raise InputError(f"the directory of {place} does not exist")


def write_app(policy: PolicyFile, name: str, place: Path, int8: bool = False) -> None:
    """Write the apps of `policy` to the new directory `place`, or nothing and raise InputError."""
    check_place(place)
    files = files_of(policy, name, int8)
    with tempfile.TemporaryDirectory(dir=place.absolute().parent, prefix=".app-") as partial:
        for path, text in files.items():
            target = Path(partial) / "app" / path
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(text, encoding="utf-8")
        shutil.move(Path(partial) / "app", place)


MAKEFILE = """\
# make CRAZYFLIE_BASE=path/of/crazyflie-firmware cf2_defconfig && make CRAZYFLIE_BASE=...
CRAZYFLIE_BASE ?= ../../crazyflie-firmware
OOT_CONFIG := $(PWD)/app-config
include $(CRAZYFLIE_BASE)/tools/make/oot.mk
"""
APP_CONFIG = """\
CONFIG_APP_ENABLE=y
CONFIG_APP_PRIORITY=1
CONFIG_APP_STACKSIZE={words}
CONFIG_CONTROLLER_OOT=y
"""
KBUILD = """\
CFLAGS_core.o := {options} -DMJXBALL_FOLLOWER={number}
CFLAGS_glue.o := -DMJXBALL_FOLLOWER={number}
obj-y += core.o glue.o
"""
README = """\
# {name} on board

Made by `python -m mjxfly.app POLICY DIR` (configuration {hash}, {weights} weights, {flash} bytes of
constants, control period {period} ms, CRC of the weights {ident}).

`leader/` and `follower/` are out-of-tree apps for the Crazyflie firmware 2026.08; `src/` is what both share: `core.c`
with `checks.h`, `controllers.h` and `packets.h` is the flight (plain C, no firmware types), `glue.c` the firmware's
interface, `policy.h` and `rig.h` the policy.

    cd leader && make CRAZYFLIE_BASE=... cf2_defconfig && make CRAZYFLIE_BASE=... && make CRAZYFLIE_BASE=... cload

and likewise in `follower/`. Both drones must be on the same radio channel and data rate, or they do not hear each
other. Then `python -m mjxfly POLICY.npz --onboard --leader URI --follower URI`.

No such app has been on hardware. Propellers off first: see docs/hardware.md of mjxball.
"""
