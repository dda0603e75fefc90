"""Textures of materials: PNG and JPEG pictures up to a size, copied without a change."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path, PurePosixPath

from shapespace.files.limits import clipped, read_plain

#: Most bytes of one picture, and of all pictures of a mesh. Every answer in some formats holds all of them.
LARGEST, ALL = 16 * 2**20, 32 * 2**20
#: The first bytes of PNG and JPEG files.
BEGINNINGS = (b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff")


def beside(folder: Path, name: str) -> Path:
    """Return the path of a file that another file names. It is always in ``folder`` or below.

    If the name leads to another place, only its last part counts, as for absolute names from other machines. So no
    file from elsewhere gets into a bundle.
    """
    inside = PurePosixPath(name.replace("\\", "/"))
    away = inside.is_absolute() or ".." in inside.parts or not (folder / inside).is_file()
    return folder / (inside.name if away else inside)


class Textures:
    """The pictures of a mesh. ``faults`` gets a sentence for each one that can't be kept.

    Attributes:
        files: contents of the pictures by name.
    """

    def __init__(self, faults: list[str]) -> None:
        self.files: dict[str, bytes] = {}
        self._faults, self._known = faults, dict[object, str | None]()

    def add_file(self, folder: Path, name: str, material: str) -> str | None:
        """Add a file; return its name in `files`, or None if it can't be kept."""
        path = beside(folder, name)

        def content() -> bytes:
            if path.stat().st_size > LARGEST:
                raise ValueError(_too_large(path.stat().st_size))
            return read_plain(path)

        return self.add(path.resolve(), path.name, content, material)

    def add(self, key: object, name: str, content: Callable[[], bytes], material: str) -> str | None:
        """Add a picture, once for each key; return its name in `files`, or None if it can't be kept."""
        if key not in self._known:
            try:
                self._known[key] = self._kept(name, content())
            except OSError as error:
                self._leave_out(key, name, material, error.strerror or "it can't be read")
            except ValueError as error:
                self._leave_out(key, name, material, str(error))
        return self._known[key]

    def _leave_out(self, key: object, name: str, material: str, reason: str) -> None:
        self._known[key] = None
        self._faults.append(f"the texture {clipped(name)} of material {material} is left out: {reason}")

    def _kept(self, name: str, data: bytes) -> str:
        if not data.startswith(BEGINNINGS):
            raise ValueError("it is neither PNG nor JPEG; save it as one of them")
        if len(data) > LARGEST or sum(map(len, self.files.values())) + len(data) > ALL:
            raise ValueError(_too_large(len(data)))
        # A valid file name in a bundle, with the extension of its format.
        stem = re.sub(r"[^A-Za-z0-9_-]+", "-", Path(name).stem).strip("-_")[:60] or "texture"
        ending = "png" if data.startswith(BEGINNINGS[0]) else "jpg"
        taken = {known.casefold() for known in self.files}
        numbered = (f"{stem}-{k}.{ending}" for k in range(2, len(taken) + 3))
        kept = next(new for new in (f"{stem}.{ending}", *numbered) if new.casefold() not in taken)
        self.files[kept] = data
        return kept


def _too_large(size: int) -> str:
    return (
        f"it has {size / 2**20:.1f} MiB, but at most {LARGEST >> 20} are allowed, and {ALL >> 20} for all textures; "
        "make it smaller"
    )
