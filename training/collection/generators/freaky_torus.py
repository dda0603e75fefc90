"""Freaky Torus: the paper's synthetic collection, a product S¹ × S¹ × T² by design (paper, appendix A)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.coordinates.nric import nric, unwrap
from shapespace.mesh.triangle_mesh import Connectivity, TriangleMesh
from shapespace.shell.space import FirstStep
from shapespace.training.runs.latent_coordinates import Coordinates
from shapespace.training.runs.sampling import FeaturePositions, SampledShapes


@dataclass(frozen=True)
class TorusForm:
    """Grid and sizes of the torus; the defaults are from the paper's appendix A, lengths without a unit."""

    columns: int = 64  # number of vertices around the axis, along u
    rows: int = 32  # number of vertices around the ring, along v
    major_radius: float = 0.375  # size of the ellipse around the axis
    minor_radius: float = 0.125  # size of the ellipse around the ring
    semi_axes: tuple[float, float] = (1.0, 0.5)  # semi-axes of both ellipses, as multiples of their sizes
    bump_height: float = 0.075  # height of the bump over the surface
    bump_width: float = 0.05  # distance at which the bump has fallen to 1/e


PAPER = TorusForm()
#: Latent indices of each factor.
FACTORS = {"latitudinal ellipse": [0], "longitudinal ellipse": [1], "bump": [2, 3]}
LATENTS = ("alpha", "beta", "gamma", "zeta")
#: Period of every latent, in radians.
PERIOD = 2 * np.pi


def connectivity() -> Connectivity:
    """Return the 64 × 32 grid on the torus: vertex (i, j) is 32 i + j, each quad split along (i, j) – (i+1, j+1)."""
    columns, rows = PAPER.columns, PAPER.rows
    i, j = np.meshgrid(np.arange(columns), np.arange(rows), indexing="ij")

    def index(di: int, dj: int) -> np.ndarray:
        return ((i + di) % columns * rows + (j + dj) % rows).ravel()

    corner, right, up, across = index(0, 0), index(1, 0), index(0, 1), index(1, 1)
    return Connectivity(
        np.concatenate([np.stack([corner, right, across], 1), np.stack([corner, across, up], 1)]), columns * rows
    )


def _ellipse(angle: FloatArray, t: FloatArray, semi_axes: tuple[float, float]) -> tuple[FloatArray, ...]:
    """Return the warped ellipse τ(t) turned by half the angle, and its derivative: τ₁, τ₂, τ₁', τ₂'."""
    a, b = semi_axes
    c, s = np.cos(angle / 2), np.sin(angle / 2)
    ct, st = np.cos(t - angle / 2), np.sin(t - angle / 2)
    return a * c * ct - b * s * st, a * s * ct + b * c * st, -a * c * st - b * s * ct, -a * s * st + b * c * ct


def _surface(
    form: TorusForm, alpha: FloatArray, beta: FloatArray, u: FloatArray, v: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return points f^{α,β}(u, v) and unit normals, each (…, 3)."""
    p1, p2, dp1, dp2 = (form.major_radius * x for x in _ellipse(alpha, u, form.semi_axes))
    q1, q2, dq1, dq2 = (form.minor_radius * x for x in _ellipse(beta, v, form.semi_axes))
    c, s = np.cos(u), np.sin(u)
    point = np.stack(np.broadcast_arrays(p1 + c * q1, p2 + s * q1, q2), axis=-1)
    by_u = np.stack(np.broadcast_arrays(dp1 - s * q1, dp2 + c * q1, 0.0 * q2), axis=-1)
    by_v = np.stack(np.broadcast_arrays(c * dq1, s * dq1, dq2), axis=-1)
    normal = np.cross(by_u, by_v)
    return point, normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def vertices(latents: FloatArray, form: TorusForm = PAPER) -> FloatArray:
    """Return shapes (n, V, 3) for codes (n, 4) = (α, β, γ, ζ) in radians: the map 𝓕 of the paper's appendix."""
    alpha, beta, gamma, zeta = np.moveaxis(np.asarray(latents, dtype=np.float64)[..., None], -2, 0)
    u = np.repeat(2 * np.pi * np.arange(form.columns) / form.columns, form.rows)
    v = np.tile(2 * np.pi * np.arange(form.rows) / form.rows, form.columns)
    points, _ = _surface(form, alpha, beta, u, v)
    centre, normal = _surface(form, alpha, beta, gamma, zeta)
    distance = np.linalg.norm(points - centre, axis=-1, keepdims=True)
    return points + form.bump_height * np.exp(-((distance / form.bump_width) ** 2)) * normal


def reference() -> TriangleMesh:
    """Return the torus at α = β = γ = ζ = 0."""
    return TriangleMesh(vertices(np.zeros((1, 4)))[0], connectivity())


def edge_permutation(mesh: Connectivity, vertex_map: IntArray) -> IntArray:
    """Return the image (E,) of each edge under an automorphism of the connectivity, given on vertices (V,)."""
    image = np.sort(vertex_map[mesh.edges], axis=1)
    key = mesh.edges[:, 0] * mesh.vertex_count + mesh.edges[:, 1]
    return np.searchsorted(key, image[:, 0] * mesh.vertex_count + image[:, 1])


class FreakyTorus:
    """The collection of `vertices`, normalised to a reference of unit area; see `sampling.Collection`."""

    factors = FACTORS
    latent_names = LATENTS
    coordinates = Coordinates(np.zeros(4), np.full(4, PERIOD), np.full(4, PERIOD))
    codes = np.empty((0, 4))
    #: A formula has no steps and is exact, and the convolutions for this collection don't learn from derivatives.
    steps = limit = differentiated = None
    first_step: FirstStep = "paper"
    #: Sizes of the shapes; the reference always has the paper's.
    form = PAPER

    def __init__(self) -> None:
        mesh = reference()
        self.scale = float(np.sqrt(mesh.area))
        self.reference = mesh.with_vertices(mesh.vertices / self.scale)

    @property
    def symmetries(self) -> list[IntArray]:
        """The half turn about the x-axis, which maps the shape with code (α, β, γ, ζ) to the one with code negated."""
        columns, rows = PAPER.columns, PAPER.rows
        i, j = np.divmod(np.arange(columns * rows), rows)
        turned = -i % columns * rows + -j % rows
        return [edge_permutation(self.reference.connectivity, turned)]

    @property
    def places(self) -> FeaturePositions:
        """The features that codes move over the surface: both ellipses, each by half its angle, and the bump.

        Shift a shape by some columns of the grid: α changes by twice the angle of the shift, γ by the angle itself.
        The constants of an edge don't change. They are its row and its direction in the grid.
        """
        counts = np.array([PAPER.columns, PAPER.rows])
        start, end = np.moveaxis(np.stack(np.divmod(self.reference.connectivity.edges, PAPER.rows), axis=-1), 1, 0)
        step = (end - start + counts // 2) % counts - counts // 2
        surface = 2 * np.pi / counts * (start + step / 2)
        row = surface[:, 1, None] * [1, 2]
        return FeaturePositions(
            surface=surface,
            multiples=np.array([[2, 0], [0, 2], [1, 0], [0, 1]]),
            constants=np.concatenate([step == 0, np.cos(row), np.sin(row)], axis=1),
        )

    def shapes(self, latents: FloatArray) -> SampledShapes:
        """Return the shapes for codes (n, 4); each angle differs from the reference's by at most π. Never fails."""
        mesh, points = self.reference, vertices(latents, self.form) / self.scale
        z = unwrap(nric(points, mesh.connectivity), nric(mesh.vertices, mesh.connectivity))
        return SampledShapes(points, z, [""] * len(latents))
