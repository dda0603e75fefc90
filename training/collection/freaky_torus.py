"""Freaky Torus: the paper's synthetic collection, a product S¹ × S¹ × T² by design (paper, appendix A)."""

from __future__ import annotations

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.coordinates.nric import nric, unwrap
from shapespace.mesh.triangle_mesh import Connectivity, TriangleMesh
from shapespace.training.runs.latent_coordinates import Coordinates
from shapespace.training.runs.sampling import FeaturePositions, SampledShapes

U_COUNT, V_COUNT = 64, 32
MAJOR_RADIUS, MINOR_RADIUS = 0.375, 0.125
SEMI_AXES = (1.0, 0.5)
BUMP_HEIGHT, BUMP_WIDTH = 0.075, 0.05

FACTORS = {"latitudinal ellipse": [0], "longitudinal ellipse": [1], "bump": [2, 3]}
LATENTS = ("alpha", "beta", "gamma", "zeta")
PERIOD = 2 * np.pi


def connectivity() -> Connectivity:
    """The 64 × 32 grid on the torus: vertex (i, j) is 32 i + j, each quad split along (i, j) – (i+1, j+1)."""
    i, j = np.meshgrid(np.arange(U_COUNT), np.arange(V_COUNT), indexing="ij")

    def index(di: int, dj: int) -> np.ndarray:
        return ((i + di) % U_COUNT * V_COUNT + (j + dj) % V_COUNT).ravel()

    corner, right, up, across = index(0, 0), index(1, 0), index(0, 1), index(1, 1)
    return Connectivity(
        np.concatenate([np.stack([corner, right, across], 1), np.stack([corner, across, up], 1)]),
        U_COUNT * V_COUNT,
    )


def _ellipse(angle: FloatArray, t: FloatArray) -> tuple[FloatArray, ...]:
    """The warped ellipse τ(t) turned by half the angle, and its derivative: τ₁, τ₂, τ₁', τ₂'."""
    a, b = SEMI_AXES
    c, s = np.cos(angle / 2), np.sin(angle / 2)
    ct, st = np.cos(t - angle / 2), np.sin(t - angle / 2)
    return a * c * ct - b * s * st, a * s * ct + b * c * st, -a * c * st - b * s * ct, -a * s * st + b * c * ct


def _surface(alpha: FloatArray, beta: FloatArray, u: FloatArray, v: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Points f^{α,β}(u, v) and unit normals, each (…, 3)."""
    p1, p2, dp1, dp2 = (MAJOR_RADIUS * x for x in _ellipse(alpha, u))
    q1, q2, dq1, dq2 = (MINOR_RADIUS * x for x in _ellipse(beta, v))
    c, s = np.cos(u), np.sin(u)
    point = np.stack(np.broadcast_arrays(p1 + c * q1, p2 + s * q1, q2), axis=-1)
    by_u = np.stack(np.broadcast_arrays(dp1 - s * q1, dp2 + c * q1, 0.0 * q2), axis=-1)
    by_v = np.stack(np.broadcast_arrays(c * dq1, s * dq1, dq2), axis=-1)
    normal = np.cross(by_u, by_v)
    return point, normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def vertices(latents: FloatArray) -> FloatArray:
    """Shapes (n, V, 3) of codes (n, 4) = (α, β, γ, ζ) in radians: the map 𝓕 of the paper's appendix."""
    alpha, beta, gamma, zeta = np.moveaxis(np.asarray(latents, dtype=np.float64)[..., None], -2, 0)
    u = np.repeat(2 * np.pi * np.arange(U_COUNT) / U_COUNT, V_COUNT)
    v = np.tile(2 * np.pi * np.arange(V_COUNT) / V_COUNT, U_COUNT)
    points, _ = _surface(alpha, beta, u, v)
    centre, normal = _surface(alpha, beta, gamma, zeta)
    distance = np.linalg.norm(points - centre, axis=-1, keepdims=True)
    return points + BUMP_HEIGHT * np.exp(-((distance / BUMP_WIDTH) ** 2)) * normal


def reference() -> TriangleMesh:
    """The torus at α = β = γ = ζ = 0."""
    return TriangleMesh(vertices(np.zeros((1, 4)))[0], connectivity())


def edge_permutation(mesh: Connectivity, vertex_map: IntArray) -> IntArray:
    """(E,) image of each edge under an automorphism of the connectivity given on its vertices."""
    image = np.sort(vertex_map[mesh.edges], axis=1)
    key = mesh.edges[:, 0] * mesh.vertex_count + mesh.edges[:, 1]
    return np.searchsorted(key, image[:, 0] * mesh.vertex_count + image[:, 1])


class FreakyTorus:
    """The collection of `vertices`, normalised to a reference of unit area; see sampling.Collection."""

    factors = FACTORS
    latent_names = LATENTS
    coordinates = Coordinates(np.zeros(4), np.full(4, PERIOD), np.full(4, PERIOD))

    codes = np.empty((0, 4))

    def __init__(self) -> None:
        mesh = reference()
        self.scale = float(np.sqrt(mesh.area))
        self.reference = mesh.with_vertices(mesh.vertices / self.scale)

    @property
    def symmetries(self) -> list[IntArray]:
        """The half turn about the x-axis, which takes the shape of (α, β, γ, ζ) to that of (−α, −β, −γ, −ζ)."""
        i, j = np.divmod(np.arange(U_COUNT * V_COUNT), V_COUNT)
        turned = -i % U_COUNT * V_COUNT + -j % V_COUNT
        return [edge_permutation(self.reference.connectivity, turned)]

    @property
    def places(self) -> FeaturePositions:
        """What each code moves: the ellipses, which turn by half its angle, and the bump.

        Where all shapes move by some columns of the grid, α by twice their angle and γ by this angle, edges have the
        constants that they had: their row, and their direction in the grid.
        """
        counts = np.array([U_COUNT, V_COUNT])
        start, end = np.moveaxis(np.stack(np.divmod(self.reference.connectivity.edges, V_COUNT), axis=-1), 1, 0)
        step = (end - start + counts // 2) % counts - counts // 2
        surface = 2 * np.pi / counts * (start + step / 2)
        row = surface[:, 1, None] * [1, 2]
        return FeaturePositions(
            surface=surface,
            multiples=np.array([[2, 0], [0, 2], [1, 0], [0, 1]]),
            constants=np.concatenate([step == 0, np.cos(row), np.sin(row)], axis=1),
        )

    @property
    def steps(self) -> None:
        """None: a formula has no steps."""
        return None

    @property
    def finer(self) -> None:
        """None, likewise."""
        return None

    @property
    def differentiated(self) -> None:
        """None: the convolutions that this collection needs do not learn from derivatives."""
        return None

    def shapes(self, latents: FloatArray) -> SampledShapes:
        """Shapes of codes (n, 4), angles as near as they can be to the reference's; the formula never fails."""
        mesh, points = self.reference, vertices(latents) / self.scale
        z = unwrap(nric(points, mesh.connectivity), nric(mesh.vertices, mesh.connectivity))
        return SampledShapes(points, z, [""] * len(latents))
