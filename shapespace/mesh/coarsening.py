"""A coarse connectivity that serves every shape of a collection: how far to decimate, and which result to take."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.decimation import Decimation
from shapespace.mesh.thinning import thin
from shapespace.mesh.triangle_mesh import Connectivity, MeshError, TriangleMesh, face_areas
from shapespace.mesh.triangle_quality import folded_pairs

#: Smallest angles (degrees) that an edge collapse may leave in any shape: the first limit holds until no collapse meets
#: it, then the next. Stricter limits cost accuracy, as expensive collapses are then made before cheap ones.
ANGLE_LIMITS = (10.0, 6.0, 3.0, 1.5)
#: In crumpled places edges below this length may collapse (see ``Decimation``); in mean edges of the coarse mesh.
SMALL = 1.0
#: Share of the vertices reserved for removing slivers and folds that the fine mesh has already.
HEALING_SHARE = 0.1
#: At least this share of the target number of vertices is left, however many are removed because of slivers.
LEAST_SHARE = 0.5
#: Weights of motion (see ``Decimation``) that are tried. A large weight makes triangles uniform, which networks learn
#: better, but can leave tiny faces, at which geodesics end. So among the meshes with the fewest specks and folds the
#: first is taken whose smallest face has at least NEARLY times the area that it has in the best of them.
MOTION_WEIGHTS, NEARLY = (1.0, 0.1, 0.01), 0.9

#: A mesh with more vertices than the first number, and more than the second times the target, is thinned first:
LARGE, PLENTY = 20_000, 20
#: to the first number of vertices here, or the second times the target, whichever is more.
THINNED, ENOUGH = 5000, 8
#: How many shapes, evenly spaced in the collection, thinning takes into account.
THINNED_SHAPES = 4


@dataclass(frozen=True)
class Coarsening:
    """A coarse connectivity on some of the fine vertices.

    Attributes:
        fine_index: (V,) which fine vertex each coarse one is, increasing.
        faces: (F, 3) in coarse indices.
        smallest_angle: over all faces of all shapes, radians.
        folds: pairs of neighbouring faces that are folded onto one another in some shape.
        shrinkage: smallest area of a face in a shape, as a share of the face's geometric mean over all shapes.
        smallest_area: of a face in a shape, as a share of the mean over the faces of that shape.
        specks: faces that in some shape are below the least area or angle (``triangle_quality``).
        reason: why there are more or fewer vertices than asked for, or specks, in words; empty if there are none.
    """

    fine_index: IntArray
    faces: IntArray
    smallest_angle: float
    folds: int
    shrinkage: float
    smallest_area: float = 1.0
    specks: int = 0
    reason: str = ""


def coarsen(fine: TriangleMesh, target: int, shapes: FloatArray) -> Coarsening:
    """Take vertices away until ``target`` are left, the same for all shapes.

    Half-edge collapses u → v (Garland and Heckbert 1997, Hoppe 1996): u's faces are handed to v, so that every
    coarse vertex is a fine one and the coarse faces have a position in every shape. The cheapest goes first, by the
    quadrics of several shapes together, so that bent poses count too. A collapse is refused if it changes the topology
    (link condition; boundary loops stay), or if it would leave, in the reference or any shape, a sliver, a face turned
    over, two neighbours folded onto one another, or a speck: a face whose area is next to nothing beside the other
    faces, or in one shape beside what it is in the other shapes; unless it was worse there before. The limit on slivers
    is relaxed only once nothing else is left. Slivers, folds and specks of the fine mesh itself are healed where a
    collapse or an edge flip makes them fewer, over all shapes. In the end thin parts that can only be had with slivers
    or specks lose vertices and are left to the fine mesh; the result says what remains.

    Each collapse costs a part of a millisecond, so a large mesh is thinned by many at once first, with an eye on a few
    shapes; in time about linear in its vertices.

    Args:
        fine: the reference.
        target: number of vertices.
        shapes: (n, Vf, 3) all shapes of the collection, n ≥ 0.

    Raises:
        MeshError: shapes of another form, or with coordinates that aren't finite.
    """
    shapes = np.asarray(shapes, dtype=np.float64)
    if shapes.ndim != 3 or shapes.shape[1:] != fine.vertices.shape:
        raise MeshError(f"shapes must be (n, {len(fine.vertices)}, 3), not {shapes.shape}")
    bad = [k for k, shape in enumerate(shapes) if not np.isfinite(shape).all()]
    if bad:
        raise MeshError(f"shape {bad[0]} has a coordinate that is not finite")
    if len(fine.vertices) <= max(LARGE, PLENTY * target):
        return _best(fine, target, shapes)
    some = np.unique(np.linspace(0, len(shapes) - 1, THINNED_SHAPES).astype(int)) if len(shapes) else ()
    few = np.stack([fine.vertices, *(shapes[k] for k in some)])
    kept, faces = thin(fine.connectivity, few, max(THINNED, ENOUGH * target))
    found = _best(TriangleMesh.from_arrays(fine.vertices[kept], faces), target, shapes[:, kept])
    return replace(found, fine_index=kept[found.fine_index])


def _best(fine: TriangleMesh, target: int, shapes: FloatArray) -> Coarsening:
    """The best of what the weights of motion lead to."""
    shapes = np.concatenate([fine.vertices[None], shapes])
    found = [_coarsen(fine, target, shapes, weight) for weight in MOTION_WEIGHTS]
    fewest = min((coarsening.specks, coarsening.folds) for coarsening in found)
    found = [coarsening for coarsening in found if (coarsening.specks, coarsening.folds) == fewest]
    most = max(coarsening.shrinkage for coarsening in found)
    return next(coarsening for coarsening in found if coarsening.shrinkage >= NEARLY * most)


def _coarsen(fine: TriangleMesh, target: int, shapes: FloatArray, motion_weight: float) -> Coarsening:
    first = _decimated(fine, target, target, shapes, motion_weight)
    lost = target - first.count
    # What thin parts have lost is given to the rest of the mesh.
    return _result(_decimated(fine, target, target + lost, shapes, motion_weight) if lost > 0 else first, target)


def _decimated(fine: TriangleMesh, target: int, wanted: int, shapes: FloatArray, motion_weight: float) -> Decimation:
    """The mesh with ``wanted`` vertices left, less what thin parts then lose, and with ``target`` at most."""
    edge = np.sqrt(2 / np.sqrt(3) * fine.area / target)
    # A closed surface has about twice as many faces as vertices, and others hardly fewer.
    mean_areas = face_areas(shapes, fine.faces).sum(axis=1) / (2 * target)
    decimation = Decimation(fine.connectivity, shapes, mean_areas, SMALL * edge, motion_weight)
    sines = np.sin(np.deg2rad(ANGLE_LIMITS))
    spare = int((1 + HEALING_SHARE) * wanted)
    if any(decimation.run(spare, sine) for sine in sines):
        for sine in sines[:0:-1]:  # the worst first
            decimation.heal(wanted, sine)
        any(decimation.run(wanted, sine) for sine in sines)
        decimation.heal(wanted, sines[-1])
        decimation.heal(int(LEAST_SHARE * target), sines[-1], folds=False)
        any(decimation.run(target, sine) for sine in sines)
    return decimation


def _result(decimation: Decimation, target: int) -> Coarsening:
    """What a decimation has led to."""
    fine_index, local = np.unique(list(decimation.faces.values()), return_inverse=True)
    connectivity = Connectivity(local.reshape(-1, 3), len(fine_index))
    faces = connectivity.faces
    triangles = decimation.triangles(fine_index[faces])
    areas = (triangles.areas * decimation.mean_areas).clip(1e-300)
    shrinkage = float(np.exp((np.log(areas) - np.log(areas).mean(axis=1, keepdims=True)).min()))
    specks = int((triangles.sizes < 1).any(axis=1).sum())
    return Coarsening(
        fine_index,
        faces,
        float(np.arcsin(min(np.sqrt(triangles.sines.min()), 1.0))),
        len(folded_pairs(connectivity, triangles.normals)),
        shrinkage,
        float((areas / areas.mean(axis=0)).min()),
        specks,
        _reason(len(fine_index), target, specks),
    )


def _reason(count: int, target: int, specks: int) -> str:
    """What isn't as it was asked for, and why."""
    parts = []
    if count > target:
        parts.append(
            f"{count} vertices instead of {target}: any other collapse would change the topology, or leave a sliver or "
            "a fold in some shape"
        )
    elif count < target:
        parts.append(
            f"{count} vertices instead of {target}: thin parts that could only be had with slivers are left to the "
            "fine mesh"
        )
    if specks:
        parts.append(f"{specks} faces have next to no area or height in some shape, and no collapse or flip mends that")
    return "; ".join(parts)
