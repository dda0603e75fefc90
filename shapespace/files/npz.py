"""NPZ files: the one reader, and writers for files at once or piece by piece. Pickled objects are never loaded."""

from __future__ import annotations

import io
import math
import zipfile
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import IO

import numpy as np
from numpy.typing import NDArray

from shapespace.files.archives import Buffer, Source, seekable, zip_pieces
from shapespace.files.limits import UNLIMITED, Limits, clipped
from shapespace.mesh.triangle_mesh import MeshError

#: Bytes of an array that `npz_pieces` yields at once. Writing single rows takes longer than computing a shape.
PIECE = 2**16
#: Bytes of the longest number of NumPy, a complex long double. Longer entries are text.
_LONGEST_NUMBER = 32
_READ_HEADER = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


@dataclass(frozen=True)
class ArrayHeader:
    """Shape and type of an array, as its header in the file states them."""

    shape: tuple[int, ...]
    dtype: np.dtype

    @property
    def nbytes(self) -> int:
        """Size of the array in bytes."""
        return math.prod(self.shape) * self.dtype.itemsize


def npz_headers(source: Source) -> dict[str, ArrayHeader]:
    """Return the headers of all arrays by name, without unpacking the arrays.

    Raises:
        OSError: the file can't be opened.
        Exception: the file is damaged; `zipfile`, `zlib` and NumPy raise exceptions of many classes.
    """
    with zipfile.ZipFile(seekable(source)) as archive:
        found = {}
        for name, entry in _entries(archive).items():
            with archive.open(entry) as member:
                found[name] = _header(member, entry)
        return found


def read_npz(source: Source, names: Collection[str] | None = None) -> dict[str, NDArray]:
    """Return arrays by name.

    Args:
        source: path or content of the file.
        names: arrays to read, as far as the file has them; by default all.

    Raises:
        OSError: the file can't be opened.
        ValueError: an array holds pickled objects, or more bytes than the file.
        Exception: the file is damaged, as for `npz_headers`.
    """
    with zipfile.ZipFile(seekable(source)) as archive:
        arrays = {}
        for name, entry in _entries(archive).items():
            if names is None or name in names:
                with archive.open(entry) as member:
                    _header(member, entry)
                    member.seek(0)
                    arrays[name] = np.lib.format.read_array(member, allow_pickle=False)
                    member.read(1)  # `zipfile` compares the checksum at the end of an entry
        return arrays


def read_mesh_npz(
    data: memoryview,
    names: Collection[str] = ("vertices", "faces"),
    limits: Limits = UNLIMITED,
    needed: Collection[str] = ("vertices", "faces"),
) -> dict[str, NDArray]:
    """Return arrays of an NPZ file that holds meshes.

    Args:
        data: content of the file.
        names: arrays to read, as far as the file has them.
        limits: largest numbers of vertices and faces, compared before an array is unpacked.
        needed: arrays that the file must have.

    Raises:
        MeshError: the file is no NPZ file, is too large, lacks an array, or holds pickled objects in any array.
    """
    try:
        headers = npz_headers(data)
        if missing := set(needed) - headers.keys():
            there = clipped(", ".join(sorted(headers)))
            raise MeshError(f"holds no array '{min(missing)}', only {there or 'nothing'}")
        if any(header.dtype.hasobject for header in headers.values()):
            raise MeshError("not a readable npz file: it holds pickled objects, save plain arrays instead")
        for name, header in headers.items():
            if name in ("vertices", "faces"):
                if header.dtype.itemsize > _LONGEST_NUMBER:
                    raise MeshError(f"{name} must be an array of numbers, not {clipped(header.dtype)}")
                triples = -(-math.prod(header.shape) // 3)
                limits.check(triples if name == "vertices" else 0, triples if name == "faces" else 0)
        return read_npz(data, names)
    except (MeshError, MemoryError):
        raise
    except Exception as error:
        raise MeshError("not a readable npz file: damaged, or another kind of file") from error


def npz_bytes(arrays: Mapping[str, NDArray], *, compressed: bool = True) -> bytes:
    """Return arrays as an NPZ file; equal arrays give equal bytes."""
    buffer = io.BytesIO()
    write = np.savez_compressed if compressed else np.savez
    write(buffer, **arrays)  # type: ignore[arg-type]
    return buffer.getvalue()


def npz_pieces(**arrays: NDArray) -> Iterator[bytes]:
    """Yield a compressed NPZ file in pieces, so that a large file is never held in memory."""
    return zip_pieces((f"{name}.npy", _npy_pieces(array)) for name, array in arrays.items())


def _npy_pieces(array: NDArray) -> Iterator[Buffer]:
    array, head = np.asarray(array, order="C"), io.BytesIO()
    np.lib.format.write_array_header_1_0(head, np.lib.format.header_data_from_array_1_0(array))
    yield head.getvalue()
    rows = np.atleast_1d(array)
    step = max(1, PIECE * len(rows) // max(rows.nbytes, 1))
    for start in range(0, len(rows), step):
        yield rows[start : start + step].tobytes()


def _entries(archive: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    return {e.filename.removesuffix(".npy"): e for e in archive.infolist() if e.filename.endswith(".npy")}


def _header(member: IO[bytes], entry: zipfile.ZipInfo) -> ArrayHeader:
    """Read the header of an array; raises ValueError for an array that NumPy can't have written."""
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{entry.filename} is compressed in a way that NumPy doesn't use")
    version = np.lib.format.read_magic(member)
    if version not in _READ_HEADER:
        raise ValueError(f"{entry.filename} is of version {version}")
    shape, _, dtype = _READ_HEADER[version](member)
    header = ArrayHeader(shape, dtype)
    if not dtype.hasobject and not 0 <= header.nbytes <= entry.file_size:
        raise ValueError(f"{entry.filename} can't be {dtype} {shape}")
    return header
