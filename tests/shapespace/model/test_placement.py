"""Where a shape is placed in a scan before a fit begins."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapespace.mesh.rigid_motion import Placement
from shapespace.model.placement import MORE, QUICK, THOROUGH, PlacementEffort, start_placements
from shapespace.model.scan import Scan, scan_of
from shapespace.model.shape_model import ShapeModel
from shapespace.solve.deadline import Deadline


@pytest.fixture(scope="module")
def body(figure: ShapeModel) -> np.ndarray:
    return figure.mesh("coarse").vertices / figure.manifest.scale


def scanned(points: np.ndarray, placement: Placement) -> Scan:
    return scan_of(placement(points), np.zeros((0, 3), np.int64), np.random.default_rng(0))


def somewhere(seed: int, scale: float = 1.0) -> Placement:
    rng = np.random.default_rng(seed)
    return Placement(Rotation.random(random_state=rng).as_matrix(), rng.standard_normal(3), scale)


def away(found: Placement, true: Placement, body: np.ndarray) -> float:
    return float(np.linalg.norm(found(body) - true(body), axis=1).mean() / np.ptp(body, axis=0).max())


@pytest.mark.parametrize("axis", [0, 2])
@pytest.mark.parametrize("seed", range(3))
def test_half_a_body_is_placed_although_its_middle_is_elsewhere(body: np.ndarray, axis: int, seed: int) -> None:
    true, half = somewhere(seed), body[body[:, axis] > np.median(body[:, axis])]
    best, *others = start_placements(scanned(half, true), body[None], partial=True, free=False, effort=THOROUGH)
    assert away(best.placement, true, body) < 0.01
    assert len(others) < THOROUGH.count
    assert [start.score for start in (best, *others)] == sorted(start.score for start in (best, *others))


@pytest.mark.parametrize("effort", [QUICK, MORE])
@pytest.mark.parametrize("scale", [1.0, 3.0])
def test_a_whole_body_is_placed_in_its_size(body: np.ndarray, effort: PlacementEffort, scale: float) -> None:
    true = somewhere(5, scale)
    found = start_placements(scanned(body, true), body[None], partial=False, free=scale != 1, effort=effort)
    best = min(found, key=lambda start: away(start.placement, true, body))
    assert found.index(best) < 2, "front and back of a body are alike"
    assert away(best.placement, true, body) < 0.05 * scale
    assert best.placement.scale == pytest.approx(scale, rel=0.05)
    angles = [a.placement.angle_to(b.placement) for a in found for b in found if a is not b]
    assert min(angles) > 0.17, "each differs from the others"


def test_steps_to_the_closest_points_lower_the_score(body: np.ndarray) -> None:
    scan = scanned(body, somewhere(7))
    scores = [
        start_placements(scan, body[None], partial=False, free=False, effort=replace(QUICK, steps=steps))[0].score
        for steps in (0, 2, 8)
    ]
    assert scores == sorted(scores, reverse=True)
    assert scores[-1] < 0.8 * scores[0]


def test_after_the_deadline_only_the_first_shape_is_tried(body: np.ndarray) -> None:
    true = somewhere(5)
    shapes = np.stack([body * stretch for stretch in ([1, 1.5, 1], [1, 1, 1])])
    in_time, late = (
        start_placements(
            scanned(body, true), shapes, partial=False, free=False, effort=QUICK, deadline=Deadline(seconds)
        )
        for seconds in (1e9, 0)
    )
    assert in_time[0].shape == 1
    assert {start.shape for start in late} == {0}
    assert [start.score for start in late] == sorted(start.score for start in late)
