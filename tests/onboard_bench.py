"""The apps' C compiled for this computer, and two of them on a rig that is held in the hand."""

from __future__ import annotations

import dataclasses
import functools
import shutil
import subprocess
import types
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import onboard
from mjxball.export import in_team
from mjxball.policy import PolicyFile, load_file
from mjxball.policy.file import interface_of, shipped_policy
from mjxfly.app import host, protocol
from mjxfly.app.host import App, Library, OnboardState, compile_pair
from mjxfly.app.protocol import CAUSES, AppPhase
from mjxfly.telemetry import ObjectState, Rig

NO_GCC = pytest.mark.skipif(shutil.which("gcc") is None, reason="no gcc is installed")
AT_REST = ObjectState(np.zeros(3), np.zeros(3), np.array([1.0, 0, 0, 0]), np.zeros(3))


def needs_gcc(test: Any) -> Any:
    """What compiles belongs to the second tier."""
    return pytest.mark.slow(NO_GCC(test))


def policy_of(name: str) -> PolicyFile:
    """The shipped policy; for any rig with commands that a pair of Crazyflies can follow.

    "recurrent flight" is not trained, and knows the rate of a goal.
    """
    if name == "recurrent flight":
        policy = onboard.recurrent()
        config = policy.metadata["config"]
        scenario = {**config["scenario"], "goal_motion_probability": 0.5}
        return dataclasses.replace(policy, metadata={**policy.metadata, "config": {**config, "scenario": scenario}})
    policy = load_file(shipped_policy(name))
    if name != "universal":
        return policy
    return in_pair(dataclasses.replace(policy, metadata={**policy.metadata, "command_limits": [0.26, 0.4]}))


def in_pair(policy: PolicyFile) -> PolicyFile:
    """Told that it flies a pair of Crazyflies, if it has to be told."""
    return in_team(policy, "follower", Path("crazyflie")) if interface_of(policy.metadata).geometry else policy


@functools.cache
def cores_of(name: str = "flight") -> tuple[Library, Library]:
    """Leader and follower, compiled once a process."""
    return compile_pair(policy_of(name), name)


def compilers() -> list[list[str]]:
    """The C compilers of this computer, each told in several ways that numbers are finite."""
    ways = (["-Ofast"], ["-O2", "-ffast-math"], ["-Os", "-ffinite-math-only"], ["-O0", "-ffinite-math-only"])
    return [[one, *way] for one in ("gcc", "clang") if shutil.which(one) for way in ways]


def cores_by(compiler: list[str], name: str = "flight") -> tuple[Library, Library]:
    """Likewise, compiled by `compiler`. Linked without its flags: they would round small numbers in this process."""

    def link(command: list[str], **given: Any) -> Any:
        step = [*compiler, "-std=c11", "-fPIC", *(one for one in command if one.startswith("-D")), "-c", "host.c"]
        subprocess.run([*step, "-o", "host.o"], cwd=given["cwd"], check=True)
        out = command[command.index("-o") + 1]
        return subprocess.run([compiler[0], "-shared", "-o", out, "host.o"], cwd=given["cwd"], check=True)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(host, "subprocess", types.SimpleNamespace(run=link))
        return compile_pair(policy_of(name), name)


class Bench:
    """Two apps on a rig that is held in the hand."""

    def __init__(self, cores: tuple[Library, Library], rig: Rig):
        self.apps = [App(core, number) for number, core in enumerate(cores)]
        self.rig, self.now = rig, 1000
        for app, mount in zip(self.apps, rig.mounts, strict=True):
            for axis, value in zip("XYZ", mount, strict=True):
                app.set(f"mount{axis}", value)

    def state(self, pair: ObjectState, mount: np.ndarray) -> OnboardState:
        """What the drone at `mount` estimates."""
        seen, matrix = OnboardState(), pair.matrix
        seen.position[:] = pair.position + matrix @ mount
        seen.velocity[:] = pair.velocity + matrix @ np.cross(pair.rates, mount)
        seen.quaternion[:], seen.rates[:] = pair.quaternion, pair.rates
        seen.variance[:], seen.time, seen.can_fly, seen.voltage = [1e-5] * 3, self.now, True, 4.0
        return seen

    def tick(self, order: AppPhase | None, pair: ObjectState | None = None, **wrong: Any) -> list[Any]:
        """A period of both; `wrong` values of the leader's state. Returns both setpoints."""
        beats = [app.send() for app in self.apps]
        self.now += self.apps[0].period
        sent = []
        for app, beat, mount in zip(self.apps, beats[::-1], self.rig.mounts, strict=True):
            app.hear(beat, self.now)
            if order is not None:
                app.laptop(protocol.order(order).data, self.now)
            state = self.state(pair or AT_REST, mount)
            for name, value in wrong.items() if app is self.apps[0] else ():
                if isinstance(value, bool | float):
                    setattr(state, name, value)
                else:
                    getattr(state, name)[:] = value
            sent.append(app.tick(state, self.now))
        return sent

    def take_off(self) -> None:
        """To the first period under the controllers, which the laptop asks for: this pair does not leave the ground."""
        for phase, periods in ((AppPhase.IDLE, 3), (AppPhase.SPIN, 5), (AppPhase.RAMP, 150), (AppPhase.FLY, 5)):
            for _ in range(periods):
                self.tick(phase)
                if self.apps[0].phase is AppPhase.FLY:
                    return

    @property
    def phases(self) -> list[AppPhase]:
        return [app.phase for app in self.apps]

    def cause(self, number: int = 0) -> str:
        return CAUSES[int(self.apps[number].logged()["cause"])]
