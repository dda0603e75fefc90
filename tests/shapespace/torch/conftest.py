"""Models on which the layer and the graph are compared with the server."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

import shapespace
from shapespace.bundle import writer
from shapespace.bundle.geometry import FineMesh, Geometry
from shapespace.bundle.writer import Networks
from shapespace.mesh.fine_detail import FineDetail
from shapespace.mesh.prolongation import AttachedPart, Prolongation
from shapespace.mesh.triangle_mesh import TriangleMesh
from tests.service import bundles
from tests.shapespace.conftest import closed, sheet

BUNDLED = {
    name: max((Path("models") / name).iterdir(), key=lambda path: int(path.name)) for name in ("figure", "freaky-torus")
}


@pytest.fixture(scope="session")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a bundle of two components, one with a boundary, an attached rigid part, and fine detail; not to be
    changed.
    """
    with pytest.MonkeyPatch.context() as patch:
        coarse, fine, part = _sheet_and_ball()
        patch.setattr(bundles, "reference", lambda: coarse)
        factors = [model.SerializeToString() for model in bundles.networks().values()]
        prolong = replace(Prolongation.of(coarse, fine, [part]), detail=_detail(coarse, fine))
        geometry = Geometry(reference=coarse, fine=FineMesh(fine, prolong))
        files = Networks(factors=factors[:2], combiner=factors[2])
        return writer.write_bundle(tmp_path_factory.mktemp("models"), bundles.facts("tiny"), files, geometry)


@pytest.fixture(scope="session", params=[*BUNDLED, "tiny"])
def model(request: pytest.FixtureRequest, tiny: Path) -> shapespace.ShapeModel:
    """The model of a bundle with kernels, of one with fields, and of the tiny one."""
    return shapespace.load(BUNDLED.get(request.param, tiny))


def _sheet_and_ball() -> tuple[TriangleMesh, TriangleMesh, AttachedPart]:
    """A coarse mesh of two components, and a fine mesh that has a third one beside it."""
    flat, ball = sheet(), closed()
    coarse = _joined(flat.vertices, flat.faces, 0.3 * ball.vertices + [0, 0, 1], ball.faces)
    size = 1 / np.sqrt(coarse.area)
    finer = trimesh.remesh.subdivide(size * coarse.vertices, coarse.faces)
    eye = trimesh.creation.icosphere(subdivisions=0)
    fine = _joined(*finer, 0.1 * eye.vertices + [0.2, 0, 0.3], eye.faces)
    own = np.arange(len(finer[0]), len(fine.vertices))
    part = AttachedPart(own, np.array([30, 31, 36, 37]), np.full(4, 0.25), rigid=True)
    return coarse.with_vertices(size * coarse.vertices), fine, part


def _detail(coarse: TriangleMesh, fine: TriangleMesh) -> FineDetail:
    rng = np.random.default_rng(5)
    axes, fields = (scale * rng.standard_normal((3, *mesh.vertices.shape))
                    for scale, mesh in ((0.1, coarse), (0.05, fine)))  # fmt: skip
    return FineDetail(coarse.vertices, axes, fields.astype(np.float32))


def _joined(v: np.ndarray, f: np.ndarray, w: np.ndarray, g: np.ndarray) -> TriangleMesh:
    return TriangleMesh.from_arrays(np.concatenate([v, w]), np.concatenate([f, g + len(v)]))
