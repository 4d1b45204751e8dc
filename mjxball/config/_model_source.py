"""A model for MuJoCo, compiled: MJCF as it is, a URDF with a base that flies. Needs MuJoCo."""

from __future__ import annotations

import re
from collections.abc import Collection
from pathlib import Path
from typing import Any

from mjxball.errors import InputError

MODELS = (".xml", ".urdf")  # endings of the files
MAX_ASSET = 2**26  # bytes of a mesh or texture
LONGEST = 200  # characters of a name or a message that a sentence shows
FIRST = re.compile(r"\ufeff?(?>\s|<\?.*?\?>|<!--.*?-->|<!DOCTYPE[^>]*>)*+<([\w:.-]+)", re.DOTALL)
ROTOR = re.compile(r"prop|rotor|motor|thrust", re.IGNORECASE)  # in the name of a URDF's link


def compiled(path: Path, text: str, rotors: Collection[str]) -> tuple[Any, bool]:
    """The `text` of the model `path` compiled, and whether it is a URDF; InputError for what does not compile.

    Of a URDF joints of links that `rotors` names are fixed; if it names none, of those that are called like rotors.
    """
    import mujoco

    found = FIRST.match(text)
    first = found[1] if found else None
    if first not in ("mujoco", "robot"):
        begins = f"it begins with <{printable(first)}>" if first else "it is no XML"
        raise InputError(f"{begins}, expected <mujoco> (MJCF) or <robot> (URDF)")
    warnings: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(warnings.append)  # else they go to a file in the current directory
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        if first == "robot":
            _free(spec, rotors)
        _check_assets(spec, path)
        model = spec.compile()
    except InputError:
        raise
    except Exception as error:  # whatever MuJoCo's parser, compiler and plug-ins raise
        said = printable(str(error)).removeprefix("Error: ").removeprefix("XML Error: ")
        if "mjMINVAL" in said:
            raise InputError("a body that moves has no mass or no inertia, expected both above 0") from None
        raise InputError(f"MuJoCo does not compile it: {said}") from None
    finally:
        mujoco.set_mju_user_warning(before)
    if any("NaN" in warning for warning in warnings):
        raise InputError("a number of it is NaN, expected numbers")
    return model, first == "robot"


def _free(spec: Any, rotors: Collection[str]) -> None:
    """Let a URDF's base fly; its links have the mass of their <inertial>, and shapes do not matter."""
    import mujoco

    spec.compiler.fusestatic = False
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_FALSE
    for shape in [*spec.geoms, *spec.meshes]:
        spec.delete(shape)
    if not sum(body.mass for body in spec.bodies if body.explicitinertial):
        raise InputError("no link has a mass, expected <inertial> with <mass> and <inertia>")
    for body in spec.bodies:
        if not body.explicitinertial:
            body.ipos = [0.0, 0.0, 0.0]
    for joint in [*spec.joints]:
        if _is_rotor(joint.parent.name, rotors):
            spec.delete(joint)
    base = spec.worldbody.first_body()
    if base.joints:
        raise InputError(f"joint {base.joints[0].name} holds its base to the world, expected a base that flies free")
    base.add_freejoint()


def _check_assets(spec: Any, path: Path) -> None:
    for kind, folder, every in (
        ("mesh", spec.meshdir, spec.meshes),
        ("texture", spec.texturedir, spec.textures),
        ("height field", spec.meshdir, spec.hfields),
    ):
        for asset in every:
            file = path.parent / folder / asset.file
            if asset.file and not file.is_file():
                raise InputError(f"its {kind} {asset.file} is missing, expected at {file}")
            if asset.file and file.stat().st_size > MAX_ASSET:
                raise InputError(f"its {kind} {asset.file} is larger than {MAX_ASSET >> 20} MiB")


def _is_rotor(name: str, rotors: Collection[str]) -> bool:
    return name in rotors if rotors else ROTOR.search(name) is not None


def printable(text: str) -> str:
    """`text` of a stranger's file in one line, of a long one the beginning."""
    return " ".join("".join(letter if letter.isprintable() else " " for letter in text).split())[:LONGEST]
