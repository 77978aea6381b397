"""Arrays in .npz files from untrusted sources: sizes are checked first, and nothing is unpickled."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

_MOST_ARRAYS = 100_000
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


class ArchiveError(ValueError):
    """The file isn't an archive of plain arrays, or is too large; the message says why."""


def read_arrays(path: Path, most_bytes: int) -> dict[str, np.ndarray]:
    """All arrays of an .npz file.

    Args:
        path: the file.
        most_bytes: limit on the total size of the arrays in bytes, as declared by the file.

    Raises:
        ArchiveError: if the file can't be read for any reason.
    """
    try:
        if not path.is_file():
            raise ArchiveError("it isn't a regular file")
        if not path.stat().st_size:
            raise ArchiveError("it is empty")
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            declared, names = sum(member.file_size for member in members), {member.filename for member in members}
            if declared > most_bytes:
                raise ArchiveError(f"it would unpack to {declared:,} bytes; the limit is {most_bytes:,}")
            if len(members) > _MOST_ARRAYS or len(names) < len(members):
                raise ArchiveError(f"it has {len(members)} members with {len(names)} names")
            return {
                member.filename.removesuffix(".npy"): _array(member.filename, archive.read(member))
                for member in members
            }
    except ArchiveError:
        raise
    except Exception as error:  # zipfile, zlib and NumPy raise various exceptions for damaged files
        raise ArchiveError(str(error) or type(error).__name__) from error


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray], *, compress: bool) -> None:
    """Write an .npz file atomically: a reader never finds a partial file, even if this process is killed.

    Args:
        path: the file; its folder is created.
        arrays: arrays by name.
        compress: whether to compress the file.
    """
    save: Any = np.savez_compressed if compress else np.savez
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.part")
    with partial.open("wb") as stream:
        save(stream, **arrays)
    partial.replace(path)


def _array(name: str, content: bytes) -> np.ndarray:
    """An array from the content of a .npy file, whose length must match its header."""
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    if version not in _HEADERS:
        raise ArchiveError(f"{name}: unsupported version {version} of .npy files")
    shape, _, dtype = _HEADERS[version](stream)
    if dtype.hasobject or min(shape, default=0) < 0:
        raise ArchiveError(f"{name}: unsupported array of {dtype} and shape {shape}")
    if math.prod(shape) * dtype.itemsize != len(content) - stream.tell():
        raise ArchiveError(f"{name}: its length doesn't match its header (shape {shape} of {dtype})")
    stream.seek(0)
    array: np.ndarray = np.lib.format.read_array(stream, allow_pickle=False)
    return array
