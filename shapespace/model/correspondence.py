"""Match a given mesh with a model's meshes, and bring its vertices into the model's order."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.files.limits import Limits
from shapespace.mesh.triangle_mesh import on_shared_vertices
from shapespace.model.decoder import Decoder, MeshChoice

#: Larger meshes than the model's are read up to these limits, so that the error message can name their size.
_VERTICES_READ, _FACES_READ = 2**15, 2**16
#: Largest distance between corners of one vertex, as a share of the diagonal.
_TOLERANCE = 1e-5


class InvalidMeshError(ValueError):
    """A mesh that can't be used; the message says what to do."""


@dataclass(frozen=True)
class Matched:
    """A mesh in the model's vertex order.

    Attributes:
        vertices: (V, 3) vertices.
        mesh: whether they belong to the fine or the coarse mesh.
    """

    vertices: FloatArray
    mesh: MeshChoice


def limits(model: Decoder) -> Limits:
    """Return the limits up to which files are read: large enough for each of the model's meshes."""
    layouts = _layouts(model)
    vertices, faces = max(layout.count for layout in layouts), max(len(layout.faces) for layout in layouts)
    return Limits(max(vertices, 3 * faces, _VERTICES_READ), max(faces, _FACES_READ))


def match(model: Decoder, vertices: FloatArray, faces: IntArray) -> Matched:
    """Find which of the model's meshes a file holds.

    Either the vertices are in the model's order, and the faces in any; JSON may leave faces out. Or the faces are in
    the model's order, and vertices may be split or numbered otherwise, as in STL and after flat shading. Vertices that
    training has welded may be separate, as in its files.

    Args:
        model: decoder with the meshes.
        vertices: (V, 3) vertices in the file's order.
        faces: (F, 3) faces; F may be 0.

    Raises:
        InvalidMeshError: a vertex is not finite, or the mesh is none of the model's meshes.
    """
    layouts = _layouts(model)
    bad = np.flatnonzero(~(np.abs(vertices) < np.finfo(np.float32).max).all(axis=1))
    if len(bad):
        raise InvalidMeshError(f"Vertex {bad[0]} has a coordinate that is not a finite number. Give finite positions.")
    faults = []
    for layout in layouts:
        if len(vertices) == layout.count:
            fault = layout.fault(faces)
            if fault is None:
                return Matched(vertices[layout.places], layout.mesh)
            faults.append(fault)
    for layout in layouts:
        if len(faces) == len(layout.faces) and faces.min() >= 0 and faces.max() < len(vertices):
            reference = model.mesh(layout.mesh).vertices
            shape, torn = on_shared_vertices(vertices[faces], layout.faces, len(reference), _TOLERANCE)
            # The other way round too: vertices that the file shares have to coincide in the reference.
            more = on_shared_vertices(reference[layout.faces], faces, len(vertices), _TOLERANCE)[1]
            if not len(torn) and not len(more):
                return Matched(shape, layout.mesh)
            faults.append(
                f"Face {[*torn, *more][0]} does not meet its neighbours as in the model. Give the faces in the "
                "model's order. Vertices may be split at texture seams, by flat shading, or as in STL."
            )
    if faults:
        raise InvalidMeshError(f"{faults[0]} Give a mesh with the faces and the vertex order of the model.")
    known = " or ".join(f"{layout.count} vertices and {len(layout.faces)} faces" for layout in layouts)
    raise InvalidMeshError(
        f"The mesh has {len(vertices)} vertices and {len(faces)} faces, but those of {model.manifest.name} have "
        f"{known}. Give a mesh in correspondence: nothing may be merged, split or reordered. For other meshes use fit."
    )


@dataclass(frozen=True)
class _Layout:
    """One order in which files may hold a mesh of the model.

    Attributes:
        mesh: fine or coarse mesh.
        faces: (F, 3) faces of the mesh.
        of_file: (N,) mesh vertex for each vertex of the file, −1 for none.
        places: (V,) file vertex for each vertex of the mesh.
    """

    mesh: MeshChoice
    faces: IntArray
    of_file: IntArray
    places: IntArray

    @property
    def count(self) -> int:
        """Number N of vertices in the file."""
        return len(self.of_file)

    def fault(self, faces: IntArray) -> str | None:
        """Return how a file's faces (F, 3) differ from the mesh's faces, or None."""
        if not len(faces):
            return None
        if faces.min() < 0 or faces.max() >= self.count:
            return f"The faces name vertices {faces.min()} to {faces.max()}, but there are {self.count}."
        # Leave out faces of parts that training left out.
        faces = faces[(self.of_file[faces] >= 0).any(axis=1)]
        if len(faces) != len(self.faces):
            return f"The mesh has {len(faces)} faces, but the model's has {len(self.faces)}."
        given, own = (_canonical(f) for f in (self.of_file[faces], self.faces))
        differing = np.flatnonzero((given != own).any(axis=1))
        if not len(differing):
            return None
        if np.array_equal(_canonical(self.of_file[faces][:, ::-1]), own):
            return (
                "The faces are turned inside out, as programs do with mirror images: turn them, and mirror the mesh "
                "too if left and right are exchanged."
            )
        return f"No face joins vertices {tuple(self.places[own[differing[0]]].tolist())} as in the model."


def _canonical(faces: IntArray) -> IntArray:
    """Return faces in an order that doesn't depend on the file; each begins with its smallest vertex."""
    first = faces.argmin(axis=1)[:, None]
    turned = np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1)
    return turned[np.lexsort(turned.T[::-1])]


def _layouts(model: Decoder) -> list[_Layout]:
    layouts = []
    choices = [MeshChoice.FINE, MeshChoice.COARSE] if model.fine else [MeshChoice.FINE]
    if model.fine and (model.fine.prolong.coarse_vertices < 0).any():
        choices = [MeshChoice.COARSE]  # the positions of coarse vertices on the fine mesh are unknown
    for choice in choices:
        mesh = model.mesh(choice)
        own = np.arange(len(mesh.vertices))
        layouts.append(_Layout(choice, mesh.faces, own, own))
    if model.file_vertices is not None and choices[0] is MeshChoice.FINE:
        of_file = model.file_vertices
        places = np.zeros(len(layouts[0].of_file), np.int64)
        # In reverse order, so that the first of several welded vertices remains.
        there = np.flatnonzero(of_file >= 0)[::-1]
        places[of_file[there]] = there
        layouts.append(_Layout(choices[0], layouts[0].faces, of_file, places))
    return layouts
