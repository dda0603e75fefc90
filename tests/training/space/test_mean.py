"""The mean of a collection."""

from __future__ import annotations

import numpy as np
import pytest

from shapespace.mesh.rigid_motion import align, without_rigid_motion
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.shell.energy import Material
from shapespace.shell.exponential import exponential
from shapespace.shell.mean import centre_of_mass, elastic_mean
from shapespace.shell.space import ShellSpace
from shapespace.solve.outcome import Status
from shapespace.training.space.logarithms import logarithms
from shapespace.training.space.mean import centred_mean

STEPS = 4


@pytest.fixture(scope="module")
def reference(ellipsoid: TriangleMesh) -> TriangleMesh:
    return ellipsoid


@pytest.fixture(scope="module")
def shapes(reference: TriangleMesh) -> np.ndarray:
    """One large bend to one side, and smaller bends, most of them to the other side."""
    space, x = ShellSpace(reference), reference.vertices
    bend = without_rigid_motion(np.stack([0 * x[:, 0], 0 * x[:, 0], 0.25 * x[:, 0] ** 2], axis=1), x)
    return np.stack([exponential(space, x, t * bend, STEPS).vertices[-1] for t in (-1.2, -0.2, 0.1, 0.3, 0.4)])


def common(reference: TriangleMesh, mean: np.ndarray, shapes: np.ndarray) -> float:
    """Norm of the logarithms' mean, as a share of their root mean square norm."""
    fields = logarithms(ShellSpace(reference.with_vertices(mean)), mean, shapes, STEPS, workers=1).fields
    return float(np.linalg.norm(fields.mean(axis=0)) / np.sqrt((fields**2).sum(axis=(1, 2)).mean()))


def test_logarithms_have_next_to_nothing_in_common(reference, shapes):
    before = elastic_mean(ShellSpace(reference), shapes).vertices
    found = centred_mean(reference, shapes, Material(), STEPS, workers=1)
    assert found.status is Status.CONVERGED
    assert common(reference, before, shapes) > 0.01
    assert common(reference, found.vertices, shapes) < 0.2 * common(reference, before, shapes)


@pytest.mark.long
def test_with_more_steps_it_comes_to_the_centre_of_mass(reference, shapes):
    """Centred mean and discrete centre of mass differ to first order in the step."""
    space = ShellSpace(reference)

    def away(steps: int) -> float:
        centre = centre_of_mass(space, shapes, steps=steps).vertices
        found = centred_mean(reference, shapes, Material(), steps, workers=1).vertices
        return float(np.linalg.norm(align(found, centre) - centre))

    assert away(16) < 0.55 * away(8)


def test_no_mean_is_told_as_it_is(reference):
    flat = np.stack([reference.vertices, reference.vertices * [1, 1, 0]])
    found = centred_mean(reference, flat, Material(), STEPS, workers=1)
    assert found.status is not Status.CONVERGED
    assert found.reason
