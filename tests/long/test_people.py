"""Bodies of the package ``anny`` itself; ``make long people`` installs it."""

import numpy as np
import pytest

from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.collection.generators import MESHES, people

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def body() -> people.AnnyBody:
    return people.AnnyBody()


@pytest.mark.parametrize("generator", ["expressive", "people"])
def test_shapes_are_closed_bodies_with_a_volume_like_at_rest(generator: str) -> None:
    meshes = MESHES[generator]()
    mesh = TriangleMesh.from_arrays(meshes.vertices[0], meshes.faces)
    assert len(mesh.vertices) - len(mesh.edges) + len(mesh.faces) == 2
    p, q, r = np.moveaxis(meshes.vertices[:, meshes.faces], 2, 0)
    volumes = (p * np.cross(q, r)).sum(axis=(1, 2)) / 6
    assert (volumes > 0.02).all()
    assert (volumes < 0.25).all()
    if generator == "expressive":
        assert np.abs(volumes / volumes[0] - 1).max() < 0.1
        assert 1.5 < np.ptp(meshes.vertices[0, :, 2]) < 1.8


def moved(body: people.AnnyBody, **angles: float) -> np.ndarray:
    """Return where each vertex moves, from rest."""
    row = people._row({name.replace("_", " "): angle for name, angle in angles.items()})
    return body.vertices(row[None])[0] - body.rest


def test_angles_turn_the_way_their_names_say(body: people.AnnyBody) -> None:
    x, _, z = body.rest.T
    left, hand, foot, top = x > 0.1, x > 0.45, (z < 0.1) & (x > 0.1), z > 1.4
    assert moved(body, left_arm_raise=0.5)[hand, 2].min() > 0.1, "upwards"
    assert moved(body, left_arm_swing=0.5)[hand, 1].max() < -0.1, "forwards"
    assert moved(body, left_elbow=0.8)[hand, 1].max() < -0.05, "forwards"
    assert moved(body, left_leg_swing=0.5)[foot, 1].max() < -0.1, "forwards"
    assert moved(body, left_leg_spread=0.4)[foot, 0].min() > 0.1, "outwards"
    assert moved(body, left_knee=1.0)[foot, 1].min() > 0.1, "backwards"
    assert moved(body, spine_bend=0.5)[top, 1].max() < -0.05, "forwards"
    assert moved(body, spine_lean=0.3)[top, 0].min() > 0.05, "to the left"
    assert np.abs(moved(body, right_arm_raise=0.5, right_knee=1.0)[left]).max() < 0.03, "the other side stays"
    fingers = moved(body, **{f"left_finger_{k}_curl": 0.8 for k in range(2, 6)})
    wrist = np.array([0.45, -0.18, 1.03])
    tips = np.argsort(np.linalg.norm(fingers, axis=1))[-50:]
    before, after = (np.linalg.norm(x[tips] - wrist, axis=1).mean() for x in (body.rest, body.rest + fingers))
    assert after < before - 0.02, "towards the wrist"
