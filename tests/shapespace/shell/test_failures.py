"""For invalid input every operation returns a failed outcome with a reason."""

import numpy as np
import pytest

from shapespace.shell.exponential import exponential
from shapespace.shell.geodesic import geodesic, logarithm
from shapespace.shell.mean import centre_of_mass, elastic_mean
from shapespace.solve.outcome import Status

K = 4


@pytest.mark.parametrize("where", ["start", "velocity"])
def test_what_is_not_finite_is_told(space, mesh, velocity, where):
    start, velocity = mesh.vertices.copy(), velocity.copy()
    {"start": start, "velocity": velocity}[where][3, 1] = np.nan
    path = exponential(space, start, velocity, K)
    assert path.status is Status.NOT_FINITE
    assert np.isfinite(path.vertices).all()
    found = logarithm(space, start, start + velocity, K)
    assert found.path.status is Status.NOT_FINITE
    assert np.isfinite(found.velocity).all()
    mean = elastic_mean(space, np.stack([mesh.vertices, start + velocity]))
    assert mean.status is Status.NOT_FINITE
    assert mean.iterations == 0
    assert np.isfinite(mean.vertices).all()


@pytest.mark.parametrize("pose", [1.3], indirect=True)
@pytest.mark.parametrize(
    "operation", ["exponential", "geodesic", "elastic_mean", "centre_of_mass", "centre_of_mass from there"]
)
def test_a_degenerate_face_is_told(space, mesh, velocity, operation):
    flat = mesh.vertices.copy()
    a, b, c = mesh.faces[0]
    flat[c] = (flat[a] + flat[b]) / 2
    if operation == "exponential":
        result = exponential(space, flat, velocity, K)
    elif operation == "geodesic":
        result = geodesic(space, mesh.vertices, flat, K)
    elif operation == "elastic_mean":
        result = elastic_mean(space, np.stack([flat, flat]))
    elif operation == "centre_of_mass":
        result = centre_of_mass(space, np.stack([mesh.vertices, flat]), start=mesh.vertices)
    else:
        result = centre_of_mass(space, np.stack([mesh.vertices]), start=flat, steps=1)
    assert result.status is not Status.CONVERGED
    assert result.reason
    assert np.isfinite(result.vertices).all()
