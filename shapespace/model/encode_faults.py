"""Faults of meshes in correspondence: another order of vertices, a mirror image, another size, another kind of shape.

A search finds a code for such a mesh too, but the code does not describe it. The checks compare
the mesh with the shape of the code. `init` uses the same signs for the meshes of a collection.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from scipy.spatial import KDTree

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.triangle_mesh import Connectivity
from shapespace.mesh.vertex_order import ORDER, VertexEdges, extent, times_longer


class EncodeCause(StrEnum):
    """Why a mesh is no shape of the model.

    ``order``: the vertices have another order. ``exchanged``: some vertices are exchanged. ``outliers``: some vertices
    lie far off. ``mirrored``: the mesh is a mirror image. ``size``: the mesh has another size than the model's shapes.
    ``far``: no shape of the model is near.
    """

    ORDER = "order"
    EXCHANGED = "exchanged"
    OUTLIERS = "outliers"
    MIRRORED = "mirrored"
    SIZE = "size"
    FAR = "far"


@dataclass(frozen=True)
class FaultThresholds:
    """Differences between a mesh and the shape of its code that are signs of a fault.

    Attributes:
        scattered, edge: with another order, the mean distance of vertices and the median edge are larger shares of the
            diagonal. Noise of 1 % also makes edges many times as long, but not longer than 2.5 % of the diagonal.
        beside, most: or a larger share of the vertices than ``most`` stand within ``beside`` edges of the place of
            another vertex.
        apart: an exchanged vertex lies more than this many times as far from its own place as three quarters of all
            vertices,
        least: and farther than this share of the diagonal,
        near: but within this share of its distance from the place of another vertex,
        jump: and the mean displacement of its neighbours differs by more than this share of its own.
        mirrored: a mesh is a mirror image if mirroring reduces the mean square distance to less than this share.
        sized: a mesh has another size if its patches lie farther from the shape than this share of the diagonal,
        resized: if resizing reduces the mean square distance to less than this share,
        times: and if its size differs by at least this factor.
        far: the mesh is no shape of the model if its patches lie farther than this share of the diagonal. Noise of 2 %
            moves patches of 16 vertices by 0.8 %, and a flattened figure lies 2.4 % away.
    """

    scattered: float = 0.05
    edge: float = 0.03
    beside: float = 0.3
    most: float = 0.6
    apart: float = 6.0
    least: float = 1e-3
    near: float = 0.25
    jump: float = 0.5
    mirrored: float = 0.25
    sized: float = 0.01
    resized: float = 0.1
    times: float = 1.03
    far: float = 0.02


THRESHOLDS = FaultThresholds()


@dataclass(frozen=True)
class EncodeFault:
    """A fault of a mesh: its cause, a sentence about it, and the misplaced vertices (k,), if single ones are."""

    cause: EncodeCause
    sentence: str
    misplaced: IntArray


class OrderCheck:
    """Finds vertices of meshes that stand where other vertices should, or far off.

    Args:
        connectivity: faces and edges of the meshes.
        diagonal: diagonal of the bounding box, in the units of the meshes.
    """

    def __init__(self, connectivity: Connectivity, diagonal: float) -> None:
        self._edges, self._diagonal = VertexEdges(connectivity), diagonal

    def __call__(self, given: FloatArray, shape: FloatArray) -> EncodeFault | None:
        """Return the fault of a mesh (V, 3) beside the shape (V, 3) of its code, which is aligned to it."""
        lengths, usual = self._edges.lengths(given), self._edges.lengths(shape)
        extents = np.array([extent(given)]), np.array([extent(shape)])
        distances, middle = np.linalg.norm(given - shape, axis=1), float(np.median(lengths))

        def times(values: FloatArray, known: FloatArray) -> FloatArray:
            with np.errstate(divide="ignore", invalid="ignore"):
                found: FloatArray = times_longer(values[None], extents[0], known[None], extents[1])[0]
            return found

        edge = float(np.median(usual))
        scattered = distances.mean() > THRESHOLDS.scattered * self._diagonal
        scattered &= middle > THRESHOLDS.edge * self._diagonal
        longer = scattered and np.median(times(lengths, usual)) > ORDER.scrambled
        if longer or _shifted(given, shape, distances, edge):
            return _another_order(np.flatnonzero(distances > THRESHOLDS.beside * edge), len(given))
        shortest, longest = self._edges.range(lengths)[0], self._edges.range(usual)[1]
        stretched = (times(shortest, longest) > ORDER.stretch) & (shortest > ORDER.long * middle)
        misplaced = np.union1d(np.flatnonzero(stretched), self._swapped(given, shape, distances))
        if not len(misplaced):
            return None
        places = np.asarray(KDTree(shape[misplaced]).query(given[misplaced])[0])
        return _some_misplaced(misplaced, len(given), exchanged=bool((places < ORDER.long * edge).mean() > 0.5))

    def _swapped(self, given: FloatArray, shape: FloatArray, distances: FloatArray) -> IntArray:
        """Return vertices that stand at the place of another vertex of this kind, though their neighbours do not."""
        least = max(THRESHOLDS.apart * float(np.quantile(distances, 0.75)), THRESHOLDS.least * self._diagonal)
        far = np.flatnonzero(distances > least)
        if not len(far):
            return far
        near, place = map(np.asarray, KDTree(shape).query(given[far]))
        moved = given - shape
        jump = np.linalg.norm(moved - self._edges.neighbours_mean(moved), axis=1)[far]
        there = (place != far) & (near < THRESHOLDS.near * distances[far]) & (jump > THRESHOLDS.jump * distances[far])
        far, place = far[there], place[there]
        found: IntArray = far[np.isin(place, far)]
        return found


def _shifted(given: FloatArray, shape: FloatArray, distances: FloatArray, edge: float) -> bool:
    """Whether most vertices stand at the place of another vertex, as after a shift along a symmetric shape."""
    if np.median(distances) < THRESHOLDS.beside * edge:
        return False
    near, place = map(np.asarray, KDTree(shape).query(given))
    beside = (place != np.arange(len(given))) & (near < THRESHOLDS.beside * edge)
    return bool(beside.mean() > THRESHOLDS.most)


def _another_order(misplaced: IntArray, count: int) -> EncodeFault:
    sentence = (
        f"The vertices are in another order than the model's: {len(misplaced)} of {count} have other positions. "
        "Export the "
        "mesh again with the vertex order of the model, or use fit, which needs no order."
    )
    return EncodeFault(EncodeCause.ORDER, sentence, misplaced)


def _some_misplaced(misplaced: IntArray, count: int, *, exchanged: bool) -> EncodeFault:
    if len(misplaced) == 1:
        sentence = f"Vertex {misplaced[0]} (counted from 0) lies far off the surface."
        return EncodeFault(EncodeCause.OUTLIERS, f"{sentence} Correct the mesh, or use fit.", misplaced)
    which = f"{len(misplaced)} of {count} vertices"
    first = f"the first is vertex {misplaced[0]}, counted from 0"
    if exchanged:
        sentence = (
            f"{which} are in another order than the model's: they are at the positions of other vertices ({first}). "
            "Export "
            "the mesh again with the vertex order of the model."
        )
        return EncodeFault(EncodeCause.EXCHANGED, sentence, misplaced)
    sentence = f"{which} lie far off the surface ({first}). Correct the mesh, or use fit."
    return EncodeFault(EncodeCause.OUTLIERS, sentence, misplaced)


def mirror_image(given: float, mirrored: float) -> EncodeFault | None:
    """Return the fault of a mesh whose mirror image is much nearer to a shape of the model.

    The root mean square distances of both from their nearest shapes are shares of the diagonal.
    """
    if not mirrored**2 < THRESHOLDS.mirrored * given**2:
        return None
    sentence = (
        f"The mesh is a mirror image: all its vertices are mirrored. They lie {given:.2g} of the diagonal from a shape "
        f"of the model, and {mirrored:.2g} if mirrored back. Change the sign of one coordinate."
    )
    return EncodeFault(EncodeCause.MIRRORED, sentence, np.zeros(0, np.int64))


def patch_distance(misfit: FloatArray, patches: IntArray) -> float:
    """Return the mean length of the mean displacements of patches. Noise changes it little.

    Displacements are (V, 3), and patches (V,) the number of the patch of each vertex.
    """
    counts = np.bincount(patches)
    sums = np.stack([np.bincount(patches, along) for along in misfit.T], axis=1)
    return float(np.linalg.norm(sums / counts[:, None], axis=1) @ counts / len(patches))


def other_size(given: float, resized: float, times: float) -> EncodeFault | None:
    """Return the fault of a mesh that is much nearer to a shape of the model at another size.

    The root mean square distances of both from their nearest shapes are shares of the mesh's diagonal.
    """
    if not resized**2 < THRESHOLDS.resized * given**2 or max(times, 1 / times) < THRESHOLDS.times:
        return None
    sentence = (
        f"The mesh is about {times:.3g} times as large as the model's shape: it lies {given:.2g} of the diagonal away, "
        f"and {resized:.2g} at the model's size. Multiply its coordinates by about {1 / times:.3g}."
    )
    return EncodeFault(EncodeCause.SIZE, sentence, np.zeros(0, np.int64))


def far_from_all(distance: float, mean: float) -> EncodeFault | None:
    """Return the fault of a mesh that is far from all shapes of the model.

    The distance of its patches and the mean distance of its vertices are shares of the diagonal.
    """
    if distance <= THRESHOLDS.far:
        return None
    sentence = (
        f"The nearest shape of the model lies {mean:.1%} of the diagonal away on average: the mesh is another kind of "
        "shape, or it is stretched or flattened. Give a mesh like those that the model was trained on."
    )
    return EncodeFault(EncodeCause.FAR, sentence, np.zeros(0, np.int64))
