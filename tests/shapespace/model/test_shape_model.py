"""The model in Python: it is loaded from its folder, and its results are those of the server."""

import multiprocessing
import os
import pickle
import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Literal

import httpx
import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

import shapespace
from shapespace.bundle import finding
from shapespace.bundle.finding import BUNDLED
from shapespace.bundle.reader import BundleError, read_bundle
from shapespace.files.formats import MESH_FORMATS
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import MeshError, TriangleMesh
from shapespace.model.correspondence import InvalidMeshError
from shapespace.model.decoder import MeshChoice
from shapespace.model.edit import InvalidTargetError
from shapespace.model.encode_search import SETTINGS, EncodeSearch
from shapespace.model.latent_space import LatentError, NotFiniteError, OutOfBoundsError, WrongLengthError
from shapespace.model.options import PriorKind, Target
from shapespace.model.searched_shapes import SearchedShapes
from shapespace.model.shape_model import ShapeModel, load
from shapespace.solve.cholesky import NotPositiveDefiniteError
from shapespace.solve.least_squares import Fit
from shapespace.solve.outcome import Status
from tests.service.bundles import SCALE, fine_reference, reference, write_bundle
from tests.service.conftest import ROOT, starting

CODES = np.array([[0.1, 0.7, 0.4], [0.0, -1.0, 0.2]])


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("library") / "models"
    for version in ("1", "2", "10"):
        write_bundle(folder, "small", version)
    write_bundle(folder, "with-fine", fine=True)
    shutil.copytree(ROOT / "models" / "figure", folder / "figure")  # a bundle must not be a link
    return folder


@pytest.fixture(scope="module")
def model(models: Path) -> ShapeModel:
    return load(models / "with-fine")


@pytest.fixture(scope="module")
def client(models: Path) -> Iterator[httpx.Client]:
    with starting() as start, httpx.Client(base_url=start(models).url, timeout=120) as client:
        yield client


def post(client: httpx.Client, name: str, call: str, **body: object) -> dict:
    return client.post(f"/v1/models/{name}/{call}", json=body).raise_for_status().json()


@pytest.mark.parametrize("name", ["with-fine", "figure"])
@pytest.mark.parametrize("mesh", ["fine", "coarse"])
def test_shapes_are_those_of_the_server(models: Path, client: httpx.Client, name: str, mesh: str) -> None:
    model = load(models / name)
    codes = 1.2 * model.sample(3, seed=5, distribution="gaussian").astype(np.float64)
    answer = post(client, name, "vertices", latents=codes.tolist(), mesh=mesh)
    found = model.decode(codes, mesh=mesh)
    np.testing.assert_array_equal(found.astype(np.float32), np.array(answer["vertices"], np.float32))
    drawn = client.get(f"/v1/models/{name}/mesh", params={"mesh": mesh, "format": "json"}).json()
    np.testing.assert_array_equal(model.mesh(MeshChoice(mesh)).faces, drawn["faces"])
    # Networks run for several codes at once, except for full shapes. This changes the last digits.
    np.testing.assert_allclose(model.decode(codes[1], mesh=mesh), found[1], atol=1e-5)
    full = model.decode(codes, mesh=mesh, quality="full")
    np.testing.assert_array_equal(model.decode(codes[1], mesh=mesh, quality="full"), full[1])
    clamped = post(client, name, "vertices", latents=(9 * codes).tolist(), mesh=mesh, bounds="clamp")
    found = model.decode(9 * codes, mesh, "clamp")
    np.testing.assert_array_equal(found.astype(np.float32), np.array(clamped["vertices"], np.float32))


@pytest.mark.parametrize("name", ["with-fine", "figure"])
def test_codes_are_those_of_the_server(models: Path, client: httpx.Client, name: str, tmp_path: Path) -> None:
    model = load(models / name)
    for options in (("population", 0.5), ("population", 1.0), ("uniform", 1.0), ("gaussian", 1.0)):
        asked = dict(zip(("distribution", "temperature"), options, strict=True))
        codes = post(client, name, "sample", count=2, seed=3, **asked)["latents"]
        np.testing.assert_array_equal(model.sample(2, 3, *options), np.array(codes, np.float32))
    shape = model.decode(codes[0])
    file = tmp_path / "shape.ply"
    file.write_bytes(MESH_FORMATS["ply"].encode(shape, model.faces))
    answer = client.post(f"/v1/models/{name}/encode?format=ply", content=file.read_bytes()).raise_for_status().json()
    found = model.encode(file)
    np.testing.assert_array_equal(found.code, np.array(answer["latent"], np.float32))
    assert (found.residual, found.iterations, found.status) == tuple(
        answer[key] for key in ("residual", "iterations", "status")
    )
    assert answer["vertex_error"] == {"mean": found.distances.mean(), "max": found.distances.max()}
    targets = [Target(5, (shape[5] + 0.05 * SCALE).tolist(), 0.01), Target(40, shape[40].tolist())]
    pairs = [{name: value for name, value in asdict(target).items() if value is not None} for target in targets]
    for more in ({}, {"fixed": {0: 0.3}, "samples": 2, "seed": 4, "prior_kind": PriorKind.RIDGE}):
        edited = post(client, name, "edit", latent=codes[1], targets=pairs, prior=1e-3, **more)
        changed = model.edit(codes[1], targets, prior=1e-3, **more)
        np.testing.assert_array_equal(changed.code, np.array(edited["latent"], np.float32))
        np.testing.assert_array_equal(changed.samples.ravel(), np.array(edited["samples"], np.float32).ravel())
        np.testing.assert_allclose(edited["covariance"], changed.covariance, rtol=1e-12, atol=1e-18)
        assert changed.residual == edited["residual"]
        np.testing.assert_array_equal(changed.distances, edited["distances"])


def test_a_mesh_is_encoded_from_vertices_meshes_and_files(model: ShapeModel, tmp_path: Path) -> None:
    for mesh, its_reference in (("fine", fine_reference()), ("coarse", reference())):
        shape = model.decode(CODES[0], mesh)
        np.savez(tmp_path / "shape.npz", vertices=shape, faces=its_reference.faces)
        plain = model.encode(shape)
        assert plain.mesh == mesh
        np.testing.assert_allclose(plain.code, CODES[0], atol=1e-3)
        for given in (
            TriangleMesh.from_arrays(shape, its_reference.faces),
            shape.tolist(),
            tmp_path / "shape.npz",
            str(tmp_path / "shape.npz"),
        ):
            np.testing.assert_array_equal(model.encode(given).code, plain.code)


def test_of_a_fine_mesh_all_vertices_count(tmp_path: Path) -> None:
    """Shapes that no code makes, on a mesh that is fine on one side: there they are met."""
    mesh = reference()
    v, f = mesh.vertices, mesh.faces
    for _ in range(3):
        v, f = trimesh.remesh.subdivide(v, f, face_index=np.flatnonzero((v[f][:, :, 0] > 0).all(axis=1)))
    write_bundle(tmp_path, "dense", fine=TriangleMesh.from_arrays(v, f))
    model = load(tmp_path / "dense")
    coarse = [int(np.argmin(np.linalg.norm(model.vertices - corner, axis=1))) for corner in SCALE * mesh.vertices]
    for code in CODES:
        shape = model.decode(code)
        x = shape[:, :1] / np.abs(shape).max()
        target = shape * (1.02 + 0.02 * x)

        def away(code: np.ndarray, target: np.ndarray = target) -> float:
            return float(np.square(align(model.decode(code), target) - target).sum())

        assert away(model.encode(target).code) < 0.5 * away(model.encode(target[coarse]).code)


def test_a_folder_a_name_or_here(models: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert load(str(models / "small" / "2")).manifest.version == "2"
    assert load(models / "small").manifest.version == "10"  # the highest, not the last in the alphabet
    for folder in (models / "small", models / "small" / "10"):
        monkeypatch.chdir(folder)
        assert load(os.curdir).manifest.version == "10"
    for folder in (models, models / "small" / "1" / "manifest.json", models / "none"):
        with pytest.raises(BundleError, match="holds no bundle" if folder == models else "can't be read"):
            load(folder)


def test_models_are_known_by_name_in_any_folder(models: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert {"figure", "freaky-torus"} <= shapespace.models().keys()
    assert load("figure").folder == BUNDLED / "figure" / "4"
    (tmp_path / "figure").mkdir()  # a folder of meshes, say
    (tmp_path / "models" / "odd").mkdir(parents=True)
    assert load("figure/4").manifest.name == "figure"
    shutil.copytree(models / "small", tmp_path / "models" / "small")
    write_bundle(tmp_path / "models", "figure", "7")
    listed = shapespace.models()
    assert (listed["small"].version, listed["small"].dimension) == ("10", 3)
    assert listed["figure"].folder == tmp_path / "models" / "figure" / "7"
    assert load("small").manifest.version == "10"
    for unknown in ("figur", "small/3", "Figure", "my figure"):
        with pytest.raises(BundleError, match=f"no model {unknown} here: choose among figure, freaky-torus, small, or"):
            load(unknown)
    for folder in ("models/figur", "../figure", "figure/4/5"):
        with pytest.raises(BundleError, match="can't be read: there is no such file or folder"):
            load(folder)
    monkeypatch.setattr(finding, "BUNDLED", tmp_path / "none")
    assert list(shapespace.models()) == ["figure", "small"]


def test_a_model_is_sent_to_another_process_by_its_folder(models: Path, tmp_path: Path) -> None:
    shutil.copytree(models / "small" / "2", tmp_path / "small" / "2")
    model = load(tmp_path / "small" / "2", threads=2)
    content = pickle.dumps(model)
    assert len(content) < 1000
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        np.testing.assert_array_equal(pool.submit(model.decode, CODES).result(), model.decode(CODES))
    write_bundle(tmp_path, "small", "2", fine=True)
    with pytest.raises(BundleError, match="has changed since the model was pickled"):
        pickle.loads(content)  # noqa: S301
    shutil.rmtree(tmp_path / "small")
    with pytest.raises(BundleError, match="can't be read"):
        pickle.loads(content)  # noqa: S301


def test_bounds_are_read_only(model: ShapeModel) -> None:
    for bounds in (model.lower, model.upper):
        with pytest.raises(ValueError, match="read-only"):
            bounds[0] = 0


def test_its_facts(model: ShapeModel) -> None:
    assert (model.dimension, len(model.names)) == (3, 3)
    assert model.period == [None, 2 * np.pi, None]
    np.testing.assert_array_equal([model.lower, model.upper], [[-0.2, -np.pi, 0], [0.2, np.pi, 1]])
    np.testing.assert_array_equal(model.faces, fine_reference().faces)
    np.testing.assert_array_equal(model.vertices, SCALE * fine_reference().vertices)
    assert repr(model) == f"<ShapeModel with-fine/1: 3 coordinates, 2 factors, {len(model.vertices)} vertices>"


def test_what_is_wrong_is_said(model: ShapeModel) -> None:
    with pytest.raises(WrongLengthError, match="takes 3"):
        model.decode([[0.0, 1.0]])
    with pytest.raises(WrongLengthError, match=r"\(n, m\) or \(m,\)"):
        model.decode(np.zeros((1, 1, 3)))
    with pytest.raises(OutOfBoundsError):
        model.decode([0, 0, 2], bounds="reject")
    with pytest.raises(ValueError, match="'large' is not a valid MeshChoice: choose among fine, coarse"):
        model.decode(CODES, mesh="large")  # type: ignore[arg-type]
    with pytest.raises(InvalidMeshError, match=r"\(V, 3\)"):
        model.encode(np.zeros(3))
    with pytest.raises(InvalidMeshError, match="has 7 vertices"):
        model.encode(np.zeros((7, 3)))
    with pytest.raises(MeshError, match="can't be read"):
        model.encode("nothing.obj")
    with pytest.raises(InvalidTargetError, match="Give at least one"):
        model.edit(CODES[0], {})
    count = len(reference().vertices)
    for vertex in (-1, count):
        with pytest.raises(InvalidTargetError, match=f"vertex is {vertex}, but the coarse mesh"):
            model.edit(CODES[0], {vertex: [0, 0, 0]}, mesh="coarse")
    with pytest.raises(InvalidTargetError, match=r"targets\[0\]\.position has another shape"):
        model.edit(CODES[0], {0: [1, 2]})
    with pytest.raises(NotFiniteError):
        model.edit(CODES[0], {0: [np.inf, 0, 0]})
    with pytest.raises(TypeError, match=r"no option 'partal': choose among .*partial"):
        model.fit_scan(CODES, partal=True)
    for changed in ({"samples": -1}, {"seed": -1}, {"seed": 2**63}):
        with pytest.raises(ValueError, match="Give a whole number of at least 0"):
            model.encode(reference().vertices, **changed)
    with pytest.raises(LatentError, match="count is -1"):
        model.sample(-1)


def test_shapes_that_were_not_found_are_told(model: ShapeModel, monkeypatch: pytest.MonkeyPatch) -> None:
    assert model.decode(np.zeros((0, 3))).shape == (0, *model.vertices.shape)
    monkeypatch.setattr("shapespace.model.decoder.TOLERANCE", 1e-300)
    with pytest.warns(RuntimeWarning, match="1 of 1 shapes did not converge; the first is that of code 0: ") as caught:
        model.decode(CODES[:1])
    assert caught[0].filename == __file__


def test_a_code_outside_is_answered_only_where_none_inside_is_as_near(figure: ShapeModel) -> None:
    """Rough shapes of codes on the bounds, whose nearest codes may lie on either side."""
    rng = np.random.default_rng(2)
    latents = figure.latents
    away = 0.004 * np.linalg.norm(np.ptp(figure.vertices, axis=0))
    for k in range(2):
        code = np.where(rng.random(latents.dimension) < 0.5, latents.lower, latents.upper)
        shape = figure.decode(code)
        found = figure.encode(shape + away * rng.normal(size=shape.shape))
        assert found.inside_bounds, k
        assert found.distances.mean() < 2.5 * away
    # A code clearly outside the bounds is found there.
    beyond = latents.lower + 1.1 * latents.width * (np.arange(latents.dimension) == 3)
    outside = figure.encode(figure.decode(beyond))
    assert not outside.inside_bounds
    assert outside.distances.mean() < 0.1 * away


@pytest.mark.parametrize("seed", [pytest.param(1, marks=pytest.mark.long), 2])
def test_a_code_outside_is_no_farther_than_one_inside(figure: ShapeModel, seed: int) -> None:
    """Of twisted shapes, which no code makes: what a search far outside comes to need not be the shape of its code."""
    shape = figure.decode(figure.sample(1, seed)[0])
    turn = 4 * (shape[:, 1] - figure.vertices[:, 1].mean()) / np.linalg.norm(np.ptp(figure.vertices, axis=0))
    x, y, z = shape.T
    twisted = np.stack([x * np.cos(turn) - z * np.sin(turn), y, x * np.sin(turn) + z * np.cos(turn)], axis=1)
    allowed, clamped = (
        np.sqrt(np.square(figure.encode(twisted, bounds=bounds).distances).mean()) for bounds in ("allow", "clamp")
    )
    assert allowed < 1.03 * clamped


def ending_elsewhere(
    models: Path, monkeypatch: pytest.MonkeyPatch, residuals: Callable[[NDArray], NDArray]
) -> tuple[ShapeModel, NDArray]:
    """The figure, whose search by lengths and angles ends at the upper bounds, with residuals; and a training shape."""
    model, by_nric = load(models / "figure"), EncodeSearch._by_nric
    codes = read_bundle(models / "figure" / "4").training_codes
    assert codes is not None
    given = model.decode(codes[20])

    def elsewhere(self: EncodeSearch, *given: Any) -> Fit:
        found = by_nric(self, *given)
        return replace(found, x=model.upper, residuals=residuals(found.residuals))

    monkeypatch.setattr(EncodeSearch, "_by_nric", elsewhere)
    return model, given


@pytest.mark.parametrize(
    ("spent", "most"),
    [(SETTINGS.long, 30), (SETTINGS.shapes + SETTINGS.inside, SETTINGS.shapes + SETTINGS.inside + SETTINGS.long)],
)
def test_a_search_that_went_astray_begins_once_more_from_the_nearest_training_shape(
    models: Path, monkeypatch: pytest.MonkeyPatch, spent: int, most: int
) -> None:
    model, given = ending_elsewhere(models, monkeypatch, np.zeros_like)
    size = np.linalg.norm(np.ptp(given, axis=0))
    by_vertices, searches = EncodeSearch._by_vertices, iter(range(9))

    def stuck(self: EncodeSearch, near: Fit, *given: Any, **more: Any) -> Fit:
        if next(searches) == 0:
            return replace(near, iterations=spent)
        return by_vertices(self, near, *given, **more)

    monkeypatch.setattr(EncodeSearch, "_by_vertices", stuck)
    found = model.encode(given, bounds="clamp")
    assert found.distances.mean() < 1e-5 * size
    assert spent < found.iterations <= most
    assert found.status is Status.CONVERGED


def test_a_search_that_met_a_collapsed_shape_begins_once_more(models: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model, given = ending_elsewhere(models, monkeypatch, np.zeros_like)
    moved, searches = SearchedShapes.derivatives, iter(range(99))

    def collapsed(self: SearchedShapes, *given: Any) -> Any:
        if next(searches) == 0:
            raise NotPositiveDefiniteError("a face without area")
        return moved(self, *given)

    monkeypatch.setattr(SearchedShapes, "derivatives", collapsed)
    found = model.encode(given, bounds="clamp")
    assert found.distances.mean() < 1e-5 * np.linalg.norm(np.ptp(given, axis=0))
    assert (found.status, found.iterations <= 30) == (Status.CONVERGED, True)


def test_a_search_begins_at_a_training_shape_that_is_nearer(models: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A search by lengths and angles that ends elsewhere, as where a bundle remembers more than reaches that far."""
    model, given = ending_elsewhere(models, monkeypatch, lambda residuals: 1 + residuals)
    objectives: tuple[Literal["vertices", "nric"], ...] = ("vertices", "nric")
    for objective in objectives:
        found = model.encode(given, objective=objective)
        assert found.distances.mean() < 1e-4 * np.linalg.norm(np.ptp(given, axis=0))
        assert found.iterations <= 3
