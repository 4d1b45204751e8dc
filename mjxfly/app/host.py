"""The apps' C code compiled for this computer, one shared library for each role, for the twin."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from mjxball.errors import InputError
from mjxball.policy.file import PolicyFile
from mjxfly.app.generate import CORE, ROLES, files_of
from mjxfly.app.protocol import BEAT_SIZE, REPLY_SIZE, AppPhase

FLAGS = (
    *("-std=c11", "-O2", "-ffp-contract=off", "-fno-math-errno", "-Werror"),
    *("-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-pedantic"),
)
# Accessors of the fields of `mjxball_app`, whose layout Python does not know.
ACCESS = """\
#include "core.c"
uint32_t mjxball_size(void) { return sizeof(mjxball_app); }
const float *mjxball_command(const mjxball_app *app) { return app->command; }
const float *mjxball_integral(const mjxball_app *app) { return app->integral; }
#if MJXBALL_MEMORY_SIZE > 0
const float *mjxball_memory(const mjxball_app *app) { return app->follower.memory; }
#else
const float *mjxball_memory(const mjxball_app *app) { return app ? 0 : 0; }
#endif
"""


class Parameters(ctypes.Structure):
    """`mjxball_parameters`."""

    _fields_ = (
        ("goal", ctypes.c_float * 3),
        ("mount", ctypes.c_float * 3),
        ("curve", ctypes.c_uint8),
        ("battery", ctypes.c_float),
    )


class OnboardState(ctypes.Structure):
    """`mjxball_state`."""

    _fields_ = (
        ("position", ctypes.c_float * 3),
        ("velocity", ctypes.c_float * 3),
        ("quaternion", ctypes.c_float * 4),
        ("rates", ctypes.c_float * 3),
        ("variance", ctypes.c_float * 3),
        ("voltage", ctypes.c_float),
        ("time", ctypes.c_uint32),
        ("can_fly", ctypes.c_bool),
    )


class AppSetpoint(ctypes.Structure):
    """`mjxball_setpoint`."""

    _fields_ = (
        ("active", ctypes.c_bool),
        ("roll", ctypes.c_float),
        ("pitch", ctypes.c_float),
        ("thrust", ctypes.c_float),
    )


class Library:
    """The compiled core of one role; attribute `x` is the C function `mjxball_x`."""

    def __init__(self, path: Path):
        self._library = ctypes.CDLL(str(path))
        for name, result in (
            ("mjxball_size", ctypes.c_uint32),
            ("mjxball_ident", ctypes.c_uint32),
            ("mjxball_upload_size", ctypes.c_uint32),
            ("mjxball_command", ctypes.POINTER(ctypes.c_float)),
            ("mjxball_integral", ctypes.POINTER(ctypes.c_float)),
            ("mjxball_memory", ctypes.POINTER(ctypes.c_float)),
        ):
            getattr(self._library, name).restype = result

    def __getattr__(self, name: str) -> ctypes._NamedFuncPointer:
        return getattr(self._library, f"mjxball_{name}")


def compile_pair(policy: PolicyFile, name: str, int8: bool = False) -> tuple[Library, Library]:
    """Compile the cores of leader and follower. Raises InputError without gcc, or for a policy that cannot fly."""
    files = files_of(policy, name, int8)
    if shutil.which("gcc") is None:
        raise InputError("the twin runs the app's C, which needs gcc: install it, or leave --onboard out")
    with tempfile.TemporaryDirectory() as place:
        for path in (*CORE, "policy.h", "rig.h"):
            (Path(place) / path).write_text(files[f"src/{path}"], encoding="utf-8")
        (Path(place) / "host.c").write_text(ACCESS, encoding="utf-8")
        libraries = []
        for number, role in enumerate(ROLES):
            out = Path(place) / f"{role}.so"
            command = ["gcc", *FLAGS, f"-DMJXBALL_FOLLOWER={number}", "-shared", "-fPIC", "-o", str(out), "host.c"]
            done = subprocess.run(command, cwd=place, capture_output=True, text=True, check=False)
            if done.returncode:
                raise InputError(f"gcc cannot compile the {role}'s app: {done.stderr.strip().splitlines()[0]}")
            libraries.append(Library(out))
    return libraries[0], libraries[1]


class App:
    """One drone's app. Times in milliseconds of the drone's clock."""

    def __init__(self, library: Library, role: int, now: int = 0):
        """`role`: 0 leader, 1 follower."""
        self._c, self.role = library, role
        self._core = ctypes.create_string_buffer(library.size())
        self._memory = ctypes.create_string_buffer(max(library.upload_size(), 1))
        self._set = Parameters()
        self.period = int(library.period())
        self.thrust = 0.0  # of the last setpoint [thrust units]
        library.defaults(ctypes.byref(self._set))
        library.start(self._core, ctypes.c_uint32(now))

    def set(self, name: str, value: float) -> None:
        """Write the parameter `name`, such as goalX."""
        if name in ("curve", "battery"):
            setattr(self._set, name, int(value) if name == "curve" else value)
        else:
            getattr(self._set, name[:-1])["XYZ".index(name[-1])] = value

    def parameters(self) -> Mapping[str, float]:
        """Return all parameters by name."""
        vectors = {
            f"{what}{axis}": getattr(self._set, what)[i] for what in ("goal", "mount") for i, axis in enumerate("XYZ")
        }
        scalars = {"curve": self._set.curve, "battery": self._set.battery}
        return {**vectors, **scalars, "ident": self.ident, "role": self.role, "period": self.period}

    def tick(self, state: OnboardState, now: int) -> AppSetpoint:
        """Run one period; return the setpoint for the commander."""
        wanted = AppSetpoint()
        self._c.tick(
            self._core, ctypes.byref(self._set), ctypes.byref(state), ctypes.c_uint32(now), ctypes.byref(wanted)
        )
        self.thrust = wanted.thrust
        return wanted

    def send(self) -> bytes:
        """Return the heartbeat for the other drone."""
        out = ctypes.create_string_buffer(BEAT_SIZE)
        self._c.send(self._core, out)
        return out.raw

    def hear(self, data: bytes, now: int) -> None:
        """Handle a heartbeat of the other drone."""
        self._c.hear(self._core, data, len(data), ctypes.c_uint32(now))

    def laptop(self, data: bytes, now: int) -> bytes:
        """Handle a packet of the laptop; return the answer, empty for none."""
        reply = ctypes.create_string_buffer(REPLY_SIZE)
        size = self._c.laptop(self._core, data, len(data), ctypes.c_uint32(now), self._memory, reply)
        return reply.raw[:size]

    @property
    def phase(self) -> AppPhase:
        """The app's phase."""
        return AppPhase(self._core.raw[0])

    @property
    def command(self) -> Sequence[float]:
        """(3,) last command of its controller: roll, pitch [rad], vertical acceleration [m/s2]."""
        return list(self._c.command(self._core)[:3])

    @property
    def integral(self) -> Sequence[float]:
        """(3,) integral of the leader's error [m s]."""
        return list(self._c.integral(self._core)[:3])

    @property
    def ident(self) -> int:
        """CRC of the weights in use."""
        return int(self._c.ident(self._core))

    def logged(self) -> Mapping[str, float]:
        """Return the log variables of the group mjxb that Python can read."""
        phase, cause, refusal, _, copying = self._core.raw[:5]
        values = {"phase": phase, "cause": cause, "refusal": refusal, "copying": copying}
        return values | dict(zip(("roll", "pitch", "az"), self.command, strict=True)) | {"thrust": self.thrust}
