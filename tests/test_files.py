"""Files of users are read within bounds; what is written is there whole or not at all."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from command_line import REPOSITORY, environment

from mjxball.config import Config, read_plant, with_plant
from mjxball.errors import InputError
from mjxball.evaluate.scenarios import read_waveform
from mjxball.files import MissingFileError, read_bytes, read_text, write_atomically
from mjxball.policy import load_file
from mjxball.train.run_directory import file_hash, read_config, read_json, read_rows
from mjxball.view.flight import flight_from, load_flight
from mjxfly.preflight import read_gains
from mjxfly.rig.log import read_log

READERS = {
    "policy": load_file,
    "policy to start from": file_hash,
    "plant": read_plant,
    "waveform": read_waveform,
    "sweep": lambda path: read_json(path, "sweep file"),
    "table": read_rows,
    "gains": read_gains,
    "flight": load_flight,
    "what is viewed": lambda path: flight_from(str(path.rename(path.with_suffix(".npz"))), {}, "newton-euler"),
    "arrays of a log": lambda path: read_log(path.rename(path.with_suffix(".npz"))),
}
HOLE = 2**32  # [B] beyond what any reader takes


def pretended(place: Path, what: str) -> Path:
    """Something that is no file for reading, under a name that anything may have."""
    path = place / "given.json"
    path.unlink(missing_ok=True)
    if what == "pipe":
        os.mkfifo(path)
    elif what == "device":
        path.symlink_to("/dev/zero")
    else:
        with path.open("wb") as stream:
            stream.truncate(HOLE)  # of no blocks
    return path


def test_what_is_no_file_or_too_large_is_refused_by_every_reader(tmp_path: Path) -> None:
    for name, reader in READERS.items():
        for what, word in (("pipe", "regular"), ("device", "regular"), ("hole", "larger")):
            with pytest.raises(InputError, match=word) as refused:
                reader(pretended(tmp_path, what))
            assert "\n" not in str(refused.value), name


def test_a_run_directory_with_a_device_for_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "config.json").symlink_to("/dev/zero")
    with pytest.raises(InputError, match="regular"):
        read_config(tmp_path)


def test_reading_tells_a_missing_file_from_others(tmp_path: Path) -> None:
    with pytest.raises(MissingFileError, match=r"sweep file .*absent does not exist"):
        read_bytes(tmp_path / "absent", "sweep file")
    with pytest.raises(InputError, match="directory"):
        read_bytes(tmp_path)
    with pytest.raises(InputError, match="impossible"):
        read_bytes("a\0b")
    (tmp_path / "latin").write_bytes(b"\xe9")
    with pytest.raises(InputError, match="UTF-8"):
        read_text(tmp_path / "latin")
    (tmp_path / "text").write_bytes("é\r\n".encode())
    assert read_text(tmp_path / "text") == "é\r\n"


def test_whoever_reads_sees_one_of_the_files_that_several_write(tmp_path: Path) -> None:
    """A writer that opened the file itself, or one temporary file for all, would show a mixture or a part."""
    path, size = tmp_path / "shared", 300_000
    contents = [bytes([65 + number]) * size for number in range(3)]
    write_atomically(path, contents[0])
    done, faults = threading.Event(), list[str]()

    def write(content: bytes) -> None:
        try:
            for _ in range(40):
                write_atomically(path, content)
        except OSError as error:
            faults.append(str(error))

    def read() -> None:
        while not done.is_set():
            if path.read_bytes() not in contents:
                faults.append("a mixture")

    reader, writers = threading.Thread(target=read), [threading.Thread(target=write, args=(one,)) for one in contents]
    for thread in (reader, *writers):
        thread.start()
    for thread in writers:
        thread.join()
    done.set()
    reader.join()
    assert faults == []
    assert [path.name for path in tmp_path.iterdir()] == ["shared"]


def test_contents_are_on_disk_before_the_name_and_the_name_thereafter(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a loss of power there is the old file or the new one: content, name, folder, in that order."""
    path, seen = tmp_path / "kept", list[tuple[str, bytes | None]]()
    path.write_bytes(b"old")
    sync, replace = os.fsync, Path.replace

    def note(handle: int) -> None:
        kind = "folder" if os.path.isdir(f"/proc/self/fd/{handle}") else "content"
        seen.append((kind, path.read_bytes()))
        sync(handle)

    def renamed(partial: Path, target: Path) -> Path:
        seen.append(("name", partial.read_bytes()))
        return replace(partial, target)

    monkeypatch.setattr(os, "fsync", note)
    monkeypatch.setattr(Path, "replace", renamed)
    write_atomically(path, "new")
    assert seen == [("content", b"old"), ("name", b"new"), ("folder", b"new")]


def test_a_full_disk_keeps_the_old_file_and_names_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "kept"
    path.write_bytes(b"old")

    def full(handle: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space") as failed:
        write_atomically(path, b"new")
    assert failed.value.filename == str(path)
    assert path.read_bytes() == b"old"
    assert [one.name for one in tmp_path.iterdir()] == ["kept"]


@pytest.mark.slow
def test_a_command_names_the_file_that_does_not_fit(tmp_path: Path) -> None:
    """The process may write a few kB to a file, as on a disk that has no more."""
    exported = ["-m", "mjxball.export", REPOSITORY / "policies" / "balance.npz", tmp_path / "out.h"]
    done = subprocess.run(
        ["bash", "-c", 'ulimit -f 4; exec "$@"', "_", sys.executable, *exported],
        cwd=REPOSITORY,
        env=environment(),
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2, done.stderr
    assert done.stderr.count("\n") == 1
    assert str(tmp_path / "out.h") in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_plant_that_is_absent_is_answered_with_those_by_name(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="by name there are"):
        with_plant(Config(), tmp_path / "absent.toml")
