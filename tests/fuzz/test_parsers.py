"""Bytes from outside, as hypothesis makes them up: every parser reads them or refuses them in one line.

A few hundred, the same each time, in the whole suite; ``make fuzz`` tries thousands of new ones.
"""

from __future__ import annotations

import base64
import json
import os
import sys
import tracemalloc
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from shapespace.bundle.reader import BundleError, read_bundle
from shapespace.bundle.schema import Manifest
from shapespace.files.formats import MESH_FORMATS, read_arrays
from shapespace.files.limits import Limits
from shapespace.mesh.triangle_mesh import MeshError
from shapespace.model.correspondence import InvalidMeshError, Matched, limits, match
from shapespace.model.latent_space import LatentError
from shapespace.model.shape_model import ShapeModel
from shapespace.service.http.negotiation import choose
from shapespace.service.http.problems import ProblemError
from shapespace.service.use_cases.animation import Animation, UnknownInterpolationError
from shapespace.service.use_cases.uploads import FORMATS, UploadError, read_mesh_file
from shapespace.training.collection.ingest import IngestError, read_collection
from tests.hostile import BINARY, MATRIX, document, glb
from tests.service.bundles import reference, seal, write_bundle

EXAMPLES = int(os.environ.get("FUZZ_EXAMPLES", "0"))
fuzz = settings(
    max_examples=EXAMPLES or 40,
    derandomize=not EXAMPLES,
    deadline=None,
    database=None,
    suppress_health_check=list(HealthCheck),
)
MESH = reference()
#: Formats that are read and not written.
OFF = f"OFF\n{len(MESH.vertices)} {len(MESH.faces)} 0\n".encode() + b"".join(
    [
        *(b"%.9g %.9g %.9g\n" % tuple(v) for v in MESH.vertices.tolist()),
        *(b"3 %d %d %d\n" % tuple(f) for f in MESH.faces.tolist()),
    ]
)
SOUND = {name: kind.encode(MESH.vertices, MESH.faces) for name, kind in MESH_FORMATS.items()} | {"off": OFF}
SOUND["json"] = json.dumps({"vertices": MESH.vertices.tolist(), "faces": MESH.faces.tolist()}).encode()
#: What parsers stumble over.
WORDS = (
    b"nan", b"-1", b"1e999", b"99999999999999999999", b"\0", b"\xff\xff\xff\xff", b"[", b'"', b"//", b"-0", b"\n", b" ",
    b"3 0 0 0", b"f 0 0 0", b"{}", b"null", b"\x7f\xff\xff\xff", b"end_header", b"PK\x01\x02", b"../../etc/passwd",
)  # fmt: skip


@st.composite
def damaged(draw: st.DrawFn, sound: bytes) -> bytes:
    """A sound file after one to six cuts, insertions, overwritten or repeated pieces; or nothing but noise."""
    if draw(st.integers(0, 9)) == 0:
        return draw(st.binary(max_size=300))
    data = bytearray(sound)
    for _ in range(draw(st.integers(1, 6))):
        # Heads matter most.
        place = draw(st.integers(0, min(200, len(data))) | st.integers(0, len(data)))
        match draw(st.integers(0, 4)):
            case 0:
                del data[place : place + draw(st.integers(1, 40))]
            case 1:
                data[place:place] = draw(st.sampled_from(WORDS) | st.binary(max_size=8))
            case 2:
                word = draw(st.sampled_from(WORDS) | st.binary(min_size=1, max_size=4))
                data[place : place + len(word)] = word
            case 3:
                data[place:place] = data[place : place + draw(st.integers(1, 200))]
            case 4:
                del data[place:]
    return bytes(data)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.sampled_from(["../x", "1" * 99]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


def one_line(error: Exception) -> None:
    text = str(error)
    assert text
    assert "\n" not in text
    assert len(text) < 1000, text


@contextmanager
def at_most(steps: int, memory: int) -> Iterator[None]:
    """Counts calls, of C too, and bytes, which are the same on every machine, however busy it is."""
    count = 0

    def call(*_: object) -> None:
        nonlocal count
        count += 1

    tracemalloc.start()
    sys.setprofile(call)
    try:
        yield
    finally:
        sys.setprofile(None)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    assert count <= steps
    assert peak <= memory


#: What a mesh as small as ours can need, whatever its bytes say.
SMALL, MEMORY = Limits(3 * len(MESH.faces), len(MESH.faces)), 2**21


@pytest.mark.parametrize("format", sorted(SOUND.keys() - {"json"}))
def test_mesh_files(format: str) -> None:
    @fuzz
    @given(damaged(SOUND[format]))
    def read(data: bytes) -> None:
        try:
            with at_most(1000 + 10 * len(data), MEMORY):
                vertices, faces = read_arrays(data, format, SMALL)
        except MeshError as error:
            one_line(error)
        else:
            assert isinstance(vertices, np.ndarray)
            assert isinstance(faces, np.ndarray)

    read()


def numbers(count: int) -> st.SearchStrategy[list[Any]]:
    odd = st.sampled_from([0, -1, 1e300, "1", None, [1]])
    return st.lists(st.floats(-2, 2) | odd, min_size=count, max_size=count)


@st.composite
def scenes(draw: st.DrawFn) -> dict[str, Any]:
    """Scenes with nodes inside each other in any way, and accessors that say anything."""
    count = draw(st.integers(1, 60))
    shape = draw(st.sampled_from(["chain", "double", "tree", "any"]))
    nodes: list[dict[str, Any]] = []
    for k in range(count):
        ways = {
            "chain": [k + 1],
            "double": [k + 1, k + 1],
            "tree": [c for c in (2 * k + 1, 2 * k + 2) if c < count],
            "any": draw(st.lists(st.integers(-1, count), max_size=4)) if shape == "any" else [],
        }
        node: dict[str, Any] = {"children": ways[shape] if k < count - 1 or shape == "any" else []}
        if draw(st.booleans()):
            node |= draw(
                st.fixed_dictionaries(
                    {},
                    optional={
                        "matrix": st.just(MATRIX) | numbers(16),
                        "translation": numbers(3),
                        "rotation": numbers(4),
                        "scale": numbers(3),
                        "mesh": st.integers(0, 1) | st.just(0),
                    },
                )
            )
        nodes.append(node)
    nodes[-1]["mesh"] = 0
    tree = document(nodes=nodes, scenes=[{"nodes": draw(st.just([0]) | st.lists(st.integers(0, count), max_size=3))}])
    for kind in ("accessors", "bufferViews", "buffers"):
        for entry in draw(st.just([]) | st.just(tree[kind])):
            key = draw(st.sampled_from([*entry, "byteOffset", "byteStride", "normalized", "sparse"]))
            entry[key] = draw(JSON | st.integers(-1, 300) | st.sampled_from([10**9, 2**31, 5121, 5126, "VEC4", "MAT4"]))
    modes = st.fixed_dictionaries({}, optional={"mode": st.integers(0, 7), "indices": st.integers(0, 2)})
    primitives = draw(st.lists(modes, min_size=1, max_size=3))
    tree["meshes"] = [{"primitives": [{"attributes": {"POSITION": 0}} | primitive for primitive in primitives]}]
    return tree


@fuzz
@given(scenes())
def test_scenes(tree: dict[str, Any]) -> None:
    """Every node once: the steps are in proportion to what is written, where the ways through it may be millions."""
    data = glb(tree, BINARY)
    try:
        with at_most(2000 + 5 * len(data), MEMORY):
            vertices, faces = read_arrays(data, "glb", SMALL)
    except MeshError as error:
        one_line(error)
    else:
        assert vertices.shape[1] == faces.shape[1] == 3
        assert len(vertices) <= SMALL.vertices
        assert 0 <= faces.min() <= faces.max() < len(vertices)


@cache
def model() -> ShapeModel:
    with TemporaryDirectory() as folder:
        return ShapeModel(read_bundle(write_bundle(Path(folder))))


@pytest.fixture(scope="module", autouse=True)
def forget() -> Iterator[None]:
    """Models end before the interpreter does."""
    yield
    model.cache_clear()


@pytest.mark.parametrize("format", FORMATS)
def test_uploads(format: str) -> None:
    @fuzz
    @given(damaged(SOUND[format]))
    def upload(data: bytes) -> None:
        try:
            found = matched(data, format)
        except (UploadError, InvalidMeshError) as error:
            one_line(error)
        else:
            assert found.vertices.shape == MESH.vertices.shape
            assert np.isfinite(found.vertices).all()

    upload()


def matched(data: bytes, format: str | None, content_type: str = "") -> Matched:
    vertices, faces, *_ = read_mesh_file(data, content_type, format, limits(model()))
    return match(model(), vertices, faces)


FORM = b"\r\n".join(
    [
        *(b"--b", b'Content-Disposition: form-data; name="note"', b"", b"a torus", b"--b"),
        b'Content-Disposition: form-data; name="file"; filename="torus.obj"',
        *(b"Content-Type: model/obj", b"", SOUND["obj"], b"--b--", b""),
    ]
)


def test_forms() -> None:
    assert matched(FORM, None, "multipart/form-data; boundary=b").vertices.shape == MESH.vertices.shape

    @fuzz
    @given(damaged(FORM), damaged(b"multipart/form-data; boundary=b"))
    def upload(data: bytes, content_type: bytes) -> None:
        with suppress(InvalidMeshError):
            try:
                matched(data, None, content_type.decode("latin-1"))
            except UploadError as error:
                one_line(error)

    upload()


@pytest.mark.parametrize(
    "uri", ["shape.bin", "/etc/passwd", "file:///etc/passwd", "../../etc/passwd", "http://[::1]/x"]
)
def test_an_upload_opens_no_other_file(uri: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tree = json.loads(SOUND["gltf"])
    data = base64.b64decode(tree["buffers"][0]["uri"].partition(",")[2])
    (tmp_path / "shape.bin").write_bytes(data)  # what it asks for is even there
    monkeypatch.chdir(tmp_path)
    tree["buffers"][0]["uri"] = uri
    with pytest.raises(UploadError) as refusal:
        matched(json.dumps(tree).encode(), "gltf")
    one_line(refusal.value)
    assert "root:" not in str(refusal.value)


@pytest.mark.parametrize("format", ["obj", "ply", "stl", "off", "glb", "npz"])
def test_folders_of_meshes(format: str, tmp_path: Path) -> None:
    @fuzz
    @given(st.lists(damaged(SOUND[format]) | st.just(SOUND[format]), min_size=3, max_size=3))
    def ingest(files: list[bytes]) -> None:
        for k, data in enumerate(files):
            (tmp_path / f"{k}.{format}").write_bytes(data)
        try:
            read_collection(tmp_path)
        except IngestError as error:
            one_line(error)

    ingest()


@fuzz
@given(st.data())
def test_one_npz_for_a_collection(data: st.DataObject) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder, "all.npz")
        np.savez(path, vertices=np.stack([MESH.vertices] * 3), faces=MESH.faces)
        path.write_bytes(data.draw(damaged(path.read_bytes())))
        try:
            read_collection(path)
        except IngestError as error:
            one_line(error)


@cache
def bundle() -> dict[str, bytes]:
    with TemporaryDirectory() as folder:
        return {path.name: path.read_bytes() for path in write_bundle(Path(folder)).iterdir()}


@fuzz
@given(st.data())
def test_manifests(data: st.DataObject) -> None:
    """Damaged text, or any value in the place of any other."""
    text = bundle()["manifest.json"]
    if data.draw(st.booleans()):
        text = data.draw(damaged(text))
    else:
        facts = json.loads(text)
        here = facts
        while True:
            keys = sorted(here) if isinstance(here, dict) else list(range(len(here)))
            key = data.draw(st.sampled_from(keys))
            if not isinstance(here[key], dict | list) or not here[key] or data.draw(st.booleans()):
                break
            here = here[key]
        here[key] = data.draw(JSON)
        text = json.dumps(facts).encode()
    with suppress(ValidationError):
        Manifest.model_validate_json(text)
    as_bundle(lambda folder: (folder / "manifest.json").write_bytes(text))


@pytest.mark.parametrize("file", ["geometry.npz", "factor-0.onnx", "combiner.onnx"])
def test_files_of_bundles_that_have_their_digests(file: str) -> None:
    """Who writes a bundle writes the digests too, so these alone don't make a file sound."""

    @fuzz
    @given(damaged(bundle()[file]))
    def read(data: bytes) -> None:
        def spoil(folder: Path) -> None:
            (folder / file).write_bytes(data)
            seal(folder)

        as_bundle(spoil)

    read()


def as_bundle(spoil: Callable[[Path], object]) -> None:
    with TemporaryDirectory() as folder:
        place = Path(folder, "small", "1")
        place.mkdir(parents=True)
        for name, content in bundle().items():
            (place / name).write_bytes(content)
        spoil(place)
        try:
            ShapeModel(read_bundle(place)).rehearse()
        except BundleError as error:
            one_line(ValueError(" ".join(str(error).split())))


@cache
def sound_id() -> str:
    path = Animation(keyframes=[[0, 0, 0], [0.1, 1, 0.5]], frames=5)
    return path.to_id(model().digest, model().latents)


@fuzz
@given(st.data())
def test_ids_of_interpolations(data: st.DataObject) -> None:
    name = data.draw(damaged(sound_id().encode())).decode("latin-1")
    try:
        animation, _ = Animation.from_id(name)
    except UnknownInterpolationError as error:
        one_line(error)
    else:
        assert name == sound_id()
        assert animation.frame_count == 5


@fuzz
@given(st.text(max_size=60) | st.lists(st.sampled_from(["model/obj", "*/*", ";q=", "0", "nan", ",", "/"])).map("".join))
def test_what_is_accepted(accept: str) -> None:
    try:
        assert choose({"glb": "model/gltf-binary", "obj": "model/obj"}, None, accept) in {"glb", "obj"}
    except ProblemError as error:
        one_line(error)


@fuzz
@given(st.lists(st.lists(st.floats() | st.integers(), max_size=4), max_size=3))
def test_codes(values: list[list[float]]) -> None:
    try:
        codes, inside = model().latents.codes(values)
    except LatentError as error:
        one_line(error)
    else:
        assert np.isfinite(codes).all()
        assert len(inside) == len(values)
