"""Compiled loops beside the NumPy code that says what they compute."""

import numpy as np
import pytest

from shapespace.coordinates import compiled
from shapespace.coordinates.frame_integration import CompiledFrameIntegration, FrameIntegration
from shapespace.coordinates.integrability import Integrability
from shapespace.coordinates.least_squares import CompiledLeastSquares, LeastSquares
from shapespace.coordinates.normal_matrix import NormalMatrix
from shapespace.coordinates.nric import WeightedNorm, nric

# Without Numba the loops are plain Python: the same numbers, slowly.


@pytest.fixture
def asked(mesh, pose, rng):
    """Lengths and angles of no shape, some angles more than half a turn away."""
    z = nric(pose, mesh.connectivity)
    z *= 1 + 0.02 * rng.standard_normal(len(z))
    z[-20:] += 2 * np.pi * mesh.connectivity.interior[-20:]
    return z


def test_misfits_forces_and_normal_matrices_are_the_same(mesh, asked):
    norm, matrix = WeightedNorm.of(mesh, 1e-2), NormalMatrix(mesh.connectivity)
    one, other = (
        squares(mesh.connectivity, norm, matrix)(mesh.vertices, asked)
        for squares in (LeastSquares, CompiledLeastSquares)
    )
    np.testing.assert_allclose(other.misfit, one.misfit, rtol=0, atol=1e-12)
    assert other.energy == pytest.approx(one.energy, rel=1e-12)
    np.testing.assert_allclose(other.forces(), one.forces(), rtol=0, atol=1e-11 * np.abs(one.forces()).max())
    np.testing.assert_allclose(other.entries(), one.entries(), rtol=0, atol=1e-12 * np.abs(one.entries()).max())


def test_frames_are_the_same(mesh, asked):
    one, other = FrameIntegration(mesh)(asked), CompiledFrameIntegration(mesh)(asked)
    # The Poisson equation is anchored by a billionth only.
    np.testing.assert_allclose(other, one, rtol=0, atol=1e-6 * mesh.diagonal)


def test_closing_conditions_are_the_same(mesh, asked):
    one, other = (Integrability(mesh.connectivity, kernels).at_vertices(asked) for kernels in ("numpy", "compiled"))
    np.testing.assert_allclose(other, one, rtol=0, atol=1e-12)


@np.errstate(invalid="ignore")
def test_lengths_of_nothing_or_without_end_are_not_finite_and_raise_nothing(mesh, asked):
    squares = CompiledLeastSquares(mesh.connectivity, WeightedNorm.of(mesh, 1e-2), NormalMatrix(mesh.connectivity))
    assert not np.isfinite(squares(mesh.vertices, np.full_like(asked, np.inf)).energy)
    flat = squares(0 * mesh.vertices, asked)
    assert not np.isfinite(flat.forces()).all()
    assert not np.isfinite(flat.entries()).all()


def test_the_choice_is_made_by_what_is_installed():
    assert compiled.are_used("auto") is compiled.AVAILABLE
    assert compiled.are_used("compiled")
    assert not compiled.are_used("numpy")
