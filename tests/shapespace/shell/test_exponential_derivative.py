"""The derivative of the exponential map, compared with central differences."""

import numpy as np
import pytest

from shapespace.mesh.rigid_motion import align, without_rigid_motion
from shapespace.shell.energy import Material
from shapespace.shell.exponential import exponential
from shapespace.shell.exponential_derivative import ExponentialDerivative
from shapespace.shell.space import DiscretePath, ShellSpace
from shapespace.solve.outcome import Status

STEPS = 5


@pytest.fixture(params=["centred", "paper"])
def space(request, mesh) -> ShellSpace:
    return ShellSpace(mesh, Material(eta=1e-3), first_step=request.param)


@pytest.fixture
def path(space, mesh, velocity) -> DiscretePath:
    path = exponential(space, mesh.vertices, velocity, STEPS, tolerance=1e-12)
    assert path.converged
    return path


@pytest.fixture
def directions(mesh, velocity, rng):
    rough = np.abs(velocity).max() * rng.standard_normal((2, *velocity.shape))
    return without_rigid_motion(np.concatenate([0.1 * rough, velocity[None]]), mesh.vertices)


def test_it_is_the_limit_of_central_differences(space, mesh, velocity, path, directions):
    end, h = path.vertices[-1], 1e-4

    def last(v):
        return align(exponential(space, mesh.vertices, v, STEPS, tolerance=1e-12).vertices[-1], end)

    differences = np.stack([last(velocity + h * d) - last(velocity - h * d) for d in directions]) / (2 * h)
    found = ExponentialDerivative(path).push_forward(directions)
    np.testing.assert_allclose(found, differences, rtol=0, atol=1e-6 * np.abs(differences).max())


def test_pulling_back_is_the_transpose_of_pushing_forward(path, directions, rng):
    derivative = ExponentialDerivative(path)
    gradients = rng.standard_normal((4, *directions.shape[1:]))
    there = np.einsum("ivc,jvc->ij", derivative.push_forward(directions), gradients)
    here = np.einsum("ivc,jvc->ij", directions, derivative.pull_back(gradients))
    np.testing.assert_allclose(here, there, rtol=0, atol=1e-10 * np.abs(there).max())


def test_at_rest_and_after_one_step_it_is_the_identity(space, mesh, velocity, directions):
    still = ExponentialDerivative(exponential(space, mesh.vertices, 0 * velocity, STEPS))
    np.testing.assert_allclose(still.push_forward(directions), directions, atol=1e-6 * np.abs(directions).max())
    once = ExponentialDerivative(exponential(space, mesh.vertices, 1e-9 * velocity, 1))
    np.testing.assert_allclose(once.push_forward(directions), directions, atol=1e-7 * np.abs(directions).max())


def test_rigid_motions_have_no_part_in_it(path, mesh, rng):
    turn = np.cross(rng.standard_normal(3), mesh.vertices) + rng.standard_normal(3)
    found = ExponentialDerivative(path).push_forward(turn[None])
    assert np.abs(found).max() < 1e-9 * np.abs(turn).max()


def test_a_path_that_ended_early_has_none(space, mesh):
    broken = DiscretePath(
        vertices=mesh.vertices[None],
        space=space,
        status=Status.STALLED,
        iterations=0,
        residual=np.inf,
        reason="a face collapsed",
    )
    with pytest.raises(ValueError, match="a face collapsed"):
        ExponentialDerivative(broken)
