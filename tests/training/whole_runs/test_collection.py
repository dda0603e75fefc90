"""From a folder of meshes to a served shape: the real command, and a real server."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest
import trimesh
from pxr import Usd, UsdGeom

from benchmarks.studies import SeedLearner, ShareLearner
from shapespace.files.attributes.reading import read_attributes
from shapespace.files.formats import MESH_FORMATS
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.training.runs.config import load
from shapespace.training.runs.provenance import MADE_BY
from shapespace.training.runs.sampling import read
from shapespace.training.stages import export
from shapespace.training.stages.networks import learner_of
from shapespace.training.stages.run import STAGES
from shapespace.training.stages.stage import Run
from tests.service.conftest import starting
from tests.service.glb import GLB
from tests.surfaces import corner_uv, parse_obj, same_corners
from tests.training.whole_runs.conftest import BAR, EYE, NAIL, SURFACE, bars


def test_a_run_leaves_what_the_contract_promises(run: Path) -> None:
    vertices, faces = bars()
    with np.load(run / "reference.npz") as reference:
        mesh = TriangleMesh.from_mapping(reference)
        assert 100 <= len(mesh.vertices) <= 130
        fine = TriangleMesh.from_arrays(reference["fine_vertices"], reference["fine_faces"])
        assert np.array_equal(fine.faces, faces)
        shell = np.isin(faces, BAR).all(axis=1)
        assert fine.face_areas[shell].sum() == pytest.approx(1)
        np.testing.assert_allclose(reference["scale"] * fine.vertices, vertices[0], atol=1e-4)
    with np.load(run / "mean.npz") as mean:
        # Served shapes are in the position of the mean.
        np.testing.assert_allclose(align(mean["vertices"], mesh.vertices), mean["vertices"], atol=1e-9)
    with np.load(run / "modes.npz") as modes:
        assert modes["nric"].shape == (3, 2 * len(mesh.edges))
        assert modes["vertices"].shape == (3, *mesh.vertices.shape)
        assert modes["coefficients"].shape == (5, 3)
        assert (modes["lower"] < 0).all()
        assert (modes["upper"] > 0).all()
    groups = json.loads((run / "factors.json").read_text())
    assert [j for members in groups["factors"] for j in members] == [0, 1, 2]
    assert len(groups["factors"]) == len(groups["names"]) == 2
    figures = json.loads((run / "evaluation.json").read_text())
    for model in ("composite", "monolithic", "monolithic_paper", "kernel", "affine", "grid"):
        assert set(figures["r2"][model]) == {"total", "lengths", "angles"}
    assert figures["r2"]["affine"]["total"] > 0.5
    assert figures["r2"]["composite"]["total"] > 0.99
    assert figures["prolongation"]["mean"] < 0.02
    parts = {part["name"]: part for part in figures["prolongation"]["parts"]}
    assert {name: part["carried"] for name, part in parts.items()} == {
        "Bar": "shell",
        "Eye": "rigidly",
        "Nail": "affinely",
    }
    assert all(1e-6 < part["mean"] < part["max"] < 0.02 for part in parts.values())
    said = (run.parent / "said.txt").read_text()
    assert "3 separate parts: the model predicts 'Bar'" in said
    assert "Eye is attached and moves rigidly" in said
    report = (run / "report.html").read_text()
    assert "<html" in report
    assert "Eye, attached, moves rigidly" in report
    unseen, encoded = (json.loads((run / f"{name}.json").read_text()) for name in ("generalisation", "encoded"))
    assert unseen.pop("made_by")["version"]
    assert figures["generalisation"] == unseen
    assert (unseen["held_out"], unseen["counts"]) == (5, [2, 3])
    for kind in ("modes", "components", "remembering_components", "linear_nric"):
        fewer, more = (each["mean"] for each in unseen[kind])
        assert 0 < more < fewer < 0.1
    assert unseen["stuck"] == 0
    assert unseen["not_stuck"]["modes"] == unseen["modes"][-1]
    parts = [np.load(path) for path in sorted((run / "samples").glob("part-*.npz"))]
    random = np.concatenate([part["vertices"][part["status"] == "done"] for part in parts])[:200]
    given = np.load(run / "shapes.npz")["vertices"][:5]  # mirror images come after
    size = np.linalg.norm(np.ptp(np.load(run / "reference.npz")["vertices"], axis=0))
    away = [min(np.linalg.norm(align(x, y) - y, axis=1).mean() for y in given) for x in random]
    assert figures["specificity"]["modes"] == pytest.approx(np.mean(away) / size, rel=1e-4)
    assert 0 < figures["specificity"]["components"] < 0.2
    assert 0.5 < figures["compactness"]["modes"] <= 1
    assert 0.5 < figures["compactness"]["components"] <= 1
    assert (encoded["shapes"], encoded["outside"], encoded["mesh"]) == (5, [], "fine")
    assert 0 < encoded["mean"] < encoded["p95"] < 0.02
    # What modes and these hasty networks miss is remembered; the fine mesh is still carried along.
    assert encoded["remembered"]
    assert encoded["mean"] < 0.5 * encoded["modes"]["mean"]
    assert report.index("Unseen shapes") < report.index("Training shapes") < report.index("R²")
    events = [json.loads(line) for line in (run / "log.jsonl").read_text().splitlines()]
    assert [e["stage"] for e in events if e["event"] == "end"] == list(STAGES)
    assert all(e["time"] for e in events)
    with np.load(run / "samples" / "split.npz") as split:
        drawn = np.concatenate([split[k] for k in ("train", "validation", "test")])
        assert sorted(drawn) == list(range(60))
        assert len(split["test"]) == 12


def test_a_factor_s_samples_are_the_parts_of_the_joint_codes(run: Path) -> None:
    groups = json.loads((run / "factors.json").read_text())["factors"]
    with np.load(run / "samples" / "part-00002.npz") as part:
        joint = part["latents"]
    for j, members in enumerate(groups):
        with np.load(run / "samples" / f"factor-{j}" / "part-00002.npz") as part:
            np.testing.assert_array_equal(part["latents"][:, members], joint[:, members])
            assert not np.delete(part["latents"], members, axis=1).any()


def test_the_collection_s_shapes_are_learned_from_but_not_measured_on(run: Path) -> None:
    opened = Run(run, *load(run / "config.toml"), run / "models")
    samples = read(run / "samples")
    known = np.flatnonzero(samples.index < 0)
    with np.load(run / "modes.npz") as modes:
        images = modes["mirrored_coefficients"]
        assert len(images) > 0, "one of the shapes is symmetric"
        np.testing.assert_array_equal(samples.latents[known], np.concatenate([modes["coefficients"], images]))
    expected = opened.collection.shapes(samples.latents[known]).nric
    np.testing.assert_allclose(samples.nric[known], expected, atol=1e-6)
    learner = learner_of(opened)
    rows = learner.rows
    assert set(known) < set(rows["train"])
    assert not set(known) & {*rows["validation"], *rows["test"]}
    assert not set(known) & set(ShareLearner(learner, 0.5).rows["train"]), "shares have random codes only"
    other = SeedLearner(learner, 1).rows
    assert set(known) < set(other["train"])
    assert not set(known) & {*other["validation"], *other["test"]}


def test_derivatives_are_learned_from_at_training_codes_only(run: Path) -> None:
    opened = Run(run, *load(run / "config.toml"), run / "models")
    learner = learner_of(opened)
    half, other = ShareLearner(learner, 0.5), SeedLearner(learner, 1)
    rows, derivatives = learner.differentiated()
    assert rows.tolist() == learner.split["train"][:6].tolist(), "a tenth of the joint samples"
    expected = opened.collection.differentiated.shapes(learner.joint.latents[rows[:1]]).derivatives
    np.testing.assert_allclose(derivatives[:1], expected, atol=1e-6)
    assert half.differentiated()[0].tolist() == rows.tolist()
    some = other.differentiated()[0]
    assert set(some) == set(rows) & set(other.split["train"])
    figures = json.loads((run / "evaluation.json").read_text())
    assert figures["derivatives"] == 6
    # A core computes one file at a time, and all cores have work.
    assert len(list((run / "samples" / "derivatives").glob("part-*.npz"))) == 6
    assert min(figures["times"][each] for each in ("exact", "exact, with derivatives")) > 0


def test_several_processes_find_the_codes_that_one_finds(copy: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    one = copy.directory.encoded.read()
    copy.directory.encoded.path.unlink()
    monkeypatch.setattr(export, "MANY", 1)
    export.encode_collection(copy)
    assert copy.directory.encoded.read() | {MADE_BY: one[MADE_BY]} == one


@pytest.fixture(scope="module")
def url(run: Path) -> Iterator[str]:
    with starting() as start:
        yield start(run / "models").url


def test_the_server_picks_the_model_up_and_answers_in_the_units_of_the_meshes(url: str, run: Path) -> None:
    card = httpx.get(f"{url}/v1/models/bars").json()
    assert card["latent_dimension"] == 3
    figures = json.loads((run / "evaluation.json").read_text())
    assert figures.pop("made_by")["version"]
    assert card["figures"] == figures
    vertices, faces = bars()
    with np.load(run / "modes.npz") as modes:
        codes = modes["coefficients"]
    answer = httpx.post(f"{url}/v1/models/bars/vertices", json={"latents": codes[:3].tolist()}, timeout=60).json()
    fine = np.array(answer["vertices"])
    assert fine.shape == (3, *vertices.shape[1:])
    diagonal = np.linalg.norm(np.ptp(vertices[0], axis=0))
    for found, exact in zip(fine, vertices, strict=False):
        off = np.linalg.norm(align(found, exact) - exact, axis=1)
        assert max(off[part].mean() for part in (EYE, BAR, NAIL)) < 0.05 * diagonal
        np.testing.assert_allclose(align(found[EYE], exact[EYE]), exact[EYE], atol=1e-5 * diagonal)
    mesh = httpx.get(f"{url}/v1/models/bars/mesh", params={"format": "json", "mesh": "coarse"}).json()
    assert len(mesh["vertices"]) < 140
    assert len(httpx.get(f"{url}/v1/models/bars/mesh", params={"format": "json"}).json()["faces"]) == len(faces)


def test_the_server_encodes_the_user_s_own_files(url: str, run: Path, folder: Path) -> None:
    vertices, _ = bars()
    diagonal = np.linalg.norm(np.ptp(vertices[0], axis=0))
    with np.load(run / "modes.npz") as modes:
        lower, upper = modes["lower"], modes["upper"]
    for k in (1, 4):
        file = (folder / "meshes" / f"bar{k}.obj").read_bytes()
        headers = {"Content-Type": "model/obj"}
        found = httpx.post(f"{url}/v1/models/bars/encode", content=file, headers=headers, timeout=60).json()
        assert found["mesh"] == "fine"
        assert found["vertex_error"]["mean"] < 0.03 * diagonal
        assert len(found["vertex_errors"]) == vertices.shape[1]
        assert (np.array(found["latent"]) > lower - 0.5 * (upper - lower)).all()


def test_files_that_number_their_vertices_otherwise_are_encoded_with_their_attached_parts(url: str) -> None:
    vertices, faces = bars()
    order = np.random.default_rng(2).permutation(len(vertices[2]))
    flat = vertices[2][faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3)
    codes = []
    for shape, numbers in ((vertices[2], faces), (vertices[2][order], np.argsort(order)[faces]), flat):
        content = MESH_FORMATS["ply"].encode(shape, numbers)
        found = httpx.post(f"{url}/v1/models/bars/encode?format=ply", content=content, timeout=60).json()
        codes.append(found["latent"])
        assert found["status"] == "converged", found
        assert len(found["vertex_errors"]) == len(vertices[2])
    np.testing.assert_allclose(codes[1:], [codes[0]] * 2, atol=1e-4)


def test_what_the_files_had_comes_back(url: str, run: Path, folder: Path, tmp_path: Path) -> None:
    given = SURFACE
    shapes, _ = bars()
    mesh = f"{url}/v1/models/bars/mesh"
    with np.load(run / "modes.npz") as modes:
        code = ",".join(map(str, modes["coefficients"][3]))

    def ask(**query: str) -> httpx.Response:
        return httpx.get(mesh, params={"latent": code} | query, timeout=60)

    said = httpx.get(f"{url}/v1/models/bars").json()["surface"]
    assert (said["objects"], said["groups"]) == (["Eye", "Bar", "Nail"], ["left", "right"])
    assert [(material["name"], material["texture"]) for material in said["materials"]] == [
        ("skin", "skin.png"),
        ("cap", None),
    ]

    # But for positions, and for saying that it is smooth, the answer equals each file of the collection.
    answer = parse_obj(ask(format="obj").raise_for_status().text)
    for k in range(len(shapes)):
        file = parse_obj((folder / "meshes" / f"bar{k}.obj").read_text())
        assert answer["polygons"] == [(*polygon, names | {"s": "1"}) for *polygon, names in file["polygons"]]
        np.testing.assert_allclose(answer["vt"], file["vt"], atol=1e-7)
    assert not answer["mtllib"], "a single OBJ file refers to no other files"
    positions = np.array(ask(format="json").json()["vertices"])
    np.testing.assert_allclose(answer["v"], positions, rtol=1e-6)
    archive = zipfile.ZipFile(io.BytesIO(ask(format="zip").content))
    archive.extractall(tmp_path)
    assert (tmp_path / "skin.png").read_bytes() == given.textures["skin.png"]
    assert parse_obj(archive.read("shape.obj").decode())["polygons"] == answer["polygons"]
    (tmp_path / "shape.ply").write_bytes(ask(format="ply").content)
    kept, _ = read_attributes(tmp_path / "shape.ply")
    assert kept
    assert np.array_equal(kept.corners, given.corners)
    assert np.array_equal(kept.starts, given.starts)

    for format, topology, sizes in (
        ("usd", "original", given.sizes),
        ("usdz", "original", given.sizes),
        ("usd", "triangles", np.full(len(given.triangles), 3)),
    ):
        path = tmp_path / f"{topology}.{'usdc' if format == 'usd' else format}"
        path.write_bytes(ask(format=format, topology=topology).raise_for_status().content)
        stage = Usd.Stage.Open(str(path))
        prim = UsdGeom.Mesh(stage.GetDefaultPrim())
        assert not prim.GetPointsAttr().GetTimeSamples(), "a single shape has no time samples"
        np.testing.assert_array_equal(prim.GetPointsAttr().Get(), positions.astype("f4"))
        np.testing.assert_array_equal(prim.GetFaceVertexCountsAttr().Get(), sizes)
        assert {each.GetDisplayName() for each in stage.GetDefaultPrim().GetChildren()} >= {
            "Eye",
            "Bar",
            "Nail",
            "skin",
        }
    with zipfile.ZipFile(tmp_path / "original.usdz") as package:
        assert given.textures["skin.png"] in [package.read(name) for name in package.namelist()]

    # Triangles on request, and in formats without polygons.
    triangles = ask(format="obj", topology="triangles")
    assert [polygon[0] for polygon in parse_obj(triangles.text)["polygons"]] == given.triangles.tolist()
    tags = [ask(format="obj", **more).headers["ETag"] for more in ({}, {"topology": "original"})]
    assert tags[0] == tags[1] != triangles.headers["ETag"]
    for query in ({"format": "glb"}, {"format": "json"}, {"format": "obj", "mesh": "coarse"}):
        refused = ask(topology="original", **query)
        assert refused.status_code == 422
        assert "triangles only" in refused.json()["detail"]
    coarse = parse_obj(ask(format="obj", mesh="coarse").text)
    assert {len(polygon[0]) for polygon in coarse["polygons"]} == {3}
    assert not coarse["vt"]

    # GLB: another reader gets the texture coordinates, and `encode` accepts the file.
    glb = ask(format="glb").content
    scene = trimesh.load_scene(io.BytesIO(glb), file_type="glb", process=False)
    assert {part.visual.material.name for part in scene.geometry.values()} == {"skin", "cap"}
    assert [node["name"] for node in GLB(glb).tree["nodes"]] == ["Eye", "Bar", "Nail"]
    used = {name: np.unique(scene.geometry[name].faces) for name in ("Eye", "Nail")}
    for name, vertices in (("Eye", EYE), ("Nail", NAIL)):
        rows = scene.geometry[name].vertices[used[name]]
        np.testing.assert_allclose(np.unique(rows, axis=0), np.unique(positions[vertices].astype("f4"), axis=0))
    (tmp_path / "shape.glb").write_bytes(glb)
    kept, _ = read_attributes(tmp_path / "shape.glb")
    assert kept
    same_corners(corner_uv(kept), corner_uv(given))
    headers = {"Content-Type": "model/gltf-binary"}
    found = httpx.post(f"{url}/v1/models/bars/encode", content=glb, headers=headers, timeout=60).raise_for_status()
    assert found.json()["vertex_error"]["max"] < 0.01 * np.ptp(positions)
    # A coloured shape has colours instead of the texture.
    tree = GLB(ask(format="glb", color="stretch").content).tree
    assert "images" not in tree
    assert len(tree["materials"]) == 1


def test_animations_have_what_the_files_had(url: str, run: Path, tmp_path: Path) -> None:
    given = SURFACE
    with np.load(run / "modes.npz") as modes:
        body = {"keyframes": modes["coefficients"][:2].tolist(), "frames": 3}
    made = httpx.post(f"{url}/v1/models/bars/interpolations", json=body).json()
    address = f"{url}/v1/interpolations/{made['id']}"

    def ask(**query: str) -> httpx.Response:
        return httpx.get(address, params=query, timeout=60)

    glb = GLB(ask(format="glb").content)
    rows = glb.array(glb.primitive["attributes"]["_VERTEX"]).astype(int)
    frame = httpx.get(f"{address}/frames/2", params={"format": "json"}, timeout=60).json()
    np.testing.assert_allclose(glb.key(2), np.array(frame["vertices"])[rows], atol=1e-3)
    assert [channel["target"]["node"] for channel in glb.tree["animations"][0]["channels"]] == [0, 1, 2]
    assert len(glb.tree["images"]) == 1
    with zipfile.ZipFile(io.BytesIO(ask(format="zip").content)) as archive:
        assert sorted(archive.namelist()) == [*(f"frame-{k:04d}.obj" for k in range(3)), "frames.mtl", "skin.png"]
        last = parse_obj(archive.read("frame-0002.obj").decode())
    assert last["mtllib"] == ["frames.mtl"]
    assert [len(polygon[0]) for polygon in last["polygons"]] == given.sizes.tolist()
    for topology, sizes in (("original", given.sizes), ("triangles", np.full(len(given.triangles), 3))):
        path = tmp_path / f"{topology}.usdc"
        path.write_bytes(ask(format="usd", topology=topology).content)
        stage = Usd.Stage.Open(str(path))
        mesh = UsdGeom.Mesh(stage.GetDefaultPrim())
        np.testing.assert_array_equal(mesh.GetFaceVertexCountsAttr().Get(), sizes)
        subsets = {each.GetDisplayName() for each in stage.GetDefaultPrim().GetChildren()}
        assert subsets >= {"Eye", "Bar", "Nail"}
    assert ask(format="npz", topology="original").status_code == 422
    one = httpx.get(f"{address}/frames/1", params={"format": "obj", "topology": "triangles"}, timeout=60)
    assert {len(polygon[0]) for polygon in parse_obj(one.text)["polygons"]} == {3}


def test_the_server_has_the_exponentials_that_the_networks_learned_from(url: str, run: Path) -> None:
    with np.load(run / "samples" / "part-00000.npz") as part, np.load(run / "reference.npz") as reference:
        assert (part["status"][:2] == "done").all()
        codes, shapes = part["latents"][:2], part["vertices"][:2] * reference["scale"]
    body = {"latents": codes.tolist(), "mesh": "coarse", "exact": True}
    answer = httpx.post(f"{url}/v1/models/bars/vertices", json=body, timeout=60).json()
    for exact, shape in zip(answer["exact"], shapes, strict=True):
        np.testing.assert_allclose(exact, align(shape, np.array(exact)), atol=0.01)
