"""Arrays in NumPy's files: read only where a file holds what its headers claim, and nothing that runs."""

from __future__ import annotations

import io
import math
import struct
import sys
import tokenize
import warnings
import zipfile
import zlib
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import FileError, FormatError

__all__ = ["read_arrays"]

# Packed arrays may grow to so many bytes, or to so many times the size of their file if that is more.
_MOST_BYTES, _MOST_TIMES = 1 << 28, 20
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
# What zipfile, zlib and NumPy raise of files that are damaged.
_BROKEN = (
    zipfile.BadZipFile, zlib.error, struct.error, tokenize.TokenError, EOFError, NotImplementedError, RuntimeError,
    ValueError, KeyError, TypeError, SyntaxError, IndexError, OverflowError, MemoryError, RecursionError,
)  # fmt: skip


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Arrays of an .npz file by name; the one of an .npy file has the empty name.

    Raises
    ------
    FileError
        When it cannot be read.
    FormatError
        When it is damaged, claims more than it holds, or unpacks to more than 256 MB and twenty times its size; when an
        array is of objects or of records.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            size = path.stat().st_size
            if file.read(2) != b"PK":
                file.seek(0)
                return {"": _read(file, size)}
            with zipfile.ZipFile(file) as archive:
                members = archive.infolist()
                if sum(each.file_size for each in members) > max(_MOST_BYTES, _MOST_TIMES * size):
                    raise FormatError("it would unpack to many times its size")
                return {
                    each.filename.removesuffix(".npy"): _read(io.BytesIO(archive.read(each)), each.file_size)
                    for each in members
                }
    except OSError as error:
        raise FileError(f"{path} cannot be read: {error.strerror or error}") from error
    except _BROKEN as error:
        raise FormatError(f"{path} is garbled: {error}") from error


def _read(file: IO[bytes], size: int) -> NDArray[Any]:
    """The array of a file of so many bytes."""
    header = _HEADERS.get(np.lib.format.read_magic(file))
    if header is None:
        raise ValueError("its version of the format is unknown")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what Python says of a header that is no Python
        shape, by_columns, dtype = header(file)
    if dtype.kind not in "biufcU":
        raise ValueError(f"its type is {dtype}, expected numbers or texts")
    count = math.prod(shape)
    if min(shape, default=0) < 0 or max(shape, default=0) > sys.maxsize or count * dtype.itemsize > size - file.tell():
        raise ValueError(f"an array {shape} of {dtype} is cut short")
    data = file.read(count * dtype.itemsize)
    array = np.frombuffer(data, dtype, count) if dtype.itemsize else np.zeros(count, dtype)
    return array.reshape(shape, order="F" if by_columns else "C")
