"""ZIP and NPZ archives written piece by piece, so that a large archive is never held whole."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterable, Iterator

import numpy as np

Buffer = bytes | bytearray | memoryview
#: Compression level of zlib. Higher levels take longer than computing the shapes, and save a tenth of the size.
LEVEL = 1
#: About how many bytes of an array are written at once: writing row by row takes longer than computing a shape.
PIECE = 2**16


class _Sink(io.RawIOBase):
    """A file that keeps what is written until it is taken; not seekable."""

    def __init__(self) -> None:
        self._pieces: list[bytes] = []

    def writable(self) -> bool:
        return True

    def write(self, data: Buffer) -> int:  # type: ignore[override]
        self._pieces.append(bytes(data))
        return len(data)

    def take(self) -> bytes:
        taken = b"".join(self._pieces)
        self._pieces.clear()
        return taken


def zip_pieces(members: Iterable[tuple[str, Iterable[Buffer]]]) -> Iterator[bytes]:
    """Yield an archive of members, each a name and its content in parts, a piece at a time.

    Equal members give equal bytes, whatever the date. Sizes stand behind the members and in the directory, not in front
    of them, so readers have to go by the directory.
    """
    sink = _Sink()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_DEFLATED, compresslevel=LEVEL) as archive:
        for name, content in members:
            with archive.open(name, "w") as member:
                for part in content:
                    member.write(part)
                    if piece := sink.take():
                        yield piece
    yield sink.take()


def npz_pieces(**arrays: np.ndarray) -> Iterator[bytes]:
    """Arrays as a compressed NPZ file, some rows of each at a time."""
    return zip_pieces((f"{name}.npy", _npy(array)) for name, array in arrays.items())


def _npy(array: np.ndarray) -> Iterator[Buffer]:
    array, head = np.asarray(array, order="C"), io.BytesIO()
    np.lib.format.write_array_header_1_0(head, np.lib.format.header_data_from_array_1_0(array))
    yield head.getvalue()
    rows = np.atleast_1d(array)
    step = max(1, PIECE * len(rows) // max(rows.nbytes, 1))
    for start in range(0, len(rows), step):
        yield rows[start : start + step].tobytes()
