"""The least squares that a reconstruction minimises, ``‖z(X) − z*‖²`` in a weighted norm, and its derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from shapespace.arrays import FloatArray, IntArray
from shapespace.coordinates import compiled
from shapespace.coordinates.normal_matrix import NormalMatrix
from shapespace.coordinates.nric import HingeGeometry, NRICGradients, NRICJacobian, WeightedNorm
from shapespace.mesh.triangle_mesh import Connectivity


@dataclass(frozen=True)
class LeastSquaresPoint:
    """A shape, and how far it is from what is asked for.

    Attributes:
        vertices: (V, 3).
        misfit: (2E,) ``z(X) − z*``, angles modulo 2π.
        energy: its squared norm.
    """

    vertices: FloatArray
    misfit: FloatArray
    energy: float

    def forces(self) -> FloatArray:
        """The negative gradient (V, 3) of half the energy."""
        raise NotImplementedError

    def entries(self) -> FloatArray:
        """Entries of the normal matrix ``JᵀWJ + εI``, on its pattern."""
        raise NotImplementedError


class LeastSquares:
    """Shapes of one connectivity beside what is asked for, by NumPy.

    Args:
        connectivity: of the shapes.
        norm: of the misfit.
        matrix: has the normal matrix's pattern.
    """

    def __init__(self, connectivity: Connectivity, norm: WeightedNorm, matrix: NormalMatrix) -> None:
        self.connectivity, self.norm, self.matrix = connectivity, norm, matrix
        self.jacobian = NRICJacobian(connectivity)

    @np.errstate(divide="ignore", over="ignore", invalid="ignore")
    def __call__(self, vertices: FloatArray, target: FloatArray) -> LeastSquaresPoint:
        """A shape (V, 3) beside z* (2E,)."""
        geometry = HingeGeometry(vertices, self.connectivity)
        misfit = geometry.nric()
        misfit -= target
        half = len(misfit) // 2
        # As `wrap`, in place and ten times faster; half a turn counts the same either way round.
        misfit[half:] -= 2 * np.pi * np.rint(misfit[half:] / (2 * np.pi))
        return _NumPyPoint(vertices, misfit, float(self.norm.square(misfit)), self, geometry)


@dataclass(frozen=True)
class _NumPyPoint(LeastSquaresPoint):
    squares: LeastSquares
    geometry: HingeGeometry

    @cached_property
    def gradients(self) -> NRICGradients:
        """The derivatives, which the last shape doesn't need."""
        return self.geometry.gradients()

    def forces(self) -> FloatArray:
        """See LeastSquaresPoint."""
        return -self.squares.jacobian.pull_back(self.gradients, self.squares.norm.squared * self.misfit)

    def entries(self) -> FloatArray:
        """See LeastSquaresPoint."""
        return self.squares.matrix.entries(self.gradients, self.squares.norm)


class CompiledLeastSquares(LeastSquares):
    """The same in compiled loops."""

    def __call__(self, vertices: FloatArray, target: FloatArray) -> LeastSquaresPoint:
        """See LeastSquares."""
        c, vertices = self.connectivity, np.ascontiguousarray(vertices, np.float64)
        target = np.ascontiguousarray(target, np.float64)
        misfit, energy = compiled.misfit(vertices, c.edges, c.hinges, c.hinge_edges, target, self.norm.squared)
        return _CompiledPoint(vertices, misfit, energy, self)

    @cached_property
    def slots(self) -> tuple[IntArray, IntArray]:
        """Where the products of derivatives of each length (E, 21) and of each angle (H, 78) go."""
        of_lengths, of_angles = self.matrix.slots_of_norms
        return np.ascontiguousarray(of_lengths.T, np.int32), np.ascontiguousarray(of_angles.T, np.int32)


@dataclass(frozen=True)
class _CompiledPoint(LeastSquaresPoint):
    squares: CompiledLeastSquares

    @cached_property
    def gradients(self) -> tuple[FloatArray, FloatArray]:
        """See `compiled.gradients`."""
        c = self.squares.connectivity
        found: tuple[FloatArray, FloatArray] = compiled.gradients(self.vertices, c.edges, c.hinges)
        return found

    def forces(self) -> FloatArray:
        """See LeastSquaresPoint."""
        c, weighted = self.squares.connectivity, -self.squares.norm.squared * self.misfit
        forces: FloatArray = compiled.pull_back(
            *self.gradients, c.edges, c.hinges, c.hinge_edges, c.vertex_count, weighted
        )
        return forces

    def entries(self) -> FloatArray:
        """See LeastSquaresPoint."""
        squares = self.squares
        hinge_edges, size = squares.connectivity.hinge_edges, len(squares.matrix.pattern)
        return squares.matrix.regularised(
            compiled.normal_entries(*self.gradients, hinge_edges, squares.norm.squared, *squares.slots, size)
        )
