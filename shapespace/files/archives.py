"""ZIP archives: written piece by piece, so that a large archive is never held in memory, and read from memory."""

from __future__ import annotations

import io
import os
import re
import zipfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import IO, cast

Buffer = bytes | bytearray | memoryview
#: Place of a file: in a folder, or in an open archive.
Place = Path | zipfile.Path
#: What an archive can be read from.
Source = Path | bytes | memoryview
#: Compression level of zlib. Higher levels take longer than computing the shapes, and save a tenth of the size.
LEVEL = 1


def natural_order(name: str) -> list[tuple[int, str]]:
    """Key that sorts names of files by the words and the numbers in them: pose2 before pose10."""
    return [(int(piece), "") if piece.isdecimal() else (-1, piece) for piece in re.split(r"(\d+)", name.casefold())]


class _Sink(io.RawIOBase):
    """Write-only file that keeps its content until `take` is called; not seekable."""

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
    """Yield a ZIP archive of files, each a name and the parts of its content, piece by piece.

    Equal members give equal bytes, whatever the date. Sizes follow the members and are in the directory. They do not
    precede the members, so a reader has to use the directory.
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


def seekable(source: Source) -> Path | IO[bytes]:
    """Return the path of an archive, or its content as an open file."""
    if isinstance(source, memoryview):
        return cast("IO[bytes]", _MemoryFile(source))
    return io.BytesIO(source) if isinstance(source, bytes) else source


class _MemoryFile:
    """A buffer as an open file. `io.BytesIO` would copy a buffer that is not ``bytes``."""

    def __init__(self, data: memoryview) -> None:
        self._data, self._position = data, 0

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._position

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        start = {os.SEEK_SET: 0, os.SEEK_CUR: self._position, os.SEEK_END: len(self._data)}[whence]
        if start + offset < 0:
            raise OSError("before the beginning")
        self._position = start + offset
        return self._position

    def read(self, size: int | None = -1) -> bytes:
        stop = len(self._data) if size is None or size < 0 else self._position + size
        piece = bytes(self._data[self._position : stop])
        self._position += len(piece)
        return piece
