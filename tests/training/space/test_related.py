"""Shapes that are held out together."""

import numpy as np
import pytest

from shapespace.arrays import FloatArray, IntArray
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.shell.energy import Material
from shapespace.training.runs.settings import ModeSettings
from shapespace.training.space.generalisation import vertex_distances
from shapespace.training.space.geometry import choose_geometry
from shapespace.training.space.held_out import held_out
from shapespace.training.space.modes import left_of_held_out
from shapespace.training.space.related import Related

#: Three subjects with three, two and one shape; the last two rows are mirror images of shapes 0 and 3.
SUBJECTS = Related(np.array([0, 1, 2, 3, 4, 5, 0, 3]), np.array([0, 0, 0, 1, 1, 2]))


@pytest.mark.parametrize(("count", "parts"), [(3, 3), (9, 9), (10, 5), (57, 5)])
def test_folds_hold_every_shape_out_once(count: int, parts: int) -> None:
    found = Related.none(count).folds()
    assert len(found) == parts
    assert sorted(np.concatenate(found)) == list(range(count))


@pytest.mark.parametrize(("count", "most"), [(3, 1), (5, 3), (10, 7), (47, 36)])
def test_there_are_no_more_modes_than_folds_support(count: int, most: int) -> None:
    assert Related.none(count).most_modes == most
    images = np.concatenate([np.arange(count)] * 2)
    assert Related.images(images).most_modes == most, "an image is no further shape"


def test_groups_are_held_out_as_a_whole() -> None:
    assert [each.tolist() for each in SUBJECTS.folds()] == [[0, 1, 2], [3, 4], [5]]
    assert SUBJECTS.without(np.array([1])).tolist() == [3, 4, 5, 7], "with the images of related shapes"
    held = [each.tolist() for each, _ in SUBJECTS.inner_folds()]
    kept = [each.tolist() for _, each in SUBJECTS.inner_folds()]
    assert held == [[0, 1, 2, 6], [3, 4, 7], [5]]
    assert kept == [[3, 4, 5, 7], [0, 1, 2, 5, 6], [0, 1, 2, 3, 4, 6, 7]]
    assert SUBJECTS.most_modes == 2, "the fold without the first subject keeps three originals"


@pytest.mark.parametrize(("groups", "parts"), [(3, 3), (7, 5), (30, 5)])
def test_many_shapes_in_few_groups_have_few_folds(groups: int, parts: int) -> None:
    related = Related(np.arange(60), np.arange(60) % groups)
    assert len(related.folds()) == parts
    assert not related.few


def test_a_part_keeps_its_relations() -> None:
    some = SUBJECTS.some(np.array([1, 3, 4, 7]))
    assert some.original.tolist() == [0, 1, 2, 1]
    assert some.group.tolist() == [0, 1, 1]


@pytest.mark.parametrize("group", [np.arange(336) % 14, np.arange(336) // 14])
def test_every_group_has_shapes_among_a_hundred(group: IntArray) -> None:
    """Every fourth of 24 bodies in 14 poses would have only every second pose."""
    related = Related(np.arange(336), group)
    used = related.spread(100)
    assert used.sum() == 84
    assert related.some(used).groups == related.groups


def test_local_fields_are_held_out_with_their_shapes() -> None:
    folds = SUBJECTS.with_local(np.empty((8, 3, 1, 3))).inner_folds()
    whose = SUBJECTS.group[np.concatenate([SUBJECTS.original, np.repeat(SUBJECTS.original, 3)])]
    assert sorted(np.concatenate([held for held, _ in folds])) == list(range(8)), "each shape once, no local field"
    for held, kept in folds:
        assert not set(whose[held]) & set(whose[kept])
        assert set(whose[held]) | set(whose[kept]) == {0, 1, 2}


@pytest.fixture
def scans(ellipsoid: TriangleMesh, rng: np.random.Generator) -> tuple[FloatArray, Related]:
    """Twelve subjects, each with its own direction, in three scans that differ a little."""
    own = rng.normal(size=(12, 1, *ellipsoid.vertices.shape))
    every = 0.02 * own + 0.002 * rng.normal(size=(12, 3, *ellipsoid.vertices.shape))
    shapes = (ellipsoid.vertices + every).reshape(36, *ellipsoid.vertices.shape)
    return shapes, Related(np.arange(36), np.repeat(np.arange(12), 3))


def test_scans_of_a_subject_tell_nothing_of_other_subjects(
    ellipsoid: TriangleMesh, scans: tuple[FloatArray, Related]
) -> None:
    """Noise is the same for all subjects, so no mode helps. By the other scans, each subject seems known."""
    shapes, related = scans
    rows = (shapes - shapes.mean(axis=0)).reshape(36, -1)
    gram = rows @ rows.T

    def left(who: Related) -> float:
        errors = left_of_held_out(gram, who)
        return float(np.sqrt(errors[:, who.most_modes]).mean() / np.sqrt(errors[:, 0]).mean())

    assert left(Related.none(36)) < 0.3
    assert left(related) > 0.8
    settings = ModeSettings(geometry="vertices")
    alone = choose_geometry(settings, ellipsoid, shapes, Material(), vary=False)
    together = choose_geometry(settings, ellipsoid, shapes, Material(), related, vary=False)
    assert alone.count is not None
    assert together.count is not None
    assert together.count < alone.count


def test_an_error_on_unseen_shapes_leaves_out_their_relatives(
    ellipsoid: TriangleMesh, scans: tuple[FloatArray, Related]
) -> None:
    shapes, related = scans
    settings, index = ModeSettings(geometry="vertices", count=11), np.array([0])

    def error(who: Related | None) -> float:
        found = held_out(ellipsoid, shapes, index, None, settings, Material(), related=who, remember=False)
        return float(found.distances(shapes, ellipsoid.diagonal)["modes"][-1].mean())

    subject = float(vertex_distances(shapes[[0]], shapes[[3]], ellipsoid.diagonal).mean())
    assert error(None) < 0.2 * subject
    assert error(related) > 0.5 * subject
