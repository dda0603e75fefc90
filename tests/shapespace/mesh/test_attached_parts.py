"""Attached parts: their anchors, and their positions beside a moving surface."""

import numpy as np
import pytest
import trimesh

from shapespace.mesh.attached_parts import attach_part
from shapespace.mesh.prolongation import AttachedPart, Prolongation, ProlongationError
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import TriangleMesh

SPHERE = trimesh.creation.icosphere(2)
BODY = TriangleMesh.from_arrays(SPHERE.vertices * [3, 1, 1], SPHERE.faces)
BALL = trimesh.creation.icosphere(1, 0.2)


def bent(points: np.ndarray, angle: float) -> np.ndarray:
    """Rotate points beyond x = 1 about an axis there, by an angle that grows with the distance."""
    x, y, z = points.T
    turn = angle * np.clip(x - 1, 0, None)
    return np.stack([np.where(x > 1, 1 + (x - 1) * np.cos(turn) - z * np.sin(turn), x), y,
                     np.where(x > 1, (x - 1) * np.sin(turn) + z * np.cos(turn), z)], axis=1)  # fmt: skip


ANGLES = (0.0, 0.2, 0.4, -0.3, -0.5)
SHAPES = np.stack([bent(BODY.vertices, angle) for angle in ANGLES])


def both(part: np.ndarray, faces: np.ndarray) -> tuple[TriangleMesh, np.ndarray]:
    """Join the body and a part to one mesh; returns it and the vertices of the part."""
    count = len(BODY.vertices)
    fine = TriangleMesh.from_arrays(np.concatenate([BODY.vertices, part]), np.concatenate([BODY.faces, faces + count]))
    return fine, count + np.arange(len(part))


def attach(part: np.ndarray, moved: np.ndarray, faces: np.ndarray = BALL.faces) -> tuple[AttachedPart, Prolongation]:
    fine, index = both(part, faces)
    attached = attach_part(BODY, part, index, SHAPES, moved)
    return attached, Prolongation.of(BODY, fine, [attached])


def rigidly_moved(part: np.ndarray) -> np.ndarray:
    """Positions of a part that moves rigidly with the body."""
    return np.stack([align(part, bent(part, angle)) for angle in ANGLES])


EYE = BALL.vertices + np.array([2.4, 0, 0.7])


def test_a_rigid_part_keeps_its_form_and_stays_close() -> None:
    moved = rigidly_moved(EYE)
    attached, prolong = attach(EYE, moved)
    assert attached.rigid
    assert attached.weights.sum() == pytest.approx(1)
    index = attached.vertices
    for shape, truth in zip(SHAPES, moved, strict=True):
        there = prolong(shape)[index]
        np.testing.assert_allclose(align(EYE, there), there, atol=1e-12)
        assert np.linalg.norm(there - truth, axis=1).mean() < 0.02
    # All other vertices are where they would be without the part.
    np.testing.assert_array_equal(prolong(SHAPES[1])[: len(BODY.vertices)], Prolongation.of(BODY, BODY)(SHAPES[1]))


def test_a_part_that_changes_its_form_moves_affinely() -> None:
    stretches = (1.0, 1.3, 1.6, 0.8, 0.6)
    shapes = np.stack([BODY.vertices * [1, 1, k] for k in stretches])
    moved = np.stack([EYE * [1, 1, k] for k in stretches])
    fine, index = both(EYE, BALL.faces)
    attached = attach_part(BODY, EYE, index, shapes, moved)
    assert not attached.rigid
    prolong = Prolongation.of(BODY, fine, [attached])
    np.testing.assert_allclose(prolong(shapes[2])[index], moved[2], atol=0.08)


def test_anchors_move_like_the_part_and_need_not_be_the_nearest_vertices() -> None:
    # The ball is above the end that bends, and moves with the end that does not.
    part = BALL.vertices + np.array([2.0, 0, 1.1])
    moved = np.repeat(part[None], len(ANGLES), axis=0)
    attached, prolong = attach(part, moved)
    assert BODY.vertices[attached.anchors, 0].max() < 1.5
    assert max(np.abs(prolong(shape)[attached.vertices] - part).max() for shape in SHAPES) < 0.1


@pytest.mark.parametrize("rigid", [True, False])
def test_parts_move_with_the_shape(rigid: bool, rng: np.random.Generator) -> None:
    fine, index = both(EYE, BALL.faces)
    prolong = Prolongation.of(BODY, fine, [AttachedPart(index, np.array([3, 9]), np.array([0.25, 0.75]), rigid)])
    np.testing.assert_allclose(prolong(BODY.vertices), fine.vertices, atol=1e-12)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    np.testing.assert_allclose(prolong(SHAPES[1] @ turn + [1, 2, 3]), prolong(SHAPES[1]) @ turn + [1, 2, 3], atol=1e-12)
    assert (np.abs(prolong(2 * BODY.vertices) - 2 * fine.vertices).max() < 1e-12) == (not rigid)


def test_what_a_file_holds_is_read_back() -> None:
    _, prolong = attach(EYE, rigidly_moved(EYE))
    again = Prolongation.from_arrays(prolong.arrays())
    np.testing.assert_array_equal(again(SHAPES[2]), prolong(SHAPES[2]))
    assert not Prolongation.from_arrays(Prolongation.of(BODY, BODY).arrays()).rigid


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("rigid", lambda array: array[:-1]),
        ("rest", lambda array: array[:-1]),
        ("rest", lambda array: array * np.nan),
        ("rigid", lambda array: array.astype(float)),
        ("rest", None),
    ],
)
def test_arrays_of_rigid_parts_that_do_not_fit_are_refused(name: str, change) -> None:  # type: ignore[no-untyped-def]
    arrays = attach(EYE, rigidly_moved(EYE))[1].arrays()
    key = f"prolongation_{name}"
    arrays = arrays | {key: change(arrays[key])} if change else {k: v for k, v in arrays.items() if k != key}
    with pytest.raises(ProlongationError, match="prolongation_"):
        Prolongation.from_arrays(arrays)
