"""Bundles with what files have beside triangles: read as they were written, or refused."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shapespace.bundle import writer
from shapespace.bundle.reader import BundleError, read_bundle
from shapespace.bundle.schema import ARRAYS, SURFACE
from shapespace.bundle.writer import Networks
from shapespace.files.attributes.textures import ALL, LARGEST
from shapespace.mesh.attributes import Labels, MeshAttributes, SurfaceMaterial
from shapespace.model.decoder import MeshChoice
from shapespace.model.shape_model import ShapeModel
from tests.service.bundles import facts, fine_reference, geometry, networks, seal
from tests.surfaces import png

MESH = fine_reference()
RNG = np.random.default_rng(0)


def surface() -> MeshAttributes:
    """Everything that a surface can have, on the finer torus, except polygons of more corners."""
    faces = MESH.faces
    count = len(faces)
    return MeshAttributes(
        starts=np.arange(0, 3 * count + 1, 3),
        corners=faces.ravel(),
        uv=RNG.random((50, 2)),
        uv_corners=RNG.integers(-1, 50, 3 * count),
        shading=RNG.integers(0, 3, 3 * count),
        normals=True,
        colors=RNG.random(MESH.vertices.shape),
        objects=Labels(("torus",), np.zeros(count, int)),
        groups=Labels(("inside", "outside"), RNG.integers(-1, 2, count)),
        material_of=RNG.integers(-1, 2, count),
        materials=(
            SurfaceMaterial("skin", texture="skin.png"),
            SurfaceMaterial("steel", (0.1, 0.2, 0.3, 0.5), 1.0, 0.2),
        ),
        textures={"skin.png": png()},
    )


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    *factors, combiner = (model.SerializeToString() for model in networks().values())
    files = Networks(factors=factors, combiner=combiner)
    return writer.write_bundle(tmp_path, facts(), files, replace(geometry(fine=True), surface=surface()))


def test_a_surface_is_read_as_it_was_written(folder: Path) -> None:
    with np.load(folder / "geometry.npz") as file:
        assert {name for name in file if name.startswith(SURFACE)} == {n for n in ARRAYS if n.startswith(SURFACE)}
    found, wanted = read_bundle(folder).surface, surface()
    assert found
    for name in ("starts", "corners", "uv_corners", "shading", "material_of"):
        assert getattr(found, name).shape == getattr(wanted, name).shape
    np.testing.assert_array_equal(found.triangles, MESH.faces)
    assert found.uv is not None
    assert found.uv.shape == (50, 2)
    assert (found.materials, found.textures, found.normals) == (wanted.materials, wanted.textures, True)
    assert found.objects
    assert found.groups
    assert (found.objects.names, found.groups.names) == (("torus",), ("inside", "outside"))
    model = ShapeModel(read_bundle(folder))
    assert model.decoder.surface(MeshChoice.FINE)
    assert model.decoder.surface(MeshChoice.COARSE) is None


def entry(**changes: object) -> Callable[[Path], None]:
    """A function that changes the manifest's entry about the surface."""

    def spoil(folder: Path) -> None:
        path = folder / "manifest.json"
        manifest = json.loads(path.read_text())
        manifest["surface"] |= changes
        path.write_text(json.dumps(manifest))

    return spoil


def arrays(**changes: object) -> Callable[[Path], None]:
    """A function that replaces arrays, or removes those that are None."""

    def spoil(folder: Path) -> None:
        with np.load(folder / "geometry.npz") as file:
            found = {**file, **{f"surface_{name}": array for name, array in changes.items()}}
        np.savez(folder / "geometry.npz", **{name: array for name, array in found.items() if array is not None})
        seal(folder)

    return spoil


def picture(content: bytes) -> Callable[[Path], None]:
    def spoil(folder: Path) -> None:
        (folder / "skin.png").write_bytes(content)
        seal(folder)

    return spoil


def material(**changes: object) -> Callable[[Path], None]:
    plain = {"name": "skin", "color": [1, 1, 1, 1], "metallic": 0, "roughness": 1, "texture": "skin.png"}
    return entry(materials=[plain | changes, plain | {"texture": None}])


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda folder: (folder / "skin.png").unlink(), "skin.png is missing"),
        (lambda folder: (folder / "skin.png").write_bytes(png(1)), "skin.png does not have the digest"),
        (picture(b"GIF89a"), "surface: skin.png is neither PNG nor JPEG"),
        (picture(png() + bytes(LARGEST)), "surface: skin.png has more than 16 MiB"),
        (entry(materials=[]), "files must list exactly the networks, the geometry and the textures"),
        (material(texture="../skin.png"), "surface.materials.0.texture"),
        (material(texture="combiner.onnx"), "files must list exactly"),
        (material(color=[2, 0, 0, 1]), "surface.materials.0.color"),
        (material(name="a\nb"), "surface.materials.0.name"),
        (entry(objects=["torus"] * 10_001), "surface.objects"),
        (entry(groups=[]), "surface: there are names of groups without polygons"),
        (entry(groups=["one"]), "surface: a group is numbered -1 to 1, but there are 1"),
        (arrays(starts=None), "surface: there is no array surface_starts"),
        (arrays(starts=np.array([0, 3])), "surface: polygons do not begin at the first corner and end at the last"),
        (arrays(starts=np.array([[0, 3]])), "surface_starts must be whole numbers (P + 1,)"),
        (arrays(corners=MESH.faces[:, ::-1].ravel()), "surface: polygons are not those of the triangles"),
        (arrays(uv_corners=np.full(MESH.faces.size, 50)), "surface: a texture coordinate is numbered 50 to 50"),
        (arrays(uv=np.full((50, 2), np.nan)), "surface_uv has an entry that is not finite"),
        (arrays(uv=None), "surface: a texture coordinate is numbered"),
        (arrays(colors=np.zeros((4, 3))), "surface: colours must be (512, 3)"),
    ],
)
def test_a_surface_that_is_not_what_the_manifest_says_is_refused(
    spoil: Callable[[Path], None], says: str, folder: Path
) -> None:
    read_bundle(folder)
    spoil(folder)
    with pytest.raises(BundleError) as refusal:
        read_bundle(folder)
    assert says in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_textures_are_limited_together(folder: Path) -> None:
    names = [f"skin-{k}.png" for k in range(ALL // LARGEST + 1)]
    for name in names:
        (folder / name).write_bytes(png() + bytes(LARGEST - 1000))
    plain = {"color": [1, 1, 1, 1], "metallic": 0, "roughness": 1}
    (folder / "skin.png").unlink()
    arrays(material_of=None)(folder)
    entry(materials=[plain | {"name": name, "texture": name} for name in names])(folder)
    with pytest.raises(BundleError, match="textures have more than 32 MiB together"):
        read_bundle(folder)
