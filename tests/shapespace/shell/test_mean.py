"""Means: forces balance there, and shapes without a mean are reported."""

import numpy as np
import pytest

from shapespace.shell.mean import _MeanEnergy, centre_of_mass, elastic_mean
from shapespace.shell.space import ShellSpace
from shapespace.solve.outcome import Status
from tests.shapespace.conftest import MESHES


def assert_forces_balance(space, shapes, weights, vertices):
    point = space.point(vertices)
    pulls = [point.pull_back(p) for p in space.energy.rest(space.nric(shapes)).gradient_deformed(point.z)]
    assert np.abs(np.tensordot(weights, pulls, 1)).max() < 1e-6 * np.abs(pulls).max()


def test_forces_balance_at_the_elastic_mean(space, mesh, pose):
    shapes, weights = np.stack([mesh.vertices, pose]), np.array([1.0, 2.0])
    found = elastic_mean(space, shapes, weights)
    assert found.status is Status.CONVERGED
    assert_forces_balance(space, shapes, weights, found.vertices)


@pytest.mark.parametrize(("name", "seed", "size"), [("sheet", 1, 0.25), ("closed", 3, 0.35), ("torus", 2, 0.35)])
def test_faces_that_differ_much_between_shapes_have_a_mean(name, seed, size):
    """Quasi-Newton steps stall: their metric belongs to one shape, but faces differ much between shapes."""
    mesh = MESHES[name]()
    edge = np.linalg.norm(mesh.vertices[mesh.edges[:, 0]] - mesh.vertices[mesh.edges[:, 1]], axis=1).mean()
    noise = np.random.default_rng(seed).standard_normal((5, *mesh.vertices.shape))
    shapes, space = mesh.vertices + size * edge * noise, ShellSpace(mesh)
    assert elastic_mean(space, shapes[:2]).status is Status.CONVERGED
    found = elastic_mean(space, shapes)
    assert found.status is Status.CONVERGED
    assert_forces_balance(space, shapes, np.ones(len(shapes)), found.vertices)


def test_the_first_guess_of_many_shapes_is_a_typical_one(space, mesh, pose, monkeypatch):
    shapes = mesh.vertices + np.array([-1.0, -0.9, 0.4, 0.5, 0.6, 0.9, 1.0])[:, None, None] * (pose - mesh.vertices)
    rest = space.energy.rest(space.nric(shapes))
    best = shapes[np.argmin([rest.value(space.point(x).z).sum() for x in shapes])]
    every, tried = elastic_mean(space, shapes), []
    value = _MeanEnergy.value
    monkeypatch.setattr(_MeanEnergy, "value", lambda energy, x: tried.append(x) or value(energy, x))
    monkeypatch.setattr("shapespace.shell.mean.CANDIDATES", 3)
    found = elastic_mean(space, shapes)
    assert any(np.array_equal(x, best) for x in tried[:3])
    assert not any(np.array_equal(x, shape) for x in tried[:3] for shape in shapes[:2])
    assert found.status is Status.CONVERGED
    np.testing.assert_allclose(found.vertices, every.vertices, atol=1e-7)


def test_without_a_mean_the_worst_face_is_named(space, mesh, pose):
    i, j, _ = mesh.faces[7]
    flat = pose.copy()
    flat[i] = flat[j]
    found = elastic_mean(space, np.stack([mesh.vertices, pose, flat]))
    assert found.status is not Status.CONVERGED
    assert found.reason
    assert found.worst is not None
    shape, face = found.worst
    assert shape == 2
    assert {i, j} <= set(mesh.faces[face])


@pytest.mark.parametrize("weights", [[0, 0], [1, -1], [1], [np.nan, 1], [np.inf, 1]])
def test_weights_that_make_no_mean_are_refused(space, mesh, pose, weights):
    for mean in (elastic_mean, centre_of_mass):
        with pytest.raises(ValueError, match="weights"):
            mean(space, [mesh.vertices, pose], weights)
        with pytest.raises(ValueError, match="no shapes"):
            mean(space, [])


def test_a_shape_that_is_not_finite_is_named(space, mesh, pose):
    broken = pose.copy()
    broken[-1, 0] = np.nan
    for mean in (elastic_mean, centre_of_mass):
        assert mean(space, [mesh.vertices, pose, broken]).reason == "shape 2 has a coordinate that is not finite"
