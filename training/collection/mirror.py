"""The left–right symmetry of a collection, and mirror images of its shapes.

Bodies and faces are often made from a template whose vertices mirror each other. A pose of the left arm then says how
the right arm moves. The mesh's faces need not mirror each other: a quad may be split along the other diagonal.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial import KDTree

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import diagonal
from shapespace.training.collection.large_arrays import stacked

#: A shape is symmetric if a reflection maps every vertex to within this distance of a vertex, a share of the diagonal.
TOLERANCE = 1e-3
#: Least share of edges that the reflection maps to an edge.
EDGES = 0.9
#: Number of vertices to test first, as most reflections fail already there.
FIRST = 200


def find_mirror(shapes: Sequence[FloatArray] | FloatArray, edges: IntArray) -> tuple[IntArray, int] | None:
    """Find the first shape with exactly one reflection symmetry, and the mirror image of each vertex.

    A shape with several reflections, such as a straight bar, doesn't tell left from right: if the bar can bend forward,
    it need not be able to bend backward.

    Returns:
        For shapes (n, V, 3) with edges (E, 2), the index (V,) of each vertex's mirror image, and the index of the
        symmetric shape. None if no shape is symmetric.
    """
    known = np.unique(np.sort(edges, axis=1) @ [len(shapes[0]), 1])
    for number, shape in enumerate(shapes):
        found: list[IntArray] = []
        centred = shape - shape.mean(axis=0)
        tree, size = KDTree(centred), TOLERANCE * diagonal(shape)
        # If the principal axes are distinct, the normal of a plane of symmetry is one of them.
        for normal in [*np.linalg.eigh(centred.T @ centred)[1].T, *np.eye(3)]:
            reflection = np.eye(3) - 2 * np.outer(normal, normal)
            some = centred[:: max(1, len(shape) // FIRST)]
            if np.max(tree.query(some @ reflection)[0]) > size:
                continue
            away, image = map(np.asarray, tree.query(centred @ reflection))
            images = np.unique(np.sort(image[edges], axis=1) @ [len(shape), 1])
            if (
                away.max() <= size
                and np.array_equal(image[image], np.arange(len(image)))
                and len(np.intersect1d(images, known)) >= EDGES * len(known)
                and not any(np.array_equal(image, other) for other in found)
            ):
                found.append(image)
        if len(found) == 1:
            return found[0], number
    return None


def mirrored(shapes: FloatArray, image: IntArray) -> tuple[FloatArray, IntArray]:
    """Return mirror images of shapes (n, V, 3), each aligned to its shape; ``image`` (V,) is as in `find_mirror`.

    Symmetric shapes get no image. The second result is the index (k,) of the shape that each image mirrors.
    """
    flipped = np.array([-1.0, 1, 1])

    def of(shape: FloatArray) -> FloatArray:
        return align(shape[image] * flipped, shape)

    others = [k for k, shape in enumerate(shapes) if np.abs(of(shape) - shape).max() > TOLERANCE * diagonal(shape)]
    found = stacked(len(others), (of(shapes[k]) for k in others)) if others else np.empty((0, *shapes.shape[1:]))
    return found, np.array(others, dtype=int)
