"""Edits: targets are reached, other vertices and fixed coordinates stay, and the covariance is right."""

from collections.abc import Iterator

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from benchmarks.edit import PULL, Pull, limbs, pulls
from shapespace.arrays import FloatArray
from shapespace.mesh.rigid_motion import Placement, weighted_change
from shapespace.model.decoder import MeshChoice
from shapespace.model.edit import InvalidTargetError
from shapespace.model.edit_search import SETTINGS
from shapespace.model.latent_space import InvalidFixedError
from shapespace.model.options import EditOptions, PriorKind, Target
from shapespace.model.shape_model import ShapeModel

CODE = np.array([0.1, 0.7, 0.4])


@pytest.fixture(scope="module")
def pulled(figure: ShapeModel) -> Iterator[list[Pull]]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("benchmarks.edit.LOOKED_AT", 1)
        yield pulls(figure, 3, 1)


@pytest.mark.parametrize("kind", list(PriorKind))
def test_a_limb_follows_and_the_others_stay(figure: ShapeModel, pulled: list[Pull], kind: PriorKind) -> None:
    parts, moved, changed = limbs(), [], []
    for pull in pulled:
        found = figure.edit(pull.start, [pull.target], prior_kind=kind)
        now = found.placement(figure.decode(found.code))
        others = np.logical_or.reduce([limb for name, limb in parts.items() if name != pull.limb])
        moved.append(np.linalg.norm(now - pull.before, axis=1)[others].mean())
        assert np.linalg.norm(now[pull.target.vertex] - pull.target.position) < 0.01 * PULL
        change = np.abs(found.code - pull.start) / figure.latents.width
        changed.append(sum(change[f.start : f.stop].max() > 0.01 for f in figure.manifest.factors))
    assert np.mean(moved) < 0.02
    # With GROUPS few factors change, three at most; with RIDGE many change a little.
    assert (np.mean(changed) < 3) == (kind is PriorKind.GROUPS)


@pytest.mark.parametrize("mesh", ["fine", "coarse"])
def test_the_placement_takes_the_new_shape_to_where_the_old_one_is(model: ShapeModel, mesh: str) -> None:
    before, goal = model.decode(CODE, mesh), model.decode([-0.1, 0.9, 0.8], mesh)
    turn = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
    for targets in ({v: goal[v] for v in (3, 20, 45)}, {v: goal[v] @ turn.T + [1, 2, 3] for v in (3, 20, 45, 60)}):
        found = model.edit(CODE, targets, mesh=mesh)
        rotation = found.placement.rotation
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1)
        assert found.placement.scale == 1
        placed = model.decode(found.code, mesh) @ rotation.T + found.placement.translation
        away = [np.linalg.norm(placed[v] - place) for v, place in targets.items()]
        np.testing.assert_allclose(found.distances, away, atol=1e-9)
        assert found.residual < 0.01 * np.linalg.norm(np.ptp(before, axis=0))
    unmoved = model.edit(CODE, {v: before[v] for v in (3, 20)}, mesh=mesh)
    np.testing.assert_allclose(unmoved.code, CODE, atol=1e-5)
    np.testing.assert_allclose(unmoved.placement(before), before, atol=1e-4)


def objective(
    model: ShapeModel, code: FloatArray, pulled: dict[int, FloatArray], prior: float, kind: PriorKind, mesh: str
) -> float:
    """What an edit from CODE minimises, term by term, with a general minimiser over rigid motions."""
    diagonal = model.manifest.scale * model.reference.diagonal
    vertices, choice = list(pulled), MeshChoice(mesh)
    coarse = model.decoder.fine.prolong.coarse_vertices if model.decoder.fine and mesh == "fine" else slice(None)
    before, shape = (model.decode(x, choice) for x in (CODE, code))

    def misfit(motion: FloatArray) -> float:
        moved = Rotation.from_rotvec(motion[:3]).apply(shape) + motion[3:]
        away = ((moved[vertices] - list(pulled.values())) ** 2).sum(axis=1) / diagonal**2
        square = ((moved - before)[coarse] ** 2).sum(axis=1) / diagonal**2
        return float(
            away.mean()
            + SETTINGS.still * (2 * SETTINGS.small * (np.sqrt(square + SETTINGS.small**2) - SETTINGS.small)).mean()
        )

    change = (code - CODE) / model.latents.width
    norms = [np.linalg.norm(change[f.start : f.stop]) for f in model.manifest.factors]
    penalty = change @ change if kind is PriorKind.RIDGE else np.sum(norms) ** 2
    found = minimize(misfit, np.zeros(6), tol=1e-12)
    return float(found.fun) + prior / len(code) * float(penalty)


@pytest.mark.parametrize("kind", list(PriorKind))
@pytest.mark.parametrize("mesh", ["fine", "coarse"])
def test_an_edit_is_the_best_compromise(model: ShapeModel, mesh: str, kind: PriorKind) -> None:
    shape = model.decode([-0.1, 0.2, 0.8], mesh)
    noise = np.random.default_rng(1).normal(0, 0.03, (3, 3))
    pulled = {v: shape[v] + by for v, by in zip((3, 20, 45), noise, strict=True)}
    found = model.edit(CODE, pulled, prior=1e-3, mesh=mesh, prior_kind=kind)
    best = found.code.astype(np.float64)
    cost = objective(model, best, pulled, 1e-3, kind, mesh)
    assert cost < 0.9 * objective(model, CODE, pulled, 1e-3, kind, mesh)
    for direction in np.vstack([np.diag(model.latents.width), -np.diag(model.latents.width)]):
        trial = np.clip(best + 0.03 * direction, model.lower, model.upper)
        assert objective(model, trial, pulled, 1e-3, kind, mesh) >= cost * (1 - 1e-3)


def test_what_is_fixed_is_kept_to_the_last_bit(model: ShapeModel) -> None:
    shape = model.decode([-0.1, 0.9, 0.8])
    targets = {v: shape[v] for v in (3, 20, 45)}
    free = model.edit(CODE, targets)
    for fixed in ({1: 0.65}, {0: 0.3, 2: 0.4}, {0: 0.1, 1: 0.7, 2: 0.4}):  # the second outside the bounds
        found = model.edit(CODE, targets, fixed=fixed, samples=4)
        for index, value in fixed.items():
            assert found.code[index] == np.float32(value)
            assert not found.covariance[index].any()
            assert not found.covariance[:, index].any()
            assert (found.samples[:, index] == np.float32(value)).all()
        for index in {0, 1, 2} - fixed.keys():
            assert found.code[index] != np.float32(CODE[index])
            assert found.covariance[index, index] > 0
        assert found.residual > free.residual
    wrapped = model.edit(CODE, targets, fixed={1: 0.65 + 2 * np.pi})
    assert wrapped.code[1] == pytest.approx(0.65, abs=1e-6)
    for fixed in ({3: 0.0}, {-1: 0.0}):
        with pytest.raises(InvalidFixedError, match="coordinates 0 to 2"):
            model.edit(CODE, targets, fixed=fixed)
    with pytest.raises(InvalidFixedError, match="not a finite number"):
        model.edit(CODE, targets, fixed={0: np.nan})


def test_fixed_values_far_outside_the_bounds_and_names_are_refused(figure: ShapeModel) -> None:
    for fixed, says in (
        ({0: 1e15}, r"fixed\[0\] \(.*\) is 1e\+15, far outside"),
        ({"3": 0.1}, "coordinate '3', but .* whole numbers"),
        ({7: -1e6}, r"fixed\[7\] \(left knee\) is -1e\+06, far outside"),
        ({"left knee": 0.1}, "coordinate 'left knee', but .* 0 to 19, whole numbers. left knee is 7"),
        ({"left kne": 0.1}, "coordinate 'left kne', but .* 0 to 19, whole numbers.$"),
    ):
        with pytest.raises(InvalidFixedError, match=says):
            figure.edit(np.zeros(20), {0: figure.vertices[0]}, fixed=fixed)


def test_targets_count_by_their_sigma(model: ShapeModel) -> None:
    shape = model.decode(CODE)
    apart = np.array([0.02, 0, 0])
    pulled = [Target(3, (shape[3] - apart).tolist(), 0.001), Target(3, (shape[3] + apart).tolist(), 0.002)]
    start = CODE.astype(np.float32)
    found = model.edit(start, pulled)
    # Half the sigma has four times the weight: a fifth of the way from that target.
    np.testing.assert_allclose(found.distances, [0.008, 0.032], atol=1e-3)
    everywhere = model.edit(CODE, {3: shape[3] + apart, 20: shape[20]}, sigma=SETTINGS.sigma * shape_diagonal(model))
    plain = model.edit(CODE, {3: shape[3] + apart, 20: shape[20]})
    np.testing.assert_allclose(everywhere.code, plain.code, atol=1e-6)
    for sigma in (0, -1, np.nan, np.inf):
        with pytest.raises(InvalidTargetError, match=r"targets\[0\].sigma is"):
            model.edit(CODE, {3: shape[3]}, sigma=sigma)


def shape_diagonal(model: ShapeModel) -> float:
    return model.manifest.scale * model.reference.diagonal


@pytest.mark.parametrize("fixed", [{}, {1: 0.9}])
def test_the_covariance_is_the_inverse_of_what_differences_find(model: ShapeModel, fixed: dict[int, float]) -> None:
    goal = model.decode([-0.05, 0.9, 0.6])
    targets, sigma = {v: goal[v] for v in (3, 200)}, 0.1
    found = model.edit(CODE, targets, sigma=sigma, fixed=fixed, prior=1e-8)
    vertices, h = list(targets), 2e-3 * model.latents.width

    # The positions reached, in a fixed pose.
    def reached(code: FloatArray) -> FloatArray:
        placed: FloatArray = found.placement(model.decode(code))[vertices]
        return placed.ravel()

    slopes = np.stack([(reached(found.code + d) - reached(found.code - d)) / (2 * d.max()) for d in np.diag(h)])
    free = [k for k in range(3) if k not in fixed]
    precision = slopes @ slopes.T / sigma**2 + np.linalg.inv(model.population.covariance)
    expected = np.zeros((3, 3))
    expected[np.ix_(free, free)] = np.linalg.inv(precision[np.ix_(free, free)])
    np.testing.assert_allclose(found.covariance, expected, rtol=0.03, atol=1e-3 * np.abs(expected).max())
    assert (np.diag(found.covariance) < np.diag(model.population.covariance)).all()


def test_samples_have_the_covariance_that_is_answered(model: ShapeModel) -> None:
    shape = model.decode(CODE)
    found = model.edit(CODE, {3: shape[3]}, samples=4000, seed=5)
    away = model.latents.shorter(found.samples.astype(np.float64) - found.code)
    spread = np.sqrt(np.diag(found.covariance))
    np.testing.assert_allclose(away.mean(axis=0) / spread, 0, atol=0.06)
    np.testing.assert_allclose(
        away.T @ away / 4000 / np.outer(spread, spread), found.covariance / np.outer(spread, spread), atol=0.08
    )
    again = model.edit(CODE, {3: shape[3]}, samples=10, seed=5).samples
    np.testing.assert_array_equal(found.samples[:10], again)
    assert not np.isin(again, model.edit(CODE, {3: shape[3]}, samples=10, seed=6).samples).any()
    assert model.edit(CODE, {3: shape[3]}).samples.shape == (0, 3)


def test_the_prior_holds_a_code_back_as_much_as_it_weighs(model: ShapeModel) -> None:
    shape = model.decode([-0.1, 0.2, 0.8])
    targets = {v: shape[v] for v in (0, 100, 300)}
    for kind in PriorKind:
        residuals = [model.edit(CODE, targets, prior=prior, prior_kind=kind).residual for prior in (0, 1e-2, 1)]
        assert residuals == sorted(residuals)
        held = model.edit(CODE, targets, prior=1e6, prior_kind=kind)
        np.testing.assert_allclose(held.code, CODE, atol=SETTINGS.unmoved)
    assert EditOptions().prior < 1e-2


def test_anchored_the_whole_stays_though_a_target_is_out_of_reach(figure: ShapeModel) -> None:
    before = figure.decode(np.zeros(20))
    hand, size = int(before[:, 0].argmax()), np.linalg.norm(np.ptp(before, axis=0))
    leg = next(factor for factor in figure.manifest.factors if factor.name == "left knee")
    locked = {k: 0.0 for k in range(20) if not leg.start <= k < leg.stop}
    target = {hand: before[hand] + [0, 0.25, 0]}
    away = {
        anchored: np.linalg.norm(found.placement(figure.decode(found.code)) - before, axis=1)
        for anchored in (False, True)
        for found in [figure.edit(np.zeros(20), target, fixed=locked, anchored=anchored)]
    }
    assert np.median(away[False]) > 0.03 * size
    assert np.median(away[True]) < 0.005 * size
    assert away[True][hand] < 0.01 * size
    # A target within reach is still met.
    assert figure.edit(np.zeros(20), target, anchored=True).residual < 1e-3 * size


def test_misfits_change_as_differences_say_whichever_weights_align() -> None:
    rng = np.random.default_rng(0)
    points, field = rng.standard_normal((2, 30, 3))
    weights, aligned = rng.uniform(0.1, 1, (2, 30))
    step = 1e-6

    def misfits(way: float) -> FloatArray:
        there = points + way * step * field
        return np.sqrt(weights)[:, None] * (Placement.between(there, points, aligned)(there) - points)

    found = weighted_change(field[None], points, weights, aligned)[0]
    np.testing.assert_allclose(found, (misfits(1) - misfits(-1)) / (2 * step), atol=1e-8)
