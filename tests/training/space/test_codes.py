"""Codes of shapes and their bounds, on an ellipsoid with known modes."""

import numpy as np
import pytest
import trimesh

from shapespace.mesh.rigid_motion import align, without_rigid_motion
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.shell.exponential import exponential
from shapespace.shell.space import ShellSpace
from shapespace.training.runs.settings import ModeSettings
from shapespace.training.space import codes
from shapespace.training.space.codes import STEPS_ERROR, box_of, enough_steps, exponential_map, nearest_codes
from shapespace.training.space.memory import RememberingMap
from shapespace.training.space.modes import mode_count, pga

STEPS = 4


@pytest.fixture(scope="module")
def space() -> ShellSpace:
    ball = trimesh.creation.icosphere(subdivisions=2)
    return ShellSpace(TriangleMesh.from_arrays(ball.vertices * [2, 1, 1], ball.faces))


@pytest.fixture(scope="module")
def modes(space: ShellSpace) -> np.ndarray:
    x = space.reference.vertices
    bend = np.stack([np.zeros(len(x)), np.zeros(len(x)), 0.1 * x[:, 0] ** 2], axis=1)
    stretch = 0.2 * x * [1, 0, 0]
    return without_rigid_motion(np.stack([bend, stretch]), x)


def shot(space: ShellSpace, modes: np.ndarray, code: np.ndarray) -> np.ndarray:
    path = exponential(space, space.reference.vertices, np.tensordot(code, modes, 1), STEPS)
    assert path.converged
    return path.vertices[-1]


def test_codes_of_exponentials_come_back_in_any_pose(space, modes, rng):
    codes = np.array([[0.8, -0.5], [-1.0, 0.9], [0.0, 0.0]])
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    turn *= np.linalg.det(turn)
    shapes = np.stack([shot(space, modes, code) @ turn + [3, 2, 1] for code in codes])
    start = codes + 0.3 * rng.standard_normal(codes.shape)
    found = nearest_codes(space, space.reference.vertices, modes, shapes, start, STEPS, workers=1)
    assert found.codes == pytest.approx(codes, abs=2e-3)
    assert found.vertices == pytest.approx(shapes, abs=2e-3)
    assert max(found.exponentials) < 10


def test_a_code_is_a_minimum_for_a_shape_that_no_code_has(space, modes, rng):
    smooth = np.sin(space.reference.vertices @ rng.standard_normal((3, 3)))
    shape = shot(space, modes, np.array([0.5, 0.5])) + 0.1 * smooth

    def misfit(code: np.ndarray) -> float:
        return float(((align(shot(space, modes, code), shape) - shape) ** 2).sum())

    start = np.zeros((1, 2)) + 0.1
    (found,) = nearest_codes(space, space.reference.vertices, modes, shape[None], start, STEPS, workers=1).codes
    for step in 0.05 * np.eye(2):
        assert misfit(found) < min(misfit(found + step), misfit(found - step))


def test_a_start_that_has_no_exponential_is_shortened(space, modes):
    shape = shot(space, modes, np.array([0.5, -0.5]))
    far = np.array([[0.0, -10.0]])
    path = exponential(space, space.reference.vertices, np.tensordot(far[0], modes, 1), STEPS)
    assert not path.converged
    found = nearest_codes(space, space.reference.vertices, modes, shape[None], far, STEPS, workers=1)
    assert found.codes[0] == pytest.approx([0.5, -0.5], abs=5e-3)


def test_bounds_hold_every_code_with_room_and_the_mean():
    codes = np.array([[1.0, -2.0, 0.5], [3.0, 2.0, 0.6]])
    lower, upper = box_of(codes)
    assert upper == pytest.approx([3.1, 2.2, 0.605])
    assert lower == pytest.approx([-0.31, -2.2, -0.0605])


def test_as_many_modes_as_pay(space, rng):
    """Three strong directions and many weak ones: more than three modes hardly reduce the error."""
    x = space.reference.vertices
    strong = np.stack([np.sin(x @ rng.standard_normal((3, 3))) for _ in range(3)])
    weak = 0.003 * np.stack([np.sin(x @ (3 * rng.standard_normal((3, 3)))) for _ in range(20)])
    mixed = [np.tensordot(rng.standard_normal((25, len(some))), some, 1) for some in (strong, weak)]
    fields = without_rigid_motion(0.05 * sum(mixed), x)
    assert mode_count(ModeSettings(), space, x, fields).count == 3
    assert mode_count(ModeSettings(count=7), space, x, fields).count == 7
    assert mode_count(ModeSettings(count=70), space, x, fields).count == 24
    assert len(pga(space, x, fields, 24)) > 20
    assert mode_count(ModeSettings(), space, x, fields[:2]).count == 1
    assert mode_count(ModeSettings(), space, x, fields[:1]).count == 1
    assert mode_count(ModeSettings(), space, x, np.repeat(fields[:1], 6, axis=0)).count == 1


def test_the_number_of_steps_grows_with_the_distance_of_the_codes(
    space: ShellSpace, modes: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(codes, "STEPS_CODES", 4)
    mean, near = space.reference.vertices, np.array([[-1.0, -1.0], [1.0, 1.0]])
    few, more = (enough_steps(space, mean, modes, reach * near, workers=1) for reach in (0.3, 3))
    assert few == 8
    assert more > few
    assert STEPS_ERROR == 1e-5, "a tenth of the error of good networks"


def test_exponentials_remember_alike_in_one_process_and_in_two(space, modes, rng):
    codes = rng.uniform(-0.8, 0.8, (4, 2))
    shapes = np.stack([shot(space, modes, code) for code in codes]) + 0.02 * rng.standard_normal((4, 1, 3))
    shapes += 0.02 * shapes**2
    units, unseen = np.ones(2), shapes[:2] + 0.02 * rng.standard_normal(shapes[:2].shape)
    plain = exponential_map(space, space.reference.vertices, modes, STEPS)
    start = nearest_codes(space, space.reference.vertices, modes, unseen, codes[:2], STEPS, workers=1)
    one, two = (RememberingMap(plain, codes, shapes, units, workers).nearest(unseen, start) for workers in (1, 2))
    np.testing.assert_array_equal(one.codes, two.codes)
    np.testing.assert_array_equal(one.vertices, two.vertices)
    away, without = (np.linalg.norm(found.vertices - unseen) for found in (one, start))
    assert away < without
