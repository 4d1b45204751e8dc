"""Followers on board: the same C on this computer and on a Cortex-M4F, its size, stack and time; weights of 8 bits.

Needs gcc, gcc-arm-none-eabi and qemu-system-arm; without `--policies` it takes the shipped ones and a recurrent one of
random weights for two Crazyflies. One step from the same memory, outputs compared bit for bit between both machines and
with NumPy in float32. QEMU (netduinoplus2, an STM32F405) counts no cycles: time is the instructions of a call times the
weights `WEIGHTS`, at 168 MHz. Flash and stack are those of the whole core of a follower's app, controller, network and
supervisor, where the policy is one of a pair.
"""

from __future__ import annotations

import collections
import dataclasses
import math
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from harness import Row, arguments, say, table, write
from mjxball.errors import InputError
from mjxball.export import in_team
from mjxball.policy import Policy, PolicyFile
from mjxball.policy.file import interface_of, load_file, shipped_policies, shipped_policy
from mjxball.policy.formats.c_header import APP, c_header, footprint
from mjxball.running import run_command
from mjxfly.app.generate import CORE, options, rig_header, sources
from mjxfly.policy_setup import config_of

HOST = ("gcc",)
ARM = ("arm-none-eabi-gcc", "-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16")
STRICT = ("-std=c11", "-Wall", "-Wextra", "-Werror", "-ffp-contract=off", "-fno-math-errno")
QEMU = ("qemu-system-arm", "-M", "netduinoplus2", "-nographic", "-semihosting-config", "enable=on,target=native")
CLOCK = 168e6  # [Hz]
TOOLS = ("gcc", "arm-none-eabi-gcc", "qemu-system-arm")

# The start of a program without a library, and files by semihosting.
BOARD = r"""
extern unsigned bottom_of_data, top_of_data, data_in_flash, bottom_of_bss, top_of_bss, top_of_stack;
int main(void);

int semihost(int what, const void *with) {
    register int r0 __asm__("r0") = what;
    register const void *r1 __asm__("r1") = with;
    __asm__ volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

static int length(const char *text) {
    int n = 0;
    while (text[n]) n++;
    return n;
}

int file_open(const char *name, int write) {
    const int with[3] = {(int)name, write ? 5 : 1, length(name)};
    return semihost(1, with);
}

int file_read(int file, void *to, unsigned size) {
    const unsigned with[3] = {(unsigned)file, (unsigned)to, size};
    return semihost(6, with) == 0;
}

int file_write(int file, const void *from, unsigned size) {
    const unsigned with[3] = {(unsigned)file, (unsigned)from, size};
    return semihost(5, with) == 0;
}

void begin(void) {
    unsigned *from = &data_in_flash;
    *(volatile unsigned *)0xE000ED88 |= 0xFu << 20; /* the FPU */
    for (unsigned *to = &bottom_of_data; to < &top_of_data;) *to++ = *from++;
    for (unsigned *to = &bottom_of_bss; to < &top_of_bss;) *to++ = 0;
    main();
    semihost(0x18, (const void *)0x20026);
    for (;;) {}
}

__attribute__((section(".vectors"), used)) static void *const vectors[] = {&top_of_stack, (void *)begin};
"""
LAYOUT = """
MEMORY { FLASH (rx) : ORIGIN = 0x08000000, LENGTH = 1M  RAM (rw) : ORIGIN = 0x20000000, LENGTH = 128K }
SECTIONS {
    .text : { KEEP(*(.vectors)) *(.text*) *(.rodata*) } > FLASH
    .data : { bottom_of_data = .; *(.data*) . = ALIGN(4); top_of_data = .; } > RAM AT > FLASH
    data_in_flash = LOADADDR(.data);
    .bss : { bottom_of_bss = .; *(.bss*) *(COMMON) . = ALIGN(4); top_of_bss = .; } > RAM
    top_of_stack = ORIGIN(RAM) + LENGTH(RAM);
}
"""
# The same three functions on a computer.
COMPUTER = r"""
#include <stdio.h>
static FILE *files[2];
int file_open(const char *name, int write) { return (files[write] = fopen(name, write ? "wb" : "rb")) ? write : -1; }
int file_read(int file, void *to, unsigned size) { return fread(to, size, 1, files[file]) == 1; }
int file_write(int file, const void *from, unsigned size) { return fwrite(from, size, 1, files[file]) == 1; }
"""


def missing() -> str:
    """The tools that are not installed, empty if all are."""
    return ", ".join(tool for tool in TOOLS if shutil.which(tool) is None)


def run(command: Sequence[str], place: Path, limit: float = 600.0) -> str:
    """Run `command` in `place`; its output. Raises RuntimeError with it."""
    done = subprocess.run(command, cwd=place, capture_output=True, text=True, check=False, timeout=limit)
    if done.returncode:
        raise RuntimeError(f"{' '.join(command[:3])}: {done.stderr[-2000:] or done.stdout[-2000:]}")
    return done.stdout


def build(place: Path, main: str, flags: Sequence[str] = ()) -> None:
    """Compile `main`, which uses file_open and so on, for both machines, into `host` and `arm.elf` in `place`.

    `flags` are the apps', with their level of optimization; the host's is that of the twin.
    """
    (place / "main.c").write_text(main)
    (place / "board.c").write_text(BOARD)
    (place / "computer.c").write_text(COMPUTER)
    (place / "layout.ld").write_text(LAYOUT)
    run([*HOST, *STRICT, *flags, "-O2", "main.c", "computer.c", "-o", "host"], place)
    link = ["-nostartfiles", "-T", "layout.ld", "-Wl,-Map=arm.map", "-Wl,--gc-sections"]
    split = ["-ffunction-sections", "-fdata-sections"]
    run([*ARM, *STRICT, *split, "-fno-builtin", *flags, "main.c", "board.c", *link, "-o", "arm.elf"], place)


def on_both(place: Path, records: bytes) -> tuple[bytes, bytes]:
    """What `host` and `arm.elf` write to `out.bin` for `records` in `in.bin`."""
    (place / "in.bin").write_bytes(records)
    outputs = []
    for command in (["./host"], [*QEMU, "-kernel", "arm.elf"]):
        (place / "out.bin").unlink(missing_ok=True)
        run(command, place)
        outputs.append((place / "out.bin").read_bytes())
    return outputs[0], outputs[1]


def sizes(place: Path, flags: Sequence[str], source: str) -> int:
    """Bytes of code and constants of `source` in flash, by the linker's map file."""
    options = [*ARM, *STRICT, "-ffunction-sections", "-fdata-sections", *flags]
    run([*options, "-c", source, "-o", "measured.o"], place)
    roots = ["-Wl,--gc-sections", "-Wl,-e,mjxball_tick", "-Wl,-u,mjxball_laptop", "-Wl,-u,mjxball_hear"]
    more = ["-Wl,-u,mjxball_send", "-Wl,-u,mjxball_text", "-Wl,-u,mjxball_start", "-Wl,-u,mjxball_defaults"]
    run([*options, "-nostartfiles", *roots, *more, "-Wl,-Map=measured.map", "measured.o", "-o", "measured.elf"], place)
    kept = (place / "measured.map").read_text().split("Linker script and memory map")[1]
    rows = re.findall(r"^ \.(?:text|rodata)\S*\s+0x[0-9a-f]+\s+(0x[0-9a-f]+) measured\.o$", kept, re.M)
    return sum(int(size, 16) for size in rows)


def stack(place: Path, flags: Sequence[str], source: str, root: str) -> int:
    """Bytes of stack of the deepest chain of calls from `root`, by gcc's call graph."""
    run([*ARM, *STRICT, *flags, "-fcallgraph-info=su", "-c", source, "-o", "graph.o"], place)
    text = (place / "graph.ci").read_text()
    own = {
        name: int(size) for name, size in re.findall(r'title: "([^"]+)"[^}]*?\\n(\d+) bytes \((?:static|dynamic)', text)
    }
    calls = collections.defaultdict(set)
    for caller, callee in re.findall(r'sourcename: "([^"]+)" targetname: "([^"]+)"', text):
        calls[caller].add(callee)

    def deepest(name: str) -> int:
        return own.get(name, 0) + max((deepest(one) for one in calls[name] if one != name), default=0)

    return max(deepest(name) for name in own if name.split(":")[-1] == root)


# Cycles of a Cortex-M4 (Technical Reference Manual); the first pattern that fits counts. A load or store that follows
# another one directly overlaps it; a branch that is taken refills the pipeline; an FPU result that the next instruction
# needs takes one cycle more.
LIST = -1  # one and one for each register
WEIGHTS = (
    (r"v?(ldm|stm)|push|pop|vpush|vpop", LIST),
    (r"vdiv|vsqrt", 14),
    (r"vn?ml[as]|vfn?m[as]", 3),
    (r"(s|u)div", 12),
    (r"v?ldrd|strd", 3),
    (r"v?(ldr|str)", 2),
    (r".*", 1),
)
TAKEN = 2  # more, of a branch
LINE, WAIT = 16, 5  # bytes of a line of flash, and its wait states at 168 MHz: constants come from there once a call


class Count(NamedTuple):
    """One call."""

    instructions: int
    cycles: float

    @property
    def milliseconds(self) -> float:
        """At 168 MHz."""
        return 1e3 * self.cycles / CLOCK


def count(place: Path, function: str, constants: int) -> Count:
    """The last call of `function` in `arm.elf`, whose `constants` [bytes] are read once from flash."""
    listing = run(["arm-none-eabi-objdump", "-d", "--no-show-raw-insn", "arm.elf"], place)
    code: dict[int, tuple[str, str]] = {}
    start, inside = 0, ""
    for line in listing.splitlines():
        if label := re.match(r"([0-9a-f]+) <([^>]+)>:", line):
            inside = label[2]
            start = int(label[1], 16) if inside == function else start
        elif found := re.match(r"\s*([0-9a-f]+):\s+(\S+)\s*(.*)", line):
            code[int(found[1], 16)] = (found[2], found[3])
    log = place / "trace.log"
    run([*QEMU, "-kernel", "arm.elf", "-singlestep", "-d", "exec,nochain", "-D", str(log)], place)
    pattern = re.compile(r"Trace \d+: \S+ \[[0-9a-f]+/([0-9a-f]+)/")
    trace: list[int] = []
    before, back = 0, -1
    with log.open() as lines:
        for line in lines:
            if not (match := pattern.match(line)):
                continue
            at = int(match[1], 16)
            if at == start and before:
                trace, back = [], before  # what called it; the call ends behind that
            if back >= 0:
                if before != back and at in (back + 2, back + 4) and trace:
                    back = -1
                else:
                    trace.append(at)
            before = at
    log.unlink()
    return Count(len(trace), cycles(trace, code) + WAIT * constants / LINE)


def cycles(trace: Sequence[int], code: dict[int, tuple[str, str]]) -> float:
    """Weighted instructions of a trace of addresses."""
    total, loaded, computed = 0.0, False, ""
    for at, following in zip(trace, [*trace[1:], trace[-1] + 2], strict=True):
        name, operands = code[at]
        weight = next(weight for pattern, weight in WEIGHTS if re.match(pattern, name))
        memory = bool(re.match(r"v?(ldr|str)", name)) and weight == 2
        if weight == LIST:
            weight = 1 + operands.count(",") + _ranges(operands)
        total += weight - (memory and loaded)
        total += TAKEN if following not in (at + 2, at + 4) else 0
        registers = re.findall(r"s\d+", operands)
        total += computed in registers[1:] or (computed in registers and name.startswith(("vstr", "vcmp", "vmov")))
        loaded = memory
        computed = registers[0] if registers and re.match(r"v(add|sub|mul|cvt|neg|abs)", name) else ""
    return total


def _ranges(operands: str) -> int:
    """Registers that a list such as {s0-s3} has beyond those that are spelled out."""
    return sum(int(b) - int(a) for a, b in re.findall(r"[rsd](\d+)-[rsd](\d+)", operands))


# --- followers --------------------------------------------------------------------------------------------------------

FLIGHT = 500  # steps of a flight
PAIR = Path("pair")  # the plant of a policy that must know its team
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
    scale, kept = policy.observation_scale[:18].astype(float), 1 - policy.metadata["control_period"]
    spread = np.where(scale > 0, 1 / np.where(scale > 0, scale, 1), 0.3)
    records, actions = [], []
    for _ in range(-(-steps // FLIGHT)):
        follower.reset()
        place = random.normal(size=18)
        for noise in random.normal(scale=math.sqrt(1 - kept**2), size=(FLIGHT, 18)):
            place = kept * place + noise
            seen = (policy.observation_mean[:18] + spread * place).astype(np.float32)
            memory = follower.memory if follower.memory is not None else follower.controller.start(seen)
            records.append(np.concatenate([memory, seen]).astype(np.float32))
            actions.append(follower.action(seen))
    return np.array(records[:steps]), np.array(actions[:steps])


def compare(policy: PolicyFile, place: Path, int8: bool, steps: int) -> Row:
    """Both machines and NumPy on `steps` observations."""
    (place / "policy.h").write_text(c_header(policy, "follower", int8, APP))
    build(place, MAIN, options(int8))
    records, actions = flown(policy, steps)
    host, arm = on_both(place, records.tobytes())
    found = np.frombuffer(arm, np.float32).reshape(steps, -1)[:, :3]
    error = np.abs(found - actions)
    return {
        "observations": steps,
        "identical": host == arm and len(arm) == 4 * steps * (records.shape[1] - 12),
        "error": float(error.max()),
        "error_rms": float(np.sqrt((error**2).mean())),
    }


def cost(policy: PolicyFile, place: Path, int8: bool) -> Row:
    """Time of one call of what `compare` has built, and flash and stack of the follower's app core."""
    (place / "in.bin").write_bytes(flown(policy, 3)[0].tobytes())
    call = count(place, "step", footprint(policy, int8).flash)
    row: Row = {"instructions": call.instructions, "cycles": call.cycles, "ms": call.milliseconds}
    try:
        (place / "rig.h").write_text(rig_header(policy, config_of(policy.metadata), int8))
    except InputError:  # a team: its follower's network alone
        return row
    for name in CORE:
        (place / name).write_text((sources() / name).read_text())
    flags = [*options(int8), "-DMJXBALL_FOLLOWER=1"]
    flash, deepest = sizes(place, flags, "core.c"), stack(place, flags, "core.c", "mjxball_tick")
    return {**row, "flash": flash, "stack": deepest}


def recurrent(units: int = UNITS) -> PolicyFile:
    """The shipped policy `flight` with a GRU of random weights in place of its network."""
    policy, random = load_file(shipped_policy("flight")), np.random.default_rng(2)
    metadata = {field: value for field, value in policy.metadata.items() if field not in ("filters", "flown")}
    metadata |= {"format_version": 5, "recurrent_units": units, "previous_action": True}
    size = interface_of(metadata).input_size

    def layer(inputs: int, outputs: int) -> np.ndarray:
        return random.normal(scale=inputs**-0.5, size=(inputs, outputs)).astype(np.float32)

    return dataclasses.replace(
        policy,
        metadata=metadata,
        observation_mean=np.zeros(size, np.float32),
        observation_scale=np.append(policy.observation_scale[:18], np.ones(size - 18)).astype(np.float32),
        weights=(layer(size + units, HEAD), layer(HEAD + units, 6)),
        biases=(layer(1, HEAD)[0], layer(1, 6)[0]),
        gru=(layer(size, 3 * units), layer(units, 3 * units), layer(1, 3 * units)[0]),
    )


def placed(policy: PolicyFile, name: str) -> PolicyFile:
    """`policy` as the follower of a pair, if it has to be told."""
    return in_team(policy, name, PAIR) if interface_of(policy.metadata).geometry else policy


def measure(policy: PolicyFile, name: str, int8: bool, steps: int) -> Row:
    """One row of the table."""
    with tempfile.TemporaryDirectory() as place:
        compared = compare(policy, Path(place), int8, steps)
        row = {"policy": name, "weights": "int8" if int8 else "float32", **compared}
        return {**row, **cost(policy, Path(place), int8)}


def main(given: Sequence[str] | None = None) -> int:
    """Print the table; returns 1 if the machines differ."""
    parser = arguments(__file__, __doc__)
    parser.add_argument("--policies", type=Path, nargs="+", default=None)
    parser.add_argument("--observations", type=int, default=10_000)
    chosen = parser.parse_args(given)
    if missing():
        raise InputError(f"not installed: {missing()}")
    policies = {path.stem: placed(load_file(path), path.stem) for path in chosen.policies or shipped_policies()}
    if not chosen.policies:
        policies["recurrent flight"] = recurrent()
    rows = []
    for name, policy in policies.items():
        for int8 in (False, True):
            rows.append(measure(policy, name, int8, chosen.observations))
            say(rows[-1])
    table(rows, ("policy", "weights", "identical", "error", "error_rms", "flash", "stack", "instructions", "ms"), ".2g")
    write(chosen.json, {"inference": rows})
    return 0 if all(row["identical"] for row in rows) else 1


if __name__ == "__main__":
    sys.exit(run_command(main))
