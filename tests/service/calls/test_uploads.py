"""Uploads of ``encode`` and ``fit``: fields of forms are options, and the content of a file decides its format."""

from __future__ import annotations

import base64
import gzip
import io
import json
import zipfile
from typing import Any

import httpx
import numpy as np
import pytest

from shapespace.files.formats import MESH_FORMATS
from shapespace.service.use_cases.uploads import FORMATS, POINT_FORMATS
from tests.service.bundles import SCALE, reference

ENCODE, FIT = "/v1/models/with-fine/encode", "/v1/models/with-fine/fit"
MESH = reference()
OBJ = MESH_FORMATS["obj"].encode(SCALE * MESH.vertices, MESH.faces)
FILE = {"file": ("shape.obj", OBJ)}


def in_millimetres() -> bytes:
    return b"".join(b"%r %r %r\n" % tuple(row) for row in (1000 * SCALE * MESH.vertices).tolist())


def found(answer: httpx.Response) -> dict[str, Any]:
    return answer.raise_for_status().json()


def test_fields_act_as_query_parameters_do(client: httpx.Client) -> None:
    scan = {"file": ("cloud.xyz", in_millimetres())}
    assert client.post(FIT, files=scan).status_code == 422, "other units"
    by_query = found(client.post(FIT, files=scan, params={"scale": "free", "samples": 2, "fixed": '{"1": 0.25}'}))
    by_fields = found(client.post(FIT, files=scan, data={"scale": "free", "samples": "2", "fixed": '{"1": 0.25}'}))
    assert by_fields == by_query
    assert by_query["latent"][1] == 0.25
    asked = {"samples": 2, "bounds": "clamp", "objective": "nric", "fixed": '{"1": 0.5}', "seed": 3}
    by_query = found(client.post(ENCODE, files=FILE, params=asked))
    assert found(client.post(ENCODE, files=FILE, data=asked)) == by_query
    assert len(by_query["samples"]) == 2


@pytest.mark.parametrize("call", [ENCODE, FIT])
def test_options_may_be_a_field_or_a_file(client: httpx.Client, call: str) -> None:
    options = json.dumps({"fixed": {"1": 0.5}, "samples": 1})
    by_fields = found(client.post(call, files=FILE, data={"fixed": '{"1": 0.5}', "samples": 1}))
    assert found(client.post(call, files=FILE, data={"options": options})) == by_fields
    for content in (options.encode(), options.encode("utf-8-sig")):
        file = {"options": ("o.json", content, "application/json")}
        assert found(client.post(call, files=FILE | file)) == by_fields
    # A file for another field; and a field of an HTML form without a value.
    file = {"fixed": ("fixed.json", b'{"1": 0.5}')}
    assert found(client.post(call, files=FILE | file, data={"samples": "1", "options": ""})) == by_fields
    # The file of a form may have any name, that of an option too.
    assert found(client.post(call, files={"seed": ("shape.obj", OBJ)}, data={"options": options})) == by_fields


def test_a_form_has_priority_over_the_query(client: httpx.Client) -> None:
    expected = found(client.post(ENCODE, files=FILE, params={"samples": 1, "seed": 4}))
    assert found(client.post(ENCODE, files=FILE, params={"samples": 1, "seed": 9}, data={"seed": 4})) == expected
    file = {"file": ("shape", OBJ)}
    answer = client.post(ENCODE, files=file, params={"samples": 1, "format": "ply"}, data={"seed": 4, "format": "OBJ"})
    assert found(answer) == expected


def test_a_field_chooses_the_version(client: httpx.Client) -> None:
    path = "/v1/models/small/encode"
    digests = {
        version: found(client.post(path, files=FILE, data={"version": version}))["diagnostics"]["model"]
        for version in ("1", "2")
    }
    assert digests["2"] == found(client.post(path, files=FILE, params={"version": "2"}))["diagnostics"]["model"]
    assert digests["1"] != digests["2"]
    assert client.post(path, files=FILE, data={"version": "9"}).status_code == 404


@pytest.mark.parametrize("call", [ENCODE, FIT])
@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"samples": "banana"}, "samples"),
        ({"nosie": "1"}, "no field 'nosie' here: choose among fixed, samples, seed"),
        ({"fixed": '{"one": 1}'}, "'one' is not an index"),
        ({"fixed": "{"}, "fixed is not JSON"),
        ({"options": "{"}, "options is not JSON"),
        ({"options": '{"nosie": 1}'}, "options.nosie"),
        ({"options": '{"samples": 1, "samples": 2}'}, "the member 'samples' twice"),
        ({"samples": "1_0"}, "whole number for samples"),
        ({"options": '{"samples": "2"}'}, "options.samples"),
        ({"options": '{"samples": 2}', "samples": "2"}, "samples as a field and in options"),
        ({"samples": ["1", "2"]}, "the field 'samples' twice"),
        ({"samples": b"\xff\xfe\x00"}, "'samples' is not text"),
    ],
)
def test_a_wrong_field_is_named(client: httpx.Client, call: str, fields: dict[str, Any], says: str) -> None:
    answer = client.post(call, files=FILE, data=fields)
    assert answer.status_code == 422, answer.text
    assert answer.json()["type"].endswith("invalid-request")
    assert says in answer.json()["detail"]


def test_what_comes_cut_short_or_says_a_thing_twice_is_refused(client: httpx.Client) -> None:
    request = client.build_request("POST", ENCODE, files=FILE)
    short = request.read().rpartition(b"\r\n--")[0]
    answer = client.post(ENCODE, content=short, headers={"Content-Type": request.headers["Content-Type"]})
    assert (answer.status_code, answer.json()["type"]) == (400, "urn:shapespace:problem:malformed-request")
    assert "ends before its last boundary" in answer.json()["detail"]
    twice = client.post(
        ENCODE, headers={"Content-Type": "application/json"}, content=b'{"vertices": [], "faces": [], "vertices": []}'
    )
    assert "'vertices' twice" in twice.json()["detail"]
    wide = client.post(ENCODE, headers={"Content-Type": "application/json"}, content='{"}}": "}"}'.encode("utf-16"))
    assert wide.json()["type"] == "urn:shapespace:problem:invalid-mesh"
    assert client.post(FIT, files=FILE, params={"noise": "inf"}).json()["type"].endswith("not-finite")


def test_a_wrong_value_of_each_call_is_named(client: httpx.Client) -> None:
    for call, name in ((ENCODE, "bounds"), (FIT, "scale")):
        answer = client.post(call, files=FILE, data={name: "banana"})
        assert answer.status_code == 422
        assert name in answer.json()["errors"][0]["pointer"]
        assert "for scale" in answer.json()["detail"] or "for bounds" in answer.json()["detail"]
    # The message helps where the file can't be read either.
    answer = client.post(ENCODE, files={"file": ("shape.obj", b"nothing")}, data={"fromat": "off"})
    assert "'fromat'" in answer.json()["detail"]


def test_the_content_decides_the_format(client: httpx.Client) -> None:
    expected = found(client.post(ENCODE, files=FILE))["latent"]
    for format in ("glb", "gltf", "ply", "stl", "npz"):
        content = MESH_FORMATS[format].encode(SCALE * MESH.vertices, MESH.faces)
        latent = found(client.post(ENCODE, files={"file": ("shape.obj", content, "text/plain")}))["latent"]
        np.testing.assert_allclose(latent, expected, atol=1e-4)
    for arguments in (
        {"content": OBJ},
        {"content": OBJ, "headers": {"Content-Type": "text/plain; charset=utf-8"}},
        {"content": OBJ, "headers": {"Content-Type": "application/x-www-form-urlencoded"}},
        {"content": OBJ, "headers": {"Content-Type": "model/stl"}, "params": {"format": "OBJ"}},
        {"content": OBJ.decode().encode("utf-16"), "headers": {"Content-Type": "text/plain"}},
        {"files": {"file": ("shape.OBJ", OBJ, "image/png")}},
        {"files": {"file": ("shape.dat", OBJ, "application/x-dat")}},
    ):
        assert found(client.post(ENCODE, **arguments))["latent"] == expected  # type: ignore[arg-type]
    scan = in_millimetres()
    for arguments in (
        {"files": {"file": ("cloud.xyz", scan, "text/plain")}, "params": {"scale": "free"}},
        {"content": scan, "headers": {"Content-Type": "text/plain"}, "params": {"scale": "free"}},
        {"files": {"file": ("cloud.asc", scan)}, "params": {"scale": "free"}},
    ):
        assert found(client.post(FIT, **arguments))["placement"]["scale"] == pytest.approx(1000, rel=0.2)  # type: ignore[arg-type]


PNG = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0\1\0\xff\xd8"
REFUSED: dict[str, tuple[bytes, str, str | None, int, str]] = {
    "a picture": (PNG, "shape.obj", None, 415, "is a PNG picture"),
    "a picture, said to be OBJ": (PNG, "shape", "obj", 422, "it is a PNG picture"),
    "bytes": (b"\x01\xfe\xfa\0" * 50, "shape.obj", None, 422, "The server read it as obj, as its name says"),
    "a packed file": (gzip.compress(OBJ), "shape.obj.gz", None, 415, "unpack it first"),
    "an extension": (b"hello", "shape.fbx", None, 415, ".fbx is not the extension"),
    "UTF-16 without a mesh": ("hello\n".encode("utf-16"), "shape.obj", None, 422, "it holds no vertices"),
    "a GLB, said to be PLY": (
        MESH_FORMATS["glb"].encode(MESH.vertices, MESH.faces),
        "shape",
        "PLY",
        422,
        "looks like glb",
    ),
    "lines of MNI": (b"L 1 1\n0 0 0\n", "fibres.obj", None, 422, "MNI's OBJ with lines"),
    "half an archive": (b"PK\x03\x04" + bytes(40), "shape.zip", None, 422, "damaged"),
}


@pytest.mark.parametrize("call", [ENCODE, FIT])
@pytest.mark.parametrize("fault", REFUSED)
def test_a_refusal_names_the_format_the_reason_and_the_choices(client: httpx.Client, fault: str, call: str) -> None:
    content, name, format, status, says = REFUSED[fault]
    answer = client.post(call, files={"file": (name, content)}, params={"format": format} if format else {})
    detail = answer.json()["detail"]
    assert answer.status_code == status, answer.text
    assert says in detail
    assert ", ".join((*(FORMATS if call == ENCODE else POINT_FORMATS), "zip")) in detail
    assert detail.isprintable()
    assert "PNG\\" not in detail
    assert "\ufffd" not in detail


def test_points_are_no_mesh(client: httpx.Client) -> None:
    answer = client.post(ENCODE, content=in_millimetres(), headers={"Content-Type": "text/plain"})
    assert answer.status_code == 415
    assert "has points and no faces" in answer.json()["detail"]


def test_a_zip_may_hold_a_gltf_file_and_its_buffer(client: httpx.Client) -> None:
    """Whole scenes are downloaded like this. Names may start with ./ in archives of some programs."""
    tree = json.loads(MESH_FORMATS["gltf"].encode(SCALE * MESH.vertices, MESH.faces))
    data = base64.b64decode(tree["buffers"][0]["uri"].partition(",")[2])
    tree["buffers"][0]["uri"] = "data/scene%201.bin"
    for folder in ("", "./", "scene/"):
        content = io.BytesIO()
        with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr(f"{folder}scene.gltf", json.dumps(tree))
            archive.writestr(f"{folder}data/scene 1.bin", data)
        assert found(client.post(ENCODE, content=content.getvalue()))["status"] == "converged"
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.writestr("a/scene.gltf", json.dumps(tree).replace("data/", "../data/"))
        archive.writestr("data/scene 1.bin", data)
    assert "which is not beside it" in client.post(ENCODE, content=content.getvalue()).json()["detail"]


def zipped(**files: bytes) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name, data in files.items():
            archive.writestr(name.replace("_", "."), data)
    return content.getvalue()


def test_a_zip_of_frames_gives_the_code_of_each(client: httpx.Client) -> None:
    keys = [[0.0, 0.2, 0.4], [0.1, 0.7, 0.4]]
    made = client.post("/v1/models/with-fine/interpolations", json={"keyframes": keys, "frames": 3}).json()
    content = client.get(f"/v1/interpolations/{made['id']}", params={"format": "zip"}).content
    for arguments in (
        {"content": content, "headers": {"Content-Type": "application/zip"}},
        {"files": {"file": ("frames.zip", content)}},
        {"content": content, "params": {"format": "ZIP"}},
    ):
        meshes = found(client.post(ENCODE, **arguments))["meshes"]  # type: ignore[arg-type]
        latents = np.array([mesh["latent"] for mesh in meshes])
        np.testing.assert_allclose(latents, np.linspace(keys[0], keys[1], 3), atol=1e-2)
        names = [mesh["name"] for mesh in meshes]
        assert names == sorted(names)
        assert {mesh["status"] for mesh in meshes} == {"converged"}
    answer = client.post(FIT, content=content)
    assert answer.status_code == 422
    assert "3 meshes" in answer.json()["detail"]


def test_a_zip_of_mesh_files_is_read_in_natural_order(client: httpx.Client) -> None:
    expected = found(client.post(ENCODE, files=FILE))
    assert found(client.post(ENCODE, content=zipped(a_mtl=b"newmtl a\n", a_obj=OBJ, a_png=PNG))) == expected
    ply = MESH_FORMATS["ply"].encode(1.1 * SCALE * MESH.vertices, MESH.faces)
    content = zipped(pose10_ply=ply, pose2_OBJ=OBJ, README_txt=b"1 2 3")
    meshes = found(client.post(ENCODE, content=content))["meshes"]
    assert [mesh["name"] for mesh in meshes] == ["pose2.OBJ", "pose10.ply"]
    assert meshes[0]["latent"] == expected["latent"]
    scan = found(client.post(FIT, content=zipped(cloud_xyz=in_millimetres()), params={"scale": "free"}))
    assert scan["placement"]["scale"] == pytest.approx(1000, rel=0.2)
    for files, says in (
        ({}, "the archive is empty"),
        ({"a_txt": b"1 2 3"}, "holds no mesh file, only a.txt"),
        ({"a_obj": OBJ, "b_obj": b"v 1 2"}, "b.obj: not a readable obj file: line 1 can't be read: a vertex is"),
        ({"a_obj": OBJ, "b_obj": PNG}, "b.obj: is a PNG picture"),
        ({"a_obj": OBJ, "b_obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"}, "b.obj: "),
        ({f"a{k}_obj": OBJ for k in range(21)}, "more than 20 meshes"),
    ):
        answer = client.post(ENCODE, content=zipped(**files))
        assert answer.status_code == 422, answer.text
        assert says in answer.json()["detail"]
