"""Parallel transport: over one step and none, and of vectors that are zero or not finite."""

from dataclasses import replace

import numpy as np
import pytest

from shapespace.shell.exponential import exponential
from shapespace.shell.transport import parallel_transport
from shapespace.solve.outcome import Status


def test_transport_takes_one_step_and_not_none(space, mesh, velocity):
    path = exponential(space, mesh.vertices, 0.1 * velocity, 1)
    carried = parallel_transport(space, path, velocity)
    assert carried.status is Status.CONVERGED
    length = space.norm(mesh.vertices, velocity)
    assert space.norm(path.vertices[1], carried.velocities[1]) == pytest.approx(length, rel=0.1)
    with pytest.raises(ValueError, match="two shapes"):
        parallel_transport(space, replace(path, vertices=path.vertices[:1]), velocity)


def test_a_vector_of_no_length_stays_one_and_what_is_not_finite_is_told(space, mesh, velocity):
    path = exponential(space, mesh.vertices, 0.5 * velocity, 2)
    assert not parallel_transport(space, path, 0 * velocity).velocities.any()
    lost = parallel_transport(space, path, np.nan * velocity)
    assert lost.status is Status.NOT_FINITE
    assert len(lost.velocities) == 0


def test_what_the_rungs_cost_is_told(space, mesh, velocity):
    path = exponential(space, mesh.vertices, 0.5 * velocity, 2)
    carried = parallel_transport(space, path, velocity)
    assert carried.iterations > 0
    assert 0 < carried.residual < 1e-8
