"""Followers on board: the apps compile against the firmware's interface, and a Cortex-M4F computes the same bits."""

from __future__ import annotations

import itertools
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from command_line import call
from onboard_bench import Bench, cores_of, needs_gcc, policy_of
from tables import weekly

import onboard as benchmark
from mjxball.control import rotations
from mjxball.policy.file import load_file, save_file, shipped_policy
from mjxfly.app import generate, protocol
from mjxfly.app.main import main as make_app
from mjxfly.app.protocol import AppPhase
from mjxfly.telemetry import ObjectState, Rig

needs_arm = pytest.mark.skipif(bool(benchmark.missing()), reason=f"not installed: {benchmark.missing()}")


INTERFACE = Path(__file__).parents[2] / "firmware" / "interface.h"
STRICT = (
    *("-std=c11", "-Wall", "-Wextra", "-Werror"),
    *("-Wdouble-promotion", "-Wconversion", "-Wshadow", "-pedantic"),
)
FIRMWARE = (  # its Kbuild's, release 2026.08: gcc's dialect has functions of its own such as finite
    *("-std=gnu11", "-Os", "-Wall", "-Wmissing-braces", "-Wdouble-promotion", "-Werror", "-Werror=implicit-int"),
    *("-fno-strict-aliasing", "-ffunction-sections", "-fdata-sections", "-fno-strict-overflow", "-fno-math-errno"),
    *("-Wno-pointer-sign", "-Wno-unused-but-set-variable", "-Wno-unused-const-variable"),
)


@needs_gcc
@pytest.mark.parametrize("name", ["flight --int8", "universal", *weekly("flight", "stand", "recurrent flight --int8")])
def test_the_app_compiles_against_the_interface(name: str, tmp_path: Path, capsys: pytest.CaptureFixture):
    policy, *more = name.removesuffix(" --int8"), *(["--int8"] if name.endswith("--int8") else [])
    save_file(tmp_path / "policy.npz", policy_of(policy))
    assert call(make_app, [tmp_path / "policy.npz", tmp_path / "app", *more]) == 0
    glue = (tmp_path / "app/src/glue.c").read_text()
    (tmp_path / "include").mkdir()
    for header in set(re.findall(r'#include "(\w+\.h)"', glue)) - {"core.h"}:
        (tmp_path / "include" / header).write_text(f'#include "{INTERFACE}"\n')
    include = ["-isystem", str(tmp_path / "include"), "-c"]  # the firmware warns in its own dialect
    compilers = [
        ["gcc"],
        *([["clang"]] if shutil.which("clang") else []),
        *([[*benchmark.ARM]] if not benchmark.missing() else []),
    ]
    for compiler, flags, (number, role) in itertools.product(compilers, (STRICT, FIRMWARE), enumerate(generate.ROLES)):
        kbuild = (tmp_path / "app" / role / "src/Kbuild").read_text()
        for source in ("core", "glue"):
            own = re.search(rf"^CFLAGS_{source}.o := (.*)$", kbuild, re.M)[1].split()
            assert f"-DMJXBALL_FOLLOWER={number}" in own
            options = [*compiler, *flags, *include, *own, f"src/{source}.c", "-o", "out.o"]
            done = subprocess.run(options, cwd=tmp_path / "app" / role, capture_output=True, text=True, check=False)
            assert done.returncode == 0, done.stderr
    words = int(re.search(r"STACKSIZE=(\d+)", (tmp_path / "app/follower/app-config").read_text())[1])
    assert 500 < words < 2000


@pytest.mark.slow
@needs_arm
@pytest.mark.parametrize("int8", [False, True])
def test_a_cortex_m4_computes_the_same_bits(int8: bool, tmp_path: Path):
    policies = {name: load_file(shipped_policy(name)) for name in ("balance", "flight", "universal")}
    policies["recurrent flight"] = benchmark.recurrent()
    for name, policy in policies.items():
        found = benchmark.compare(benchmark.placed(policy, name), tmp_path, int8, 500)
        assert found["identical"], name
        assert int8 or found["error"] <= 1e-5


# Each record: state, heartbeat of the other drone, time, order -> setpoint, command, integral, heartbeat.
REPLAY = r"""
#include "core.c"
int file_open(const char *name, int write);
int file_read(int file, void *to, unsigned size);
int file_write(int file, const void *from, unsigned size);

int main(void) {
    static mjxball_app app;
    static struct { mjxball_state state; uint8_t beat[MJXBALL_BEAT_SIZE]; uint32_t now, order; } in;
    static struct { float setpoint[3], command[3], integral[3]; uint8_t beat[MJXBALL_BEAT_SIZE]; } out;
    int from = file_open("in.bin", 0), to = file_open("out.bin", 1);
    mjxball_parameters set;
    mjxball_defaults(&set);
    set.mount[1] = MJXBALL_FOLLOWER ? -0.15f : 0.15f;
    mjxball_start(&app, 0);
    while (file_read(from, &in, sizeof in)) {
        const uint8_t order[2] = {1, (uint8_t)in.order};
        mjxball_setpoint wanted;
        mjxball_hear(&app, in.beat, sizeof in.beat, in.now);
        mjxball_laptop(&app, order, 2, in.now, 0, out.beat);
        mjxball_tick(&app, &set, &in.state, in.now, &wanted);
        mjxball_send(&app, out.beat);
        out.setpoint[0] = wanted.roll, out.setpoint[1] = wanted.pitch, out.setpoint[2] = wanted.thrust;
        for (int i = 0; i < 3; i++) out.command[i] = app.command[i];
        for (int i = 0; i < 3; i++) out.integral[i] = app.integral[i];
        file_write(to, &out, sizeof out);
    }
    return 0;
}
"""


@pytest.mark.slow
@needs_arm
@pytest.mark.parametrize("name", ["recurrent flight", *weekly("flight", "universal")])
def test_a_cortex_m4_flies_the_same_bits(name: str, tmp_path: Path):
    """Both apps over take-off, motion of the pair, landing and a fence that is left, whose inputs were recorded."""
    policy = policy_of(name)
    bench, random = Bench(cores_of(name), Rig.from_metadata(policy.metadata)), np.random.default_rng(5)
    records: list[list[bytes]] = [[], []]
    place, euler, seen = np.zeros(3), np.zeros(3), set()
    for step in range(900):
        order = (
            (AppPhase.IDLE, AppPhase.SPIN, AppPhase.RAMP, AppPhase.FLY)[min(step // 20, 3)]
            if step < 700
            else AppPhase.LAND
        )
        place = place + random.normal(scale=0.002, size=3) if step > 200 else place
        euler = 0.98 * euler + random.normal(scale=0.004, size=3)
        far = np.array([0.0, 0.0, 0.0 if step < 60 else 0.4 if step < 800 else 2.0])  # at its goal, then outside
        moving = ObjectState(place + far, euler[::-1], rotations.quaternion_from_euler(euler), 4 * euler)
        beats = [app.send() for app in bench.apps][::-1]
        bench.tick(order, moving)
        for number, mount in enumerate(bench.rig.mounts):
            state = bytes(bench.state(moving, mount))
            records[number].append(state + beats[number] + np.array([bench.now, order], np.uint32).tobytes())
        seen |= set(bench.phases)
    assert seen >= {AppPhase.SPIN, AppPhase.RAMP, AppPhase.FLY, AppPhase.LAND, AppPhase.DESCEND}
    for path, text in generate.files_of(policy, name, False).items():
        if path != "src/glue.c" and path.startswith("src/"):
            (tmp_path / Path(path).name).write_text(text)
    for number in range(2):
        benchmark.build(tmp_path, REPLAY, [*generate.options(False), f"-DMJXBALL_FOLLOWER={number}"])
        host, arm = benchmark.on_both(tmp_path, b"".join(records[number]))
        assert len(host) == 900 * (9 * 4 + protocol.BEAT_SIZE)
        assert host == arm
