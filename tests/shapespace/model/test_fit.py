"""Fits: code, placement and size of a scan are found again; a scan of another shape is reported."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from shapespace.mesh.rigid_motion import Placement
from shapespace.model.decoder import MeshChoice
from shapespace.model.fit_constraints import FitConstraints
from shapespace.model.fit_preparation import FitPreparation
from shapespace.model.fit_result import FitState, FitStatus
from shapespace.model.fit_settings import SETTINGS
from shapespace.model.latent_space import InvalidFixedError
from shapespace.model.options import FitOptions, Landmark
from shapespace.model.part_exchange import ShapeJudge
from shapespace.model.placement import QUICK, PlacementEffort, StartPlacement, start_placements
from shapespace.model.scan import InvalidScanError, scan_of
from shapespace.model.shape_model import ShapeModel, load
from shapespace.solve.deadline import Deadline
from tests.service.conftest import ROOT
from tests.shapespace.model.moved_shapes import Moved, Plain


@pytest.fixture(scope="module")
def ring() -> ShapeModel:
    return load(ROOT / "models" / "freaky-torus")


@pytest.mark.parametrize("seed", [1, 3])
def test_a_code_comes_back_from_points_anywhere(plain: Plain, seed: int) -> None:
    given, found = plain(seed)
    assert found.status is FitStatus.CONVERGED, found.reason
    assert given.error(found) < 1e-3
    assert found.explained > 0.99
    assert found.seen > 0.99
    assert found.placement.scale == 1
    assert found.scan.p95 < 2e-3 * given.size
    assert found.model.max < 0.05 * given.size
    np.testing.assert_allclose(found.placement.rotation @ found.placement.rotation.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(found.placement.rotation) == pytest.approx(1)
    # The cost is as documented, counting a rough shape as a third of a solved one.
    assert found.solved + found.rough / 3 < 60


def test_a_fit_whose_first_search_ends_in_the_wrong_place_goes_on(
    figure: ShapeModel, plain: Plain, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The first search only knows the body on its head.
    given, _ = plain(3)
    turned = Placement(Rotation.random(random_state=3).as_matrix() @ np.diag([1.0, -1.0, -1.0]), np.zeros(3), 1)
    first = replace(QUICK, count=1)

    def placed(*scan: object, effort: PlacementEffort, **options: bool) -> list[StartPlacement]:
        found = start_placements(*scan, effort=effort, **options)
        return found if effort is not first else [max(found_far(*scan, **options), key=apart)]

    def apart(start: StartPlacement) -> float:
        return -start.placement.angle_to(turned)

    def found_far(*scan: object, **options: bool) -> list[StartPlacement]:
        return start_placements(*scan, effort=replace(QUICK, count=8), **options)

    monkeypatch.setattr("shapespace.model.fit.QUICK", first)
    monkeypatch.setattr("shapespace.model.fit.start_placements", placed)
    found = figure.fit_scan(given.points())
    assert found.status is FitStatus.CONVERGED, found.reason
    assert given.error(found) < 2e-3
    monkeypatch.setattr("shapespace.model.fit.SETTINGS", replace(SETTINGS, attempts=()))
    assert figure.fit_scan(given.points()).status is FitStatus.POOR


def test_a_forearm_gets_another_place_by_an_exchange_of_parts(figure: ShapeModel) -> None:
    elbow = next(f.start for f in figure.manifest.factors if f.name == "left elbow")
    code = figure.population.mean.copy()
    code[elbow] = figure.lower[elbow]
    wrong = code.copy()
    wrong[elbow] = figure.upper[elbow]
    preparation, decoder = FitPreparation(figure.decoder), figure.decoder
    scan = scan_of(figure.decode(code) / decoder.manifest.scale, figure.faces, np.random.default_rng(0))
    judge = ShapeJudge(decoder, scan, FitConstraints.of(FitOptions(), decoder))
    shape = preparation.shapes_of(wrong[None]).shapes[0]
    with decoder.solver() as reconstruct:
        found = preparation.exchange(reconstruct, judge, FitState(wrong, shape, Placement(np.eye(3), np.zeros(3), 1)))
    assert abs(found[elbow] - code[elbow]) < 0.2 * abs(wrong[elbow] - code[elbow])
    # What is in its place remains there.
    assert (np.delete(found, elbow) == np.delete(code, elbow)).mean() > 0.7


@pytest.mark.parametrize(("seed", "told"), [(3, True), (2, False), pytest.param(1, True, marks=pytest.mark.long)])
def test_landmarks_tell_a_ring_how_it_is_turned(ring: ShapeModel, seed: int, told: bool) -> None:
    # A ring turned by 180° or upside down is that of another code: only landmarks tell vertices apart.
    given = Moved.of(ring, seed)
    landmarks = [Landmark(k, given.shape[k].tolist()) for k in (0, 300, 700, 1000, 1400, 1900)]
    found = ring.fit_scan(given.points(), landmarks=landmarks if told else ())
    assert not told or given.error(found) < 5e-3
    # A bump of two percent of the surface is found, wherever the search began.
    assert found.status is FitStatus.CONVERGED
    assert found.scan.p95 < 2e-3 * given.size


def test_another_mesh_is_fit_whichever_way_its_faces_are_turned(figure: ShapeModel) -> None:
    given = Moved.of(figure, 3)
    other = trimesh.Trimesh(given.shape, given.faces).subdivide()
    rng = np.random.default_rng(0)
    order = rng.permutation(len(other.vertices))
    vertices, faces = np.empty_like(other.vertices), order[other.faces]
    vertices[order] = other.vertices
    found = figure.fit_scan((vertices, faces))
    turned = figure.fit_scan((vertices, faces[:, ::-1]))
    assert given.error(found) < 1e-3
    assert given.error(turned) < 1e-3
    assert found.sampled
    assert f"Of {len(vertices)} points" in found.reason


def test_points_on_faces_are_not_said_to_be_taken_from_fewer_points(figure: ShapeModel) -> None:
    coarse = figure.decoder.reference.vertices, figure.decoder.mesh(MeshChoice.COARSE).faces
    scan = scan_of(*coarse, np.random.default_rng(0))
    assert len(scan.points) > len(coarse[0])
    assert scan.replaced.startswith("In place of 1000 vertices, ")


def test_a_size_is_found_where_it_is_free(figure: ShapeModel) -> None:
    given = Moved.of(figure, 2, scale=40.0)
    with pytest.raises(InvalidScanError, match="scale=free"):
        figure.fit_scan(given.points())
    found = figure.fit_scan(given.points(), scale="free")
    assert found.placement.scale == pytest.approx(40, rel=1e-3)
    assert given.error(found) < 1e-3


def test_noise_and_outliers_are_told_from_the_shape(figure: ShapeModel) -> None:
    given = Moved.of(figure, 2)
    rng = np.random.default_rng(1)
    points = given.points() + 0.005 * given.size * rng.standard_normal((4000, 3))
    low, high = points.min(axis=0), points.max(axis=0)
    points[:80] = low + (high - low) * rng.random((80, 3))
    found = figure.fit_scan(points)
    assert found.status is FitStatus.CONVERGED, found.reason
    assert given.error(found) < 4e-3
    assert found.noise == pytest.approx(0.005 * given.size, rel=0.2)
    assert 0.96 < found.explained < 0.99
    told = figure.fit_scan(points, noise=0.005 * given.size)
    assert given.error(told) < 4e-3
    assert told.noise == pytest.approx(0.005 * given.size)


def test_a_piece_that_does_not_belong_is_left_out(figure: ShapeModel) -> None:
    given = Moved.of(figure, 2)
    rng = np.random.default_rng(0)
    wall = given.shape.mean(axis=0) + given.size * (rng.random((800, 3)) - 0.5) * [1, 0, 1] + [0, given.size, 0]
    found = figure.fit_scan(np.concatenate([given.points(3200), wall]))
    assert found.status is FitStatus.CONVERGED, found.reason
    assert given.error(found) < 5e-3
    assert found.seen > 0.99
    assert found.explained < 0.9


def test_landmarks_decide_where_a_fit_begins_and_what_it_holds_on_to(figure: ShapeModel) -> None:
    given = Moved.of(figure, 5)
    chosen = [0, 700, 1500, 2600, 4000]
    landmarks = [Landmark(k, given.shape[k].tolist(), 0.01) for k in chosen]
    found = figure.fit_scan(given.points(), landmarks=landmarks)
    assert given.error(found) < 1e-3
    # A landmark moved elsewhere, with a small sigma, pulls the shape there.
    away = given.shape[chosen[0]] + 0.01 * given.size
    moved = figure.fit_scan(given.points(), landmarks=[Landmark(chosen[0], away.tolist(), 1e-4)])
    there = [f.placement(f.shape.vertices)[chosen[0]] for f in (found, moved)]
    assert np.linalg.norm(there[1] - away) < 0.5 * np.linalg.norm(there[0] - away)


def test_fixed_coordinates_keep_their_values(figure: ShapeModel, plain: Plain) -> None:
    given, free = plain(1)
    fixed = {0: float(given.code[0]) + 0.2, 7: float(given.code[7])}
    found = figure.fit_scan(given.points(), fixed=fixed, samples=3)
    for k, value in fixed.items():
        assert found.code[k] == np.float32(value)
        assert (found.samples[:, k] == np.float32(value)).all()
        assert not found.covariance[k].any()
        assert not found.covariance[:, k].any()
    assert (found.covariance.diagonal() > 0).sum() == figure.dimension - 2
    assert given.error(found) > 10 * given.error(free)


def test_the_covariance_is_that_of_the_samples_and_holds_the_truth(figure: ShapeModel) -> None:
    given = Moved.of(figure, 2)
    points = given.points() + 0.005 * given.size * np.random.default_rng(2).standard_normal((4000, 3))
    found = figure.fit_scan(points, samples=4000)
    assert (np.linalg.eigvalsh(found.covariance) > 0).all()
    np.testing.assert_array_equal(found.covariance, found.covariance.T)
    deviations = np.sqrt(found.covariance.diagonal())
    spread = np.cov(found.samples.T)
    np.testing.assert_allclose(
        spread / np.outer(deviations, deviations), found.covariance / np.outer(deviations, deviations), atol=0.1
    )
    off = np.abs(found.code - given.code) / deviations
    assert (off < 1.645).mean() >= 0.7
    assert off.max() < 6
    # Much narrower than the prior.
    assert (deviations < 0.5 * np.sqrt(figure.population.covariance.diagonal())).all()


def test_one_seed_gives_one_answer(model: ShapeModel) -> None:
    points = Moved.of(model, 1).points()
    one, again, other = (model.fit_scan(points, samples=2, seed=seed) for seed in (5, 5, 6))
    np.testing.assert_array_equal(one.code, again.code)
    np.testing.assert_array_equal(one.samples, again.samples)
    np.testing.assert_array_equal(one.covariance, again.covariance)
    assert one.reason == again.reason
    assert (one.samples != other.samples).any()


@pytest.mark.parametrize(
    ("name", "solid"),
    [
        ("model", "ball"),
        pytest.param("figure", "ball", marks=pytest.mark.long),
        pytest.param("figure", "box", marks=pytest.mark.long),
    ],
)
def test_what_is_no_such_shape_is_told_so(request: pytest.FixtureRequest, name: str, solid: str) -> None:
    solids = {"ball": trimesh.creation.icosphere(4, 0.6), "box": trimesh.creation.box((1, 0.5, 1.5)).subdivide_loop(5)}
    found = request.getfixturevalue(name).fit_scan((solids[solid].vertices, solids[solid].faces))
    assert found.status is FitStatus.POOR
    assert "set scale=free" in found.reason
    assert found.explained < 0.9
    assert "not a shape of this model" in found.reason


@pytest.mark.parametrize("known", ["landmarks", pytest.param("fixed", marks=pytest.mark.long)])
def test_a_mirrored_scan_is_told_so(
    figure: ShapeModel, plain: Plain, monkeypatch: pytest.MonkeyPatch, known: str
) -> None:
    # Fixed coordinates of arms and legs distinguish left from right, in a pose that is far from its own mirror image.
    monkeypatch.setattr("shapespace.model.fit.SETTINGS", replace(SETTINGS, attempts=()))
    given, whole = plain(3)
    flip = np.array([-1, 1, 1])
    some = np.linspace(0, len(given.shape) - 1, 6).astype(int)
    options = {
        "landmarks": [Landmark(int(vertex), (given.shape[vertex] * flip).tolist()) for vertex in some],
        "fixed": {k: float(value) for k, value in enumerate(given.code) if k < 18},
    }
    found = figure.fit_scan(given.points() * flip, **{known: options[known]})
    assert found.status is FitStatus.POOR
    assert found.mirrored < 0.6
    assert "mirror image" in found.reason
    assert whole.mirrored is None


def test_distances_of_each_point_come_in_its_order(figure: ShapeModel, plain: Plain) -> None:
    given, whole = plain(1)
    points = given.points(3500)
    points[17] += given.size
    found = figure.fit_scan(points, points=True)
    assert found.scan.points.shape == (3500,)
    assert found.model.points.shape == (len(figure.vertices),)
    assert found.scan.points.argmax() == 17
    assert whole.scan.points is None


def test_the_box_keeps_codes_inside_the_bounds(figure: ShapeModel) -> None:
    code = figure.population.mean.copy()
    code[0] = figure.upper[0] + 0.2 * (figure.upper[0] - figure.lower[0])
    given = Moved.of(figure, 1, code=code)
    free, boxed = (figure.fit_scan(given.points(), distribution=name) for name in ("population", "box"))
    assert free.code[0] > figure.upper[0] + 0.1
    assert (boxed.code <= figure.upper.astype(np.float32)).all()
    assert (boxed.code >= figure.lower.astype(np.float32)).all()


def test_a_deadline_ends_a_fit_with_what_there_is(figure: ShapeModel) -> None:
    late = Deadline(60)
    late.call_off()
    found = figure.fit_scan(Moved.of(figure, 1).points(), deadline=late)
    assert found.status is FitStatus.DEADLINE
    assert found.rough < 12
    assert np.isfinite(found.covariance).all()
    assert np.isfinite(found.code).all()


CLOUD = np.random.default_rng(0).standard_normal((50, 3))


def test_one_stray_however_far_changes_nothing(figure: ShapeModel, plain: Plain) -> None:
    given, whole = plain(1)
    strayed = figure.fit_scan(np.concatenate([given.points(), [[1e8, 0, 0]]]))
    assert whole.status is strayed.status is FitStatus.CONVERGED
    away = strayed.placement(strayed.shape.vertices) - whole.placement(whole.shape.vertices)
    assert np.linalg.norm(away, axis=1).mean() < 1e-3


def test_points_with_a_few_faces_among_them_are_points(figure: ShapeModel) -> None:
    assert figure.fit_scan((figure.decode(np.full(20, 0.1)), [[0, 1, 2]])).status is FitStatus.CONVERGED


@pytest.mark.parametrize(
    ("points", "options", "says"),
    [
        (CLOUD[:9], {}, "9 points"),
        (np.zeros((0, 3)), {}, "0 points"),
        (CLOUD[:, :2], {}, "(N, 3)"),
        (np.where(np.arange(50)[:, None] == 3, np.nan, CLOUD), {}, "Point 3"),
        (CLOUD * [1, 0, 1], {}, "in a plane"),
        (np.ones((50, 3)), {}, "are the same"),
        (np.concatenate([np.zeros((990, 3)), CLOUD[:10]]), {}, "at one place"),
        (CLOUD, {"noise": 1e200}, "noise"),
        (CLOUD, {"scale": "free", "landmarks": [Landmark(5, [0, 0, 0])] * 3}, "at one place"),
        (1e-200 * CLOUD, {"scale": "free"}, "too small"),
        ((CLOUD, [[0, 1, 50]]), {}, "0 to 50"),
        (CLOUD, {"noise": 0.0}, "noise"),
        (CLOUD, {"noise": np.nan}, "noise"),
        (CLOUD, {"fixed": {20: 0.0}}, "coordinate 20"),
        (CLOUD, {"fixed": {-1: 0.0}}, "coordinate -1"),
        (CLOUD, {"fixed": {1: np.inf}}, "fixed[1]"),
        (CLOUD, {"fixed": {0: 1e6}}, "far outside"),
        (CLOUD, {"fixed": dict.fromkeys(range(20), 0.0)}, "all coordinates"),
        (CLOUD, {"landmarks": [Landmark(4601, [0, 0, 0])]}, "0 to 4600"),
        (CLOUD, {"landmarks": [Landmark(0, [0, np.nan, 0])]}, r"landmarks[0].position"),
        (CLOUD, {"landmarks": [Landmark(0, [0, 0, 0], 0.0)]}, r"landmarks[0].sigma"),
        (1000 * CLOUD, {}, "scale=free"),
        (1e-3 * CLOUD, {}, "scale=free"),
        (1e-3 * CLOUD, {"partial": True}, "scale=free"),
    ],
)
def test_bad_input_is_refused_with_what_to_do(figure: ShapeModel, points: object, options: dict, says: str) -> None:
    with pytest.raises((InvalidScanError, InvalidFixedError)) as caught:
        figure.fit_scan(points, **options)
    assert says in str(caught.value)
