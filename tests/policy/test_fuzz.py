"""Damaged files load right or are refused in one sentence."""

from __future__ import annotations

import contextlib
import io
import itertools
import json
import os
import random
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import NamedTuple

import damage
import numpy as np
import orbax.checkpoint as ocp
import pytest
from command_line import TRANSPORT, environment
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mjxball.errors import InputError
from mjxball.policy import Policy, PolicyFileError, shipped_policies, shipped_policy
from mjxball.train.checkpoint import Checkpoints
from mjxball.train.run_directory import read_config


@pytest.fixture(scope="module")
def run_directory(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The records of a run of two members, without its checkpoints."""
    return damage.records(tmp_path_factory.mktemp("run"))


MANY = pytest.mark.release


@pytest.mark.parametrize("files", [140, pytest.param(10_000, marks=MANY)])
def test_damaged_policies(files: int, tmp_path: Path) -> None:
    """At least 10 of each kind of damage."""
    counts = damage.fuzz_policies(files, 2, tmp_path)
    assert [count for count in counts if count.faults] == []
    assert sum(count.files for count in counts) == files
    assert sum(count.loaded for count in counts) > 0, "nothing loads: the mutations are not what they say"
    assert sum(count.refused for count in counts) > files / 3


@pytest.mark.parametrize("files", [19, pytest.param(1000, marks=MANY)])
def test_damaged_records_of_a_run(files: int, run_directory: Path) -> None:
    damage.read_records(run_directory)
    counts = damage.fuzz_records(run_directory, files, 1)
    assert [count for count in counts if count.faults] == []
    assert sum(count.loaded for count in counts) > files / 20
    assert sum(count.refused for count in counts) > files / 3


class TestTheJudge:
    """What judges the loaders sees every fault."""

    @pytest.mark.parametrize(
        ("load", "word"),
        [
            (lambda path: (_ for _ in ()).throw(KeyError("x")), "KeyError"),
            (lambda path: (_ for _ in ()).throw(InputError("two\nlines")), "not one line"),
            (lambda path: bytearray(300 * 2**20), "took 300 MiB"),
            (lambda path: os.environ.__setitem__("MJXBALL_FUZZ_WITNESS", "x"), "ran code"),
            (lambda path: os.system("true"), "ran code"),
            (lambda path: (_ for _ in ()).throw(MemoryError()), "MemoryError"),
        ],
        ids=["traceback", "two lines", "memory", "code", "a process", "no memory"],
    )
    def test_fault(self, load, word: str, tmp_path: Path) -> None:
        count = damage.Count("planted")
        assert word in damage.measured(load, tmp_path, count)
        assert (count.files, count.faults) == (1, 1)

    def test_hang(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        monkeypatch.setattr(damage, "PATIENCE", 0.2)

        def hang(path: Path) -> None:
            while True:
                try:
                    while True:
                        pass
                except Exception:  # as a loader's own clause would
                    continue

        assert damage.outcome(hang, tmp_path) == "it hung"

    def test_a_pickle_would_be_seen(self, tmp_path: Path) -> None:
        path = tmp_path / "pickle.npz"
        path.write_bytes(damage.pickled(random.Random(3), TRANSPORT.read_bytes()))
        for name in ("card", "weight_0", "observation_mean", "extra"):
            with np.load(path, allow_pickle=True) as data:
                try:
                    data[name]
                except Exception:
                    continue
        assert os.environ.pop("MJXBALL_FUZZ_WITNESS", None) == "executed"
        with pytest.raises(PolicyFileError):
            Policy.load(path)
        assert "MJXBALL_FUZZ_WITNESS" not in os.environ


class TestFoundHoles:
    """What the fuzzers found, each with the file that showed it."""

    def rewritten(self, place: Path, name: str, content: bytes, method: int = zipfile.ZIP_STORED) -> Path:
        path = place / "hole.npz"
        with zipfile.ZipFile(TRANSPORT) as old, zipfile.ZipFile(path, "w", method) as new:
            for entry in old.namelist():
                if entry != name:
                    new.writestr(entry, old.read(entry))
            new.writestr(name, content)
        return path

    def refused(self, path: Path, word: str) -> None:
        with pytest.raises(PolicyFileError, match=word):
            Policy.load(path)

    def test_flipped_weight(self, tmp_path: Path) -> None:
        """One bit of a weight: NumPy reads it unnoticed, the zip's checksum knows."""
        content = bytearray(TRANSPORT.read_bytes())
        content[content.index(b"weight_0.npy") + 1000] ^= 1
        path = tmp_path / "bit.npz"
        path.write_bytes(content)
        self.refused(path, "damaged")

    def test_terabyte_by_header(self, tmp_path: Path) -> None:
        stream = io.BytesIO()
        np.lib.format.write_array_header_1_0(stream, {"descr": "<f4", "fortran_order": False, "shape": (2**28,)})
        path = self.rewritten(tmp_path, "weight_0.npy", stream.getvalue() + bytes(4096))
        count = damage.Count("header")
        assert damage.measured(Policy.load, path, count) == "refused"
        assert count.memory < 5  # [MiB]; 1 GiB if the header were believed

    def test_lzma_dictionary(self, tmp_path: Path) -> None:
        path = self.rewritten(tmp_path, "extra.npy", b"x", zipfile.ZIP_LZMA)
        self.refused(path, "another method")

    def test_wide_card(self, tmp_path: Path) -> None:
        """JSON of two million empty lists: 60 times its own length in memory, if it were parsed."""
        stream = io.BytesIO()
        np.save(stream, np.array("[" + "[]," * 2_000_000 + "[]]"))
        path = self.rewritten(tmp_path, "card.npy", stream.getvalue(), zipfile.ZIP_DEFLATED)
        count = damage.Count("card")
        assert damage.measured(Policy.load, path, count) == "refused"
        assert count.memory < 120  # [MiB]: the text itself, 24 MiB, a few times; 250 more if it were parsed

    def test_pipe(self, tmp_path: Path) -> None:
        path = tmp_path / "pipe.npz"
        os.mkfifo(path)
        self.refused(path, "regular file")

    def test_entry_twice(self, tmp_path: Path) -> None:
        path = tmp_path / "twice.npz"
        path.write_bytes(TRANSPORT.read_bytes())
        with (
            zipfile.ZipFile(TRANSPORT) as old,
            zipfile.ZipFile(path, "a") as new,
            pytest.warns(UserWarning, match="Duplicate name"),
        ):
            new.writestr("bias_0.npy", old.read("bias_0.npy"))
        self.refused(path, "more than once")

    @pytest.mark.parametrize("config", [[], {"leader": [1]}, {"reward": 3}, "x"])
    def test_card_with_another_configuration(self, config: object, tmp_path: Path) -> None:
        with np.load(TRANSPORT) as data:
            arrays = dict(data)
        metadata = {**json.loads(str(arrays.pop("card"))), "config": config}
        np.savez(tmp_path / "config.npz", **arrays | {"card": np.array(json.dumps(metadata))})
        self.refused(tmp_path / "config.npz", "config")

    @pytest.mark.parametrize(
        "text",
        [
            "[" * 100_000,
            '{"config": {}, "seed": 0}',
            "null",
            '{"config": ' + "9" * 5000 + "}",
            "\xff\xfe{",
        ],
        ids=["deep", "empty", "null", "long number", "not UTF-8"],
    )
    def test_configuration_of_a_run(self, text: str, tmp_path: Path) -> None:
        (tmp_path / "config.json").write_text(text, encoding="latin-1")
        with pytest.raises(InputError) as error:
            read_config(tmp_path)
        assert str(error.value).isprintable()

    @pytest.mark.parametrize(("name", "value"), [("seeds", 10**9), ("seed", -1), ("sweep", {"plant.arm": [1, 2]})])
    def test_a_run_of_a_billion_members(self, name: str, value: object, run_directory: Path, tmp_path: Path) -> None:
        record = json.loads((run_directory / "config.json").read_text())
        (tmp_path / "config.json").write_text(json.dumps({**record, name: value}))
        with pytest.raises(InputError, match=r"sound seed|cannot differ"):
            read_config(tmp_path)


class State(NamedTuple):
    """As much of a training state as its checkpoints ask for."""

    steps: np.ndarray
    weights: np.ndarray
    replay: np.ndarray


class TestCheckpoints:
    """Every damaged file of a checkpoint is noticed: restored is what was written, or nothing."""

    state = State(np.array(7), np.linspace(-1, 1, 64, dtype=np.float32).reshape(8, 8), np.arange(500, dtype=np.float32))

    @pytest.fixture
    def written(self, tmp_path: Path) -> Path:
        with contextlib.closing(Checkpoints(tmp_path / "run")) as checkpoints:
            checkpoints.save(self.state)
        return tmp_path / "run"

    def restored(self, run: Path) -> State | None:
        with contextlib.suppress(InputError), contextlib.closing(Checkpoints(run)) as checkpoints:
            return checkpoints.restore(self.state, lambda text: None, discard=False)
        return None

    def test_one_that_cannot_be_written_is_a_sentence(self, tmp_path: Path) -> None:
        """Orbax writes in the background; what went wrong there is told when all is to be on disk."""
        checkpoints = Checkpoints(tmp_path / "run")
        shutil.rmtree(tmp_path / "run")
        (tmp_path / "run").touch()  # no directory can be made there
        with pytest.raises(InputError, match="checkpoints cannot be written"), contextlib.closing(checkpoints):
            checkpoints.save(self.state)

    def test_reading_leaves_the_one_that_is_being_written(self, written: Path) -> None:
        """Another process writes it: whoever exports a run that is trained must not clean up."""
        unfinished = written / "checkpoints" / "9.orbax-checkpoint-tmp"
        unfinished.mkdir()
        (unfinished / "part").write_bytes(b"part")
        with contextlib.closing(Checkpoints(written, reading=True)) as checkpoints:
            self.assert_whole(checkpoints.restore(self.state, lambda text: None, discard=False))
        assert (unfinished / "part").read_bytes() == b"part"

    @pytest.mark.slow
    def test_reads_that_fail_beside_the_first_are_nobodys_business(self) -> None:
        """asyncio says so of a task that is collected unread; when that is, depends on the load of the machine."""
        code = """
import asyncio, gc
import mjxball.train.checkpoint
async def _wrap_awaitable(): raise ValueError("NOT_FOUND")
async def another(): raise ValueError("of a user's")
async def read(task):
    asyncio.ensure_future(task())
    await asyncio.sleep(0)
for task in (_wrap_awaitable, another):
    asyncio.run(read(task))
gc.collect()
"""
        done = subprocess.run(
            [sys.executable, "-c", code], env=environment(), capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        assert "NOT_FOUND" not in done.stderr
        assert "of a user's" in done.stderr

    def test_a_damaged_one_is_one_warning_and_no_traceback(self, tmp_path: Path, written: Path) -> None:
        """TensorStore's threads answer reads after the first failure has ended them; that is nobody's business."""
        script = f"""
import contextlib, shutil, sys
from pathlib import Path
sys.path.insert(0, {str(Path(__file__).parents[1])!r})
from policy.test_fuzz import TestCheckpoints
from mjxball.train.checkpoint import Checkpoints
run = Path({str(written)!r})
files = [path.relative_to(run) for path in run.rglob("*") if path.is_file()]
for name in files:
    shutil.copytree(run, run.with_name("other"))
    (run.with_name("other") / name).unlink()
    with contextlib.suppress(Exception), contextlib.closing(Checkpoints(run.with_name("other"))) as checkpoints:
        checkpoints.restore(TestCheckpoints.state, print, discard=False)
    shutil.rmtree(run.with_name("other"))
"""
        done = subprocess.run(
            [sys.executable, "-c", script], env=environment(), capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        assert done.stderr == ""
        assert "cannot be read" in done.stdout

    def assert_whole(self, found: State) -> None:
        for mine, other in zip(self.state, found, strict=True):
            np.testing.assert_array_equal(mine, other)

    def test_the_newest_sound_one_is_restored(self, tmp_path: Path) -> None:
        steps, warnings = (7, 9), []
        for step in steps:
            with contextlib.closing(Checkpoints(tmp_path)) as checkpoints:
                checkpoints.save(self.state._replace(steps=np.array(step)))
        with contextlib.closing(Checkpoints(tmp_path)) as checkpoints:
            assert checkpoints.steps() == [9, 7]
        assert self.restored(tmp_path).steps == 9
        for path in (tmp_path / "checkpoints" / "9").rglob("*"):
            if path.is_file():
                path.write_bytes(path.read_bytes()[:10])
        with contextlib.closing(Checkpoints(tmp_path)) as checkpoints:
            assert checkpoints.restore(self.state, warnings.append, discard=False).steps == 7
        assert len(warnings) == 1
        assert "checkpoint 9 cannot be read" in warnings[0]

    def test_every_file_damaged(self, written: Path) -> None:
        self.assert_whole(self.restored(written))
        lost = 0
        files = sorted(path for path in (written / "checkpoints").rglob("*") if path.is_file())
        for number, (path, kind) in enumerate(itertools.product(files, ["overwritten", "truncated", "flipped_bits"])):
            content = path.read_bytes()
            path.write_bytes(getattr(damage, kind)(random.Random(number), content or b"x"))
            found = self.restored(written)
            path.write_bytes(content)
            lost += found is None
            if found is not None:
                self.assert_whole(found)
        assert lost >= 5
        self.assert_whole(self.restored(written))

    def test_changed_numbers_behind_sound_files(self, written: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        """What TensorStore does not notice, the checksums do."""
        monkeypatch.setattr("mjxball.train.checkpoint._checksums", lambda arrays: np.zeros(3, np.uint32))
        assert self.restored(written) is None

    def test_a_checkpoint_without_checksums_is_read(self, tmp_path: Path) -> None:
        """Such are those of runs before there were any."""
        with contextlib.closing(Checkpoints(tmp_path)) as checkpoints:
            checkpoints._manager.save(7, args=ocp.args.StandardSave(self.state._asdict()))
        self.assert_whole(self.restored(tmp_path))

    def test_deep_metadata(self, written: Path) -> None:
        for path in (written / "checkpoints").rglob("_*METADATA"):
            path.write_text("[" * 200_000)
        assert self.restored(written) is None


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    content=st.binary(max_size=2000), head=st.sampled_from([b"", b"PK\x03\x04", b"PK\x05\x06", b"\x93NUMPY\x01\x00"])
)
def test_any_bytes_are_refused(content: bytes, head: bytes, tmp_path: Path) -> None:
    path = tmp_path / "any.npz"
    path.write_bytes(head + content)
    with pytest.raises(PolicyFileError) as error:
        Policy.load(path)
    assert str(error.value).isprintable()


def test_shipped_policies_load() -> None:
    assert {"paper", "balance", "flight"} <= {Policy.load(path).name for path in shipped_policies()}
    assert {shipped_policy(name).parent.name for name in ("transport-large", "robust")} == {"archive"}


def test_a_shipped_policy_has_the_name_of_its_preset_and_then_what_differs_from_it() -> None:
    for path in shipped_policies():
        preset = Policy.load(path).metadata["preset"]
        assert path.stem == preset or path.stem.startswith(f"{preset}-"), path.stem
