"""A flag of XLA's, which reads its flags once, when JAX finds its devices."""

from __future__ import annotations

import os

# On CPUs a loop whose body touches fewer bytes than that becomes one function of LLVM's, instead of one for each
# operation of its body, called by XLA's runtime, which takes longer than the operation if that has dozens of numbers.
SMALL_LOOPS = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=10000000"


def compile_small_loops_whole() -> None:
    """Add `SMALL_LOOPS` to this process's flags, unless these say something of such options themselves."""
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_backend_extra_options" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {SMALL_LOOPS}".strip()
