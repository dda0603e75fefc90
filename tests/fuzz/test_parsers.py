"""Bytes from outside, as hypothesis makes them up: every parser reads them or refuses them in one line.

A few hundred, the same each time, in the whole suite; ``make fuzz`` tries thousands of new ones.
"""

from __future__ import annotations

import base64
import json
import os
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from geometry.formats import MESH_FORMATS, read_arrays
from geometry.mesh import MeshError
from service.animation import Animation, UnknownInterpolationError
from service.bundle import BundleError, read_bundle
from service.correspondence import InvalidMeshError, match
from service.latent_space import LatentError
from service.manifest import Manifest
from service.negotiation import choose
from service.problems import ProblemError
from service.shape_model import ShapeModel
from service.uploads import FORMATS
from tests.service.bundles import reference, seal, write_bundle
from training.ingest import IngestError, read_collection

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


def one_line(error: Exception) -> None:
    text = str(error)
    assert text
    assert "\n" not in text
    assert len(text) < 1000, text


@pytest.mark.parametrize("format", sorted(SOUND.keys() - {"json"}))
def test_mesh_files(format: str) -> None:
    @fuzz
    @given(damaged(SOUND[format]))
    def read(data: bytes) -> None:
        try:
            vertices, faces = read_arrays(data, format)
        except MeshError as error:
            one_line(error)
        else:
            assert isinstance(vertices, np.ndarray)
            assert isinstance(faces, np.ndarray)

    read()


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
            found = match(model(), data, format)
        except InvalidMeshError as error:
            one_line(error)
        else:
            assert found.vertices.shape == MESH.vertices.shape
            assert np.isfinite(found.vertices).all()

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
    with pytest.raises(InvalidMeshError) as refusal:
        match(model(), json.dumps(tree).encode(), "gltf")
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


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.sampled_from(["../x", "1" * 99]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


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
            ShapeModel(read_bundle(place))
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
