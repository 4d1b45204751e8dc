"""Followers of any origin for the benchmark: a name, a policy file, an ONNX file or `module:Class`."""

from __future__ import annotations

import hashlib
import sys
from importlib.machinery import PathFinder
from pathlib import Path
from typing import Any

import numpy as np

from mjxball.baselines import CONTROLLERS
from mjxball.config import Config
from mjxball.control.observation import OBSERVATION_SIZE
from mjxball.errors import InputError, said
from mjxball.evaluate.followers import FollowerFactory, answered, follower_factory
from mjxball.evaluate.policies import load_policy
from mjxball.files import read_bytes
from mjxball.policy import Policy, policy_name, policy_path, shipped_policies
from mjxball.policy.file import adds_to_pid
from mjxball.reading import parse_json

BASELINES = Path(__file__).parents[1] / "baselines"
TYPES = {"observation": "tensor(float)", "memory": "tensor(float)", "start": "tensor(bool)"}  # of inputs
UNRANKED = {"oracle", "stay", "random"}  # with privileged information, or no controllers


def entrant(text: str) -> tuple[str, FollowerFactory]:
    """(name, function that makes it for a plant) of the follower that `text` names; InputError if there is none.

    `text` is POLICY.npz or the name of a shipped one, MODEL.onnx, or what `evaluate.followers.follower_factory` finds.
    """
    path = policy_path(text)
    if path.suffix == ".npz":
        Policy.load(path)  # raises at once for a bad file
        return policy_name(path), lambda config: _loaded(path, config)
    if path.suffix == ".onnx":
        session = _session(path)
        return path.stem, lambda config: OnnxFollower(path.stem, session)
    check_name(text)
    return follower_factory(text, "follower")


def identity(text: str) -> tuple[str, str]:
    """(name, SHA-256) of the follower that `text` names, without running anything of it; InputError if there is none.

    The hash is of its file, of the file of its module, or of all classical followers for one of them.
    """
    path = policy_path(text)
    if path.suffix in (".npz", ".onnx"):
        return policy_name(path), hashlib.sha256(read_bytes(path, "", 2**30)).hexdigest()
    check_name(text)
    sources = sorted(BASELINES.glob("*.py")) if text in CONTROLLERS else [_source(text)]
    content = b"".join(read_bytes(source) for source in sources)
    return text.rpartition(":")[2], hashlib.sha256(content).hexdigest()


def _source(text: str) -> Path:
    """The file of the module in module:Class, which is not imported; searches the current directory too."""
    module, places = text.partition(":")[0], [*sys.path, str(Path.cwd())]
    found, parts = None, module.split(".")
    for number in range(len(parts)):
        found = PathFinder.find_spec(".".join(parts[: number + 1]), places)
        if found is None:
            raise InputError(
                f"follower {text}: there is no module {module} here or among the installed packages; install it or run "
                "from its directory"
            )
        places = list(found.submodule_search_locations or [])
    if found is None or found.origin is None:
        raise InputError(f"follower {text}: module {module} has no source file")
    return Path(found.origin)


def check_name(text: str) -> None:
    """Raise InputError unless `text` is module:Class or the name of a classical follower that is ranked."""
    if text in UNRANKED:
        raise InputError(f"{text} is not ranked: it uses information that no follower can have, or is no controller")
    if text not in CONTROLLERS and ":" not in text:
        names = [
            *(shipped.stem for shipped in shipped_policies()),
            *(name for name in CONTROLLERS if name not in UNRANKED),
        ]
        raise InputError(
            f"the benchmark flies a file .npz or .onnx, module:Class, or one of {', '.join(names)}, not {text!r}"
        )


def _loaded(path: Path, config: Config) -> Policy:
    """The policy; its errors are worded without the file's path, because entries store them."""
    try:
        return load_policy(path, config)
    except InputError as error:
        raise InputError(str(error).replace(str(path), path.name)) from None


class OnnxFollower:
    """An ONNX model with the inputs and outputs of `mjxball.export`, one row per flight and follower."""

    def __init__(self, name: str, session: Any):
        self.name, self._session = name, session
        if adds_to_pid(_metadata(name, session)):
            raise InputError(f"{name} adds to the leader's PID controller with its integrals, which none does now")
        self._remembers = "memory" in {one.name for one in session.get_inputs()}
        self._memory: np.ndarray | None = None

    def reset(self) -> None:
        """See `Follower.reset`."""
        self._memory = None

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        """See `Follower.__call__`."""
        rows = np.asarray(observation, np.float32).reshape(-1, OBSERVATION_SIZE)
        given: dict[str, np.ndarray] = {"observation": rows}
        if self._remembers:
            size = next(one.shape[-1] for one in self._session.get_inputs() if one.name == "memory")
            fresh = self._memory is None
            given["memory"] = np.zeros((len(rows), size), np.float32) if self._memory is None else self._memory
            given["start"] = np.full((len(rows), 1), fresh)
        wanted = ["command", "next_memory"] if self._remembers else ["command"]
        try:
            command, *memory = self._session.run(wanted, given)
        except Exception as error:  # whatever the runtime raises for a model that cannot be computed
            raise InputError(f"follower {self.name} raised {said(error)}") from None
        self._memory = memory[0] if memory else None
        return answered(self.name, command, rows).reshape(*np.shape(observation)[:-1], 3)


def _metadata(name: str, session: Any) -> dict[str, Any]:
    """Metadata of the policy that the model was exported from; {} for a model of another origin."""
    text = session.get_modelmeta().custom_metadata_map.get("card", "{}")
    try:
        found = parse_json(text)
    except (ValueError, RecursionError):
        found = None
    if not isinstance(found, dict):
        raise InputError(f"the metadata of {name} is not a JSON object")
    return found


def _session(path: Path) -> Any:
    try:
        import onnxruntime  # type: ignore[import-untyped]
    except ImportError:
        raise InputError("an ONNX follower needs onnxruntime; pip install 'mjxball[onnx]'") from None
    if not path.is_file():
        raise InputError(f"there is no file {path}")
    try:
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 4  # what it raises says it all
        options.intra_op_num_threads = options.inter_op_num_threads = 1  # CPU time is that of the model alone
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # whatever the runtime raises for a file that is no model
        raise InputError(f"{path} is no ONNX model: {said(error)}") from None
    inputs = {one.name: one for one in session.get_inputs()}
    outputs = {one.name for one in session.get_outputs()}
    wanted = {"command", "next_memory"} if "memory" in inputs else {"command"}
    paired = ("memory" in inputs) == ("start" in inputs)
    if "observation" not in inputs or not set(inputs) <= set(TYPES) or not wanted <= outputs or not paired:
        raise InputError(
            f"{path} has inputs {', '.join(sorted(inputs))} and outputs {', '.join(sorted(outputs))}; wanted are "
            "observation, with a memory also memory and start, and command, with a memory also next_memory"
        )
    for name, one in inputs.items():
        width = {"observation": OBSERVATION_SIZE, "start": 1}.get(name, one.shape[-1] if one.shape else None)
        rows, *rest = one.shape or [None]
        if one.type != TYPES[name] or isinstance(rows, int) or rest != [width] or not isinstance(width, int):
            raise InputError(
                f"{path} takes {name} as {one.type} of shape {one.shape}; wanted is {TYPES[name]} of shape "
                f"['flights', {width if isinstance(width, int) else 'a number'}], for any number of flights"
            )
    return session
