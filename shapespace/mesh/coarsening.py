"""Choose a coarse connectivity for all shapes of a collection: how far to decimate, and which result to take."""

from dataclasses import dataclass, replace

import numpy as np

from shapespace.arrays import FloatArray, IntArray, evenly_spaced
from shapespace.mesh.decimation import Decimation
from shapespace.mesh.thinning import thin
from shapespace.mesh.triangle_mesh import Connectivity, MeshError, TriangleMesh, face_areas
from shapespace.mesh.triangle_quality import folded_pairs

#: Smallest angles (degrees) that an edge collapse may leave in any shape. The first limit holds until no collapse meets
#: it, then the next. Stricter limits cost accuracy, because expensive collapses are then made before cheap ones.
ANGLE_LIMITS = (10.0, 6.0, 3.0, 1.5)
#: In crumpled places edges below this length may collapse (see ``Decimation``), in mean edges of the coarse mesh.
SMALL_EDGE = 1.0
#: Share of the vertices reserved for removing slivers and folds of the fine mesh.
HEALING_SHARE = 0.1
#: At least this share of the target number of vertices stays, however many are removed because of slivers.
LEAST_SHARE = 0.5
#: Weights of motion (see ``Decimation``) that are tried. A large weight gives uniform triangles, which networks learn
#: better, but may leave tiny faces, where geodesics fail.
MOTION_WEIGHTS = (1.0, 0.1, 0.01)
#: Among the meshes with the fewest specks and folds, the first one is taken whose smallest face has at least this
#: share of the area of the smallest face in the best of them.
NEARLY_BEST = 0.9
#: Most vertices of all shapes together that collapses are checked against, since each takes about 150 bytes.
MOST_CHECKED = 4_000_000


@dataclass(frozen=True)
class Thinning:
    """When and how far a large mesh is thinned before it is decimated: one collapse after the other takes too long."""

    vertices: int = 20_000  # a mesh is thinned if it has more vertices than this
    ratio: int = 20  # and than this multiple of the target
    left: int = 5000  # number of vertices afterwards
    left_ratio: int = 8  # or this multiple of the target, if that is more
    shapes: int = 4  # number of shapes, evenly spaced in the collection, that thinning takes into account


THINNING = Thinning()


@dataclass(frozen=True)
class Coarsening:
    """A coarse connectivity on a subset of the fine vertices."""

    fine_index: IntArray  # (V,) fine vertex of each coarse vertex, increasing
    faces: IntArray  # (F, 3) in coarse indices
    smallest_angle: float  # smallest angle of all faces in all shapes, in radians
    folds: int  # number of pairs of neighbouring faces that are folded onto one another in some shape
    shrinkage: float  # smallest area of a face in a shape, as a share of the face's geometric mean over all shapes
    # smallest area of a face in a shape, as a share of the mean over the faces of this shape
    smallest_area: float = 1.0
    specks: int = 0  # number of faces with too small an area or angle in some shape (``triangle_quality``)
    reason: str = ""  # why the number of vertices differs from the target, or why there are specks; may be empty


def coarsen(fine: TriangleMesh, target: int, shapes: FloatArray) -> Coarsening:
    """Remove vertices of a reference until ``target`` are left, the same for all shapes (n, Vf, 3), n ≥ 0.

    Half-edge collapses u → v (Garland and Heckbert 1997, Hoppe 1996) attach the faces of u to v. So every coarse vertex
    is a fine vertex, and the coarse faces have a position in every shape. The cheapest collapse is made first. Its cost
    is the sum of the quadrics of several shapes, so that bent poses count too.

    A collapse is refused if it changes the topology (link condition; boundary loops stay). It is also refused if it
    leaves one of these faults in the reference or in any shape, unless the place had a worse one before:

    - a sliver; this limit is relaxed once no other collapse is left,
    - a face that is turned over, or two neighbours folded onto one another,
    - a speck: a face whose area is tiny relative to the other faces, or relative to its own area in the other shapes.

    Collapses and edge flips remove slivers, folds and specks of the fine mesh where they reduce their number over all
    shapes. At the end, thin parts that would need slivers or specks lose vertices; the fine mesh still shows them. The
    result says what remains.

    Each collapse takes a fraction of a millisecond. A large mesh is therefore thinned first, by many collapses at once,
    in time about linear in its number of vertices. Thinning takes only a few shapes into account. Of a large collection
    (`MOST_CHECKED`), evenly spaced shapes stand for all, also in the result. Raises MeshError if the shapes have
    another number of vertices, or coordinates that are not finite.
    """
    shapes = np.asarray(shapes, dtype=np.float64)
    if shapes.ndim != 3 or shapes.shape[1:] != fine.vertices.shape:
        raise MeshError(f"shapes must be (n, {len(fine.vertices)}, 3), not {shapes.shape}")
    bad = [k for k, shape in enumerate(shapes) if not np.isfinite(shape).all()]
    if bad:
        raise MeshError(f"shape {bad[0]} has a coordinate that is not finite")
    if len(fine.vertices) <= max(THINNING.vertices, THINNING.ratio * target):
        return _best(fine, target, shapes)
    few = np.stack([fine.vertices, *(shapes[k] for k in evenly_spaced(len(shapes), THINNING.shapes))])
    kept, faces = thin(fine.connectivity, few, max(THINNING.left, THINNING.left_ratio * target))
    found = _best(TriangleMesh.from_arrays(fine.vertices[kept], faces), target, shapes[:, kept])
    return replace(found, fine_index=kept[found.fine_index])


def _best(fine: TriangleMesh, target: int, shapes: FloatArray) -> Coarsening:
    if len(shapes) * len(fine.vertices) > MOST_CHECKED:
        shapes = shapes[evenly_spaced(len(shapes), MOST_CHECKED // len(fine.vertices))]
    shapes = np.concatenate([fine.vertices[None], shapes])
    found = [_coarsen(fine, target, shapes, weight) for weight in MOTION_WEIGHTS]
    fewest = min((coarsening.specks, coarsening.folds) for coarsening in found)
    found = [coarsening for coarsening in found if (coarsening.specks, coarsening.folds) == fewest]
    most = max(coarsening.shrinkage for coarsening in found)
    return next(coarsening for coarsening in found if coarsening.shrinkage >= NEARLY_BEST * most)


def _coarsen(fine: TriangleMesh, target: int, shapes: FloatArray, motion_weight: float) -> Coarsening:
    first = _decimated(fine, target, target, shapes, motion_weight)
    lost = target - first.count
    # Give the vertices that thin parts have lost to the rest of the mesh.
    return _result(_decimated(fine, target, target + lost, shapes, motion_weight) if lost > 0 else first, target)


def _decimated(fine: TriangleMesh, target: int, wanted: int, shapes: FloatArray, motion_weight: float) -> Decimation:
    """Decimate to ``wanted`` vertices and heal; thin parts then lose vertices, and at most ``target`` are left."""
    edge = np.sqrt(2 / np.sqrt(3) * fine.area / target)
    # A closed surface has about twice as many faces as vertices, and other surfaces slightly fewer.
    # One shape at a time, as all faces of all shapes would take more memory than anything else.
    mean_areas = np.array([face_areas(shape, fine.faces).sum() for shape in shapes]) / (2 * target)
    decimation = Decimation(fine.connectivity, shapes, mean_areas, SMALL_EDGE * edge, motion_weight)
    sines = np.sin(np.deg2rad(ANGLE_LIMITS))
    spare = int((1 + HEALING_SHARE) * wanted)
    if any(decimation.run(spare, sine) for sine in sines):
        for sine in sines[:0:-1]:  # the worst slivers first
            decimation.heal(wanted, sine)
        any(decimation.run(wanted, sine) for sine in sines)
        decimation.heal(wanted, sines[-1])
        decimation.heal(int(LEAST_SHARE * target), sines[-1], folds=False)
        any(decimation.run(target, sine) for sine in sines)
    return decimation


def _result(decimation: Decimation, target: int) -> Coarsening:
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
    parts = []
    if count != target:
        why = "thin parts are only in the fine mesh, because the coarse mesh would need slivers for them"
        if count > target:
            why = "any other collapse would change the topology, or leave a sliver or a fold in some shape"
        parts.append(f"{count} vertices instead of {target}: {why}")
    if specks:
        parts.append(
            f"{specks} faces have almost no area or height in some shape, and simplification can't correct that"
        )
    return "; ".join(parts)
