"""Drawings of meshes as SVG."""

import re

import numpy as np

from shapespace.files.poster import poster
from shapespace.mesh.triangle_mesh import TriangleMesh
from tests.service.bundles import torus


def drawn(mesh: TriangleMesh) -> tuple[list[int], list[str], list[list[int]]]:
    """Width and height of the drawing, the colour of each face, and its six coordinates in the drawing."""
    text = poster(mesh).decode()
    frame = re.findall(r'viewBox="-2 -2 (\d+) (\d+)"', text)[0]
    places = [list(map(int, re.findall(r"-?\d+", path))) for path in re.findall(r' d="(.+?)"', text)]
    return list(map(int, frame)), re.findall(r'fill="(.+?)"', text), places


def test_the_faces_towards_the_camera_are_drawn_inside_the_frame_and_far_ones_first() -> None:
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float)
    near = TriangleMesh.from_arrays(
        np.concatenate([corners + np.array([0, 0, z]) for z in (0, 1, -1)]), [[0, 1, 2], [3, 4, 5], [6, 8, 7]]
    )
    (width, height), _, paths = drawn(near)
    assert len(paths) == 2, "the third face looks away"
    # The nearer one lies to the left, because the camera is on the right.
    assert paths[0][0] > paths[1][0]
    assert all(
        -2 <= x <= width - 2 and -2 <= y <= height - 2
        for path in paths
        for x, y in zip(path[::2], path[1::2], strict=True)
    )
    up = {y for path in paths for y in path[5::6]}
    assert max(up) < max(y for path in paths for y in path[1::6]), "y is up"


def test_it_fills_its_frame_and_light_comes_from_above() -> None:
    size, colours, paths = drawn(torus(16, 16))
    assert 100 < len(paths) < 512
    assert 2 < len(set(colours)) <= 25
    assert max(size) == 604
