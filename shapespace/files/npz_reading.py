"""Reader of NPZ: only the arrays that are asked for, and never more memory than the file can fill."""

from __future__ import annotations

import io
import math
import os
import zipfile
from collections.abc import Collection
from typing import IO

import numpy as np
from numpy.typing import NDArray

from shapespace.files.limits import PIECE, UNLIMITED, Limits, clipped
from shapespace.mesh.triangle_mesh import MeshError

_MOST_ARRAYS = 1000
#: How many bytes are read for an array's header; NumPy accepts headers of at most ten thousand bytes.
_HEAD = 12_000
#: Largest expansion factor of deflate, and bytes of NumPy's largest number.
_DEFLATION, _LONGEST_NUMBER = 1032, 32
_READ_HEAD = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


class _MemoryFile:
    """Bytes as an open file, not copied. A request for a large piece is refused: it follows a forged directory."""

    def __init__(self, data: memoryview) -> None:
        self._data, self._place = data, 0

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._place

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        place = offset + {os.SEEK_SET: 0, os.SEEK_CUR: self._place, os.SEEK_END: len(self._data)}[whence]
        if place < 0:
            raise OSError("before the beginning")
        self._place = place
        return place

    def read(self, size: int | None = -1) -> bytes:
        left = max(0, len(self._data) - self._place)
        size = left if size is None or size < 0 else min(size, left)
        if size > PIECE:
            raise zipfile.BadZipFile("its directory is too long")
        piece = bytes(self._data[self._place : self._place + size])
        self._place += size
        return piece


def load_npz(
    data: memoryview,
    names: Collection[str] = ("vertices", "faces"),
    limits: Limits = UNLIMITED,
    needed: Collection[str] = ("vertices", "faces"),
) -> dict[str, NDArray]:
    """Arrays of an NPZ file that holds at least those that are needed.

    Args:
        data: the file.
        names: the arrays to read, as far as there are any.
        limits: of the vertices and faces.
        needed: without which the file is refused.

    Raises:
        MeshError: no NPZ file, too large, pickled objects (which could run code) anywhere in it, or without what is
            needed; with the reason.
    """
    try:
        with zipfile.ZipFile(_MemoryFile(data)) as archive:
            entries = {e.filename.removesuffix(".npy"): e for e in archive.infolist() if e.filename.endswith(".npy")}
            if len(entries) > _MOST_ARRAYS:
                raise MeshError(f"holds {len(entries)} arrays, where {_MOST_ARRAYS} are the most")
            missing = set(needed) - entries.keys()
            if missing:
                there = clipped(", ".join(sorted(entries)))
                raise MeshError(f"holds no array '{min(missing)}', only {there or 'nothing'}")
            arrays = {}
            for name, entry in entries.items():
                with archive.open(entry) as member:
                    array = PackedArray(member, entry)
                    if array.dtype.hasobject:
                        raise MeshError("not a readable npz file: it holds pickled objects, save plain arrays instead")
                    if name in ("vertices", "faces"):
                        _check(name, array, limits)
                    if name in names:
                        arrays[name] = array.read(_DEFLATION * len(data))
    except MeshError:
        raise
    except Exception as error:  # NumPy, zipfile and zlib each have their own
        raise MeshError("not a readable npz file: damaged, or another kind of file") from error
    return arrays


class PackedArray:
    """An array in an opened archive, of which only the head has been read.

    Args:
        member: the opened entry.
        entry: what the archive's directory says of it.

    Attributes:
        shape, dtype: as the head says.

    Raises:
        ValueError: compressed in a way that NumPy does not, or without a head that can be read.
    """

    def __init__(self, member: IO[bytes], entry: zipfile.ZipInfo) -> None:
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):  # others take what memory they like
            raise ValueError(f"{entry.filename} is packed in a way that NumPy doesn't")
        self._member, self._entry = member, entry
        start = io.BytesIO(member.read(_HEAD))
        version = np.lib.format.read_magic(start)
        if version not in _READ_HEAD:
            raise ValueError(f"{entry.filename} is of version {version}")
        self.shape, self._columns_first, self.dtype = _READ_HEAD[version](start)
        self._start = start.read()

    def read(self, most: int) -> NDArray:
        """The array, of at most so many bytes.

        Raises:
            ValueError: pickled objects, or more bytes than the archive's directory says, or than ``most``.
        """
        length = math.prod(self.shape) * self.dtype.itemsize
        if self.dtype.hasobject or not 0 <= length <= min(self._entry.file_size, most):
            raise ValueError(f"{self._entry.filename} can't be {self.dtype} {self.shape}")
        content = np.empty(length, np.uint8)
        content[: len(self._start)] = np.frombuffer(self._start[:length], np.uint8)
        for start in range(len(self._start), length, PIECE):
            piece = content[start : start + PIECE]
            piece[:] = np.frombuffer(self._member.read(len(piece)), np.uint8)
        self._member.read(1)  # at the end of an entry its checksum is compared
        return content.view(self.dtype).reshape(self.shape, order="F" if self._columns_first else "C")


def _check(name: str, array: PackedArray, limits: Limits) -> None:
    """Refuse vertices or faces that are too many, or whose entries are as long as only text can be."""
    if array.dtype.itemsize > _LONGEST_NUMBER:
        raise MeshError(f"{name} must be an array of numbers, not {clipped(array.dtype)}")
    triples = -(-math.prod(array.shape) // 3)
    limits.check(triples if name == "vertices" else 0, triples if name == "faces" else 0)
