"""Followers on board: the same C on this computer and on a Cortex-M4F, its size, stack and time; weights of 8 bits.

`python benchmarks/onboard.py [--policies FILE ...] [--observations 10000] [--json FILE]` needs gcc, gcc-arm-none-eabi
and qemu-system-arm; without FILE it takes the shipped policies and a recurrent one of random weights for two
Crazyflies. One step from the same memory, outputs compared bit for bit between both machines and with NumPy in float32.
Time: instructions of a call under QEMU times the weights of `cortex.py`, at 168 MHz. Flash and stack are those of the
whole core of a follower's app, law, network and supervisor, where the policy is one of a pair.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

import cortex
from mjxball.errors import InputError
from mjxball.export import in_team
from mjxball.fly.app.generate import CORE, options, rig_header, sources
from mjxball.fly.card import config_of
from mjxball.policy import Policy, PolicyFile
from mjxball.policy.file import law_of, load_file, shipped_policies, shipped_policy
from mjxball.policy.formats.c_header import APP, c_header, footprint

FLIGHT = 500  # steps of a flight
PAIR = Path("pair")  # the plant of a policy that has to be told its team
UNITS, HEAD = 48, 32  # of a recurrent follower for a pair of Crazyflies
MAIN = r"""
#include "policy.h"
int file_open(const char *name, int write);
int file_read(int file, void *to, unsigned size);
int file_write(int file, const void *from, unsigned size);

/* Each record: memory and observation -> action, command, memory. */
__attribute__((noinline)) void step(mjxball_follower *follower, const float *seen, float *action, float *command) {
    mjxball_follow(follower, seen, action, command);
}

int main(void) {
    static mjxball_follower follower;
    static float record[MJXBALL_MEMORY_SIZE + 18], out[MJXBALL_MEMORY_SIZE + 6];
    int from = file_open("in.bin", 0), to = file_open("out.bin", 1);
    while (file_read(from, record, sizeof record)) {
#if MJXBALL_MEMORY_SIZE > 0
        for (int k = 0; k < MJXBALL_MEMORY_SIZE; k++) follower.memory[k] = record[k];
#endif
        follower.running = 1;
        step(&follower, record + MJXBALL_MEMORY_SIZE, out, out + 3);
#if MJXBALL_MEMORY_SIZE > 0
        for (int k = 0; k < MJXBALL_MEMORY_SIZE; k++) out[6 + k] = follower.memory[k];
#endif
        file_write(to, out, sizeof out);
    }
    return 0;
}
"""


def flown(policy: PolicyFile, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Memory and observation of each step (T, m + 18), and NumPy's action (T, 3).

    Observations wander within 1 s or so, with mean and spread that they had in training by the policy's own scaling.
    """
    follower, random = Policy(policy, "follower"), np.random.default_rng(3)
    scale, kept = policy.observation_scale[:18].astype(float), 1 - policy.card["control_period"]
    spread = np.where(scale > 0, 1 / np.where(scale > 0, scale, 1), 0.3)
    records, actions = [], []
    for _ in range(-(-steps // FLIGHT)):
        follower.reset()
        place = random.normal(size=18)
        for noise in random.normal(scale=math.sqrt(1 - kept**2), size=(FLIGHT, 18)):
            place = kept * place + noise
            seen = (policy.observation_mean[:18] + spread * place).astype(np.float32)
            memory = follower.memory if follower.memory is not None else follower.law.start(seen)
            records.append(np.concatenate([memory, seen]).astype(np.float32))
            actions.append(follower.scaled(seen))
    return np.array(records[:steps]), np.array(actions[:steps])


def compare(policy: PolicyFile, place: Path, int8: bool, steps: int) -> dict[str, Any]:
    """Both machines and NumPy on `steps` observations."""
    (place / "policy.h").write_text(c_header(policy, "follower", int8, APP))
    cortex.build(place, MAIN, options(int8))
    records, actions = flown(policy, steps)
    host, arm = cortex.on_both(place, records.tobytes())
    found = np.frombuffer(arm, np.float32).reshape(steps, -1)[:, :3]
    error = np.abs(found - actions)
    return {
        "observations": steps,
        "identical": host == arm and len(arm) == 4 * steps * (records.shape[1] - 12),
        "error": float(error.max()),
        "error_rms": float(np.sqrt((error**2).mean())),
    }


def cost(policy: PolicyFile, place: Path, int8: bool) -> dict[str, Any]:
    """Time of one call of what `compare` has built, and flash and stack of the follower's app core."""
    (place / "in.bin").write_bytes(flown(policy, 3)[0].tobytes())
    call = cortex.count(place, "step", footprint(policy, int8).flash)
    row: dict[str, Any] = {"instructions": call.instructions, "cycles": call.cycles, "ms": call.milliseconds}
    try:
        (place / "rig.h").write_text(rig_header(policy, config_of(policy.card), int8))
    except InputError:  # a team: its follower's network alone
        return row
    for name in CORE:
        (place / name).write_text((sources() / name).read_text())
    flags = [*options(int8), "-DMJXBALL_FOLLOWER=1"]
    stack = cortex.stack(place, flags, "core.c", "mjxball_tick")
    return {**row, "flash": cortex.sizes(place, flags, "core.c"), "stack": stack}


def recurrent(units: int = UNITS) -> PolicyFile:
    """The shipped policy `flight` with a GRU of random weights in place of its network."""
    policy, random = load_file(shipped_policy("flight")), np.random.default_rng(2)
    card = {field: value for field, value in policy.card.items() if field not in ("filters", "flown")}
    card |= {"format_version": 5, "recurrent_units": units, "previous_action": True}
    size = law_of(card).input_size

    def layer(inputs: int, outputs: int) -> np.ndarray:
        return random.normal(scale=inputs**-0.5, size=(inputs, outputs)).astype(np.float32)

    return dataclasses.replace(
        policy,
        card=card,
        observation_mean=np.zeros(size, np.float32),
        observation_scale=np.append(policy.observation_scale[:18], np.ones(size - 18)).astype(np.float32),
        weights=(layer(size + units, HEAD), layer(HEAD + units, 6)),
        biases=(layer(1, HEAD)[0], layer(1, 6)[0]),
        gru=(layer(size, 3 * units), layer(units, 3 * units), layer(1, 3 * units)[0]),
    )


def placed(policy: PolicyFile, name: str) -> PolicyFile:
    """`policy` as the follower of a pair, if it has to be told."""
    return in_team(policy, name, PAIR) if law_of(policy.card).geometry else policy


def measure(policy: PolicyFile, name: str, int8: bool, steps: int) -> dict[str, Any]:
    """One row of the table."""
    with tempfile.TemporaryDirectory() as place:
        compared = compare(policy, Path(place), int8, steps)
        row = {"policy": name, "weights": "int8" if int8 else "float32", **compared}
        return {**row, **cost(policy, Path(place), int8)}


def main() -> int:
    """Print the table; returns 1 if the machines differ."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--policies", type=Path, nargs="+", default=None)
    parser.add_argument("--observations", type=int, default=10_000)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    if cortex.missing():
        print(f"not installed: {cortex.missing()}", file=sys.stderr)
        return 2
    names = f"{'error':>8} {'rms':>8} {'flash B':>8} {'stack B':>8} {'instr.':>8} {'ms':>6}"
    print(f"{'policy':18} {'weights':8} identical {names}")
    policies = {path.stem: placed(load_file(path), path.stem) for path in options.policies or shipped_policies()}
    if not options.policies:
        policies["recurrent flight"] = recurrent()
    rows = []
    for name, policy in policies.items():
        for int8 in (False, True):
            row = measure(policy, name, int8, options.observations)
            rows.append(row)
            flash, stack = row.get("flash", "-"), row.get("stack", "-")
            print(
                f"{row['policy']:18} {row['weights']:8} {'yes' if row['identical'] else 'NO':9} {row['error']:8.1e} "
                f"{row['error_rms']:8.1e} {flash:>8} {stack:>8} {row['instructions']:8} {row['ms']:6.3f}",
                flush=True,
            )
    if options.json:
        command = "python benchmarks/onboard.py " + " ".join(sys.argv[1:])
        options.json.write_text(json.dumps({"command": command, "inference": rows}, indent=1) + "\n", encoding="utf-8")
    return 0 if all(row["identical"] for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
