"""The container of a policy file or a recorded flight: a zip of NPY arrays, read within bounds whatever it claims.

Nothing is unpickled, and no size that the file states is believed before it was compared with what is there.
"""

from __future__ import annotations

import io
import math
import zipfile

import numpy as np

from mjxball.errors import InputError
from mjxball.files import read_bytes

MAX_BYTES = 64 * 2**20  # of the file, and of everything in it unpacked
MAX_ENTRIES = 68
DIRECTORY_ENTRY = b"PK\x01\x02"  # with which every entry of a zip's directory begins
PLAIN = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # others may ask for gigabytes to unpack
READERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


class PolicyFileError(InputError):
    """A policy file that cannot be used; the message names the file and what is wrong."""


class _DamagedError(Exception):
    """What is wrong with an entry, in a few words."""


def read_arrays(name: str, kind: str = "policy file", limit: int = MAX_BYTES) -> dict[str, np.ndarray]:
    """The arrays of the `.npz` file `name` by their names, `limit` bytes at most.

    Raises PolicyFileError with one sentence on anything unsound; `kind` says in it what the file should be.
    """
    try:
        content = read_bytes(name, kind, limit)
    except InputError as error:
        raise PolicyFileError(str(error)) from None
    if str(name).endswith(".onnx"):
        raise PolicyFileError(f"{name} is no {kind}; `eval.py bench` alone flies an ONNX model")
    if content.count(DIRECTORY_ENTRY) > MAX_ENTRIES:
        raise PolicyFileError(f"{name} is not a {kind}: it has more than {MAX_ENTRIES} entries")
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            entries = archive.infolist()
            if sum(entry.file_size for entry in entries) > limit:
                raise PolicyFileError(f"{name} is not a {kind}: it unpacks to more than {limit >> 20} MiB")
            names = [entry.filename.removesuffix(".npy") for entry in entries]
            twice = next((key for key in names if names.count(key) > 1), None)
            if twice is not None:
                raise PolicyFileError(f"{name} holds the array {twice!r} more than once")
            return {key: _array(_unpack(archive, entry)) for key, entry in zip(names, entries, strict=True)}
    except PolicyFileError:
        raise
    except _DamagedError as error:
        raise PolicyFileError(f"{kind} {name} cannot be read: {error}") from None
    except Exception:  # zipfile, zlib and NumPy raise a dozen kinds for damaged bytes
        raise PolicyFileError(f"{kind} {name} cannot be read: it is damaged or not an .npz") from None


def _unpack(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> bytes:
    if entry.compress_type not in PLAIN:
        raise _DamagedError("it is packed with another method than NumPy's")
    with archive.open(entry) as stream:
        # To read with a limit is what keeps a bomb from going off: `ZipFile.read` unpacks before it counts.
        content = stream.read(entry.file_size)
    if len(content) != entry.file_size:
        raise _DamagedError("it is cut short")
    return content


def _array(content: bytes) -> np.ndarray:
    """The array of an NPY file, if its header says exactly as much as follows it."""
    stream = io.BytesIO(content)
    if not content.startswith(np.lib.format.MAGIC_PREFIX):
        raise _DamagedError("an entry is not an array")
    version = np.lib.format.read_magic(stream)
    if version not in READERS:
        raise _DamagedError(f"an array has NPY version {version[0]}.{version[1]}")
    shape, fortran_order, dtype = READERS[version](stream)
    if dtype.hasobject:
        raise _DamagedError("it holds a pickle")
    if min(shape, default=0) < 0 or math.prod(shape) * dtype.itemsize != len(content) - stream.tell():
        raise _DamagedError("an array's header does not fit its data")
    if not dtype.itemsize:
        raise _DamagedError("an array's elements have no size")
    flat = np.frombuffer(content, dtype, offset=stream.tell()).copy()
    return flat.reshape(shape[::-1]).T if fortran_order else flat.reshape(shape)
