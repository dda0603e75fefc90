"""The meshes, modes and codes of a bundle, which are in ``geometry.npz``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from shapespace.arrays import FloatArray, IntArray
from shapespace.bundle.attributes import from_entry, surface_arrays
from shapespace.bundle.schema import ARRAYS, ArrayType, Manifest
from shapespace.mesh.attributes import MeshAttributes
from shapespace.mesh.prolongation import PREFIX, Prolongation, ProlongationError, nearest_counts
from shapespace.mesh.triangle_mesh import MeshError, TriangleMesh

#: Largest distance of a vertex of the fine mesh from the prolonged reference, as a fraction of the diagonal. It allows
#: for the rounding of float32.
FINE_TOLERANCE = 1e-5


class GeometryError(ValueError):
    """Arrays don't fit each other or the manifest."""


@dataclass(frozen=True)
class FineMesh:
    """A fine mesh that follows the coarse mesh."""

    reference: TriangleMesh  # the fine mesh at the coarse reference
    prolong: Prolongation  # maps coarse vertices to fine vertices

    @cached_property
    def nearby(self) -> FloatArray:
        """Number of fine vertices whose nearest coarse vertex is each coarse vertex, at least 1, (V,)."""
        return nearest_counts(self.reference.vertices, self.prolong.coarse_vertices)


@dataclass(frozen=True, kw_only=True)
class Geometry:
    """Content of ``geometry.npz``."""

    reference: TriangleMesh  # the reference shape, normalised
    fine: FineMesh | None = None  # the fine mesh, if there is one
    # (m, V, 3) vertex fields d_j at the reference, if codes are coefficients of tangent vectors
    modes: FloatArray | None = None
    training_codes: FloatArray | None = None  # (n, m) codes of the training shapes, if there are any
    # (N,) for each vertex of the user's files its vertex of the finest mesh, or −1 if it is in no face; None if the
    # vertices are the same
    file_vertices: IntArray | None = None
    surface: MeshAttributes | None = None  # attributes of the finest mesh in the user's file, if any

    def arrays(self) -> dict[str, NDArray]:
        """Return the arrays of the file by name, in the types of `ARRAYS`."""
        mesh = self.reference
        found = {
            "vertices": mesh.vertices,
            "faces": mesh.faces,
            "edges": mesh.edges,
            "modes": self.modes,
            "training_codes": self.training_codes,
            "file_vertices": self.file_vertices,
        }
        if self.fine:
            fine = self.fine.reference
            found |= {"fine_vertices": fine.vertices, "fine_faces": fine.faces, **self.fine.prolong.arrays()}
        if self.surface:
            found |= surface_arrays(self.surface)
        return {name: array.astype(ARRAYS[name].dtype) for name, array in found.items() if array is not None}

    @classmethod
    def from_arrays(
        cls, arrays: Mapping[str, NDArray], manifest: Manifest, textures: Mapping[str, bytes] = MappingProxyType({})
    ) -> Geometry:
        """Return the geometry in arrays, after checks against each other and the manifest.

        Raises GeometryError, whose message names the file, the array and the fault.
        """
        file = manifest.geometry.file
        try:
            reference, edges = TriangleMesh.from_mapping(arrays), arrays["edges"]
        except KeyError as error:
            raise GeometryError(f"{file} has no array {error}") from None
        except MeshError as error:
            raise GeometryError(f"{file}: {error}") from None
        for name, array in arrays.items():
            if np.issubdtype(array.dtype, np.floating) and not np.isfinite(array).all():
                raise GeometryError(f"{file}: {name} has an entry that is not finite")
        counts = (len(reference.vertices), len(reference.faces), len(reference.edges))
        said = (manifest.vertices, manifest.faces, manifest.edges)
        if counts != said:
            raise GeometryError(f"{file} has (V, F, E) = {counts}, the manifest says {said}")
        if not np.array_equal(edges, reference.edges):
            raise GeometryError(f"{file}: edges are not those of the faces in lexicographic order")
        fine = _fine_mesh(file, arrays, reference)
        places = arrays.get("file_vertices")
        if places is not None:
            _check_file_vertices(file, places, fine.reference if fine else reference)
        sizes = {"m": manifest.latent_dimension, "V": manifest.vertices, "F": manifest.faces, "E": manifest.edges}
        for name in ARRAYS.keys() & arrays.keys():
            _check_type(f"{file}: {name}", arrays[name], ARRAYS[name], sizes)
        surface = None
        if manifest.surface:
            finest = fine.reference if fine else reference
            try:
                surface = from_entry(manifest.surface, arrays, textures)
                surface.check(len(finest.vertices), finest.faces)
            except MeshError as error:
                raise GeometryError(f"surface: {error}") from None

        def numbers(name: str) -> NDArray | None:
            return arrays[name].astype(np.float64) if name in arrays else None

        return cls(
            reference=reference,
            fine=fine,
            modes=numbers("modes"),
            training_codes=numbers("training_codes"),
            file_vertices=None if places is None else places.astype(np.int64),
            surface=surface,
        )


def _check_type(name: str, array: NDArray, wanted: ArrayType, sizes: Mapping[str, int]) -> None:
    if not array.size:
        raise GeometryError(f"{name} is empty")
    shape = [sizes.get(size, size) if isinstance(size, str) else size for size in wanted.shape]
    fits = array.ndim == len(shape) and all(
        isinstance(want, str) or want == size for want, size in zip(shape, array.shape, strict=True)
    )
    real = issubclass(wanted.dtype, np.floating)
    if not fits or not np.issubdtype(array.dtype, np.floating if real else np.integer):
        text = f"({', '.join(map(str, shape))}{',' if len(shape) == 1 else ''})"
        kind = "real" if real else "whole"
        raise GeometryError(f"{name} must be {kind} numbers {text}, not {array.dtype} {array.shape}")


def _check_file_vertices(file: str, places: NDArray, mesh: TriangleMesh) -> None:
    """Raise GeometryError unless the array (N,) has whole numbers and every vertex of the finest mesh."""
    count = len(mesh.vertices)
    if places.ndim != 1 or not np.issubdtype(places.dtype, np.integer) or len(places) < count:
        raise GeometryError(
            f"{file}: file_vertices must be at least {count} whole numbers, not {places.dtype} {places.shape}"
        )
    if not np.array_equal(np.unique(places[places != -1]), np.arange(count)):
        raise GeometryError(f"{file}: file_vertices must name each of the vertices 0 to {count - 1}, or -1")


def _fine_mesh(file: str, arrays: Mapping[str, NDArray], reference: TriangleMesh) -> FineMesh | None:
    if not any(name.startswith(("fine_", PREFIX)) for name in arrays):
        return None
    try:
        fine = TriangleMesh.from_arrays(arrays["fine_vertices"], arrays["fine_faces"])
        prolong = Prolongation.from_arrays(arrays)
    except KeyError as error:
        raise GeometryError(f"{file} has no array {error}, which goes with the other arrays of a fine mesh") from None
    except ProlongationError as error:
        raise GeometryError(f"{file}: {error}") from None
    except MeshError as error:
        raise GeometryError(f"{file}: fine mesh: {error}") from None
    if not np.array_equal(prolong.faces, reference.faces):
        raise GeometryError(f"{file}: {PREFIX}faces are not the faces of the mesh")
    if prolong.vertex_count != len(fine.vertices):
        raise GeometryError(
            f"{file}: the prolongation is to {prolong.vertex_count} vertices, but there are {len(fine.vertices)} "
            "fine_vertices"
        )
    distance = np.linalg.norm(prolong(reference.vertices) - fine.vertices, axis=1).max()
    if distance > FINE_TOLERANCE * fine.diagonal:
        raise GeometryError(
            f"{file}: fine_vertices are up to {distance:.1e} away from where the prolongation takes the reference"
        )
    return FineMesh(fine, prolong)
