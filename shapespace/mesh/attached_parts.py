"""Anchors of attached parts: parts of the fine mesh that lie beside the coarse surface, such as eyes and nails."""

from itertools import product

import numpy as np
from scipy.spatial import cKDTree

from shapespace.arrays import FloatArray, IntArray, evenly_spaced
from shapespace.mesh.prolongation import AttachedPart, Prolongation, bind_points
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import TriangleMesh, diagonal

#: Number of coarse vertices near a part that are candidates for anchors.
CANDIDATES = 64
#: Number of points of the part that are compared.
SAMPLE = 100
#: Numbers of anchors that are tried.
ANCHORS = (1, 2, 4, 8, 16)
#: A part moves rigidly unless an affine map has an error below this share of the error of the rigid motion.
AFFINE_GAIN = 0.9


def attach_part(
    coarse: TriangleMesh, rest: FloatArray, vertices: IntArray, shapes: FloatArray, parts: FloatArray
) -> AttachedPart:
    """Choose the anchors that predict the positions of a part best, and whether it moves rigidly.

    Each coarse vertex near the part has an affine map, see `Prolongation`. The anchors are the vertices whose maps
    predict the part best in all shapes, weighted by the inverse squares of their errors.

    The part has the vertices (k,) of the fine mesh. It lies at ``rest`` (k, 3), and at ``parts`` (n, k, 3) in the
    coarse shapes (n, V, 3).
    """
    some = evenly_spaced(len(rest), SAMPLE)
    distances = [np.asarray(cKDTree(part).query(shape)[0]) for shape, part in zip(shapes, parts, strict=True)]
    near = np.argsort(np.mean(distances, axis=0), kind="stable")[:CANDIDATES]
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
        moved = np.einsum("a,naki->nki", b, alone[:, chosen])
        if rigid:
            moved = align(np.broadcast_to(rest[some], moved.shape), moved)
        error = np.linalg.norm(moved - truth[:, 0], axis=-1).mean()
        found.append((error if rigid else error / AFFINE_GAIN, AttachedPart(vertices, near[chosen], b, rigid)))
    return min(found, key=lambda one: one[0])[1]
