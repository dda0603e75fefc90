"""What carries a part that lies beside a surface, as an eye or a nail does, over a collection of shapes."""

from __future__ import annotations

from itertools import product

import numpy as np
from scipy.spatial import cKDTree

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.prolongation import AttachedPart, Prolongation, bind_points
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import TriangleMesh, diagonal

#: How many coarse vertices near a part are candidates for carrying it, how many points of the part are compared, and
#: the numbers of carrying vertices that are tried.
NEAR, SAMPLE, ANCHORS = 64, 100, (1, 2, 4, 8, 16)
#: A part moves rigidly unless an affine map's error is less than this share of the rigid motion's.
CLOSER = 0.9


def attach_part(
    coarse: TriangleMesh, rest: FloatArray, vertices: IntArray, shapes: FloatArray, parts: FloatArray
) -> AttachedPart:
    """The anchors that carry a part best, and whether it keeps its form on the way.

    Each coarse vertex near the part would take it along with its own affine map (`Prolongation`). Those whose maps come
    nearest to where the part is in all shapes do, weighted by the inverse squares of their errors.

    Args:
        coarse: the surface at rest.
        rest: (k, 3) the part at rest.
        vertices: (k,) numbers of its vertices in the fine mesh.
        shapes: (n, V, 3) shapes of the surface.
        parts: (n, k, 3) the part beside them.
    """
    some = np.unique(np.linspace(0, len(rest) - 1, SAMPLE).astype(int))
    away = [np.asarray(cKDTree(part).query(shape)[0]) for shape, part in zip(shapes, parts, strict=True)]
    near = np.argsort(np.mean(away, axis=0), kind="stable")[:NEAR]
    rows = np.arange(len(near) * len(some))
    weights = bind_points(
        coarse, np.tile(rest[some], (len(near), 1)), rows, np.repeat(near, len(some)), np.ones(len(rows))
    )
    alone = Prolongation(coarse.faces, weights)(shapes).reshape(len(shapes), len(near), len(some), 3)
    truth = parts[:, None, some]
    errors = np.linalg.norm(alone - truth, axis=-1).mean(axis=(0, 2))
    best = np.argsort(errors, kind="stable")
    share = 1 / np.maximum(errors[best], 1e-6 * diagonal(coarse.vertices)) ** 2

    found = []
    for rigid, count in product((True, False), ANCHORS):
        chosen = best[:count]
        b = share[:count] / share[:count].sum()
        carried = np.einsum("a,naki->nki", b, alone[:, chosen])
        if rigid:
            carried = align(np.broadcast_to(rest[some], carried.shape), carried)
        error = np.linalg.norm(carried - truth[:, 0], axis=-1).mean()
        found.append((error if rigid else error / CLOSER, AttachedPart(vertices, near[chosen], b, rigid)))
    return min(found, key=lambda one: one[0])[1]
