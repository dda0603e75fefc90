"""How much of a file is read, and how much of it messages quote."""

from __future__ import annotations

import sys
from dataclasses import dataclass

from shapespace.mesh.triangle_mesh import MeshError


@dataclass(frozen=True)
class Limits:
    """Sizes of a mesh beyond which its reader stops; by default none.

    Attributes:
        vertices: most vertices.
        faces: most triangles.
    """

    vertices: int = sys.maxsize
    faces: int = sys.maxsize

    def check(self, vertices: int, faces: int) -> None:
        """Raise MeshError for a mesh that is larger."""
        if vertices > self.vertices:
            raise MeshError(f"it has more than {self.vertices} vertices")
        if faces > self.faces:
            raise MeshError(f"it has more than {self.faces} faces")


#: For files that are trusted.
UNLIMITED = Limits()


def label(text: object) -> str | None:
    """A name from a file, on one line and not too long; None where nothing of it can be shown."""
    return clipped("".join(c if c.isprintable() else " " for c in str(text)[:1000])) or None


def clipped(text: object, most: int = 100) -> str:
    """Text from a file as messages quote it: on one line, and at most so many characters of it."""
    line = " ".join(str(text)[:1000].split())
    return line if len(line) <= most else f"{line[:most]}…"
