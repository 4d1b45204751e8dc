"""Check and compile a model: MJCF as it is, a URDF with a free base. Needs MuJoCo."""

from __future__ import annotations

import contextlib
import math
import re
import struct
import warnings
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any
from xml.parsers import expat

from mjxball.errors import InputError
from mjxball.files import read_text

XACRO = ".xacro"
MODELS = (".xml", ".urdf", XACRO)  # suffixes of model files
MAX_MODEL = 2**20  # bytes of a model, or of one that it includes
MAX_ASSET = 2**26  # bytes of a mesh or texture
MAX_ELEMENTS = 5000  # XML elements; MuJoCo takes seconds for more
MAX_PIXELS = 2**22  # of all height fields and textures of a model
UNEXPANDED = "it is a xacro file, expand it with xacro first: xacro FILE.xacro > FILE.urdf"
LONGEST = 200  # characters of a name or a message in an error message
FIRST = re.compile(r"(?>\s|<\?.*?\?>|<!--.*?-->|<!DOCTYPE[^>]*>)*+<([\w:.-]+)", re.DOTALL)
COMMENT = re.compile(r"<!--.*?-->", re.DOTALL)
COUNTS = re.compile(r"count|nrow|ncol|nsample|nkey|nuser\w*")  # attributes that count elements
FILE = re.compile(r"file(?:right|left|up|down|front|back)?")  # attributes of MJCF; shapes of a URDF are not used
MACRO = re.compile(r"\$\$?[{(]")  # a xacro expression in an attribute
ROTOR = re.compile(r"prop|rotor|motor|thrust", re.IGNORECASE)  # names of a URDF's links


def compiled(path: Path, text: str, rotors: Collection[str]) -> tuple[Any, Any, bool]:
    """(model, data in its initial state, whether it is a URDF) of the `text` in `path`; InputError if MuJoCo fails.

    In a URDF the joints of the links `rotors` are fixed, or if that is empty, of all links with names of rotors.
    """
    import mujoco

    if path.suffix.lower() == XACRO:
        raise InputError(UNEXPANDED)
    found = FIRST.match(text)
    first = found[1] if found else None
    if first not in ("mujoco", "robot"):
        begins = f"it begins with <{printable(first)}>" if first else "it is no XML"
        raise InputError(f"{begins}, expected <mujoco> (MJCF) or <robot> (URDF)")
    _Check(path, text)
    try:
        with captured_warnings() as caught:
            spec = mujoco.MjSpec.from_file(str(path))
            if first == "robot":
                _free(spec, rotors)
            model = spec.compile()
            data = mujoco.MjData(model)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_collision(model, data)
    except InputError:
        raise
    except Exception as error:  # whatever MuJoCo's parser, compiler and plug-ins raise
        said = printable(str(error)).removeprefix("Error: ").removeprefix("XML Error: ")
        if "mjMINVAL" in said:
            raise InputError("a body that moves has no mass or no inertia, expected both above 0") from None
        raise InputError(f"MuJoCo does not compile it: {said}") from None
    if any("NaN" in warning for warning in caught):
        raise InputError("a number of it is NaN, expected numbers")
    return model, data, first == "robot"


@contextlib.contextmanager
def captured_warnings() -> Iterator[list[str]]:
    """MuJoCo's warnings, which would go to a file in the current directory; those of its compiler are dropped."""
    import mujoco

    said: list[str] = []
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(said.append)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            yield said
    finally:
        mujoco.set_mju_user_warning(before)


def _free(spec: Any, rotors: Collection[str]) -> None:
    """Make the base of a URDF free, with masses from <inertial> alone, without shapes."""
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
    still = {joint.name for joint in spec.joints if _is_rotor(joint.parent.name, rotors)}
    for mimicry in [*spec.equalities]:
        if still & {mimicry.name1, mimicry.name2}:
            spec.delete(mimicry)
    for joint in [*spec.joints]:
        if joint.name in still:
            spec.delete(joint)
    base = spec.worldbody.first_body()
    for joint in [joint for joint in spec.joints if joint.type == mujoco.mjtJoint.mjJNT_FREE]:
        carried = {joint.parent.name, *(body.name for body in joint.parent.find_all("body"))}
        if joint.parent.name != base.name and not any(b.mass for b in spec.bodies if b.name not in carried):
            # Below a frame such as odom, which is a body to MuJoCo.
            base.add_joint(
                name=f"{joint.name} ", type=joint.type, damping=joint.damping, frictionloss=joint.frictionloss
            )
            spec.delete(joint)
    if base.joints and base.joints[0].type != mujoco.mjtJoint.mjJNT_FREE:
        raise InputError(f"joint {base.joints[0].name} holds its base to the world, expected a base that flies free")
    if not base.joints:
        base.add_freejoint()


class _Check:
    """Limits on the text of a model, checked before MuJoCo reads it.

    Raises InputError for more than `MAX_ELEMENTS` elements, after repetition, inclusion and attachment, more than
    `MAX_PIXELS` of pictures, and files that are missing, too large, or no files, such as a pipe, on which MuJoCo waits.
    """

    def __init__(self, path: Path, text: str, around: _Check | None = None):
        """`around`: the check of the model to which the one in `path` may be attached."""
        self.elements, self.attached, self.largest, self.points, self.times = 0.0, 0.0, 0.0, 0.0, [1.0]
        self.read, self.parents, self.folders = {path.resolve()}, [path.parent], [""]
        self.parents += around.parents if around else []
        self.models: dict[Path, float] = around.models if around else {}  # elements of models that may be attached
        self.files: list[tuple[str, str]] = []
        self._text(text)
        self._count(self.attached * self.largest)
        for kind, name in self.files:
            self._file(kind, name, MAX_ASSET)

    def _text(self, text: str) -> None:
        parser = expat.ParserCreate()
        parser.StartElementHandler, parser.EndElementHandler = self._begin, lambda name: self.times.pop()
        try:
            # MuJoCo allows -- in comments and blanks before the declaration.
            parser.Parse(COMMENT.sub("", text).lstrip(" \t\r\n"), True)
        except expat.ExpatError as error:
            raise InputError(f"it is no well-formed XML: {error}") from None

    def _begin(self, name: str, given: dict[str, str]) -> None:
        if name.startswith("xacro:") or any(map(MACRO.search, given.values())):
            raise InputError(UNEXPANDED)
        sizes = {"numeric": ("size",), "texture": ("width", "height")}.get(name, ())
        counts = [value for key, value in given.items() if COUNTS.fullmatch(key) or key in sizes]
        size = math.prod(max(1.0, _number(word)) for value in counts for word in value.split())
        if name in ("hfield", "texture"):
            self._picture(name, size)
            size = 1.0
        if name == "lengthrange" and given.get("mode") != "none":
            raise InputError("it has <lengthrange>, expected none: its actuators are rotors")
        self._count(self.times[-1] * size)
        self.attached += self.times[-1] * (name == "attach")
        self.times.append(self.times[-1] * (size if name == "replicate" else 1))
        self.folders += [given[key] for key in ("meshdir", "texturedir", "assetdir") if key in given]
        for file in (file for key, file in given.items() if file and FILE.fullmatch(key)):
            if name not in ("include", "model"):
                self.files.append((name, file))
                continue
            place = self._file(name, file, MAX_MODEL)
            if name == "model":
                self._model(place)
            elif place.resolve() not in self.read:
                self.read.add(place.resolve())
                self.parents.append(place.parent)
                self._text(read_text(place, name, MAX_MODEL))

    def _model(self, place: Path) -> None:
        """Check a model that <attach> may attach, and keep its number of elements."""
        if place.resolve() not in self.models:
            self.models[place.resolve()] = math.inf  # for a model that attaches itself
            self.models[place.resolve()] = _Check(place, read_text(place, "model", MAX_MODEL), self).elements
        elements = self.models[place.resolve()]
        self._count(elements)
        self.largest = max(self.largest, elements)

    def _picture(self, kind: str, points: float) -> None:
        self.points += points
        if self.points > MAX_PIXELS:
            raise InputError(f"with its {kind} it has {self.points:.3g} points, expected at most {MAX_PIXELS}")

    def _count(self, elements: float) -> None:
        self.elements += elements
        if self.elements > MAX_ELEMENTS:
            raise InputError(f"it has more than {MAX_ELEMENTS} elements, repeated and included ones among them")

    def _file(self, kind: str, name: str, limit: int) -> Path:
        """The path of the file `name`, with its folders or without (`strippath`); InputError beyond `limit` bytes."""
        names = (name, Path(name).name)
        places = [
            parent / folder / one for parent in self.parents for folder in reversed(self.folders) for one in names
        ]
        place = next((place for place in places if place.exists()), None)
        what = f"its {kind} {printable(name)}"
        if place is None:
            raise InputError(f"{what} is missing, expected at {places[0]}")
        if not place.is_file():
            raise InputError(f"{what} is no file")
        if place.stat().st_size > limit:
            raise InputError(f"{what} is larger than {limit >> 20} MiB")
        if place.suffix.lower() == ".png":
            with place.open("rb") as stream:
                self._picture(kind, math.prod(struct.unpack(">II", stream.read(24).ljust(24, b"\0")[16:])))
        return place


def _number(word: str) -> float:
    try:
        return float(word)
    except ValueError:  # MuJoCo reports it
        return 1.0


def _is_rotor(name: str, rotors: Collection[str]) -> bool:
    return name in rotors if rotors else ROTOR.search(name) is not None


def printable(text: str) -> str:
    """The printable characters of `text` in one line, shortened."""
    return " ".join("".join(letter if letter.isprintable() else " " for letter in text).split())[:LONGEST]
