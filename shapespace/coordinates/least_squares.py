"""The least-squares objective of a reconstruction, ``‖z(X) − z*‖²`` in a weighted norm, and its derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from shapespace.arrays import FloatArray
from shapespace.coordinates.normal_matrix import NormalMatrix
from shapespace.coordinates.nric import HingeGeometry, NRICGradients, NRICJacobian, WeightedNorm
from shapespace.mesh.triangle_mesh import Connectivity


class LeastSquares:
    """The misfit between shapes of one connectivity and a target."""

    def __init__(self, connectivity: Connectivity, norm: WeightedNorm, matrix: NormalMatrix) -> None:
        self.connectivity, self.norm, self.matrix = connectivity, norm, matrix
        self.jacobian = NRICJacobian(connectivity)

    @np.errstate(divide="ignore", over="ignore", invalid="ignore")
    def __call__(self, vertices: FloatArray, target: FloatArray) -> LeastSquaresPoint:
        """Compare a shape (V, 3) with a target z* (2E,)."""
        geometry = HingeGeometry(vertices, self.connectivity)
        misfit = geometry.nric()
        misfit -= target
        half = len(misfit) // 2
        # Like `wrap`, but in place and ten times faster. The sign of half a turn doesn't change its square.
        misfit[half:] -= 2 * np.pi * np.rint(misfit[half:] / (2 * np.pi))
        return LeastSquaresPoint(vertices, misfit, float(self.norm.square(misfit)), self, geometry)


@dataclass(frozen=True)
class LeastSquaresPoint:
    """A shape and its misfit."""

    vertices: FloatArray  # (V, 3)
    misfit: FloatArray  # (2E,) ``z(X) − z*``, angles modulo 2π
    energy: float  # squared norm of the misfit
    squares: LeastSquares  # the objective
    geometry: HingeGeometry  # edge vectors and normals of the shape

    @cached_property
    def gradients(self) -> NRICGradients:
        """Derivatives of the lengths and angles, computed on demand: the last shape doesn't need them."""
        return self.geometry.gradients()

    def forces(self) -> FloatArray:
        """Negative gradient (V, 3) of half the energy."""
        return -self.squares.jacobian.pull_back(self.gradients, self.squares.norm.squared * self.misfit)

    def entries(self) -> FloatArray:
        """Entries of the normal matrix ``JᵀWJ + εI``, on its pattern."""
        return self.squares.matrix.entries(self.gradients, self.squares.norm)
