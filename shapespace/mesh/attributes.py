"""Attributes of a mesh beside positions and triangles: polygons, texture coordinates, names and materials."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.triangle_mesh import MeshError

#: Marks a corner or a polygon without an index.
NONE = -1


class Topology(StrEnum):
    """The faces of an answer: the polygons of the file, or the triangles that they are split into."""

    ORIGINAL = "original"
    TRIANGLES = "triangles"


@dataclass(frozen=True)
class SurfaceMaterial:
    """The material of a part of a surface."""

    name: str  # name of the material
    # red, green and blue as linear light, and opacity, each from 0 to 1; multiplied by the texture
    color: tuple[float, float, float, float] = (1.0, 1.0, 1.0, 1.0)
    # metallic, roughness: from 0 to 1
    metallic: float = 0.0
    roughness: float = 0.75
    texture: str | None = None  # name of the picture of the base colour, or None


class Labels(NamedTuple):
    """A name for each polygon, or none."""

    names: tuple[str, ...]  # distinct names
    of: IntArray  # (P,) index of the name of each polygon, NONE for none


class SplitVertices(NamedTuple):
    """Split vertices, for formats where each vertex has one texture coordinate and one normal."""

    vertex: IntArray  # (V',) index of the original vertex, increasing
    uv: FloatArray | None  # (V', 2) texture coordinates, zeros where there is none
    normal: IntArray  # (V',) index of the normal, see `MeshAttributes.normal_corners`
    faces: IntArray  # (F, 3) triangles of split vertices


@dataclass(frozen=True, eq=False, kw_only=True)
class MeshAttributes:
    """Polygons on the vertices of a mesh; its triangles are the fans from the first corner of each polygon.

    P polygons have C corners in total. The corners of one polygon are consecutive.

    >>> import numpy as np
    >>> square = MeshAttributes(starts=np.array([0, 4]), corners=np.array([0, 1, 3, 2]))
    >>> square.triangles.tolist()
    [[0, 1, 3], [0, 3, 2]]
    """

    starts: IntArray  # (P + 1,) first corner of each polygon, then C
    corners: IntArray  # (C,) vertex of each corner
    uv: FloatArray | None = None  # (U, 2) texture coordinates, with the origin at the lower left
    uv_corners: IntArray | None = None  # (C,) index of the texture coordinate of each corner, NONE for none
    # (C,) labels: corners of one vertex with the same label share one normal. None if all corners of each vertex do.
    shading: IntArray | None = None
    normals: bool = False  # whether the file had normals or smoothing groups
    colors: FloatArray | None = None  # (V, 3) sRGB colours of the vertices, from 0 to 1
    # objects, groups: names of parts
    objects: Labels | None = None
    groups: Labels | None = None
    material_of: IntArray | None = None  # (P,) index of the material of each polygon, NONE for none
    materials: tuple[SurfaceMaterial, ...] = ()  # materials of the surface
    textures: Mapping[str, bytes] = field(default_factory=dict)  # picture files by name

    @classmethod
    def of_triangles(cls, faces: IntArray) -> MeshAttributes:
        """Make plain attributes from triangles (F, 3)."""
        return cls(starts=np.arange(0, faces.size + 1, 3), corners=faces.ravel())

    @property
    def sizes(self) -> IntArray:
        """(P,) number of corners of each polygon."""
        return np.diff(self.starts)

    @cached_property
    def triangle_polygons(self) -> IntArray:
        """(F,) polygon of each triangle."""
        return np.repeat(np.arange(len(self.sizes)), self.sizes - 2)

    @cached_property
    def triangle_corners(self) -> IntArray:
        """(F, 3) corners of each triangle."""
        cut = self.sizes - 2
        first = self.starts[:-1][self.triangle_polygons]
        behind = np.arange(len(first)) - np.repeat(np.cumsum(cut) - cut, cut)
        return np.stack([first, first + behind + 1, first + behind + 2], axis=1)

    @cached_property
    def triangles(self) -> IntArray:
        """(F, 3) vertices of each triangle."""
        return self.corners[self.triangle_corners]

    @property
    def is_plain(self) -> bool:
        """Whether there is nothing beside triangles."""
        parts = (self.uv, self.shading, self.colors, self.objects, self.groups, self.material_of)
        return bool((self.sizes == 3).all()) and not self.normals and all(part is None for part in parts)

    @cached_property
    def triangulated(self) -> MeshAttributes:
        """The same attributes on triangles instead of polygons."""
        polygons = self.triangle_polygons
        labels = (given and Labels(given.names, given.of[polygons]) for given in (self.objects, self.groups))
        return self._taken(np.full(len(polygons), 3), self.triangle_corners.ravel(), polygons, *labels)

    def only(self, polygons: NDArray[np.bool_]) -> MeshAttributes:
        """Keep some of the polygons, given by a mask (P,)."""

        def used(labels: Labels | None) -> Labels | None:
            if labels is None:
                return None
            there = np.unique(labels.of[polygons])
            there = there[there >= 0]
            of = np.where(labels.of[polygons] < 0, NONE, np.searchsorted(there, labels.of[polygons]))
            return Labels(tuple(labels.names[k] for k in there), of) if len(there) else None

        corners = np.repeat(polygons, self.sizes)
        return self._taken(self.sizes[polygons], corners, polygons, used(self.objects), used(self.groups))

    def _taken(
        self, sizes: IntArray, corners: NDArray, polygons: NDArray, objects: Labels | None, groups: Labels | None
    ) -> MeshAttributes:
        """Return polygons with these sizes, given which corners and polygons they are made of."""

        def taken(array: IntArray | None, chosen: NDArray) -> IntArray | None:
            return None if array is None else array[chosen]

        return replace(
            self,
            starts=np.concatenate([[0], np.cumsum(sizes)]),
            corners=self.corners[corners],
            uv_corners=taken(self.uv_corners, corners),
            shading=taken(self.shading, corners),
            objects=objects,
            groups=groups,
            material_of=taken(self.material_of, polygons),
        )

    def welded(self, vertices: IntArray) -> MeshAttributes:
        """Renumber the vertices: ``vertices`` (N,) has the new index of each, NONE where its polygons are left out."""
        there = np.logical_and.reduceat(vertices[self.corners] >= 0, self.starts[:-1])
        if not there.all():
            return self.only(there).welded(vertices)
        colors = None
        if self.colors is not None:
            # In reverse, so that the colour of the first of several welded vertices stays.
            first = np.flatnonzero(vertices >= 0)[::-1]
            colors = np.empty((vertices.max() + 1, 3))
            colors[vertices[first]] = self.colors[first]
        found = replace(self, corners=vertices[self.corners], colors=colors)
        # Keep the labels only if some vertex has several normals.
        smooth = found.shading is not None and len(np.unique(found.normal_corners)) == len(np.unique(found.corners))
        return replace(found, shading=None) if smooth else found

    @cached_property
    def normal_corners(self) -> IntArray:
        """(C,) index of the normal of each corner: its vertex, unless some vertices have several normals."""
        if self.shading is None:
            return self.corners
        keys = self.corners * (self.shading.max() + 1) + self.shading
        return np.unique(keys, return_inverse=True)[1]

    @cached_property
    def split(self) -> SplitVertices:
        """The triangles on split vertices, which have one texture coordinate and one normal each."""
        # Sort by vertex, then texture coordinate, then normal. Sorting pairs as one number is much faster.
        number = self.corners
        for further in (self.uv_corners, self.normal_corners):
            if further is not None:
                number = np.unique(number * (further.max() + 2) + further + 1, return_inverse=True)[1]
        first = np.unique(number, return_index=True)[1]
        uv = None
        if self.uv is not None and self.uv_corners is not None:
            of_uv = self.uv_corners[first]
            uv = np.where(of_uv[:, None] >= 0, self.uv[of_uv], 0.0)
        return SplitVertices(self.corners[first], uv, self.normal_corners[first], number[self.triangle_corners])

    def check(self, vertex_count: int, faces: IntArray) -> None:
        """Raise MeshError unless the attributes fit a mesh with `vertex_count` vertices and these triangles (F, 3)."""
        starts, corners = self.starts, self.corners
        if starts.ndim != 1 or len(starts) < 2 or starts[0] != 0 or starts[-1] != len(corners):
            raise MeshError("polygons do not begin at the first corner and end at the last")
        if (self.sizes < 3).any():
            raise MeshError(f"polygon {int((self.sizes < 3).argmax())} has fewer than three corners")
        if not np.array_equal(self.triangles, faces):
            raise MeshError("polygons are not those of the triangles")
        places, polygons = len(corners), len(self.sizes)
        for name, of, length, count in (
            ("texture coordinate", self.uv_corners, places, 0 if self.uv is None else len(self.uv)),
            ("shading label", self.shading, places, places),
            ("object", self.objects and self.objects.of, polygons, len(self.objects.names) if self.objects else 0),
            ("group", self.groups and self.groups.of, polygons, len(self.groups.names) if self.groups else 0),
            ("material", self.material_of, polygons, len(self.materials)),
        ):
            if of is None:
                continue
            if len(of) != length:
                raise MeshError(f"there are {len(of)} numbers of a {name}, which is not one for each")
            if of.min() < NONE or of.max() >= count:
                raise MeshError(f"a {name} is numbered {of.min()} to {of.max()}, but there are {count}")
        if self.shading is not None and self.shading.min() < 0:
            raise MeshError("a corner has no shading label")
        if (self.uv is None) != (self.uv_corners is None):
            raise MeshError("texture coordinates and corners that have them go together")
        if self.uv is not None and not np.isfinite(self.uv).all():
            raise MeshError("a texture coordinate is not finite")
        if self.colors is not None and not (
            self.colors.shape == (vertex_count, 3) and (self.colors >= 0).all() and (self.colors <= 1).all()
        ):
            raise MeshError(f"colours must be ({vertex_count}, 3) numbers from 0 to 1")
        for material in self.materials:
            if material.texture is not None and material.texture not in self.textures:
                raise MeshError(f"material {material.name} has no file {material.texture}")


def labelled(names: Sequence[str | None]) -> Labels | None:
    """Make labels from the names of the polygons; None if no polygon has a name."""
    known = list(dict.fromkeys(name for name in names if name is not None))
    if not known:
        return None
    numbers: dict[str | None, int] = {name: k for k, name in enumerate(known)} | {None: NONE}
    return Labels(tuple(known), np.array([numbers[name] for name in names]))


def linear(srgb: FloatArray) -> FloatArray:
    """Convert sRGB colours from 0 to 1 to linear light (IEC 61966-2-1)."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def srgb(linear: NDArray[np.floating]) -> FloatArray:
    """Convert linear light to sRGB colours from 0 to 1, the inverse of `linear`."""
    light = np.clip(linear.astype(np.float64), 0, 1)
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
