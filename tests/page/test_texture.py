"""Textures of the model's files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shapespace.bundle import writer
from shapespace.bundle.writer import Networks
from shapespace.mesh.attributes import MeshAttributes, SurfaceMaterial
from tests.page.conftest import Open
from tests.service.bundles import facts, fine_reference, geometry, networks
from tests.service.conftest import Start
from tests.surfaces import png


def dressed(folder: Path, picture: bytes) -> Path:
    """A torus whose fine mesh has a red texture on one half, a green material on the other, and a seam."""
    mesh = fine_reference()
    faces = mesh.faces
    half = mesh.vertices[faces].mean(axis=1)[:, 0] > 0
    surface = MeshAttributes(
        starts=np.arange(0, faces.size + 1, 3),
        corners=faces.ravel(),
        uv=np.array([[0.2, 0.2], [0.8, 0.8]]),
        uv_corners=np.repeat(half, 3).astype(int),
        material_of=np.where(half, 0, 1),
        materials=(SurfaceMaterial("red", texture="red.png"), SurfaceMaterial("green", (0.0, 0.5, 0.0, 1.0))),
        textures={"red.png": picture},
    )
    *factors, combiner = (model.SerializeToString() for model in networks().values())
    files = Networks(factors=factors, combiner=combiner)
    writer.write_bundle(folder, facts("dressed"), files, replace(geometry(fine=True), surface=surface))
    return folder


def share(picture: np.ndarray, channel: int) -> float:
    """Share of pixels in which one colour channel is much stronger than the others."""
    others = np.delete(picture, channel, axis=2).max(axis=2)
    return float((picture[:, :, channel] > others + 60).mean())


def test_the_fine_mesh_wears_its_texture(tmp_path: Path, start: Start, window: Open) -> None:
    studio = window(start(dressed(tmp_path, png(color=(220, 0, 0)))).url).open("#model=dressed")
    studio.eventually(lambda: share(studio.picture(), 0) > 0.02)
    first = studio.picture()
    assert share(first, 1) > 0.02, "the other material"
    studio.type(2, 0.8)
    # Leave the factor, which colours what it changes while it is edited.
    studio.coordinate(2).locator("input[type=number]").blur()
    studio.rest()
    moved = studio.until_different(first)
    studio.eventually(lambda: share(studio.picture(), 0) > 0.02)
    assert share(moved, 2) < 0.001
    # Coloured shapes and the coarse mesh have no texture.
    studio["#normals"].click()
    studio.eventually(lambda: share(studio.picture(), 2) > 0.01)
    studio["#normals"].click()
    studio.eventually(lambda: share(studio.picture(), 0) > 0.02)
    studio["#to-look"].click()
    own = studio.page.get_by_label("the file’s own")
    assert own.is_checked()
    studio.page.get_by_label("clay").check()
    studio.eventually(lambda: share(studio.picture(), 0) < 0.001)
    own.check()
    studio.eventually(lambda: share(studio.picture(), 0) > 0.02)
    studio["#fine"].click()
    studio.eventually(lambda: share(studio.picture(), 0) < 0.001)


@pytest.mark.long
def test_a_picture_that_no_browser_reads_leaves_the_rest_as_it_is(tmp_path: Path, start: Start, window: Open) -> None:
    studio = window(start(dressed(tmp_path, png()[:20])).url, complains=True).open("#model=dressed")
    studio.eventually(lambda: "could not be decoded" in studio.messages)
    before = studio.picture()
    studio.type(2, 0.8)
    studio.until_different(before)
