"""``encode``: from a mesh, in any pose and any file format, back to its code."""

import json
import re
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapespace.bundle.reader import read_bundle
from shapespace.files.formats import MESH_FORMATS, VTK_FORMATS
from shapespace.files.npz import npz_bytes
from shapespace.mesh.rigid_motion import align
from shapespace.mesh.triangle_mesh import TriangleMesh
from shapespace.model.correspondence import InvalidMeshError, Matched, limits, match
from shapespace.model.decoder import MeshChoice
from shapespace.model.shape_model import ShapeModel
from shapespace.service.use_cases.uploads import FORMATS, POINT_FORMATS, read_mesh_files
from tests.hostile import HOSTILE, MIB
from tests.service.bundles import SCALE, fine_reference, reference, seal, write_bundle

ENCODE = "/v1/models/with-fine/encode"
CODE = [0.1, 0.7, 0.4]


def mesh_file(client: httpx.Client, format: str = "json", model: str = "with-fine", **body: Any) -> httpx.Response:
    body = {"latent": CODE} | body
    return client.post(f"/v1/models/{model}/mesh", json=body, params={"format": format}).raise_for_status()


def as_json(vertices: np.ndarray, faces: np.ndarray | None = None) -> bytes:
    content = {"vertices": vertices.tolist()} | ({} if faces is None else {"faces": faces.tolist()})
    return json.dumps(content).encode()


def encode(client: httpx.Client, content: bytes, format: str | None = "json", path: str = ENCODE, **query: str) -> Any:
    params = query | ({"format": format} if format else {})
    answer = client.post(path, content=content, params=params)
    assert answer.status_code == 200, answer.text
    return answer.json()


@pytest.mark.parametrize("name", ["figure", "freaky-torus"])
def test_codes_come_back_from_turned_and_moved_shapes(client: httpx.Client, name: str) -> None:
    card = client.get(f"/v1/models/{name}").json()
    lower, upper = np.array(card["lower"]), np.array(card["upper"])
    codes = client.post(f"/v1/models/{name}/sample", json={"count": 4, "seed": 5}).json()["latents"]
    rng = np.random.default_rng(0)
    errors = []
    for code in codes:
        shape = mesh_file(client, model=name, latent=code).json()
        vertices = np.array(shape["vertices"]) @ Rotation.random(rng=rng).as_matrix() + rng.normal(size=3)
        found = encode(client, as_json(vertices, np.array(shape["faces"])), path=f"/v1/models/{name}/encode")
        turns = np.round((np.array(found["latent"]) - code) / (upper - lower)) * [p is not None for p in card["period"]]
        errors.append(np.abs((np.array(found["latent"]) - code) / (upper - lower) - turns))
        assert found["status"] == "converged"
        assert found["residual"] < 0.03
        diagonal = np.linalg.norm(np.ptp(vertices, axis=0))
        assert 0 < found["vertex_error"]["mean"] <= found["vertex_error"]["max"] < 0.005 * diagonal
        assert found["vertex_error"]["max"] == pytest.approx(max(found["vertex_errors"]), rel=1e-5)
        assert len(found["vertex_errors"]) == len(vertices)
        assert found["diagnostics"]["model"] == card["digest"]
    assert np.median(errors) < 2e-3
    assert np.max(errors) < 0.02


@pytest.mark.parametrize("mesh", ["fine", "coarse"])
@pytest.mark.parametrize("format", [*MESH_FORMATS, *VTK_FORMATS, "json"])
def test_every_format_gives_the_same_code(client: httpx.Client, format: str, mesh: str) -> None:
    expected = encode(client, mesh_file(client, mesh="coarse").content)
    file = mesh_file(client, format, mesh=mesh)
    media_type = {"Content-Type": file.headers["Content-Type"]}
    for answer in (
        client.post(ENCODE, content=file.content, headers=media_type),
        client.post(ENCODE, content=file.content, params={"format": format}),
        client.post(ENCODE, files={"file": (f"shape.{format}", file.content)}),
        client.post(ENCODE, files={"file": ("shape", file.content, media_type["Content-Type"])}),
    ):
        found = answer.raise_for_status().json()
        np.testing.assert_allclose(found["latent"], expected["latent"], atol=2e-5)
        assert found["mesh"] == mesh
        assert len(found["vertex_errors"]) == len(fine_reference().vertices if mesh == "fine" else reference().vertices)


def test_off_is_read_though_it_is_never_written(client: httpx.Client) -> None:
    shape = mesh_file(client).json()
    expected = encode(client, as_json(np.array(shape["vertices"]), np.array(shape["faces"])))
    rows = [*shape["vertices"], *([3, *face] for face in shape["faces"])]
    lines = ["OFF", f"{len(shape['vertices'])} {len(shape['faces'])} 0", *(" ".join(map(repr, row)) for row in rows)]
    content = "\n".join(lines).encode()
    assert encode(client, content, "off") == expected
    for answer in (
        client.post(ENCODE, content=content, headers={"Content-Type": "application/octet-stream"}),
        client.post(ENCODE, files={"file": ("shape.OFF", content)}),
    ):
        assert answer.raise_for_status().json() == expected


def test_the_page_lets_choose_every_format(client: httpx.Client) -> None:
    (accepted,) = re.findall(r'id="mesh-file"[^>]* accept="(.*?)"', client.get("/").text)
    assert set(accepted.split(",")) == {f".{format}" for format in POINT_FORMATS}


def test_what_the_query_says_wins(client: httpx.Client) -> None:
    content = mesh_file(client, "obj").content
    answer = client.post(ENCODE, content=content, params={"format": "obj"}, headers={"Content-Type": "model/stl"})
    assert answer.status_code == 200
    wrong = client.post(ENCODE, files={"file": ("shape.obj", content)}, params={"format": "ply"})
    assert wrong.status_code == 422


def test_residual_and_vertex_error_tell_how_far_a_mesh_is_from_the_model(client: httpx.Client) -> None:
    # A uniform scaling is a shape of this model, so no error remains.
    mesh = reference()
    found = encode(client, as_json(1.1 * SCALE * mesh.vertices, mesh.faces))
    np.testing.assert_allclose([found["latent"][0], found["latent"][2]], [0.1, 0], atol=1e-4)
    assert found["residual"] < 1e-5
    assert found["vertex_error"]["max"] < 1e-4
    rough = mesh.vertices + 0.02 * np.random.default_rng(0).normal(size=mesh.vertices.shape)
    found = encode(client, as_json(SCALE * rough, mesh.faces))
    assert found["residual"] > 0.05
    assert found["vertex_error"]["mean"] > 0.01


def test_bounds(client: httpx.Client) -> None:
    content = as_json(1.3 * SCALE * reference().vertices)
    free = encode(client, content)
    assert not free["inside_bounds"]
    assert free["latent"][0] == pytest.approx(0.3, abs=1e-4)
    clamped = encode(client, content, bounds="clamp")
    assert clamped["inside_bounds"]
    assert clamped["latent"][0] == pytest.approx(0.2, abs=1e-6)
    assert clamped["residual"] > 0.02
    refused = client.post(ENCODE, content=content, params={"format": "json", "bounds": "reject"})
    assert refused.json()["type"].endswith("out-of-bounds")


def test_the_query_says_what_is_fixed_and_how_many_samples(client: httpx.Client) -> None:
    content = mesh_file(client).content
    plain = encode(client, content)
    found = encode(client, content, fixed='{"2": 0.25, "0": 0.3}', samples="3", seed="4")
    assert (found["latent"][0], found["latent"][2]) == (np.float32(0.3), 0.25)
    assert found["vertex_error"]["mean"] > plain["vertex_error"]["mean"]
    assert np.shape(found["covariance"]) == (3, 3)
    assert not np.any(found["covariance"][2])
    assert found["covariance"][1][1] > 0
    assert [row[2] for row in found["samples"]] == [0.25] * 3
    assert plain["samples"] == []
    for query, says in (
        ({"fixed": "{"}, "fixed is not JSON"),
        ({"fixed": "[1]"}, "fixed"),
        ({"fixed": '{"3": 1}'}, "coordinates 0 to 2"),
        ({"fixed": '{"one": 1}'}, "'one' is not an index"),
        ({"fixed": '{"1": "0"}'}, "the value at 1 is not a finite number"),
        ({"fixed": '{"1": NaN}'}, "the value at 1 is not a finite number"),
        ({"fixed": '{"1": 1e39}'}, "fixed[1] is not a finite number"),
        ({"samples": "21"}, "the limit is 20"),
        ({"samples": "-1"}, "samples"),
        ({"seed": "x"}, "seed"),
    ):
        answer = client.post(ENCODE, content=content, params={"format": "json"} | query)
        assert answer.status_code == 422, answer.text
        assert says in answer.json()["detail"]


def test_faces_may_be_in_any_order_and_left_out_of_json(client: httpx.Client) -> None:
    shape = mesh_file(client).json()
    vertices, faces = np.array(shape["vertices"]), np.array(shape["faces"])
    shuffled = np.roll(np.random.default_rng(0).permutation(faces), 1, axis=1)
    expected = encode(client, as_json(vertices, faces))
    for content in (as_json(vertices, shuffled), as_json(vertices)):
        assert encode(client, content) == expected


def test_files_larger_than_other_bodies_may_be(client: httpx.Client) -> None:
    content = mesh_file(client).content + b" " * 200_000
    assert encode(client, content)["status"] == "converged"


MESH, OTHER = reference(), TriangleMesh.from_arrays(*[[[0, 0, 0], [1, 0, 0], [0, 1, 0.0]], [[0, 1, 2]]])
SHUFFLED = np.random.default_rng(0).permutation(MESH.faces)
NAN, HUGE = MESH.vertices.copy(), MESH.vertices.copy()
NAN[5, 1], HUGE[7, 0] = np.nan, 1e300


def written(format: str, vertices: np.ndarray = MESH.vertices, faces: np.ndarray = MESH.faces) -> bytes:
    return MESH_FORMATS[format].encode(vertices, faces)


def npz_with_objects() -> bytes:
    return npz_bytes({"vertices": MESH.vertices, "faces": MESH.faces, "more": np.array([{}], dtype=object)})


BAD = {
    **{f"garbage as {f}": (b"\x93 no mesh at all \xff\x00" * 20, f, "Send a correct") for f in FORMATS},
    **{f"half a {f}": (written(f)[: len(written(f)) // 2], f, "") for f in ("glb", "gltf", "ply", "npz")},
    "nothing": (b"", "obj", "The file is empty"),
    "NaN": (written("npz", NAN), "npz", "Vertex 5 has a coordinate that is not a finite number"),
    "beyond floats": (as_json(HUGE), "json", "Vertex 7 has a coordinate"),
    "another mesh": (written("obj", OTHER.vertices, OTHER.faces), "obj", "has 3 vertices and 1 faces, but those of"),
    "other faces": (written("ply", faces=MESH.faces[:, [0, 1, 2]] % 60), "ply", "No face joins vertices"),
    "a face less": (written("ply", faces=MESH.faces[1:]), "ply", "has 127 faces, but the model's has 128"),
    "inside out": (written("obj", faces=MESH.faces[:, ::-1]), "obj", "turn them, and mirror the mesh too if"),
    "faces out of range": (as_json(MESH.vertices, MESH.faces + 1), "json", "vertices 1 to 64"),
    "STL in another order": (written("stl", faces=SHUFFLED), "stl", "Give the faces in the model's order"),
    "a single point": (as_json(0 * MESH.vertices), "json", "no edge has a length"),
    "JSON of numbers": (b"[1, 2, 3]", "json", "not an object"),
    "JSON of text": (b'{"vertices": ["a", "b"]}', "json", "vertices must be"),
    "ragged JSON": (b'{"vertices": [[1, 2], [3]]}', "json", "three numbers each"),
    "faces of text": (b'{"vertices": [[1, 2, 3]], "faces": "all"}', "json", "faces must be"),
    "an archive of nothing": (HOSTILE["npz_of_zeros"](MIB)[1], "npz", "more than 32768 vertices"),
    "a hollow GLB": (HOSTILE["glb_of_nothing"](MIB)[1], "glb", "accessor 0 has no data"),
    "pickles": (npz_with_objects(), "npz", "pickled objects"),
}


@pytest.mark.parametrize("fault", BAD)
def test_files_that_cannot_be_used_are_refused_in_one_line(client: httpx.Client, fault: str) -> None:
    content, format, says = BAD[fault]
    answer = client.post(ENCODE, content=content, params={"format": format})
    problem = answer.json()
    assert answer.status_code == 422, problem
    assert problem["type"] == "urn:shapespace:problem:invalid-mesh"
    assert says in problem["detail"]
    assert "\n" not in problem["detail"]
    assert len(problem["detail"]) < 400


def test_requests_without_a_known_format_or_a_file_are_refused(client: httpx.Client) -> None:
    content = mesh_file(client, "obj").content
    for arguments, status, says in (
        ({"content": b"neither a mesh nor points"}, 415, "neither its content nor a name or a media type"),
        ({"content": b"neither", "headers": {"Content-Type": "image/png"}}, 415, "image/png is not the media type"),
        ({"content": content, "params": {"format": "fbx"}}, 415, "no format 'fbx' here"),
        ({"files": {"file": ("shape.fbx", b"neither")}}, 415, "is not the extension of a format"),
        ({"files": {"a": ("a.obj", content), "b": ("b.obj", content)}}, 400, "Too many files"),
        ({"files": {"a": (None, "text")}}, 422, "no file"),
        ({"content": b"x", "headers": {"Content-Type": "multipart/form-data"}}, 400, "Missing boundary"),
    ):
        answer = client.post(ENCODE, **arguments)  # type: ignore[arg-type]
        assert answer.status_code == status, answer.text
        assert answer.headers["Content-Type"] == "application/problem+json"
        assert says in answer.json()["detail"]


def test_meshes_that_are_hardly_surfaces_are_answered_too(client: httpx.Client) -> None:
    for stretch in ([1, 0, 0], [1, 1, 0], [-1, 1, 1]):
        found = encode(client, as_json(SCALE * MESH.vertices * stretch, MESH.faces))
        assert np.isfinite(found["latent"]).all()
        assert found["residual"] > 0.1


@pytest.fixture
def of_files(tmp_path: Path) -> ShapeModel:
    """A model whose files have an unused vertex first, and a copy of the mesh's vertex 7 at the end."""
    folder = write_bundle(tmp_path)
    with np.load(folder / "geometry.npz") as file:
        arrays = dict(file)
    arrays["file_vertices"] = np.array([-1, *range(64), 7])
    (folder / "geometry.npz").write_bytes(npz_bytes(arrays))
    seal(folder)
    return ShapeModel(read_bundle(folder))


def matched(model: ShapeModel, data: bytes, format: str) -> Matched:
    ((vertices, faces, _),), _ = read_mesh_files(data, "", format, limits(model.decoder))
    return match(model.decoder, vertices, faces)


def test_files_like_those_that_the_model_was_made_of(of_files: ShapeModel) -> None:
    vertices = np.concatenate([[[9, 9, 9]], MESH.vertices, MESH.vertices[7:8]])
    faces = MESH.faces + 1
    seam = np.argwhere(faces == 8)[0]
    faces[tuple(seam)] = 65
    found = matched(of_files, MESH_FORMATS["obj"].encode(vertices, faces), "obj")
    assert found.mesh is MeshChoice.FINE
    np.testing.assert_allclose(found.vertices, MESH.vertices, atol=1e-7)
    welded = matched(of_files, written("obj"), "obj")
    np.testing.assert_array_equal(welded.vertices, found.vertices)
    # Faces of a part that the model leaves out are accepted.
    with_part = np.concatenate([faces, [[0, 0, 0]]])
    again = matched(of_files, MESH_FORMATS["obj"].encode(vertices, with_part), "obj")
    np.testing.assert_array_equal(again.vertices, found.vertices)
    faces[0, 0] = 0  # the unused vertex
    with pytest.raises(InvalidMeshError, match="No face joins"):
        matched(of_files, MESH_FORMATS["obj"].encode(vertices, faces), "obj")


def bent(x: np.ndarray, length: float) -> np.ndarray:
    """A shape (V, 3) displaced by waves of this length, which no code can represent."""
    return x + 0.1 * length * np.sin(x / length)[:, [1, 2, 0]]


def test_the_objective_says_what_comes_closest(client: httpx.Client) -> None:
    shape = np.array(mesh_file(client, model="figure", latent=[0.5] * 20).json()["vertices"])
    content = as_json(bent(shape, np.ptp(shape[:, 1]) / 6))
    path = "/v1/models/figure/encode"
    by_vertices = encode(client, content, path=path)
    assert encode(client, content, path=path, objective="vertices") == by_vertices
    by_nric = encode(client, content, path=path, objective="nric")
    assert by_nric["residual"] < 0.99 * by_vertices["residual"]
    assert by_vertices["vertex_error"]["mean"] < 0.8 * by_nric["vertex_error"]["mean"]
    assert by_vertices["iterations"] <= 30
    wrong = client.post(path, content=content, params={"format": "json", "objective": "pose"})
    assert wrong.status_code == 422


def test_the_code_is_the_minimum_over_vertices(client: httpx.Client) -> None:
    mesh = reference()
    target = bent(SCALE * mesh.vertices, SCALE / 3)

    def squares(latent: np.ndarray) -> float:
        shape = np.array(mesh_file(client, mesh="coarse", latent=latent.tolist()).json()["vertices"])
        return float(((align(shape, target) - target) ** 2).sum())

    found = encode(client, as_json(target, mesh.faces))
    code = np.array(found["latent"])
    assert squares(code) == pytest.approx(float(np.square(found["vertex_errors"]).sum()), rel=1e-3)
    # Codes outside the bounds may be nearer, by 2 % at most.
    lower, upper = np.array([-0.2, -np.pi, 0]), np.array([0.2, np.pi, 1])
    for step in [*0.02 * np.eye(len(code)), *-0.02 * np.eye(len(code))]:
        inside = ((lower <= code + step) & (code + step <= upper)).all()
        assert squares(code) < squares(code + step) * (1 if inside else 1.02**2)


def test_vertices_may_be_split_and_numbered_otherwise(client: httpx.Client) -> None:
    """As after flat shading, or once a program has read our STL: the faces are in the model's order."""
    rng = np.random.default_rng(4)
    shape = mesh_file(client).json()
    vertices, faces = np.array(shape["vertices"]), np.array(shape["faces"])
    corners = faces.ravel().copy()
    alone = rng.random(len(corners)) < 0.3
    corners[alone] = len(vertices) + np.arange(alone.sum())
    split = np.concatenate([vertices, vertices[faces.ravel()[alone]]])
    order = rng.permutation(len(split))
    renumbered = as_json(split[order], np.argsort(order)[corners].reshape(-1, 3))
    assert encode(client, renumbered) == encode(client, as_json(vertices, faces))
