"""Fits to scans of a part: what is there is matched, and what is hidden is said to be uncertain."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from shapespace.model.fit_result import FitStatus
from shapespace.model.options import Landmark
from shapespace.model.shape_model import ShapeModel
from tests.shapespace.model.moved_shapes import Moved, Plain


def test_what_one_camera_sees_is_enough_and_the_rest_is_less_certain(figure: ShapeModel, plain: Plain) -> None:
    given, whole = plain(3)
    found = figure.fit_scan(given.seen_from(2), partial=True)
    assert found.status is FitStatus.CONVERGED, found.reason
    assert given.error(found) < 0.005
    assert found.seen < 0.9 < found.explained
    assert np.trace(found.covariance) > np.trace(whole.covariance)


@pytest.mark.parametrize(("seed", "axis"), [(2, 0), (9, 2), (12, 0)])
def test_no_limb_sticks_out_of_what_one_camera_sees(figure: ShapeModel, seed: int, axis: int) -> None:
    # The points alone also suit a limb that is turned wrongly, because they do not say where the surface ends.
    given = Moved.of(figure, seed)
    found = figure.fit_scan(given.seen_from(axis), partial=True)
    assert found.status is FitStatus.CONVERGED, found.reason
    assert given.error(found) < 5e-4


@pytest.mark.parametrize(("seed", "axis", "off"), [(5, None, 0.65), (8, 2, 0.8)])
def test_what_the_model_can_not_make_hardly_moves_the_code(
    figure: ShapeModel, seed: int, axis: int | None, off: float
) -> None:
    # All points of a wave are missed alike, so thousands of them say little more than one.
    given = Moved.of(figure, seed)
    waves = np.sin(given.shape[:, [1, 0, 2]] * [28, 36, 32] / given.size)
    wavy = replace(given, shape=given.shape + 0.01 * given.size * waves)
    found = figure.fit_scan(wavy.points() if axis is None else wavy.seen_from(axis), partial=axis is not None)
    deviations = np.sqrt(figure.population.covariance.diagonal())
    assert np.sqrt((((found.code - given.code) / deviations) ** 2).mean()) < off


def test_a_fit_is_ambiguous_where_the_scan_says_little(figure: ShapeModel, plain: Plain) -> None:
    given, _ = plain(3)
    moved = np.linalg.norm(figure.jacobian(given.code)[:, :, figure.latents.names.index("left knee")], axis=1)
    leg = moved > 0.5 * moved.max()
    nearest = cKDTree(given.shape).query(points := given.points())[1]
    scan = points[~leg[nearest]]
    found = figure.fit_scan(scan, partial=True)
    assert found.status is FitStatus.AMBIGUOUS
    assert "the scan says little about left knee:" in found.reason
    assert "Scan the other sides too, or give landmarks" in found.reason
    # Landmarks on the leg tell where it is.
    told = [Landmark(int(k), given.shape[k].tolist()) for k in np.flatnonzero(leg)[::20]]
    found = figure.fit_scan(scan, partial=True, landmarks=told)
    assert found.status is FitStatus.CONVERGED, found.reason


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_a_part_in_other_units_is_fitted_alike(figure: ShapeModel, unit: float) -> None:
    given = Moved.of(figure, 11)
    points = given.points()
    half = points[points[:, 1] > np.median(points[:, 1])]
    one, other = (figure.fit_scan(k * half, partial=True, scale="free", noise=1e-4 * k) for k in (1.0, unit))
    assert one.placement.scale == pytest.approx(1, rel=0.02)
    assert other.placement.scale == pytest.approx(unit * one.placement.scale, rel=1e-3)
    np.testing.assert_allclose(other.code, one.code, atol=0.02)
    assert (other.status, other.noise) == (one.status, pytest.approx(unit * one.noise, rel=1e-2))
