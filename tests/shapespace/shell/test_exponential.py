"""The exponential: its equations, its end points, and its reasons where it can't be continued."""

from itertools import pairwise

import numpy as np
import pytest

from shapespace.mesh.rigid_motion import align
from shapespace.shell.energy import Material
from shapespace.shell.exponential import Renewals, exponential, extrapolate
from shapespace.shell.geodesic import geodesic
from shapespace.shell.space import ShellSpace
from shapespace.solve.deadline import Deadline
from shapespace.solve.outcome import Status
from tests.shapespace.shell.constrained import constrained_exponential
from tests.shapespace.shell.measures import distance, true_residuals

K = 4


def test_the_exponential_ends_when_its_deadline_passes(space, mesh, velocity):
    deadline = Deadline(60)
    assert len(exponential(space, mesh.vertices, velocity, 4, deadline=deadline).vertices) == 5
    deadline.call_off()
    path = exponential(space, mesh.vertices, velocity, 4, deadline=deadline)
    assert path.status is Status.DEADLINE
    assert len(path.vertices) == 2


def test_every_step_of_the_exponential_solves_its_equation(space, mesh, velocity):
    path = exponential(space, mesh.vertices, velocity, 8)
    assert path.converged
    assert len(path.vertices) == 9
    assert true_residuals(space, path).max() <= 1e-9


@pytest.mark.parametrize(("mesh", "pose"), [("torus", 1.3)], indirect=True)
def test_a_centred_first_step_is_a_hundred_times_closer_to_the_limit(mesh, velocity):
    """Squared distances fall like 1/K² with the paper's step. Centred ones start far below and fall faster."""
    centred, paper = (ShellSpace(mesh, Material(eta=1e-3), first_step=step) for step in ("centred", "paper"))
    limit = exponential(centred, mesh.vertices, velocity, 128).vertices[-1]

    def missed(space: ShellSpace, steps: int) -> float:
        end = align(exponential(space, mesh.vertices, velocity, steps).vertices[-1], limit)
        return float(((end - limit) ** 2).sum() / ((limit - mesh.vertices) ** 2).sum())

    centred_misses, paper_misses = ([missed(space, steps) for steps in (4, 8, 16)] for space in (centred, paper))
    assert max(new / old for new, old in zip(centred_misses, paper_misses, strict=True)) < 0.01
    assert all(fine < coarse / 3 for coarse, fine in pairwise(centred_misses))
    assert missed(paper, 128) > centred_misses[-1], "128 steps of the paper are worse than 16 centred ones"


def test_a_rigid_part_of_the_velocity_changes_nothing(space, mesh, velocity):
    turning = np.cross([0.1, 0.4, -0.2], mesh.vertices)
    # Each path alone may miss its equations by the tolerance.
    plain, turned = (exponential(space, mesh.vertices, v, K, tolerance=1e-12) for v in (velocity, velocity + turning))
    assert plain.converged
    assert turned.converged
    np.testing.assert_allclose(turned.vertices, plain.vertices, atol=1e-9 * mesh.diagonal)


def test_a_step_back_and_forth_returns(space, mesh, velocity):
    first = mesh.vertices
    second = first + velocity / K
    back = extrapolate(space, second, first, 2, forward=False)
    forth = extrapolate(space, back.vertices[-1], back.vertices[-2], 2)
    assert back.converged
    assert forth.converged
    assert distance(space, forth.vertices[-2], first) < 1e-6
    assert distance(space, forth.vertices[-1], second) < 1e-6


def test_shooting_backwards_continues_the_path_before_its_start(space, mesh, velocity):
    before = exponential(space, mesh.vertices, 0.5 * velocity, -2)
    after = exponential(space, mesh.vertices, 0.5 * velocity, 2)
    whole = extrapolate(space, before.vertices[-1], before.vertices[-2], 3)
    assert distance(space, whole.vertices[-1], after.vertices[-1]) < 1e-6


@pytest.mark.parametrize("mesh", ["closed", "sheet"], indirect=True)  # simply connected
def test_nodal_and_constrained_form_are_the_same(space, mesh, velocity):
    path = exponential(space, mesh.vertices, velocity, K, tolerance=1e-11)
    z = constrained_exponential(space, path.nric[0], path.nric[1], K)
    np.testing.assert_allclose(z, path.nric, atol=1e-8)


def test_backends_agree(mesh, velocity):
    paths = []
    for backend in ("banded", "auto"):
        space = ShellSpace(mesh, Material(eta=1e-3), backend)
        paths.append(exponential(space, mesh.vertices, velocity, K))
        paths.append(geodesic(space, mesh.vertices, paths[-1].vertices[-1], K))
    for path in paths[1:]:
        assert distance(space, path.vertices[-1], paths[0].vertices[-1]) < 1e-6


def test_a_velocity_that_tears_the_mesh_is_told(space, mesh, rng):
    path = exponential(space, mesh.vertices, 20 * mesh.diagonal * rng.standard_normal(mesh.vertices.shape), K)
    assert not path.converged
    assert path.reason
    assert np.isfinite(path.vertices).all()


@pytest.mark.parametrize("pose", [1.3], indirect=True)
def test_a_long_way_ends_in_a_finite_path_whatever_happens(mesh, velocity):
    """Bending is so stiff that faces collapse on the way: the result has the shapes so far, and a reason."""
    space = ShellSpace(mesh, Material(eta=1.0))
    path = exponential(space, mesh.vertices, 5 * velocity, K)
    assert np.isfinite(path.vertices).all()
    assert path.converged == (len(path.vertices) == K + 1)
    assert path.converged or path.reason


def test_exact_newton_takes_over_where_the_chord_fails(space, mesh, velocity, monkeypatch):
    easy = exponential(space, mesh.vertices, velocity, K)
    monkeypatch.setattr("shapespace.shell.exponential.RENEWALS", Renewals(slow=1e-9))
    hard = exponential(space, mesh.vertices, velocity, K)
    back = exponential(space, mesh.vertices, velocity, -2)
    assert hard.converged
    assert back.converged
    assert distance(space, hard.vertices[-1], easy.vertices[-1]) < 1e-6
