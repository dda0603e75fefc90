"""Symmetric shapes are found however they stand, and mirror images are what a mirror shows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from shapespace.mesh.rigid_motion import align
from shapespace.training.collection.mirror import TOLERANCE, find_mirror, mirrored
from shapespace.training.runs.config import Config
from shapespace.training.runs.directory import RunDirectory
from shapespace.training.space.held_out import held_out
from shapespace.training.space.related import Related
from shapespace.training.stages.ingest import ingest
from shapespace.training.stages.stage import Run

ROUND = trimesh.creation.icosphere(1)
FACES = np.asarray(ROUND.faces)
EDGES = np.asarray(ROUND.edges_unique)
FLIP = np.array([-1.0, 1, 1])


def body() -> np.ndarray:
    """Left and right alike, but neither front and back nor top and bottom."""
    x, y, z = np.asarray(ROUND.vertices).T
    return np.stack([x * (1 + 0.3 * z), 1.5 * y + 0.4 * z**2, 0.8 * z + 0.2 * y**3], axis=1)


def bent(left: float, right: float) -> np.ndarray:
    """The body with either side pulled."""
    shape = body()
    for side, size in ((shape[:, 0] < 0, left), (shape[:, 0] > 0, right)):
        shape[side, 1] += size * shape[side, 0] ** 2
    return shape


def placed(shape: np.ndarray) -> np.ndarray:
    return shape @ Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix() + [5, -2, 1]


def pairs() -> np.ndarray:
    """Which vertex of the body is where its mirror image has each."""
    return np.linalg.norm(body()[:, None] - body() * FLIP, axis=2).argmin(axis=0)


@pytest.mark.parametrize("place", [lambda shape: shape, placed])
def test_a_symmetric_shape_says_which_vertices_mirror_each_other(place) -> None:
    found = find_mirror(np.stack([place(bent(0.4, 0)), place(body()), place(bent(0.2, 0.1))]), EDGES)
    assert found is not None
    image, template = found
    assert template == 1
    assert np.array_equal(image, pairs())


def test_no_shape_is_taken_for_symmetric_that_is_not() -> None:
    noise = np.random.default_rng(0).normal(size=body().shape)
    assert find_mirror(np.stack([bent(0.4, 0), bent(0, 0.3)]), EDGES) is None
    assert find_mirror(np.stack([body() + 5 * TOLERANCE * noise]), EDGES) is None
    assert find_mirror(np.stack([body() + 0.05 * TOLERANCE * noise]), EDGES) is not None


def test_what_is_symmetric_in_several_ways_has_no_left_and_right() -> None:
    box = np.asarray(ROUND.vertices) * [3.0, 2.0, 1.0]
    assert find_mirror(np.stack([box]), EDGES) is None
    found = find_mirror(np.stack([box, body()]), EDGES)
    assert found is not None
    assert found[1] == 1


def test_vertices_that_mirror_each_other_by_chance_do_not_count() -> None:
    """The edges have to as well."""
    shuffled = np.random.default_rng(0).permutation(len(body()))
    assert find_mirror(np.stack([body()]), shuffled[EDGES]) is None


def test_a_mirror_image_is_what_a_mirror_shows() -> None:
    shapes = np.stack([placed(bent(0.4, 0.1)), placed(body()), bent(0, 0.3)])
    images, original_index = mirrored(shapes, pairs())
    assert original_index.tolist() == [0, 2], "a symmetric shape is its own image"
    for image, expected in zip(images, (bent(0.1, 0.4), bent(0.3, 0)), strict=True):
        np.testing.assert_allclose(align(image, expected), expected, atol=1e-12)
    again, _ = mirrored(images, pairs())
    np.testing.assert_allclose(align(again, shapes[original_index]), shapes[original_index], atol=1e-12)
    for image, shape in zip(images, shapes[original_index], strict=True):
        np.testing.assert_allclose(align(image, shape), image, atol=1e-12, err_msg="it stands where the shape stands")


def ingested(out: Path, mirror: bool) -> tuple[RunDirectory, Config]:
    out.mkdir(exist_ok=True)
    sizes = [(0, 0), (0.5, 0), (0.3, 0.1), (0.1, 0.4), (0.2, 0.2)]
    np.savez(out / "body.npz", vertices=np.stack([bent(*each) for each in sizes]), faces=FACES)
    document = {
        "collection": {"data": out / "body.npz", "coarse_vertices": 30, "mirror": mirror},
        "export": {"name": "body", "title": "", "description": "", "licence": ""},
    }
    run = Run(out, Config.model_validate(document), "", out / "models")
    ingest(run)
    return run.directory, run.config


@pytest.fixture(scope="module")
def with_images(tmp_path_factory: pytest.TempPathFactory) -> tuple[RunDirectory, Config]:
    return ingested(tmp_path_factory.mktemp("body"), True)


def test_a_run_learns_from_mirror_images_unless_told_otherwise(
    with_images: tuple[RunDirectory, Config], tmp_path: Path
) -> None:
    run, _ = with_images
    shapes = run.shapes.read()
    assert shapes["original"].tolist() == [0, 1, 2, 3, 4, 1, 2, 3]
    assert [name.endswith(" (mirrored)") for name in shapes["names"].tolist()] == 5 * [False] + 3 * [True]
    assert len(run.own_shapes()) == 5
    assert run.ingest.read()["images"] == 3
    assert any("mirror images" in note for note in run.ingest.read()["notes"])
    plain, _ = ingested(tmp_path, False)
    assert plain.shapes.read()["original"].tolist() == [0, 1, 2, 3, 4]
    assert plain.ingest.read()["images"] == 0


def test_held_out_shapes_take_their_images_with_them(with_images: tuple[RunDirectory, Config]) -> None:
    run, config = with_images
    shapes = run.shapes.read()
    others = shapes["vertices"].copy()
    others[5] *= 1.3  # the image of shape 1
    found, again, without = (
        held_out(run.reference_mesh(), each, np.array([1]), [2], config.modes, config.shell_material, 4, related)
        for each, related in (
            (shapes["vertices"], Related.of_arrays(shapes)),
            (others, Related.of_arrays(shapes)),
            (shapes["vertices"][:5], None),
        )
    )
    assert np.array_equal(found.near["modes"][0], again.near["modes"][0])
    away = found.distances(shapes["vertices"], 1.0)
    assert away["modes"][0].mean() < 0.7 * without.distances(shapes["vertices"], 1.0)["modes"][0].mean()
    assert np.array_equal(away["components"][0], without.distances(shapes["vertices"], 1.0)["components"][0])
    assert away["mirrored_components"][0].mean() < away["components"][0].mean()
