"""Shapes from frames along a tree: exact for integrable z, and close for nearly integrable z."""

import numpy as np
import pytest

from shapespace.coordinates.frame_integration import FrameIntegration
from shapespace.coordinates.nric import nric
from shapespace.coordinates.reconstruction import Reconstructor
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.solve.outcome import Status
from tests.shapespace.conftest import bent, closed, sheet


@pytest.mark.parametrize("backend", ["banded", "pardiso"])
def test_integrable_lengths_and_angles_give_their_shape(mesh, pose, backend):
    found = FrameIntegration(mesh, backend)(nric(pose, mesh.connectivity))
    assert np.abs(align(found, pose) - pose).max() < 1e-6 * mesh.diagonal


def test_parts_that_hang_together_by_nothing_keep_their_places():
    ball, strip = closed(), sheet()
    both = TriangleMesh.from_arrays(
        np.concatenate([ball.vertices, strip.vertices + np.array([5, 1, 2])]),
        np.concatenate([ball.faces, strip.faces + len(ball.vertices)]),
    )
    found = FrameIntegration(both)(nric(both.vertices, both.connectivity))
    assert np.abs(found - both.vertices).max() < 1e-6 * both.diagonal


def test_small_errors_of_z_make_small_errors_of_the_shape(mesh, pose, rng):
    integrate, z = FrameIntegration(mesh), nric(pose, mesh.connectivity)
    noise = rng.standard_normal(len(z)) * np.where(np.arange(len(z)) < len(z) // 2, z, 1)
    errors = [np.abs(align(integrate(z + size * noise), pose) - pose).max() for size in (1e-4, 1e-5)]
    assert 0 < errors[0] < 0.01 * mesh.diagonal
    assert errors[1] == pytest.approx(errors[0] / 10, rel=0.1)


def test_frames_that_fit_at_every_hinge_come_nearer_than_those_of_a_tree(mesh, pose, rng):
    every, tree, reconstruct = FrameIntegration(mesh), FrameIntegration(mesh), Reconstructor(mesh)
    tree._others = tree._others[:0]
    z, away = nric(pose, mesh.connectivity), {every: [], tree: []}
    for _ in range(8):
        target = z * (1 + 1e-2 * rng.standard_normal(len(z)))
        solved = reconstruct(target).vertices
        for integrate, found in away.items():
            found.append(np.linalg.norm(align(integrate(target), solved) - solved, axis=1).mean())
    assert np.mean(away[every]) < 0.7 * np.mean(away[tree])


@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0, -1.0])
def test_what_is_no_shape_raises_nothing(mesh, value):
    z = nric(mesh.vertices, mesh.connectivity)
    z[: mesh.connectivity.edge_count] = value
    assert FrameIntegration(mesh)(z).shape == mesh.vertices.shape


def test_a_guess_from_frames_saves_steps(mesh, rng):
    reconstruct = Reconstructor(mesh)
    z = nric(bent(mesh.vertices, 1.3), mesh.connectivity)
    z *= 1 + 1e-3 * rng.standard_normal(len(z))
    far, near = reconstruct(z, tolerance=1e-5), reconstruct(z, reconstruct.guess(z), tolerance=1e-5)
    assert near.status is far.status is Status.CONVERGED
    assert near.iterations < far.iterations
    assert np.abs(align(near.vertices, far.vertices) - far.vertices).max() < 1e-4 * mesh.diagonal
    whole = reconstruct.from_guess(z, tolerance=1e-5)
    assert np.array_equal(whole.vertices, near.vertices)
    assert (whole.iterations, whole.residual) == (near.iterations, near.residual)


def test_where_frames_go_astray_the_nearest_start_is_taken(mesh, monkeypatch):
    reconstruct, c = Reconstructor(mesh), mesh.connectivity
    shape = bent(mesh.vertices, 0.5)
    z = nric(shape, c)
    asked = []

    def other(vertices):
        return lambda: asked.append(1) or vertices

    reconstruct.guess(z, other(mesh.vertices))
    assert not asked  # the frames were good
    for astray in (1.5 * mesh.vertices, np.full_like(shape, np.nan)):
        monkeypatch.setattr(reconstruct, "integrate", lambda z, astray=astray: astray)
        assert np.array_equal(reconstruct.guess(z), mesh.vertices)
        assert reconstruct.guess(z, other(shape)) is shape
        assert np.array_equal(reconstruct.guess(z, other(3 * shape), other(np.full_like(shape, np.nan))), mesh.vertices)
        whole, given = reconstruct.from_guess(z, other(shape)), reconstruct(z, shape)
        assert np.array_equal(whole.vertices, given.vertices)
        assert whole.residual == given.residual < 1e-8
    assert len(asked) == 8
