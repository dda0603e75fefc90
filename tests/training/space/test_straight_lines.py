"""Straight lines of shapes, and lines that remember, on families that are straight or bend."""

import numpy as np
import pytest

from shapespace.coordinates.nric import nric
from shapespace.coordinates.reconstruction import Reconstructor
from shapespace.mesh.rigid_motion import without_rigid_motion
from shapespace.training.space.generalisation import PrincipalComponents, vertex_distances
from shapespace.training.space.memory import RememberingMap
from shapespace.training.space.modes import ModeError
from shapespace.training.space.straight_lines import StraightLines
from tests.training.conftest import bent


@pytest.fixture(scope="module")
def family(ellipsoid):
    """A curved family with one parameter: large bends to both sides."""
    return bent(ellipsoid, np.linspace(-1, 1, 6))


def turned(shapes, rng):
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    return 1 + shapes @ (turn * np.linalg.det(turn))


def slopes(shape_of, code, step=1e-5):
    """Difference quotients (m, V, 3) of a map from codes to shapes."""
    return np.stack([
        (shape_of(code + step * unit)[0] - shape_of(code - step * unit)[0]) / (2 * step) for unit in np.eye(len(code))
    ])  # fmt: skip


def test_unseen_blend_shapes_lie_on_straight_lines_of_vertices_in_any_pose(blends, rng):
    mesh, large = blends
    # Large displacements would turn the shapes.
    shapes = mesh.vertices + 0.2 * (large - mesh.vertices)
    lines = StraightLines.of("vertices", turned(shapes[:9], rng), mesh)
    found = lines.first(3).nearest(turned(shapes[9:], rng))
    assert vertex_distances(found.vertices, shapes[9:], mesh.diagonal).max() < 1e-3
    assert np.abs(lines.coefficients).max(axis=0) == pytest.approx(1)
    assert (lines.explained[:3] > 0.01).all()
    assert lines.explained[3:].sum() < 1e-3


def test_vertices_count_as_often_as_the_fine_mesh_has_them(blends):
    mesh, shapes = blends
    counts = np.random.default_rng(3).integers(1, 30, len(mesh.vertices))
    lines = StraightLines.of("vertices", shapes, mesh, vertex_counts=counts.astype(float))
    repeated = np.repeat(lines.offsets(shapes).reshape(len(shapes), -1, 3), counts, axis=1)
    u, s, _ = np.linalg.svd(repeated.reshape(len(shapes), -1), full_matrices=False)
    assert lines.explained == pytest.approx((s**2 / (s**2).sum())[: len(lines)], abs=1e-9)
    peaks = np.abs(u[:, :3]).max(axis=0)
    assert np.abs(lines.coefficients[:, :3]) == pytest.approx(np.abs(u[:, :3]) / peaks, abs=1e-6)
    assert lines.project(shapes)[:, :3] == pytest.approx(lines.coefficients[:, :3], abs=1e-6)
    once = StraightLines.of("vertices", shapes, mesh, vertex_counts=np.ones(len(counts)))
    assert (once.modes == StraightLines.of("vertices", shapes, mesh).modes).all()


def test_lines_of_lengths_and_angles_bend_where_lines_of_vertices_cut_across(ellipsoid, family):
    ends = nric(family[[0, -1]], ellipsoid.connectivity)
    reconstruct = Reconstructor(ellipsoid)
    bends = [reconstruct((1 - share) * ends[0] + share * ends[1]).vertices for share in np.linspace(0, 1, 6)]
    known, unseen = np.stack([bends[k] for k in (0, 2, 3, 5)]), np.stack([bends[k] for k in (1, 4)])
    away = [
        vertex_distances(StraightLines.of(kind, known, ellipsoid).first(1).nearest(unseen).vertices, unseen, 1.0).mean()
        for kind in ("nric", "vertices")
    ]
    assert away[0] < 0.3 * away[1]


@pytest.mark.parametrize("kind", ["vertices", "nric", "differential"])
def test_derivatives_are_difference_quotients(ellipsoid, family, kind):
    lines = StraightLines.of(kind, family, ellipsoid).first(2)
    code = np.array([0.4, -0.2])
    # Reconstructed shapes have the pose of their start, which is the same nearby.
    found, derivative = lines.shape(code)
    expected = slopes(lines.shape, code)
    size = np.abs(expected).max()
    mine, other = (without_rigid_motion(each, found) for each in (derivative(), expected))
    assert np.abs(mine - other).max() < 1e-3 * size


def test_lines_that_remember_return_their_shapes_and_leave_others_alone(ellipsoid, family):
    lines = StraightLines.of("vertices", family, ellipsoid).first(1)
    codes = lines.codes_of(family)
    remembering = RememberingMap(lines.shape, codes, family, lines.sizes)
    back = np.stack([remembering.shape(code)[0] for code in codes])
    assert vertex_distances(back, family, 1.0).max() < 1e-9
    plain = PrincipalComponents.of(family, ellipsoid.vertices).nearest(family, 1)
    assert vertex_distances(plain, family, 1.0).mean() > 0.01
    far = 3 * np.abs(codes).max() * np.ones(1)
    assert remembering.shape(far)[0] == pytest.approx(lines.shape(far)[0], abs=1e-9)
    between = (codes[0] + codes[1]) / 2 + 0.1 * (codes[1] - codes[0])
    assert remembering.shape(between)[1]() == pytest.approx(slopes(remembering.shape, between), abs=1e-5)
    found = remembering.nearest(family[2:3], lines.nearest(family[2:3]))
    assert vertex_distances(found.vertices, family[2:3], 1.0).max() < 1e-3


def test_equal_shapes_have_no_lines(ellipsoid):
    for kind in ("vertices", "nric"):
        with pytest.raises(ModeError, match="all shapes are the same"):
            StraightLines.of(kind, np.stack([ellipsoid.vertices] * 4), ellipsoid)
