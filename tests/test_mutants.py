"""The table of `benchmarks/mutants.py` fits the tree: each fault can be made, changes something, names its tests."""

from __future__ import annotations

import ast
import functools
import importlib.util
from collections import Counter

from command_line import REPOSITORY


@functools.cache
def read(file: str) -> tuple[str, str]:
    """Text of a file and, if it is Python, what it says."""
    text = (REPOSITORY / file).read_text()
    return text, ast.dump(ast.parse(text)) if file.endswith(".py") else ""


def test_every_fault_can_be_made() -> None:
    spec = importlib.util.spec_from_file_location("mutants", REPOSITORY / "benchmarks" / "mutants.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    table = module.read_table()
    assert len(table) >= 60
    assert max(Counter((one.file, one.new) for one in table).values()) == 1
    for one in table:
        text, meant = read(one.file)
        changed = one.applied(text)  # ValueError unless the old text occurs exactly once
        assert changed != text, one
        assert not one.file.endswith(".py") or ast.dump(ast.parse(changed)) != meant, one
        assert one.tests
        for test in one.tests:
            path, *inside = test.split("::")
            assert not inside or f"def {inside[-1].partition('[')[0]}(" in read(path)[0], test
