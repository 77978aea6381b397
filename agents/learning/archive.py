"""Arrays in .npz files that may come from anybody: sizes are checked first, and nothing is unpickled."""

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
    """A file that isn't an archive of plain arrays, or is larger than it may be; the message says why."""


def read_arrays(path: Path, most_bytes: int) -> dict[str, np.ndarray]:
    """All arrays of an .npz file.

    Args:
        path: the file.
        most_bytes: the size that its arrays may have together, as the file declares it.

    Raises:
        ArchiveError: for whatever is wrong with the file.
    """
    try:
        if not path.is_file():
            raise ArchiveError("it isn't a regular file")
        if not path.stat().st_size:
            raise ArchiveError("it is empty")
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            declared, names = sum(one.file_size for one in members), {one.filename for one in members}
            if declared > most_bytes:
                raise ArchiveError(f"unpacked it would have {declared:,} bytes, and at most {most_bytes:,} are read")
            if len(members) > _MOST_ARRAYS or len(names) < len(members):
                raise ArchiveError(f"it has {len(members)} members with {len(names)} names")
            return {one.filename.removesuffix(".npy"): _array(one.filename, archive.read(one)) for one in members}
    except ArchiveError:
        raise
    except Exception as error:  # zipfile, zlib and NumPy raise all kinds for damaged files
        raise ArchiveError(str(error) or type(error).__name__) from error


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray], *, compress: bool) -> None:
    """Write an .npz file at once, so that a reader, or a kill, never finds half of it.

    Args:
        path: the file; its folder is made.
        arrays: by name.
        compress: whether to compress it.
    """
    save: Any = np.savez_compressed if compress else np.savez
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.part")
    with partial.open("wb") as stream:
        save(stream, **arrays)
    partial.replace(path)


def _array(name: str, content: bytes) -> np.ndarray:
    """An array from the bytes of a .npy file, which have to be as many as its header says."""
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)
    if version not in _HEADERS:
        raise ArchiveError(f"{name}: version {version} of .npy files isn't read")
    shape, _, dtype = _HEADERS[version](stream)
    if dtype.hasobject or min(shape, default=0) < 0:
        raise ArchiveError(f"{name}: arrays of {dtype} and shape {shape} aren't read")
    if math.prod(shape) * dtype.itemsize != len(content) - stream.tell():
        raise ArchiveError(f"{name}: its header says shape {shape} of {dtype}, and its length is another")
    stream.seek(0)
    array: np.ndarray = np.lib.format.read_array(stream, allow_pickle=False)
    return array
