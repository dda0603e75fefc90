"""Limits on the size of a mesh, and text from files: its encoding, and how messages quote it."""

from __future__ import annotations

import sys
from dataclasses import dataclass

from shapespace.mesh.triangle_mesh import MeshError


@dataclass(frozen=True)
class Limits:
    """Largest size of a mesh; by default there is no limit."""

    vertices: int = sys.maxsize  # largest number of vertices
    faces: int = sys.maxsize  # largest number of triangles

    def check(self, vertices: int, faces: int) -> None:
        """Raise MeshError if a mesh has more vertices or faces."""
        if vertices > self.vertices:
            raise MeshError(f"it has more than {self.vertices} vertices")
        if faces > self.faces:
            raise MeshError(f"it has more than {self.faces} faces")


#: For files of the user's own.
UNLIMITED = Limits()


def as_utf8(data: memoryview) -> memoryview:
    """Return a text in UTF-8 without its byte-order mark; raises ValueError if it is damaged UTF-16."""
    if bytes(data[:3]) == b"\xef\xbb\xbf":
        return data[3:]
    if bytes(data[:2]) in (b"\xff\xfe", b"\xfe\xff"):
        return memoryview(str(data, "utf-16").encode())
    return data


def label(text: object) -> str | None:
    """Return a name from a file on one line, shortened; None if it has no printable character."""
    return clipped("".join(c if c.isprintable() else " " for c in str(text)[:1000])) or None


def clipped(text: object, most: int = 100) -> str:
    """Return text from a file on one line, shortened to ``most`` characters."""
    line = " ".join(str(text)[:1000].split())
    return line if len(line) <= most else f"{line[:most]}…"
