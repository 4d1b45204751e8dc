"""Imports run one way, along the data: config -> plant -> control -> policy | assembly -> physics -> env -> algorithms
-> train -> evaluate; and from mjxfly to mjxball.

Read from the syntax tree of every module, so that a lazy import inside a function counts as well.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest
from command_line import REPOSITORY, environment

# Floor by floor: a part imports itself and what stands on lower floors, never a neighbour or what is above.
FLOORS = (
    {"errors"},
    {"arrays", "reading", "pictures", "terminal"},
    {"files"},
    {"config"},
    {"xla", "scalar_form"},
    {"running", "quiet", "plotting"},
    {"cli"},
    {"plant"},
    {"control"},
    {"policy", "baselines"},
    {"assembly"},
    {"physics", "scene"},
    {"rewards", "sim"},
    {"env", "foreign"},
    {"algorithms"},
    {"train"},
    {"evaluate"},
    {"gym", "bench", "view"},
    {"notebook"},
    {"commands", "export"},
    {"entry"},
    {"mjxfly"},
    {"mjxfly.rig"},
    {"mjxfly.view"},
    {"mjxfly.log"},
    {"mjxfly.entry"},
)
FLOOR = {part: height for height, parts in enumerate(FLOORS) for part in parts}
GROUND = {
    "arrays",
    "errors",
    "reading",
    "pictures",
    "files",
    "config",
    "plant",
    "control",
}  # all of our own that `control` and `policy` may import
# What the base install runs: NumPy alone.
BASE = (
    "arrays",
    "errors",
    "reading",
    "pictures",
    "files",
    "config",
    "running",
    "cli",
    "plant",
    "control",
    "policy",
    "entry",
)
OURS, FLIES = "mjxball", "mjxfly"
# What only flights need, their logs and their cameras.
FLYING = {"cflib", "yaml", "mcap", "mcap_ros2", "rosbags", "pyarrow", "websockets"}


class Module(NamedTuple):
    """One module's imports: dotted names."""

    name: str  # mjxball.control.leader
    eager: set[str]  # at import time
    lazy: set[str]  # inside functions
    typed: set[str]  # for type checkers alone

    @property
    def part(self) -> str:
        """First name below mjxball, '' for the package itself; of mjxfly what stands above the rest of it."""
        return part_of(self.name)


def part_of(name: str) -> str:
    house, below = [*name.split("."), ""][:2]
    if house == FLIES:
        return f"{FLIES}.{below}" if f"{FLIES}.{below}" in FLOOR else FLIES
    return below


def imports_in(node: ast.AST, kind: str, found: dict[str, set[str]]) -> None:
    if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
        for child in node.body:
            imports_in(child, "typed", found)
        for child in node.orelse:
            imports_in(child, kind, found)
        return
    if isinstance(node, ast.Import):
        found[kind].update(alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom):
        assert node.level == 0, "relative imports hide where a name comes from"
        found[kind].update(f"{node.module}.{alias.name}" for alias in node.names)
    if isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.Lambda)):
        kind = "lazy"
    for child in ast.iter_child_nodes(node):
        imports_in(child, kind, found)


def read(package: Path) -> dict[str, Module]:
    """Every module below the directory `package`, by name."""
    modules = {}
    for path in sorted(package.rglob("*.py")):
        parts = path.relative_to(package.parent).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        found: dict[str, set[str]] = {"eager": set(), "lazy": set(), "typed": set()}
        imports_in(ast.parse(path.read_text()), "eager", found)
        modules[name] = Module(name, **found)
    return modules


def own(names: set[str]) -> set[str]:
    return {name for name in names if name.split(".")[0] in (OURS, FLIES)}


def foreign(names: set[str]) -> set[str]:
    """Top-level names of other packages; the standard library is nobody's."""
    return {name.split(".")[0] for name in names - own(names)} - sys.stdlib_module_names - {"__future__"}


def direction_faults(modules: dict[str, Module]) -> list[str]:
    """What breaks the one-way flow, one sentence each. The package itself may be imported for its version alone."""
    faults = []
    for module in modules.values():
        if module.part and module.part not in FLOOR:
            faults.append(f"{module.name}: give the part {module.part!r} a floor in FLOORS")
            continue
        for target in own(module.eager | module.lazy) if module.part else ():
            there = part_of(target)
            if target == f"{OURS}.__version__" or there == module.part:
                continue
            if FLOOR.get(there, len(FLOORS)) >= FLOOR[module.part]:
                faults.append(f"{module.name} imports {target}, which is not below it")
            if module.part in ("control", "policy") and there not in (GROUND | {"policy"}):
                faults.append(f"{module.name} imports {target}: the ground floor imports {sorted(GROUND)} only")
    return faults


def loaded_by(modules: dict[str, Module], name: str) -> set[str]:
    """Our modules that importing `name` loads, itself and the packages around included."""
    seen: set[str] = set()
    waiting = [name]
    while waiting:
        current = waiting.pop()
        while current and current not in modules:  # `mjxball.errors.InputError` is a name in mjxball.errors
            current = current.rpartition(".")[0]
        if not current or current in seen:
            continue
        seen.add(current)
        waiting += [*own(modules[current].eager), current.rpartition(".")[0]]
    return seen


def circle(modules: dict[str, Module]) -> list[str]:
    """Modules of one circle of imports, those for type checkers included; packages' own lists of names are left out."""

    def follow(name: str, path: tuple[str, ...]) -> list[str]:
        if name in path:
            return [*path[path.index(name) :], name]
        if name not in done:
            done.add(name)
            for target in sorted(own(modules[name].eager | modules[name].typed)):
                there = target if target in modules else target.rpartition(".")[0]
                if there in ends and (found := follow(there, (*path, name))):
                    return found
        return []

    packages = {name.rpartition(".")[0] for name in modules}
    ends, done = set(modules) - packages, set[str]()
    return next((found for name in sorted(ends) if (found := follow(name, ()))), [])


def asked(name: str) -> set[str]:
    """What the module `name` may need besides, since only who writes that format loads it."""
    return {"onnx"} if name.startswith("mjxball.policy.formats.onnx_") else set()


def needs(modules: dict[str, Module], name: str) -> set[str]:
    """Other packages that importing `name` loads."""
    return set().union(*(foreign(modules[one].eager) for one in loaded_by(modules, name)))


@pytest.fixture(scope="module")
def modules() -> dict[str, Module]:
    return read(REPOSITORY / OURS) | read(REPOSITORY / FLIES)


def test_imports_run_one_way(modules: dict[str, Module]) -> None:
    assert direction_faults(modules) == []


def names_of_flight(text: str) -> list[str]:
    """Where Python code reaches for mjxfly: imports anywhere, and strings that name a module, or begin with one."""
    found: dict[str, set[str]] = {"eager": set(), "lazy": set(), "typed": set()}
    tree = ast.parse(text)
    imports_in(tree, "eager", found)
    strings = [node.value for node in ast.walk(tree) if isinstance(node, ast.Constant) and isinstance(node.value, str)]
    return [
        *sorted(name for name in set().union(*found.values()) if name.split(".")[0] == FLIES),
        *(string for string in strings if re.search(rf"(^|-m |import |from ){FLIES}\b", string)),
    ]


def test_what_trains_never_reaches_for_what_flies(modules: dict[str, Module]) -> None:
    for path in (*(REPOSITORY / OURS).rglob("*.py"), *REPOSITORY.glob("*.py")):
        assert names_of_flight(path.read_text()) == [], path
    for name, module in modules.items():
        if name.split(".")[0] == OURS:
            assert not foreign(module.eager | module.lazy) & FLYING, name
    assert set().union(*(foreign(module.eager | module.lazy) for module in modules.values())) >= FLYING


def test_no_imports_go_in_a_circle(modules: dict[str, Module]) -> None:
    """Not those for type checkers either: who asks for a function's hints loads them."""
    assert circle(modules) == []


@pytest.mark.parametrize("part", BASE)
def test_the_base_install_imports_numpy_alone(modules: dict[str, Module], part: str) -> None:
    members = [name for name, module in modules.items() if module.part == part]
    assert members
    for name in members:
        assert needs(modules, name) <= {"numpy"} | asked(name), name


@pytest.mark.parametrize("part", ["control", "policy"])
def test_the_ground_floor_never_imports_jax_or_mujoco_not_even_lazily(modules: dict[str, Module], part: str) -> None:
    for name, module in modules.items():
        if module.part == part:
            assert foreign(module.eager | module.lazy) <= {"numpy"} | asked(name), name


def test_what_flies_loads_no_jax(modules: dict[str, Module]) -> None:
    """Not in a function either, nor through a module that a function imports."""
    for name, module in modules.items():
        if module.part.startswith(FLIES):
            reached = foreign(module.lazy).union(
                needs(modules, name), *(needs(modules, one) for one in own(module.lazy))
            )
            assert not reached & {"jax", "jaxlib", "flax", "brax", "optax"}, name


COMMANDS = {OURS: ("commands.train", "commands.evaluate", "view.main", "export")}
COMMANDS[FLIES] = ("main", "view.main", "log", "app.main")


@pytest.mark.slow
@pytest.mark.parametrize("name", [f"{house}.{name}" for house, names in COMMANDS.items() for name in names])
def test_a_command_line_is_read_without_what_computes(name: str) -> None:
    """Help and refusals come at once: JAX alone takes half a second."""
    heavy = "{'jax', 'mujoco', 'scipy.stats', 'matplotlib'}"
    script = f"import sys, {name}\nprint(sorted({heavy} & set(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, env=environment(), cwd=REPOSITORY
    )
    assert done.stdout.strip() == "[]"


class TestTheReader:
    """The reader sees what it must see: each fault is planted in a small package and found."""

    def package(self, place: Path, **files: str) -> dict[str, Module]:
        for name, text in {"__init__": "", **files}.items():
            path = place / OURS / f"{name}.py"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        return read(place / OURS)

    def test_upward(self, tmp_path: Path) -> None:
        found = direction_faults(self.package(tmp_path, control="from mjxball.train import run", train=""))
        assert any("not below it" in fault for fault in found)

    def test_lazily_upward(self, tmp_path: Path) -> None:
        text = "def f():\n    import mjxball.evaluate\n"
        assert direction_faults(self.package(tmp_path, train=text, evaluate=""))

    def test_from_what_trains_to_what_flies(self, tmp_path: Path) -> None:
        assert direction_faults(self.package(tmp_path, env="def f():\n    import mjxfly.policy_setup\n"))
        for text in (
            "from mjxfly import policy_setup",
            "run_module('mjxfly.main')",
            "['-m', f'mjxfly.{name}']",
            "'-m mjxfly'",
        ):
            assert names_of_flight(text), text
        assert not names_of_flight("raise InputError('mjxball.view: mjxfly.view plays it')")

    def test_between_neighbours(self, tmp_path: Path) -> None:
        assert direction_faults(self.package(tmp_path, sim="import mjxball.env", env=""))

    def test_unknown_part(self, tmp_path: Path) -> None:
        (fault,) = direction_faults(self.package(tmp_path, attic=""))
        assert "floor" in fault

    def test_in_a_circle(self, tmp_path: Path) -> None:
        typed = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from mjxball.run import Run"
        modules = self.package(tmp_path, loop=typed, run="from mjxball.loop import learn")
        assert circle(modules) == ["mjxball.loop", "mjxball.run", "mjxball.loop"]

    def test_through_another_module(self, tmp_path: Path) -> None:
        modules = self.package(tmp_path, policy="from mjxball.control import mean", control="import jax.numpy as jnp")
        assert needs(modules, "mjxball.policy") == {"jax"}

    def test_sound(self, tmp_path: Path) -> None:
        text = "import numpy\nfrom mjxball.control import mean\nfrom mjxball import __version__"
        modules = self.package(tmp_path, policy=text, control="def mean(): ...")
        assert direction_faults(modules) == []
        assert needs(modules, "mjxball.policy") == {"numpy"}
