"""Soft fields: directions that cost little elastic energy. They stand beside the modes of a small collection.

A few shapes differ in few directions, and an unseen shape also moves in others. The elastic energy says which of these
are likely: on a thin shell, bending a limb costs little and stretching it costs much. Soft fields d_k are generalised
eigenvectors of the energy at the mean, ``½ Jᵀ Hess₂W J d = λ M d`` with M the areas of vertices, for the smallest λ,
without rigid motion. They are scaled by ``λ^(-1/2)``, as an elastic body moves by chance. Added to the covariance of
the shapes, they lead modes to directions that the data do not show (Cootes and Taylor, "Combining point distribution
models with shape models based on finite element analysis", 1995).
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import eigsh

from shapespace.arrays import FloatArray
from shapespace.coordinates.normal_matrix import QuadraticForm
from shapespace.mesh.triangle_mesh import vertex_areas
from shapespace.shell.space import ShellSpace

#: Number of soft fields.
SOFT = 60
#: Rigid motions of each separate part cost nothing: eigenvalues up to this share of the largest one are theirs.
RIGID, FREE = 6, 1e-9
#: Shift of the eigenvalues, as a share of the energy's mean diagonal, so that the energy can be factorised.
SHIFT = 1e-6
#: Modes take this share of the variance that the shapes leave to soft fields, so that the data's modes come first.
SOFT_SHARE = 0.1
#: Bounds of codes have room for this number of standard deviations of the remaining variance.
DEVIATIONS = 2 / np.sqrt(SOFT_SHARE)


@dataclass(frozen=True, eq=False)
class SoftFields:
    """Soft fields, and how much of the shapes' variance they add."""

    fields: FloatArray  # (p, V, 3)
    share: float  # of the sum of the shapes' squares, which the sum of the fields' squares is

    def scale(self, rows: FloatArray, soft: FloatArray) -> float:
        """Return the factor of the fields, from rows (n, q) of the shapes and (p, q) of the fields, in one norm."""
        return float(np.sqrt(self.share * (rows**2).sum() / (soft**2).sum()))


def soft_fields(space: ShellSpace, mean: FloatArray) -> FloatArray:
    """Return the `SOFT` softest fields (p, V, 3) at a mean (V, 3), the softest first, fewer on a small mesh."""
    point = space.point(mean)
    jacobian = space.jacobian.matrix(point.gradients)
    hessian = point.hessian
    metric = space.energy.matrix(QuadraticForm(hessian.faces / 2, hessian.angles / 2))
    stiffness = sparse.csc_array(jacobian.T @ metric @ jacobian)
    areas = vertex_areas(mean, space.connectivity.faces)
    mass = np.repeat(areas / areas.mean(), 3)
    edges = space.connectivity.edges
    links = sparse.coo_array((np.ones(len(edges)), edges.T), (len(mean), len(mean)))
    count = min(RIGID * connected_components(links, directed=False)[0] + SOFT, len(mass) - 2)
    shift = -SHIFT * float(stiffness.diagonal().mean())
    start = np.random.default_rng(0).standard_normal(len(mass))  # without it, each call has other signs
    values, vectors = eigsh(stiffness, count, sparse.diags_array(mass).tocsc(), sigma=shift, v0=start)
    order = np.argsort(values)
    order = order[values[order] > FREE * values.max()]
    fields: FloatArray = vectors[:, order].T / np.sqrt(values[order])[:, None]
    return fields.reshape(len(order), -1, 3)
