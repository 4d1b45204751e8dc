"""Exported C on a Cortex-M4F: gcc-arm-none-eabi compiles it, qemu-system-arm runs it (netduinoplus2, an STM32F405).

QEMU counts no cycles: `cycles` weighs the instructions that were executed, see `WEIGHTS`.
"""

from __future__ import annotations

import collections
import re
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

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
