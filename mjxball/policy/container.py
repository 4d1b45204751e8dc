"""Safe reading of `.npz` files (policies, recorded flights): zip archives of NPY arrays from untrusted sources.

Nothing is unpickled, and every size that the file states is compared with the data before memory is allocated.
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
DIRECTORY_ENTRY = b"PK\x01\x02"  # signature of every entry of a zip's directory
PLAIN = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)  # others may need gigabytes to unpack
READERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


class PolicyFileError(InputError):
    """A policy file cannot be used; the message names the file and the reason."""


class _DamagedError(Exception):
    """An entry of the archive is damaged; the message is a phrase."""


def read_arrays(name: str, kind: str = "policy file", limit: int = MAX_BYTES) -> dict[str, np.ndarray]:
    """The arrays of the `.npz` file `name` by their names, at most `limit` bytes.

    Raises PolicyFileError, with one sentence, if it is damaged or too large; `kind` describes the file in the message.
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
            duplicate = next((key for key in names if names.count(key) > 1), None)
            if duplicate is not None:
                raise PolicyFileError(f"{name} holds the array {duplicate!r} more than once")
            return {key: _array(_unpack(archive, entry)) for key, entry in zip(names, entries, strict=True)}
    except PolicyFileError:
        raise
    except _DamagedError as error:
        raise PolicyFileError(f"{kind} {name} cannot be read: {error}") from None
    except Exception:  # zipfile, zlib and NumPy raise many kinds for damaged bytes
        raise PolicyFileError(f"{kind} {name} cannot be read: it is damaged or not an .npz") from None


def _unpack(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> bytes:
    if entry.compress_type not in PLAIN:
        raise _DamagedError("it is packed with another method than NumPy's")
    with archive.open(entry) as stream:
        # A limit on the read protects against zip bombs: `ZipFile.read` unpacks everything before it checks the size.
        content = stream.read(entry.file_size)
    if len(content) != entry.file_size:
        raise _DamagedError("it is cut short")
    return content


def _array(content: bytes) -> np.ndarray:
    """The array of an NPY file. Raises _DamagedError unless its header describes exactly the bytes that follow."""
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
