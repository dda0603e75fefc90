"""Limits on the size of a mesh, and text from files as messages quote it."""

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


def label(text: object) -> str | None:
    """Return a name from a file on one line, shortened; None if it has no printable character."""
    return clipped("".join(c if c.isprintable() else " " for c in str(text)[:1000])) or None


def clipped(text: object, most: int = 100) -> str:
    """Return text from a file on one line, shortened to ``most`` characters."""
    line = " ".join(str(text)[:1000].split())
    return line if len(line) <= most else f"{line[:most]}…"
