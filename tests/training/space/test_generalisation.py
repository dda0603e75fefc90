"""Distance of held-out shapes from the space and from principal components, on a bending ellipsoid."""

import numpy as np
import pytest

from shapespace.mesh.rigid_motion import without_rigid_motion
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.shell.energy import Material
from shapespace.shell.space import ShellSpace
from shapespace.training.runs.settings import ModeSettings
from shapespace.training.space.codes import box_of
from shapespace.training.space.generalisation import (
    PrincipalComponents,
    nearest_exponentials,
    summary,
    time_steps,
    to_nearest,
    vertex_distances,
)
from shapespace.training.space.held_out import held_out
from shapespace.training.space.modes import ModeError
from tests.training.conftest import STEPS, bent


@pytest.fixture(scope="module")
def shapes(ellipsoid: TriangleMesh) -> np.ndarray:
    """A curved family with one parameter: large bends to both sides."""
    return bent(ellipsoid, np.linspace(-1, 1, 6))


def test_two_modes_follow_a_curved_family_where_components_cut_across(ellipsoid, shapes):
    found = held_out(ellipsoid, shapes, np.array([1, 4]), [1, 2], ModeSettings(), Material(), STEPS)
    assert found.counts == [1, 2]
    away = found.distances(shapes, ellipsoid.diagonal)
    modes, components = ([each.mean() for each in away[kind]] for kind in ("modes", "components"))
    assert modes[0] < components[0]
    assert modes[1] < 0.2 * components[1]


def test_nothing_is_known_of_what_is_held_out(ellipsoid, shapes):
    """Replacing one of two held-out shapes changes neither mean nor modes, so the other's result stays."""
    others = shapes.copy()
    others[4] = ellipsoid.vertices * [1, 1.3, 1]
    how = (np.array([1, 4]), None, ModeSettings(count=1), Material(), 2)
    found, again = (held_out(ellipsoid, each, *how) for each in (shapes, others))
    assert found.counts == again.counts == [1, 1]
    # The start of the search depends on both held-out shapes, its end hardly.
    assert found.near["modes"][0][0] == pytest.approx(again.near["modes"][0][0], abs=1e-4)
    assert found.near["components"][0][0] == pytest.approx(again.near["components"][0][0], abs=1e-12)


def test_modes_lead_from_the_mean_of_the_other_logarithms(ellipsoid):
    """The logarithms at the mean of all shapes add up to zero, so that the others' sum would give the last one away."""
    rng, x = np.random.default_rng(0), ellipsoid.vertices
    waves = np.stack([np.sin(x @ rng.standard_normal((3, 3)) + rng.uniform(0, 6, 3)) for _ in range(4)])
    others = 0.05 * without_rigid_motion(waves, x)
    last = -others.sum(axis=0)
    mixed = np.tensordot([0.7, 0.5, -0.4, 0.2], others, axes=1)  # with weights that add up to 1
    towards = np.stack([last, mixed])
    space = ShellSpace(ellipsoid, Material(), first_step="centred")
    near = nearest_exponentials(space, x, others, towards, x + towards, 3, 1)
    away = vertex_distances(near, x + towards, ellipsoid.diagonal).mean(axis=1)
    assert away[1] < 1e-4
    edges = others[1:] - others[0]
    known = edges.reshape(3, -1).T
    rest = (last - others[0]).ravel()
    rest = rest - known @ np.linalg.lstsq(known, rest)[0]
    assert away[0] == pytest.approx(np.linalg.norm(rest.reshape(-1, 3), axis=1).mean() / ellipsoid.diagonal, rel=0.05)


def test_no_search_begins_where_the_mean_of_the_others_has_no_exponential(ellipsoid):
    x = ellipsoid.vertices
    moved = np.random.default_rng(0).standard_normal((2, 4, *x.shape))
    space = ShellSpace(ellipsoid, Material(), first_step="centred")
    small = nearest_exponentials(space, x, 1e-3 * moved[0], 1e-3 * moved[1], x + 1e-3 * moved[1], 2, 4)
    assert small.shape == moved[1].shape
    with pytest.raises(ModeError, match="has no exponential"):
        nearest_exponentials(space, x, 30 * moved[0], 30 * moved[1], x + 30 * moved[1], 2, 4)


def test_one_step_is_chosen_where_shapes_neither_bend_nor_fold(ellipsoid, shapes, blends):
    mesh, linear = blends
    assert time_steps(ModeSettings(), ellipsoid, shapes, Material()) == 8
    assert time_steps(ModeSettings(log_steps=3), mesh, linear, Material()) == 3
    assert time_steps(ModeSettings(), mesh, linear[:4], Material()) == 8, "too few to tell"
    wide = mesh.vertices + 6 * (linear - mesh.vertices)
    assert time_steps(ModeSettings(), mesh, wide, Material()) == 8, "in one step they fold"


@pytest.mark.long
def test_one_step_comes_nearer_to_blend_shapes(blends):
    mesh, linear = blends
    index, plain = np.array([0, 5]), ModeSettings(sparsity=0)
    found, more_steps = (held_out(mesh, linear, index, [3], plain, Material(), steps) for steps in (None, 8))
    assert found.steps.tolist() == [1, 1]
    away, more = (each.distances(linear, mesh.diagonal)["modes"][0].mean() for each in (found, more_steps))
    assert away < 0.4 * more


def test_components_reproduce_what_they_were_found_from_and_come_nearer_with_more(shapes, rng):
    linear = PrincipalComponents.of(shapes, shapes[0])
    assert vertex_distances(linear.nearest(shapes, 5), shapes, 1.0).max() < 1e-9
    errors = [np.square(vertex_distances(linear.nearest(shapes, k), shapes, 1.0)).sum() for k in range(6)]
    assert (np.diff(errors) < 0).all()
    left = [1 - linear.explained(k) for k in range(6)]
    assert left == pytest.approx(np.array(errors) / errors[0], abs=1e-9)
    drawn = linear.random(1, 500, rng)
    along = (drawn - linear.mean).reshape(500, -1) @ linear.axes[0]
    lower, upper = box_of(linear.coefficients[:, :1])
    assert (
        lower <= along.min() < linear.coefficients[:, 0].min() < linear.coefficients[:, 0].max() < along.max() <= upper
    )


def test_shapes_are_as_far_from_a_collection_as_from_the_nearest_of_it(shapes):
    assert to_nearest(shapes[:2], shapes, 1.0) < 1e-9
    expected = vertex_distances(shapes[:1], shapes[1], 2.0).mean()
    assert to_nearest(shapes[:1], shapes[1:], 2.0) == pytest.approx(expected), "the next of a family"


def test_distances_know_no_pose_and_no_unit(shapes, rng):
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    turn *= np.linalg.det(turn)
    expected = vertex_distances(shapes, shapes[0], 2.0)
    assert vertex_distances(7 * shapes @ turn + 5, 7 * shapes[0], 14.0) == pytest.approx(expected, abs=1e-12)
    assert expected[0] == pytest.approx(0, abs=1e-12)
    assert summary(np.arange(101.0)) == {"mean": 50, "p95": 95}
