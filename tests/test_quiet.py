"""Imports that are left until they are needed."""

from __future__ import annotations

import importlib
import sys

import pytest
from command_line import REPOSITORY, run

from mjxball import quiet


def printed_by(code: str) -> str:
    """What a fresh Python prints."""
    done = run(["-c", code], REPOSITORY)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_training_loads_no_mesh_library() -> None:
    """A quarter of the time of its imports."""
    printed = printed_by("""
import sys
import mjxball.train.run
from mjxball.config import preset
from mjxball.train.population import Population
Population(preset("transport"), "mjx").template()
print([name for name in ("trimesh", "scipy.spatial", "scipy.optimize", "jaxopt._src.base") if name in sys.modules])
""")
    assert printed == "[]\n"


def test_what_is_left_out_is_there_once_it_is_used() -> None:
    """A mesh, whose convex hull MJX asks of SciPy and trimesh."""
    printed = printed_by("""
import sys
import mujoco
from mjxball.quiet import LATE, import_brax_env, import_mjx
import_brax_env()
print(*(type(sys.modules[name]).__name__ for name in LATE))
corners = " ".join(f"{x} {y} {z}" for x in (0, 1) for y in (0, 1) for z in (0, 1))
model = mujoco.MjModel.from_xml_string(
    f'<mujoco><asset><mesh name="m" vertex="{corners}"/></asset><worldbody><geom type="plane" size="1 1 1"/>'
    '<body><freejoint/><geom type="mesh" mesh="m"/></body></worldbody></mujoco>'
)
meshes = import_mjx().put_model(model, impl="jax")._impl.mesh_convex
print([mesh.vert.shape for mesh in meshes if mesh])
import jaxopt
print(jaxopt.ProjectedGradient.__name__)
print(*(type(sys.modules[name]).__name__ for name in LATE))
""")
    assert printed.splitlines() == ["_LazyModule _LazyModule", "[(8, 3)]", "ProjectedGradient", "module module"]


def test_imports_are_found_as_ever_afterwards() -> None:
    before = list(sys.meta_path)
    with quiet._when_used("mjxball.absent"):
        assert len(sys.meta_path) == len(before) + 1
        with pytest.raises(ModuleNotFoundError):
            importlib.import_module("mjxball.absent")
    assert sys.meta_path == before
