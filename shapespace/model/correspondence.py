"""Uploaded meshes: which of a model's meshes one is, and its vertices in the model's order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.limits import Limits
from shapespace.mesh.triangle_mesh import diagonal
from shapespace.model.decoder import Decoder, MeshChoice

#: Larger meshes than the model's are read up to these, so that their sizes can be told.
_VERTICES_READ, _FACES_READ = 2**15, 2**16


class InvalidMeshError(ValueError):
    """An uploaded mesh that can't be used, with a sentence that says what to do."""


@dataclass(frozen=True)
class Matched:
    """An uploaded mesh in the model's order.

    Attributes:
        vertices: (V, 3) of the mesh of choice.
        mesh: which one it is.
    """

    vertices: FloatArray
    mesh: MeshChoice


def limits(model: Decoder) -> Limits:
    """How large a file has to be read to tell whether it holds one of the model's meshes."""
    layouts = _layouts(model)
    vertices, faces = max(layout.count for layout in layouts), max(len(layout.faces) for layout in layouts)
    return Limits(max(vertices, 3 * faces, _VERTICES_READ), max(faces, _FACES_READ))


def match(model: Decoder, vertices: FloatArray, faces: IntArray) -> Matched:
    """Find which of the model's meshes a file holds.

    Vertices count in their order and faces in any; JSON may leave these out. STL, which shares no vertices, counts by
    the order of its faces. A file like those that the model was trained on may have the vertices that were welded then.

    Args:
        model: whose meshes come into question.
        vertices: (V, 3) as they stand in the file.
        faces: (F, 3) there, or none.

    Raises:
        InvalidMeshError: not finite, or none of the model's meshes.
    """
    layouts = _layouts(model)
    bad = np.flatnonzero(~(np.abs(vertices) < np.finfo(np.float32).max).all(axis=1))
    if len(bad):
        raise InvalidMeshError(f"Vertex {bad[0]} has a coordinate that is not a finite number. Send finite positions.")
    soup = len(vertices) == faces.size and np.array_equal(faces.ravel(), np.arange(len(vertices)))
    faults = []
    for layout in layouts:
        if soup and len(faces) == len(layout.faces):
            return _of_soup(layout, vertices[faces])
        if len(vertices) == layout.count:
            fault = layout.fault(faces)
            if fault is None:
                return Matched(vertices[layout.places], layout.mesh)
            faults.append(fault)
    if faults:
        raise InvalidMeshError(f"{faults[0]} Send a mesh with the faces and the vertex order of the model's.")
    known = " or ".join(f"{layout.count} vertices and {len(layout.faces)} faces" for layout in layouts)
    raise InvalidMeshError(
        f"The mesh has {len(vertices)} vertices and {len(faces)} faces, but those of {model.manifest.name} have "
        f"{known}. Send one in correspondence, with nothing welded, split or reordered."
    )


@dataclass(frozen=True)
class _Layout:
    """One way in which a mesh of the model lies in a file.

    Attributes:
        mesh: which mesh.
        faces: (F, 3) of it.
        of_file: (N,) vertex of the mesh that each vertex of the file is, −1 for none.
        places: (V,) vertex of the file that each vertex of the mesh is.
    """

    mesh: MeshChoice
    faces: IntArray
    of_file: IntArray
    places: IntArray

    @property
    def count(self) -> int:
        """N."""
        return len(self.of_file)

    def fault(self, faces: IntArray) -> str | None:
        """What distinguishes the faces of a file (F, 3) from those of the mesh, if there are any."""
        if not len(faces):
            return None
        if faces.min() < 0 or faces.max() >= self.count:
            return f"The faces name vertices {faces.min()} to {faces.max()}, but there are {self.count}."
        # Faces of parts that the model was told to leave out.
        faces = faces[(self.of_file[faces] >= 0).any(axis=1)]
        if len(faces) != len(self.faces):
            return f"The mesh has {len(faces)} faces, but the model's has {len(self.faces)}."
        given, own = (_canonical(f) for f in (self.of_file[faces], self.faces))
        differing = np.flatnonzero((given != own).any(axis=1))
        if not len(differing):
            return None
        if np.array_equal(_canonical(self.of_file[faces][:, ::-1]), own):
            return "The faces are turned inside out."
        return f"No face joins vertices {tuple(self.places[own[differing[0]]].tolist())} as in the model."


def _canonical(faces: IntArray) -> IntArray:
    """Faces in an order that doesn't depend on the file's: each begins with its smallest vertex."""
    first = faces.argmin(axis=1)[:, None]
    turned = np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1)
    return turned[np.lexsort(turned.T[::-1])]


def _layouts(model: Decoder) -> list[_Layout]:
    layouts = []
    choices = [MeshChoice.FINE, MeshChoice.COARSE] if model.fine else [MeshChoice.FINE]
    if model.fine and (model.fine.prolong.coarse_vertices < 0).any():
        choices = [MeshChoice.COARSE]  # nothing tells where the coarse vertices are on a fine mesh
    for choice in choices:
        mesh = model.mesh(choice)
        own = np.arange(len(mesh.vertices))
        layouts.append(_Layout(choice, mesh.faces, own, own))
    if model.file_vertices is not None and choices[0] is MeshChoice.FINE:
        of_file = model.file_vertices
        places = np.zeros(len(layouts[0].of_file), np.int64)
        # Backwards, so that the first of welded vertices stays.
        there = np.flatnonzero(of_file >= 0)[::-1]
        places[of_file[there]] = there
        layouts.append(_Layout(choices[0], layouts[0].faces, of_file, places))
    return layouts


def _of_soup(layout: _Layout, corners: FloatArray) -> Matched:
    """Vertices of triangles (F, 3, 3) in the order of the mesh's faces."""
    vertices = np.zeros((layout.faces.max() + 1, 3))
    vertices[layout.faces] = corners
    apart = np.linalg.norm(vertices[layout.faces] - corners, axis=-1).max(axis=1)
    torn = np.flatnonzero(apart > 1e-5 * diagonal(vertices))
    if len(torn):
        raise InvalidMeshError(
            f"Face {torn[0]} does not meet its neighbours as in the model. Send STL with the faces in the model's "
            "order, or a format that keeps vertices: glb, obj, ply, npz or json."
        )
    return Matched(vertices, layout.mesh)
