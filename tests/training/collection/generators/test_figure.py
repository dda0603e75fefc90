from __future__ import annotations

import numpy as np
import pytest

from shapespace.arrays import FloatArray
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.collection.generators import figure, mannequin


def smallest_angles(vertices: FloatArray, faces: np.ndarray) -> FloatArray:
    """Smallest angle of each face, in degrees."""
    p = vertices[faces]
    a, b = np.roll(p, -1, axis=1) - p, np.roll(p, 1, axis=1) - p
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b), axis=2), (a * b).sum(axis=2))).min(axis=1)


def volume(vertices: FloatArray, faces: np.ndarray) -> float:
    p, q, r = np.moveaxis(vertices[faces], 1, 0)
    return float((p * np.cross(q, r)).sum() / 6)


def angles(**values: float) -> FloatArray:
    return np.array([[values.get(name.replace(" ", "_"), 0.0) for name in figure.ANGLES]])


@pytest.fixture(scope="module")
def rest() -> TriangleMesh:
    return mannequin.rest()


@pytest.fixture(scope="module")
def collection() -> tuple[list[str], FloatArray, np.ndarray]:
    return figure.poses()


@pytest.fixture
def some(rng: np.random.Generator) -> FloatArray:
    """Random joint angles (20, D) between their bounds."""
    lower, upper = np.array(list(figure.ANGLES.values())).T
    return rng.uniform(lower, upper, (20, len(lower)))


def test_surface_is_a_closed_sphere_in_one_piece_facing_outward(rest: TriangleMesh) -> None:
    directed = rest.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    assert len(np.unique(directed, axis=0)) == len(directed)
    assert set(map(tuple, directed)) == set(map(tuple, directed[:, ::-1]))
    assert len(np.unique(rest.faces)) == len(rest.vertices)
    assert len(rest.vertices) - len(rest.edges) + len(rest.faces) == 2
    reached = np.zeros(len(rest.vertices), dtype=bool)
    reached[0] = True
    while (grown := reached[rest.edges].any(axis=1) & ~reached[rest.edges].all(axis=1)).any():
        reached[rest.edges[grown]] = True
    assert reached.all()
    assert 0.04 < volume(rest.vertices, rest.faces) < 0.08


def test_triangles_are_good(rest: TriangleMesh) -> None:
    assert 4000 <= len(rest.vertices) <= 5500
    smallest = smallest_angles(rest.vertices, rest.faces)
    assert smallest.min() > 25
    assert smallest.mean() > 50
    lengths = np.linalg.norm(np.diff(rest.vertices[rest.edges], axis=1), axis=2)
    assert lengths.max() < 4 * lengths.min()


def test_figure_stands_on_the_ground_and_is_as_tall_as_a_person(rest: TriangleMesh) -> None:
    assert np.isclose(rest.vertices[:, 1].min(), 0, atol=2e-3)
    assert 1.65 < rest.vertices[:, 1].max() < 1.75
    assert rest.vertices[rest.vertices[:, 1] < 0.05, 2].max() > 0.1, "toes point along z"


def test_left_is_the_mirror_image_of_right(rest: TriangleMesh) -> None:
    def ordered(vertices: FloatArray) -> np.ndarray:
        return np.lexsort(np.round(vertices, 9).T)

    here, there = ordered(rest.vertices), ordered(rest.vertices * [-1, 1, 1])
    image = np.empty_like(here)
    image[there] = here
    assert np.array_equal(rest.vertices[image], rest.vertices * [-1, 1, 1])
    faces = {frozenset(face) for face in rest.faces.tolist()}
    assert {frozenset(face) for face in image[rest.faces].tolist()} == faces


def test_meshing_again_gives_the_same_bits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mannequin, "RELAXATIONS", 1)
    once, again = mannequin.rest.__wrapped__(), mannequin.rest.__wrapped__()
    assert np.array_equal(again.vertices, once.vertices)
    assert np.array_equal(again.faces, once.faces)


def test_mirrored_angles_give_mirrored_shapes(some: FloatArray) -> None:
    def mirrored(name: str) -> str:
        swap = {"left": "right", "right": "left"}
        side, _, rest = name.partition(" ")
        return f"{swap.get(side, side)} {rest}"

    names = list(figure.ANGLES)
    odd = [name in ("spine lean", "spine twist", "head tilt", "head turn") for name in names]
    other = some[:, [names.index(mirrored(name)) for name in names]] * np.where(odd, -1, 1)

    def cloud(angles: FloatArray, sign: float) -> FloatArray:
        shapes = np.round(figure.pose(angles) * [sign, 1, 1], 7)
        return np.stack([shape[np.lexsort(shape.T)] for shape in shapes])

    assert np.allclose(cloud(other, 1), cloud(some, -1), atol=1e-6)


@pytest.mark.parametrize("name", figure.ANGLES)
def test_each_angle_moves_its_own_part_of_the_body_and_strains_no_triangle_too_much(
    rest: TriangleMesh, name: str
) -> None:
    most = {"spine": 0.65, "head": 0.2}.get(name.split(maxsplit=1)[0], 0.2)
    for bound in figure.ANGLES[name]:
        if bound == 0:
            continue
        shape = figure.pose(angles(**{name.replace(" ", "_"): bound}))[0]
        moved = np.abs(shape - rest.vertices).max(axis=1) > 1e-9
        assert 0.08 < moved.mean() < most
        if name.startswith("left"):
            assert rest.vertices[moved, 0].min() > -1e-9
        assert smallest_angles(shape, rest.faces).min() > 5
        assert np.isclose(volume(shape, rest.faces), volume(rest.vertices, rest.faces), rtol=0.05)


@pytest.mark.parametrize(
    ("name", "part", "direction"),
    [
        ("spine bend", "head", [0, -1, 1]),
        ("spine lean", "head", [1, 0, 0]),
        ("spine twist", "left hand", [0, 0, -1]),
        ("head nod", "head", [0, 0, 1]),
        ("head tilt", "head", [1, 0, 0]),
        ("head turn", "nose", [1, 0, 0]),
        ("left arm swing", "left hand", [0, 0, 1]),
        ("left arm raise", "left hand", [1, 1, 0]),
        ("left elbow", "left hand", [0, 0, 1]),
        ("left leg swing", "left foot", [0, 0, 1]),
        ("left leg spread", "left foot", [1, 0, 0]),
        ("left knee", "left foot", [0, 0, -1]),
    ],
)
def test_positive_angles_turn_the_way_their_names_say(
    rest: TriangleMesh, name: str, part: str, direction: list[float]
) -> None:
    outermost = {"head": [0, 1, 0], "nose": [0, 3, 1], "left hand": [1, 0, 0], "left foot": [0.2, -1, 0]}[part]
    tip = (rest.vertices @ outermost).argmax()
    motion = (figure.pose(angles(**{name.replace(" ", "_"): 0.2}))[0] - rest.vertices)[tip]
    assert motion @ direction > 0.9 * np.linalg.norm(motion) * np.linalg.norm(direction) * 0.75
    assert np.linalg.norm(motion) > 5e-3


def test_beyond_the_joints_the_motion_is_rigid(rest: TriangleMesh, some: FloatArray) -> None:
    hand = (rest.vertices - mannequin.ELBOW) @ mannequin.ARM > 0.07
    hand &= rest.vertices[:, 0] > mannequin.ELBOW[0]
    shin = (rest.vertices[:, 1] < 0.37) & (rest.vertices[:, 0] > 0)
    for part in (hand, shin, rest.vertices[:, 1] > 1.6):
        inside = part[rest.edges].all(axis=1)
        assert inside.sum() > 300
        lengths = np.linalg.norm(np.diff(figure.pose(some)[:, rest.edges[inside]], axis=2), axis=3)
        assert np.allclose(lengths, np.linalg.norm(np.diff(rest.vertices[rest.edges[inside]], axis=1), axis=2))


def test_collection_begins_at_rest_and_keeps_triangles_and_volume(
    collection: tuple[list[str], FloatArray, np.ndarray], rest: TriangleMesh
) -> None:
    names, vertices, faces = collection
    assert len(set(names)) == len(vertices) == 60
    assert names[0] == "rest"
    assert np.array_equal(vertices[0], rest.vertices)
    assert np.array_equal(faces, rest.faces)
    areas = np.stack([rest.with_vertices(shape).face_areas for shape in vertices])
    assert (areas / rest.face_areas).min() > 0.2
    assert min(smallest_angles(shape, faces).min() for shape in vertices) > 5
    volumes = np.array([volume(shape, faces) for shape in vertices])
    assert np.allclose(volumes, volumes[0], rtol=0.1)
    assert not any(figure._touches(shape) for shape in vertices)


def test_poses_differ_but_are_the_same_for_the_same_seed(collection: tuple[list[str], FloatArray, np.ndarray]) -> None:
    names, vertices, _ = collection
    again, same, _ = figure.poses(count=12)
    assert again == names[:12]
    assert np.array_equal(same, vertices[:12])
    _, others, _ = figure.poses(count=12, seed=1)
    known = len(figure.NAMED)
    assert np.array_equal(others[:known], vertices[:known])
    assert (np.abs(others[known:] - vertices[known:12]).max(axis=(1, 2)) > 0.05).all()
    assert (np.abs(np.diff(vertices, axis=0)).max(axis=(1, 2)) > 0.05).all()


def test_a_limb_that_touches_another_is_noticed(rest: TriangleMesh) -> None:
    inward = {"elbow": 2.1, "arm_swing": 1.2, "arm_twist": -1.2}
    crossed = angles(**{f"{side}_{name}": value for side in ("left", "right") for name, value in inward.items()})
    assert figure._touches(figure.pose(crossed)[0])
    assert not figure._touches(rest.vertices)


def test_faults_in_angles_and_count_are_named() -> None:
    with pytest.raises(figure.FigureError, match=r"angles must be \(n, 20\), not \(20,\)"):
        figure.pose(np.zeros(20))
    with pytest.raises(figure.FigureError, match="not finite"):
        figure.pose(angles(left_knee=np.nan))
    with pytest.raises(figure.FigureError, match="count must be at least 1"):
        figure.poses(count=0)


def test_bounds_hold_for_every_named_pose() -> None:
    for name, values in figure.NAMED.items():
        for angle, value in values.items():
            lower, upper = figure.ANGLES[angle]
            assert lower <= value <= upper, (name, angle)
