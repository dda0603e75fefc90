"""The mean of a collection."""

import numpy as np
import pytest

from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.shell.energy import Material
from shapespace.shell.mean import centre_of_mass, elastic_mean
from shapespace.shell.space import ShellSpace
from shapespace.solve.outcome import Status
from shapespace.training.space.logarithms import logarithms
from shapespace.training.space.mean import centred_mean
from tests.training.conftest import STEPS, bent


@pytest.fixture(scope="module")
def shapes(ellipsoid: TriangleMesh) -> np.ndarray:
    """One large bend to one side, and smaller bends, most of them to the other side."""
    return bent(ellipsoid, (-1.2, -0.2, 0.1, 0.3, 0.4))


def common(reference: TriangleMesh, mean: np.ndarray, shapes: np.ndarray) -> float:
    """Norm of the logarithms' mean, as a share of their root mean square norm."""
    fields = logarithms(ShellSpace(reference.with_vertices(mean)), mean, shapes, STEPS, workers=1).fields
    return float(np.linalg.norm(fields.mean(axis=0)) / np.sqrt((fields**2).sum(axis=(1, 2)).mean()))


def test_logarithms_have_next_to_nothing_in_common(ellipsoid, shapes):
    before = elastic_mean(ShellSpace(ellipsoid), shapes).vertices
    found = centred_mean(ellipsoid, shapes, Material(), STEPS, workers=1)
    assert found.status is Status.CONVERGED
    assert common(ellipsoid, before, shapes) > 0.01
    assert common(ellipsoid, found.vertices, shapes) < 0.2 * common(ellipsoid, before, shapes)


def test_with_more_steps_it_comes_to_the_centre_of_mass(ellipsoid, shapes):
    """Centred mean and discrete centre of mass differ to first order in the step."""
    space = ShellSpace(ellipsoid)

    def away(steps: int) -> float:
        centre = centre_of_mass(space, shapes, steps=steps).vertices
        found = centred_mean(ellipsoid, shapes, Material(), steps, workers=1).vertices
        return float(np.linalg.norm(align(found, centre) - centre))

    assert away(8) < 0.55 * away(4)


def test_no_mean_is_told_as_it_is(ellipsoid):
    flat = np.stack([ellipsoid.vertices, ellipsoid.vertices * [1, 1, 0]])
    found = centred_mean(ellipsoid, flat, Material(), STEPS, workers=1)
    assert found.status is not Status.CONVERGED
    assert found.reason
