"""Cells of VTK's files as triangles: polygons and triangle strips, given by where each begins in a list of corners."""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.limits import Limits
from shapespace.files.polygon_reading import ENDS_EARLY, strip_triangles
from shapespace.mesh.attributes import MeshAttributes
from shapespace.mesh.triangle_mesh import MeshError, require_vertices

#: Types of cells in unstructured grids: points and lines, which are left out, and cells that have area.
_WITHOUT_AREA = (0, 1, 2, 3, 4)
_TRIANGLE, _STRIP, _POLYGON, _PIXEL, _QUAD = 5, 6, 7, 8, 9


class VtkCells(NamedTuple):
    """Cells of one kind: each begins at an entry of ``offsets`` (n + 1,) in the list of their corners."""

    offsets: IntArray
    corners: IntArray
    strips: bool = False  # whether they are triangle strips, or else polygons

    def triangles(self, limits: Limits) -> IntArray:
        """Return the triangles (F, 3). Cells with fewer than three corners are left out.

        Raises:
            MeshError: there are more triangles than the limits allow.
            ValueError: the offsets go back, or beyond the corners.
        """
        self._check()
        cells = self._chosen(np.diff(self.offsets) >= 3)
        polygons = MeshAttributes(starts=cells.offsets, corners=cells.corners)
        limits.check(0, int((polygons.sizes - 2).sum()))
        return strip_triangles(cells.corners, cells.offsets) if self.strips else polygons.triangles

    def of_grid(self, types: IntArray) -> tuple[VtkCells, VtkCells]:
        """Return the polygons and the triangle strips among the cells of an unstructured grid, by their types (n,).

        Raises:
            MeshError: there are cells of other types, such as tetrahedra.
            ValueError: there is not one type for each cell.
        """
        self._check()
        if len(types) != len(self.offsets) - 1:
            raise ValueError(ENDS_EARLY)
        known = (*_WITHOUT_AREA, _TRIANGLE, _STRIP, _POLYGON, _PIXEL, _QUAD)
        if not np.isin(types, known).all():
            raise MeshError(other_kind("cells that are no polygons"))
        corners = self.corners.copy()
        pixels = self.offsets[:-1][(types == _PIXEL) & (np.diff(self.offsets) == 4)]
        # The corners of a pixel go along its rows, not around it.
        corners[pixels + 2], corners[pixels + 3] = self.corners[pixels + 3], self.corners[pixels + 2]
        cells = self._replace(corners=corners)
        return (
            cells._chosen(np.isin(types, (_TRIANGLE, _POLYGON, _PIXEL, _QUAD))),
            cells._chosen(types == _STRIP)._replace(strips=True),
        )

    def _check(self) -> None:
        if not len(self.offsets) or self.offsets[0] or (np.diff(self.offsets) < 0).any():
            raise ValueError(ENDS_EARLY)
        if self.offsets[-1] > len(self.corners):
            raise ValueError(ENDS_EARLY)

    def _chosen(self, cells: NDArray[np.bool_]) -> VtkCells:
        """Return some cells, given by a mask (n,)."""
        sizes = np.diff(self.offsets)
        corners = self.corners[: self.offsets[-1]][np.repeat(cells, sizes)]
        return self._replace(offsets=np.append(0, np.cumsum(sizes[cells])), corners=corners)


def surface(vertices: FloatArray, cells: list[VtkCells], limits: Limits) -> tuple[FloatArray, IntArray]:
    """Return vertices (V, 3) and faces (F, 3), polygons before strips.

    Raises:
        MeshError: a face names a vertex that is not there, or the mesh is too large.
        ValueError: the cells are damaged.
    """
    ordered = sorted(cells, key=lambda one: one.strips)
    faces = np.concatenate([np.zeros((0, 3), np.int64), *(one.triangles(limits) for one in ordered)])
    limits.check(len(vertices), len(faces))
    require_vertices(faces, len(vertices))
    return vertices, faces


def other_kind(kind: str) -> str:
    """Return the message for data that are not read."""
    kind = kind if re.fullmatch(r"[\w ]{1,40}", kind, re.ASCII) else "other data"
    return f"it holds {kind}, and only polygons are read: extract the surface, in ParaView by Extract Surface"
