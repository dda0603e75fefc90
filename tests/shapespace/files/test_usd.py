"""USD files: polygons, texture coordinates, materials, names and textures."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdShade

from shapespace.files.colouring import Colouring, Quantity
from shapespace.files.formats import USD_FORMATS
from shapespace.files.usd import animated_usd
from tests.surfaces import ball

VERTICES, SURFACE = ball(1)


def test_usd_has_quads_texture_coordinates_materials_and_names(tmp_path: Path) -> None:
    path = tmp_path / "animation.usdc"
    frames = np.stack([VERTICES, 2 * VERTICES])
    path.write_bytes(b"".join(animated_usd(frames, SURFACE.triangles, SURFACE)))
    stage = Usd.Stage.Open(str(path))
    mesh = UsdGeom.Mesh(stage.GetDefaultPrim())
    np.testing.assert_array_equal(mesh.GetFaceVertexCountsAttr().Get(), SURFACE.sizes)
    np.testing.assert_array_equal(mesh.GetFaceVertexIndicesAttr().Get(), SURFACE.corners)
    coordinates = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st")
    assert coordinates.GetInterpolation() == "faceVarying"
    np.testing.assert_allclose(coordinates.ComputeFlattened(), SURFACE.uv[SURFACE.uv_corners], atol=1e-6)
    assert mesh.GetPrim().GetDisplayName() == "Bar"
    parts = {}
    for part in UsdShade.MaterialBindingAPI(mesh).GetMaterialBindSubsets():
        material = UsdShade.MaterialBindingAPI(part).ComputeBoundMaterial()[0]
        look = UsdShade.Shader(material.GetPrim().GetChild("surface"))
        parts[material.GetPrim().GetDisplayName()] = np.array(part.GetIndicesAttr().Get())
        assert not look.GetInput("diffuseColor").HasConnectedSource(), "a USD layer alone has no textures"
    assert parts.keys() == {"skin", "cap"}
    for k, name in enumerate(("skin", "cap")):
        np.testing.assert_array_equal(parts[name], np.flatnonzero(SURFACE.material_of == k))
    groups = {p.GetPrim().GetDisplayName(): p for p in UsdGeom.Subset.GetGeomSubsets(mesh, "face", "group")}
    np.testing.assert_array_equal(groups["left"].GetIndicesAttr().Get(), np.flatnonzero(SURFACE.groups.of == 0))


def test_usdz_packs_the_textures_that_its_materials_read(tmp_path: Path) -> None:
    vertices, surface = ball()
    assert surface.textures
    content = b"".join(animated_usd(np.stack([vertices, vertices]), surface.triangles, surface, packed=True))
    path = tmp_path / "ball.usdz"
    path.write_bytes(content)
    with zipfile.ZipFile(path) as archive:
        layer, *pictures = archive.namelist()
        assert layer.endswith(".usdc")
        assert {archive.read(name) for name in pictures} == set(surface.textures.values())
    stage = Usd.Stage.Open(str(path))
    readers = [UsdShade.Shader(prim) for prim in stage.Traverse() if prim.GetTypeName() == "Shader"]
    files = [reader.GetInput("file").Get() for reader in readers if reader.GetInput("file")]
    assert files
    assert all(file.resolvedPath for file in files)


@pytest.mark.parametrize("colored", [False, True])
def test_usd_of_a_shape_is_the_same_at_any_time(colored: bool, tmp_path: Path) -> None:
    colouring = Colouring(Quantity.STRETCH, np.linspace(-1, 1, len(VERTICES)), 1.0) if colored else None
    first = {name: kind.encode(VERTICES, SURFACE.triangles, colouring, SURFACE) for name, kind in USD_FORMATS.items()}
    for name, kind in USD_FORMATS.items():
        assert kind.encode(VERTICES.copy(), SURFACE.triangles, colouring, SURFACE) == first[name]
    path = tmp_path / "shape.usdz"
    path.write_bytes(first["usdz"])
    with zipfile.ZipFile(path) as package:
        assert len(package.namelist()) == (1 if colored else 2), "colours replace textures"
        assert {info.date_time[:3] for info in package.infolist()} == {(1980, 1, 2)}
    stage = Usd.Stage.Open(str(path))
    mesh = UsdGeom.Mesh(stage.GetDefaultPrim())
    shown = np.array(mesh.GetDisplayColorPrimvar().Get())
    np.testing.assert_allclose(shown, colouring.linear if colouring else [(0.72, 0.76, 0.82)], atol=1e-6)
