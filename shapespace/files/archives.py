"""ZIP archives written piece by piece, so that a large archive is never held in memory."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Iterable, Iterator

Buffer = bytes | bytearray | memoryview
#: Compression level of zlib. Higher levels take longer than computing the shapes, and save a tenth of the size.
LEVEL = 1


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
