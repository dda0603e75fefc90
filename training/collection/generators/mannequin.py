"""The body of the figure: a solid given by formulas and meshed once, with equal left and right halves.

All lengths are in metres. The figure stands on y = 0 and looks along z; its left side is at x > 0.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial import Delaunay, cKDTree

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.mesh.vectors import unit


def _vector(x: float, y: float, z: float) -> FloatArray:
    return np.array([x, y, z], dtype=np.float64)


X, Y, Z = np.eye(3)
# Joints and directions of the left half at rest.
MIRROR = _vector(-1, 1, 1)
SHOULDER, ARM = _vector(0.168, 1.385, -0.014), unit(_vector(0.88, -1, 0))
ELBOW, WRIST = SHOULDER + 0.285 * ARM, SHOULDER + 0.53 * ARM
HIP, ANKLE = _vector(0.091, 0.91, 0), _vector(0.130, 0.075, -0.02)
LEG = unit(ANKLE - HIP)
KNEE = HIP + 0.44 * LEG
TOES = unit(_vector(0.16, 0, 1))


class _Tube:
    """A rounded solid about a straight axis. Splines interpolate its sections, each a half ellipse in front and behind.

    Args:
        origin: (3,) point of the axis with s = 0.
        axis: (3,) direction in which s grows.
        front: (3,) direction of depth; the width is perpendicular to axis and depth.
        caps: lengths of the half ellipsoids before the first section and after the last.
        rows: a section each: s, centre across, centre forward, half width, depth to the front, depth to the back.
    """

    def __init__(
        self,
        origin: FloatArray,
        axis: FloatArray,
        front: FloatArray,
        caps: tuple[float, float],
        *rows: tuple[float, float, float, float, float, float],
    ) -> None:
        s = unit(axis)
        v = unit(front - s * (front @ s))
        self.origin, self.frame, self.caps = origin, np.stack([s, np.cross(s, v), v]), caps
        table = np.array(rows)
        self.ends = rows[0][0], rows[-1][0]
        self.sections = CubicSpline(table[:, 0], table[:, 1:], bc_type="natural")

    def __call__(self, points: FloatArray) -> FloatArray:
        """Return distances (n,) from points (n, 3) to first order, negative inside."""
        s, u, v = self.frame @ (points - self.origin).T
        inner = np.clip(s, *self.ends)
        u0, v0, width, front, back = self.sections(inner).T
        q = np.stack([s - inner, u - u0, v - v0])
        r = np.stack([np.where(s < inner, *self.caps), width, np.where(v > v0, front, back)])
        rho = np.linalg.norm(q / r, axis=0)
        return rho * (rho - 1) / (np.linalg.norm(q / r**2, axis=0) + 1e-9)


def _ball(centre: FloatArray, width: float, height: float, depth: float) -> _Tube:
    section = (0.0, 0.0, width, depth, depth)
    return _Tube(centre, Y, Z, (height, height), (0.0, *section), (1e-6, *section))


def _join(f: FloatArray, g: FloatArray, blend: float) -> FloatArray:
    """Unite two solids given by distances; where these differ by less than ``blend``, the union is rounded (C²)."""
    return np.minimum(f, g) - np.maximum(blend - np.abs(f - g), 0) ** 3 / (6 * blend**2)


#: Solids of the left half, each with the width over which it blends into the solids before it.
SOLIDS: list[tuple[_Tube, float]] = [
    # Torso, by height.
    (_Tube(0 * Y, Y, Z, (0.05, 0.04),
        (0.87, 0, -0.012, 0.140, 0.078, 0.085),
        (0.93, 0, -0.008, 0.152, 0.090, 0.098),
        (1.00, 0, -0.002, 0.142, 0.092, 0.090),
        (1.08, 0, +0.004, 0.124, 0.088, 0.078),
        (1.17, 0, +0.002, 0.129, 0.095, 0.084),
        (1.26, 0, -0.004, 0.146, 0.105, 0.094),
        (1.34, 0, -0.014, 0.146, 0.091, 0.090),
        (1.41, 0, -0.026, 0.105, 0.063, 0.064),
    ), 0.01),
    # Buttock and breast.
    (_ball(_vector(0.076, 0.892, -0.056), 0.078, 0.085, 0.064), 0.07),
    (_ball(_vector(0.074, 1.285, 0.050), 0.082, 0.074, 0.035), 0.08),
    # From the neck to the shoulder.
    (_Tube(_vector(0, 1.455, -0.022), _vector(0.168, -0.06, 0.008), Z, (0.04, 0.04),
        (0.00, 0, 0, 0.045, 0.045, 0.045),
        (0.09, 0, 0, 0.038, 0.042, 0.045),
        (0.17, 0, 0, 0.040, 0.045, 0.045),
    ), 0.06),
    # Neck, skull and face.
    (_Tube(_vector(0, 1.40, -0.030), _vector(0, 1, 0.24), Z, (0.03, 0.03),
        (0.00, 0, 0, 0.066, 0.060, 0.062),
        (0.06, 0, 0, 0.053, 0.053, 0.055),
        (0.16, 0, 0, 0.050, 0.050, 0.052),
    ), 0.05),
    (_ball(_vector(0, 1.610, 0.006), 0.076, 0.094, 0.096), 0.03),
    (_Tube(_vector(0, 1.60, 0.036), _vector(0, -1, 0.16), Z, (0.05, 0.03),
        (0.00, 0, 0, 0.066, 0.060, 0.060),
        (0.05, 0, 0, 0.057, 0.052, 0.055),
        (0.09, 0, 0, 0.038, 0.042, 0.045),
    ), 0.04),
    # Arm, palm and thumb.
    (_Tube(SHOULDER, ARM, Z, (0.05, 0.03),
        (0.00, 0, 0.000, 0.049, 0.055, 0.056),
        (0.07, 0, 0.000, 0.053, 0.057, 0.057),
        (0.15, 0, 0.000, 0.043, 0.049, 0.050),
        (0.24, 0, 0.000, 0.037, 0.040, 0.041),
        (0.29, 0, 0.002, 0.037, 0.038, 0.039),
        (0.35, 0, 0.007, 0.039, 0.043, 0.041),
        (0.44, 0, 0.016, 0.030, 0.035, 0.034),
        (0.52, 0, 0.026, 0.021, 0.027, 0.027),
        (0.56, 0, 0.030, 0.018, 0.032, 0.032),
    ), 0.06),
    (_Tube(WRIST + 0.028 * Z, ARM + _vector(-0.10, 0, 0.10), Z, (0.03, 0.02),
        (0.000, +0.000, 0.000, 0.020, 0.027, 0.027),
        (0.045, +0.002, 0.000, 0.020, 0.040, 0.037),
        (0.090, +0.000, 0.000, 0.018, 0.042, 0.040),
        (0.130, -0.004, 0.000, 0.016, 0.037, 0.037),
        (0.165, -0.010, -0.002, 0.014, 0.027, 0.028),
    ), 0.02),
    (_Tube(WRIST + 0.02 * ARM + 0.042 * Z, ARM + _vector(-0.3, 0, 0.75), Z, (0.02, 0.014),
        (0.000, 0, 0, 0.0160, 0.0160, 0.020),
        (0.045, 0, 0, 0.0145, 0.0150, 0.015),
        (0.085, 0, 0, 0.0120, 0.0120, 0.012),
    ), 0.02),
    # Leg and foot.
    (_Tube(HIP, LEG, Z, (0.10, 0.03),
        (0.00, 0, 0.000, 0.0690, 0.080, 0.086),
        (0.12, 0, 0.006, 0.0720, 0.080, 0.082),
        (0.25, 0, 0.008, 0.0610, 0.070, 0.068),
        (0.38, 0, 0.004, 0.0490, 0.054, 0.053),
        (0.45, 0, 0.000, 0.0460, 0.053, 0.047),
        (0.53, 0, -0.006, 0.0480, 0.045, 0.056),
        (0.60, 0, -0.008, 0.0470, 0.042, 0.060),
        (0.70, 0, -0.006, 0.0350, 0.035, 0.043),
        (0.78, 0, -0.002, 0.0275, 0.031, 0.032),
        (0.84, 0, 0.000, 0.0300, 0.034, 0.035),
    ), 0.08),
    (_Tube(ANKLE * (1 - Y) - 0.03 * TOES, TOES, Y, (0.034, 0.028),
        (0.000, 0.000, 0.034, 0.031, 0.038, 0.034),
        (0.060, 0.000, 0.038, 0.033, 0.040, 0.036),
        (0.120, 0.000, 0.032, 0.041, 0.030, 0.031),
        (0.165, 0.000, 0.026, 0.045, 0.024, 0.026),
        (0.205, -0.004, 0.023, 0.038, 0.020, 0.023),
    ), 0.035),
]  # fmt: skip


def _distance(points: FloatArray) -> FloatArray:
    """Return distances (n,) from points (n, 3) to the surface, to first order, negative inside; symmetric in x."""
    x, y, z = points.T
    # A rounded |x|, which joins the halves smoothly.
    left = np.stack([np.hypot(x, 0.008), y, z], axis=1)
    f = np.full(len(points), np.inf)
    for solid, blend in SOLIDS:
        f = _join(f, solid(left), blend)
    return f


def _project(points: FloatArray, steps: int) -> FloatArray:
    """Move points (n, 3) onto the surface by Newton steps."""
    h = 1e-5
    for _ in range(steps):
        f = _distance(np.concatenate([points, *(points + h * e for e in np.eye(3))])).reshape(4, -1)
        gradient = (f[1:] - f[0]).T / h
        points = points - (f[0] / np.maximum((gradient**2).sum(axis=1), 0.05))[:, None] * gradient
    return points


#: Length of edges on the trunk in metres, which gives the figure about 4600 vertices.
EDGE = 0.0195
#: Steps in which springs move the vertices.
RELAXATIONS = 60


def _edge_length(points: FloatArray) -> FloatArray:
    """Wanted lengths (n,) of edges at points with x ≥ 0: shorter at hands, feet and head."""
    hand = np.where(points[:, 0] > 0.25, np.clip(((points - WRIST) @ ARM + 0.13) / 0.12, 0, 1), 0)
    foot = np.clip((0.22 - points[:, 1]) / 0.14, 0, 1)
    head = np.clip((points[:, 1] - 1.40) / 0.12, 0, 1)
    return EDGE * (1 - 0.5 * hand - 0.25 * foot - 0.25 * head)


def _scatter() -> tuple[FloatArray, int]:
    """Scatter points (n, 3) over the surface with x ≥ 0, nearly an edge apart; the first, counted, have x = 0."""
    cell = 0.03
    axes = [np.arange(a, b, cell) for a, b in ((0, 0.7), (-0.02, 1.75), (-0.2, 0.25))]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    grid = grid[np.abs(_distance(grid)) < cell]
    jitter = np.random.default_rng(0).uniform(-cell / 2, cell / 2, (12, *grid.shape))
    points = _project((grid + jitter).reshape(-1, 3), 2)
    points = points[points[:, 0] >= 0]
    middle = points[:, 0] < 0.45 * _edge_length(points)
    points = np.concatenate([points[middle] * (1 - X), points[~middle]])
    points = _project(points, 2)
    kept = np.ones(len(points), dtype=bool)
    for i, near in enumerate(cKDTree(points).query_ball_point(points, 0.8 * _edge_length(points))):
        if kept[i]:
            kept[near] = False
            kept[i] = True
    return points[kept], int(kept[: middle.sum()].sum())


def _both(left: FloatArray, middle: int) -> FloatArray:
    """Add the mirror images of all points but the first ``middle``, which lie in the plane x = 0."""
    return np.concatenate([left, left[middle:] * MIRROR])


def _triangulate(points: FloatArray) -> IntArray:
    """Return the faces (F, 3), seen from outside, of the restricted Delaunay triangulation of surface points (n, 3).

    A face separates a tetrahedron whose circumcentre is inside from one whose circumcentre is outside. If the points
    are dense on a smooth surface, the faces form a closed surface of the same topology (Amenta and Bern 1999).
    """
    corners = np.stack(np.meshgrid([-4, 4], [-4, 4], [-4, 4]), axis=-1).reshape(-1, 3)
    # Mirrored pairs of points lie on common circles. Noise gives them one triangulation and finite circumcentres.
    noisy = points + np.random.default_rng(0).uniform(-1e-6, 1e-6, points.shape)
    mesh = Delaunay(np.concatenate([noisy, corners]))
    tetrahedra = mesh.simplices
    p = mesh.points[tetrahedra]
    a, b, c = np.moveaxis(p[:, 1:] - p[:, :1], 1, 0)
    bc, ca, ab = np.cross(b, c), np.cross(c, a), np.cross(a, b)
    aa, bb, cc = ((e**2).sum(axis=1, keepdims=True) for e in (a, b, c))
    centres = p[:, 0] + (aa * bc + bb * ca + cc * ab) / (2 * (a * bc).sum(axis=1, keepdims=True))
    inside = np.zeros(len(tetrahedra), dtype=bool)
    near = np.abs(centres).max(axis=1) < 2
    inside[near] = _distance(centres[near]) < 0
    t, k = np.nonzero(inside[:, None] & ~inside[mesh.neighbors])
    faces = tetrahedra[t][np.arange(4) != k[:, None]].reshape(-1, 3)
    p, q, r = np.moveaxis(mesh.points[faces], 1, 0)
    inward = (np.cross(q - p, r - p) * (mesh.points[tetrahedra[t, k]] - p)).sum(axis=1) > 0
    faces[inward] = faces[inward, ::-1]
    return faces


@cache
def rest() -> TriangleMesh:
    """Mesh the figure at rest, arms half lowered: closed, of genus 0, vertices mirrored in the plane x = 0.

    Springs push neighbouring points apart until edges have the wanted lengths (Persson and Strang 2004).
    """
    left, middle = _scatter()
    triangulated = np.full((2 * len(left) - middle, 3), np.inf)
    for _ in range(RELAXATIONS):
        points = _both(left, middle)
        if np.abs(points - triangulated).max() > 0.2 * EDGE:
            triangulated = points
            faces = _triangulate(points)
            i, j = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0).T
        d = points[i] - points[j]
        length = np.linalg.norm(d, axis=1)
        wanted = _edge_length(np.abs(points[i] + points[j]) / 2)
        wanted *= 1.1 * np.sqrt((length**2).sum() / (wanted**2).sum())
        push = (0.2 * np.maximum(wanted / length - 1, 0))[:, None] * d
        step = np.stack([np.bincount(i, x, len(points)) - np.bincount(j, x, len(points)) for x in push.T], axis=1)
        left = _project(left + step[: len(left)], 1)
        left[:middle, 0] = 0
    left = _project(left, 3)
    left[:middle, 0] = 0
    points = _both(left, middle)
    return TriangleMesh.from_arrays(points, _triangulate(points))
