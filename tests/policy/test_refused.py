"""Nothing unsound is ever loaded as a policy: every kind of damage gets one error of one line."""

from __future__ import annotations

import contextlib
import io
import json
import pickle
import struct
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import assert_refused
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mjxball.commands import evaluate
from mjxball.errors import InputError
from mjxball.policy import Policy, PolicyFileError

OBSERVATIONS = np.random.default_rng(0).normal(size=(40, 18))
ARRAYS = ("weight_0", "bias_0", "weight_1", "bias_2", "observation_mean", "observation_scale", "action_scale")
HUGE = 10**400  # an integer that JSON allows and no float holds


def refused(path: Path, match: str = "") -> None:
    """`path` is refused with one line that names the file, and `match` beside its path, which may hold it as well."""
    with pytest.raises(PolicyFileError) as error:
        Policy.load(path)
    message = str(error.value)
    assert match in message.replace(str(path), "")
    assert message.isprintable(), "not one line of printable text"
    assert str(path) in message
    assert isinstance(error.value, InputError)  # exit code 2


def arrays_of(path: Path) -> dict[str, np.ndarray]:
    with np.load(path) as data:
        return dict(data)


def rewrite(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Save the arrays of `path` again after `change`."""
    arrays = arrays_of(path)
    change(arrays)
    np.savez(path, **arrays)


def rewrite_metadata(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Save the metadata of `path` again after `change`."""
    metadata = json.loads(str(arrays_of(path)["card"]))
    change(metadata)
    rewrite(path, lambda arrays: arrays.update({"card": np.array(json.dumps(metadata))}))


class Bomb:
    """Writes a file when unpickled."""

    def __init__(self, witness: Path):
        self.witness = witness

    def __reduce__(self) -> tuple[Any, ...]:
        return (Path.touch, (self.witness,))


def copy_zip(path: Path, replaced: dict[str, bytes]) -> None:
    """Write the zip at `path` again with the bytes of some entries replaced."""
    with zipfile.ZipFile(path) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in {**entries, **replaced}.items():
            archive.writestr(name, content)


class TestDamagedContainer:
    def test_truncated_anywhere(self, saved):
        content = saved.read_bytes()
        offsets = {*range(0, len(content), len(content) // 60), *range(len(content) - 30, len(content)), 1, 2, 3, 4}
        for offset in sorted(offsets):
            saved.write_bytes(content[:offset])
            refused(saved)

    def test_missing(self, tmp_path):
        refused(tmp_path / "none.npz", "does not exist")

    def test_directory(self, tmp_path):
        refused(tmp_path, "directory")

    @pytest.mark.parametrize("content", [b"", b"PK", b"hello, I am not a zip file\n", bytes(1000)])
    def test_not_a_zip(self, tmp_path, content):
        path = tmp_path / "text.npz"
        path.write_bytes(content)
        refused(path)

    def test_pickle(self, tmp_path):
        path = tmp_path / "pickle.npz"
        path.write_bytes(pickle.dumps({"weights": [1, 2, 3]}))
        refused(path)

    def test_npy(self, tmp_path):
        path = tmp_path / "array.npz"
        with path.open("wb") as stream:
            np.save(stream, np.zeros(3))
        refused(path)

    @pytest.mark.parametrize("name", ["weight_0", "card"])
    def test_pickled_array_is_refused_unread(self, saved, name, tmp_path):
        witness = tmp_path / "executed"
        bomb = np.empty((), object)
        bomb[()] = Bomb(witness)
        rewrite(saved, lambda arrays: arrays.update({name: bomb}))
        refused(saved, "it holds a pickle")
        assert not witness.exists()

    def test_entry_that_is_no_array(self, saved):
        for name in arrays_of(saved):
            content = saved.read_bytes()
            copy_zip(saved, {f"{name}.npy": b"not an array at all"})
            refused(saved)
            saved.write_bytes(content)

    def test_huge_zip_claim(self, saved):
        """A zip bomb: 100 MB of zeros in 100 kB."""
        rewrite(saved, lambda arrays: None)
        with zipfile.ZipFile(saved, "a", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("bias_9.npy", bytes(100 * 2**20))
        refused(saved, "MiB")

    def test_huge_array_claim(self, saved):
        """An array header that claims a terabyte behind which there is nothing."""
        header = io.BytesIO()
        np.lib.format.write_array_header_1_0(header, {"descr": "<f4", "fortran_order": False, "shape": (2**38,)})
        copy_zip(saved, {"weight_0.npy": header.getvalue()})
        refused(saved)

    def test_entry_shorter_than_its_directory_claims(self, saved):
        """A sound array, whose checksum fits, behind a directory that promises one byte more."""
        content = bytearray(saved.read_bytes())
        entry = content.rindex(b"PK\x01\x02")
        (size,) = struct.unpack_from("<I", content, entry + 24)  # of the entry, unpacked
        struct.pack_into("<I", content, entry + 24, size + 1)
        saved.write_bytes(content)
        refused(saved)

    def test_too_many_entries(self, saved):
        rewrite(
            saved, lambda arrays: arrays.update({f"weight_{k}": np.zeros((1, 1), np.float32) for k in range(3, 200)})
        )
        refused(saved)


class TestDamagedArrays:
    @pytest.mark.parametrize("name", [*ARRAYS, "card"])
    def test_missing(self, saved, name):
        rewrite(saved, lambda arrays: arrays.pop(name))
        refused(saved, name.replace("weight", "bias"))  # layers are counted by weights: what is left over is named

    @pytest.mark.parametrize("name", ["weight_7", "bias_3", "extra", "a\nb"])
    def test_extra(self, saved, name):
        rewrite(saved, lambda arrays: arrays.update({name: np.zeros(3, np.float32)}))
        refused(saved)

    @pytest.mark.parametrize("name", ARRAYS)
    @pytest.mark.parametrize("dtype", [np.float64, np.float16, np.int32, np.complex64, ">f4"])
    def test_wrong_dtype(self, saved, name, dtype):
        rewrite(saved, lambda arrays: arrays.update({name: arrays[name].astype(dtype)}))
        refused(saved, name)

    @pytest.mark.parametrize("name", ARRAYS)
    @pytest.mark.parametrize(
        "reshape",
        [
            lambda a: a[:-1],
            lambda a: a[None],
            lambda a: np.concatenate([a, a]),
            lambda a: a.ravel()[0],
            lambda a: a[:0],
        ],
        ids=["shorter", "another axis", "longer", "a scalar", "empty"],
    )
    def test_wrong_shape(self, saved, name, reshape):
        rewrite(saved, lambda arrays: arrays.update({name: np.asarray(reshape(arrays[name]))}))
        refused(saved)

    def test_transposed_weight(self, saved):
        rewrite(saved, lambda arrays: arrays.update(weight_0=arrays["weight_0"].T))
        refused(saved, "weight_0")

    @pytest.mark.parametrize("name", ARRAYS)
    @pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
    def test_not_finite(self, saved, name, value):
        rewrite(saved, lambda arrays: np.put(arrays[name], 1, value))
        refused(saved)

    @pytest.mark.parametrize(
        ("name", "value"), [("observation_scale", -1.0), ("action_scale", 0.0), ("action_scale", 9.0)]
    )
    def test_impossible_scale(self, saved, name, value):
        rewrite(saved, lambda arrays: np.put(arrays[name], 0, value))
        refused(saved, name)

    def test_action_without_range(self, saved):
        """The metadata and the array agree that roll and pitch have a range of 0."""
        rewrite_metadata(saved, lambda metadata: metadata.update(action_reach=[0.0, metadata["action_reach"][1]]))
        rewrite(saved, lambda arrays: np.put(arrays["action_scale"], [0, 1], 0.0))
        refused(saved, "action_scale must be positive")

    @pytest.mark.parametrize(
        "metadata", [np.zeros(3), np.array(["{}"]), np.array(b"{}"), np.array("{"), np.array("[1]")]
    )
    def test_card_is_not_one_json_object(self, saved, metadata):
        rewrite(saved, lambda arrays: arrays.update({"card": metadata}))
        refused(saved, "metadata")


class TestDamagedCard:
    @pytest.mark.parametrize(
        ("version", "kind"), [(2, "an LQG of a pair"), (3, "an LQG of one of a team"), (4, "LQGs for attitude loops")]
    )
    def test_a_format_on_an_lqg_names_the_last_version_that_flies_it(self, saved, version, kind, capsys):
        """Whatever its arrays are, and on the command line."""
        rewrite_metadata(saved, lambda metadata: metadata.update(format_version=version))
        rewrite(saved, lambda arrays: arrays.update(weight_0=arrays["weight_0"][:3]))
        refused(saved, f"has policy format {version}, a network on top of {kind}")
        refused(saved, ": mjxball 0.1.0 is the last version that flies it")
        assert "0.1.0" in assert_refused(evaluate.main, [saved], saved.parent, capsys)

    @pytest.mark.parametrize("version", [0, 6, "1", None, True, [1], 1.5, HUGE], ids=lambda v: repr(v)[:5])
    def test_unknown_format_version(self, saved, version):
        rewrite_metadata(saved, lambda metadata: metadata.update(format_version=version))
        refused(saved, "format")

    def test_every_field_is_needed(self, saved, trained):
        content = saved.read_bytes()
        for field in ("history", "observation", "action_reach", "gravity", "control_period", "plant", "bounds"):
            saved.write_bytes(content)
            rewrite_metadata(saved, lambda metadata, field=field: metadata.pop(field))
            refused(saved, field)

    @pytest.mark.parametrize(
        "observation",
        [
            lambda slots: [["height", "m"], *slots[1:]],
            lambda slots: [["follower_x", "cm"], *slots[1:]],
            lambda slots: slots[:-1],
            lambda slots: [*slots, ["wind", "m/s"]],
            lambda slots: [*slots, "wind"],
            lambda slots: [slots[1], slots[0], *slots[2:]],
            lambda slots: [],
            lambda slots: "follower_x",
        ],
        ids=["name", "unit", "missing", "extra", "extra without unit", "order", "empty", "text"],
    )
    def test_other_observation(self, saved, observation):
        rewrite_metadata(saved, lambda metadata: metadata.update(observation=observation(metadata["observation"])))
        refused(saved, "observation")

    def test_other_action(self, saved):
        rewrite_metadata(saved, lambda metadata: metadata.update(action=metadata["action"][::-1]))
        refused(saved, "action")

    @pytest.mark.parametrize(
        ("field", "value"),
        [
            ("history", 0),
            ("history", 101),
            ("history", 2),
            ("history", 1.0),
            ("history", True),
            ("history", HUGE),
            ("previous_action", 1),
            ("previous_action", True),
            ("stale", True),
            ("stale", 0),
            ("stale", None),
            ("action_mode", "both"),
            ("action_mode", "a\nb"),
            ("action_reach", [0.2]),
            ("action_reach", [0.2, float("nan")]),
            ("action_reach", [0.2, "2"]),
            ("action_reach", [0.2, HUGE]),
            ("command_limits", [-0.6, 6.0]),
            ("leader_kp", [0.5, 0.5]),
            ("leader_kp", [1e300, 0.5, 0.5]),  # no float32: the command would be NaN
            ("leader_kd", [[1, 1, 1]]),
            ("gravity", 0.0),
            ("gravity", float("inf")),
            ("gravity", HUGE),
            ("gravity", "9.81"),
            ("control_period", -0.02),
            ("control_period", None),
            ("plant", []),
            ("bounds", {"x_peak": None}),
            ("bounds", {"x_peak": HUGE}),
            ("bounds", {"x_peak": -1e300}),
            ("bounds", [0.05]),
            ("flown", [2, 3]),
            ("flown", {"drones": [2, 3]}),
            ("flown", {"drones": [], "seconds": 60.0}),
            ("flown", {"drones": [1], "seconds": 60.0}),
            ("flown", {"drones": [2.0], "seconds": 60.0}),
            ("flown", {"drones": [2], "seconds": HUGE}),
            ("flown", {"drones": [2], "seconds": 0}),
        ],
        ids=lambda value: "huge" if value == HUGE else repr(value)[:20],
    )
    def test_impossible_field(self, saved, field, value):
        rewrite_metadata(saved, lambda metadata: metadata.update({field: value}))
        refused(saved)

    def test_residual_policy_of_unknown_plant_still_loads(self, saved, capsys):
        """The network does not use the plant, so that settings of another version are no damage; evaluation does."""
        rewrite_metadata(saved, lambda metadata: metadata["plant"].update(leader_mass=1.0))
        assert Policy.load(saved).metadata["plant"]["leader_mass"] == 1.0
        said = assert_refused(evaluate.main, [saved], saved.parent, capsys)
        assert f"{saved}: configuration" in said
        assert "unknown leader_mass; mjxball 0.1.0 is the last version that reads" in said


def loads_or_is_refused(path: Path) -> None:
    """Either a policy that flies or the one error in one line, never another."""
    refusal = ""
    try:
        policy = Policy.load(path)
    except PolicyFileError as error:
        refusal = str(error)
    assert refusal.isprintable()
    if not refusal:
        assert np.isfinite(policy(OBSERVATIONS)).all()


@contextlib.contextmanager
def damaged(path: Path) -> Iterator[bytes]:
    """The file's bytes; what the block left there loads or is refused, and is then undone, for the next example."""
    original = path.read_bytes()
    try:
        yield original
        loads_or_is_refused(path)
    finally:
        path.write_bytes(original)


mutations = settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
places = st.one_of(
    st.integers(0, 10**6),  # anywhere
    st.integers(-1500, -1),  # the zip's directory: where everything is, and how long
)


@mutations
@given(changes=st.lists(st.tuples(places, st.integers(0, 255)), min_size=1, max_size=4))
def test_mutated_bytes_load_or_are_refused(saved, changes):
    with damaged(saved) as original:
        content = bytearray(original)
        for place, value in changes:
            content[place % len(content)] = value
        saved.write_bytes(content)


@mutations
@given(data=st.data())
def test_mutated_array_header_loads_or_is_refused(saved, data):
    """Behind an intact zip: any byte of an array's own header, where NumPy keeps dtype and shape."""
    name = data.draw(st.sampled_from([*ARRAYS, "card"]))
    with zipfile.ZipFile(saved) as archive:
        content = bytearray(archive.read(f"{name}.npy"))
    for place, value in data.draw(
        st.lists(st.tuples(st.integers(0, 127), st.integers(0, 255)), min_size=1, max_size=3)
    ):
        content[place] = value
    with damaged(saved):
        copy_zip(saved, {f"{name}.npy": bytes(content)})


@mutations
@given(data=st.data())
def test_mutated_card_loads_or_is_refused(saved, data):
    """Any JSON value in place of any field, behind an intact zip."""
    metadata = json.loads(str(arrays_of(saved)["card"]))
    number = st.one_of(st.integers(), st.floats(), st.just(HUGE), st.booleans(), st.none(), st.text(max_size=5))
    value = st.recursive(
        number, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
    )
    field = data.draw(st.sampled_from(sorted(metadata)))
    with damaged(saved):
        rewrite_metadata(saved, lambda metadata: metadata.update({field: data.draw(value)}))
