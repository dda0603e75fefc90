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
#: Bytes in which the head of an array ends, of which NumPy takes ten thousand at most.
_HEAD = 12_000
#: Bytes that deflate can make of one, and those of NumPy's longest number.
_DEFLATION, _LONGEST_NUMBER = 1032, 32


class _File:
    """Bytes as an open file, without a copy; refuses large reads, which zipfile makes for long directories only."""

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
    data: memoryview, names: Collection[str] = ("vertices", "faces"), limits: Limits = UNLIMITED
) -> dict[str, NDArray]:
    """Arrays of an NPZ file that holds at least ``vertices`` and ``faces``.

    Args:
        data: the file.
        names: the arrays to read, as far as there are any.
        limits: of the vertices and faces.

    Raises:
        MeshError: no NPZ file, too large, pickled objects (which could run code) anywhere in it, or without vertices or
            faces; with the reason.
    """
    try:
        with zipfile.ZipFile(_File(data)) as archive:
            entries = {e.filename.removesuffix(".npy"): e for e in archive.infolist() if e.filename.endswith(".npy")}
            if len(entries) > _MOST_ARRAYS:
                raise MeshError(f"holds {len(entries)} arrays, where {_MOST_ARRAYS} are the most")
            missing = {"vertices", "faces"} - entries.keys()
            if missing:
                there = clipped(", ".join(sorted(entries)))
                raise MeshError(f"holds no array '{min(missing)}', only {there or 'nothing'}")
            arrays = {}
            for name, entry in entries.items():
                with archive.open(entry) as member:
                    array = _Array(member, entry)
                    if name in ("vertices", "faces"):
                        array.check(name, limits)
                    if name in names:
                        arrays[name] = array.read(_DEFLATION * len(data))
    except MeshError:
        raise
    except Exception as error:  # NumPy, zipfile and zlib each have their own
        raise MeshError("not a readable npz file: damaged, or another kind of file") from error
    return arrays


class _Array:
    """An array in an archive, of which only the head has been read."""

    def __init__(self, member: IO[bytes], entry: zipfile.ZipInfo) -> None:
        # The decompressors of other methods don't limit the memory that they take.
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise zipfile.BadZipFile("compressed in another way")
        self._member, self._size = member, entry.file_size
        start = io.BytesIO(member.read(_HEAD))
        read_head = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        self._shape, self._columns_first, self._dtype = read_head[np.lib.format.read_magic(start)](start)
        if self._dtype.hasobject:
            raise MeshError("not a readable npz file: it holds pickled objects, save plain arrays instead")
        self._start = start.read()

    def check(self, name: str, limits: Limits) -> None:
        """Raise MeshError for too many vertices or faces, or for entries so long that they can only be text."""
        if self._dtype.itemsize > _LONGEST_NUMBER:
            raise MeshError(f"{name} must be an array of numbers, not {clipped(self._dtype)}")
        triples = -(-math.prod(self._shape) // 3)
        limits.check(triples if name == "vertices" else 0, triples if name == "faces" else 0)

    def read(self, most: int) -> NDArray:
        """The array; raises ValueError where it has more bytes than its entry says, or than can be there."""
        length = math.prod(self._shape) * self._dtype.itemsize
        if not 0 <= length <= min(self._size, most):
            raise ValueError("it says more than there is")
        content = np.empty(length, np.uint8)
        content[: len(self._start)] = np.frombuffer(self._start[:length], np.uint8)
        for start in range(len(self._start), length, PIECE):
            piece = content[start : start + PIECE]
            piece[:] = np.frombuffer(self._member.read(len(piece)), np.uint8)
        self._member.read(1)  # at the end of an entry its checksum is compared
        return content.view(self._dtype).reshape(self._shape, order="F" if self._columns_first else "C")
